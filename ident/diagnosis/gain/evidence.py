"""Evidence for columns beyond the base: held-back gain and significance from Gram matrices of blocks.

Rows of all joints and sides are cut into blocks of time; of each block only products of columns are kept. A fit
without a part of the motion, its error on that part and the covariance from blocks are then linear algebra of small
matrices: Schur complements on the base. The held-back parts are the same phases of every period, so a repeating
motion never checks itself.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cached_property, partial
from itertools import count

import numpy as np
from numpy.typing import NDArray

from ident.diagnosis.gain.fitted_rows import FittedRows
from ident.diagnosis.gain.products import (
    Beside,
    Fit,
    Floats,
    Group,
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
from lwr_driver.session.spool import Arena

# Least share of a column's power left by base parameters without the prior, where the prior is a drawing.
_OWN_SHARE = 3e-3

# Share of the information on an accepted column that holds it at its value where a part of the motion is held back:
# what a few moments alone tell has no value without them, and one from their edges would be all error there.
_KEPT = 0.01

# A fall of the chi-square up to this is no evidence, whatever its value on the held-back parts.
_NO_EVIDENCE = 12.0

# Memory of the latest columns that are not present [bytes].
_SPARE_BYTES = 64 * 2**20
_FIRST = np.zeros(1, dtype=np.int64)

_Columns = Rows | Callable[[], Rows]
_Joined = tuple[Floats, NDArray[np.int64]]


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
        self._each, self._part = np.arange(self.blocks), np.argmax(self.parts, axis=0)
        self._groups: dict[int, Group] = {}
        self._next = count()
        self._present: tuple[Group, ...] = ()
        self._joined: dict[tuple[int, ...], dict[Key, _Joined]] = {}
        self._kept_held: tuple[Fit, Floats] | None = None
        self._kept_free: Fit | None = None
        self._base_products()
        self._fit_present()

    # ---- products ----

    def _base_products(self) -> None:
        p = self.base_count
        gram, self._base_target = Arena().room((self.blocks, p, p)), np.zeros((self.blocks, p))
        gram[...] = 0.0
        self.energy = np.zeros(self.blocks)
        for key, own in self.fitted_rows.keys.items():
            weight, on = self._weights[key], own.acting
            self.energy += weight * own.energy
            gram[:, on[:, None], on] += weight * own.gram
            self._base_target[:, on] += weight * own.moment
        self._base_gram = gram
        self._base_sums = block_sums(self.parts, gram), self.parts @ self._base_target

    @property
    def extra(self) -> list[Rows]:
        """The columns beyond the base."""
        return [group.rows for group in self._present]

    @property
    def beside_what(self) -> tuple[int, ...]:
        """Numbers of the groups of columns beyond the base, of no other groups before or after."""
        return tuple(group.number for group in self._present)

    def _places(self, groups: Sequence[Group] | None = None) -> Iterator[tuple[slice, Group]]:
        """Groups of further columns, default the present ones, with their places behind the base."""
        place = self.base_count
        for group in self._present if groups is None else groups:
            yield slice(place, place + group.width), group
            place += group.width

    def coefficients(self) -> list[Floats]:
        """Values (k,) of each group of further columns in the full fit."""
        return [self.full.values[place].copy() for place, _ in self._places()]

    def _fit_present(self) -> None:
        """Sums of the products of base and further columns, and their fit."""
        p = self.base_count
        size = p + sum(group.width for group in self._present)
        gram, target = np.zeros((len(self.parts), size, size)), np.zeros((len(self.parts), size))
        gram[:, :p, :p], target[:, :p] = self._base_sums
        for k, (here, group) in enumerate(self._places()):
            base, own, target[:, here] = group.products.sums
            others = self._present[k + 1 :]
            cross = self._crossed(group.products, partial(self.ordered, group.rows), others, kept=False)
            gram[:, here, here.start :] = np.concatenate([own, cross], axis=2)
            gram[:, here.start :, here] = gram[:, here, here.start :].transpose(0, 2, 1)
            gram[:, here, :p], gram[:, :p, here] = base, base.transpose(0, 2, 1)
        self._part_gram, self._part_target = gram, target
        self._scale = scale_of(np.einsum("pii->i", gram))
        self.full = self._fit(gram.sum(axis=0), target.sum(axis=0))
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

    def ordered(self, rows: Rows) -> dict[Key, Floats]:
        """Columns (r, k) in the order of the blocks."""
        return {key: np.ascontiguousarray(values[self._order[key[0]]]) for key, values in rows.items()}

    def padded(self, rows: Rows) -> dict[Key, Floats]:
        """Columns (r, k) in the order of the blocks, zero in unused rows."""
        return {key: values * self.mask[key][:, None] for key, values in self.ordered(rows).items()}

    def products(self, columns: _Columns, known: Products | None = None) -> Beside:
        """Products of columns (r, k) in the order of the blocks, or of those that a function makes on demand, beside
        the present ones; `known` : those with the base alone, which remember the ones with further columns."""
        known = self.alone(_made(columns)) if known is None else known
        base, own, target = known.sums
        if self._present:
            base = np.concatenate([base, self._crossed(known, columns, self._present)], axis=2)
        return Beside(known, columns, (base, own, target))

    def _crossed(
        self, known: Products, columns: _Columns, groups: Sequence[Group], *, kept: bool = True
    ) -> Floats:
        """Sums (parts, k, w) of the products of columns with groups of further ones, remembered in their `known` ones;
        kept : whether the same groups will be asked for again."""
        missing = [group for group in groups if group.number not in known.crossed]
        if missing:
            for number in known.crossed.keys() - {group.number for group in self._groups.values()}:
                del known.crossed[number]
            made = _made(columns)
            together = self._together(missing) if kept else self._join(missing, made)
            sums, place = self._cross(made, together, self._part, sum(group.width for group in missing)), 0
            for group in missing:
                known.crossed[group.number] = sums[:, :, place : place + group.width]
                place += group.width
        none = np.zeros((len(self.parts), known.own.shape[1], 0))
        return np.concatenate([none, *(known.crossed[group.number] for group in groups)], axis=2)

    def _join(self, groups: Sequence[Group], keys: Container[Key]) -> dict[Key, _Joined]:
        """Groups of further columns side by side in the order of the blocks, by key, each with the places of those that
        act there."""
        parts: dict[Key, list[_Joined]] = {}
        place = 0
        for group in groups:
            places = np.arange(place, place + group.width)
            place += group.width
            for key, columns in self.ordered({k: v for k, v in group.rows.items() if k in keys}).items():
                parts.setdefault(key, []).append((columns, places))
        return {
            key: some[0]
            if len(some) == 1
            else (np.concatenate([c for c, _ in some], axis=1), np.concatenate([i for _, i in some]))
            for key, some in parts.items()
        }

    def _together(self, groups: Sequence[Group]) -> dict[Key, _Joined]:
        """The same for all keys, remembered as long as the present columns stay."""
        names = tuple(group.number for group in groups)
        if names not in self._joined:
            self._joined[names] = self._join(groups, self.mask)
        return self._joined[names]

    def in_blocks(self, products: Beside) -> Floats:
        """Products (blocks, k, P) of columns with base and further ones."""
        alone, size = products.known.alone, sum(group.width for group in self._present)
        further = self._cross(_made(products.columns), self._together(self._present), self._each, size)
        return np.concatenate([alone, further], axis=2)

    def replace(self, extra: Sequence[Rows]) -> None:
        """Replace the columns beyond the base."""
        if [*map(id, extra)] == [*map(id, self.extra)]:
            return
        self._joined.clear()
        self._present = tuple(self._group(rows) for rows in extra)
        spare = [group for group in self._groups.values() if group not in self._present]
        size = sum(group.size for group in spare)
        for group in spare:
            if size <= _SPARE_BYTES:
                break
            size -= group.size
            del self._groups[id(group.rows)]
        self._fit_present()

    def _group(self, rows: Rows) -> Group:
        """Rows with their products and a number. The latest ones are kept, the rows too, so that their identity stays
        theirs."""
        group = self._groups.pop(id(rows), None)
        if group is None:
            group = Group(next(self._next), rows, self.alone(self.ordered(rows)))
        self._groups[id(rows)] = group
        return group

    @contextmanager
    def beside(self, extra: Sequence[Rows]) -> Iterator[None]:
        """Other columns beyond the base for a while, in place of the present ones."""
        present = self.extra
        self.replace(extra)
        try:
            yield
        finally:
            self.replace(present)

    def _cross(self, a: Rows, b: Mapping[Key, _Joined], into: NDArray[np.int64], width: int) -> Floats:
        """Products (m, k, width) of columns in the order of the blocks with joined ones, each block's at its number
        `into` (blocks,)."""
        total = np.zeros((int(into.max()) + 1, width_of(a), width))
        # In a fixed order: the last digits of a sum depend on it.
        for key in sorted(a.keys() & b.keys()):
            (columns, places), starts = b[key], self._starts[key[0]]
            add_products(a[key], columns, self.mask[key], starts, self._weights[key], places, into, total)
        return total

    def alone(self, columns: Rows) -> Products:
        """Products of columns in the order of the blocks with the base, themselves and the torques."""
        width, into = width_of(columns), self._each
        base = np.zeros((self.blocks, width, self.base_count))
        own = np.zeros((self.blocks, width, width))
        target = np.zeros((self.blocks, width, 1))
        places = np.arange(width)
        for key, wide in columns.items():
            mask, starts, weight = self.mask[key], self._starts[key[0]], self._weights[key]
            fitted = self.fitted_rows.keys[key]
            add_products(wide, fitted.columns, mask, starts, weight, fitted.acting, into, base)
            add_own_products(wide, mask, starts, weight, places, into, own)
            add_products(wide, fitted.target, mask, starts, weight, places[:1], into, target)
        return Products(base, own, target[:, :, 0], self.parts)

    def information(self, products: Products) -> float:
        """Mean fall of the chi-square for a unit of a group's coefficients beside the base parameters alone."""
        base, own, _ = products.sums
        left = left_beside(base.sum(axis=0), own.sum(axis=0), self._base_inverse)
        return float(np.mean(np.maximum(left, 0.0)))

    @cached_property
    def _base_inverse(self) -> Floats:
        """Inverse (p, p) of the base's products, with the prior."""
        gram = self._base_sums[0].sum(axis=0)
        if self.prior is not None:
            gram = gram + self.prior[0]
        return inverse_of(gram, scale_of(np.diag(gram)))

    # ---- scores ----

    def score(
        self,
        columns: Rows,
        *,
        ridge: float = 0.0,
        pull: float = 0.0,
        known: Products | None = None,
    ) -> Score:
        """Score of columns in the order of the blocks.

        ridge : pull towards zero, in units of the columns' mean square, for groups of many columns. pull : precision
        of coefficients known to be 1, for the parts held back: an effect of a few moments hardly exists without one
        of them.
        known : their products with the base alone, to save time.
        """
        products = self.products(columns, known)
        return self.score_products([products], [list(columns)], ridge=ridge, pull=pull)[0]

    def score_groups(
        self, groups: Sequence[tuple[Rows, Products]], *, ridge: float = 0.0, pull: float = 0.0
    ) -> list[Score]:
        """Scores of groups of rows, each with its products with the base alone; those of as many columns together."""
        some = [self.products(partial(self.ordered, rows), known) for rows, known in groups]
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
        groups, known, p = self._present, products.known, self.base_count
        on = np.ones(self.blocks) if products.on is None else products.on

        def robust() -> tuple[Floats, int]:
            columns, beside = _made(products.columns), self._torque(groups, values)
            own = known.target - known.alone @ values[:p] - known.own @ coefficients
            own = on[:, None] * (own - self._cross(columns, beside, self._each, 1)[:, :, 0])
            seen = {key: (wide @ coefficients[:, None], _FIRST) for key, wide in columns.items()}
            change = [np.einsum("bkp,k->bp", known.alone, coefficients)]
            change += [self._cross(self.ordered(g.rows), seen, self._each, 1)[:, :, 0] for g in groups]
            left = self._left(groups, values, beside) - on[:, None] * np.concatenate(change, axis=1)
            scores = own - left @ projection
            size = on * np.einsum("bkk->b", known.own)
            active = int(np.sum(size > 1e-3 * size.max(initial=0.0)))
            middle = active / max(active - 1, 1) * scores.T @ scores
            return widened(inner @ middle @ inner, inner), active

        return robust

    def _torque(self, groups: Sequence[Group], values: Floats) -> dict[Key, _Joined]:
        """Torque (r, 1) in the order of the blocks of groups of further columns with the values (P,)."""
        found: dict[Key, Floats] = {}
        for here, group in self._places(groups):
            for key, columns in self.ordered(group.rows).items():
                found[key] = found.get(key, 0.0) + columns @ values[here, None]
        return {key: (torque, _FIRST) for key, torque in found.items()}

    def _left(self, groups: Sequence[Group], values: Floats, beside: Mapping[Key, _Joined]) -> Floats:
        """Products (blocks, P) of base and groups of further columns with what the values (P,) leave of the torques;
        beside : torque of the further columns."""
        p = self.base_count
        base = self._base_target - self._base_gram @ values[:p]
        further = []
        for here, group in self._places(groups):
            products = group.products
            base -= np.einsum("bkp,k->bp", products.alone, values[here])
            own = self._cross(self.ordered(group.rows), beside, self._each, 1)[:, :, 0]
            further.append(products.target - products.alone @ values[:p] - own)
        return np.concatenate([base, *further], axis=1)

    def sums(self, of: NDArray[np.int64]) -> tuple[Floats, Floats]:
        """Products among all present columns (m, P, P) and with the torques (m, P), summed over the blocks of each
        number in `of` (blocks,)."""
        p, size = self.base_count, len(self._scale)
        gram, target = np.zeros((int(of.max()) + 1, size, size)), np.zeros((int(of.max()) + 1, size))
        np.add.at(gram[:, :p, :p], of, self._base_gram)
        np.add.at(target[:, :p], of, self._base_target)
        for here, group in self._places():
            base = np.zeros((len(gram), group.width, p))
            np.add.at(base, of, group.products.alone)
            gram[:, here, :p], gram[:, :p, here] = base, base.transpose(0, 2, 1)
            np.add.at(target[:, here], of, group.products.target)
        for key, (columns, places) in sorted(self._together(self._present).items()):
            starts, weight = self._starts[key[0]], self._weights[key]
            add_own_products(columns, self.mask[key], starts, weight, p + places, of, gram)
        return gram, target

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
        for here, group in self._places():
            for (of_side, j), columns in group.rows.items():
                if of_side == side:
                    predicted[:, j] += columns[some] @ values[here]
        return predicted

    def covariance(self, fit: Fit | None = None) -> Floats:
        """Covariance (P, P) of all present columns in a fit, default the full one, from blocks, at least that of
        independent rows."""
        fit = fit or self.full
        scores = self._left(self._present, fit.values, self._torque(self._present, fit.values))
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
        for place, group in self._places():
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
        gram = self._base_sums[0].sum(axis=0)
        return inverse_of(gram, self._scale[: self.base_count])

    @property
    def chi_square(self) -> float:
        """Sum of squares of all fitted rows, in units of their noise."""
        v = self.full.values
        gram, target = self._part_gram.sum(axis=0), self._part_target.sum(axis=0)
        return float(self.energy.sum() - 2.0 * v @ target + v @ gram @ v)


def _made(columns: _Columns) -> Rows:
    return columns() if callable(columns) else columns
