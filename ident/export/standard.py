"""An arm with numbers for all its parameters and one condition of load: what all exports start from."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from fri.errors import ConfigurationError
from ident.kinematics import Chain

__all__ = ["CoupledDrives", "StandardModel"]


@dataclass(frozen=True)
class CoupledDrives:
    """Two joints (counted from 0) with coupled drives: inertia [kg m^2], viscous [Nm s/rad], coulomb [Nm]."""

    joints: tuple[int, int]
    inertia: float
    viscous: float
    coulomb: float


@dataclass(frozen=True, eq=False)
class StandardModel:
    """Numbers for every standard parameter of a chain, with the payload (if any) already part of the last
    link.

    inertial : (n, 10) XX ... M of each link in its modified-DH frame. drive : (n, 7) Ia Fvl Fcl offl Fvm Fcm
        offm.
    sides : what the model describes: joint torque, motor torque, or only their difference.
    coulomb_kind, coulomb_width : the function that stands for sign(qd).
    consistent : whether every link is a body that can exist (needed for URDF and MJCF, not for code).
    title : one line for the head of a file.
    """

    chain: Chain
    inertial: NDArray[np.float64]
    drive: NDArray[np.float64]
    couplings: tuple[CoupledDrives, ...] = ()
    sides: tuple[str, ...] = ("motor", "joint")
    coulomb_kind: str = "sign"
    coulomb_width: float = 0.0
    consistent: bool = False
    title: str = ""
    notes: tuple[str, ...] = field(default=())

    def __post_init__(self) -> None:
        for name, width in (("inertial", 10), ("drive", 7)):
            values = np.array(getattr(self, name), dtype=np.float64)
            if values.shape != (self.chain.n, width) or not np.all(np.isfinite(values)):
                raise ConfigurationError(
                    f"`{name}` has shape {values.shape} or is not finite; expected ({self.chain.n}, {width})"
                )
            values.setflags(write=False)
            object.__setattr__(self, name, values)
