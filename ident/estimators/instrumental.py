"""Instrumental variables (IDIM-IV, Janot, Vandanjon and Gautier 2014): consistent when the regressor is
noisy.

The instruments are the regressor evaluated on motions that the measurement noise has not touched: the states
of a simulation with the present estimate under the same controller and reference, or the commanded motion
itself.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from fri.errors import DataError
from ident.estimators.covariance import CovarianceSettings, textbook
from ident.estimators.estimate import Estimate
from ident.estimators.problem import FloatArray, Problem
from ident.estimators.solution import class_variances, consumed_parameters, estimate_from, factor_of
from ident.estimators.weighted import weighted_solution

__all__ = ["InstrumentalVariables", "Instruments"]

Instruments = Callable[[FloatArray], Sequence[FloatArray]]


@dataclass(frozen=True)
class InstrumentalVariables:
    """chi = (Z^T R^-1 Omega)^-1 Z^T R^-1 Y, repeated with the instruments Z(chi) of the last estimate.

    instruments : maps an estimate (p,) to one (m, p) matrix for each row group of the problem.
    """

    instruments: Instruments
    covariance: CovarianceSettings = field(default_factory=CovarianceSettings)
    iterations: int = 20
    tolerance: float = 0.01

    def fit(self, problem: Problem) -> Estimate:
        """Estimate (p,); stops when no parameter moves by more than `tolerance` standard deviations."""
        values, weights, factor, _, _ = weighted_solution(problem)
        root = factor.inverse_root()
        consumed = consumed_parameters(problem, weights, root)
        converged, done = False, 0
        for iteration in range(1, self.iterations + 1):
            done = iteration
            matrices = self._checked(problem, values)
            cross, moment = _moments(problem, matrices, weights)
            scale = np.sqrt(np.diag(factor.normal))
            scaled = cross / np.outer(scale, scale)
            condition = float(np.linalg.cond(scaled))
            if not condition < 1e12:
                raise DataError(
                    f"the instruments do not span the parameters (condition {condition:.1e}); simulate the "
                    "same motion that was recorded, all joints moving"
                )
            bread = np.asarray(np.linalg.inv(scaled) / np.outer(scale, scale), dtype=np.float64)
            new = bread @ moment
            change = float(np.max(np.abs(new - values) / np.linalg.norm(root, axis=1)))
            values = new
            weights = 1.0 / class_variances(problem, values, consumed)
            factor = factor_of(problem, weights)
            root = factor.inverse_root()
            if change < self.tolerance:
                converged = True
                break
        # The last weights belong to the last values: one more solution with both in step.
        cross, moment = _moments(problem, matrices, weights)
        bread = np.asarray(np.linalg.inv(cross), dtype=np.float64)
        values = bread @ moment
        square = sum(
            weights[number] * (z.T @ z) for z, number in zip(matrices, problem.class_of_group, strict=True)
        )
        return estimate_from(
            problem,
            method="IDIM-IV",
            values=values,
            weights=weights,
            bread=bread,
            consumed=consumed,
            settings=self.covariance,
            matrices=matrices,
            plain=textbook(bread @ square @ bread.T),
            iterations=done,
            converged=converged,
        )

    def _checked(self, problem: Problem, values: FloatArray) -> list[FloatArray]:
        matrices = [np.asarray(matrix, dtype=np.float64) for matrix in self.instruments(values)]
        if len(matrices) != len(problem.groups):
            raise DataError(
                f"{len(matrices)} instrument matrices for {len(problem.groups)} row groups; give one each"
            )
        for matrix, group in zip(matrices, problem.groups, strict=True):
            if matrix.shape != group.matrix.shape or not np.all(np.isfinite(matrix)):
                raise DataError(
                    f"{group.label}: instruments of shape {matrix.shape} are not finite or do not match "
                    f"the rows {group.matrix.shape}; evaluate them at the same times"
                )
        return matrices


def _moments(
    problem: Problem, matrices: Sequence[FloatArray], weights: FloatArray
) -> tuple[FloatArray, FloatArray]:
    p = len(problem.names)
    cross, moment = np.zeros((p, p)), np.zeros(p)
    for group, matrix, number in zip(problem.groups, matrices, problem.class_of_group, strict=True):
        cross += weights[number] * (matrix.T @ group.matrix)
        moment += weights[number] * (matrix.T @ group.target)
    return cross, moment
