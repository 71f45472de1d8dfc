"""Evidence for columns beyond the base: held-back gain and significance from Gram matrices of blocks.

Rows of all joints and sides are cut into blocks of time. Of each block only products of columns are kept.
Whatever is asked then (a fit without a part of the motion, the error on that part, the covariance that
blocks, not rows, give) is linear algebra of small matrices: Schur complements on the base. The parts that are
held back are the same phases of every period, so a motion that repeats never checks itself.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from fri.errors import DataError
from ident.diagnosis.nominal import Nominal
from ident.diagnosis.settings import DiagnosisSettings
from ident.estimators.estimate import chi_square_tail, fisher_tail

__all__ = ["Evidence", "Fit", "Products", "Rows", "Score"]

Floats = NDArray[np.float64]
# Share of a column's power that free base parameters must leave, where the others lean on a drawing.
_OWN_SHARE = 3e-3

Key = tuple[str, int]
Rows = Mapping[Key, Floats]
"""Columns in rows: (m, k) for each side and joint in which they are not zero."""


# A fall of the chi-square up to this is nothing, whatever the parts that are held back say to it.
_NOTHING = 12.0


@dataclass(frozen=True, eq=False)
class Score:
    """What a group of k columns adds to the model.

    gain : fall of the chi-square on the parts held back in turn. fitted : fall on the rows fitted.
    coefficients (k,), covariance (k, k) from blocks. p_value : that all are zero. inflation : the gain over
    the number of rows of the joints and sides it acts on, the relative excess of power that it explains.
    robust : gives covariance and number of blocks that carry it; asked only where it matters, for most
    scores it does not. chance : the p-value, where it does not come from the covariance.
    """

    gain: float
    fitted: float
    coefficients: Floats
    inflation: float
    robust: Callable[[], tuple[Floats, int]]
    chance: float | None = None

    @cached_property
    def _robust(self) -> tuple[Floats, int]:
        return self.robust()

    @property
    def covariance(self) -> Floats:
        """(k, k), from blocks."""
        return self._robust[0]

    @cached_property
    def p_value(self) -> float:
        """Probability of such coefficients where all are zero."""
        return _wald(self.coefficients, *self._robust) if self.chance is None else self.chance


@dataclass(frozen=True, eq=False)
class Fit:
    """Least-squares values (P,) of base and further columns, and the inverse Gram matrix (P, P)."""

    values: Floats
    inverse: Floats


@dataclass(frozen=True, eq=False)
class Products:
    """Products of a group's columns with the base and among themselves in each block, and their sums over the
    parts of the motion that are held back in turn; `parts` (parts, blocks) is 1 where a block belongs to one.
    """

    base: Floats
    own: Floats
    target: Floats
    parts: Floats

    @cached_property
    def sums(self) -> tuple[Floats, Floats, Floats]:
        """Base, own and target of each part."""
        return _sums(self.parts, self.base), _sums(self.parts, self.own), self.parts @ self.target

    def only(self, on: Floats) -> Products:
        """Of the blocks with weight 1 in `on` (blocks,) alone."""
        return Products(
            self.base * on[:, None, None], self.own * on[:, None, None], self.target * on[:, None], self.parts
        )


class Evidence:
    """Block products of the base and of accepted columns.

    sigma : noise of a row [Nm] by side, (n,). dilution : by side, (n,), how much less than a row each row
    counts, because noise is correlated. prior : precision (p, p) and values (p,) of the base parameters, from
    a reference; then a cause that the base parameters would absorb shows as well, where they are `compared`.
    floor : repeatability of a row [Nm] by side, (n,); default sigma.
    """

    def __init__(
        self,
        nominal: Nominal,
        settings: DiagnosisSettings,
        sigma: Mapping[str, Floats],
        dilution: Mapping[str, Floats],
        prior: tuple[Floats, Floats] | None = None,
        *,
        compared: bool = True,
        floor: Mapping[str, Floats] | None = None,
    ) -> None:
        self.settings = settings
        self.prior = prior
        self.compared = compared
        self.floor = dict(sigma if floor is None else floor)
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
        self._acting: dict[Key, NDArray[np.int64]] = {}
        self._targets: dict[Key, Floats] = {}
        for side, rows in nominal.rows.items():
            for j in range(nominal.arm.chain.n):
                keep = rows.valid[:, j] & ~rows.test
                wide = np.where(keep[:, None], rows.matrix[j], 0.0)
                # Most base columns do not reach most joints.
                self._acting[side, j] = np.flatnonzero(np.any(wide != 0.0, axis=0))
                self._columns[side, j] = self._padded(side, wide[:, self._acting[side, j]])
                self._targets[side, j] = self._padded(side, np.where(keep, rows.target[:, j], 0.0)[:, None])
        self.mask = {
            (side, j): self._padded(side, (rows.valid[:, j] & ~rows.test).astype(float)[:, None])
            for side, rows in nominal.rows.items()
            for j in range(nominal.arm.chain.n)
        }
        self.base_count = len(nominal.base)
        self.extra: list[Rows] = []
        self._known: dict[int, tuple[Rows, dict[Key, Floats], Products]] = {}
        self._joined: dict[Key, Floats] | None = None
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
        # A motion that does not repeat gives half as long a block, for enough of them.
        parts = {r.number: (2.0 if r.repeats else 4.0) * settings.folds for r in nominal.recordings}
        length = {r.number: min(settings.block_s, r.period_s / parts[r.number]) for r in nominal.recordings}
        ids: dict[str, NDArray[np.int64]] = {}
        for side, rows in nominal.rows.items():
            found = np.full(len(rows.time), -1)
            for k in np.flatnonzero(~rows.test):
                session, time = rows.session[k], rows.time[k]
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
        self.parts = (np.unique(self.fold)[:, None] == self.fold).astype(float)
        if len(set(folds)) < 2:
            raise DataError("the sessions are too short to hold a part of them back; record at least 5 s")
        for side, found in ids.items():
            fitted = np.flatnonzero(found >= 0)
            order = fitted[np.argsort(found[fitted], kind="stable")]
            counts = np.bincount(found[fitted], minlength=self.blocks)
            within = np.zeros(len(found), dtype=np.int64)
            within[order] = np.concatenate([np.arange(c) for c in counts])
            self._place[side] = (found, within, int(counts.max(initial=1)))

    def _padded(self, side: str, values: Floats) -> Floats:
        """(blocks, L, k) of rows (m, k); zeros where a block is shorter. Rows that are never fitted have none."""
        block, within, length = self._place[side]
        fitted = block >= 0
        out = np.zeros((self.blocks, length, values.shape[1]))
        out[block[fitted], within[fitted]] = values[fitted]
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
            on = self._acting[key]
            self._base_gram[:, on[:, None], on] += np.matmul(turned, matrix)
            self._base_target[:, on] += np.matmul(turned, t)[:, :, 0]
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
        self._part_gram, self._part_target = _sums(self.parts, self.gram), self.parts @ self.target
        gram, target = self._part_gram.sum(axis=0), self._part_target.sum(axis=0)
        self.full = self._fit(gram, target)
        self._free = None
        if self.prior is not None and not self.compared:
            self._free = self._fit(gram, target, leaning=False)
        self._held = [
            self._fit(gram - g, target - t) for g, t in zip(self._part_gram, self._part_target, strict=True)
        ]

    def _fit(self, gram: Floats, target: Floats, *, leaning: bool = True) -> Fit:
        """Values from sums of products, `leaning` on the prior where there is one."""
        s = self._scale
        gram, target = gram.copy(), target.copy()
        if self.prior is not None and leaning:
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
        if not self.extra:
            return known
        base = np.concatenate([known.base, self._cross(columns, self._beside())], axis=2)
        return Products(base, known.own, known.target, self.parts)

    def _beside(self) -> dict[Key, Floats]:
        """All further columns side by side, padded, by key."""
        if self._joined is None:
            width = sum(_width(rows) for rows in self.extra)
            self._joined = {}
            place = 0
            for rows in self.extra:
                for key, values in self._known[id(rows)][1].items():
                    if key not in self._joined:
                        self._joined[key] = np.zeros((*values.shape[:2], width))
                    self._joined[key][:, :, place : place + values.shape[2]] = values
                place += _width(rows)
        return self._joined

    def replace(self, extra: Sequence[Rows]) -> None:
        """Let the base be followed by these columns."""
        self.extra = list(extra)
        self._joined = None
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
            base[:, :, self._acting[key]] += np.matmul(turned, self._columns[key])
            own += np.matmul(turned, matrix)
            target += np.matmul(turned, self._targets[key])[:, :, 0]
        return Products(base, own, target, self.parts)

    # ---- scores ----

    def score(
        self,
        columns: Mapping[Key, Floats],
        *,
        ridge: float = 0.0,
        pull: float = 0.0,
        known: Products | None = None,
    ) -> Score:
        """Score of padded columns.

        ridge : pull towards zero, in units of the columns' mean square, for groups of many columns. pull : precision
        with which coefficients are known to be 1, for what is held against parts of the motion: what acts in a few
        moments only is hardly there without one of them. known : their products with the base alone, to save time.
        """
        products = self.products(columns, known)
        return self.score_products(products, list(columns), ridge=ridge, pull=pull)

    def score_products(
        self, products: Products, keys: Sequence[Key], *, ridge: float = 0.0, pull: float = 0.0
    ) -> Score:
        """Score of columns in the rows of `keys` from their products with all present columns."""
        base, own, target = products.sums
        whole = base.sum(axis=0), own.sum(axis=0), target.sum(axis=0)
        lever, inner, reach = _schur(whole, self.full, ridge)
        k = products.own.shape[1]
        if inner is None:
            return Score(-np.inf, 0.0, np.zeros(k), 0.0, lambda: (np.eye(k), 0), 1.0)
        coefficients = inner @ reach
        fitted = float(reach @ coefficients)
        gain = fitted
        if fitted > _NOTHING:
            gain = 0.0
            pulled = whole[0], whole[1] + pull * np.eye(k), whole[2] + pull
            for part, fit in enumerate(self._held):
                mine = base[part], own[part], target[part]
                rest = pulled[0] - mine[0], pulled[1] - mine[1], pulled[2] - mine[2]
                gain += self._held_gain(mine, rest, fit, part, ridge)
        rows = sum(float(self.mask[key].sum()) / self.dilution[key[0]][key[1]] for key in keys)
        if self.prior is not None and self.compared and fitted > _NOTHING:
            gain += self._strain(self.full.values) - self._strain(self.full.values - lever @ coefficients)
        # Held-back error can also fall because a base fitted without the part was poor: never more than that.
        gain = min(gain, fitted)
        if self._free is not None and self._absorbed(whole[0], whole[1]):
            gain = min(gain, 0.0)
        values, gram, torque = self.full.values - lever @ coefficients, self.gram, self.target
        return Score(
            gain,
            fitted,
            coefficients,
            gain / max(rows, 1.0),
            lambda: _robust(products, gram, torque, values, lever, inner, coefficients),
        )

    def _absorbed(self, base: Floats, own: Floats) -> bool:
        """Whether base parameters that do not lean on the drawing explain the columns: such a cause could only
        make up for a wrong drawing."""
        assert self._free is not None
        left = np.diag(own) - np.einsum("kp,pq,kq->k", base, self._free.inverse, base)
        return bool(np.all(left < _OWN_SHARE * np.diag(own)))

    def event_score(self, score: Score, choices: int) -> Score:
        """A score of columns that are active in a few blocks only, the best of `choices`: the fall
        on the rows
        fitted, less what the best of so many would fall by chance.
        """
        k = len(score.coefficients)
        penalty = 2.0 * np.log(max(choices, 1)) + 4.0 * k
        p = float(min(1.0, choices * chi_square_tail(score.fitted, k)))
        gain = score.fitted - penalty if np.isfinite(score.gain) else -np.inf
        return replace(score, gain=gain, chance=p)

    def _held_gain(
        self,
        mine: tuple[Floats, Floats, Floats],
        rest: tuple[Floats, Floats, Floats],
        fit: Fit,
        part: int,
        ridge: float,
    ) -> float:
        """Fall of the chi-square on a part of the motion, the columns fitted on the rest."""
        lever, inner, reach = _schur(rest, fit, ridge)
        if inner is None:
            return 0.0
        c = inner @ reach
        change = -(lever @ c)
        gram, (cross, own, target) = self._part_gram[part], mine
        base_reach = self._part_target[part] - gram @ fit.values
        own_reach = target - cross @ fit.values
        linear = 2.0 * (change @ base_reach + c @ own_reach)
        square = change @ gram @ change + 2.0 * (c @ cross @ change) + c @ own @ c
        return float(linear - square)

    def _strain(self, values: Floats) -> float:
        """Chi-square of base parameters against the reference."""
        if self.prior is None:
            return 0.0
        difference = values[: self.base_count] - self.prior[1]
        return float(difference @ self.prior[0] @ difference)

    # ---- results of a fit ----

    def block_of(self, side: str) -> Floats:
        """Number (m,) of the block of each row of a side, -1 for rows that are never fitted."""
        return self._place[side][0].astype(float)

    def residuals(self, *, test: bool = False) -> dict[str, Floats]:
        """Residual (m, n) by side with the present columns, NaN where a row is not used; `test`: the rows
        never fitted instead."""
        found = {}
        for side, rows in self.nominal.rows.items():
            keep = rows.valid & (rows.test if test else ~rows.test)[:, None]
            keep &= np.array([self.mask[side, j].any() for j in range(rows.target.shape[1])])
            predicted = self.predicted(side, self.full.values)
            found[side] = np.where(keep, rows.target - predicted, np.nan)
        return found

    def held_residuals(self) -> dict[str, Floats]:
        """Residual (m, n) by side of each part of the motion as predicted from the others."""
        found = {}
        for side, rows in self.nominal.rows.items():
            out = np.full(rows.target.shape, np.nan)
            for part, fit in zip(self.parts, self._held, strict=True):
                mine = (part > 0.0)[self._place[side][0]]
                out[mine] = rows.target[mine] - self.predicted(side, fit.values, mine)
            found[side] = np.where(rows.valid & ~rows.test[:, None], out, np.nan)
        return found

    def predicted(self, side: str, values: Floats, mine: NDArray[np.bool_] | None = None) -> Floats:
        """Torques (rows, n) [Nm] of the rows `mine` (m,), default all, with values (P,) of the present columns."""
        mine = np.ones(len(self.nominal.rows[side].time), dtype=bool) if mine is None else mine
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
        # Columns that nothing excites leave a variance of nothing, on either side of zero by rounding.
        np.fill_diagonal(sandwich, np.maximum(np.diag(sandwich), 0.0))
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


def _sums(parts: Floats, values: Floats) -> Floats:
    """Sums (parts, k, l) of values (blocks, k, l) over the blocks of each part."""
    return (parts @ values.reshape(len(values), -1)).reshape(len(parts), *values.shape[1:])


def _schur(
    products: tuple[Floats, Floats, Floats], fit: Fit, ridge: float
) -> tuple[Floats, Floats | None, Floats]:
    """Image in the base (P, k), inverse of the Schur complement (k, k), and product with the residual (k,) of
    columns with the products base (k, P), own (k, k) and target (k,)."""
    cross, own, target = products
    lever = fit.inverse @ cross.T
    inner = own - cross @ lever
    size = np.diag(own).copy()
    # A column that the base explains to a millionth has nothing of its own to say.
    if np.any(size <= 0.0) or np.any(np.diag(inner) < 1e-7 * size):
        return lever, None, np.zeros(len(own))
    inner = inner + ridge * np.diag(size)
    root = np.sqrt(np.diag(inner))
    scaled = inner / np.outer(root, root)
    if len(own) > 1 and np.linalg.eigvalsh(scaled)[0] < 1e-9:
        return lever, None, np.zeros(len(own))
    return lever, np.linalg.inv(scaled) / np.outer(root, root), target - cross @ fit.values


def _robust(
    products: Products,
    gram: Floats,
    target: Floats,
    values: Floats,
    lever: Floats,
    inner: Floats,
    coefficients: Floats,
) -> tuple[Floats, int]:
    """Covariance from blocks, at least that of independent rows; and the number of blocks that carry it."""
    own = products.target - products.base @ values - products.own @ coefficients
    base = target - gram @ values - np.einsum("bkp,k->bp", products.base, coefficients)
    scores = own - base @ lever
    size = np.einsum("bkk->b", products.own)
    active = int(np.sum(size > 1e-3 * size.max(initial=0.0)))
    factor = active / max(active - 1, 1)
    middle = factor * scores.T @ scores
    sandwich = inner @ middle @ inner
    floor = np.sqrt(np.maximum(np.diag(inner), 0.0) / np.maximum(np.diag(sandwich), 1e-300))
    widen = np.maximum(floor, 1.0)
    return sandwich * np.outer(widen, widen), active


def _wald(coefficients: Floats, covariance: Floats, active: int) -> float:
    k = len(coefficients)
    try:
        value = float(coefficients @ np.linalg.solve(covariance, coefficients))
    except np.linalg.LinAlgError:
        return 1.0
    return fisher_tail(value / k, k, max(active - k, 1))
