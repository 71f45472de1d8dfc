"""A doubt about the data: channel, joints, observation, likely cause, remedy."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

from fri.errors import DataError
from lwr_driver.session import JointColumns, Session

LATE_S = 0.01
"""Least delay of a position of interest [s]: see `positions`."""
MOVED = 0.05
"""Least movement of a joint of interest [rad or m]."""
MEND_TIME = "shift the column by that time before the import, or record it with the stamps of its own samples"
MEND_POSITION = (
    "check zero and gain of this channel (`offset_rad` and `scale` in the mapping of the import) and the joint's frame "
    "in the URDF"
)


DoubtKind = Literal["", "gain", "zero", "drift", "saturation"]


@dataclass(frozen=True)
class Doubt:
    """One sentence about one channel of one session or of all.

    channel : "position", "velocity", "joint torque", "motor torque", "time", "payload", "log", "spike", "kinematics".
    joints : names; empty for the channel as a whole. session : file name; empty for all sessions.
    certain : whether the data are worthless with it. lost : whether the channel holds nothing of use, and the rows do
    without it. kind : "gain", "zero" or "drift" of a torque, "saturation" of one, whose samples at the level are left
    out.
    """

    channel: str
    joints: tuple[str, ...]
    seen: str
    looks_like: str
    mend: str
    certain: bool = False
    session: str = ""
    lost: bool = False
    kind: DoubtKind = ""

    @property
    def subject(self) -> str:
        """Session, joints and channel."""
        where = f"{self.session}: " if self.session else ""
        return f"{where}{', '.join(self.joints)} {self.channel}" if self.joints else f"{where}{self.channel}"

    def __str__(self) -> str:
        looks = f", looks like {self.looks_like}" if self.looks_like else ""
        return f"{self.subject}: {self.seen}{looks}; {self.mend}"


def torques_of(session: Session) -> Iterator[tuple[str, JointColumns]]:
    """Torque channels of a session with values, by their names in doubts."""
    for channel, columns in (("joint torque", session.joint), ("motor torque", session.motor)):
        if columns is not None and columns.effort.size:
            yield channel, columns


def doubted_joints(doubts: Sequence[Doubt]) -> frozenset[str]:
    """Joints with a doubt about their torque or position; both make the residual of their rows."""
    return frozenset(
        joint
        for doubt in doubts
        if doubt.channel == "position" or "torque" in doubt.channel
        for joint in doubt.joints
    )


def late_positions(doubts: Sequence[Doubt]) -> bool:
    """Whether the positions of a joint are late; the torques of all joints seem early or late with them."""
    return any(doubt.mend == MEND_TIME for doubt in doubts)


def settle(doubts: Sequence[Doubt]) -> list[str]:
    """Sentences of the doubts for the report. Raises DataError with all of them if one is certain."""
    sentences = list(dict.fromkeys(str(doubt) for doubt in doubts))
    certain = list(dict.fromkeys(str(doubt) for doubt in doubts if doubt.certain))
    if certain:
        raise DataError("\n".join([*certain, *(text for text in sentences if text not in certain)]))
    return sentences


@contextlib.contextmanager
def explaining(doubts: Sequence[Doubt]) -> Iterator[None]:
    """Add the doubts to a DataError from within, as its possible causes."""
    try:
        yield
    except DataError as error:
        if not doubts:
            raise
        seen = ("before that these channels were in doubt:", *settle(doubts))
        raise DataError("\n".join([str(error), *seen])) from error
