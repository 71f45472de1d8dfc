"""Torques that are another's than on the healthy arm: turned, those of two joints interchanged, or of another scale.

Of one log alone a turned torque may be a wrong URDF; against the healthy arm's own torques in the same motion it is
not. Interchanged currents come with the other drive's constant, so their factors to the healthy torques are inverse. A
payload scales the torque of a light joint as a wrong gain does; with the other channels of the log, which tell a
payload, it is a gain.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from ident.diagnosis.gain.products import Floats
from ident.diagnosis.rows.broken_data import BrokenChannel
from ident.diagnosis.rows.side_rows import SideRows
from ident.screening.doubts import Doubt

# Least correlation of a torque with that of the healthy arm of which it is a copy, and largest one of another with it.
_SAME, _OTHER = 0.95, 0.7
# Largest factor between a copy and the healthy arm's torque, and of the product of two that are interchanged.
_SCALE = 1.5
# Least number of rows to compare.
_ROWS = 40


def against_healthy(
    rows: Mapping[str, SideRows], values: Floats, names: Sequence[str], doubts: Sequence[Doubt] = ()
) -> tuple[BrokenChannel, ...]:
    """The torque channels that the healthy arm contradicts.

    rows : by side. values (p,) : base parameters of the healthy arm. names : of the joints. doubts : of the channels by
    each other, those of a gain to be confirmed.
    """
    gains = {(one.channel, name) for one in doubts if one.kind == "gain" for name in one.joints}
    found = []
    for side, own in rows.items():
        alike, scale = _compared(own, values)
        for j in np.flatnonzero((np.diag(alike) < -_SAME) & _close(-np.diag(scale))).tolist():
            what = f"is {scale[j, j]:.3g} times the healthy arm's torque in this motion, looks like a reversed sign"
            found.append(BrokenChannel(f"{side} torque", j + 1, what, "check its sign where it is recorded"))
        for j in np.flatnonzero((np.diag(alike) > _SAME) & ~_close(np.diag(scale))).tolist():
            if (f"{side} torque", names[j]) in gains:
                what = (
                    f"is {scale[j, j]:.3g} times the healthy arm's torque in this motion, as the other channels say, "
                    "too, looks like a wrong scale"
                )
                advice = "check its unit and gain; `scale` in the mapping of the import mends a known factor"
                found.append(BrokenChannel(f"{side} torque", j + 1, what, advice))
        crossed = (alike > _SAME) & _close(scale * scale.T)
        for j, k in combinations(range(len(alike)), 2):
            if crossed[j, k] and crossed[k, j] and max(alike[j, j], alike[k, k]) < _OTHER:
                for one, other in ((j, k), (k, j)):
                    what = (
                        f"is {scale[one, other]:.3g} times the healthy arm's torque of {names[other]} in this motion, "
                        "looks like the two joints interchanged"
                    )
                    advice = "check the order of the columns of this channel"
                    found.append(BrokenChannel(f"{side} torque", one + 1, what, advice))
    return tuple(found)


def _close(scale: Floats) -> NDArray[np.bool_]:
    """Whether factors are near one."""
    return (scale > 1.0 / _SCALE) & (scale < _SCALE)


def _compared(rows: SideRows, values: Floats) -> tuple[Floats, Floats]:
    """Correlation (n, n) of the torque of each joint (row) with the healthy arm's of each (column), and its factor to
    it; zero where too few rows have both."""
    healthy = np.stack([table @ values for table in rows.matrix], axis=1)
    n = healthy.shape[1]
    alike, scale = np.zeros((n, n)), np.zeros((n, n))
    for j in range(n):
        for k in range(n):
            used = rows.valid[:, j] & rows.valid[:, k]
            if used.sum() < _ROWS:
                continue
            here, there = rows.target[used, j], healthy[used, k]
            here, there = here - here.mean(), there - there.mean()
            both, own, other = float(here @ there), float(here @ here), float(there @ there)
            if own > 0.0 and other > 0.0:
                alike[j, k], scale[j, k] = both / np.sqrt(own * other), both / other
    return alike, scale
