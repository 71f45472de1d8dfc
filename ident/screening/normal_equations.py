"""The normal equations of each class of rows, and their fit with weights by the residuals."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.linalg.lapack import dpotrs, dpstrf

from ident.dynamics.parameters import Floats
from ident.estimators.prior import Prior

Class = tuple[str, int]
Part = tuple[int, int]

FLOOR = 0.01
"""A residual below this share of the torque is as good as none: the accuracy of torque sensors."""
DEVIATIONS = 5.0
"""An error of less standard deviations may be chance."""
ROUNDS = 8
"""Rounds of reweighting, at most."""
BLOCK = 10
"""Rows with a common error: two seconds at the usual rate."""
# The rounds end with a fall of the score below this.
_SETTLED = 1e-3
# Dependent column: square of the sine between it and those before it.
_DEPENDENT = 1e-9
# Column of rounding errors alone: its norm over the largest.
_NOTHING = 1e-10


class Blocks(NamedTuple):
    """Symmetric matrices G (m, p, p) by their nonzero columns.

    matrix : (m, u, u), for the c <= u columns of each in the first c rows and columns. columns : (m, u), rising.
    sizes : c (m,).
    """

    matrix: Floats
    columns: NDArray[np.int64]
    sizes: NDArray[np.int64]

    @classmethod
    def of(cls, matrices: Sequence[Floats], columns: Sequence[NDArray[np.int64]]) -> Blocks:
        """From each matrix (c, c) and its columns (c,)."""
        sizes = np.array([len(own) for own in columns], dtype=np.int64)
        most = int(sizes.max(initial=0))
        matrix, places = np.zeros((len(sizes), most, most)), np.zeros((len(sizes), most), dtype=np.int64)
        for k, (block, own) in enumerate(zip(matrices, columns, strict=True)):
            matrix[k, : len(own), : len(own)], places[k, : len(own)] = block, own
        return cls(matrix, places, sizes)


@dataclass(frozen=True)
class Normal:
    """Normal equations of the m classes, the torques' of the o parts.

    matrix : G. mixed : B^T (m, o, n + 2, p). scatter, square : T (m, o, n + 2, n + 2) without the mean of the
    session, and S with it. prior : of the bodies, by the URDF's.
    """

    classes: tuple[Class, ...]
    parts: tuple[Part, ...]
    matrix: Blocks
    mixed: Floats
    scatter: Floats
    square: Floats
    prior: Prior

    def total(self, fit: Fit) -> Floats:
        """Weighted sum of the matrices and the prior's precision, (p, p), its lower triangle."""
        return self.weighted(np.array([fit.weight[key] for key in self.classes]), fit.nominal)

    def weighted(self, weights: Floats, nominal: float) -> Floats:
        """The same by weights (m,) of the classes and one of the prior."""
        out = nominal * self.prior.precision
        _add_weighted(*self.matrix, weights, out)
        return out

    def squares(self, values: Floats) -> Floats:
        """x^T G x (m,) of the classes for parameters x (p,)."""
        out = np.empty(len(self.classes))
        _squares(*self.matrix, values, out)
        return out

    @property
    def by_data(self) -> Normal:
        """The same without the prior, from the data alone: a wrong URDF would bend weakly excited parameters."""
        width = self.mixed.shape[-1]
        return replace(self, prior=Prior(np.zeros(width), np.zeros((width, width))))

    @property
    def rows(self) -> float:
        """Independent rows of a class, in the mean."""
        return max(float(self.square[:, :, -2, -2].sum()) / (len(self.classes) * BLOCK), 1.0)


@dataclass(frozen=True)
class Fit:
    """Parameters (p,), rho and weight of each class, and weight `nominal` of the prior.

    cost : minimised by the fit. `score`: sum of log rho, none below the floor.
    """

    parameters: Floats
    rho: Mapping[Class, float]
    weight: Mapping[Class, float]
    nominal: float
    cost: float

    @property
    def score(self) -> float:
        """Sum over classes of log rho; the less, the better the explanation."""
        return float(sum(np.log(max(value, FLOOR)) for value in self.rho.values()))


class Sums(NamedTuple):
    """W^T y (m, p) of the classes, y^T y (m,), and the same (m,) about the mean."""

    mixed: Floats
    square: Floats
    total: Floats


def reweighted(normal: Normal, sums: Sums, start: Floats, nominal_weight: float, rounds: int) -> Fit:
    """The fit by reweighting. start : squared residuals (m,) of the first weights. nominal_weight : first one."""
    mixed, square, total = sums
    least = FLOOR**2 * total
    prior = normal.prior
    pull = prior.precision @ prior.mean
    weight, firm, error, values, cost = 1.0 / start, nominal_weight, total, np.zeros(0), np.inf
    for _ in range(rounds):
        values = solve(normal.weighted(weight, firm), weight @ mixed + firm * pull)
        error = np.maximum(square - 2.0 * mixed @ values + normal.squares(values), 0.0)
        weight = 1.0 / np.maximum(error, least)
        apart = values - prior.mean
        distance = float(apart @ prior.precision @ apart)
        firm = 1.0 / (normal.rows + distance)
        # The cost falls from round to round.
        before, residuals = cost, float(np.sum(np.log(np.maximum(error, least) / total)))
        cost = 0.5 * (residuals + float(np.log1p(distance / normal.rows)))
        if before - cost < _SETTLED:
            break
    rho = np.sqrt(error / total)
    return Fit(
        values,
        dict(zip(normal.classes, rho.tolist(), strict=True)),
        dict(zip(normal.classes, weight.tolist(), strict=True)),
        firm,
        cost,
    )


def solve(matrix: Floats, right: Floats) -> Floats:
    """Solution of the normal equations in the excited columns, zero in the others; arguments as for `factored`."""
    return factored(matrix)(right)


def factored(matrix: Floats) -> Callable[[Floats], Floats]:
    """The solution of the normal equations by their right side (p,) (Cholesky with pivots).

    matrix : (p, p); its lower triangle counts.
    """
    scale = np.sqrt(np.diag(matrix))
    scale = np.where(scale > max(_NOTHING * np.max(scale, initial=0.0), 1e-150), scale, np.inf)
    # Column-major as LAPACK has it; the matrix is symmetric.
    factor, order, rank, _ = dpstrf((matrix / (scale[:, None] * scale)).T, tol=_DEPENDENT, overwrite_a=1)
    kept = order[:rank] - 1

    def solution(right: Floats) -> Floats:
        found = np.zeros(len(right))
        found[kept] = dpotrs(factor[:rank, :rank], (right / scale)[kept])[0].ravel() / scale[kept]
        return found

    return solution


@njit(cache=True, nogil=True)
def _add_weighted(
    matrix: Floats, columns: NDArray[np.int64], sizes: NDArray[np.int64], weights: Floats, out: Floats
) -> None:
    """Adds the lower triangle of the weighted sum of `Blocks` to out (p, p)."""
    for k in range(len(matrix)):
        own = columns[k]
        for a in range(sizes[k]):
            row, total = matrix[k, a], out[own[a]]
            for b in range(a + 1):
                total[own[b]] += weights[k] * row[b]


@njit(cache=True, nogil=True)
def _squares(
    matrix: Floats, columns: NDArray[np.int64], sizes: NDArray[np.int64], values: Floats, out: Floats
) -> None:
    """x^T G x (m,) from the lower triangles of `Blocks`."""
    for k in range(len(matrix)):
        own = values[columns[k]]
        out[k] = 0.0
        for a in range(sizes[k]):
            row, before = matrix[k, a], 0.0
            for b in range(a):
                before += row[b] * own[b]
            out[k] += own[a] * (2.0 * before + row[a] * own[a])
