"""Products of columns in blocks of rows, and least squares on them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numba import njit
from numpy.typing import NDArray

Floats = NDArray[np.float64]
# A column with less than this share of its power beside the base carries no information of its own.
_LEAST_LEFT = 1e-5
# Size of a column over the largest one below which it is rounding: some hundred operations of double precision leave
# 1e-14, and SI units of an arm's parameters differ by less than 1e9.
_ROUNDING = 1e-12

Key = tuple[str, int]
Rows = Mapping[Key, Floats]
"""Columns in rows: (m, k) for each side and joint with non-zero entries."""
Sums = tuple[Floats, Floats, Floats]


@dataclass(frozen=True, eq=False)
class Fit:
    """Least-squares values (P,) of base and further columns, and the inverse Gram matrix (P, P)."""

    values: Floats
    inverse: Floats


@dataclass(frozen=True, eq=False)
class Products:
    """Products of a group's columns with the base, among themselves and with the torques in each block.

    alone : (blocks, k, p) with the base parameters; own (blocks, k, k); target (blocks, k). parts : (parts, blocks),
    1 for the blocks of a part held back in turn. crossed : sums (parts, k, w) of those with groups of further columns,
    by the number of the group, as met so far.
    """

    alone: Floats
    own: Floats
    target: Floats
    parts: Floats
    crossed: dict[int, Floats] = field(default_factory=dict)

    @cached_property
    def sums(self) -> Sums:
        """Base, own and target of each part."""
        return block_sums(self.parts, self.alone), block_sums(self.parts, self.own), self.parts @ self.target


@dataclass(frozen=True, eq=False)
class Group:
    """Columns beyond the base with their products. number : of no other group before or after it."""

    number: int
    rows: Rows
    products: Products

    @property
    def width(self) -> int:
        """Number of columns."""
        return self.products.own.shape[1]

    @property
    def size(self) -> int:
        """Bytes of rows and products."""
        return self.products.alone.nbytes + sum(values.nbytes for values in self.rows.values())


@dataclass(frozen=True, eq=False)
class Beside:
    """Products of a group's columns beside the present ones. sums : base with further columns (parts, k, P), own and
    target of each part. columns : in the order of the blocks, or what makes them. on : (blocks,) 1 where they act.
    """

    known: Products
    columns: Rows | Callable[[], Rows]
    sums: Sums
    on: Floats | None = None

    def only(self, on: Floats, base: Floats) -> Beside:
        """The same in the blocks with weight 1 in `on` (blocks,) alone. base : (blocks, k, P)."""
        parts = self.known.parts * on
        sums = block_sums(parts, base), block_sums(parts, self.known.own), parts @ self.known.target
        return Beside(self.known, self.columns, sums, on)


def width_of(rows: Rows) -> int:
    """Number of columns, 0 without rows."""
    return next(iter(rows.values())).shape[1] if rows else 0


def scale_of(squares: Floats) -> Floats:
    """Factors (P,) to a diagonal of ones from its squares (P,), 0 for a column of nothing but rounding."""
    some = squares > _ROUNDING**2 * np.max(squares, initial=0.0)
    return np.where(some, 1.0 / np.sqrt(np.where(some, squares, 1.0)), 0.0)


def inverse_of(gram: Floats, scale: Floats) -> Floats:
    """Inverse (P, P) of products scaled to a diagonal near one."""
    both = np.outer(scale, scale)
    scaled = gram * both
    # Keeps directions without excitation finite; 1e-9 of the diagonal decides nothing else.
    scaled[np.diag_indices_from(scaled)] += 1e-9
    return np.asarray(np.linalg.inv(scaled) * both)


def left_beside(cross: Floats, own: Floats, inverse: Floats) -> Floats:
    """Squares (k,) of columns beside others: products with those (k, P), among themselves (k, k), inverse (P, P)."""
    return np.asarray(np.diag(own) - np.einsum("kp,kp->k", cross @ inverse, cross))


@njit(cache=True, nogil=True)
def add_products(one, other, mask, starts, weight, places, into, out):  # type: ignore[no-untyped-def]
    """Add the weighted products of (r, k) and (r, l) over the rows of `mask` (r,) in each block to the `places` (l,) of
    (m, k, p), at the number of the block in `into` (blocks,)."""
    k, width = one.shape[1], other.shape[1]
    total = np.zeros((k, width))
    for block in range(len(starts) - 1):
        acts = False
        for row in range(starts[block], starts[block + 1]):
            if not mask[row]:
                continue
            for i in range(k):
                value = weight * one[row, i]
                if value != 0.0:
                    acts = True
                    for j in range(width):
                        total[i, j] += value * other[row, j]
        if acts:
            for i in range(k):
                for j in range(width):
                    out[into[block], i, places[j]] += total[i, j]
                    total[i, j] = 0.0


@njit(cache=True, nogil=True)
def add_own_products(wide, mask, starts, weight, places, into, out):  # type: ignore[no-untyped-def]
    """Add the weighted products among (r, k) over the rows of `mask` (r,) in each block to the `places` (k,) of
    (m, p, p), at the number of the block in `into` (blocks,)."""
    width = wide.shape[1]
    total = np.zeros((width, width))
    for block in range(len(starts) - 1):
        acts = False
        for row in range(starts[block], starts[block + 1]):
            if not mask[row]:
                continue
            for i in range(width):
                value = weight * wide[row, i]
                if value != 0.0:
                    acts = True
                    for j in range(i + 1):
                        total[i, j] += value * wide[row, j]
        if acts:
            for i in range(width):
                for j in range(i + 1):
                    out[into[block], places[i], places[j]] += total[i, j]
                    if i != j:
                        out[into[block], places[j], places[i]] += total[i, j]
                    total[i, j] = 0.0


def block_sums(parts: Floats, values: Floats) -> Floats:
    """Sums (parts, k, l) of values (blocks, k, l) over the blocks of each part."""
    return (parts @ values.reshape(len(values), -1)).reshape(len(parts), *values.shape[1:])


def schur(products: Sums, fit: Fit, ridge: float) -> tuple[Floats, Floats, Floats, NDArray[np.bool_]]:
    """Projection on the base (..., P, k), inverse of the Schur complement (..., k, k), and product with the residual
    (..., k) of columns with the products base (..., k, P), own (..., k, k) and target (..., k).

    Last (...,), whether the columns are something of their own beside the base; the inverse is zero elsewhere.
    """
    cross, own, target = products
    projection = fit.inverse @ cross.swapaxes(-1, -2)
    inner = own - cross @ projection
    power, left = np.einsum("...kk->...k", own), np.einsum("...kk->...k", inner)
    sound = ((power > 0.0) & (left >= _LEAST_LEFT * power)).all(axis=-1)
    moment = target - (cross @ fit.values[..., None])[..., 0]
    eye, at = np.eye(power.shape[-1]), sound[..., None, None]
    root = np.sqrt(np.where(sound[..., None], left + ridge * power, 1.0))
    both = root[..., :, None] * root[..., None, :]
    if len(eye) == 1:
        # Most groups are one column.
        return projection, at / both, moment, sound
    scaled = np.where(at, (inner + ridge * power[..., :, None] * eye) / both, eye)
    sound = sound & (np.linalg.eigvalsh(scaled)[..., 0] >= 1e-9)
    at = sound[..., None, None]
    return projection, at * np.linalg.inv(np.where(at, scaled, eye)) / both, moment, sound
