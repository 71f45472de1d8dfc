"""Errors on held-out rows, before and after an extension, with intervals from blocks."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:  # the words about a diagnosis need a constant of this module, and no search
    from ident.diagnosis.gain.evidence import Evidence
    from ident.diagnosis.gain.products import Floats, Key, Rows
    from ident.diagnosis.rows.side_rows import SideRows

_DRAWS = 1000
FELT_WORSE = 0.01
"""A rise of an error by a smaller share is felt by nobody, however sure: all rows share base parameters."""
BEYOND_HEALTHY = 1.5
"""Error over that which 19 of 20 healthy days stay below, hardly reached by other motions and loads."""
# A rise beyond this counts, though it came from a single block.
_MUCH_WORSE = 0.05


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Residual (m, n) [Nm] by side on held-out rows, NaN elsewhere, and the blocks (m,) of rows."""

    residual: dict[str, Floats]
    block: dict[str, NDArray[np.int64]]

    def where(self, other: HeldOut) -> HeldOut:
        """The same on the rows of `other`: a shift in time changes the usable rows of a channel."""
        residual = {
            side: np.where(np.isfinite(other.residual[side]), values, np.nan)
            for side, values in self.residual.items()
        }
        return HeldOut(residual, self.block)

    def rms(self) -> dict[str, Floats]:
        """Root mean square (n,) by side."""
        found = {}
        for side, values in self.residual.items():
            count = np.isfinite(values).sum(axis=0)
            total = np.nansum(values**2, axis=0)
            found[side] = np.where(count > 0, np.sqrt(total / np.maximum(count, 1)), np.nan)
        return found


def held_out(evidence: Evidence, extra: Sequence[Rows]) -> HeldOut:
    """Residuals with the base and further columns: on the test sessions if there are any, else on each part of the
    motion as predicted from the others.
    """
    evidence.replace(extra)
    rows = evidence.nominal.rows
    if any(side.test.any() for side in rows.values()):
        return HeldOut(evidence.residuals(test=True), _blocks_of(rows, evidence.settings.block_s))
    return HeldOut(evidence.held_residuals(), {side: evidence.block_of(side) for side in rows})


def _blocks_of(rows: Mapping[str, SideRows], block_s: float) -> dict[str, NDArray[np.int64]]:
    """Number (m,) by side of each row's block of `block_s` of its session, the same on all sides."""
    pairs = [
        np.stack([r.session, np.floor(r.time / block_s).astype(np.int64)], axis=1) for r in rows.values()
    ]
    number = np.unique(np.concatenate(pairs), axis=0, return_inverse=True)[1].ravel()
    ends = np.cumsum([len(pair) for pair in pairs])
    return dict(zip(rows, np.split(number, ends[:-1]), strict=True))


def interval(
    before: HeldOut, after: HeldOut, keys: Sequence[Key], seed: int, *, tail: float = 0.025
) -> tuple[float, float, float, float]:
    """RMS before and after, pooled over the rows of `keys`, and the 95 % interval of their difference.

    tail : share beyond each end of the interval. From 1000 draws of blocks with replacement.
    """
    table = _by_block(before, after, dict.fromkeys(keys, 1.0))
    if not len(table):
        return 0.0, 0.0, 0.0, 0.0
    drawn = drawn_sums(table, np.random.default_rng(seed))
    difference = np.sqrt(drawn[:, 0] / drawn[:, 2]) - np.sqrt(drawn[:, 1] / drawn[:, 2])
    total = table.sum(axis=0)
    low, high = np.quantile(difference, [tail, 1.0 - tail])
    return float(np.sqrt(total[0] / total[2])), float(np.sqrt(total[1] / total[2])), float(low), float(high)


def fall(before: HeldOut, after: HeldOut, weights: Mapping[Key, float], seed: int) -> tuple[float, float]:
    """95 % interval of the fall of the weighted sum of squares over the rows of all keys, from draws of blocks.

    weights : of a row's square, by side and joint [1/Nm^2]. Zeros without rows.
    """
    table = _by_block(before, after, weights)
    if not len(table):
        return 0.0, 0.0
    drawn = drawn_sums(table, np.random.default_rng(seed))
    low, high = np.quantile(drawn[:, 0] - drawn[:, 1], [0.025, 0.975])
    return float(low), float(high)


def spread_out(before: HeldOut, after: HeldOut, keys: Sequence[Key]) -> bool:
    """Whether the error over the rows of `keys` falls without the block of its largest fall, too."""
    table = _by_block(before, after, dict.fromkeys(keys, 1.0))
    fall = table[:, 0] - table[:, 1] if len(table) else np.zeros(1)
    return bool(fall.sum() > max(float(fall.max()), 0.0))


def worse_rows(
    before: HeldOut,
    after: HeldOut,
    seed: int,
    acting: Collection[Key] | None = None,
    usual: Mapping[str, Floats] | None = None,
) -> list[Key]:
    """Sides and joints with a larger error after than before: by 5 %, or by 1 % and beyond chance for the worst of all
    rows, once in twenty.

    acting : rows on which the cause in question acts, default all. The others change with the shared base parameters
    alone, and count where the error is both larger by 5 % and beyond chance. usual : error (n,) [Nm] by side that
    healthy days leave; up to it the others do not count at all, for a healthy arm is as wrong there.
    """
    keys = [
        (side, joint)
        for side, values in before.residual.items()
        for joint in range(values.shape[1])
        if np.isfinite(values[:, joint]).any()
    ]
    tail = 0.025 / max(len(keys), 1)
    found = {key: interval(before, after, [key], seed, tail=tail) for key in keys}
    worse = []
    for key, (a, b, _, high) in found.items():
        sure, acts = high < 0.0, acting is None or key in acting
        if not acts and usual and key[0] in usual and b <= usual[key[0]][key[1]]:
            continue
        if (sure or acts) and b > (1.0 + (FELT_WORSE if sure and acts else _MUCH_WORSE)) * a:
            worse.append(key)
    return worse


def _by_block(before: HeldOut, after: HeldOut, weights: Mapping[Key, float]) -> Floats:
    """Weighted sums of squares before and after, and number of rows, (blocks, 3)."""
    blocks: dict[int, Floats] = {}
    for (side, joint), weight in weights.items():
        a, b = before.residual[side][:, joint], after.residual[side][:, joint]
        ok = np.isfinite(a) & np.isfinite(b)
        for block in np.unique(before.block[side][ok]):
            mine = ok & (before.block[side] == block)
            part = np.array([weight * np.sum(a[mine] ** 2), weight * np.sum(b[mine] ** 2), mine.sum()])
            blocks[int(block)] = blocks.get(int(block), np.zeros(3)) + part
    return np.array(list(blocks.values()))


def drawn_sums(table: Floats, rng: np.random.Generator) -> Floats:
    """Sums (draws, k) of a table (blocks, k) over the same number of blocks, drawn with replacement."""
    drawn: Floats = table[rng.integers(0, len(table), (_DRAWS, len(table)))].sum(axis=1)
    return drawn
