"""What happens to a session of the controller's end, with a sentence for whoever reads it."""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple

__all__ = ["Event", "EventKind"]


class EventKind(Enum):
    """What happened to the session; those after REFUSED ended command mode."""

    OPENED = "opened"
    STARTED = "started"
    STOPPED = "stopped"
    CLOSED = "closed"
    REFUSED = "start refused"
    MISSES = "answers missing"
    MALFORMED = "malformed datagram"
    WRONG_FLAGS = "wrong command flags"
    FLAGS_CHANGED = "command flags changed"
    NOT_FINITE = "value not finite"
    NOT_MIRRORED = "command away from the mirror"
    POSITION = "position limit"
    VELOCITY = "velocity limit"
    ACCELERATION = "acceleration limit"
    QUALITY = "quality"
    DRIVES_OFF = "drives off"
    DRIVE_ERROR = "drive error"
    EXTERNAL = "external"


class Event(NamedTuple):
    """Something that happened to the session: in which cycle, what, and a sentence about it."""

    cycle: int
    kind: EventKind
    text: str
