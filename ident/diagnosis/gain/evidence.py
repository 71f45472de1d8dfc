"""Evidence for columns beyond the base: held-back gain and significance from Gram matrices of blocks.

Rows of all joints and sides are cut into blocks of time; of each block only products of columns are kept. A fit
without a part of the motion, its error on that part and the covariance from blocks are then linear algebra of small
matrices: Schur complements on the base. The held-back parts are the same phases of every period, so a repeating
motion never checks itself.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray

from ident.diagnosis.gain.fitted_rows import FittedRows
from ident.diagnosis.gain.products import (
    Fit,
    Floats,
    Key,
    Products,
    Rows,
    Sums,
    add_own_products,
    add_products,
    block_sums,
    inverse_of,
    left_beside,
    scale_of,
    schur,
    width_of,
)
from ident.diagnosis.gain.score import Score, widened
from ident.diagnosis.rows.nominal import Nominal
from ident.diagnosis.settings import DiagnosisSettings
from ident.estimators.estimate import chi_square_tail
from ident.estimators.physical import lacking_bodies

# Least share of a column's power left by base parameters without the prior, where the prior is a drawing.
_OWN_SHARE = 3e-3

# Share of the information on an accepted column that holds it at its value where a part of the motion is held back:
# what a few moments alone tell has no value without them, and one from their edges would be all error there.
_KEPT = 0.01

# A fall of the chi-square up to this is no evidence, whatever its value on the held-back parts.
_NO_EVIDENCE = 12.0

_Columns = Mapping[Key, Floats] | Callable[[], Mapping[Key, Floats]]


class Evidence:
    """Block products of the base and of accepted columns.

    sigma : noise of a row [Nm] by side, (n,). variance_inflation : by side, (n,), of correlated noise.
    prior : precision (p, p) and values (p,) of the base parameters, from a reference. Where they are `compared`,
    causes otherwise absorbed by the base parameters show as well.
    floor : repeatability of a row [Nm] by side, (n,); default sigma. fitted_rows : of the arm, made with another noise.
    """

    def __init__(
        self,
        nominal: Nominal,
        settings: DiagnosisSettings,
        sigma: Mapping[str, Floats],
        variance_inflation: Mapping[str, Floats],
        prior: tuple[Floats, Floats] | None = None,
        *,
        compared: bool = True,
        floor: Mapping[str, Floats] | None = None,
        fitted_rows: FittedRows | None = None,
    ) -> None:
        self.settings, self.prior, self.compared = settings, prior, compared
        self.floor = dict(sigma if floor is None else floor)
        self.nominal = nominal
        self.sigma = {side: np.array(value) for side, value in sigma.items()}
        self.variance_inflation = {side: np.array(value) for side, value in variance_inflation.items()}
        self.fitted_rows = fitted = fitted_rows or FittedRows(nominal, settings)
        self.blocks, self.block_session, self.block_start = (
            fitted.blocks,
            fitted.block_session,
            fitted.block_start,
        )
        self.fold, self.parts = fitted.fold, fitted.parts
        self._block, self._order, self._starts = fitted.block, fitted.order, fitted.starts
        self.mask = {key: own.mask for key, own in fitted.keys.items()}
        self._weights: dict[Key, float] = {}
        self._independent: dict[Key, float] = {}
        for (side, j), own in fitted.keys.items():
            inflation = float(self.variance_inflation[side][j])
            self._weights[side, j] = 1.0 / (float(self.sigma[side][j]) ** 2 * inflation)
            self._independent[side, j] = own.count / inflation
        self.base_count = len(nominal.base)
        self.extra: list[Rows] = []
        self._known: dict[int, tuple[Rows, dict[Key, Floats], Products]] = {}
        self._joined: dict[tuple[int, ...], dict[Key, Floats]] = {}
        self._kept_held: tuple[Fit, Floats] | None = None
        self._kept_free: Fit | None = None
        self._base_products()
        self._gram()

    # ---- products ----

    def _base_products(self) -> None:
        p = self.base_count
        self._base_gram = np.zeros((self.blocks, p, p))
        self._base_target = np.zeros((self.blocks, p))
        self.energy = np.zeros(self.blocks)
        for key, own in self.fitted_rows.keys.items():
            weight, on = self._weights[key], own.acting
            self.energy += weight * own.energy
            self._base_gram[:, on[:, None], on] += weight * own.gram
            self._base_target[:, on] += weight * own.moment

    def _places(self) -> Iterator[tuple[slice, Rows]]:
        """The further columns with their places behind the base."""
        place = self.base_count
        for rows in self.extra:
            yield slice(place, place + width_of(rows)), rows
            place += width_of(rows)

    def coefficients(self) -> list[Floats]:
        """Values (k,) of each group of further columns in the full fit."""
        return [self.full.values[place].copy() for place, _ in self._places()]

    def _gram(self) -> None:
        """Products of base and further columns, and their fit."""
        p = self.base_count
        size = p + sum(width_of(rows) for rows in self.extra)
        self.gram, self.target = np.zeros((self.blocks, size, size)), np.zeros((self.blocks, size))
        self.gram[:, :p, :p], self.target[:, :p] = self._base_gram, self._base_target
        wide: dict[Key, list[Floats]] = {}
        places: dict[Key, list[NDArray[np.int64]]] = {}
        for here, rows in self._places():
            _, padded, products = self._known[id(rows)]
            self.gram[:, here, :p] = products.base
            self.gram[:, :p, here] = products.base.transpose(0, 2, 1)
            self.target[:, here] = products.target
            for key, columns in padded.items():
                wide.setdefault(key, []).append(columns)
                places.setdefault(key, []).append(np.arange(here.start, here.stop))
        # In a fixed order: the last digits of a sum depend on it.
        for key in sorted(wide):
            columns, on = np.concatenate(wide[key], axis=1), np.concatenate(places[key])
            add_own_products(columns, self._starts[key[0]], self._weights[key], on, self.gram)
        self._scale = scale_of(np.einsum("bii->i", self.gram))
        self._part_gram, self._part_target = block_sums(self.parts, self.gram), self.parts @ self.target
        self.full = self._fit(self._part_gram.sum(axis=0), self._part_target.sum(axis=0))
        self._kept_held, self._kept_free = None, None

    # Where columns are only tried, these two are not asked for.

    @property
    def _held(self) -> tuple[Fit, Floats]:
        """Fits (parts, ...) without each part of the motion, the further columns held near their values, see `_KEPT`,
        and the products (parts, P) of the columns with what they leave of its torques."""
        if self._kept_held is None:
            gram, target = self._part_gram, self._part_target
            p, pulls = self.base_count, np.zeros(len(self._scale))
            variances = np.diag(self.full.inverse)[p:]
            # A column of zeros has none, and nothing to keep.
            np.divide(_KEPT, variances, out=pulls[p:], where=variances > 0.0)
            fits = [
                self._fit(g, t, pulls=pulls, towards=self.full.values)
                for g, t in zip(gram.sum(axis=0) - gram, target.sum(axis=0) - target, strict=True)
            ]
            held = Fit(np.array([fit.values for fit in fits]), np.array([fit.inverse for fit in fits]))
            self._kept_held = held, target - (gram @ held.values[:, :, None])[:, :, 0]
        return self._kept_held

    @property
    def _free(self) -> Fit | None:
        """The fit without the prior where that is the arm's drawing, else None."""
        if self.drawn and self._kept_free is None:
            gram, target = self._part_gram.sum(axis=0), self._part_target.sum(axis=0)
            self._kept_free = self._fit(gram, target, with_prior=False)
        return self._kept_free

    @property
    def drawn(self) -> bool:
        """Whether the prior is the arm's drawing, and not a healthy arm or the bounds of its friction alone."""
        known = self.prior is not None and not self.compared
        return known and not lacking_bodies(self.nominal.structure.chain)

    def _fit(
        self,
        gram: Floats,
        target: Floats,
        *,
        with_prior: bool = True,
        pulls: Floats | None = None,
        towards: Floats | None = None,
    ) -> Fit:
        """Values from sums of products, `with_prior` if there is one; pulls : (P,) precision of columns around the
        values `towards` (P,), default zero."""
        s = self._scale
        gram, target = gram.copy(), target.copy()
        if pulls is not None:
            gram[np.diag_indices_from(gram)] += pulls
            target += 0.0 if towards is None else pulls * towards
        if self.prior is not None and with_prior:
            p = self.base_count
            gram[:p, :p] += self.prior[0]
            target[:p] += self.prior[0] @ self.prior[1]
        inverse = inverse_of(gram, s)
        return Fit(inverse @ target, inverse)

    def padded(self, rows: Rows) -> dict[Key, Floats]:
        """Columns (r, k) in the order of the blocks, zero in unused rows."""
        return {key: values[self._order[key[0]]] * self.mask[key] for key, values in rows.items()}

    def products(self, columns: _Columns, known: Products | None = None) -> Products:
        """Products in each block of padded columns (r, k), or of those that a function makes on demand; `known` : those
        with the base alone, which remember the ones with further columns."""
        known = self.alone(_made(columns)) if known is None else known
        if not self.extra:
            return known
        missing = [rows for rows in self.extra if id(rows) not in known.crossed]
        if missing:
            sums, place = block_sums(self.parts, self._cross(_made(columns), self._together(missing))), 0
            for rows in missing:
                known.crossed[id(rows)] = sums[:, :, place : place + width_of(rows)]
                place += width_of(rows)
        further = partial(self._further, columns, self.extra)
        sums = np.concatenate([known.crossed[id(rows)] for rows in self.extra], axis=2)
        return replace(known, further=further, further_sums=sums, plain=known)

    def _further(self, columns: _Columns, groups: Sequence[Rows]) -> Floats:
        """Products (blocks, k, w) of padded columns with groups of further columns."""
        return self._cross(_made(columns), self._together(groups))

    def _together(self, groups: Sequence[Rows]) -> dict[Key, Floats]:
        """Groups of further columns side by side, padded, by key."""
        names = tuple(map(id, groups))
        if names not in self._joined:
            joined, size, place = dict[Key, Floats](), sum(map(width_of, groups)), 0
            for rows in groups:
                for key, values in self._known[id(rows)][1].items():
                    wide = joined.setdefault(key, np.zeros((len(values), size)))
                    wide[:, place : place + width_of(rows)] = values
                place += width_of(rows)
            self._joined[names] = joined
        return self._joined[names]

    def replace(self, extra: Sequence[Rows]) -> None:
        """Replace the columns beyond the base."""
        if [*map(id, extra)] == [*map(id, self.extra)]:
            return
        self.extra = list(extra)
        self._joined.clear()
        for rows in self.extra:
            if id(rows) not in self._known:
                padded = self.padded(rows)
                # The rows are kept too, so that their identity stays theirs.
                self._known[id(rows)] = (rows, padded, self.alone(padded))
        self._gram()

    @contextmanager
    def beside(self, extra: Sequence[Rows]) -> Iterator[None]:
        """Other columns beyond the base for a while, in place of the present ones."""
        present = self.extra
        self.replace(extra)
        try:
            yield
        finally:
            self.replace(present)

    def _cross(self, a: Mapping[Key, Floats], b: Mapping[Key, Floats]) -> Floats:
        """Products (blocks, k, l) of two groups of padded columns."""
        k, width = (width_of(a), width_of(b)) if b else (0, 0)
        total, places = np.zeros((self.blocks, k, width)), np.arange(width)
        # In a fixed order: the last digits of a sum depend on it.
        for key in sorted(a.keys() & b.keys()):
            add_products(a[key], b[key], self._starts[key[0]], self._weights[key], places, total)
        return total

    def alone(self, columns: Mapping[Key, Floats]) -> Products:
        """Products of padded columns with the base, themselves and the torques."""
        width = width_of(columns)
        base = np.zeros((self.blocks, width, self.base_count))
        own = np.zeros((self.blocks, width, width))
        target = np.zeros((self.blocks, width, 1))
        places = np.arange(width)
        for key, wide in columns.items():
            starts, weight = self._starts[key[0]], self._weights[key]
            fitted = self.fitted_rows.keys[key]
            add_products(wide, fitted.columns, starts, weight, fitted.acting, base)
            add_own_products(wide, starts, weight, places, own)
            add_products(wide, fitted.target, starts, weight, places[:1], target)
        return Products(base, own, target[:, :, 0], self.parts)

    def information(self, products: Products) -> float:
        """Mean fall of the chi-square for a unit of a group's coefficients beside the base parameters alone."""
        left = left_beside(products.alone.sum(axis=0), products.own.sum(axis=0), self._base_inverse)
        return float(np.mean(np.maximum(left, 0.0)))

    @cached_property
    def _base_inverse(self) -> Floats:
        """Inverse (p, p) of the base's products, with the prior."""
        gram = self._base_gram.sum(axis=0)
        if self.prior is not None:
            gram = gram + self.prior[0]
        return inverse_of(gram, scale_of(np.diag(gram)))

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
        of coefficients known to be 1, for the parts held back: an effect of a few moments hardly exists without one
        of them.
        known : their products with the base alone, to save time.
        """
        products = self.products(columns, known)
        return self.score_products([products], [list(columns)], ridge=ridge, pull=pull)[0]

    def score_groups(self, groups: Sequence[tuple[Rows, Products]], *, pull: float = 0.0) -> list[Score]:
        """Scores of groups of rows, each with its products with the base alone; those of as many columns together."""
        some = [self.products(partial(self.padded, rows), known) for rows, known in groups]
        found: dict[int, Score] = {}
        for size in {one.own.shape[1] for one in some}:
            alike = [k for k, one in enumerate(some) if one.own.shape[1] == size]
            keys = [list(groups[k][0]) for k in alike]
            found |= zip(alike, self.score_products([some[k] for k in alike], keys, pull=pull), strict=True)
        return [found[k] for k in range(len(some))]

    def score_products(
        self,
        groups: Sequence[Products],
        keys: Sequence[Sequence[Key]],
        *,
        ridge: float = 0.0,
        pull: float = 0.0,
    ) -> list[Score]:
        """Scores of groups of k columns each in the rows of their `keys`, from their products with all present ones."""
        base, own, target = (np.stack(of) for of in zip(*(one.sums for one in groups), strict=True))
        whole = base.sum(axis=1), own.sum(axis=1), target.sum(axis=1)
        projection, inner, moment, sound = schur(whole, self.full, ridge)
        k = own.shape[-1]
        coefficients = (inner @ moment[..., None])[..., 0]
        fitted = np.einsum("mk,mk->m", moment, coefficients)
        gain = fitted.copy()
        held = np.flatnonzero(sound & (fitted > _NO_EVIDENCE))
        if len(held):
            mine = base[held], own[held], target[held]
            sums = whole[0][held, None], whole[1][held, None] + pull * np.eye(k), whole[2][held, None] + pull
            rest = sums[0] - mine[0], sums[1] - mine[1], sums[2] - mine[2]
            gain[held] = self._held_gain(mine, rest, ridge)
        found, free = [], self._free
        for m, (products, of) in enumerate(zip(groups, keys, strict=True)):
            if not sound[m]:
                found.append(Score(-np.inf, 0.0, np.zeros(k), 0.0, lambda: (np.eye(k), 0), 1.0))
                continue
            values = self.full.values - projection[m] @ coefficients[m]
            most = float(gain[m])
            if self.prior is not None and self.compared and fitted[m] > _NO_EVIDENCE:
                most += self._prior_penalty(self.full.values) - self._prior_penalty(values)
            # Held-back error can also fall after a poor fit of the base without the part: never more than the
            # fitted gain.
            most = min(most, float(fitted[m]))
            if free is not None:
                # A cause explained by base parameters without the prior could only make up for a wrong drawing.
                left = left_beside(whole[0][m], whole[1][m], free.inverse)
                most = min(most, 0.0) if np.all(left < _OWN_SHARE * np.diag(whole[1][m])) else most
            rows = sum(self._independent[key] for key in of)
            robust = self._robust(products, values, coefficients[m], projection[m], inner[m])
            inflation = most / max(rows, 1.0)
            found.append(Score(most, float(fitted[m]), coefficients[m], inflation, robust))
        return found

    def _robust(
        self, products: Products, values: Floats, coefficients: Floats, projection: Floats, inner: Floats
    ) -> Callable[[], tuple[Floats, int]]:
        """Covariance (k, k) of coefficients (k,) from the blocks and the number of these, on demand."""
        gram, torque = self.gram, self.target

        def robust() -> tuple[Floats, int]:
            own = products.target - products.base @ values - products.own @ coefficients
            left = torque - gram @ values - np.einsum("bkp,k->bp", products.base, coefficients)
            scores = own - left @ projection
            size = np.einsum("bkk->b", products.own)
            active = int(np.sum(size > 1e-3 * size.max(initial=0.0)))
            middle = active / max(active - 1, 1) * scores.T @ scores
            return widened(inner @ middle @ inner, inner), active

        return robust

    def setting_in(self, products: Products, lasting: NDArray[np.int64]) -> Floats:
        """Fall (blocks,) of the chi-square on the fitted rows by columns that set in at the start of each block, and
        act until the end of its session and in those of the later sessions where they are `lasting`."""
        each = products.base, products.own, products.target
        sums = np.empty_like(each[0]), np.empty_like(each[1]), np.empty_like(each[2])
        later = [np.zeros(values.shape[1:]) for values in each]
        for session in np.unique(self.block_session)[::-1]:
            mine = np.flatnonzero(self.block_session == session)
            mine = mine[np.argsort(-self.block_start[mine])]
            for k, values in enumerate(each):
                sums[k][mine] = np.cumsum(values[mine], axis=0)
                whole = sums[k][mine[-1]].copy()
                sums[k][mine] += later[k]
                later[k] += whole * (session in lasting)
        _, inner, moment, _ = schur(sums, self.full, 0.0)
        return np.asarray(np.einsum("mk,mkl,ml->m", moment, inner, moment))

    def after(self, block: int, lasting: NDArray[np.int64]) -> Floats:
        """1 in the blocks (blocks,) of columns that set in at the start of one, see `setting_in`; 0 in the others."""
        session = self.block_session[block]
        on = (self.block_session == session) & (self.block_start >= self.block_start[block])
        on |= (self.block_session > session) & np.isin(self.block_session, lasting)
        return on.astype(float)

    def event_score(self, score: Score, choices: int) -> Score:
        """Score of columns active in a few blocks, the best of `choices`: the fall on the fitted rows less its
        expectation for the best of so many by chance."""
        k = len(score.coefficients)
        penalty = 2.0 * np.log(max(choices, 1)) + 4.0 * k
        p = float(min(1.0, choices * chi_square_tail(score.fitted, k)))
        gain = score.fitted - penalty if np.isfinite(score.gain) else -np.inf
        return replace(score, gain=gain, chance=p)

    def _held_gain(self, mine: Sums, rest: Sums, ridge: float) -> Floats:
        """Fall (m,) of the chi-square on each part of the motion, the columns of each of m groups fitted on the rest;
        the sum of all parts."""
        held, left = self._held
        projection, inner, moment, _ = schur(rest, held, ridge)
        cross, own, target = mine
        c = inner @ moment[..., None]
        change = -(projection @ c)
        own_moment = target[..., None] - cross @ held.values[..., None]
        square = change * (self._part_gram @ change - 2.0 * left[..., None])
        square_own = c * (2.0 * (cross @ change) + own @ c - 2.0 * own_moment)
        return np.asarray(-square.sum(axis=(1, 2, 3)) - square_own.sum(axis=(1, 2, 3)))

    def _prior_penalty(self, values: Floats) -> float:
        if self.prior is None:
            return 0.0
        difference = values[: self.base_count] - self.prior[1]
        return float(difference @ self.prior[0] @ difference)

    # ---- results of a fit ----

    def block_of(self, side: str) -> NDArray[np.int64]:
        """Number (m,) of the block of each row of a side, -1 for held-out rows."""
        return self._block[side]

    def residuals(self, *, test: bool = False) -> dict[str, Floats]:
        """Residual (m, n) by side with the present columns, NaN in unused rows; `test` : of held-out rows instead."""
        found = {}
        for side, rows in self.nominal.rows.items():
            keep = rows.valid & (rows.test if test else ~rows.test)[:, None]
            keep &= np.array([self.mask[side, j].any() for j in range(rows.target.shape[1])])
            predicted = self.predicted(side, self.full.values)
            found[side] = np.where(keep, rows.target - predicted, np.nan)
        return found

    def held_residuals(self) -> dict[str, Floats]:
        """Residual (m, n) by side of each part of the motion, predicted from the others."""
        found = {}
        for side, rows in self.nominal.rows.items():
            out = np.full(rows.target.shape, np.nan)
            for part, values in zip(self.parts, self._held[0].values, strict=True):
                mine = (part > 0.0)[self._block[side]]
                out[mine] = rows.target[mine] - self.predicted(side, values, mine)
            found[side] = np.where(rows.valid & ~rows.test[:, None], out, np.nan)
        return found

    def predicted(self, side: str, values: Floats, mine: NDArray[np.bool_] | None = None) -> Floats:
        """Torques (rows, n) [Nm] of the rows `mine` (m,), default all, with values (P,) of the present columns."""
        p, some = self.base_count, slice(None) if mine is None else mine
        predicted = np.stack([table[some] @ values[:p] for table in self.nominal.rows[side].matrix], axis=1)
        for here, rows in self._places():
            for (of_side, j), columns in rows.items():
                if of_side == side:
                    predicted[:, j] += columns[some] @ values[here]
        return predicted

    def covariance(self, fit: Fit | None = None) -> Floats:
        """Covariance (P, P) of all present columns in a fit, default the full one, from blocks, at least that of
        independent rows."""
        fit = fit or self.full
        scores = self.target - self.gram @ fit.values
        # A product with its own transpose keeps every variance above zero by rounding, and every correlation below one.
        moved = np.sqrt(self.blocks / max(self.blocks - 1, 1)) * scores @ fit.inverse
        sandwich = moved.T @ moved
        return widened(sandwich, fit.inverse)

    def free(self, around_zero: Sequence[Rows] = (), std: float = 0.0) -> tuple[Floats, Floats]:
        """Base parameters (p,) by these sessions alone, without the prior, and their covariance (p, p).

        around_zero : groups of the present columns whose coefficients have the mean zero and the standard deviation
        `std`.
        """
        pulls = np.zeros(len(self._scale))
        known = {id(rows) for rows in around_zero}
        for place, rows in self._places():
            if id(rows) in known:
                pulls[place] = std**-2.0
        gram, target = self._part_gram.sum(axis=0), self._part_target.sum(axis=0)
        fit = self._fit(gram, target, with_prior=False, pulls=pulls)
        p = self.base_count
        uncertain = (fit.inverse * pulls) @ fit.inverse
        return fit.values[:p], (self.covariance(fit) + uncertain)[:p, :p]

    def free_inverse(self) -> Floats:
        """Inverse (p, p) of the base's products without the prior: times those of a column, the change of the base
        parameters that takes it up."""
        gram = self._base_gram.sum(axis=0)
        return inverse_of(gram, self._scale[: self.base_count])

    @property
    def chi_square(self) -> float:
        """Sum of squares of all fitted rows, in units of their noise."""
        v = self.full.values
        return float(self.energy.sum() - 2.0 * v @ self.target.sum(axis=0) + v @ self.gram.sum(axis=0) @ v)


def _made(columns: _Columns) -> Mapping[Key, Floats]:
    return columns() if callable(columns) else columns
