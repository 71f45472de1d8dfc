"""Enumerations of FRI 1.0, its session state machine as data, and the events of a session.

The numbers are the protocol's, without the "invalid" members of a KUKA client: a packet with any other value
is malformed.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum, IntEnum, IntFlag
from types import MappingProxyType
from typing import NamedTuple

#: Drive bits of a fully powered arm: bit 0 is A1, bit 6 is A6.
ALL_DRIVES = 0x7F


class State(IntEnum):
    """State of an FRI session, as in `$FRISTATE`. OFF is internal to the controller: nothing is sent then."""

    OFF = 0
    MON = 1
    CMD = 2


class Quality(IntEnum):
    """The controller's judgement of the timing of the answers; commanding is allowed from BAD upwards."""

    UNACCEPTABLE = 0
    BAD = 1
    OK = 2
    PERFECT = 3


class Control(IntEnum):
    """Control mode of the arm."""

    OTHER = 0
    POSITION = 1
    CART_IMP = 2
    JNT_IMP = 3


class CommandFlag(IntFlag):
    """Fields of a command in use; may change in monitor mode only."""

    JNTPOS = 0x0001
    JNTTRQ = 0x0004
    JNTSTIFF = 0x0010
    JNTDAMP = 0x0020
    CARTPOS = 0x0100
    TCPFT = 0x0400
    CARTSTIFF = 0x1000
    CARTDAMP = 0x2000


class Trigger(Enum):
    """Causes of a change of state."""

    FRI_OPEN = "friOpen"
    FRI_START = "friStart with the timing in sync"
    FRI_STOP = "friStop"
    FRI_CLOSE = "friClose"
    FAULT = "fault"


#: The session state machine; any other trigger leaves the state unchanged.
TRANSITIONS: Mapping[tuple[State, Trigger], State] = MappingProxyType(
    {
        (State.OFF, Trigger.FRI_OPEN): State.MON,
        (State.MON, Trigger.FRI_START): State.CMD,
        (State.MON, Trigger.FRI_CLOSE): State.OFF,
        (State.CMD, Trigger.FRI_STOP): State.MON,
        (State.CMD, Trigger.FAULT): State.MON,
    }
)

_JOINT = CommandFlag.JNTPOS | CommandFlag.JNTTRQ | CommandFlag.JNTSTIFF | CommandFlag.JNTDAMP
_CARTESIAN = CommandFlag.CARTPOS | CommandFlag.TCPFT | CommandFlag.CARTSTIFF | CommandFlag.CARTDAMP

#: Full flag set of a client for each control mode: 0x0001, 0x0035, 0x3500.
FLAGS: Mapping[Control, CommandFlag] = MappingProxyType(
    {
        Control.OTHER: CommandFlag(0),
        Control.POSITION: CommandFlag.JNTPOS,
        Control.JNT_IMP: _JOINT,
        Control.CART_IMP: _CARTESIAN,
    }
)

#: Flags allowed in each control mode. In Cartesian impedance JNTPOS asks for a null-space posture.
ALLOWED_FLAGS: Mapping[Control, CommandFlag] = MappingProxyType(
    {
        Control.OTHER: _JOINT | _CARTESIAN,
        Control.POSITION: CommandFlag.JNTPOS,
        Control.JNT_IMP: _JOINT,
        Control.CART_IMP: _CARTESIAN | CommandFlag.JNTPOS,
    }
)

#: `$STIFFNESS.STRATEGY` of KRL for each control mode.
STRATEGY_BY_CONTROL: Mapping[Control, int] = MappingProxyType(
    {Control.POSITION: 10, Control.CART_IMP: 20, Control.JNT_IMP: 30}
)

CONTROL_BY_STRATEGY: Mapping[int, Control] = MappingProxyType(
    {strategy: control for control, strategy in STRATEGY_BY_CONTROL.items()}
)


class EventKind(Enum):
    """Kinds of events; those after REFUSED end command mode."""

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
    IMPEDANCE = "stiffness or damping out of range"
    NOT_MIRRORED = "command away from the mirror"
    POSITION = "position limit"
    VELOCITY = "velocity limit"
    ACCELERATION = "acceleration limit"
    QUALITY = "quality"
    DRIVES_OFF = "drives off"
    DRIVE_ERROR = "drive error"
    EXTERNAL = "external"


class Event(NamedTuple):
    """An event of the session: its cycle, its kind, and a sentence about it."""

    cycle: int
    kind: EventKind
    text: str
