"""The stacked linear regression y = A chi + e of equation (8), kept as groups of rows.

A group holds the rows of one joint, one side (joint, motor or difference) and one session, in the order of
time. Rows of one joint and side share a variance, equation (13): they form a *class*. Estimators work on the
triangular factor of each class, [A y] = Q R, so an iteration costs the same for a thousand rows as for a
million, and a residual sum of squares is ||R [-chi; 1]||^2 without cancellation.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, solve_triangular

from fri.errors import DataError
from ident.dynamics.parameters import Floats
from lwr_driver.session.spool import spans, stored

_QR_ROWS = 4096
_GRAM_PIVOT = 1e-5
_ADVICE = (
    "leave parameters out of the model (`--without`), or choose an estimator that takes from the URDF's "
    "inertials whatever the data leave open (`--estimator physical`, `map`)"
)


SINGULAR = 1e12
"""Condition number from which on rounding decides."""


def condition_text(value: float) -> str:
    """A condition number in four digits, as a person writes it; `infinite` where rounding decides."""
    if not value < SINGULAR:
        return "infinite"
    return f"{float(f'{value:.4g}'):.0f}" if value >= 1000.0 else f"{value:.4g}"


@dataclass(frozen=True)
class RowGroup:
    """Rows of one joint, side and session.

    matrix : (m, p), rows of the observation matrix.
    target : (m,), measured torques [Nm].
    time_index : (m,) int64, strictly increasing number of the output sample within its session; neighbours
        in time differ by one, excluded samples leave a gap.
    record : number of the session (or of an uninterrupted part of it); time runs on only within a record.
    unit : of the torque, N for the force of a prismatic joint.
    """

    joint: str
    side: str
    record: int
    matrix: Floats
    target: Floats
    time_index: NDArray[np.int64]
    unit: str = "Nm"

    def __post_init__(self) -> None:
        rows = self.target.shape
        if self.matrix.ndim != 2 or rows != self.matrix.shape[:1] or self.time_index.shape != rows:
            raise DataError(
                f"{self.label}: matrix {self.matrix.shape}, target {self.target.shape} and time index "
                f"{self.time_index.shape} do not agree; give (m, p), (m,) and (m,)"
            )
        if np.any(np.diff(self.time_index) <= 0):
            raise DataError(
                f"{self.label}: the time index must increase from row to row; sort the rows by time"
            )

    @property
    def label(self) -> str:
        """Joint and side, the name of the variance class."""
        return f"{self.joint} {self.side}"

    def select(self, columns: Sequence[int] | NDArray[np.int64]) -> RowGroup:
        """The same rows with some of the columns."""
        return replace(self, matrix=np.ascontiguousarray(self.matrix[:, np.asarray(columns)]))


@dataclass(frozen=True)
class TriangularFactor:
    """Upper triangular R (p + 1, p + 1) with R^T R = [A y]^T [A y], and its number of rows."""

    r: Floats
    rows: int

    @classmethod
    def of(cls, matrix: Floats, target: Floats) -> TriangularFactor:
        """Factor of (m, p) rows and (m,) targets: Gram and Cholesky if safe, else blocked QR."""
        if not len(target):
            return cls(np.zeros((matrix.shape[1] + 1,) * 2), 0)
        p = matrix.shape[1]
        acting = _acting(matrix)
        part = _columns(matrix, acting)
        r = _gram_factor(part, target) if len(target) > _QR_ROWS else None
        if r is None:
            r = _blocked_qr(part, target)
        if len(acting) < p:
            # Still upper triangular: the order of the columns stays.
            places, whole = np.append(acting, p), np.zeros((p + 1, p + 1))
            whole[np.ix_(places, places)] = r
            r = whole
        return cls(r, len(target))

    @classmethod
    def combine(cls, factors: Iterable[TriangularFactor], weights: Iterable[float]) -> TriangularFactor:
        """Factor of the stack of all parts, their rows multiplied by sqrt(weight)."""
        parts = [(factor, weight) for factor, weight in zip(factors, weights, strict=True) if factor.rows]
        stack = np.vstack([np.sqrt(weight) * factor.filled for factor, weight in parts])
        return cls(_triangle(stack), sum(factor.rows for factor, _ in parts))

    @cached_property
    def filled(self) -> Floats:
        """The rows of R that are not zero: a joint's rows have none for the links before it."""
        return self.r[self.r.any(axis=1)]

    @property
    def parameters(self) -> int:
        """Number p of parameters."""
        return self.r.shape[1] - 1

    @property
    def mean_square(self) -> float:
        """Mean square of the targets."""
        return float(self.r[:, -1] @ self.r[:, -1]) / max(self.rows, 1)

    @property
    def normal(self) -> Floats:
        """A^T A, (p, p)."""
        r = self.r[:, :-1]
        return r.T @ r

    def sum_of_squares(self, values: Floats) -> float:
        """||y - A chi||^2 for values (p,)."""
        return float(np.sum((self.filled @ np.append(-values, 1.0)) ** 2))

    def solve(self) -> Floats:
        """Least-squares solution (p,). The matrix must have full rank: see `Problem.require_rank`."""
        p = self.parameters
        return solve_triangular(self.r[:p, :p], self.r[:p, p])

    def inverse_root(self) -> Floats:
        """R^-1 (p, p) of the matrix part, so that (A^T A)^-1 = R^-1 R^-T."""
        p = self.parameters
        return solve_triangular(self.r[:p, :p], np.eye(p))

    def select(self, columns: Sequence[int] | NDArray[np.int64]) -> TriangularFactor:
        """Factor of the same rows with some of the columns."""
        r = self.r[:, np.append(np.asarray(columns, dtype=np.int64), self.parameters)]
        return TriangularFactor(_triangle(r), self.rows)


@dataclass(frozen=True)
class Nuisance:
    """A quantity estimated before with an effect on the rows, such as the delay of a channel.

    std : its standard deviation. columns : by number of the row group, d(target) / d(quantity), (m,). Its
        uncertainty is added to the covariance of every estimate.
    """

    name: str
    std: float
    columns: Mapping[int, Floats]


@dataclass(frozen=True)
class RowClass:
    """All groups of one joint and side: they share a variance (equation 13)."""

    joint: str
    side: str
    groups: tuple[int, ...]
    factor: TriangularFactor
    unit: str = "Nm"

    @property
    def label(self) -> str:
        """Joint and side."""
        return f"{self.joint} {self.side}"


@dataclass(frozen=True)
class Problem:
    """A linear regression with named parameters.

    names : p parameter names. groups : the rows. sample_time_s : time between neighbouring time indices [s].
    units : p units, for tables; may be empty. record_names : one name a record, for messages.
    nuisances : quantities with an uncertainty, added to the covariance.
    periods : for each record the period of its motion in time indices, None without; may be empty. Unmodelled
        physics repeats with the motion, so rows of equal phase have similar errors.
    """

    names: tuple[str, ...]
    groups: tuple[RowGroup, ...]
    sample_time_s: float
    units: tuple[str, ...] = ()
    record_names: tuple[str, ...] = ()
    nuisances: tuple[Nuisance, ...] = ()
    periods: tuple[int | None, ...] = ()

    def __post_init__(self) -> None:
        if not self.groups:
            raise DataError(
                "no rows to estimate from: every sample was excluded; check the phases and the edges"
            )
        for group in self.groups:
            if group.matrix.shape[1] != len(self.names):
                raise DataError(
                    f"{group.label}: {group.matrix.shape[1]} columns for {len(self.names)} parameter names"
                )
        if not self.sample_time_s > 0:
            raise DataError(f"sample time {self.sample_time_s} s must be positive")

    @property
    def rows(self) -> int:
        """Number r of rows."""
        return sum(len(group.target) for group in self.groups)

    def __repr__(self) -> str:
        return f"Problem: {self.rows} rows of {len(self.groups)} groups, {len(self.names)} parameters"

    @cached_property
    def classes(self) -> tuple[RowClass, ...]:
        """Variance classes in the order of their first group. Refuses non-finite entries."""
        members: dict[str, list[int]] = {}
        for index, group in enumerate(self.groups):
            members.setdefault(group.label, []).append(index)
        return tuple(self._row_class(label, indices) for label, indices in members.items())

    def _row_class(self, label: str, indices: list[int]) -> RowClass:
        factors = []
        for index in indices:
            group = self.groups[index]
            factor = TriangularFactor.of(group.matrix, group.target)
            if not np.all(np.isfinite(factor.r)):
                raise DataError(
                    f"{label}: non-finite torque or regressor entries; remove them before estimating"
                )
            factors.append(factor)
        whole = factors[0] if len(factors) == 1 else TriangularFactor.combine(factors, [1.0] * len(factors))
        first = self.groups[indices[0]]
        return RowClass(first.joint, first.side, tuple(indices), whole, first.unit)

    @cached_property
    def class_of_group(self) -> tuple[int, ...]:
        """Index of the class of each group."""
        found = {index: number for number, row_class in enumerate(self.classes) for index in row_class.groups}
        return tuple(found[index] for index in range(len(self.groups)))

    def weighted(self, weights: Sequence[float] | Floats) -> TriangularFactor:
        """Factor of the whole stack with a weight (inverse variance) for each class."""
        return TriangularFactor.combine([c.factor for c in self.classes], [float(w) for w in weights])

    def residuals(self, values: Floats) -> tuple[Floats, ...]:
        """y - A chi [Nm] of each group, each (m,)."""
        return tuple(group.target - group.matrix @ values for group in self.groups)

    def select(self, columns: Sequence[int] | NDArray[np.int64]) -> Problem:
        """The same rows with some of the parameters."""
        chosen = [int(c) for c in columns]
        return replace(
            self,
            names=tuple(self.names[c] for c in chosen),
            groups=tuple(group.select(chosen) for group in self.groups),
            units=tuple(self.units[c] for c in chosen) if self.units else (),
        )

    def with_columns(self, names: Sequence[str], columns: Sequence[Floats], unit: str) -> Problem:
        """The same rows with further parameters of one unit. columns : (m, k) of each group."""
        groups = tuple(
            replace(group, matrix=stored([np.column_stack([group.matrix, further])]))
            for group, further in zip(self.groups, columns, strict=True)
        )
        units = (*self.units, *[unit] * len(names)) if self.units else ()
        return replace(self, names=(*self.names, *names), groups=groups, units=units)

    def require_rank(self) -> float:
        """Condition number of the column-normalised stack. DataError names the parameters at a loss of rank."""
        factor = self.weighted(np.ones(len(self.classes)))
        p = factor.parameters
        norms = np.linalg.norm(factor.r[:, :p], axis=0)
        empty = [self.names[i] for i in np.flatnonzero(norms == 0.0)]
        if empty:
            raise DataError(
                f"no row depends on {_listed(empty)}; move these joints, add a session with them excited, {_ADVICE}"
            )
        if self.rows < p:
            raise DataError(f"{self.rows} rows cannot determine {p} parameters; record a longer motion")
        _, singular, right = np.linalg.svd(factor.r[:, :p] / norms)
        if singular[-1] <= singular[0] * max(self.rows, p) * np.finfo(float).eps:
            suspects = [self.names[i] for i in np.flatnonzero(np.abs(right[-1]) > 0.1)]
            raise DataError(
                f"the motion cannot tell {_listed(suspects)} apart (singular value ratio "
                f"{singular[-1] / singular[0]:.1e}); excite them, add a session (unloaded and loaded), {_ADVICE}"
            )
        return float(singular[0] / singular[-1])

    @property
    def normalised_condition(self) -> float:
        """Condition number of the column-normalised stack, infinite without full rank."""
        try:
            return self.require_rank()
        except DataError:
            return float("inf")

    @property
    def condition(self) -> float:
        """Condition number of the unscaled, unweighted observation matrix, as in Table 1 of the paper."""
        singular = np.linalg.svd(self.weighted(np.ones(len(self.classes))).r[:, :-1], compute_uv=False)
        return float(singular[0] / singular[-1]) if singular[-1] > 0 else float("inf")


def _listed(names: Sequence[str], limit: int = 12) -> str:
    shown = ", ".join(names[:limit])
    return shown if len(names) <= limit else f"{shown} and {len(names) - limit} more"


def _acting(matrix: Floats) -> NDArray[np.int64]:
    """Columns with a nonzero entry; a joint's rows have none for the links before it."""
    acting = np.zeros(matrix.shape[1], dtype=bool)
    for some in spans(len(matrix), _QR_ROWS):
        acting |= matrix[some].any(axis=0)
    return np.flatnonzero(acting)


def _columns(matrix: Floats, chosen: NDArray[np.int64]) -> Floats:
    """Some columns in rising order, without a copy if they are neighbours."""
    if not len(chosen) or chosen[-1] - chosen[0] + 1 == len(chosen):
        return matrix[:, chosen[0] : chosen[-1] + 1] if len(chosen) else matrix[:, :0]
    by_column = matrix.strides[0] < matrix.strides[1]
    return matrix.T[chosen].T if by_column else matrix[:, chosen]


def _gram_factor(matrix: Floats, target: Floats) -> Floats | None:
    """Cholesky factor of the equilibrated Gram matrix, or None if it would lose digits."""
    p = matrix.shape[1]
    gram = np.empty((p + 1, p + 1))
    gram[:p, :p] = matrix.T @ matrix
    gram[:p, p] = gram[p, :p] = matrix.T @ target
    gram[p, p] = target @ target
    scale = np.sqrt(np.diag(gram))
    if not np.all(np.isfinite(scale)):
        return np.full((p + 1, p + 1), np.nan)
    scale[scale == 0.0] = 1.0
    zero = np.diag(gram) == 0.0
    equilibrated = gram / np.outer(scale, scale)
    equilibrated[zero, zero] = 1.0
    try:
        r = cholesky(equilibrated, lower=False)
    except np.linalg.LinAlgError:
        return None
    if np.min(np.diag(r)) < _GRAM_PIVOT:
        return None
    r[zero, zero] = 0.0
    return r * scale


def _blocked_qr(matrix: Floats, target: Floats) -> Floats:
    p = matrix.shape[1]
    r = np.zeros((0, p + 1))
    for start in range(0, len(target), _QR_ROWS):
        rows = slice(start, start + _QR_ROWS)
        block = np.column_stack([matrix[rows], target[rows]])
        if not np.all(np.isfinite(block)):
            return np.full((p + 1, p + 1), np.nan)
        r = _triangle(np.vstack([r, block]))
    return r


def _triangle(stack: Floats) -> Floats:
    """R (k, k) of the QR decomposition of (m, k), with rows of zeros for m < k."""
    r = np.asarray(np.linalg.qr(stack, mode="r"), dtype=np.float64)
    missing = r.shape[1] - r.shape[0]
    return np.vstack([r, np.zeros((missing, r.shape[1]))]) if missing > 0 else r
