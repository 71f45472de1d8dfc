"""What the arm measures in a cycle, as the controller's end sends it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

__all__ = ["IDENTITY_POSE", "Sample"]

#: 3x4 row-major pose without rotation and translation.
IDENTITY_POSE = (1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0)


def _zeros(*shape: int) -> np.ndarray:
    return field(default_factory=lambda: np.zeros(shape))


@dataclass(slots=True)
class Sample:
    """What the arm measures; written in place by the emulator, read by ``KrcSession.packet``. Units as in `MSR`."""

    msr_jnt_pos: np.ndarray = _zeros(7)
    msr_cart_pos: np.ndarray = field(default_factory=lambda: np.array(IDENTITY_POSE))
    cmd_cart_pos: np.ndarray = field(default_factory=lambda: np.array(IDENTITY_POSE))
    msr_jnt_trq: np.ndarray = _zeros(7)
    est_ext_jnt_trq: np.ndarray = _zeros(7)
    est_ext_tcp_ft: np.ndarray = _zeros(6)
    jacobian: np.ndarray = _zeros(6, 7)
    mass_matrix: np.ndarray = _zeros(7, 7)
    gravity: np.ndarray = _zeros(7)
    temperature: np.ndarray = _zeros(7)
