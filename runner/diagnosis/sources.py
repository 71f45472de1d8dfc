"""What the diagnosis needs from files: the kinematics and the description of the arm."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from fri.errors import ConfigurationError
from ident.discrepancy import ArmData
from ident.kinematics import Chain
from lwr_driver.arm import Arm
from lwr_driver.session import Session

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


def arm_data(arm: Arm | None) -> ArmData:
    """Stiffness and gear ratios of an arm file."""
    return ArmData() if arm is None else ArmData(arm.stiffness, arm.gear_ratio.astype(float))
