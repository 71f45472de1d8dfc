"""Periods of the excitation in a recording without marks, from the measured positions.

A motion repeats with the period T from t0 to t1 if, in every joint that moves,

    e(t) = q(t + T) - q(t),   mean e^2 <= 2 sigma^2 + (eps s)^2,   t0 <= t <= t1 - T,   t1 - t0 >= 2 T,

with the noise sigma of the positions and their standard deviation s in a period. The lags to try are those after which
a block of the motion comes again, by the correlation of block and motion. Averages over periods take the motion as
repeated, so a deviation eps counts there as an error of the torque of about eps.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft, next_fast_len, rfft
from scipy.ndimage import uniform_filter1d
from scipy.special import comb

from fri.errors import DataError
from ident.import_log.mapping import PeriodMarks
from ident.import_log.tables import Floats
from ident.rows.binned import bins
from ident.rows.filters import median_step

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline

# Deviation of the motion from period to period over the motion; identified torques err by one to two per cent.
EPS = 5e-3
# Positions this noisy, over the motion, cannot tell a repeat from a similar motion.
_LOUDEST = 0.05
# Order of the differences for the noise: a motion of 3 Hz at 50 Hz has 1e-4 of its size left in them.
_ORDER = 5
_MEAN_S, _GRID_S, _MOST_GRID = 0.01, 0.02, 60_000
_SHORTEST_S = 0.5
# Blocks in a recording, repeats of each to try, and steps to the period.
_BLOCKS, _REPEATS, _STEPS = 16, 4, 3
# Length over which a local deviation is judged, its size over that of the whole, and that of a single sample.
_LOCAL, _EXCESS, _PEAK = 0.05, 2.0, 4.0
# A joint moves if it travels more than its noise, and in a period as much as in the whole, by these factors.
_TRAVEL, _SHARE = 20.0, 0.5


@dataclass(frozen=True)
class Periods:
    """Consecutive equal periods: beginning after the first sample [s], length [s], number.

    deviation : rms of q(t + T) - q(t) over that of the motion, of the worst joint. outside : share of the motion before
    and after them, by the squared speeds.
    """

    start_s: float
    period_s: float
    count: int
    deviation: float = 0.0
    outside: float = 0.0

    def __str__(self) -> str:
        return f"{self.count} of {self.period_s:.6g} s, from {self.start_s:.6g} s on"

    @property
    def stop_s(self) -> float:
        """End of the last one [s]."""
        return self.start_s + self.count * self.period_s


def find_periods(time: Floats, position: Floats) -> Periods | None:
    """The shortest period of a motion that repeats, at least two of them; None for another motion.

    time : (N,) [s], increasing. position : (N, n) [rad].
    """
    motion = _Motion.of(time, position)
    if motion is None:
        return None
    # A multiple of the period repeats as well, so the first one is taken.
    return next((found for lag in motion.lags() if (found := motion.periods(lag)) is not None), None)


def marked_periods(marks: PeriodMarks, time: Floats, position: Floats) -> Periods | None:
    """The periods of a mapping; None for a `count` of 0.

    time : (N,) [s], increasing. position : (N, n) [rad]. Raises DataError for periods beyond the recording.
    """
    if marks.count == 0:
        return None
    # The last sample of a period is a step before the next one begins.
    step = median_step(time)
    length = float(time[-1] - time[0]) + step - marks.start_s
    period = marks.period_s if marks.period_s is not None else length / (marks.count or 1)
    fit = int((length + 0.5 * step) / period) if period > 0.0 else 0
    count = fit if marks.count is None else marks.count
    if not 1 <= count <= fit:
        raise DataError(
            f"`periods`: {max(count, 1)} of {period:.6g} s from {marks.start_s:g} s on end at "
            f"{marks.start_s + max(count, 1) * period:.6g} s, the recording at {marks.start_s + length:.6g} s; correct "
            "`period_s`, `start_s` or `count`"
        )
    found = Periods(marks.start_s, period, count)
    motion = _Motion.of(time, position)
    if motion is None or period < motion.grid_s:
        return found
    first, last = (int(np.searchsorted(motion.time, at)) for at in (found.start_s, found.stop_s))
    change = motion.difference(period, slice(first, last))[0] if count > 1 else 0.0
    return replace(found, deviation=change, outside=motion.outside(found))


@dataclass(frozen=True, eq=False)
class _Motion:
    """Joints in motion on an even grid.

    time : (N,) [s] from the first sample; q : (N, m) [rad], means over 10 ms; noise : (m,) their standard deviation
    [rad]; step_s : their median step.
    """

    time: Floats
    q: Floats
    noise: Floats
    step_s: float
    curve: CubicSpline

    @classmethod
    def of(cls, time: Floats, position: Floats) -> _Motion | None:
        """None for positions too short, at rest, or too noisy."""
        if not time[-1] > time[0]:
            return None
        width = max(1, int(_MEAN_S * (len(time) - 1) / (time[-1] - time[0])))
        if len(time) < 4 * _ORDER * width:
            return None
        seconds, position = bins((time - time[0])[:, None], width)[:, 0], bins(position, width)
        noise = _noise(position)
        moving = np.ptp(position, axis=0) > _TRAVEL * np.maximum(noise, 1e-9)
        q, noise = position[:, moving], noise[moving]
        if not q.shape[1] or np.any(noise > _LOUDEST * q.std(axis=0)):
            return None
        step = median_step(seconds)
        grid_s = max(_GRID_S, step, seconds[-1] / _MOST_GRID)
        grid = np.arange(seconds[0], seconds[-1] + 1e-9, grid_s)
        from scipy.interpolate import CubicSpline  # on use: its import is slow

        curve = CubicSpline(seconds, q)
        return cls(grid, curve(grid), noise, step, curve)

    @property
    def grid_s(self) -> float:
        """Distance of the samples [s]."""
        return float(self.time[1] - self.time[0])

    def lags(self) -> Iterator[int]:
        """Lags in samples after which a block of the motion comes again, those of the best repeats of each block.

        Blocks, since the autocorrelation of the whole has its peaks aside where an approach and a return are in it.
        """
        count, least = len(self.time), max(2, round(_SHORTEST_S / self.grid_s))
        width = count // _BLOCKS
        if width < least:
            return
        x = (self.q - self.q.mean(axis=0)) / self.q.std(axis=0)
        size = next_fast_len(2 * count, real=True)
        spectrum, total = rfft(x, size, axis=0), np.append(0.0, np.cumsum((x**2).sum(axis=1)))
        square = total[width:] - total[:-width]
        found: set[int] = set()
        for first in range(0, count // 2, max(1, width // 2)):
            block = rfft(x[first : first + width], size, axis=0)
            cross = irfft(spectrum * block.conj(), size, axis=0)[: len(square)].sum(axis=1)
            apart = (square + square[first] - 2.0 * cross)[first + least :]
            padded = np.pad(apart, 1, constant_values=np.inf)
            low = np.flatnonzero((apart <= padded[:-2]) & (apart < padded[2:]))
            found.update(int(k) + least for k in low[np.argsort(apart[low])][:_REPEATS])
        yield from sorted(lag for lag in found if lag <= count // 2 + 1)

    def periods(self, lag: int) -> Periods | None:
        """The periods of about `lag` samples; None if the motion does not repeat so."""
        difference = self.q[lag:] - self.q[:-lag]
        inside = uniform_filter1d(difference**2, lag, axis=0, mode="nearest")
        middle = int(np.argmin((inside / self.q.var(axis=0)).max(axis=1)))
        begin = max(0, middle - lag // 2)
        period = self._refined(lag * self.grid_s, slice(begin, begin + lag))
        if abs(period - lag * self.grid_s) > self.grid_s:
            return None
        _, excess = self.difference(period, slice(0, None))
        width = max(1, round(_LOCAL * period / self.grid_s))
        fits = uniform_filter1d(excess, width, axis=0, mode="nearest").max(axis=1) <= _EXCESS**2
        first, stop = _run(fits, min(middle, len(fits) - 1))
        # The mean over `width` samples ends half of it before the motion does.
        first, stop = _widened(excess.max(axis=1) <= _PEAK**2, first, stop, width // 2)
        # The last sample of a period is a step before the next one begins.
        length = (stop - first - 1) * self.grid_s + max(self.step_s, self.grid_s)
        count = 1 + int((length + 0.5 * self.grid_s) / period)
        if count < 2:
            return None
        # In the middle of what repeats; a rest before or after the motion repeats as well.
        spare = max(0.0, length - self.grid_s - (count - 1) * period)
        latest = float(self.time[-1]) + self.step_s - count * period
        start = max(0.0, min(float(self.time[first]) + 0.5 * spare, latest))
        first = int(np.searchsorted(self.time, start))
        inner = slice(first, min(len(self.time), first + round(count * period / self.grid_s)))
        share, excess = self.difference(period, inner)
        one = self.q[inner][:lag]
        moves = one.std(axis=0) >= _SHARE * self.q.std(axis=0)
        if not moves.all() or np.any(excess.mean(axis=0) > 1.0):
            return None
        found = Periods(start, period, count, share)
        return replace(found, outside=self.outside(found))

    def difference(self, period_s: float, inside: slice) -> tuple[float, Floats]:
        """q(t + T) - q(t): rms without the noise over that of the motion, of the worst joint; squares over the largest
        mean square of a repeat, (k, m).
        """
        time, q = self.time[inside], self.q[inside]
        stop = min(time[-1] + self.grid_s, self.time[-1] + 0.5 * self.step_s)
        early = time <= stop - period_s
        if not early.any():
            return 1.0, np.full((1, q.shape[1]), np.inf)
        later = self.curve(np.minimum(time[early] + period_s, self.time[-1]))
        square, size = (later - q[early]) ** 2, np.maximum(q.var(axis=0), 1e-18)
        rest = np.maximum(square.mean(axis=0) - 2.0 * self.noise**2, 0.0) / size
        return float(np.sqrt(rest.max())), square / (2.0 * self.noise**2 + EPS**2 * size)

    def _refined(self, period_s: float, inside: slice) -> float:
        """The period near one of the grid, by Gauss-Newton steps on q(t + T) - q(t).

        The rate by central differences has no part in the noise of q(t), so the noise does not draw T aside.
        """
        time, q = self.time[inside], self.q[inside]
        rate, weight = np.gradient(q, self.grid_s, axis=0), 1.0 / self.q.var(axis=0)
        for _ in range(_STEPS):
            early = time <= self.time[-1] - period_s
            change = self.curve(time[early] + period_s) - q[early]
            power = float(np.sum(weight * rate[early] ** 2))
            period_s -= float(np.sum(weight * rate[early] * change)) / max(power, 1e-12)
        return period_s

    def outside(self, periods: Periods) -> float:
        """Share of the motion, by the squared speeds, outside of the periods."""
        power = np.mean((np.gradient(self.q, self.grid_s, axis=0) / self.q.std(axis=0)) ** 2, axis=1)
        inside = (self.time >= periods.start_s) & (self.time < periods.stop_s)
        return float(1.0 - power[inside].sum() / max(power.sum(), 1e-12))


def _noise(position: Floats) -> Floats:
    """Standard deviation (n,) of white noise in positions (N, n), from differences of high order."""
    gain = np.sqrt(comb(2 * _ORDER, _ORDER))
    middle = np.median(np.abs(np.diff(position, n=_ORDER, axis=0)), axis=0)
    return np.asarray(middle / (0.6745 * gain))


def _run(fits: NDArray[np.bool_], at: int) -> tuple[int, int]:
    """First and one past the last of the True values around `at`; an empty range where it is False."""
    if not fits[at]:
        return at, at
    breaks = np.flatnonzero(~fits)
    before, after = breaks[breaks < at], breaks[breaks > at]
    return (int(before[-1]) + 1 if len(before) else 0), (int(after[0]) if len(after) else len(fits))


def _widened(fits: NDArray[np.bool_], first: int, stop: int, most: int) -> tuple[int, int]:
    """A range that is not empty, longer by up to `most` True values at each end."""
    if stop > first:
        wrong = np.flatnonzero(~fits[max(0, first - most) : first])
        first = max(0, first - most) + (int(wrong[-1]) + 1 if len(wrong) else 0)
        wrong = np.flatnonzero(~fits[stop : stop + most])
        stop += int(wrong[0]) if len(wrong) else min(most, len(fits) - stop)
    return first, stop
