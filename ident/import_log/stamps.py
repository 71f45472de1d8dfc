"""Time stamps of the samples [ns], from the clock of a recording: a column of times or a fixed rate."""

from __future__ import annotations

import datetime

import numpy as np
from numpy.typing import NDArray

from fri.errors import ConfigurationError, DataError
from ident.import_log.mapping import LogMapping, TimeBase
from ident.import_log.tables import Floats

# Distance of stamps from their grid, as a share of its step, by the rounding of decimal numbers; least samples that
# show an even rate.
_OFF_GRID, _EVEN = 0.01, 100


def nanoseconds(
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
    """Even times of samples with rounded stamps, and words for the note.

    The stamps lie on a grid, and the even times within a step of it. None for other stamps, such as those with a hole.
    """
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


def origin_ns(mapping: LogMapping, base: TimeBase) -> int | None:
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
