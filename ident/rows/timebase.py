"""Times of the channels: lost samples, equidistant grids, stretches, bridging and outliers."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d

from fri.errors import DataError
from ident.dynamics.parameters import Floats
from lwr_driver.session.spool import column, spans

BoolArray = NDArray[np.bool_]

_JITTER = 0.02
_TOO_MANY = 0.01
_GRAINS = 5.0
# Samples with one common noise level of a channel.
_BLOCK = 50
# Knots of a spline beside a part of it.
_KNOTS = 40


@dataclass(frozen=True)
class Stretch:
    """Equidistant samples without a long gap, read part by part.

    start : time of the first sample [s]. dt : sample time [s]. count : number n of samples. bridged : (n,)
    interpolated ones. resampled : whether all values are interpolated because of irregular times.
    columns : (N, k) arrays of the recording, side by side. known : (m,) their rows of this stretch. places : (m,)
    number of the sample of each known row, or its time [samples] where all are interpolated.
    """

    start: float
    dt: float
    count: int
    bridged: BoolArray
    resampled: bool
    columns: tuple[Floats, ...]
    known: NDArray[np.int64]
    places: NDArray[Any]

    @property
    def times(self) -> Floats:
        """Sample times (n,) [s]."""
        return self.start + self.dt * np.arange(self.count, dtype=np.float64)

    @property
    def end(self) -> float:
        """Time of the last sample [s]."""
        return self.start + self.dt * (self.count - 1)

    @property
    def values(self) -> Floats:
        """All samples (n, k)."""
        return self.part(0, self.count)

    def part(self, low: int, high: int) -> Floats:
        """Samples (high - low, k) from `low` on. A spline forgets a knot by a factor of 4 from one to the next."""
        first = max(int(np.searchsorted(self.places, low)) - _KNOTS, 0)
        last = min(int(np.searchsorted(self.places, high)) + _KNOTS, len(self.places))
        rows, places = self.known[first:last], self.places[first:last]
        joined = len(rows) and rows[-1] - rows[0] + 1 == len(rows)
        some: Any = slice(int(rows[0]), int(rows[-1]) + 1) if joined else rows
        values = np.hstack([column[some] for column in self.columns])
        wanted = np.arange(low, high)
        if self.resampled:
            return _spline(places, values)(wanted.astype(np.float64))
        inside = (places >= low) & (places < high)
        if inside.sum() == high - low:
            return values[inside]
        found = np.empty((high - low, values.shape[1]))
        found[places[inside] - low] = values[inside]
        gaps = np.flatnonzero(self.bridged[low:high])
        for run in np.split(gaps, np.flatnonzero(np.diff(gaps) > _KNOTS) + 1):
            near = np.searchsorted(places, [low + run[0], low + run[-1]]) + np.array([-_KNOTS, _KNOTS])
            some = slice(max(int(near[0]), 0), int(near[1]))
            found[run] = _spline(places[some].astype(np.float64), values[some])(
                wanted[run].astype(np.float64)
            )
        return found


def _spline(places: Floats, values: Floats) -> Any:
    from scipy.interpolate import CubicSpline  # on use: its import is slow

    return CubicSpline(places, values)


def sample_period(times: Floats, counts: NDArray[np.int64] | None, where: str) -> float:
    """Sample time [s]: median interval per step of the sample's number (n,)."""
    if len(times) < 16:
        raise DataError(f"{where}: {len(times)} samples are too few; record at least a few seconds of motion")
    step = np.diff(times)
    if np.any(step <= 0):
        at = times[int(np.argmax(step <= 0))]
        raise DataError(
            f"{where}: time does not increase after t = {at:.6f} s; repair the clock of the source"
        )
    if counts is not None and len(counts) == len(times) and np.all(np.diff(counts) > 0):
        return float(np.median(step / np.diff(counts)))
    return float(np.median(step))


def missing_samples(times: Floats, dt: float) -> int:
    """Number of samples missing between others at times (n,), in intervals longer than 1.75 sample times dt [s]."""
    intervals = np.diff(times)
    return int(np.sum(np.maximum(np.rint(intervals[intervals > 1.75 * dt] / dt) - 1, 0)))


def stretches(
    times: Floats,
    columns: Floats | tuple[Floats, ...],
    bad: BoolArray,
    dt: float,
    longest_bridge_s: float,
    behind: Iterable[int] = (),
) -> tuple[list[Stretch], int]:
    """Equidistant stretches of (n, k) columns at (n,) times, and the number of samples lost.

    Samples flagged `bad` (n,) and lost ones are bridged by a cubic spline through their neighbours and
    flagged; a hole longer than `longest_bridge_s` ends the stretch, and so does a jump of a position. behind : numbers
    of the samples behind jumps.
    """
    good = np.flatnonzero(~bad)
    if len(good) < 16:
        return [], 0
    lost = missing_samples(times, dt)
    hole = np.diff(times[good]) > longest_bridge_s + 1.75 * dt
    for sample in behind:
        # The good samples before and behind it are no neighbours.
        after = int(np.searchsorted(good, sample))
        hole[after - 1 : after] = True
    parts = np.split(good, np.flatnonzero(hole) + 1)
    sides = columns if isinstance(columns, tuple) else (columns,)
    return [_uniform(times[part], sides, part, dt) for part in parts if len(part) >= 16], lost


def _uniform(times: Floats, columns: tuple[Floats, ...], known: NDArray[np.int64], dt: float) -> Stretch:
    start = float(times[0])
    steps = np.rint((times - start) / dt).astype(np.int64)
    step = float((times[-1] - start) / steps[-1]) if len(steps) > 1 and steps[-1] else dt
    error = float(np.max(np.abs(times - start - steps * step)))
    if np.all(np.diff(steps) > 0) and error < max(_JITTER * dt, 2e-9):
        bridged = np.ones(int(steps[-1]) + 1, dtype=bool)
        bridged[steps] = False
        return Stretch(start, step, len(bridged), bridged, False, columns, known, steps)
    count = int(np.floor((times[-1] - start) / dt)) + 1
    grid = start + dt * np.arange(count)
    after = np.searchsorted(times, grid)
    nearest, before = (np.abs(grid - times[np.clip(k, 0, len(times) - 1)]) for k in (after, after - 1))
    bridged = np.minimum(nearest, before) > 1.0 * dt
    return Stretch(start, dt, count, bridged, True, columns, known, (times - start) / dt)


def flag_outliers(values: Floats, scale: float) -> tuple[BoolArray, list[int]]:
    """Flags (n, k) of samples far from the median of five, and the columns with too many for outliers.

    Far is more than `scale` robust standard deviations and more than 1 % of the range. The standard deviation is
    that of the distance from the cubic through the four neighbours, which follows any slope: the larger of the
    values for the whole column and for the samples around, because a working drive is noisier than one at rest.
    The median keeps steps, so the reversal of Coulomb friction is no outlier. Nothing is flagged in a column with
    over 1 % of far samples: they are a property of the signal.
    """
    flags = np.zeros(values.shape, dtype=bool)
    crowded = []
    for joint in range(values.shape[1]):
        # One array of a long column at a time, and two beside it.
        series = column(values, joint)
        low, high = np.percentile(series, [0.5, 99.5])
        # A joint at standstill jumps by a few encoder steps.
        grain = min(_GRAINS * _least_step(series), 0.5 * float(np.ptp(series)))
        distance, cubic = _displaced(series)
        del series
        around = np.maximum(_medians_around(cubic), float(np.median(cubic, overwrite_input=True)))
        del cubic
        far = _beyond(distance, scale * 1.4826 * around, max(0.01 * float(high - low), grain))
        if far.mean() > _TOO_MANY:
            crowded.append(joint)
        else:
            flags[:, joint] = far
    return flags, crowded


def _medians_around(values: Floats) -> Floats:
    """The largest of the medians of each block (m,) of `_BLOCK` values (n,) and of the neighbouring blocks."""
    whole = len(values) // _BLOCK * _BLOCK
    table = values[:whole].reshape(-1, _BLOCK)
    medians = [_medians(table[some]) for some in spans(len(table))]
    last = np.array([np.median(values[-_BLOCK:])])
    return np.asarray(maximum_filter1d(np.concatenate([*medians, last]), 3, mode="nearest"))


@njit(cache=True, nogil=True)
def _medians(table):  # type: ignore[no-untyped-def]
    """Medians (m,) of the rows of (m, k)."""
    rows, count = table.shape
    found = np.empty(rows)
    for row in range(rows):
        ordered = np.sort(table[row])
        found[row] = 0.5 * (ordered[(count - 1) // 2] + ordered[count // 2])
    return found


@njit(cache=True, nogil=True)
def _least_step(series):  # type: ignore[no-untyped-def]
    """Smallest step of (n,) values but zero; 0 without any."""
    least = np.inf
    for k in range(1, len(series)):
        step = abs(series[k] - series[k - 1])
        if 0.0 < step < least:
            least = step
    return least if least < np.inf else 0.0


@njit(cache=True, nogil=True)
def _beyond(distance, around, least):  # type: ignore[no-untyped-def]
    """Samples (n,) farther than the limit of their block and than `least`."""
    found = np.empty(len(distance), dtype=np.bool_)
    for k in range(len(distance)):
        found[k] = distance[k] > max(around[k // _BLOCK], least)
    return found


@njit(cache=True, nogil=True)
def _displaced(series):  # type: ignore[no-untyped-def]
    """Distance (n,) of samples from the median of five around them, and from the cubic through the four neighbours."""
    last = len(series) - 1
    distance, cubic = np.empty(last + 1), np.empty(last + 1)
    for k in range(last + 1):
        a, b = series[max(k - 2, 0)], series[max(k - 1, 0)]
        c, d, e = series[k], series[min(k + 1, last)], series[min(k + 2, last)]
        low = max(min(a, b), min(c, d))
        high = min(max(a, b), max(c, d))
        middle = max(min(low, high), min(max(low, high), e))
        distance[k] = abs(c - middle)
        cubic[k] = abs(c - (4.0 * (b + d) - a - e) / 6.0)
    return distance, cubic
