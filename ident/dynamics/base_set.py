"""Base parameters: their set, the preferred columns, and the numeric route.

The numeric route takes the rank of observation matrices at random states (Gautier 1991). Random states excite
every excitable combination, so dependent columns of the sampled matrix are dependent in the model. Rounding
leaves singular values of 1e-15, the geometry (link lengths of a centimetre) values above 1e-6. The rank is read
off at the widest gap between the two.
"""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fri.errors import ConfigurationError, DataError
from ident.dynamics.parameters import INERTIAL, PER_LINK, Floats
from ident.dynamics.structure import Condition, ModelStructure

_NEGLIGIBLE = 1e-10


@dataclass(frozen=True, eq=False)
class BaseSet:
    """Base parameters of a model structure under given conditions.

    With x the standard parameters (n_columns,), the torques depend only on
    `x[columns] + regrouping @ x[dependent]`.

    structure, conditions : the analysed rows.
    columns : (b,) standard columns of the base parameters, ascending.
    dependent : (k,) columns regrouped into those. regrouping : (b, k).
    not_identifiable : columns without any effect on the rows.
    excluded : columns left out by the structure.
    method : "numeric" or "closed form".
    gap : ratio of the smallest accepted to the largest rejected singular value (inf for the closed form).
    threshold : the relative singular value between the two (0 for the closed form).
    """

    structure: ModelStructure
    conditions: tuple[Condition, ...]
    columns: NDArray[np.int64]
    dependent: NDArray[np.int64]
    regrouping: Floats
    not_identifiable: NDArray[np.int64]
    excluded: NDArray[np.int64]
    method: str
    gap: float = float("inf")
    threshold: float = 0.0

    def __len__(self) -> int:
        return len(self.columns)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the base parameters, with `R` where others are regrouped into them: `ZZ2R`."""
        regrouped = np.any(self.regrouping != 0.0, axis=1)
        return tuple(
            self.structure.names[column] + ("R" if flag else "")
            for column, flag in zip(self.columns, regrouped, strict=True)
        )

    @cached_property
    def units(self) -> tuple[str, ...]:
        """SI units of the base parameters."""
        return tuple(self.structure.units[column] for column in self.columns)

    def __repr__(self) -> str:
        return f"Base set: {self._counts()}"

    def _counts(self) -> str:
        return (
            f"{self.structure.n_columns - len(self.excluded)} parameters = {len(self.not_identifiable)} not "
            f"identifiable + {len(self.dependent)} regrouped + {len(self.columns)} base parameters ({self.method})"
        )

    @cached_property
    def matrix(self) -> Floats:
        """K (b, n_columns): base parameters = K @ standard parameters."""
        matrix = np.zeros((len(self.columns), self.structure.n_columns))
        matrix[np.arange(len(self.columns)), self.columns] = 1.0
        matrix[:, self.dependent] = self.regrouping
        matrix.setflags(write=False)
        return matrix

    def index(self, name: str) -> int:
        """Position of a base parameter, named with or without its `R`."""
        plain = [self.structure.names[column] for column in self.columns]
        for names in (list(self.names), plain):
            if name in names:
                return names.index(name)
        near = difflib.get_close_matches(name, self.names, n=1)
        advice = f"; did you mean {near[0]!r}?" if near else ""
        if name in self.structure.names:
            advice = f"; it is {self.status(name)}"
        raise ConfigurationError(f"{name!r} is no base parameter of this model{advice}")

    def status(self, name: str) -> str:
        """Role of the standard parameter `name` in the base set, in words."""
        column = self.structure.index(name)
        if column in self.columns:
            return "a base parameter"
        if column in self.excluded:
            return "left out of the model"
        if column in self.not_identifiable:
            return "not identifiable"
        where = self.regrouping[:, list(self.dependent).index(column)]
        return "regrouped into " + ", ".join(self.names[k] for k in np.flatnonzero(where))

    def reduce(self, standard: ArrayLike) -> Floats:
        """Base parameters (b,) of standard parameters (n_columns,)."""
        x = np.asarray(standard, dtype=np.float64)
        if x.shape != (self.structure.n_columns,):
            raise ConfigurationError(
                f"standard parameters have shape {x.shape}; expected ({self.structure.n_columns},)"
            )
        return x[self.columns] + self.regrouping @ x[self.dependent]

    def expand(self, base: ArrayLike, prior: ArrayLike | None = None) -> Floats:
        """Standard parameters (n_columns,) with these base parameters (b,), nearest to `prior` (default 0).

        Any prior gives the same torque. Parameters without effect keep the prior's value.
        """
        values = np.asarray(base, dtype=np.float64)
        if values.shape != (len(self.columns),):
            raise ConfigurationError(
                f"base parameters have shape {values.shape}; expected ({len(self.columns)},)"
            )
        start = np.zeros(self.structure.n_columns) if prior is None else np.array(prior, dtype=np.float64)
        start[self.excluded] = 0.0
        matrix = self.matrix
        return start + matrix.T @ np.linalg.solve(matrix @ matrix.T, values - self.reduce(start))

    def relation(self, name: str) -> str:
        """The regrouping relation of one base parameter: `MY2R = MY2 + MZ3 + 0.4 M3 + ...`."""
        row = self.index(name)
        terms = [self.structure.names[self.columns[row]]]
        for k in np.flatnonzero(self.regrouping[row]):
            value, symbol = self.regrouping[row, k], self.structure.names[self.dependent[k]]
            size = "" if abs(abs(value) - 1.0) < 1e-12 else f"{abs(value):.10g} "
            terms.append(f"{'-' if value < 0 else '+'} {size}{symbol}")
        return f"{self.names[row]} = {' '.join(terms)}"

    def relations(self) -> tuple[str, ...]:
        """The relations of all base parameters with other parameters regrouped into them."""
        return tuple(self.relation(name) for name in self.names if name.endswith("R"))

    def summary(self) -> str:
        """Counts, gap at the rank, relations and parameters without effect, as text."""
        names = self.structure.names
        lines = [self._counts()]
        if np.isfinite(self.gap):
            lines.append(
                f"singular values fall by {self.gap:.1e} at rank {len(self.columns)} "
                f"(threshold {self.threshold:.1e} of the largest)"
            )
        lines += [f"  {relation}" for relation in self.relations()]
        for label, columns in (("not identifiable", self.not_identifiable), ("left out", self.excluded)):
            if len(columns):
                lines.append(f"{label}: " + " ".join(names[column] for column in columns))
        return "\n".join(lines)


def columns_by_preference(structure: ModelStructure) -> NDArray[np.int64]:
    """All columns, those kept as base parameters in the literature first.

    Khalil's choice: of a revolute joint's link YY, MZ and M are regrouped into the link before it; of a
    prismatic joint's link the six entries of the inertia tensor (and MZ where a rule needs it); lower links
    are kept before higher ones, and inertial parameters before drive inertias.
    """
    size, n = len(PER_LINK), structure.chain.n
    first: list[int] = []
    last: list[int] = []
    for column in range(structure.n_columns):
        link, position = divmod(column, size)
        symbol = PER_LINK[position] if link < structure.n_links else ""
        prismatic = bool(structure.chain.prismatic[min(link, n - 1)]) if symbol else False
        regrouped = ("XX", "XY", "XZ", "YY", "YZ", "ZZ", "MZ") if prismatic else ("YY", "MZ", "M")
        (last if symbol in INERTIAL and symbol in regrouped else first).append(column)
    return np.array(first + last, dtype=np.int64)


def independent_columns(matrix: Floats, order: Sequence[int], tolerance: float) -> list[int]:
    """Columns of `matrix`, in `order`, independent of those taken before them.

    Columns must have norm 1 or 0. A column is taken when its distance from the span of the taken ones exceeds
    `tolerance` (Gram-Schmidt, orthogonalised twice: Giraud, Langou and Rozloznik 2005).
    """
    basis = np.zeros((matrix.shape[0], min(matrix.shape)))
    taken: list[int] = []
    for column in order:
        if len(taken) == basis.shape[1]:
            break
        rest = matrix[:, column]
        span = basis[:, : len(taken)]
        for _ in range(2):
            rest = rest - span @ (rest @ span)
        length = float(np.sqrt(rest @ rest))
        if length > tolerance:
            basis[:, len(taken)] = rest / length
            taken.append(int(column))
    return taken


def base_set(
    structure: ModelStructure,
    conditions: tuple[Condition, ...],
    matrix: Floats,
    *,
    tolerance: float,
    zero: float,
    method: str,
    gap: float = float("inf"),
    threshold: float = 0.0,
) -> BaseSet:
    """Base set of a matrix (any rows, n_columns) with the row space of the observation matrix.

    tolerance : largest distance (columns scaled to norm 1) of a dependent column from the others.
    zero : largest norm, relative to the largest column, of a column without effect.
    """
    norms = np.sqrt(np.einsum("ij,ij->j", matrix, matrix))
    used = norms > zero * norms.max(initial=0.0)
    excluded = np.flatnonzero(~structure.active)
    scaled = matrix / np.where(used, norms, 1.0)
    order = [column for column in columns_by_preference(structure) if used[column]]
    columns = np.array(sorted(independent_columns(scaled, order, tolerance)), dtype=np.int64)
    dependent = np.array(sorted(set(order) - set(columns.tolist())), dtype=np.int64)
    solution = np.linalg.lstsq(scaled[:, columns], scaled[:, dependent], rcond=None)[0]
    # Rounding is at 1e-14; a real coefficient is a product of lengths and cosines.
    solution[np.abs(solution) < _NEGLIGIBLE] = 0.0
    regrouping = solution * norms[dependent] / norms[columns][:, None]
    return BaseSet(
        structure,
        conditions,
        columns,
        dependent,
        regrouping,
        np.array([c for c in np.flatnonzero(~used) if structure.active[c]], dtype=np.int64),
        excluded,
        method,
        gap,
        threshold,
    )


_FLOOR = 1e-8
_SMALLEST_GAP = 1e3
# Columns this small beside the largest are rounding, or an angle a billionth off the right one.
_ZERO = 1e-8


def random_states(
    structure: ModelStructure, samples: int, rng: np.random.Generator
) -> tuple[Floats, Floats, Floats]:
    """q, qd, qdd (samples, n): positions all around, speeds to 2 and accelerations to 5 (rad or m, s)."""
    shape = (samples, structure.chain.n)
    q = rng.uniform(-np.pi, np.pi, shape)
    return q, rng.uniform(-2.0, 2.0, shape), rng.uniform(-5.0, 5.0, shape)


def numeric_base(structure: ModelStructure, conditions: Sequence[Condition] | None = None) -> BaseSet:
    """Base parameters of the stack of `conditions` (default: the bare arm and every payload, all sides).

    The random states, the same in each call, give three rows for each column. Columns are scaled to norm 1. The rank is
    at the largest ratio of consecutive singular values, the smaller below 1e-8 of the largest. Raises DataError without
    a clear gap (1e3), for a nearly degenerate geometry.
    """
    stack = tuple(conditions) if conditions is not None else structure.conditions()
    if not stack:
        raise DataError("no condition was given; at least one session's payload and sides are needed")
    rng = np.random.default_rng(0)
    rows = structure.chain.n * sum(len(structure.condition_sides(condition)) for condition in stack)
    samples = max(16, -(-3 * structure.n_columns // rows))
    parts = [
        structure.regressor(
            *random_states(structure, samples, rng),
            payload=condition.payload,
            sides=structure.condition_sides(condition),
        )
        for condition in stack
    ]
    matrix = np.concatenate([part.T for part in parts], axis=1).T
    norms = np.sqrt(np.einsum("ij,ij->j", matrix, matrix))
    used = norms > _ZERO * norms.max(initial=0.0)
    scaled = matrix[:, used] / norms[used]
    triangle = np.linalg.qr(scaled, mode="r")
    singular = np.linalg.svd(triangle, compute_uv=False)
    rank, gap, threshold = rank_at_gap(singular)
    reduced = np.zeros((len(triangle), structure.n_columns))
    reduced[:, used] = triangle * norms[used]
    found = base_set(
        structure,
        stack,
        reduced,
        tolerance=_FLOOR,
        zero=_ZERO,
        method="numeric",
        gap=gap,
        threshold=threshold,
    )
    if len(found) != rank:
        raise DataError(
            f"the singular values say rank {rank}, the columns {len(found)}; the geometry is nearly "
            "degenerate (an inexact angle or length): check the modified-DH constants"
        )
    return found


def rank_at_gap(singular: Floats) -> tuple[int, float, float]:
    """Rank, gap and the geometric middle of the gap, relative to the first of descending singular values.

    Raises DataError when no gap below 1e-8 of the largest is a factor of 1e3 wide.
    """
    relative = singular / singular[0]
    # One more value at rounding level stands for full rank.
    floor = np.finfo(float).eps * len(singular) * 0.1
    padded = np.append(np.maximum(relative, floor), floor)
    ratios = padded[:-1] / padded[1:]
    ratios[padded[1:] > _FLOOR] = 1.0
    rank = int(np.argmax(ratios)) + 1
    gap = float(ratios[rank - 1])
    if gap < _SMALLEST_GAP:
        raise DataError(
            f"the singular values of the observation matrix fall by no more than {gap:.1e} anywhere, so its "
            "rank is not clear; the geometry is nearly degenerate: check the modified-DH constants"
        )
    return rank, gap, float(np.sqrt(padded[rank - 1] * padded[rank]))
