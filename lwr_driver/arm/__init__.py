"""The arm and its surroundings as descriptions: limits and URDF, the cell, and distances between them.

`Cell` and `CollisionChecker` are imported on first use: the real-time process needs neither, and collision
checking loads pinocchio.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from fri.on_first_use import on_first_use
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

_HOMES = {".cell": ("Box", "Cell", "PayloadShape"), ".collision": ("Clearance", "CollisionChecker")}
__getattr__, __dir__ = on_first_use(globals(), _HOMES)
