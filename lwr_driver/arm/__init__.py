"""The arm and its surroundings as descriptions: limits and URDF, the cell, and distances between them.

`Cell` and `CollisionChecker` are imported on first use: the real-time process needs neither, and collision
checking loads pinocchio.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from lwr_driver.arm.description import JOINTS, Arm, ArmLimits, LinkFrames, LinkInertia, link_inertias

if TYPE_CHECKING:
    from lwr_driver.arm.cell import Box, Cell, PayloadShape
    from lwr_driver.arm.collision import Clearance, CollisionChecker

__all__ = [
    "JOINTS",
    "Arm",
    "ArmLimits",
    "Box",
    "Cell",
    "Clearance",
    "CollisionChecker",
    "LinkFrames",
    "LinkInertia",
    "PayloadShape",
    "link_inertias",
]

_HOMES = {"cell": ("Box", "Cell", "PayloadShape"), "collision": ("Clearance", "CollisionChecker")}


def __getattr__(name: str) -> Any:
    for home, names in _HOMES.items():
        if name in names:
            return getattr(import_module(f"{__name__}.{home}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
