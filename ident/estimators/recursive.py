"""Recursive least squares in square-root form: the estimate while the arm moves.

The information is kept as a triangular factor, updated by orthogonal transformations (Bierman 1977), so it
stays positive definite. Forgetting acts on what was learned, never on the initial information, which prevents
wind-up when the motion excites nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import solve_triangular

from fri.errors import ConfigurationError
from ident.estimators.covariance import CovarianceSettings
from ident.estimators.estimate import Estimate
from ident.estimators.prior import Prior
from ident.estimators.problem import FloatArray, Problem
from ident.estimators.solution import consumed_parameters, estimate_from
from ident.estimators.timeline import instants
from ident.estimators.weighted import weighted_solution

__all__ = ["RecursiveFilter", "RecursiveLeastSquares", "Track"]


class RecursiveFilter:
    """Square-root information filter for p constant or slowly drifting parameters.

    initial : (p + 1, p + 1) triangular factor of the initial information [A y]. forgetting : factor per
        update on the information gathered so far, 1 keeps all.
    """

    def __init__(self, initial: FloatArray, forgetting: float = 1.0) -> None:
        if not 0.0 < forgetting <= 1.0:
            raise ConfigurationError(
                f"forgetting {forgetting} must lie in (0, 1]; 0.99 forgets over 100 updates"
            )
        self._initial = initial
        self._forgetting = forgetting
        self._r = initial.copy()

    @classmethod
    def start(cls, mean: FloatArray, std: FloatArray, forgetting: float = 1.0) -> RecursiveFilter:
        """Filter that begins at `mean` (p,) with standard deviations `std` (p,)."""
        information = 1.0 / np.asarray(std, dtype=np.float64)
        p = len(information)
        r = np.zeros((p + 1, p + 1))
        r[:p, :p] = np.diag(information)
        r[:p, p] = information * mean
        return cls(r, forgetting)

    def update(self, matrix: FloatArray, target: FloatArray, sigma: FloatArray | float) -> None:
        """Take in rows (k, p) with targets (k,) and standard deviations [Nm]."""
        rows = np.column_stack([matrix, target]) / np.broadcast_to(sigma, target.shape)[:, None]
        parts = [np.sqrt(self._forgetting) * self._r, rows]
        if self._forgetting < 1.0:
            parts.append(np.sqrt(1.0 - self._forgetting) * self._initial)
        self._r = np.asarray(np.linalg.qr(np.vstack(parts), mode="r"), dtype=np.float64)

    @property
    def values(self) -> FloatArray:
        """Present estimate (p,)."""
        p = self._r.shape[1] - 1
        return solve_triangular(self._r[:p, :p], self._r[:p, p])

    @property
    def root(self) -> FloatArray:
        """(p, p) with root root^T the covariance that uncorrelated rows would have."""
        p = self._r.shape[1] - 1
        return solve_triangular(self._r[:p, :p], np.eye(p))


@dataclass(frozen=True)
class Track:
    """Course of a recursive estimate: records and time indices (K,), values and standard
    deviations (K, p).
    """

    record: np.ndarray
    time_index: np.ndarray
    values: FloatArray
    std: FloatArray


@dataclass(frozen=True)
class RecursiveLeastSquares:
    """Weighted recursive least squares with forgetting.

    memory_s : time constant of the forgetting [s], None keeps all; then the result is that of WLS.
    prior : where to begin; None begins without information (a standard deviation of `initial_std`).
    sigma : standard deviation of the rows by class label ("A1 motor"); None takes those of a WLS over the
        problem.
    """

    memory_s: float | None = None
    prior: Prior | None = None
    initial_std: float = 1e4
    sigma: dict[str, float] | None = None
    covariance: CovarianceSettings = field(default_factory=CovarianceSettings)

    def start(self, problem: Problem) -> RecursiveFilter:
        """The filter before the first row."""
        forgetting = 1.0
        if self.memory_s is not None:
            forgetting = float(np.exp(-problem.sample_time_s / self.memory_s))
        p = len(problem.names)
        if self.prior is None:
            return RecursiveFilter.start(np.zeros(p), np.full(p, self.initial_std), forgetting)
        faint = np.eye(p) / self.initial_std**2
        r = np.zeros((p + 1, p + 1))
        r[:p, :p] = np.linalg.cholesky(self.prior.precision + faint).T
        r[:p, p] = solve_triangular(r[:p, :p].T, self.prior.precision @ self.prior.mean, lower=True)
        return RecursiveFilter(r, forgetting)

    def track(self, problem: Problem, *, every: int = 1) -> Track:
        """The estimate after every `every`-th instant."""
        sigma, recursion = self._sigma(problem), self.start(problem)
        found: list[tuple[int, int, FloatArray, FloatArray]] = []
        for count, instant in enumerate(instants(problem), start=1):
            recursion.update(instant.matrix, instant.target, sigma[instant.classes])
            if count % every == 0:
                std = np.linalg.norm(recursion.root, axis=1)
                found.append((instant.record, instant.time_index, recursion.values, std))
        record, time_index, values, deviations = zip(*found, strict=True)
        return Track(np.array(record), np.array(time_index), np.array(values), np.array(deviations))

    def fit(self, problem: Problem) -> Estimate:
        """Estimate after the last row; older rows count less where there is forgetting."""
        sigma, recursion = self._sigma(problem), self.start(problem)
        ages: dict[int, dict[int, int]] = {}
        count = 0
        for instant in instants(problem):
            recursion.update(instant.matrix, instant.target, sigma[instant.classes])
            ages.setdefault(instant.record, {})[instant.time_index] = count
            count += 1
        forgetting = 1.0
        if self.memory_s is not None:
            forgetting = float(np.exp(-problem.sample_time_s / self.memory_s))
        values, root, weights = recursion.values, recursion.root, 1.0 / sigma**2
        coefficients, row_weights = [], []
        for group, residual, number in zip(
            problem.groups, problem.residuals(values), problem.class_of_group, strict=True
        ):
            age = count - 1 - np.array([ages[group.record][int(t)] for t in group.time_index])
            row_weights.append(weights[number] * forgetting**age)
            coefficients.append(row_weights[-1] * residual)
        consumed = consumed_parameters(problem, weights, root)
        return estimate_from(
            problem,
            method="recursive least squares",
            values=values,
            weights=weights,
            bread=root @ root.T,
            consumed=np.minimum(consumed, [0.5 * c.factor.rows for c in problem.classes]),
            settings=self.covariance,
            coefficients=coefficients,
            row_weights=row_weights,
            notes=() if self.memory_s is None else (f"forgets with a time constant of {self.memory_s:g} s",),
        )

    def _sigma(self, problem: Problem) -> FloatArray:
        if self.sigma is None:
            _, weights, *_ = weighted_solution(problem)
            return 1.0 / np.sqrt(weights)
        missing = [c.label for c in problem.classes if c.label not in self.sigma]
        if missing:
            raise ConfigurationError(
                f"`sigma` lacks {missing[0]!r}; give a standard deviation for each joint and side"
            )
        return np.array([self.sigma[c.label] for c in problem.classes])
