"""Summary of a session log: the content of `lwr-run info`, as data and in words."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lwr_driver.listing import Listing, Piece, text_of
from lwr_driver.session.session import JointColumns, Session, clock_text, pace, payload_text, utc_text


@dataclass(frozen=True)
class ChannelSummary:
    """Samples of one topic: number, rate [Hz], lost samples, and the longest pause between two [s]."""

    topic: str
    samples: int
    rate_hz: float
    lost: int
    longest_pause_s: float
    holds: tuple[str, ...]


@dataclass(frozen=True)
class PhaseSummary:
    """A phase: name, beginning after the first joint state, and duration [s]."""

    name: str
    begin_s: float
    duration_s: float


@dataclass(frozen=True)
class SessionSummary:
    """The content of `lwr-run info`; `str()` is the text, `as_dict()` the data.

    size_bytes : size of the file; position_range, effort_rms : per joint [rad], [Nm]
    """

    path: Path
    size_bytes: int
    utc_first: str
    duration_s: float
    joint_names: tuple[str, ...]
    channels: tuple[ChannelSummary, ...]
    phases: tuple[PhaseSummary, ...]
    position_range: tuple[tuple[float, float], ...]
    effort_rms: tuple[float, ...]
    motor_effort_rms: tuple[float, ...]
    attachments: Mapping[str, int]
    metadata: Mapping[str, str]
    end: Mapping[str, str] | None
    missing: tuple[str, ...]

    @property
    def ended(self) -> str:
        """How the recording ended, in words."""
        if self.foreign:
            return "recorded by another program"
        return "unknown: the recorder died" if self.end is None else self.end.get("exit_status", "unknown")

    @property
    def foreign(self) -> bool:
        """Whether another program wrote the file: it has neither `session` nor `session_end`."""
        return self.end is None and not self.metadata

    @property
    def recorded(self) -> str:
        """Time of the first sample, in words."""
        return clock_text(self.metadata, self.utc_first)

    def as_dict(self) -> dict[str, Any]:
        """Plain data, for JSON."""
        return {**asdict(self), "path": str(self.path)}

    def pieces(self) -> list[Piece]:
        """Origin, topics, joints, phases, and what is missing."""
        data = self.metadata
        reason = f" ({self.end['reason']})" if self.end and self.end.get("reason") else ""
        lines: list[Piece] = [
            f"{self.path}  {self.size_bytes / 1e6:.1f} MB",
            f"  robot        {data.get('robot', 'unknown')} {data.get('serial', '')}".rstrip(),
            f"  payload      {self.payload}",
            f"  experiment   {data.get('experiment', '') or '-'}",
            f"  recorded     {self.recorded}, {self.duration_s:.3f} s",
            f"  ended        {self.ended}{reason}",
            f"  motor torque {data.get('motor_torque_source', 'unknown')}",
            "",
            self.topics(),
            "",
            self.joints(),
        ]
        if self.phases:
            phases = [(item.name, f"{item.begin_s:.3f}", f"{item.duration_s:.3f}") for item in self.phases]
            lines += ["", Listing(("phase", "begins s", "lasts s"), phases)]
        if self.attachments:
            lines += [
                "",
                "  attached     " + ", ".join(f"{k} ({v} bytes)" for k, v in self.attachments.items()),
            ]
        return [*lines, "", *(f"  missing      {line}" for line in self.missing or ("nothing",))]

    @property
    def payload(self) -> str:
        """Name and mass of the payload."""
        return payload_text(self.metadata)

    @property
    def counted(self) -> bool:
        """Whether the source counts its samples: in an import the counter is the number of the row."""
        return self.metadata.get("experiment") != "import"

    def topics(self) -> Listing:
        """Samples, rate, lost samples by the source's counter and longest pause of each topic."""
        rows = [
            (
                item.topic,
                f"{item.samples}",
                f"{item.rate_hz:.1f}",
                f"{item.lost}" if self.counted else "-",
                f"{item.longest_pause_s * 1e3:.1f}",
            )
            for item in self.channels
        ]
        return Listing(("topic", "samples", "Hz", "lost", "longest pause ms"), rows)

    def joints(self) -> Listing:
        """Range of the position and rms of both torques of each joint."""
        nothing = ("-",) * len(self.joint_names)
        efforts = [
            [f"{value:.3f}" for value in rms] or nothing for rms in (self.effort_rms, self.motor_effort_rms)
        ]
        rows = [
            (name, f"{low:.4f}", f"{high:.4f}", sensor, motor)
            for name, (low, high), sensor, motor in zip(
                self.joint_names, self.position_range, *efforts, strict=True
            )
        ]
        return Listing(("joint", "from rad", "to rad", "sensor rms Nm", "motor rms Nm"), rows)

    def __str__(self) -> str:
        return text_of(self.pieces())


def summarise(session: Session) -> SessionSummary:
    """Summary of a session whose file is still there."""
    joint, motor = session.joint, session.motor
    channels = [
        _channel(item.topic, item.log_time, item.lost, item.held)
        for item in (joint, motor, session.command)
        if item is not None
    ]
    for topic, other in (
        ("/fri/status", session.status),
        ("/fri/controller_model", session.controller_model),
    ):
        if other is not None:
            channels.append(_channel(topic, other.log_time, 0, ()))
    stops = [*(phase.log_time for phase in session.phases[1:]), int(joint.log_time[-1])]
    return SessionSummary(
        path=session.path,
        size_bytes=session.path.stat().st_size,
        utc_first=utc_text(session.start),
        duration_s=session.duration_s,
        joint_names=session.joint_names,
        channels=tuple(channels),
        phases=tuple(
            PhaseSummary(phase.name, (phase.log_time - session.start) * 1e-9, (stop - phase.log_time) * 1e-9)
            for phase, stop in zip(session.phases, stops, strict=False)
        ),
        position_range=tuple(
            (float(low), float(high))
            for low, high in zip(joint.position.min(axis=0), joint.position.max(axis=0), strict=True)
        ),
        effort_rms=_rms(joint),
        motor_effort_rms=() if motor is None or motor.names != joint.names else _rms(motor),
        attachments={name: len(data) for name, data in session.attachments.items()},
        metadata=session.metadata,
        end=session.end,
        missing=session.missing.lines,
    )


def _rms(columns: JointColumns) -> tuple[float, ...]:
    if not columns.effort.shape[1]:
        return ()
    return tuple(np.sqrt(np.mean(columns.effort**2, axis=0)).tolist())


def _channel(topic: str, log_time: NDArray[np.int64], lost: int, held: tuple[str, ...]) -> ChannelSummary:
    rate, pause = pace(log_time)
    return ChannelSummary(topic, len(log_time), rate, lost, pause, held)
