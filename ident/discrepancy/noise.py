"""The noise of rows, told by what differs from period to period."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ident.discrepancy.nominal import SideRows

__all__ = ["noise_floor"]

Floats = NDArray[np.float64]


def noise_floor(
    rows: SideRows, residual: Floats, periods: Mapping[int, tuple[float, float]]
) -> tuple[Floats, Floats, bool]:
    """Noise (n,) of a row [Nm], the dilution (n,) of rows by correlation, and whether periods told it.

    Where the excitation repeats, the difference of two periods of the residual is noise and nothing else.
    Otherwise the difference of neighbouring rows stands for it, which correlated noise escapes.
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
        step = float(np.median(np.diff(rows.time[first])))
        # Rows need not be evenly spaced: a slow tick seldom fits the cycle.
        after = np.clip(np.searchsorted(rows.time[first], at), 1, len(first) - 1)
        earlier = at - rows.time[first[after - 1]] < rows.time[first[after]] - at
        nearest = after - earlier
        close = np.abs(rows.time[first[nearest]] - at) < 0.6 * step
        pairs.append((residual[second[close]] - residual[first[nearest[close]]]) / np.sqrt(2.0))
    sigma, dilution = np.ones(n), np.ones(n)
    told = bool(pairs)
    differences = np.concatenate(pairs) if told else residual
    for j in range(n):
        d = differences[:, j]
        if not told:
            d = np.diff(residual[:, j]) / np.sqrt(2.0)
        d = d[np.isfinite(d)]
        if len(d) < 20:
            continue
        sigma[j] = max(_robust_rms(d), 1e-9)
        if told:
            d = _without_slow(d, max(4, round(1.0 / max(float(np.median(np.diff(rows.time))), 1e-6))))
            sigma[j] = max(_robust_rms(d), 1e-9)
            width = max(2, round(0.2 / max(float(np.median(np.diff(rows.time))), 1e-6)))
            count = len(d) // width
            if count >= 4:
                means = d[: count * width].reshape(count, width).mean(axis=1)
                dilution[j] = float(np.clip(width * np.mean(means**2) / np.mean(d**2), 1.0, width))
                if dilution[j] < 1.0 + 3.0 * np.sqrt(2.0 / count):
                    dilution[j] = 1.0
    return sigma, dilution, told


def _without_slow(values: Floats, width: int) -> Floats:
    """Values less their means over `width` samples: a drift from period to period is no noise."""
    count = len(values) // width * width
    if not count:
        return values
    parts = values[:count].reshape(-1, width)
    return ((parts - parts.mean(axis=1, keepdims=True)) * np.sqrt(width / (width - 1.0))).ravel()


def _robust_rms(values: Floats) -> float:
    """Root mean square without the largest five per cent, scaled as for a normal distribution."""
    limit = np.quantile(np.abs(values), 0.95)
    return float(np.sqrt(np.mean(values[np.abs(values) <= limit] ** 2)) / 0.8711)
