"""The description of a known arm: that of the default arm file, for a chain with its joints."""

from __future__ import annotations

from ident.dynamics.kinematics import Chain
from lwr_driver.arm import Arm


def known_arm(chain: Chain, name: str | None = None) -> Arm | None:
    """The arm file called `name`; without a name the default one, if its joints are those of the chain, else None."""
    if name is not None:
        return Arm.load(name)
    arm = Arm.load()
    return arm if arm.joint_names == chain.joint_names else None
