"""Import of motor torques from a trace file of the controller, on its own clock, into a session log.

The file is CSV with one header line; lines before it that begin with `#` are comments::

    # free text
    time_s,tau_m_A1,tau_m_A2,...,q_A1,q_A2,...
    812.437500,1.25,-33.5,...,0.100000000,0.250000000,...

`time_s` is the controller's clock [s], strictly increasing, with an unknown offset and perhaps a small error
of its rate. `tau_m_JOINT` is the motor torque referred to the joint side, gear ratio included [Nm]. `q_JOINT`
is the measured joint position, as in FRI [rad]. The columns may stand in any order; each joint of the session
has both.

The clock follows from a comparison of the positions with `/joint_states` (`lwr_driver.session.alignment`).
The samples go into `/motor_states` unchanged, without resampling, each with its log time and, as its publish
time, the time of the trace.
"""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fri.errors import DataError
from lwr_driver.configuration import as_path
from lwr_driver.session.alignment import Alignment, Track, align
from lwr_driver.session.container import Container, Messages, record_layout
from lwr_driver.session.messages import JOINT_STATE, joint_state_layout
from lwr_driver.session.motor_torque import TorqueMatch, match_torques
from lwr_driver.session.reader import read_session
from lwr_driver.session.recovery import copy_messages, replacing
from lwr_driver.session.scan import Scan
from lwr_driver.session.session import JointColumns, stamp

TIME, TORQUE, POSITION = "time_s", "tau_m_", "q_"


@dataclass(frozen=True)
class Trace:
    """A trace file: time (n,) [s], torque (n, J) [Nm], position (n, J) [rad], columns as in `joints`."""

    path: Path
    joints: tuple[str, ...]
    time: NDArray[np.float64]
    torque: NDArray[np.float64]
    position: NDArray[np.float64]
    sha256: str


@dataclass(frozen=True)
class TraceImport:
    """Result of an import.

    samples : motor torques in the session now; outside : samples of the trace before or after the session
    jitter_s : median absolute deviation of the log times from the controller's clock
    torques : comparison of motor torques and joint torque sensors; empty if the session has no sensors
    """

    out: Path
    trace: Path
    joints: tuple[str, ...]
    alignment: Alignment
    samples: int
    outside: int
    jitter_s: float
    torques: tuple[TorqueMatch, ...]

    def __str__(self) -> str:
        correlation = self.alignment.correlation
        still = [name for name, value in zip(self.joints, correlation, strict=True) if not np.isfinite(value)]
        lines = [
            f"{self.trace} aligned: {self.alignment}",
            f"{self.samples} motor torques written to {self.out}, {self.outside} outside of it left out",
        ]
        if still:
            lines.append(f"joints that stand still, whose order cannot be verified: {', '.join(still)}")
        lines += [str(match) for match in self.torques if match.suspect]
        return "\n".join(lines)


def read_trace(path: str | Path, joint_names: Sequence[str]) -> Trace:
    """The trace file `path`, its columns in the order of `joint_names`.

    DataError for an unreadable file, missing or unknown columns, values not finite, and time not rising.
    """
    path = as_path(path, "trace file")
    try:
        content = path.read_bytes()
        lines = content.decode("utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: cannot be read: {error}") from error
    first = next((row for row, line in enumerate(lines) if line.strip() and not line.startswith("#")), None)
    if first is None:
        raise DataError(
            f"{path}: is empty; a trace begins with the line {TIME},{TORQUE}JOINT,...,{POSITION}JOINT,..."
        )
    header = [word.strip() for word in lines[first].split(",")]
    order = _columns(path, header, joint_names)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            values = np.loadtxt(lines[first + 1 :], delimiter=",", comments="#", ndmin=2)
    except (ValueError, UserWarning) as error:
        raise DataError(f"{path}: the numbers after line {first + 1} cannot be read: {error}") from error
    if values.shape[1] != len(header):
        raise DataError(f"{path}: {values.shape[1]} columns of numbers under {len(header)} names")
    bad = np.argwhere(~np.isfinite(values))
    if len(bad):
        row, column = bad[0].tolist()
        raise DataError(
            f"{path}: `{header[column]}` of sample {row} is {values[row, column]}; it must be finite"
        )
    time = values[:, order[0]]
    back = np.flatnonzero(np.diff(time) <= 0.0)
    if len(back):
        row = int(back[0]) + 1
        raise DataError(
            f"{path}: time runs from {time[row - 1]:.6f} s to {time[row]:.6f} s at sample {row}; it must rise"
        )
    joints = len(joint_names)
    return Trace(
        path=path,
        joints=tuple(joint_names),
        time=time,
        torque=values[:, order[1 : 1 + joints]],
        position=values[:, order[1 + joints :]],
        sha256=hashlib.sha256(content).hexdigest(),
    )


def import_trace(
    session_path: str | Path,
    trace_path: str | Path,
    out: str | Path | None = None,
    *,
    tolerance_s: float | None = None,
) -> TraceImport:
    """Align a trace with a session and write the session anew with `/motor_states` in it.

    out : the new file; default is to replace the session itself, in one step
    tolerance_s : see `lwr_driver.session.alignment.align`

    DataError if the session has motor torques already or no proper end, the trace is invalid, the alignment
    is uncertain, or the torque columns follow the torques of other joints.
    """
    session_path = as_path(session_path, "session log")
    out = session_path if out is None else as_path(out, "session log")
    session = read_session(session_path)
    if session.motor is not None:
        raise DataError(
            f"{session_path}: has /motor_states already ({session.metadata.get('motor_torque_source', '')})"
        )
    if session.end is None or not session.missing.closed:
        raise DataError(f"{session_path}: did not end properly; make it whole with `lwr-run recover` first")
    trace = read_trace(trace_path, session.joint_names)
    joint = session.joint
    clock = joint.publish_time if np.ptp(joint.publish_time) > 0 else joint.log_time
    alignment = align(
        Track(f"session {session_path.name}", joint.names, (clock - clock[0]) * 1e-9, joint.position),
        Track(f"trace {trace.path.name}", trace.joints, trace.time, trace.position),
        tolerance_s=tolerance_s,
    )
    slope, start, jitter = _clock((clock - clock[0]) * 1e-9, joint.log_time)
    log_time = start + np.rint(alignment.at(trace.time) * slope * 1e9).astype(np.int64)
    inside = (log_time >= joint.log_time[0]) & (log_time <= joint.log_time[-1])
    zero = min(0.0, float(trace.time[0]))
    motor = _motor_columns(trace, joint.names, log_time, inside, zero, str(out))
    torques = match_torques(joint, motor) if joint.effort.shape[1] else ()
    wrong = [str(match) for match in torques if match.swapped]
    if wrong:
        raise DataError(
            f"{trace.path}: torque columns in another order: {'; '.join(wrong)}; correct the header"
        )
    metadata = {
        **session.metadata,
        "motor_torque_source": "trace_file",
        "trace_file": trace.path.name,
        "trace_sha256": trace.sha256,
        "trace_delay_s": f"{alignment.delay_s:.9f}",
        "trace_delay_std_s": f"{alignment.delay_std_s:.3e}",
        "trace_rate_error": f"{alignment.rate_error:.6e}",
        "trace_middle_s": f"{alignment.middle_s:.6f}",
        "trace_residual_rad": f"{alignment.residual_rad:.3e}",
        "trace_clock_zero_s": f"{zero:.6f}",
        "trace_log_time_jitter_s": f"{jitter:.3e}",
    }
    _write(session_path, out, metadata, motor)
    return TraceImport(
        out, trace.path, joint.names, alignment, len(motor), int((~inside).sum()), jitter, torques
    )


def _motor_columns(
    trace: Trace,
    names: tuple[str, ...],
    log_time: NDArray[np.int64],
    inside: NDArray[np.bool_],
    zero: float,
    source: str,
) -> JointColumns:
    """The torques of a trace `inside` the session, at their log times (n,) [ns]; zero : of their publish time [s]."""
    motor = JointColumns(
        topic="/motor_states",
        names=names,
        log_time=log_time[inside],
        publish_time=np.rint((trace.time[inside] - zero) * 1e9).astype(np.int64),
        sequence=np.flatnonzero(inside),
        position=np.empty((int(inside.sum()), 0)),
        velocity=np.empty((int(inside.sum()), 0)),
        effort=trace.torque[inside],
        source=source,
    )
    if (np.diff(motor.log_time) <= 0).any():
        raise DataError(f"{trace.path}: samples closer than a nanosecond at {stamp(motor.log_time)}")
    return motor


def _columns(path: Path, header: list[str], joint_names: Sequence[str]) -> list[int]:
    wanted = [TIME, *(TORQUE + name for name in joint_names), *(POSITION + name for name in joint_names)]
    if len(set(header)) != len(header):
        twice = sorted({name for name in header if header.count(name) > 1})
        raise DataError(f"{path}: column `{twice[0]}` is there twice")
    for name in wanted:
        if name not in header:
            raise DataError(f"{path}: column `{name}` is missing; found {', '.join(header)}")
    for name in header:
        if name not in wanted:
            raise DataError(f"{path}: column `{name}` is unknown; wanted {', '.join(wanted)}")
    return [header.index(name) for name in wanted]


def _clock(source: NDArray[np.float64], log_time: NDArray[np.int64]) -> tuple[float, int, float]:
    """Line log_time = start + slope source through most samples, robust against packets read late.

    Returns slope, start [ns], and the median absolute deviation [s].
    """
    host = (log_time - log_time[0]) * 1e-9
    kept = np.ones(len(host), dtype=bool)
    slope, start, spread = 1.0, 0.0, 0.0
    for _ in range(6):
        slope, start = np.polyfit(source[kept], host[kept], 1)
        residual = host - start - slope * source
        centre = float(np.median(residual[kept]))
        spread = float(np.median(np.abs(residual[kept] - centre)))
        now = np.abs(residual - centre) <= max(4.0 * spread, 1e-9)
        if now.sum() < 0.5 * len(host) or (now == kept).all():
            break
        kept = now
    return float(slope), int(log_time[0]) + round(float(start) * 1e9), spread


def _write(session_path: Path, out: Path, metadata: dict[str, str], motor: JointColumns) -> None:
    scan = Scan(session_path)
    with replacing(out) as partial:
        container = Container(partial, library=f"lwr-identification trace import into {session_path.name}")
        try:
            copy_messages(scan, container, metadata=metadata, added=_messages(container, motor))
            container.finish()
        finally:
            container.abandon()
        written = read_session(partial)
        if written.motor is None or not np.array_equal(written.motor.effort, motor.effort):
            raise DataError(f"{out}: the motor torques read back differ from those written")


def _messages(container: Container, motor: JointColumns) -> Messages:
    number = container.channel(motor.topic, JOINT_STATE)
    layout = joint_state_layout(motor.names, position=False, velocity=False, effort=True)
    columns = {
        "channel_sequence": motor.sequence,
        "log_time": motor.log_time,
        "publish_time": motor.publish_time,
        "sec": motor.log_time // 10**9,
        "nanosec": motor.log_time % 10**9,
        "effort": motor.effort,
    }
    records = [row.tobytes() for row in record_layout(layout, number).pack(columns, len(motor))]
    return Messages(records, np.full(len(records), number, dtype=np.int64), motor.log_time)
