"""The session log: one MCAP file for one motion of the arm with one payload. Writer and reader side by side.

`SessionWriter` writes; `read_session` reads into columns of numpy arrays; `recover` makes the file of a
killed recorder whole; `describe` says what a file holds.
"""

from __future__ import annotations

from lwr_driver.arm import LinkFrames
from lwr_driver.session.reader import describe, read_session
from lwr_driver.session.recovery import Recovery, recover
from lwr_driver.session.session import (
    ControllerModelColumns,
    Gap,
    JointColumns,
    Missing,
    Phase,
    Session,
    SessionSummary,
    StatusColumns,
)
from lwr_driver.session.writer import SessionWriter, session_metadata

__all__ = [
    "ControllerModelColumns",
    "Gap",
    "JointColumns",
    "LinkFrames",
    "Missing",
    "Phase",
    "Recovery",
    "Session",
    "SessionSummary",
    "SessionWriter",
    "StatusColumns",
    "describe",
    "read_session",
    "recover",
    "session_metadata",
]
