"""What the diagnosis needs from files: the kinematics and the description of the arm."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fri.errors import ConfigurationError
from ident.diagnosis import ArmData
from ident.dynamics.kinematics import Chain
from lwr_driver.arm import Arm
from lwr_driver.session import Session
from runner.estimation import couplings

__all__ = ["arm_data", "chain_of", "known_arm"]

_DEFAULT = "lwr4plus.yaml"


def chain_of(sessions: Sequence[Session], urdf: Path | None) -> Chain:
    """Kinematics from a URDF file, or from the first session."""
    text = sessions[0].robot_description
    if urdf is None and text is None:
        raise ConfigurationError(f"{sessions[0].path}: holds no robot description; name the URDF with --urdf")
    return Chain.from_urdf(os.fspath(urdf) if urdf is not None else str(text))


def known_arm(name: str | None, chain: Chain) -> Arm | None:
    """The arm file called `name`; without a name the default one, where its joints are those of the chain."""
    if name is not None:
        return Arm.load(name)
    arm = Arm.load(_DEFAULT)
    return arm if arm.joint_names == chain.joint_names else None


def arm_data(
    arm: Arm | None, chain: Chain, coupling: Sequence[str] = (), gear_ratio: str | None = None
) -> ArmData:
    """Stiffness and gear ratios of an arm file, and what the command line says of the drives.

    coupling : each `A:B`, two joints with coupled drives. gear_ratio : `N` for all joints or `N,N,...`, in place
    of the arm file's. Raises ConfigurationError for joints that the chain does not have and for wrong numbers.
    """
    pairs = couplings(coupling)
    for name in (name for pair in pairs for name in pair.joints):
        if name not in chain.joint_names:
            raise ConfigurationError(f"--coupling: no joint {name!r}; joints: {', '.join(chain.joint_names)}")
    ratio = None if arm is None else arm.gear_ratio.astype(float)
    if gear_ratio is not None:
        ratio = _gear_ratios(gear_ratio, chain.n)
    return ArmData(None if arm is None else arm.stiffness, ratio, pairs)


def _gear_ratios(text: str, n: int) -> NDArray[np.float64]:
    try:
        values = np.array([float(part) for part in text.split(",")])
    except ValueError:
        raise ConfigurationError(f"--gear-ratio {text!r} is no number or list such as 100,100,160") from None
    if len(values) not in (1, n) or not np.all((values > 0.0) & np.isfinite(values)):
        raise ConfigurationError(
            f"--gear-ratio {text!r}: one number above zero for all joints, or one for each of the {n} joints"
        )
    return np.broadcast_to(values, n).copy()
