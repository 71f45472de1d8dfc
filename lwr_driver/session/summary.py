"""What a session log holds, in a few lines."""

from __future__ import annotations

import datetime
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lwr_driver.session.columns import JointColumns
from lwr_driver.session.reader import read_session
from lwr_driver.session.session import Session

__all__ = ["ChannelSummary", "PhaseSummary", "SessionSummary", "describe"]


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
    """Everything `lwr-run info` says of a session; `str()` is the text, `as_dict()` the data.

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

    def as_dict(self) -> dict[str, Any]:
        """The same as plain data, for JSON."""
        return {**asdict(self), "path": str(self.path)}

    def __str__(self) -> str:
        data = self.metadata
        status = "unknown: the recorder died" if self.end is None else self.end.get("exit_status", "unknown")
        reason = f" ({self.end['reason']})" if self.end and self.end.get("reason") else ""
        mass = f", {data['payload_mass']} kg" if data.get("payload_mass") else ""
        lines = [
            f"{self.path}  {self.size_bytes / 1e6:.1f} MB",
            f"  robot        {data.get('robot', 'unknown')} {data.get('serial', '')}".rstrip(),
            f"  payload      {data.get('payload', 'unknown')}{mass}",
            f"  experiment   {data.get('experiment', '') or '-'}",
            f"  recorded     {self.utc_first}, {self.duration_s:.3f} s",
            f"  ended        {status}{reason}",
            f"  motor torque {data.get('motor_torque_source', 'unknown')}",
            "",
            f"  {'topic':<24}{'samples':>9}{'Hz':>9}{'lost':>7}{'longest pause':>16}",
        ]
        lines += [
            f"  {item.topic:<24}{item.samples:>9}{item.rate_hz:>9.1f}{item.lost:>7}"
            f"{item.longest_pause_s * 1e3:>13.1f} ms"
            for item in self.channels
        ]
        lines += ["", f"  {'joint':<12}{'from':>9}{'to':>9} rad{'sensor rms':>13}{'motor rms':>12} Nm"]
        for index, name in enumerate(self.joint_names):
            low, high = self.position_range[index]
            efforts = [
                f"{rms[index]:.3f}" if rms else "-" for rms in (self.effort_rms, self.motor_effort_rms)
            ]
            lines.append(f"  {name:<12}{low:>9.4f}{high:>9.4f}    {efforts[0]:>13}{efforts[1]:>12}")
        if self.phases:
            lines += ["", f"  {'phase':<24}{'begins':>9}{'lasts':>9} s"]
            lines += [f"  {item.name:<24}{item.begin_s:>9.3f}{item.duration_s:>9.3f}" for item in self.phases]
        if self.attachments:
            lines += [
                "",
                "  attached     " + ", ".join(f"{k} ({v} bytes)" for k, v in self.attachments.items()),
            ]
        lines += ["", *(f"  missing      {line}" for line in self.missing or ("nothing",))]
        return "\n".join(lines)


def describe(session: Session | str | Path) -> SessionSummary:
    """Summary of a session, or of the session in a file. DataError as `read_session`."""
    if not isinstance(session, Session):
        session = read_session(session)
    joint, motor = session.joint, session.motor
    channels = [_channel(item) for item in (joint, motor, session.command) if item is not None]
    for topic, other in (
        ("/fri/status", session.status),
        ("/fri/controller_model", session.controller_model),
    ):
        if other is not None:
            channels.append(_times(topic, other.log_time, 0, ()))
    stops = [*(phase.log_time for phase in session.phases[1:]), int(joint.log_time[-1])]
    first = datetime.datetime.fromtimestamp(session.start / 1e9, datetime.UTC)
    return SessionSummary(
        path=session.path,
        size_bytes=session.path.stat().st_size,
        utc_first=first.strftime("%Y-%m-%d %H:%M:%S.%f UTC"),
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


def _channel(columns: JointColumns) -> ChannelSummary:
    holds = tuple(name for name in ("position", "velocity", "effort") if getattr(columns, name).shape[1])
    return _times(columns.topic, columns.log_time, columns.lost, holds)


def _times(topic: str, log_time: np.ndarray[Any, Any], lost: int, holds: tuple[str, ...]) -> ChannelSummary:
    steps = np.diff(log_time) * 1e-9
    rate = float(1.0 / np.median(steps)) if len(steps) and np.median(steps) > 0 else 0.0
    return ChannelSummary(topic, len(log_time), rate, lost, float(steps.max()) if len(steps) else 0.0, holds)
