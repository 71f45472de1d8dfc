"""The arm: its description, its connection, its guards, and the log of a session.

Names are imported on first use: a process of the driver loads its own modules only.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lwr_driver.arm import Arm, Cell, CollisionChecker
    from lwr_driver.driver import Driver, LinkSettings
    from lwr_driver.motion import Motion, check_motion, move_to
    from lwr_driver.session import Session, SessionWriter, read_session, recover, session_metadata

__all__ = [
    "Arm",
    "Cell",
    "CollisionChecker",
    "Driver",
    "LinkSettings",
    "Motion",
    "Session",
    "SessionWriter",
    "check_motion",
    "move_to",
    "read_session",
    "recover",
    "session_metadata",
]

_HOMES = {
    "arm": ("Arm", "Cell", "CollisionChecker"),
    "driver": ("Driver", "LinkSettings"),
    "motion": ("Motion", "check_motion", "move_to"),
    "session": ("Session", "SessionWriter", "read_session", "recover", "session_metadata"),
}


def __getattr__(name: str) -> Any:
    for home, names in _HOMES.items():
        if name in names:
            return getattr(import_module(f"{__name__}.{home}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
