"""The arm: its description, its connection, its guards, and the log of a session.

Names are imported on first use: a process of the driver loads its own modules only.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from fri.on_first_use import on_first_use

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
    ".arm": ("Arm", "Cell", "CollisionChecker"),
    ".driver": ("Driver", "LinkSettings"),
    ".motion": ("Motion", "check_motion", "move_to"),
    ".session": ("Session", "SessionWriter", "read_session", "recover", "session_metadata"),
}
__getattr__, __dir__ = on_first_use(globals(), _HOMES)
