"""The signals of a recording as channels in SI at the joint, without the rows that lack a value."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fri.errors import DataError
from ident.import_log.mapping import LogMapping, Signal, TimeBase
from ident.import_log.recording import Recording
from ident.import_log.stamps import nanoseconds, origin_ns
from ident.import_log.tables import Floats
from ident.import_log.turns import unwrapped
from lwr_driver.session.spool import stored

ONCE = ("position", "velocity", "joint_torque")
"""Signals of `/joint_states`, in rows of one time."""

MOST_MISSING = 0.5
"""Largest share of rows without one of their values; the rest is no recording of the motion."""

# Signals of one topic: their rows are written or left out together.
_TOPICS = (ONCE, ("motor_torque", "motor_position"), ("command",))


@dataclass(frozen=True)
class Channel:
    """One signal of all joints.

    times (m,) : UTC [ns], or from the beginning of a recording without a date. published (m,) : by the source's own
    clock [ns]. values (m, n) : in SI, at the joint.
    """

    times: NDArray[np.int64]
    published: NDArray[np.int64]
    values: Floats


@dataclass(frozen=True)
class Channels:
    """by_name : the channels. rows : of the recording. unwrapped, left_out : sentences about angles and rows."""

    by_name: dict[str, Channel]
    rows: int
    unwrapped: list[str]
    left_out: list[str]


def read_channels(mapping: LogMapping, recording: Recording, rows: tuple[int, int] | None) -> Channels:
    """All signals of the mapping; `rows` as of `import_log`. Raises DataError as `import_log` does.

    Decisions about times are added to the notes of the recording.
    """
    raws, seconds, total = _raw(mapping, recording, rows)
    clocks, missing = _stamped(mapping, recording, raws, seconds, 0 if rows is None else rows[0])
    if len(raws["position"]) < 2:
        raise DataError(f"{recording.source}: {len(raws['position'])} samples are no motion; two at least")
    early = _early(mapping, recording, clocks)
    channels: dict[str, Channel] = {}
    turned: list[str] = []
    for name, signal in mapping.signals.items():
        origin = origin_ns(mapping, _base(mapping, name))
        times = clocks[name] + (early if origin is None else origin)
        if times[0] < 0:
            raise DataError(
                f"{recording.path(_one(signal.file))}: `{name}`: times begin at {clocks[name][0] * 1e-9:.9g} s, before "
                "1970; correct `start_utc`, or `zero: unix` of a clock that counts from a moment of its own"
            )
        # The source's own clock, counted from the first sample if it begins below zero.
        published = times - (0 if origin is None else origin)
        values, wraps = _convert(mapping, name, signal, raws.pop(name))
        turned += _turned(name, mapping.joints, times, wraps)
        channels[name] = Channel(times, published - min(0, int(published[0])), values)
    return Channels(channels, total, turned, missing)


def _raw(
    mapping: LogMapping, recording: Recording, rows: tuple[int, int] | None
) -> tuple[dict[str, Floats], dict[str, Floats], int]:
    """Numbers (m, n) and clock (m,) [s] of each signal as they stand in the recording, and its number of rows."""
    raws: dict[str, Floats] = {}
    seconds: dict[str, Floats] = {}
    total = 0
    for name, signal in mapping.signals.items():
        raw = recording.columns(signal, mapping.joints, name)
        place = _place(recording, signal, name)
        clock = _clock(_base(mapping, name), signal, recording, len(raw), place)
        total = len(raw) if name == "position" else total
        if name in ONCE and len(raw) != total:
            raise DataError(
                f"{place} has {len(raw)} rows, the positions have {total}; the recording is not whole"
            )
        raws[name], seconds[name] = stored([_cut(raw, rows, place)]), _cut(clock, rows, place)
        del raw
    return raws, seconds, total


def _stamped(
    mapping: LogMapping,
    recording: Recording,
    raws: dict[str, Floats],
    seconds: Mapping[str, Floats],
    first: int,
) -> tuple[dict[str, NDArray[np.int64]], list[str]]:
    """Stamps [ns] of the rows with all values of their topic, and sentences about the others, taken out of `raws`."""
    clocks: dict[str, NDArray[np.int64]] = {}
    missing: list[str] = []
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
            file = str(recording.path(_one(mapping.signals[names[0]].file)))
            parts = {f"`{name}`": raws[name] for name in names}
            parts |= {f"the time of `{name}`": seconds[name][:, None] for name in names}
            missing.append(_left_out(whole, parts, mapping.joints, file, first))
        for name in names:
            place = _place(recording, mapping.signals[name], name)
            base, numbers = _base(mapping, name), first + np.flatnonzero(timed)
            times = nanoseconds(base, seconds[name][timed], place, numbers, recording.notes)
            if not whole.all():
                times, raws[name] = times[whole[timed]], raws[name][whole]
            clocks[name] = times
    return clocks, missing


def _early(mapping: LogMapping, recording: Recording, clocks: Mapping[str, NDArray[np.int64]]) -> int:
    """By how much [ns] clocks without a date begin below zero, and are moved."""
    free = [clocks[name] for name in clocks if origin_ns(mapping, _base(mapping, name)) is None]
    early = -min((int(clock[0]) for clock in free), default=0)
    if early > 0:
        recording.notes.append(
            f"the clock begins at {-early * 1e-9:.9g} s; all times moved by {early * 1e-9:.9g} s, to begin at 0"
        )
    return max(early, 0)


def _turned(
    name: str, joints: tuple[str, ...], times: NDArray[np.int64], wraps: list[NDArray[np.int64]]
) -> list[str]:
    """Sentences about the steps of a turn that were taken back."""
    found = []
    for joint, at in zip(joints, wraps, strict=True):
        if len(at):
            since = float(times[at[0]] - times[0]) * 1e-9
            steps = f"{len(at)} steps" if len(at) > 1 else "1 step"
            found.append(
                f"{name} of {joint}: {steps} of 360 deg in one sample taken back, first at {since:.4g} s"
            )
    return found


def _left_out(
    whole: NDArray[np.bool_], values: Mapping[str, Floats], joints: tuple[str, ...], place: str, first: int
) -> str:
    """The sentence about rows (n,) without a value. DataError if they are more than half.

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


def _cut(values: Floats, rows: tuple[int, int] | None, place: str) -> Floats:
    if rows is None:
        return values
    first, last = rows
    if not 0 <= first < last <= len(values):
        raise DataError(f"{place}: rows {first}:{last} asked for, the recording has 0:{len(values)}")
    return values[first:last]


def _place(recording: Recording, signal: Signal, name: str) -> str:
    return f"{recording.path(_one(signal.file))}: `{name}`"


def _base(mapping: LogMapping, name: str) -> TimeBase:
    own = mapping.signals[name].time
    return mapping.time if own is None else own


def _one(file: str | tuple[str, ...] | None) -> str | None:
    return file[0] if isinstance(file, tuple) else file
