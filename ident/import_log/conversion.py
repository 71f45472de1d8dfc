"""From a recording and its mapping to a session log, checked and read back."""

from __future__ import annotations

import datetime
import hashlib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fri.errors import ConfigurationError, DataError
from ident.dynamics.kinematics import Chain
from ident.dynamics.urdf import held, read_urdf
from ident.import_log.channels import Channel, read_channels
from ident.import_log.mapping import LogMapping, TimeBase
from ident.import_log.periods import EPS, Periods, find_periods, marked_periods
from ident.import_log.read_back import check_written
from ident.import_log.recording import Recording
from ident.import_log.repeats import once_each, repeated
from ident.import_log.report import ImportReport
from ident.import_log.tables import Floats
from lwr_driver.configuration import find, yaml_text
from lwr_driver.session import JointColumns, SessionWriter, session_metadata

if TYPE_CHECKING:
    from ident.rows.sample_count import SampleCount

# Topics of a session, each with the signal that all its rows have.
_TOPICS = {"/joint_states": "position", "/motor_states": "motor_torque", "/joint_command": "command"}
# Share of the motion that marks may leave out unasked: without it standard deviations grow by 5 %.
_LOST = 0.1


def import_log(
    mapping: LogMapping,
    source: str | Path,
    output: str | Path,
    *,
    rows: tuple[int, int] | None = None,
    payload: str | None = None,
    payload_mass: float | None = None,
    serial: str | None = None,
    urdf: str | Path | None = None,
    base: str | None = None,
    tip: str | None = None,
    beside: Path | None = None,
) -> ImportReport:
    """Write the recording `source` (a file, a bag, or the folder of the mapping's files) as the session `output`.

    rows : first and one past the last row of every file to take (from 0); None takes all.
    payload, payload_mass [kg], serial, base, tip : instead of the mapping's.
    urdf : instead of the mapping's; a path, or the text itself.
    beside : folder of the mapping file, for its URDF.

    The session's uid follows from the content of the files and the rows taken, so a second import of the same
    recording is recognised. A row without one of its values is left out of its topic, like a lost sample.

    Raises DataError with file, column and row where more than half of the rows are without, for times that do not
    increase, files of unequal length or missing columns; ConfigurationError for an existing output, and for joints
    or links that the URDF does not have.
    """
    source = Path(source)
    if not source.exists():
        raise DataError(f"{source}: no such file or folder; give the recording of the mapping")
    taken = replace(
        mapping,
        payload=mapping.payload if payload is None else payload,
        payload_mass=mapping.payload_mass if payload_mass is None else payload_mass,
        serial=mapping.serial if serial is None else serial,
        base=base or mapping.base,
        tip=tip or mapping.tip,
    )
    described, notes = _described(taken, urdf, beside)
    recording = Recording(source, mapping.delimiter, mapping.header, notes=notes)
    read = read_channels(mapping, recording, rows)
    channels, polled = once_each(read.by_name)
    periods, origin = _periods(mapping, channels["position"], recording.notes)
    attachments = {"mapping.yaml": yaml_text(mapping.content()).encode()}
    if described is not None:
        attachments["robot.urdf"] = described.encode()
    cut = "all" if rows is None else f"{rows[0]}:{rows[1]} of {read.rows}"
    uid = hashlib.sha256(
        repr((sorted(recording.digests.values()), rows, mapping.joints)).encode()
    ).hexdigest()[:32]
    metadata = _metadata(taken, recording, channels["position"], uid=uid, rows=cut, periods=origin)
    with SessionWriter(
        Path(output), mapping.joints, metadata, robot_description=None, attachments=attachments
    ) as writer:
        if periods is not None:
            _mark(writer, periods, channels["position"].times)
        _write(writer, channels)
    check_written(Path(output), {key: (one.times, one.values) for key, one in channels.items()})
    steps = np.diff(channels["position"].times) * 1e-9
    count = _count(mapping, channels)
    return ImportReport(
        path=Path(output),
        robot=mapping.robot,
        uid=uid,
        joints=mapping.joints,
        rows={topic: len(channels[key].times) for topic, key in _TOPICS.items() if key in channels},
        rows_in_source=read.rows,
        duration_s=float(np.ptp(channels["position"].times)) * 1e-9,
        period_s=float(np.median(steps)),
        shortest_s=float(steps.min()),
        longest_s=float(steps.max()),
        holes=int(np.count_nonzero(steps > 1.75 * np.median(steps))),
        lost=count.lost,
        old=count.old,
        repeated=repeated(channels),
        unwrapped=tuple(read.unwrapped),
        left_out=tuple(read.left_out),
        periods=periods,
        notes=(
            *recording.notes,
            *polled,
            *_strange_rate(float(np.median(steps))),
            *_jumping(mapping, channels),
        ),
        conversions=_conversions(mapping),
        digests=recording.digests,
    )


def _metadata(
    mapping: LogMapping, recording: Recording, joint: Channel, *, uid: str, rows: str, periods: str
) -> dict[str, str]:
    """Metadata of the session; rows : those taken, and periods : their origin, in words."""
    source = recording.source
    gears = () if mapping.transmission is None else mapping.transmission.coupling
    more = {
        "encoder": "motor" if mapping.position.before_gear else "",
        "base": mapping.base or "",
        "tip": mapping.tip or "",
        "couplings": " ".join(f"{entry.joint}:{entry.motor}" for entry in gears),
        "held": " ".join(f"{name}={value!r}" for name, value in (mapping.held or {}).items()),
        "periods": periods,
    }
    return session_metadata(
        robot=mapping.robot,
        serial=mapping.serial,
        payload=mapping.payload,
        payload_mass=mapping.payload_mass,
        experiment="import",
        uid=uid,
        motor_torque_source="none" if mapping.motor_torque is None else f"import of {source.name}",
        utc_start=datetime.datetime.fromtimestamp(int(joint.times[0]) * 1e-9, datetime.UTC).isoformat(),
        imported_from=source.name,
        imported_rows=rows,
        imported_sha256=" ".join(f"{name}={value}" for name, value in recording.digests.items()),
        source=mapping.source,
        **{name: value for name, value in more.items() if value},
    )


def _periods(mapping: LogMapping, joint: Channel, notes: list[str]) -> tuple[Periods | None, str]:
    """Periods of the excitation, and their origin."""
    seconds = (joint.times - joint.times[0]) * 1e-9
    if mapping.periods is None:
        found, origin = find_periods(seconds, joint.values), "found in the positions"
    else:
        found, origin = marked_periods(mapping.periods, seconds, joint.values), "from the mapping"
    if found is None:
        return None, ""
    lost = f"{100.0 * found.outside:.2g} % of the motion"
    if mapping.periods is None and found.outside > _LOST:
        keys = f"{{period_s: {found.period_s:.6g}, start_s: {found.start_s:.6g}, count: {found.count}}}"
        notes.append(
            f"the motion repeats, {found}, and is not marked: {lost} lies outside and would have no part in estimates; "
            f"`periods: {keys}` marks it"
        )
        return None, ""
    notes.append(
        f"periods {origin}, equal within {100.0 * found.deviation:.2g} % of the motion; {lost} lies outside of them "
        "and has no part in estimates"
    )
    if found.deviation > EPS:
        notes.append(
            f"the motion does not repeat with {found.period_s:.6g} s: correct `periods`, or set `periods: {{count: 0}}`"
        )
    return found, origin


def _mark(writer: SessionWriter, periods: Periods, times: NDArray[np.int64]) -> None:
    """The phases of the periods, and of the rest after them."""
    first, length = int(times[0]) + round(periods.start_s * 1e9), round(periods.period_s * 1e9)
    for number in range(periods.count):
        writer.write_phase(first + number * length, f"period {number + 1}")
    stop = first + periods.count * length
    if stop <= times[-1]:
        writer.write_phase(stop, "hold")


def _described(
    mapping: LogMapping, urdf: str | Path | None, beside: Path | None
) -> tuple[str | None, list[str]]:
    """Text of the URDF, its joints checked against the mapping's, and notes."""
    if urdf is None and mapping.urdf is None:
        return None, ["no URDF: the joint names are not checked; give `urdf` in the mapping or --urdf"]
    source: str | Path = urdf if urdf is not None else find(str(mapping.urdf), beside=beside)
    read = read_urdf(source)
    rests = mapping.held or {}
    both = [name for name in rests if name in mapping.joints]
    if both:
        raise ConfigurationError(
            f"`held` and `joints` both name {both[0]!r}; a joint either rests or was measured"
        )
    plain, read = read, read_urdf(held(read.text, rests)) if rests else read
    Chain.from_urdf(read.text, root=mapping.base, tip=mapping.tip, joints=mapping.joints)
    way = read.chain(mapping.base, mapping.tip, mapping.joints)
    at_zero = [joint.name for joint in way if joint.movable and joint.name not in mapping.joints]
    if not at_zero:
        return plain.text, []
    return plain.text, [f"{', '.join(at_zero)} on the chain, without measurement, held at 0"]


def _count(mapping: LogMapping, channels: Mapping[str, Channel]) -> SampleCount:
    """Lost and old samples of `/joint_states`, as `identify` counts them."""
    from ident.rows.sample_count import sample_count  # on use: its import is slow

    joint, torque = channels["position"], channels.get("joint_torque")
    none = np.zeros((len(joint.times), 0))
    return sample_count(
        JointColumns(
            "/joint_states",
            mapping.joints,
            joint.times,
            joint.published,
            np.arange(len(joint.times)),
            joint.values,
            none,
            none if torque is None else torque.values,
        )
    )


def _jumping(mapping: LogMapping, channels: Mapping[str, Channel]) -> list[str]:
    """Notes on positions that jump and on single wrong samples, as `identify` will tell them."""
    from ident.rows.data_quality import jumps  # on use: their import is slow
    from ident.screening.channels import jump_doubts
    from ident.screening.spikes import position_spikes, torque_spikes

    joint, names = channels["position"], mapping.joints
    times = (joint.times - joint.times[0]) * 1e-9
    slides = mapping.position.unit == "m"
    lengths = [slides] * len(names)
    found = [
        *jump_doubts(jumps(times, joint.values), times, names, lengths),
        *position_spikes(times, joint.values, names, lengths),
    ]
    for key in (key for key in ("joint_torque", "motor_torque") if key in channels):
        one = channels[key]
        units = ["N" if slides else "Nm"] * len(names)
        found += torque_spikes(
            (one.times - one.times[0]) * 1e-9, one.values, names, units, key.replace("_", " ")
        )
    return [str(doubt) for doubt in found]


def _strange_rate(period: float) -> list[str]:
    """A note on a rate outside 10 Hz to 10 kHz, a factor of two beyond slow loggers and fast servo loops."""
    if 1e-4 <= period <= 0.1:
        return []
    likely = next(
        (unit for unit in ("ms", "us", "ns") if 1e-4 <= period * TimeBase(1, unit=unit).seconds <= 0.1), None
    )
    hint = f"; is the `unit` of `time` `{likely}`?" if likely else ""
    return [f"samples are {period:.4g} s apart (median), unusual for the log of an arm{hint}"]


def _write(writer: SessionWriter, channels: Mapping[str, Channel]) -> None:
    """Write all channels, a block of time after the other: messages need several times the memory of the samples."""
    joint, motor, command = (channels.get(name) for name in ("position", "motor_torque", "command"))
    position = channels.get("motor_position")
    if motor is not None and position is not None and not np.array_equal(position.times, motor.times):
        raise DataError(
            f"{writer.path}: `motor_position` and `motor_torque` have different times; one channel"
        )
    assert joint is not None
    longest = max((one for one in (joint, motor, command) if one is not None), key=lambda one: len(one.times))
    edges = [*longest.times[:: 2**15][1:].tolist(), np.iinfo(np.int64).max]
    before = -1
    for edge in edges:

        def part(channel: Channel, first: int = before, last: int = edge) -> slice:
            return slice(*np.searchsorted(channel.times, [first, last]).tolist())

        def values(name: str, some: slice) -> Floats | None:
            return channels[name].values[some] if name in channels else None

        some = part(joint)
        writer.write_joint_states(
            joint.times[some],
            joint.values[some],
            values("joint_torque", some),
            velocity=values("velocity", some),
            publish_time=joint.published[some],
        )
        if motor is not None:
            some = part(motor)
            writer.write_motor_states(
                motor.times[some],
                motor.values[some],
                values("motor_position", some),
                publish_time=motor.published[some],
            )
        if command is not None:
            some = part(command)
            writer.write_joint_command(
                command.times[some], command.values[some], publish_time=command.published[some]
            )
        if edge != edges[-1]:
            writer.advance(edge)
        before = edge


def _conversions(mapping: LogMapping) -> tuple[str, ...]:
    lines = []
    for name, signal in mapping.signals.items():
        steps: list[str] = [signal.unit]
        if signal.scale is not None:
            steps.append(f"x {signal.scale}")
        if signal.sign != 1:
            steps.append(f"sign {signal.sign}")
        if signal.torque_constant is not None:
            steps.append(f"x torque constant {signal.torque_constant} Nm/A")
        if signal.before_gear:
            steps.append("motor side, through the gear")
        if signal.quantity == "angle" and mapping.offset_rad is not None:
            steps.append("+ offset")
        lines.append(f"{name:<15} {', '.join(steps)}")
    return tuple(lines)
