"""Fewer points for the eye, without losing a spike: minimum and maximum of each stretch are kept."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

__all__ = ["thin"]

Floats = NDArray[np.float64]


def thin(x: Floats, y: Floats, points: int = 1000) -> tuple[Floats, Floats]:
    """At most `points` of the samples (n,), n > points, in their order: both extremes of each stretch.

    The samples are cut into points / 2 stretches of equal number; of each, the lowest and the highest sample
    stay at their own x. A spike of a single sample survives, which plain decimation loses. The first and the
    last sample stay too. Samples that are not finite are left out.
    """
    good = np.isfinite(x) & np.isfinite(y)
    if not good.all():
        x, y = x[good], y[good]
    if len(x) <= points:
        return x, y
    stretches = max((points - 2) // 2, 1)
    edges = np.linspace(0, len(x), stretches + 1).astype(np.int64)
    lowest = np.empty(stretches, dtype=np.int64)
    highest = np.empty(stretches, dtype=np.int64)
    for k, (low, high) in enumerate(pairwise(edges)):
        lowest[k] = low + int(np.argmin(y[low:high]))
        highest[k] = low + int(np.argmax(y[low:high]))
    kept = np.union1d(np.concatenate([lowest, highest]), np.array([0, len(x) - 1]))
    return x[kept], y[kept]
