"""What the arm measures in a cycle, as the controller's end sends it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from fri.packets import JOINTS

__all__ = ["IDENTITY_POSE", "Sample"]

#: 3x4 row-major pose without rotation and translation.
IDENTITY_POSE = (1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0)


def _identity() -> np.ndarray:
    return np.array(IDENTITY_POSE)


def _joints() -> np.ndarray:
    return np.zeros(JOINTS)


@dataclass(slots=True)
class Sample:
    """What the arm measures, in the units of `MSR`.

    The emulator writes the arrays in place, ``KrcSession.packet`` reads them.
    """

    msr_jnt_pos: np.ndarray = field(default_factory=_joints)
    msr_cart_pos: np.ndarray = field(default_factory=_identity)
    cmd_cart_pos: np.ndarray = field(default_factory=_identity)
    msr_jnt_trq: np.ndarray = field(default_factory=_joints)
    est_ext_jnt_trq: np.ndarray = field(default_factory=_joints)
    est_ext_tcp_ft: np.ndarray = field(default_factory=lambda: np.zeros(6))
    jacobian: np.ndarray = field(default_factory=lambda: np.zeros((6, JOINTS)))
    mass_matrix: np.ndarray = field(default_factory=lambda: np.zeros((JOINTS, JOINTS)))
    gravity: np.ndarray = field(default_factory=_joints)
    temperature: np.ndarray = field(default_factory=_joints)
