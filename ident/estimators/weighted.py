"""Weighted least squares, equations (13) and (14): one variance for each joint and side."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ident.estimators.covariance import CovarianceSettings
from ident.estimators.estimate import Estimate
from ident.estimators.problem import FloatArray, Problem, TriangularFactor
from ident.estimators.solution import class_variances, consumed_parameters, estimate_from, factor_of

__all__ = ["WeightedLeastSquares", "weighted_solution"]


@dataclass(frozen=True)
class WeightedLeastSquares:
    """Minimises sum over classes of ||e_c||^2 / sigma_c^2 with sigma_c^2 iterated from the residuals.

    tolerance : largest relative change of a variance at which the iteration stops.
    """

    covariance: CovarianceSettings = field(default_factory=CovarianceSettings)
    iterations: int = 50
    tolerance: float = 1e-6

    def fit(self, problem: Problem) -> Estimate:
        """Estimate (p,), covariance (p, p) and the residuals of each row group."""
        values, weights, factor, done, converged = weighted_solution(problem, self.iterations, self.tolerance)
        root = factor.inverse_root()
        return estimate_from(
            problem,
            method="WLS",
            values=values,
            weights=weights,
            bread=root @ root.T,
            consumed=consumed_parameters(problem, weights, root),
            settings=self.covariance,
            iterations=done,
            converged=converged,
        )


def weighted_solution(
    problem: Problem, iterations: int = 50, tolerance: float = 1e-6
) -> tuple[FloatArray, FloatArray, TriangularFactor, int, bool]:
    """Values (p,), inverse variances (classes,), weighted factor, iterations and whether they converged."""
    weights = np.ones(len(problem.classes))
    factor = factor_of(problem, weights)
    for iteration in range(1, iterations + 1):
        values = factor.solve()
        consumed = consumed_parameters(problem, weights, factor.inverse_root())
        variances = class_variances(problem, values, consumed)
        change = float(np.max(np.abs(variances * weights - 1.0)))
        if iteration > 1 and change < tolerance:
            return values, weights, factor, iteration, True
        weights = 1.0 / variances
        factor = factor_of(problem, weights)
    return factor.solve(), weights, factor, iterations, False
