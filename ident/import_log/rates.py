"""Velocities against dq/dt, by most of the samples: a hole, a jump or a wrap spoils the few samples beside it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import NDArray

from ident.import_log.tables import Floats

ALIKE = 0.9
"""Least correlation of a channel with the derivative of another, to be taken for it."""
# Share of the samples left out, those that fit worst. Share of all motion from which a joint counts by itself.
_WORST, _MOVES = 0.05, 1e-4
# Time of a mean [s]: steps of an encoder and repeated samples count little.
_MEAN_S = 0.02


@dataclass(frozen=True, eq=False)
class Rates:
    """A rate (n, k) beside the change of k channels.

    power, own, product : (k,), sums of squares of the changes and of the rates, and of their products.
    """

    power: Floats
    own: Floats
    product: Floats

    @property
    def ratio(self) -> float:
        """Rate over change, of all channels together; 0 without motion."""
        return float(self.product.sum() / max(self.power.sum(), 1e-300))

    @property
    def alike(self) -> float:
        """Correlation of all channels together."""
        whole = float(np.sqrt(self.own.sum() * self.power.sum()))
        return float(self.product.sum()) / whole if whole > 0.0 else 0.0

    @property
    def by_channel(self) -> Floats:
        """Rate over change (k,), nan where a channel hardly moves or they are not alike."""
        whole = np.sqrt(self.own * self.power)
        clear = (self.product > ALIKE * whole) & (self.own > _MOVES * self.own.sum()) & (whole > 0.0)
        return cast(Floats, np.divide(self.product, self.power, out=np.full(len(whole), np.nan), where=clear))

    @property
    def unlike(self) -> NDArray[np.int64]:
        """Channels that move and are not alike."""
        whole = np.sqrt(self.own * self.power)
        return np.flatnonzero((self.own > _MOVES * self.own.sum()) & (self.product <= ALIKE * whole))


def compare(values: Floats, rate: Floats, times: Floats, *, mean_s: float = _MEAN_S) -> Rates:
    """The rate (n, k) beside the change of the values (n, k) at the times (n,), by means over `mean_s`."""
    period = float(times[-1] - times[0]) / max(len(times) - 1, 1)
    width = max(1, min(round(mean_s / period), len(values) // 4)) if period > 0.0 else 1
    span = (times[width:] - times[:-width])[:, None]
    step = np.diff(times)[:, None]
    way = np.vstack([np.zeros(rate.shape[1]), np.cumsum(0.5 * (rate[1:] + rate[:-1]) * step, axis=0)])
    mean, change = (way[width:] - way[:-width]) / span, (values[width:] - values[:-width]) / span
    sums = np.array([_sums(x, y) for x, y in zip(change.T, mean.T, strict=True)]).reshape(-1, 3)
    return Rates(*sums.T)


def _sums(change: Floats, rate: Floats) -> tuple[float, float, float]:
    """Sums of change^2, rate^2 and rate x change over the samples (m,) that fit best."""
    moving = (change != 0.0) & (rate != 0.0)
    if not moving.any():
        return float(change @ change), float(rate @ rate), 0.0
    ratio, weight = rate[moving] / change[moving], np.abs(rate[moving])
    order = np.argsort(ratio)
    passed = np.cumsum(weight[order])
    usual = ratio[order][np.searchsorted(passed, 0.5 * passed[-1])]
    left = np.abs(rate - usual * change)
    kept = left <= np.quantile(left, 1.0 - _WORST)
    change, rate = change[kept], rate[kept]
    return float(change @ change), float(rate @ rate), float(rate @ change)
