"""A session as it was read: metadata, channels as columns, and what of it is missing."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from fri.errors import DataError
from lwr_driver.session.columns import ControllerModelColumns, JointColumns, Phase, StatusColumns

__all__ = ["Missing", "Session"]


@dataclass(frozen=True)
class Missing:
    """What a session lacks; false if it is whole.

    ended : the recorder wrote `session_end`
    closed : the file has its summary and footer
    bytes_unread : bytes behind the last whole record that could be read
    lost_from, lost_to : log times of the chunk that was cut, where its head can still be read [ns]
    samples : lost samples of each topic, as the source's counters tell them
    notes : further remarks, each a sentence
    """

    ended: bool = True
    closed: bool = True
    bytes_unread: int = 0
    lost_from: int | None = None
    lost_to: int | None = None
    samples: Mapping[str, int] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def __bool__(self) -> bool:
        return not (self.ended and self.closed and not self.bytes_unread and not any(self.samples.values()))

    @property
    def lines(self) -> tuple[str, ...]:
        """What is missing, one sentence each."""
        lines = []
        if not self.ended:
            lines.append(
                "the recorder died: there is no session_end; up to one open chunk (0.5 s) was never written"
            )
        elif not self.closed:
            lines.append("the file has no footer")
        if self.bytes_unread:
            lines.append(f"{self.bytes_unread} bytes at the end of the file are not whole and were not read")
        if self.lost_from is not None and self.lost_to is not None:
            seconds = (self.lost_to - self.lost_from) * 1e-9
            lines.append(f"the chunk that was cut spans {seconds:.3f} s of log time")
        lines += [f"{topic}: {count} samples lost" for topic, count in self.samples.items() if count]
        return (*lines, *self.notes)

    def __str__(self) -> str:
        return "; ".join(self.lines) or "nothing"


@dataclass(frozen=True)
class Session:
    """One motion of the arm with one payload.

    metadata : the record `session`; end : the record `session_end`, None if the recorder died
    joint_names : joints of `/joint_states` in its order; the other channels have theirs in the same order
    joint : `/joint_states`; motor, command : `/motor_states` and `/joint_command`, None if absent
    phases : beginnings of phases; empty if the session is to be used whole
    attachments : file name -> content
    """

    path: Path
    metadata: Mapping[str, str]
    end: Mapping[str, str] | None
    joint_names: tuple[str, ...]
    joint: JointColumns
    motor: JointColumns | None = None
    command: JointColumns | None = None
    phases: tuple[Phase, ...] = ()
    status: StatusColumns | None = None
    controller_model: ControllerModelColumns | None = None
    robot_description: str | None = None
    attachments: Mapping[str, bytes] = field(default_factory=dict)
    missing: Missing = field(default_factory=Missing)

    @property
    def start(self) -> int:
        """Log time of the first joint state [ns]."""
        return int(self.joint.log_time[0])

    @property
    def duration_s(self) -> float:
        """Log time from the first joint state to the last [s]."""
        return float(self.joint.log_time[-1] - self.joint.log_time[0]) * 1e-9

    def select(self, joint_names: Sequence[str]) -> Session:
        """This session with the joints `joint_names` in this order in all channels.

        DataError names a joint that a channel does not have. Joints that are not asked for are left out.
        """
        names = tuple(joint_names)
        if not names or len(set(names)) != len(names):
            raise DataError(
                f"{self.path}: joints asked for are {', '.join(names) or 'none'}; each once, one at least"
            )
        return dataclasses.replace(
            self,
            joint_names=names,
            joint=self.joint.select(names),
            motor=None if self.motor is None else self.motor.select(names),
            command=None if self.command is None else self.command.select(names),
        )

    def spans(self, name: str) -> tuple[tuple[int, int], ...]:
        """[start, stop) log times [ns] of every phase `name`, and of those numbered `name N`."""
        stops = [*(phase.log_time for phase in self.phases[1:]), int(self.joint.log_time[-1]) + 1]
        return tuple(
            (phase.log_time, stop)
            for phase, stop in zip(self.phases, stops, strict=False)
            if phase.name == name or phase.name.startswith(name + " ")
        )
