"""From a recording and its mapping to a session log: conversion to SI at the joint, checks, writing."""

from __future__ import annotations

import datetime
import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fri.errors import ConfigurationError, DataError
from ident.dynamics.kinematics import Chain
from ident.dynamics.urdf import held, read_urdf
from ident.import_log.mapping import LogMapping, Signal, TimeBase
from ident.import_log.periods import EPS, Periods, find_periods, marked_periods
from ident.import_log.read_back import check_written
from ident.import_log.recording import Recording
from ident.import_log.tables import Floats
from ident.import_log.turns import unwrapped
from lwr_driver.configuration import find, yaml_text
from lwr_driver.session import JointColumns, SessionWriter, session_metadata
from lwr_driver.session.spool import spans, stored

if TYPE_CHECKING:
    from ident.rows.sample_count import SampleCount

_ONCE = ("position", "velocity", "joint_torque")
# Signals of one topic: their rows are written or left out together.
_TOPICS = (_ONCE, ("motor_torque", "motor_position"), ("command",))
MOST_MISSING = 0.5
"""Largest share of rows without one of their values; the rest is no recording of the motion."""
# Share of the motion that marks may leave out unasked: without it standard deviations grow by 5 %.
_LOST = 0.1
# Distance of stamps from their grid, as a share of its step, by the rounding of decimal numbers; least samples that
# show an even rate.
_OFF_GRID, _EVEN = 0.01, 100


@dataclass(frozen=True)
class ImportReport:
    """Result of an import; prints itself.

    rows : samples written of each topic. rows_in_source : samples of the recording.
    period_s, shortest_s, longest_s : median, least and greatest time between samples of `/joint_states` [s].
    unwrapped : angles that wrapped, and where.
    left_out : rows without one of their values, by topic; they count as lost samples.
    holes : intervals longer than 1.75 periods. lost, old : samples that never came, and those that an estimate leaves
        out as repeated or older than their stamps; the counts of `identify`.
    repeated : samples equal to the one before in every value; they are kept.
    periods : of the excitation, marked in the session; None for a motion without.
    notes : decisions on the way that the user should know.
    """

    path: Path
    robot: str
    uid: str
    joints: tuple[str, ...]
    rows: Mapping[str, int]
    rows_in_source: int
    duration_s: float
    period_s: float
    shortest_s: float
    longest_s: float
    holes: int
    lost: int
    old: int
    repeated: int
    unwrapped: tuple[str, ...]
    left_out: tuple[str, ...]
    periods: Periods | None
    notes: tuple[str, ...]
    conversions: tuple[str, ...]
    digests: Mapping[str, str]

    def __str__(self) -> str:
        written = ", ".join(f"{topic} {count}" for topic, count in self.rows.items())
        jitter = "regular" if self.longest_s - self.shortest_s < 1e-6 else "kept as recorded"
        lost = f"  lost      {self.lost} samples"
        lost += f"; {self.holes} intervals are longer than 1.75 periods" if self.holes else ""
        old = f"  old       {self.old} samples repeated or older than their stamps, left out of estimates"
        share = 100.0 * self.repeated / self.rows["/joint_states"]
        percent = f"{share:.0f}" if share >= 10.0 else f"{share:.2g}"
        again = [
            f"  repeated  {self.repeated} samples ({percent} %) equal to the one before, kept as they are"
        ]
        lines = [
            f"{self.robot}: {len(self.joints)} joints, {self.duration_s:.3f} s",
            f"  rows      {written} (recording: {self.rows_in_source})",
            f"  period    median {self.period_s * 1e3:.4g} ms, {self.shortest_s * 1e3:.4g} to "
            f"{self.longest_s * 1e3:.4g} ms, {jitter}",
            *((lost,) if self.holes or self.lost else ()),
            *(again if self.repeated else ()),
            *((old,) if self.old else ()),
            *(f"  left out  {missing}" for missing in self.left_out),
            *(f"  unwrapped {turned}" for turned in self.unwrapped),
            *((f"  periods   {self.periods}",) if self.periods is not None else ()),
            *(f"  note      {note}" for note in self.notes),
            *(f"  {line}" for line in self.conversions),
            *(f"  read      {name}  sha256 {digest[:16]}" for name, digest in self.digests.items()),
            f"  written   {self.path}  uid {self.uid}",
        ]
        return "\n".join(lines)


@dataclass(frozen=True)
class _Channel:
    times: NDArray[np.int64]
    published: NDArray[np.int64]
    values: Floats


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
    base, tip = base or mapping.base, tip or mapping.tip
    described, notes = _described(mapping, urdf, base, tip, beside)
    recording = Recording(source, mapping.delimiter, mapping.header, notes=notes)
    total, channels, turned, missing = _read(mapping, recording, rows)
    channels, polled = _once_each(channels)
    joint = channels["position"]
    digest = hashlib.sha256(
        repr((sorted(recording.digests.values()), rows, mapping.joints)).encode()
    ).hexdigest()
    attachments = {"mapping.yaml": yaml_text(mapping.content()).encode()}
    if described is not None:
        attachments["robot.urdf"] = described.encode()
    gears = () if mapping.transmission is None else mapping.transmission.coupling
    couplings = " ".join(f"{entry.joint}:{entry.motor}" for entry in gears)
    rests = " ".join(f"{name}={value!r}" for name, value in (mapping.held or {}).items())
    periods, origin = _periods(mapping, joint, recording.notes)
    encoder = "motor" if mapping.position.before_gear else ""
    more = {
        "encoder": encoder,
        "base": base or "",
        "tip": tip or "",
        "couplings": couplings,
        "held": rests,
        "periods": origin,
    }
    start = datetime.datetime.fromtimestamp(int(joint.times[0]) * 1e-9, datetime.UTC).isoformat()
    metadata = session_metadata(
        robot=mapping.robot,
        serial=mapping.serial if serial is None else serial,
        payload=mapping.payload if payload is None else payload,
        payload_mass=mapping.payload_mass if payload_mass is None else payload_mass,
        experiment="import",
        uid=digest[:32],
        motor_torque_source="none" if mapping.motor_torque is None else f"import of {source.name}",
        utc_start=start,
        imported_from=source.name,
        imported_rows="all" if rows is None else f"{rows[0]}:{rows[1]} of {total}",
        imported_sha256=" ".join(f"{name}={value}" for name, value in recording.digests.items()),
        source=mapping.source,
        **{name: value for name, value in more.items() if value},
    )
    with SessionWriter(
        Path(output),
        mapping.joints,
        metadata,
        robot_description=None,
        attachments=attachments,
    ) as writer:
        if periods is not None:
            _mark(writer, periods, joint.times)
        _write(writer, channels)
    check_written(Path(output), {key: (one.times, one.values) for key, one in channels.items()})
    written = {
        topic: len(channels[key].times)
        for topic, key in (
            ("/joint_states", "position"),
            ("/motor_states", "motor_torque"),
            ("/joint_command", "command"),
        )
        if key in channels
    }
    steps = np.diff(joint.times) * 1e-9
    count = _count(mapping, channels)
    return ImportReport(
        path=Path(output),
        robot=mapping.robot,
        uid=digest[:32],
        joints=mapping.joints,
        rows=written,
        rows_in_source=total,
        duration_s=float(joint.times[-1] - joint.times[0]) * 1e-9,
        period_s=float(np.median(steps)),
        shortest_s=float(steps.min()),
        longest_s=float(steps.max()),
        holes=int(np.count_nonzero(steps > 1.75 * np.median(steps))),
        lost=count.lost,
        old=count.old,
        repeated=_repeated(channels),
        unwrapped=tuple(turned),
        left_out=tuple(missing),
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


def _periods(mapping: LogMapping, joint: _Channel, notes: list[str]) -> tuple[Periods | None, str]:
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
    mapping: LogMapping, urdf: str | Path | None, base: str | None, tip: str | None, beside: Path | None
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
    Chain.from_urdf(read.text, root=base, tip=tip, joints=mapping.joints)
    way = read.chain(base, tip, mapping.joints)
    at_zero = [joint.name for joint in way if joint.movable and joint.name not in mapping.joints]
    if not at_zero:
        return plain.text, []
    return plain.text, [f"{', '.join(at_zero)} on the chain, without measurement, held at 0"]


def _read(
    mapping: LogMapping, recording: Recording, rows: tuple[int, int] | None
) -> tuple[int, dict[str, _Channel], list[str], list[str]]:
    """Rows of the recording, every channel converted to joint side and SI, and sentences about unwrapped angles and
    rows left out."""
    first = 0 if rows is None else rows[0]
    raws: dict[str, Floats] = {}
    seconds: dict[str, Floats] = {}
    clocks: dict[str, NDArray[np.int64]] = {}
    missing: list[str] = []
    total = 0
    for name, signal in mapping.signals.items():
        raw = recording.columns(signal, mapping.joints, name)
        place = f"{recording.path(_one(signal.file))}: `{name}`"
        base = signal.time if signal.time is not None else mapping.time
        clock = _clock(base, signal, recording, len(raw), place)
        total = len(raw) if name == "position" else total
        if name in _ONCE and len(raw) != total:
            raise DataError(
                f"{place} has {len(raw)} rows, the positions have {total}; the recording is not whole"
            )
        raws[name], seconds[name] = stored([_cut(raw, rows, place)]), _cut(clock, rows, place)
        del raw
    for topic in _TOPICS:
        names = [name for name in topic if name in raws]
        if not names:
            continue
        if len({len(raws[name]) for name in names}) > 1:
            sizes = ", ".join(f"`{name}` {len(raws[name])}" for name in names)
            raise DataError(f"{recording.source}: rows of one topic are of unequal number: {sizes}")
        timed = np.logical_and.reduce([np.isfinite(seconds[name]) for name in names])
        whole = np.logical_and.reduce([timed, *(np.isfinite(raws[name]).all(axis=1) for name in names)])
        if not whole.all():
            place = str(recording.path(_one(mapping.signals[names[0]].file)))
            parts = {f"`{name}`": raws[name] for name in names}
            parts |= {f"the time of `{name}`": seconds[name][:, None] for name in names}
            missing.append(_left_out(whole, parts, mapping.joints, place, first))
        for name in names:
            place = f"{recording.path(_one(mapping.signals[name].file))}: `{name}`"
            base, numbers = _base(mapping, name), first + np.flatnonzero(timed)
            times = _nanoseconds(base, seconds[name][timed], place, numbers, recording.notes)
            if not whole.all():
                times, raws[name] = times[whole[timed]], raws[name][whole]
            clocks[name] = times
    if len(raws["position"]) < 2:
        raise DataError(f"{recording.source}: {len(raws['position'])} samples are no motion; two at least")
    free = [clocks[name] for name in clocks if _origin_ns(mapping, _base(mapping, name)) is None]
    early = -min((int(clock[0]) for clock in free), default=0)
    if early > 0:
        recording.notes.append(
            f"the clock begins at {-early * 1e-9:.9g} s; all times moved by {early * 1e-9:.9g} s, to begin at 0"
        )
    channels: dict[str, _Channel] = {}
    turned: list[str] = []
    for name, signal in mapping.signals.items():
        origin = _origin_ns(mapping, _base(mapping, name))
        shift = max(early, 0) if origin is None else origin
        times = clocks[name] + shift
        if times[0] < 0:
            raise DataError(
                f"{recording.path(_one(signal.file))}: `{name}`: times begin at {clocks[name][0] * 1e-9:.9g} s, before "
                "1970; correct `start_utc`, or `zero: unix` of a clock that counts from a moment of its own"
            )
        # The source's own clock, counted from the first sample if it begins below zero.
        published = times - (0 if origin is None else origin)
        values, wraps = _convert(mapping, name, signal, raws.pop(name))
        for own, at in zip(mapping.joints, wraps, strict=True):
            if len(at):
                since = float(times[at[0]] - times[0]) * 1e-9
                steps = f"{len(at)} steps" if len(at) > 1 else "1 step"
                turned.append(
                    f"{name} of {own}: {steps} of 360 deg in one sample taken back, first at {since:.4g} s"
                )
        channels[name] = _Channel(times, published - min(0, int(published[0])), values)
    return total, channels, turned, missing


def _left_out(
    whole: NDArray[np.bool_], values: Mapping[str, Floats], joints: tuple[str, ...], place: str, first: int
) -> str:
    """What to say of the rows (n,) that are not whole. DataError if they are more than half.

    values : (n, joints) or (n, 1) by what they are. first : number of the first row.
    """
    counts = {name: np.count_nonzero(~np.isfinite(own), axis=0) for name, own in values.items()}
    listed = ", ".join(
        name if bad.all() else f"{name} of {', '.join(joints[k] for k in np.flatnonzero(bad))}"
        for name, bad in counts.items()
        if bad.any()
    )
    count, row = int((~whole).sum()), first + int(np.argmin(whole))
    share = f"{count} of {len(whole)} rows ({100.0 * count / len(whole):.3g} %)"
    if count > MOST_MISSING * len(whole):
        raise DataError(
            f"{place}: {share} are without one of their values, first row {row} ({listed}); at most "
            f"{100.0 * MOST_MISSING:g} % may be: take other columns in the mapping, or a part of the recording with "
            "`--rows` of `lwr-run import`"
        )
    return f"{share} without one of their values, first row {row} ({listed}); they count as lost samples"


def _base(mapping: LogMapping, name: str) -> TimeBase:
    own = mapping.signals[name].time
    return mapping.time if own is None else own


def _one(file: str | tuple[str, ...] | None) -> str | None:
    return file[0] if isinstance(file, tuple) else file


# Least number of measurements for an even repetition, and least mean number of rows of each.
_LEAST_POLLED, _LEAST_POLLS = 50, 1.2


def _repeated(channels: Mapping[str, _Channel]) -> int:
    """Samples equal to the one before in every value of `/joint_states`."""
    once = [channels[name].values for name in _ONCE if name in channels]
    alike = np.ones(len(once[0]) - 1, dtype=bool)
    for values in once:
        for some in spans(len(alike)):
            block = values[some.start : some.stop + 1]
            alike[some] &= (block[1:] == block[:-1]).all(axis=1)
    return int(np.count_nonzero(alike))


def _count(mapping: LogMapping, channels: Mapping[str, _Channel]) -> SampleCount:
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


def _once_each(channels: dict[str, _Channel]) -> tuple[dict[str, _Channel], list[str]]:
    """The channels without the rows of a recorder that evenly polls faster than the arm measures, and a note on it.

    Rows repeat in every value of all channels, each once or several times and no more than the next whole number: an
    arm at rest, or a recorder that falls behind, has longer runs, and keeps all rows.
    """
    joint = channels["position"]
    alike = np.ones(len(joint.times) - 1, dtype=bool)
    for one in channels.values():
        if not np.array_equal(one.times, joint.times):
            return channels, []
        alike &= (one.values[1:] == one.values[:-1]).all(axis=1)
    first = np.flatnonzero(np.append(True, ~alike))
    lengths = np.diff(first)
    if (
        len(lengths) < _LEAST_POLLED
        or lengths.mean() < _LEAST_POLLS
        or lengths.max() > np.ceil(lengths.mean())
    ):
        return channels, []
    rate = 1e9 / np.diff(joint.times).mean()
    note = (
        f"{len(joint.times) - len(first)} of {len(joint.times)} rows repeat the one before evenly: recorded at "
        f"{rate:.3g} Hz from an arm that measures at {rate / lengths.mean():.3g} Hz; one row of each is taken"
    )
    once = {
        name: replace(one, times=one.times[first], published=one.published[first], values=one.values[first])
        for name, one in channels.items()
    }
    return once, [note]


def _jumping(mapping: LogMapping, channels: Mapping[str, _Channel]) -> list[str]:
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


def _clock(base: TimeBase, signal: Signal, recording: Recording, count: int, place: str) -> Floats:
    """Times of the samples (n,) [s] by the source's clock."""
    if base.column is None:
        assert base.rate_hz is not None
        return np.arange(count) / base.rate_hz
    file = base.file if base.file is not None else _one(signal.file)
    times = recording.column(file, base.column) * base.seconds
    if len(times) != count:
        raise DataError(f"{place} has {count} rows, its time column {base.column!r} has {len(times)}")
    return times


def _nanoseconds(
    base: TimeBase, clock: Floats, place: str, numbers: NDArray[np.int64], notes: list[str]
) -> NDArray[np.int64]:
    """Times [ns] by the source's clock, strictly increasing. DataError with the numbers of the rows otherwise."""
    # Whole seconds and the rest apart: a double holds unix time to 0.2 us only once, not twice.
    whole = np.floor(clock)
    times = whole.astype(np.int64) * 10**9 + np.rint((clock - whole) * 1e9).astype(np.int64)
    steps = np.diff(times)
    if base.equal == "spread" and (steps == 0).any() and (steps > 0).any():
        what, count = place.rpartition(": `")[2].rstrip("`"), int((steps == 0).sum())
        said = f"{what:<15} {count} samples share the time of the one before and are spread evenly"
        even = _even(times)
        times, how = (_spread(times), "up to the next time") if even is None else even
        notes.append(f"{said} {how}")
        steps = np.diff(times)
    backwards = np.flatnonzero(steps <= 0)
    if len(backwards):
        row = int(backwards[0])
        advice = (
            "set `equal: spread` in `time` if the clock has coarse steps"
            if (steps >= 0).all()
            else "repair the clock of the recording"
        )
        raise DataError(
            f"{place}: time {clock[row + 1]:.9g} s in row {numbers[row + 1]} follows {clock[row]:.9g} s; "
            f"times must increase ({len(backwards)} such rows); {advice}, or import without it by `rate_hz`"
        )
    return times


def _even(times: NDArray[np.int64]) -> tuple[NDArray[np.int64], str] | None:
    """Even times of samples whose stamps are rounded, and what to say of them: the stamps lie on a grid, and the even
    times within a step of it. None for others, such as those with a hole."""
    steps = np.diff(times)
    grain = int(steps[steps > 0].min())
    number = np.arange(len(times))
    if len(times) < _EVEN or (steps < 0).any():
        return None
    if np.any(np.abs(steps - grain * np.rint(steps / grain)) > _OFF_GRID * grain):
        return None
    period, first = np.polyfit(number, (times - times[0]).astype(np.float64), 1)
    if np.ptp(times - times[0] - period * number) > (1.0 + _OFF_GRID) * grain:
        return None
    start = max(int(times[0]) + round(float(first)), min(int(times[0]), 0))
    how = f"{period * 1e-6:.3g} ms apart: the stamps are rounded to {grain * 1e-6:.4g} ms"
    return start + np.rint(period * number).astype(np.int64), how


def _spread(times: NDArray[np.int64]) -> NDArray[np.int64]:
    """Samples of one time, spread evenly up to the next; those of the last time by the median step."""
    stamps, start, count = np.unique(times, return_index=True, return_counts=True)
    if len(stamps) < 2 or (np.diff(times) < 0).any():
        return times
    length = np.append(np.diff(stamps), np.median(np.diff(stamps)).astype(np.int64))
    place = np.arange(len(times)) - np.repeat(start, count)
    return np.asarray(times + place * np.repeat(length, count) // np.repeat(count, count))


def _origin_ns(mapping: LogMapping, base: TimeBase) -> int | None:
    """UTC [ns] of the source's time 0; None if unknown."""
    if base.zero == "unix":
        return 0
    return None if mapping.start_utc is None else _utc_ns(mapping.start_utc)


def _utc_ns(text: str) -> int:
    try:
        moment = datetime.datetime.fromisoformat(text)
    except ValueError as error:
        raise ConfigurationError(
            f"`start_utc` {text!r} is no time such as 2016-04-07T13:01:04+00:00"
        ) from error
    if moment.tzinfo is None:
        moment = moment.replace(tzinfo=datetime.UTC)
    elapsed = moment - datetime.datetime(1970, 1, 1, tzinfo=datetime.UTC)
    return (elapsed.days * 86400 + elapsed.seconds) * 10**9 + elapsed.microseconds * 1000


def _cut(values: Floats, rows: tuple[int, int] | None, place: str) -> Floats:
    if rows is None:
        return values
    first, last = rows
    if not 0 <= first < last <= len(values):
        raise DataError(f"{place}: rows {first}:{last} asked for, the recording has 0:{len(values)}")
    return values[first:last]


def _convert(
    mapping: LogMapping, name: str, signal: Signal, raw: Floats
) -> tuple[Floats, list[NDArray[np.int64]]]:
    """Values (n, joints) at the joint by the formulas at the head of `ident.import_log.mapping`, and their wraps."""
    values = raw * signal.factors(len(mapping.joints), name)
    wraps = [np.zeros(0, dtype=np.int64)] * len(mapping.joints)
    if signal.quantity == "angle" and signal.unit != "m":
        values, wraps = unwrapped(values)
    if signal.before_gear:
        matrix = mapping.matrix
        values = values @ (matrix if signal.quantity == "torque" else np.linalg.inv(matrix).T)
    if signal.quantity == "angle" and np.any(mapping.offset):
        values = values + mapping.offset
    return stored([values]), wraps


def _write(writer: SessionWriter, channels: Mapping[str, _Channel]) -> None:
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

        def part(channel: _Channel, first: int = before, last: int = edge) -> slice:
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
