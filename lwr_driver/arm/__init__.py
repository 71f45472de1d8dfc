"""The arm and its surroundings as descriptions: limits and URDF, the cell, and distances between them.

`Cell` and `CollisionChecker` are imported on first use: the real-time process needs neither, and collision
checking loads pinocchio.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from lwr_driver.arm.description import JOINTS, Arm, Limits, LinkFrames, LinkInertia, link_inertias

if TYPE_CHECKING:
    from lwr_driver.arm.cell import Box, Cell, PayloadShape
    from lwr_driver.arm.collision import Clearance, CollisionChecker

__all__ = [
    "JOINTS",
    "Arm",
    "Box",
    "Cell",
    "Clearance",
    "CollisionChecker",
    "Limits",
    "LinkFrames",
    "LinkInertia",
    "PayloadShape",
    "link_inertias",
]

_LATER = {
    "Box": "cell",
    "Cell": "cell",
    "PayloadShape": "cell",
    "Clearance": "collision",
    "CollisionChecker": "collision",
}


def __getattr__(name: str) -> Any:
    if name not in _LATER:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_LATER[name]}"), name)
