"""Alignment of the clocks of two recordings by the joint positions in both.

Two recordings show the same motion, each on a clock of its own. The offset is searched as the lag of best
agreement of the positions (concordance by FFT, without each joint's mean), over every lag with enough
overlap. Each lag close to the best is then refined below the sampling period by Gauss-Newton on

    p_fine(t + delay + rate (t - t_mid)) - p_coarse(t) - bias_j  ->  min,

with delay and rate common to all joints, and the best must win clearly. The standard deviations come from a
jackknife over blocks of time, valid for residuals correlated in time (elastic deflection, friction). A
constant delay between the two position measurements themselves is not identifiable.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d
from scipy.optimize import linear_sum_assignment

from fri.errors import DataError

_STILL_RAD = 1e-3
_COARSE_S = 0.01
_LEAST_OVERLAP = 0.5
_LEAST_ENERGY = 0.25
_AGREEMENT = 0.98
_CANDIDATE = 0.9
_CANDIDATES = 6
_CLEAR = 2.0
_LARGEST_RATE = 1e-3
_BLOCKS = 20
_MOST_POINTS = 60_000
_SMOOTH_S = 0.05


@dataclass(frozen=True)
class Track:
    """Joint positions on a clock: time (n,) [s] strictly increasing, position (n, J) [rad].

    name : for messages
    """

    name: str
    joints: tuple[str, ...]
    time: NDArray[np.float64]
    position: NDArray[np.float64]

    @property
    def period(self) -> float:
        """Median time between samples [s]."""
        return float(np.median(np.diff(self.time)))


@dataclass(frozen=True)
class Alignment:
    """Clock of `other` in terms of the clock of `reference`: t_reference = at(t_other).

    delay_s : t_reference - t_other in the middle of the overlap; delay_std_s : its standard deviation, the
        larger of those in the middle and at the ends of the overlap
    rate_error, rate_error_std : gain of the reference on the other clock [s/s]
    middle_s : that middle on the clock of `other`; overlap_s : duration of the overlap
    residual_rad : root mean square of the remaining difference of positions
    runner_up_rad : the same at the second-best lag, infinite if there is none
    correlation : per joint; nan for a joint at rest, with unverified order
    """

    delay_s: float
    delay_std_s: float
    rate_error: float
    rate_error_std: float
    middle_s: float
    overlap_s: float
    residual_rad: float
    runner_up_rad: float = float("inf")
    correlation: tuple[float, ...] = ()

    def at(self, time: NDArray[np.float64]) -> NDArray[np.float64]:
        """Times of the clock of `other` on the clock of the reference [s]."""
        return np.asarray(time + self.delay_s + self.rate_error * (time - self.middle_s))

    def __str__(self) -> str:
        return (
            f"delay {self.delay_s:.6f} s ± {self.delay_std_s * 1e6:.1f} µs, clock rate error "
            f"{self.rate_error * 1e6:.2f} ± {self.rate_error_std * 1e6:.2f} ppm over {self.overlap_s:.1f} s; "
            f"positions differ by {self.residual_rad:.2e} rad rms, "
            f"by {self.runner_up_rad:.2e} rad at the next-best delay"
        )


def align(reference: Track, other: Track, *, tolerance_s: float | None = None) -> Alignment:
    """Align the clock of `other` with that of `reference`; both have the same joints in the same order.

    tolerance_s : largest accepted standard deviation of the delay; default is half a period of `other`

    DataError if the arm stands still, the order or sign of joints differs, the motions differ, two delays fit
    nearly as well (a periodic motion), or the standard deviation of the delay exceeds the tolerance.
    """
    tolerance = 0.5 * other.period if tolerance_s is None else tolerance_s
    _check_motion(reference)
    _check_motion(other)
    step = max(_COARSE_S, reference.period, other.period)
    a, b = _resampled(reference, step), _resampled(other, step)
    lags, scores = _concordance(a, b)
    # lag k means: row i of `other` goes with row i + k of the reference
    base = float(reference.time[0] - other.time[0])
    best = int(np.argmax(scores))
    _check_joints(reference, other, a, b, int(lags[best]), float(scores[best]))
    fits = []
    for peak in _peaks(scores):
        try:
            fits.append(_refined(reference, other, base + lags[peak] * step, step))
        except np.linalg.LinAlgError:
            continue
    if not fits:
        raise DataError(
            f"{other.name}: no delay against {reference.name} can be refined; record a livelier motion"
        )
    fits.sort(key=lambda fit: fit.residual_rad)
    first = fits[0]
    others = [fit for fit in fits[1:] if abs(fit.delay_s - first.delay_s) > 2.0 * step]
    runner_up = others[0].residual_rad if others else float("inf")
    if runner_up < _CLEAR * first.residual_rad:
        raise DataError(
            f"{other.name}: the delay against {reference.name} is ambiguous: {first.delay_s:.4f} s leaves "
            f"{first.residual_rad:.2e} rad rms and {others[0].delay_s:.4f} s leaves {runner_up:.2e} rad, less than "
            f"{_CLEAR:g} times as much; a periodic motion must be recorded with its approach or its end"
        )
    if first.delay_std_s > tolerance:
        raise DataError(
            f"{other.name}: the delay against {reference.name} is known to "
            f"{first.delay_std_s * 1e3:.3f} ms only, "
            f"{tolerance * 1e3:.3f} ms are needed; record a longer or faster motion"
        )
    if abs(first.rate_error) > _LARGEST_RATE:
        raise DataError(
            f"{other.name}: its clock would run {first.rate_error * 1e6:.0f} ppm off that of {reference.name}, "
            f"{_LARGEST_RATE * 1e6:.0f} ppm is the limit; check the time column and its unit"
        )
    return dataclasses.replace(
        first, runner_up_rad=runner_up, correlation=_correlations(a, b, int(lags[best]))
    )


def _check_motion(track: Track) -> None:
    if len(track.time) < 10:
        raise DataError(f"{track.name}: {len(track.time)} samples are too few to align")
    spread = float(track.position.std(axis=0).max())
    if spread < _STILL_RAD:
        raise DataError(
            f"{track.name}: the arm stands still (positions vary by {spread:.1e} rad rms, "
            f"{_STILL_RAD:g} rad are needed); no delay can be found, record a motion"
        )


def _resampled(track: Track, step: float) -> NDArray[np.float64]:
    times = np.arange(track.time[0], track.time[-1], step)
    return np.stack([np.interp(times, track.time, column) for column in track.position.T], axis=1)


def _window_sums(
    a: NDArray[np.float64], first: NDArray[np.int64], stop: NDArray[np.int64]
) -> NDArray[np.float64]:
    total = np.concatenate([np.zeros((1, a.shape[1])), np.cumsum(a, axis=0)])
    return np.asarray(total[stop] - total[first])


def _lagged(
    a: NDArray[np.float64], b: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], int]:
    """All lags with enough overlap, and the overlapping rows [first, stop) of `a`; FFT size."""
    rows, other = len(a), len(b)
    lags = np.arange(-(other - 1), rows)
    first, stop = np.maximum(lags, 0), np.minimum(rows, other + lags)
    enough = stop - first >= max(10, _LEAST_OVERLAP * min(rows, other))
    return lags[enough], first[enough], stop[enough], 1 << (rows + other).bit_length()


def _concordance(
    a: NDArray[np.float64], b: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Lags and 2 cov(a, b) / (var a + var b), summed over the joints before dividing; 1 is full agreement."""
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    lags, first, stop, size = _lagged(a, b)
    product = np.fft.rfft(a, size, axis=0) * np.conj(np.fft.rfft(b, size, axis=0))
    cross = np.fft.irfft(product.sum(axis=1), size)[lags]
    count = (stop - first)[:, None]
    sum_a, sum_b = _window_sums(a, first, stop), _window_sums(b, first - lags, stop - lags)
    energy_a = (_window_sums(a**2, first, stop) - sum_a**2 / count).sum(axis=1)
    energy_b = (_window_sums(b**2, first - lags, stop - lags) - sum_b**2 / count).sum(axis=1)
    cross = cross - (sum_a * sum_b / count).sum(axis=1)
    share = min(float((a**2).sum()), float((b**2).sum()))
    moving = np.minimum(energy_a, energy_b) >= _LEAST_ENERGY * share
    scores = np.where(moving, 2.0 * cross / np.maximum(energy_a + energy_b, 1e-300), -1.0)
    return lags, scores


def _peaks(scores: NDArray[np.float64]) -> list[int]:
    """The best local maxima, the highest first."""
    padded = np.concatenate([[-2.0], scores, [-2.0]])
    local = np.flatnonzero((padded[1:-1] >= padded[:-2]) & (padded[1:-1] > padded[2:]))
    local = local[scores[local] >= _CANDIDATE]
    return [int(peak) for peak in local[np.argsort(-scores[local], kind="stable")][:_CANDIDATES]]


def _overlap(
    a: NDArray[np.float64], b: NDArray[np.float64], lag: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    first, stop = max(lag, 0), min(len(a), len(b) + lag)
    return a[first:stop], b[first - lag : stop - lag]


def _pairs(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Correlation of every column of `b` (rows) with every column of `a`; 0 where one stands still."""
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    norm = np.linalg.norm(b, axis=0)[:, None] * np.linalg.norm(a, axis=0)[None, :]
    still = (b.std(axis=0) < _STILL_RAD)[:, None] | (a.std(axis=0) < _STILL_RAD)[None, :]
    return np.where(still, 0.0, (b.T @ a) / np.maximum(norm, 1e-300))


def _correlations(a: NDArray[np.float64], b: NDArray[np.float64], lag: int) -> tuple[float, ...]:
    diagonal = np.diagonal(_pairs(*_overlap(a, b, lag)))
    return tuple(float(value) if value != 0.0 else float("nan") for value in diagonal)


def _check_joints(
    reference: Track, other: Track, a: NDArray[np.float64], b: NDArray[np.float64], lag: int, score: float
) -> None:
    """Raise if a joint does not follow itself at the best lag, naming the joint it follows."""
    own = np.array(_correlations(a, b, lag))
    moving = np.isfinite(own)
    if score >= _AGREEMENT and moving.any() and (own[moving] >= _CANDIDATE).all():
        return
    found = _best_order(a, b)
    if found is not None:
        order, values = found
        wrong = [
            f"{other.joints[row]} of it follows {'-' if values[row] < 0 else ''}{reference.joints[column]} "
            f"(correlation {values[row]:.3f})"
            for row, column in enumerate(order)
            if values[row] != 0.0 and (row != column or values[row] < 0)
        ]
        if wrong:
            raise DataError(
                f"{other.name}: joints in another order or with another sign than in {reference.name}: "
                f"{'; '.join(wrong)}; correct the header or the sign"
            )
    raise DataError(
        f"{other.name} does not show the motion of {reference.name}: agreement of positions is {score:.3f} "
        f"at best, {_AGREEMENT} is needed; check that both belong to the same motion and are in radians"
    )


def _best_order(
    a: NDArray[np.float64], b: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.float64]] | None:
    """The assignment of columns of `b` to those of `a`, at any lag, with agreement of all moving joints."""
    a0, b0 = a - a.mean(axis=0), b - b.mean(axis=0)
    lags, first, stop, size = _lagged(a0, b0)
    fa, fb = np.fft.rfft(a0, size, axis=0), np.fft.rfft(b0, size, axis=0)
    best = np.zeros(len(lags))
    norm_a = np.sqrt(np.maximum(_window_sums(a0**2, first, stop), 1e-12))
    norm_b = np.sqrt(np.maximum(_window_sums(b0**2, first - lags, stop - lags), 1e-12))
    for row in range(b.shape[1]):
        cross = np.fft.irfft(fa * np.conj(fb[:, row : row + 1]), size, axis=0)[lags]
        best += np.abs(cross / (norm_a * norm_b[:, row : row + 1])).max(axis=1)
    pairs = _pairs(*_overlap(a, b, int(lags[int(np.argmax(best))])))
    rows, columns = linear_sum_assignment(-np.abs(pairs))
    values = pairs[rows, columns]
    moving = values != 0.0
    if not moving.any() or (np.abs(values[moving]) < _AGREEMENT).any():
        return None
    return columns.astype(np.int64), values


def _refined(reference: Track, other: Track, delay: float, step: float) -> Alignment:
    """Gauss-Newton from a coarse delay; the finer sampled track is interpolated at the other's times."""
    forward = reference.period <= other.period
    fine, coarse = (reference, other) if forward else (other, reference)
    sign = 1.0 if forward else -1.0
    shift, rate = sign * delay, 0.0
    begin = max(coarse.time[0], fine.time[0] - shift)
    end = min(coarse.time[-1], fine.time[-1] - shift)
    rows = np.flatnonzero((coarse.time >= begin) & (coarse.time <= end))
    rows = rows[:: max(1, -(-len(rows) // _MOST_POINTS))]
    middle = 0.5 * (begin + end)
    time, target = coarse.time[rows], coarse.position[rows]
    # Slopes of noisy samples would be noise; slopes of a smoothed copy serve as instruments.
    width = max(1, round(_SMOOTH_S / fine.period))
    smooth = dataclasses.replace(
        fine, position=uniform_filter1d(fine.position, width, axis=0, mode="nearest")
    )
    for _ in range(30):
        wanted = time + shift + rate * (time - middle)
        inside = (wanted >= fine.time[1]) & (wanted <= fine.time[-2])
        value, _ = _interpolated(fine, wanted[inside])
        _, slope = _interpolated(smooth, wanted[inside])
        normal, right, residual = _normal_equations(value - target[inside], slope, time[inside] - middle)
        update = np.linalg.solve(normal.sum(axis=0), right.sum(axis=0))
        shift, rate = shift - float(update[0]), rate - float(update[1])
        if abs(shift - sign * delay) > 20.0 * step + 2.0 * _LARGEST_RATE * (end - begin):
            raise np.linalg.LinAlgError("the fit leaves its peak")
        if abs(update[0]) < 1e-9 and abs(update[1]) * (end - begin) < 1e-9:
            break
    spread = _jackknife(normal, right)
    half = 0.5 * (end - begin)
    at_end = float(np.sqrt(spread[0, 0] + half**2 * spread[1, 1] + 2.0 * half * abs(spread[0, 1])))
    return Alignment(
        delay_s=sign * shift,
        delay_std_s=max(at_end, float(np.sqrt(spread[0, 0]))),
        rate_error=rate if forward else 1.0 / (1.0 + rate) - 1.0,
        rate_error_std=float(np.sqrt(spread[1, 1])),
        middle_s=middle if forward else middle + shift,
        overlap_s=float(end - begin),
        residual_rad=residual,
    )


def _interpolated(track: Track, time: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Values and slopes of the cubic between two samples with central differences as end slopes."""
    at = np.clip(np.searchsorted(track.time, time, side="right") - 1, 1, len(track.time) - 3)
    t, p = track.time, track.position
    width = (t[at + 1] - t[at])[:, None]
    x = (time - t[at])[:, None] / width
    left = (p[at + 1] - p[at - 1]) / (t[at + 1] - t[at - 1])[:, None] * width
    right = (p[at + 2] - p[at]) / (t[at + 2] - t[at])[:, None] * width
    rise = p[at + 1] - p[at]
    c2, c3 = 3.0 * rise - 2.0 * left - right, left + right - 2.0 * rise
    value = p[at] + x * (left + x * (c2 + x * c3))
    return value, (left + x * (2.0 * c2 + 3.0 * x * c3)) / width


def _normal_equations(
    error: NDArray[np.float64], slope: NDArray[np.float64], time: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Normal equations of (delay, rate) for each block of time, without each joint's bias; residual rms."""
    rows = len(time)
    if rows < 2 * _BLOCKS:
        raise np.linalg.LinAlgError("too few samples")
    error = error - error.mean(axis=0)
    basis = np.stack([slope, slope * time[:, None]], axis=-1)
    basis -= basis.mean(axis=0)
    bounds = np.linspace(0, rows, _BLOCKS + 1).astype(int)
    normal, right = np.empty((_BLOCKS, 2, 2)), np.empty((_BLOCKS, 2))
    for block in range(_BLOCKS):
        part = slice(bounds[block], bounds[block + 1])
        flat = basis[part].reshape(-1, 2)
        normal[block], right[block] = flat.T @ flat, flat.T @ error[part].ravel()
    return normal, right, float(np.sqrt(np.mean(error**2)))


def _jackknife(normal: NDArray[np.float64], right: NDArray[np.float64]) -> NDArray[np.float64]:
    """Covariance of (delay, rate) from leaving out one block of time at a time."""
    left_out = np.linalg.solve(normal.sum(axis=0) - normal, (right.sum(axis=0) - right)[..., None])[..., 0]
    deviation = left_out - left_out.mean(axis=0)
    return np.asarray((_BLOCKS - 1) / _BLOCKS * deviation.T @ deviation)
