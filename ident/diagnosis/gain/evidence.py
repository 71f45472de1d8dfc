"""Evidence for columns beyond the base: held-back gain and significance from products in blocks.

Rows of all joints and sides are cut into blocks of time; of each block only products of columns are kept. A fit
without a part of the motion, its error on that part and the covariance from blocks are then linear algebra of small
matrices: Schur complements on the base. The held-back parts are the same phases of every period, so a repeating
motion never checks itself.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ident.diagnosis.gain.block_products import BlockProducts
from ident.diagnosis.gain.fitted_rows import FittedRows
from ident.diagnosis.gain.products import (
    Beside,
    Fit,
    Floats,
    Key,
    Products,
    Rows,
    Sums,
    inverse_of,
    left_beside,
    scale_of,
    schur,
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


class Evidence:
    """Fit of the base and of accepted columns, and scores of further ones beside it.

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
        weights: dict[Key, float] = {}
        self._independent: dict[Key, float] = {}
        for (side, j), own in fitted.keys.items():
            inflation = float(self.variance_inflation[side][j])
            weights[side, j] = 1.0 / (float(self.sigma[side][j]) ** 2 * inflation)
            self._independent[side, j] = own.count / inflation
        self.base_count = len(nominal.base)
        self.products = BlockProducts(fitted, weights, self.base_count)
        self.mask = self.products.mask
        self._kept_held: tuple[Fit, Floats] | None = None
        self._kept_free: Fit | None = None
        self._fit_present()

    # ---- columns beyond the base ----

    @property
    def extra(self) -> list[Rows]:
        """The columns beyond the base."""
        return [group.rows for group in self.products.present]

    @property
    def beside_what(self) -> tuple[int, ...]:
        """Numbers of the groups of columns beyond the base, of no other groups before or after."""
        return tuple(group.number for group in self.products.present)

    def replace(self, extra: Sequence[Rows]) -> None:
        """Replace the columns beyond the base."""
        if self.products.replace(extra):
            self._fit_present()

    @contextmanager
    def beside(self, extra: Sequence[Rows]) -> Iterator[None]:
        """Other columns beyond the base for a while, in place of the present ones."""
        present = self.extra
        self.replace(extra)
        try:
            yield
        finally:
            self.replace(present)

    def coefficients(self) -> list[Floats]:
        """Values (k,) of each group of further columns in the full fit."""
        return [self.full.values[place].copy() for place, _ in self.products.places()]

    def _fit_present(self) -> None:
        """Sums of the products of base and further columns, and their fit."""
        self._part_gram, self._part_target = self.products.of_parts()
        self._scale = scale_of(np.einsum("pii->i", self._part_gram))
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

    def information(self, products: Products) -> float:
        """Mean fall of the chi-square for a unit of a group's coefficients beside the base parameters alone."""
        base, own, _ = products.sums
        left = left_beside(base.sum(axis=0), own.sum(axis=0), self._base_inverse)
        return float(np.mean(np.maximum(left, 0.0)))

    @cached_property
    def _base_inverse(self) -> Floats:
        """Inverse (p, p) of the base's products, with the prior."""
        gram = self.products.base_sums[0].sum(axis=0)
        if self.prior is not None:
            gram = gram + self.prior[0]
        return inverse_of(gram, scale_of(np.diag(gram)))

    # ---- scores ----

    def score(
        self, rows: Rows, *, ridge: float = 0.0, pull: float = 0.0, known: Products | None = None
    ) -> Score:
        """Score of columns.

        ridge : pull towards zero, in units of the columns' mean square, for groups of many columns. pull : precision
        of coefficients known to be 1, for the parts held back: an effect of a few moments hardly exists without one
        of them. known : their products with the base alone, to save time.
        """
        products = self.products.beside(rows, known)
        return self.score_products([products], [list(rows)], ridge=ridge, pull=pull)[0]

    def score_groups(
        self, groups: Sequence[tuple[Rows, Products]], *, ridge: float = 0.0, pull: float = 0.0
    ) -> list[Score]:
        """Scores of groups of columns, each with its products with the base alone; those of as many columns
        together."""
        some = [self.products.beside(rows, known) for rows, known in groups]
        found: dict[int, Score] = {}
        for size in {one.known.own.shape[1] for one in some}:
            alike = [k for k, one in enumerate(some) if one.known.own.shape[1] == size]
            keys = [list(groups[k][0]) for k in alike]
            scores = self.score_products([some[k] for k in alike], keys, ridge=ridge, pull=pull)
            found |= zip(alike, scores, strict=True)
        return [found[k] for k in range(len(some))]

    def score_products(
        self,
        groups: Sequence[Beside],
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
        self, products: Beside, values: Floats, coefficients: Floats, projection: Floats, inner: Floats
    ) -> Callable[[], tuple[Floats, int]]:
        """Covariance (k, k) of coefficients (k,) from the blocks and the number of these, on demand."""
        groups = self.products.present

        def robust() -> tuple[Floats, int]:
            own, left = self.products.left_with(products, coefficients, groups, values)
            scores = own - left @ projection
            size = np.einsum("bkk->b", products.known.own)
            size = size if products.on is None else products.on * size
            active = int(np.sum(size > 1e-3 * size.max(initial=0.0)))
            middle = active / max(active - 1, 1) * scores.T @ scores
            return widened(inner @ middle @ inner, inner), active

        return robust

    def setting_in(self, products: Beside, base: Floats, lasting: NDArray[np.int64]) -> Floats:
        """Fall (blocks,) of the chi-square on the fitted rows by columns that set in at the start of each block, and
        act until the end of its session and in those of the later sessions where they are `lasting`. base : from
        `in_blocks`."""
        each = base, products.known.own, products.known.target
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
        return self.fitted_rows.block[side]

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
                mine = (part > 0.0)[self.fitted_rows.block[side]]
                out[mine] = rows.target[mine] - self.predicted(side, values, mine)
            found[side] = np.where(rows.valid & ~rows.test[:, None], out, np.nan)
        return found

    def predicted(self, side: str, values: Floats, mine: NDArray[np.bool_] | None = None) -> Floats:
        """Torques (rows, n) [Nm] of the rows `mine` (m,), default all, with values (P,) of the present columns."""
        p, some = self.base_count, slice(None) if mine is None else mine
        predicted = np.stack([table[some] @ values[:p] for table in self.nominal.rows[side].matrix], axis=1)
        for here, group in self.products.places():
            for (of_side, j), columns in group.rows.items():
                if of_side == side:
                    predicted[:, j] += columns[some] @ values[here]
        return predicted

    def covariance(self, fit: Fit | None = None) -> Floats:
        """Covariance (P, P) of all present columns in a fit, default the full one, from blocks, at least that of
        independent rows."""
        fit = fit or self.full
        scores = self.products.left(fit.values)
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
        for place, group in self.products.places():
            if id(group.rows) in known:
                pulls[place] = std**-2.0
        gram, target = self._part_gram.sum(axis=0), self._part_target.sum(axis=0)
        fit = self._fit(gram, target, with_prior=False, pulls=pulls)
        p = self.base_count
        uncertain = (fit.inverse * pulls) @ fit.inverse
        return fit.values[:p], (self.covariance(fit) + uncertain)[:p, :p]

    def free_inverse(self) -> Floats:
        """Inverse (p, p) of the base's products without the prior: times those of a column, the change of the base
        parameters that takes it up."""
        gram = self.products.base_sums[0].sum(axis=0)
        return inverse_of(gram, self._scale[: self.base_count])

    @property
    def chi_square(self) -> float:
        """Sum of squares of all fitted rows, in units of their noise."""
        v = self.full.values
        gram, target = self._part_gram.sum(axis=0), self._part_target.sum(axis=0)
        return float(self.products.energy.sum() - 2.0 * v @ target + v @ gram @ v)
