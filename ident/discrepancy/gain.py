"""How much was gained: errors on rows that were not fitted, before and after, with intervals from blocks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ident.discrepancy.evidence import Evidence, Floats, Rows

__all__ = ["HeldOut", "held_out", "interval"]

_DRAWS = 1000


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Residual (m, n) [Nm] by side on rows that were not fitted, NaN elsewhere, and the blocks
    (m,) of rows.
    """

    residual: dict[str, Floats]
    block: dict[str, Floats]

    def rms(self) -> dict[str, Floats]:
        """Root mean square (n,) by side."""
        found = {}
        for side, values in self.residual.items():
            count = np.isfinite(values).sum(axis=0)
            total = np.nansum(values**2, axis=0)
            found[side] = np.where(count > 0, np.sqrt(total / np.maximum(count, 1)), np.nan)
        return found


def held_out(evidence: Evidence, extra: Sequence[Rows]) -> HeldOut:
    """Residuals with the base and further columns: on the test sessions where there are any, else
    on each part
    of the motion as predicted from the others."""
    evidence.replace(extra)
    rows = evidence.nominal.rows
    if any(side.test.any() for side in rows.values()):
        blocks = {side: np.floor(r.time / 2.0) + 1e6 * r.session for side, r in rows.items()}
        return HeldOut(evidence.residuals(test=True), blocks)
    return HeldOut(evidence.held_residuals(), {side: evidence.block_of(side) for side in rows})


def interval(
    before: HeldOut, after: HeldOut, keys: Sequence[tuple[str, int]], seed: int
) -> tuple[float, float, float, float]:
    """RMS before and after, pooled over the rows of `keys`, and the 95 % interval of their difference.

    From 1000 draws of blocks with replacement.
    """
    blocks: dict[float, Floats] = {}
    for side, joint in keys:
        a, b = before.residual[side][:, joint], after.residual[side][:, joint]
        ok = np.isfinite(a) & np.isfinite(b)
        for block in np.unique(before.block[side][ok]):
            mine = ok & (before.block[side] == block)
            part = np.array([np.sum(a[mine] ** 2), np.sum(b[mine] ** 2), mine.sum()])
            blocks[float(block)] = blocks.get(float(block), np.zeros(3)) + part
    if not blocks:
        return 0.0, 0.0, 0.0, 0.0
    table = np.array(list(blocks.values()))
    rng = np.random.default_rng(seed)
    drawn = table[rng.integers(0, len(table), (_DRAWS, len(table)))].sum(axis=1)
    difference = np.sqrt(drawn[:, 0] / drawn[:, 2]) - np.sqrt(drawn[:, 1] / drawn[:, 2])
    total = table.sum(axis=0)
    low, high = np.quantile(difference, [0.025, 0.975])
    return (
        float(np.sqrt(total[0] / total[2])),
        float(np.sqrt(total[1] / total[2])),
        float(low),
        float(high),
    )
