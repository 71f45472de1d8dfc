"""Products of columns in blocks of weighted rows: the base, the columns present beyond it, and those only tried."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from functools import partial
from itertools import count

import numpy as np
from numpy.typing import NDArray

from ident.diagnosis.gain.fitted_rows import FittedRows
from ident.diagnosis.gain.products import (
    Beside,
    Floats,
    Group,
    Key,
    Products,
    Rows,
    add_own_products,
    add_products,
    block_sums,
    width_of,
)
from lwr_driver.session.spool import Arena

# Memory of the latest columns that are not present [bytes].
_SPARE_BYTES = 64 * 2**20
_FIRST = np.zeros(1, dtype=np.int64)

Numbers = NDArray[np.int64]
_Ordered = Rows | Callable[[], Rows]
_Joined = tuple[Floats, Numbers]


class BlockProducts:
    """Products in the blocks of fitted rows, each with its weight.

    weights : of a row's square, by side and joint [1/Nm^2]. base_count : number p of base parameters; further columns
    have the places behind them.
    """

    def __init__(self, fitted: FittedRows, weights: Mapping[Key, float], base_count: int) -> None:
        self.rows, self.weights, self.base_count = fitted, weights, base_count
        self.mask = {key: own.mask for key, own in fitted.keys.items()}
        self._each, self._part = np.arange(fitted.blocks), np.argmax(fitted.parts, axis=0)
        self._groups: dict[int, Group] = {}
        self._next = count()
        self._joined: dict[tuple[int, ...], dict[Key, _Joined]] = {}
        self.present: tuple[Group, ...] = ()
        p = base_count
        self._gram, self._target = Arena().room((fitted.blocks, p, p)), np.zeros((fitted.blocks, p))
        self._gram[...] = 0.0
        self.energy = np.zeros(fitted.blocks)
        for key, own in fitted.keys.items():
            weight, on = weights[key], own.acting
            self.energy += weight * own.energy
            self._gram[:, on[:, None], on] += weight * own.gram
            self._target[:, on] += weight * own.moment
        self.base_sums = block_sums(fitted.parts, self._gram), fitted.parts @ self._target

    # ---- the columns present ----

    def replace(self, extra: Sequence[Rows]) -> bool:
        """Replace the columns beyond the base; whether they are others."""
        if [*map(id, extra)] == [id(group.rows) for group in self.present]:
            return False
        self._joined.clear()
        self.present = tuple(self._group(rows) for rows in extra)
        spare = [group for group in self._groups.values() if group not in self.present]
        size = sum(group.size for group in spare)
        for group in spare:
            if size <= _SPARE_BYTES:
                break
            size -= group.size
            del self._groups[id(group.rows)]
        return True

    def _group(self, rows: Rows) -> Group:
        """Rows with their products and a number. The latest ones are kept, the rows too, so that their identity stays
        theirs."""
        group = self._groups.pop(id(rows), None)
        if group is None:
            group = Group(next(self._next), rows, self.alone(rows))
        self._groups[id(rows)] = group
        return group

    def places(self, groups: Sequence[Group] | None = None) -> Iterator[tuple[slice, Group]]:
        """Groups of further columns, default the present ones, with their places behind the base."""
        place = self.base_count
        for group in self.present if groups is None else groups:
            yield slice(place, place + group.width), group
            place += group.width

    def of_parts(self) -> tuple[Floats, Floats]:
        """Products among base and present columns (parts, P, P) and with the torques (parts, P), of each part of the
        motion."""
        p, parts = self.base_count, len(self.rows.parts)
        size = p + sum(group.width for group in self.present)
        gram, target = np.zeros((parts, size, size)), np.zeros((parts, size))
        gram[:, :p, :p], target[:, :p] = self.base_sums
        for k, (here, group) in enumerate(self.places()):
            base, own, target[:, here] = group.products.sums
            others = self.present[k + 1 :]
            cross = self._crossed(group.products, partial(self.ordered, group.rows), others, kept=False)
            gram[:, here, here.start :] = np.concatenate([own, cross], axis=2)
            gram[:, here.start :, here] = gram[:, here, here.start :].transpose(0, 2, 1)
            gram[:, here, :p], gram[:, :p, here] = base, base.transpose(0, 2, 1)
        return gram, target

    def sums(self, of: Numbers) -> tuple[Floats, Floats]:
        """The same (m, P, P) and (m, P), summed over the blocks of each number in `of` (blocks,)."""
        p, numbers = self.base_count, int(of.max()) + 1
        size = p + sum(group.width for group in self.present)
        gram, target = np.zeros((numbers, size, size)), np.zeros((numbers, size))
        np.add.at(gram[:, :p, :p], of, self._gram)
        np.add.at(target[:, :p], of, self._target)
        for here, group in self.places():
            base = np.zeros((numbers, group.width, p))
            np.add.at(base, of, group.products.alone)
            gram[:, here, :p], gram[:, :p, here] = base, base.transpose(0, 2, 1)
            np.add.at(target[:, here], of, group.products.target)
        for key, (columns, places) in sorted(self._together(self.present).items()):
            starts, weight = self.rows.starts[key[0]], self.weights[key]
            add_own_products(columns, self.mask[key], starts, weight, p + places, of, gram)
        return gram, target

    def left(self, values: Floats) -> Floats:
        """Products (blocks, P) of base and present columns with what the values (P,) leave of the torques."""
        return self._left(self.present, values, self._torque(self.present, values))

    def _torque(self, groups: Sequence[Group], values: Floats) -> dict[Key, _Joined]:
        """Torque (r, 1) in the order of the blocks of groups of further columns with the values (P,)."""
        found: dict[Key, Floats] = {}
        for here, group in self.places(groups):
            for key, columns in self.ordered(group.rows).items():
                found[key] = found.get(key, 0.0) + columns @ values[here, None]
        return {key: (torque, _FIRST) for key, torque in found.items()}

    def _left(self, groups: Sequence[Group], values: Floats, beside: Mapping[Key, _Joined]) -> Floats:
        """Products (blocks, P) of base and groups of further columns with what the values (P,) leave of the torques;
        beside : torque of the further columns."""
        p = self.base_count
        base = self._target - self._gram @ values[:p]
        further = []
        for here, group in self.places(groups):
            products = group.products
            base -= np.einsum("bkp,k->bp", products.alone, values[here])
            own = self._cross(self.ordered(group.rows), beside, self._each, 1)[:, :, 0]
            further.append(products.target - products.alone @ values[:p] - own)
        return np.concatenate([base, *further], axis=1)

    # ---- columns that are tried ----

    def ordered(self, rows: Rows) -> dict[Key, Floats]:
        """Columns (r, k) in the order of the blocks."""
        return {key: np.ascontiguousarray(values[self.rows.order[key[0]]]) for key, values in rows.items()}

    def alone(self, rows: Rows) -> Products:
        """Products of columns with the base, themselves and the torques."""
        return self._alone(self.ordered(rows))

    def _alone(self, columns: Rows) -> Products:
        """The same of columns in the order of the blocks."""
        width, into, blocks = width_of(columns), self._each, self.rows.blocks
        base = np.zeros((blocks, width, self.base_count))
        own = np.zeros((blocks, width, width))
        target = np.zeros((blocks, width, 1))
        places = np.arange(width)
        for key, wide in columns.items():
            mask, starts, weight = self.mask[key], self.rows.starts[key[0]], self.weights[key]
            fitted = self.rows.keys[key]
            add_products(wide, fitted.columns, mask, starts, weight, fitted.acting, into, base)
            add_own_products(wide, mask, starts, weight, places, into, own)
            add_products(wide, fitted.target, mask, starts, weight, places[:1], into, target)
        return Products(base, own, target[:, :, 0], self.rows.parts)

    def beside(self, rows: Rows, known: Products | None = None) -> Beside:
        """Products of columns beside the present ones; `known` : those with the base alone, which remember the ones
        with further columns."""
        columns: _Ordered = partial(self.ordered, rows)
        if known is None:
            columns = self.ordered(rows)
            known = self._alone(columns)
        base, own, target = known.sums
        if self.present:
            base = np.concatenate([base, self._crossed(known, columns, self.present)], axis=2)
        return Beside(known, columns, (base, own, target))

    def in_blocks(self, products: Beside) -> Floats:
        """Products (blocks, k, P) of columns with base and present ones."""
        alone, size = products.known.alone, sum(group.width for group in self.present)
        further = self._cross(_made(products.columns), self._together(self.present), self._each, size)
        return np.concatenate([alone, further], axis=2)

    def left_with(
        self, products: Beside, coefficients: Floats, groups: Sequence[Group], values: Floats
    ) -> tuple[Floats, Floats]:
        """Products (blocks, k) of columns, and (blocks, P) of base and groups of further ones, with what the columns
        with coefficients (k,), where they act, and the others with values (P,) leave of the torques."""
        known, columns, beside = products.known, _made(products.columns), self._torque(groups, values)
        on = np.ones(self.rows.blocks) if products.on is None else products.on
        own = known.target - known.alone @ values[: self.base_count] - known.own @ coefficients
        own = on[:, None] * (own - self._cross(columns, beside, self._each, 1)[:, :, 0])
        seen = {key: (wide @ coefficients[:, None], _FIRST) for key, wide in columns.items()}
        change = [np.einsum("bkp,k->bp", known.alone, coefficients)]
        change += [self._cross(self.ordered(g.rows), seen, self._each, 1)[:, :, 0] for g in groups]
        return own, self._left(groups, values, beside) - on[:, None] * np.concatenate(change, axis=1)

    # ---- products with groups of further columns ----

    def _crossed(
        self, known: Products, columns: _Ordered, groups: Sequence[Group], *, kept: bool = True
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
        none = np.zeros((len(self.rows.parts), known.own.shape[1], 0))
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

    def _cross(self, a: Rows, b: Mapping[Key, _Joined], into: Numbers, width: int) -> Floats:
        """Products (m, k, width) of columns in the order of the blocks with joined ones, each block's at its number
        `into` (blocks,)."""
        total = np.zeros((int(into.max()) + 1, width_of(a), width))
        # In a fixed order: the last digits of a sum depend on it.
        for key in sorted(a.keys() & b.keys()):
            (columns, places), starts = b[key], self.rows.starts[key[0]]
            add_products(a[key], columns, self.mask[key], starts, self.weights[key], places, into, total)
        return total


def _made(columns: _Ordered) -> Rows:
    return columns() if callable(columns) else columns
