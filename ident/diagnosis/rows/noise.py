"""The noise of rows, from differences between periods."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft, next_fast_len, rfft

from ident.diagnosis.rows.recording import SessionRecord
from ident.diagnosis.rows.side_rows import SideRows
from ident.estimators.covariance import correlation_time
from ident.rows.filters import median_step

Floats = NDArray[np.float64]


def noise_floor(
    rows: SideRows, residual: Floats, periods: Mapping[int, tuple[float, float]]
) -> tuple[Floats, Floats, bool]:
    """Noise (n,) of a row [Nm], its variance inflation (n,) by correlation, and whether periods gave both.

    Where the excitation repeats, the difference of two periods of the residual is noise alone. Otherwise the residual
    itself stands for it, counted with its effective number of rows: a misfit lasting for seconds is then one
    observation, not a thousand, and a claim must explain most of it.
    periods : start and length [s] of each session's period.
    """
    n = residual.shape[1]
    pairs: list[Floats] = []
    for session, (start, length) in periods.items():
        mine = np.flatnonzero(rows.session == session)
        phase = (rows.time[mine] - start) / length
        first, second = mine[(phase >= 0) & (phase < 1)], mine[(phase >= 1) & (phase < 2)]
        if len(first) < 50 or len(second) < 0.6 * len(first):
            continue
        at = rows.time[second] - length
        step = median_step(rows.time[first])
        # Rows need not be evenly spaced: a slow tick seldom fits the cycle.
        after = np.clip(np.searchsorted(rows.time[first], at), 1, len(first) - 1)
        earlier = at - rows.time[first[after - 1]] < rows.time[first[after]] - at
        nearest = after - earlier
        close = np.abs(rows.time[first[nearest]] - at) < 0.6 * step
        pairs.append((residual[second[close]] - residual[first[nearest[close]]]) / np.sqrt(2.0))
    if not pairs:
        return *misfit(rows, residual), False
    sigma, inflation = np.ones(n), np.ones(n)
    differences = np.concatenate(pairs)
    dt = max(median_step(rows.time), 1e-6)
    for j in range(n):
        d = differences[:, j]
        d = d[np.isfinite(d)]
        if len(d) < 20:
            continue
        d = _without_slow(d, max(4, round(1.0 / dt)))
        sigma[j] = max(_robust_rms(d), 1e-9)
        width = max(2, round(0.2 / dt))
        count = len(d) // width
        if count >= 4:
            means = d[: count * width].reshape(count, width).mean(axis=1)
            ratio = float(np.clip(width * np.mean(means**2) / np.mean(d**2), 1.0, width))
            inflation[j] = 1.0 if ratio < 1.0 + 3.0 * np.sqrt(2.0 / count) else ratio
    return sigma, inflation, True


def repeatability(recordings: Sequence[SessionRecord], rows: SideRows, residual: Floats) -> Floats:
    """Noise (n,) of a row [Nm] from sessions with the same motion, NaN without any. Every difference from run to run
    counts, drifts as well."""
    squares, counts = np.zeros((2, residual.shape[1]))
    for one, other in combinations(recordings, 2):
        if not _same_motion(one, other):
            continue
        first, second = (np.flatnonzero(rows.session == r.number) for r in (one, other))
        at, there = rows.time[first] - one.start_s, rows.time[second] - other.start_s
        for j in range(residual.shape[1]):
            d = residual[first, j] - np.interp(at, there, residual[second, j], np.nan, np.nan)
            d = d[np.isfinite(d)]
            squares[j] += 0.5 * float(d @ d)
            counts[j] += len(d)
    return np.sqrt(np.where(counts > 0, squares / np.maximum(counts, 1.0), np.nan))


def _same_motion(one: SessionRecord, other: SessionRecord) -> bool:
    """Whether two sessions run the same path in the same time, to a twentieth of its range."""
    if abs(one.duration_s - other.duration_s) > 0.02 * one.duration_s:
        return False
    a, b = (max(r.stretches, key=lambda s: len(s.time)) for r in (one, other))
    if len(a.time) < 2 or abs(len(a.time) - len(b.time)) > 0.02 * len(a.time):
        return False
    at = a.time - one.start_s
    scale = np.maximum(np.std(a.q, axis=0), 1e-3)
    for j in range(a.q.shape[1]):
        d = a.q[:, j] - np.interp(at, b.time - other.start_s, b.q[:, j])
        if np.sqrt(np.mean(d**2)) > 0.05 * scale[j]:
            return False
    return True


def misfit(rows: SideRows, residual: Floats) -> tuple[Floats, Floats]:
    """Size (n,) of the residual and its variance inflation (n,), the number of rows counting as one, from the
    autocorrelation."""
    n = residual.shape[1]
    sigma, inflation = np.ones(n), np.ones(n)
    for j in range(n):
        total, power, count = np.zeros(1), 0.0, 0
        for session in np.unique(rows.session):
            d = residual[(rows.session == session) & ~rows.test, j]
            ok = np.isfinite(d)
            if ok.sum() < 8:
                continue
            length = next_fast_len(2 * len(d) - 1, real=True)
            part = irfft(np.abs(rfft(np.where(ok, d, 0.0), length)) ** 2, length)[: max(8, len(d) // 3)]
            if len(part) > len(total):
                total = np.pad(total, (0, len(part) - len(total)))
            total[: len(part)] += part
            power, count = power + float(np.sum(d[ok] ** 2)), count + int(ok.sum())
        if count:
            sigma[j] = max(float(np.sqrt(power / count)), 1e-9)
            inflation[j] = correlation_time(total)
    return sigma, inflation


def _without_slow(values: Floats, width: int) -> Floats:
    """Values minus their means over `width` samples: a drift from period to period is not noise."""
    count = len(values) // width * width
    if not count:
        return values
    parts = values[:count].reshape(-1, width)
    return ((parts - parts.mean(axis=1, keepdims=True)) * np.sqrt(width / (width - 1.0))).ravel()


def _robust_rms(values: Floats) -> float:
    """Root mean square without the largest five per cent, scaled as for a normal distribution."""
    inside = values[np.abs(values) <= np.quantile(np.abs(values), 0.95)]
    return float(np.sqrt(np.mean(inside**2)) / 0.8711)
