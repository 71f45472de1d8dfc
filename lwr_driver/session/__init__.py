"""The session log: one MCAP file for one motion of the arm with one payload.

`SessionWriter` writes a log, `read_session` reads it into numpy arrays, `describe` summarises it. `recover`
repairs the log of a killed recorder. `as_sessions` accepts sessions and paths alike.
"""

from __future__ import annotations

from lwr_driver.arm import LinkFrames
from lwr_driver.session.reader import Sessions, as_sessions, describe, read_session
from lwr_driver.session.recovery import recover
from lwr_driver.session.session import (
    JointColumns,
    Missing,
    Phase,
    Session,
)
from lwr_driver.session.writer import SessionWriter, session_metadata

__all__ = [
    "JointColumns",
    "LinkFrames",
    "Missing",
    "Phase",
    "Session",
    "SessionWriter",
    "Sessions",
    "as_sessions",
    "describe",
    "read_session",
    "recover",
    "session_metadata",
]
