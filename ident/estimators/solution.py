"""From a solution to a results object: residuals, variances with the right degrees of freedom,
covariances.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fri.errors import DataError
from ident.estimators.covariance import (
    CovarianceSettings,
    Scores,
    bootstrap,
    effective_rows,
    hac,
    jackknife,
    textbook,
)
from ident.estimators.estimate import ClassFit, Covariance, Estimate
from ident.estimators.problem import FloatArray, Problem, TriangularFactor

__all__ = ["class_variances", "consumed_parameters", "estimate_from", "factor_of"]


def factor_of(problem: Problem, weights: FloatArray) -> TriangularFactor:
    """Weighted factor of the whole stack, after the checks that every estimator needs."""
    factor = problem.weighted(weights)
    diagonal = np.abs(np.diag(factor.r)[:-1])
    norms = np.linalg.norm(factor.r[:, :-1], axis=0)
    if problem.rows < len(problem.names) or np.any(diagonal <= 1e-9 * norms):
        problem.require_rank()
    return factor


def consumed_parameters(problem: Problem, weights: FloatArray, root: FloatArray) -> FloatArray:
    """Share of the p parameters that each class consumed, tr(N^-1 w_c A_c^T A_c); the shares sum to p.

    `root` (p, p) with root root^T = N^-1, the inverse weighted normal matrix.
    """
    return np.array(
        [
            weight * float(np.sum((row_class.factor.r[:, :-1] @ root) ** 2))
            for row_class, weight in zip(problem.classes, weights, strict=True)
        ]
    )


def class_variances(problem: Problem, values: FloatArray, consumed: FloatArray) -> FloatArray:
    """sigma_c^2 = ||e_c||^2 / (m_c - p_c) of each class [Nm^2], equation (13)."""
    result = []
    for row_class, share in zip(problem.classes, consumed, strict=True):
        freedom = row_class.factor.rows - share
        if freedom < 1.0:
            raise DataError(
                f"{row_class.label}: {row_class.factor.rows} rows for {share:.1f} parameters leave no "
                "residual; record a longer motion or raise the output rate of the signals"
            )
        result.append(row_class.factor.sum_of_squares(values) / freedom)
    variance = np.array(result)
    floor = np.finfo(float).tiny + 1e-20 * max(float(variance.max()), _mean_square(problem))
    return np.maximum(variance, floor)


def _mean_square(problem: Problem) -> float:
    return sum(float(c.factor.r[:, -1] @ c.factor.r[:, -1]) for c in problem.classes) / max(problem.rows, 1)


def estimate_from(
    problem: Problem,
    *,
    method: str,
    values: FloatArray,
    weights: FloatArray,
    bread: FloatArray,
    consumed: FloatArray,
    settings: CovarianceSettings,
    coefficients: Sequence[FloatArray] | None = None,
    matrices: Sequence[FloatArray] | None = None,
    row_weights: Sequence[FloatArray] | None = None,
    plain: Covariance | None = None,
    scores: Scores | None = None,
    offset: FloatArray | None = None,
    iterations: int = 1,
    converged: bool = True,
    notes: tuple[str, ...] = (),
) -> Estimate:
    """Results object with the covariances that `settings` asks for.

    bread : (p, p), derivative of the estimate by its scores. coefficients : weight times residual of each
        row (default: class weight times residual). matrices : what multiplies them (default: the regressors;
        the instruments of an instrumental-variable estimate). row_weights : what multiplies a a^T of each
        row in the inverse of `bread` (default: class weight). plain : the estimator's own textbook
        covariance.
    scores : in place of coefficients and matrices. offset : (p, p), added to the robust covariances.
    """
    residuals = problem.residuals(values)
    n_eff = effective_rows(problem, residuals)
    fits = []
    for number, row_class in enumerate(problem.classes):
        square = sum(float(residuals[i] @ residuals[i]) for i in row_class.groups)
        rows = row_class.factor.rows
        sigma = np.sqrt(square / max(rows - consumed[number], 1.0))
        rms = np.sqrt(square / max(rows, 1))
        fits.append(
            ClassFit(row_class.joint, row_class.side, rows, float(consumed[number]), float(sigma), float(rms),
                     float(n_eff[number]))
        )  # fmt: skip
    covariances = {"textbook": plain or textbook(bread)}
    if settings.kind != "textbook":
        if coefficients is None:
            coefficients = [
                weights[number] * residual
                for residual, number in zip(residuals, problem.class_of_group, strict=True)
            ]
        if row_weights is None:
            row_weights = [
                np.full(len(group.target), weights[number])
                for group, number in zip(problem.groups, problem.class_of_group, strict=True)
            ]
        covariances |= _robust(
            problem, bread, consumed, settings, weights, coefficients, row_weights, matrices, scores
        )
        if offset is not None:
            covariances = {
                name: replace(c, matrix=c.matrix + offset) if name != "textbook" else c
                for name, c in covariances.items()
            }
    shared = _nuisance_covariance(problem, bread, weights, matrices)
    if shared is not None:
        covariances = {
            name: replace(covariance, matrix=covariance.matrix + shared)
            for name, covariance in covariances.items()
        }
    return Estimate(
        method=method,
        names=problem.names,
        values=values,
        covariance=covariances.get(settings.kind, covariances.get("hac", covariances["textbook"])),
        covariances=covariances,
        classes=tuple(fits),
        weights=weights,
        residuals=residuals,
        iterations=iterations,
        converged=converged,
        notes=notes,
        units=problem.units,
    )


def _robust(
    problem: Problem,
    bread: FloatArray,
    consumed: FloatArray,
    settings: CovarianceSettings,
    weights: FloatArray,
    coefficients: Sequence[FloatArray],
    row_weights: Sequence[FloatArray],
    matrices: Sequence[FloatArray] | None,
    scores: Scores | None,
) -> dict[str, Covariance]:
    """The serial-correlation-robust covariances; without rows of its own (`scores` given) HAC only."""
    rows = np.array([max(row_class.factor.rows, 1) for row_class in problem.classes])
    inflation = np.sqrt(rows / np.maximum(rows - consumed, 1.0))
    if scores is None:
        corrected = [c * inflation[n] for c, n in zip(coefficients, problem.class_of_group, strict=True)]
        summed = Scores.of(problem, corrected, matrices)
    else:
        summed = scores
    robust, bandwidth = hac(summed, bread, problem.sample_time_s, settings.bandwidth_s)
    found = {"hac": robust}
    block = settings.block_s if settings.block_s is not None else 2.0 * bandwidth
    if settings.kind == "bootstrap":
        found["bootstrap"] = bootstrap(problem, weights, block, settings.draws, settings.seed)
    elif settings.kind == "jackknife" and scores is None:
        found["jackknife"] = jackknife(
            problem,
            bread,
            coefficients,
            row_weights,
            block,
            matrices=matrices,
            correlation=robust.matrix,
        )
    return found


def _nuisance_covariance(
    problem: Problem, bread: FloatArray, weights: FloatArray, matrices: Sequence[FloatArray] | None
) -> FloatArray | None:
    """sum of (d chi / d quantity) std^2 (d chi / d quantity)^T over the nuisances, or None without any."""
    active = [nuisance for nuisance in problem.nuisances if nuisance.std > 0]
    if not active:
        return None
    shifts = []
    for nuisance in active:
        moment = np.zeros(len(problem.names))
        for number, column in nuisance.columns.items():
            matrix = problem.groups[number].matrix if matrices is None else matrices[number]
            moment += weights[problem.class_of_group[number]] * (matrix.T @ column)
        shifts.append(nuisance.std * (bread @ moment))
    stacked = np.array(shifts)
    return stacked.T @ stacked


def with_notes(estimate: Estimate, *notes: str) -> Estimate:
    """The same estimate with further notes."""
    return replace(estimate, notes=estimate.notes + notes)
