"""What every exciting motion offers, whatever its parametrisation."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

__all__ = ["Array", "Basis", "Extrema", "ParametricMotion", "Samples"]

Array = npt.NDArray[np.float64]


class Samples(NamedTuple):
    """A motion at n times; each array (n, joints) float64."""

    q: Array
    """Joint positions [rad]."""
    qd: Array
    """Joint velocities [rad/s]."""
    qdd: Array
    """Joint accelerations [rad/s²]."""
    qddd: Array
    """Joint jerks [rad/s³]."""


class Extrema(NamedTuple):
    """Smallest and largest value of each joint on the continuous motion, and when; arrays (joints,)."""

    low: Array
    high: Array
    t_low: Array
    t_high: Array


class ParametricMotion(Protocol):
    """A motion that is known at every instant: Fourier series, B-spline, point to point."""

    @property
    def duration(self) -> float:
        """Length of one run [s]; a periodic motion can be repeated after it."""

    @property
    def joints(self) -> int:
        """Number of joints."""

    def sample(self, t: npt.ArrayLike) -> Samples:
        """Positions and three derivatives at the times t (n,) [s]."""

    def extrema(self, derivative: int) -> Extrema:
        """Exact extreme values of a derivative (0 to 3) on the continuous motion."""


class Basis(Protocol):
    """Parametrisation linear in its free coefficients: q(t) = matrix(t) @ x.T, x of shape (joints, free).

    Rest conditions are part of the basis: every x gives zero velocity and acceleration at both ends.
    """

    @property
    def duration(self) -> float:
        """Length of the motion [s]."""

    @property
    def free(self) -> int:
        """Free coefficients of each joint."""

    def matrix(self, t: npt.ArrayLike, derivative: int = 0) -> Array:
        """Values of the basis functions or their derivatives at t, (n, free)."""

    def motion(self, x: Array) -> ParametricMotion:
        """The motion with the free coefficients x (joints, free)."""

    def coefficients(self, motion: ParametricMotion) -> Array:
        """Free coefficients (joints, free) of a motion that this basis can represent."""

    def grid_factor(self, n: int, derivative: int) -> float:
        """Upper bound of (true maximum) / (maximum on n equidistant samples), centred signals."""
