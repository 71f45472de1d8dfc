"""Evidence for columns beyond the base: held-back gain and significance from Gram matrices of blocks.

Rows of all joints and sides are cut into blocks of time. Of each block only products of columns are kept.
Whatever is asked then (a fit without a part of the motion, the error on that part, the covariance that
blocks, not rows, give) is linear algebra of small matrices: Schur complements on the base. The parts that are
held back are the same phases of every period, so a motion that repeats never checks itself.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2
from scipy.stats import f as fisher

from fri.errors import DataError
from ident.discrepancy.nominal import Nominal, SideRows
from ident.discrepancy.settings import DiagnosisSettings

__all__ = ["Evidence", "Fit", "Products", "Rows", "Score", "noise_floor"]

Floats = NDArray[np.float64]
Key = tuple[str, int]
Rows = Mapping[Key, Floats]
"""Columns in rows: (m, k) for each side and joint in which they are not zero."""


@dataclass(frozen=True, eq=False)
class Score:
    """What a group of k columns adds to the model.

    gain : fall of the chi-square on the parts held back in turn. fitted : fall on the rows fitted.
    coefficients (k,), covariance (k, k) from blocks. p_value : that all are zero. inflation : the gain over
    the number of rows of the joints and sides it acts on, the relative excess of power that it explains.
    """

    gain: float
    fitted: float
    coefficients: Floats
    covariance: Floats
    p_value: float
    inflation: float


@dataclass(frozen=True, eq=False)
class Fit:
    """Least-squares values (P,) of base and further columns, and the inverse Gram matrix (P, P)."""

    values: Floats
    inverse: Floats


@dataclass(frozen=True, eq=False)
class Products:
    """Products of a group's columns with the base and among themselves in each block."""

    base: Floats
    own: Floats
    target: Floats


class Evidence:
    """Block products of the base and of accepted columns.

    sigma : noise of a row [Nm] by side, (n,). dilution : by side, (n,), how much less than a row each row
    counts, because noise is correlated. prior : precision (p, p) and values (p,) of the base parameters, from
    a reference; then a cause that the base parameters would absorb shows as well.
    """

    def __init__(
        self,
        nominal: Nominal,
        settings: DiagnosisSettings,
        sigma: Mapping[str, Floats],
        dilution: Mapping[str, Floats],
        prior: tuple[Floats, Floats] | None = None,
    ) -> None:
        self.settings = settings
        self.prior = prior
        self.nominal = nominal
        self.sigma = {side: np.array(value) for side, value in sigma.items()}
        self.dilution = {side: np.array(value) for side, value in dilution.items()}
        self._layout(nominal)
        self._weights = {
            (side, j): 1.0 / (self.sigma[side][j] ** 2 * self.dilution[side][j])
            for side in nominal.rows
            for j in range(nominal.arm.chain.n)
        }
        self._columns: dict[Key, Floats] = {}
        self._targets: dict[Key, Floats] = {}
        for side, rows in nominal.rows.items():
            for j in range(nominal.arm.chain.n):
                keep = rows.valid[:, j] & ~rows.test
                self._columns[side, j] = self._padded(side, np.where(keep[:, None], rows.matrix[j], 0.0))
                self._targets[side, j] = self._padded(side, np.where(keep, rows.target[:, j], 0.0)[:, None])
        self.mask = {
            (side, j): self._padded(side, (rows.valid[:, j] & ~rows.test).astype(float)[:, None])
            for side, rows in nominal.rows.items()
            for j in range(nominal.arm.chain.n)
        }
        self.base_count = len(nominal.base)
        self.extra: list[Rows] = []
        self._known: dict[int, tuple[Rows, dict[Key, Floats], Products]] = {}
        self._begin()
        self._gram()

    # ---- layout ----

    def _layout(self, nominal: Nominal) -> None:
        """Blocks of time, the same on all sides, and the part of the motion that each belongs to."""
        settings = self.settings
        numbers: dict[tuple[int, int], int] = {}
        folds: list[int] = []
        self._place: dict[str, tuple[NDArray[np.int64], NDArray[np.int64], int]] = {}
        start = {r.number: r.start_s for r in nominal.recordings}
        period = {r.number: r.period_s for r in nominal.recordings}
        length = {
            r.number: min(settings.block_s, r.period_s / (2.0 * settings.folds)) for r in nominal.recordings
        }
        ids: dict[str, NDArray[np.int64]] = {}
        for side, rows in nominal.rows.items():
            found = np.empty(len(rows.time), dtype=np.int64)
            for k, (session, time) in enumerate(zip(rows.session, rows.time, strict=True)):
                since = time - start[int(session)]
                block = (int(session), int(since / length[int(session)]))
                if block not in numbers:
                    numbers[block] = len(numbers)
                    phase = since % period[int(session)]
                    folds.append(int(phase / length[int(session)]) % settings.folds)
                found[k] = numbers[block]
            ids[side] = found
        self.blocks = len(numbers)
        self.block_session = np.array([session for session, _ in numbers], dtype=np.int64)
        self.block_start = np.array([start[k] + b * length[k] for k, b in numbers])
        self.fold = np.array(folds, dtype=np.int64)
        if len(set(folds)) < 2:
            raise DataError("the sessions are too short to hold a part of them back; record at least 5 s")
        for side, found in ids.items():
            order = np.argsort(found, kind="stable")
            counts = np.bincount(found, minlength=self.blocks)
            within = np.empty(len(found), dtype=np.int64)
            within[order] = np.concatenate([np.arange(c) for c in counts])
            self._place[side] = (found, within, int(counts.max(initial=1)))

    def _padded(self, side: str, values: Floats) -> Floats:
        """(blocks, L, k) of rows (m, k); zeros where a block is shorter."""
        block, within, length = self._place[side]
        out = np.zeros((self.blocks, length, values.shape[1]))
        out[block, within] = values
        return out

    # ---- products ----

    def _begin(self) -> None:
        """Products of the base, made once."""
        p = self.base_count
        self._base_gram = np.zeros((self.blocks, p, p))
        self._base_target = np.zeros((self.blocks, p))
        self.energy = np.zeros(self.blocks)
        for key, matrix in self._columns.items():
            weight = self._weights[key]
            t = self._targets[key]
            turned = weight * matrix.transpose(0, 2, 1)
            self._base_gram += np.matmul(turned, matrix)
            self._base_target += np.matmul(turned, t)[:, :, 0]
            self.energy += weight * np.sum(t[:, :, 0] ** 2, axis=1)

    def _gram(self) -> None:
        """Products of base and further columns, and the fits with and without each part of the motion."""
        p = self.base_count
        self.gram, self.target = self._base_gram, self._base_target
        if self.extra:
            size = p + sum(_width(rows) for rows in self.extra)
            self.gram = np.zeros((self.blocks, size, size))
            self.target = np.zeros((self.blocks, size))
            self.gram[:, :p, :p], self.target[:, :p] = self._base_gram, self._base_target
            place = p
            for rows in self.extra:
                _, padded, products = self._known[id(rows)]
                end = place + _width(rows)
                self.gram[:, place:end, :p] = products.base
                self.gram[:, :p, place:end] = products.base.transpose(0, 2, 1)
                self.target[:, place:end] = products.target
                other = p
                for against in self.extra:
                    stop = other + _width(against)
                    if other <= place:
                        cross = self._cross(padded, self._known[id(against)][1])
                        self.gram[:, place:end, other:stop] = cross
                        self.gram[:, other:stop, place:end] = cross.transpose(0, 2, 1)
                    other = stop
                place = end
        scale = np.sqrt(np.einsum("bii->i", self.gram))
        self._scale = np.where(scale > 0.0, 1.0 / np.where(scale > 0.0, scale, 1.0), 0.0)
        self.full = self._fit(np.ones(self.blocks, dtype=bool))
        self._held = [
            (part, self._fit(~part))
            for f in range(int(self.fold.max()) + 1)
            if (part := self.fold == f).any() and (~part).any()
        ]

    def _fit(self, chosen: NDArray[np.bool_]) -> Fit:
        s = self._scale
        gram, target = self.gram[chosen].sum(axis=0), self.target[chosen].sum(axis=0)
        if self.prior is not None:
            p = self.base_count
            gram[:p, :p] += self.prior[0]
            target[:p] += self.prior[0] @ self.prior[1]
        gram *= np.outer(s, s)
        # A motion that leaves a direction open must not blow it up; 1e-9 of the diagonal decides
        # nothing else.
        gram[np.diag_indices_from(gram)] += 1e-9
        inverse = np.linalg.inv(gram) * np.outer(s, s)
        return Fit(inverse @ target, inverse)

    def padded(self, rows: Rows) -> dict[Key, Floats]:
        """Columns in blocks, zero where a row is not used."""
        return {key: self._padded(key[0], values) * self.mask[key] for key, values in rows.items()}

    def products(self, columns: Mapping[Key, Floats], known: Products | None = None) -> Products:
        """Products in each block of padded columns (blocks, L, k).

        known : the products of the same columns with the base alone; only those with further
        columns are made.
        """
        known = self.alone(columns) if known is None else known
        parts = [known.base]
        parts += [self._cross(columns, self._known[id(rows)][1]) for rows in self.extra]
        return Products(np.concatenate(parts, axis=2), known.own, known.target)

    def replace(self, extra: Sequence[Rows]) -> None:
        """Let the base be followed by these columns."""
        self.extra = list(extra)
        for rows in self.extra:
            if id(rows) not in self._known:
                padded = self.padded(rows)
                # The rows are kept too, so that their identity stays theirs.
                self._known[id(rows)] = (rows, padded, self.alone(padded))
        self._gram()

    def _cross(self, a: Mapping[Key, Floats], b: Mapping[Key, Floats]) -> Floats:
        """Products (blocks, k, l) of two groups of padded columns."""
        width = (next(iter(a.values())).shape[2], next(iter(b.values())).shape[2])
        total = np.zeros((self.blocks, *width))
        for key in a.keys() & b.keys():
            total += self._weights[key] * np.matmul(a[key].transpose(0, 2, 1), b[key])
        return total

    def alone(self, columns: Mapping[Key, Floats]) -> Products:
        """Products of padded columns with the base, themselves and the torques."""
        width = next(iter(columns.values())).shape[2]
        base = np.zeros((self.blocks, width, self.base_count))
        own = np.zeros((self.blocks, width, width))
        target = np.zeros((self.blocks, width))
        for key, matrix in columns.items():
            turned = self._weights[key] * matrix.transpose(0, 2, 1)
            base += np.matmul(turned, self._columns[key])
            own += np.matmul(turned, matrix)
            target += np.matmul(turned, self._targets[key])[:, :, 0]
        return Products(base, own, target)

    # ---- scores ----

    def score(
        self, columns: Mapping[Key, Floats], *, ridge: float = 0.0, known: Products | None = None
    ) -> Score:
        """Score of padded columns.

        ridge : pull towards zero, in units of the columns' mean square, for groups of many columns.
        known : their products with the base alone, to save time.
        """
        return self.score_products(self.products(columns, known), list(columns), ridge=ridge)

    def score_products(self, products: Products, keys: Sequence[Key], *, ridge: float = 0.0) -> Score:
        """Score of columns in the rows of `keys` from their products with all present columns."""
        gain = 0.0
        for part, fit in self._held:
            train = ~part
            gain += self._held_gain(products, fit, train, part, ridge)
        whole = np.ones(self.blocks, dtype=bool)
        lever, inner, reach = self._schur(products, self.full, whole, ridge)
        if inner is None:
            k = products.own.shape[1]
            return Score(-np.inf, 0.0, np.zeros(k), np.eye(k), 1.0, 0.0)
        coefficients = inner @ reach
        fitted = float(reach @ coefficients)
        covariance, active = self._robust(products, lever, inner, coefficients)
        rows = sum(float(self.mask[key].sum()) / self.dilution[key[0]][key[1]] for key in keys)
        if self.prior is not None:
            gain += self._strain(self.full.values) - self._strain(self.full.values - lever @ coefficients)
        # Held-back error can also fall because a base fitted without the part was poor: never more than that.
        gain = min(gain, fitted)
        return Score(
            gain,
            fitted,
            coefficients,
            covariance,
            _wald(coefficients, covariance, active),
            gain / max(rows, 1.0),
        )

    def event_score(self, score: Score, choices: int) -> Score:
        """A score of columns that are active in a few blocks only, the best of `choices`: the fall
        on the rows
        fitted, less what the best of so many would fall by chance.
        """
        k = len(score.coefficients)
        penalty = 2.0 * np.log(max(choices, 1)) + 4.0 * k
        p = float(min(1.0, choices * chi2.sf(score.fitted, k)))
        gain = score.fitted - penalty if np.isfinite(score.gain) else -np.inf
        return Score(gain, score.fitted, score.coefficients, score.covariance, p, score.inflation)

    def _schur(
        self, products: Products, fit: Fit, chosen: NDArray[np.bool_], ridge: float
    ) -> tuple[Floats, Floats | None, Floats]:
        """The columns' image in the base (P, k), the inverse of their Schur complement (k, k), and their
        product with the residual (k,)."""
        cross = products.base[chosen].sum(axis=0)
        lever = fit.inverse @ cross.T
        own = products.own[chosen].sum(axis=0)
        inner = own - cross @ lever
        size = np.diag(own).copy()
        # A column that the base explains to a millionth has nothing of its own to say.
        if np.any(size <= 0.0) or np.any(np.diag(inner) < 1e-7 * size):
            return lever, None, np.zeros(len(own))
        inner = inner + ridge * np.diag(size)
        root = np.sqrt(np.diag(inner))
        scaled = inner / np.outer(root, root)
        if np.linalg.eigvalsh(scaled)[0] < 1e-9:
            return lever, None, np.zeros(len(own))
        reach = products.target[chosen].sum(axis=0) - cross @ fit.values
        return lever, np.linalg.inv(scaled) / np.outer(root, root), reach

    def _held_gain(
        self, products: Products, fit: Fit, train: NDArray[np.bool_], part: NDArray[np.bool_], ridge: float
    ) -> float:
        lever, inner, reach = self._schur(products, fit, train, ridge)
        if inner is None:
            return 0.0
        c = inner @ reach
        change = -(lever @ c)
        gram, cross, own = (
            self.gram[part].sum(axis=0),
            products.base[part].sum(axis=0),
            products.own[part].sum(axis=0),
        )
        base_reach = self.target[part].sum(axis=0) - gram @ fit.values
        own_reach = products.target[part].sum(axis=0) - cross @ fit.values
        linear = 2.0 * (change @ base_reach + c @ own_reach)
        square = change @ gram @ change + 2.0 * (c @ cross @ change) + c @ own @ c
        return float(linear - square)

    def _strain(self, values: Floats) -> float:
        """Chi-square of base parameters against the reference."""
        if self.prior is None:
            return 0.0
        difference = values[: self.base_count] - self.prior[1]
        return float(difference @ self.prior[0] @ difference)

    def _robust(
        self, products: Products, lever: Floats, inner: Floats, coefficients: Floats
    ) -> tuple[Floats, int]:
        """Covariance from blocks, at least that of independent rows; and the number of blocks that
        carry it.
        """
        values = self.full.values - lever @ coefficients
        own = products.target - products.base @ values - products.own @ coefficients
        base = self.target - self.gram @ values - np.einsum("bkp,k->bp", products.base, coefficients)
        scores = own - base @ lever
        size = np.einsum("bkk->b", products.own)
        active = int(np.sum(size > 1e-3 * size.max(initial=0.0)))
        factor = active / max(active - 1, 1)
        middle = factor * scores.T @ scores
        sandwich = inner @ middle @ inner
        floor = np.sqrt(np.maximum(np.diag(inner), 0.0) / np.maximum(np.diag(sandwich), 1e-300))
        widen = np.maximum(floor, 1.0)
        return sandwich * np.outer(widen, widen), active

    # ---- results of a fit ----

    def block_of(self, side: str) -> Floats:
        """Number (m,) of the block of each row of a side."""
        return self._place[side][0].astype(float)

    def residuals(self, *, test: bool = False) -> dict[str, Floats]:
        """Residual (m, n) by side with the present columns, NaN where a row is not used; `test`: the rows
        never fitted instead."""
        found = {}
        for side, rows in self.nominal.rows.items():
            keep = rows.valid & (rows.test if test else ~rows.test)[:, None]
            predicted = self._predict(side, self.full.values, np.ones(len(rows.time), dtype=bool))
            found[side] = np.where(keep, rows.target - predicted, np.nan)
        return found

    def held_residuals(self) -> dict[str, Floats]:
        """Residual (m, n) by side of each part of the motion as predicted from the others."""
        found = {}
        for side, rows in self.nominal.rows.items():
            out = np.full(rows.target.shape, np.nan)
            for part, fit in self._held:
                mine = part[self._place[side][0]]
                out[mine] = rows.target[mine] - self._predict(side, fit.values, mine)
            found[side] = np.where(rows.valid & ~rows.test[:, None], out, np.nan)
        return found

    def _predict(self, side: str, values: Floats, mine: NDArray[np.bool_]) -> Floats:
        """Torques (rows, n) of chosen rows with the values (P,) of the present columns."""
        p = self.base_count
        predicted = np.einsum("jmp,p->mj", self.nominal.rows[side].matrix[:, mine], values[:p])
        place = p
        for extra in self.extra:
            width = _width(extra)
            for (of_side, j), columns in extra.items():
                if of_side == side:
                    predicted[:, j] += columns[mine] @ values[place : place + width]
            place += width
        return predicted

    def covariance(self) -> Floats:
        """Covariance (P, P) of all present columns, from blocks, at least that of independent rows."""
        scores = self.target - self.gram @ self.full.values
        middle = self.blocks / max(self.blocks - 1, 1) * scores.T @ scores
        sandwich = self.full.inverse @ middle @ self.full.inverse
        floor = np.sqrt(np.maximum(np.diag(self.full.inverse), 0.0) / np.maximum(np.diag(sandwich), 1e-300))
        widen = np.maximum(floor, 1.0)
        return sandwich * np.outer(widen, widen)

    @property
    def chi_square(self) -> float:
        """Sum of squares of all rows fitted, in units of their noise."""
        v = self.full.values
        return float(self.energy.sum() - 2.0 * v @ self.target.sum(axis=0) + v @ self.gram.sum(axis=0) @ v)


def _width(rows: Rows) -> int:
    return next(iter(rows.values())).shape[1]


def _wald(coefficients: Floats, covariance: Floats, active: int) -> float:
    k = len(coefficients)
    try:
        value = float(coefficients @ np.linalg.solve(covariance, coefficients))
    except np.linalg.LinAlgError:
        return 1.0
    return float(fisher.sf(value / k, k, max(active - k, 1)))


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
        nearest = np.clip(np.rint((at - rows.time[first[0]]) / step).astype(int), 0, len(first) - 1)
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
