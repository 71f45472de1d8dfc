"""Collision of the arm with itself, the ground and the cell, by pinocchio and coal."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lwr_driver.arm import Arm
from lwr_driver.cell import Cell, PayloadShape

__all__ = ["Clearance", "CollisionChecker"]


@dataclass(frozen=True)
class Clearance:
    """The smallest distance: between which two bodies, where [m in `base_link`], and at which row of a path.

    distance : [m]; below zero the bodies overlap
    pair : names of the two bodies, links of the arm or things of the cell
    points : (2, 3), the nearest points [m]
    q : (7,), the posture [rad]; row and time_s : place in the path, 0 for a single posture
    """

    distance: float
    pair: tuple[str, str]
    points: NDArray[np.float64]
    q: NDArray[np.float64]
    row: int = 0
    time_s: float = 0.0


class CollisionChecker:
    """Distances of the arm to itself, to the ground and to the boxes of the cell."""

    def __init__(self, arm: Arm, cell: Cell, payload: PayloadShape | None = None) -> None:
        raise NotImplementedError

    def clearance(self, q: NDArray[np.float64]) -> Clearance:
        """Smallest distance in the posture q, (7,) [rad]."""
        raise NotImplementedError

    def check_path(self, q: NDArray[np.float64], *, period_s: float = 0.0) -> Clearance:
        """Tightest moment of the path q, (n, 7) [rad]; compare its distance with `margin`."""
        raise NotImplementedError
