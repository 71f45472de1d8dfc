"""Iteratively reweighted least squares: rows that fit badly count less (Huber 1964; Beaton and
Tukey 1974).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from ident.estimators.covariance import CovarianceSettings, textbook
from ident.estimators.estimate import Estimate
from ident.estimators.problem import FloatArray, Problem, TriangularFactor
from ident.estimators.solution import consumed_parameters, estimate_from
from ident.estimators.weighted import weighted_solution

__all__ = ["RobustLeastSquares"]

# Constants for 95 % efficiency at the normal law.
_TUNING = {"huber": 1.345, "tukey": 4.685}


@dataclass(frozen=True)
class RobustLeastSquares:
    """M-estimate with the loss of Huber or Tukey and a robust scale (MAD) for each joint and side.

    tuning : threshold in standard deviations; None takes the value of 95 % efficiency at normal residuals.
    """

    loss: Literal["huber", "tukey"] = "huber"
    tuning: float | None = None
    covariance: CovarianceSettings = field(default_factory=CovarianceSettings)
    iterations: int = 100
    tolerance: float = 1e-6

    def fit(self, problem: Problem) -> Estimate:
        """Estimate (p,); the covariance is the M-estimator's
        sandwich with the scores psi(e / sigma) / sigma.
        """
        values, weights, factor, _, _ = weighted_solution(problem)
        consumed = consumed_parameters(problem, weights, factor.inverse_root())
        stages = ("huber",) if self.loss == "huber" else ("huber", "tukey")
        for stage in stages:
            tuning = self.tuning if self.tuning is not None and stage == self.loss else _TUNING[stage]
            values, scales, done, converged = self._iterate(problem, values, consumed, stage, tuning)
        residuals = problem.residuals(values)
        coefficients, slopes, rejected = [], [], 0
        for residual, number in zip(residuals, problem.class_of_group, strict=True):
            u = residual / scales[number]
            weight, slope = _loss(u, self.loss, tuning)
            coefficients.append(weight * u / scales[number])
            slopes.append(np.maximum(slope, 0.0) / scales[number] ** 2)
            rejected += int(np.sum(weight < 0.5))
        bread_factor = _row_weighted(problem, slopes)
        root = bread_factor.inverse_root()
        bread = root @ root.T
        spread = float(np.mean(np.concatenate([(c * scales[n]) ** 2 for c, n in zip(
            coefficients, problem.class_of_group, strict=True)])))  # fmt: skip
        return estimate_from(
            problem,
            method=f"IRLS ({self.loss.capitalize()})",
            values=values,
            weights=1.0 / scales**2,
            bread=bread,
            consumed=consumed,
            settings=self.covariance,
            coefficients=coefficients,
            row_weights=slopes,
            plain=textbook(spread * bread),
            iterations=done,
            converged=converged,
            notes=(f"{rejected} of {problem.rows} rows have less than half weight",),
        )

    def _iterate(
        self, problem: Problem, values: FloatArray, consumed: FloatArray, loss: str, tuning: float
    ) -> tuple[FloatArray, FloatArray, int, bool]:
        scales = _scales(problem, values, consumed)
        for iteration in range(1, self.iterations + 1):
            residuals = problem.residuals(values)
            row_weights = []
            for residual, number in zip(residuals, problem.class_of_group, strict=True):
                weight, _ = _loss(residual / scales[number], loss, tuning)
                row_weights.append(weight / scales[number] ** 2)
            factor = _row_weighted(problem, row_weights)
            new = factor.solve()
            std = np.linalg.norm(factor.inverse_root(), axis=1)
            change = float(np.max(np.abs(new - values) / std))
            values = new
            if loss == "huber":
                scales = _scales(problem, values, consumed)
            if change < max(self.tolerance, 1e-9) * 100.0:
                return values, scales, iteration, True
        return values, scales, self.iterations, False


def _loss(u: FloatArray, loss: str, tuning: float) -> tuple[FloatArray, FloatArray]:
    """Weight psi(u) / u and slope psi'(u)."""
    size = np.abs(u)
    if loss == "huber":
        return np.minimum(1.0, tuning / np.maximum(size, 1e-300)), (size <= tuning).astype(float)
    ratio = np.minimum((u / tuning) ** 2, 1.0)
    return (1.0 - ratio) ** 2, (1.0 - ratio) * (1.0 - 5.0 * ratio)


def _scales(problem: Problem, values: FloatArray, consumed: FloatArray) -> FloatArray:
    """Robust standard deviation (classes,): 1.4826 median |e|, corrected for the parameters consumed."""
    residuals = problem.residuals(values)
    result = []
    for row_class, share in zip(problem.classes, consumed, strict=True):
        size = np.abs(np.concatenate([residuals[index] for index in row_class.groups]))
        correction = np.sqrt(len(size) / max(len(size) - share, 1.0))
        largest = max(float(size.max(initial=0.0)), np.finfo(float).tiny)
        result.append(max(1.4826 * float(np.median(size)) * correction, 1e-9 * largest))
    return np.array(result)


def _row_weighted(problem: Problem, row_weights: list[FloatArray]) -> TriangularFactor:
    parts = []
    for group, weight in zip(problem.groups, row_weights, strict=True):
        root = np.sqrt(weight)
        parts.append(TriangularFactor.of(group.matrix * root[:, None], group.target * root))
    return TriangularFactor.combine(parts, [1.0] * len(parts))
