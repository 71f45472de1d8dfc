"""Ordinary, weighted and iteratively reweighted least squares.

Ordinary least squares, equation (11), has one variance for all rows; weighted least squares, equations (13) and
(14), one for each joint and side. Iteratively reweighted least squares gives less weight to rows with large
residuals (Huber 1964; Beaton and Tukey 1974).

`estimate_from` makes the results object of any estimator: residuals, variances with their freedom, covariances.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from fri.errors import DataError
from ident.dynamics.parameters import Floats
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
from ident.estimators.problem import Problem, TriangularFactor


def factor_of(problem: Problem, weights: Floats) -> TriangularFactor:
    """Weighted factor of the whole stack, after the checks common to all estimators."""
    factor = problem.weighted(weights)
    diagonal = np.abs(np.diag(factor.r)[:-1])
    norms = np.linalg.norm(factor.r[:, :-1], axis=0)
    if problem.rows < len(problem.names) or np.any(diagonal <= 1e-9 * norms):
        problem.require_rank()
    return factor


def consumed_parameters(problem: Problem, weights: Floats, root: Floats) -> Floats:
    """Share of the p parameters consumed by each class, tr(N^-1 w_c A_c^T A_c); the shares sum to p.

    `root` (p, p) with root root^T = N^-1, the inverse weighted normal matrix.
    """
    return np.array(
        [
            weight * float(np.sum((row_class.factor.filled[:, :-1] @ root) ** 2))
            for row_class, weight in zip(problem.classes, weights, strict=True)
        ]
    )


def class_variances(problem: Problem, values: Floats, consumed: Floats) -> Floats:
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
    square = sum(float(c.factor.r[:, -1] @ c.factor.r[:, -1]) for c in problem.classes)
    floor = np.finfo(float).tiny + 1e-20 * max(float(variance.max()), square / max(problem.rows, 1))
    return np.maximum(variance, floor)


def estimate_from(
    problem: Problem,
    *,
    method: str,
    values: Floats,
    weights: Floats,
    bread: Floats,
    consumed: Floats,
    settings: CovarianceSettings,
    coefficients: Sequence[Floats] | None = None,
    matrices: Sequence[Floats] | None = None,
    row_weights: Sequence[Floats] | None = None,
    class_weights: Floats | None = None,
    plain: Covariance | None = None,
    scores: Scores | None = None,
    offset: Floats | None = None,
    iterations: int = 1,
    converged: bool = True,
    notes: tuple[str, ...] = (),
) -> Estimate:
    """Results object with the covariances of `settings`.

    bread : (p, p), derivative of the estimate by its scores. coefficients : weight times residual of each
        row (default: class weight times residual). matrices : their matrices (default: the regressors;
        instruments for an instrumental-variable estimate). row_weights : factor of a a^T of each row in the
        inverse of `bread` (default: class weight). class_weights : (classes,) class weights of these two
        defaults, if other than `weights`. plain : the estimator's own textbook covariance.
    scores : in place of coefficients and matrices, for the HAC covariance only.
    offset : (p, p), added to the robust covariances.
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
                     float(n_eff[number]), row_class.unit)
        )  # fmt: skip
    covariances = {"textbook": plain or textbook(bread)}
    by_class = weights if class_weights is None else class_weights
    if settings.kind != "textbook":
        by_group = by_class[list(problem.class_of_group)]
        if coefficients is None:
            coefficients = [weight * e for weight, e in zip(by_group, residuals, strict=True)]
        if row_weights is None:
            row_weights = [np.full(len(e), weight) for weight, e in zip(by_group, residuals, strict=True)]
        summed = scores
        if summed is None:
            rows_of = np.array([max(row_class.factor.rows, 1) for row_class in problem.classes])
            inflation = np.sqrt(rows_of / np.maximum(rows_of - consumed, 1.0))
            corrected = [c * inflation[n] for c, n in zip(coefficients, problem.class_of_group, strict=True)]
            summed = Scores.of(problem, corrected, matrices)
        robust, bandwidth = hac(summed, bread, problem.sample_time_s, settings.bandwidth_s)
        covariances["hac"] = robust
        block = settings.block_s if settings.block_s is not None else 2.0 * bandwidth
        if settings.kind == "bootstrap":
            covariances["bootstrap"] = bootstrap(problem, weights, block, settings.draws, settings.seed)
        elif settings.kind == "jackknife" and scores is None:
            covariances["jackknife"] = jackknife(
                problem,
                bread,
                coefficients,
                row_weights,
                block,
                matrices=matrices,
                correlation=robust.matrix,
                consumed=consumed,
            )
        if offset is not None:
            covariances = {
                name: replace(c, matrix=c.matrix + offset) if name != "textbook" else c
                for name, c in covariances.items()
            }
    shared = nuisance_covariance(problem, bread, by_class, matrices)
    if shared is not None:
        covariances = {name: replace(c, matrix=c.matrix + shared) for name, c in covariances.items()}
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
        bread=bread,
        score_weights=by_class,
    )


def nuisance_covariance(
    problem: Problem, bread: Floats, weights: Floats, matrices: Sequence[Floats] | None = None
) -> Floats | None:
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


@dataclass(frozen=True)
class OrdinaryLeastSquares:
    """Minimises ||Y - Omega chi||; one variance for all rows."""

    covariance: CovarianceSettings = field(default_factory=CovarianceSettings)

    def fit(self, problem: Problem) -> Estimate:
        """Estimate (p,) by QR; textbook covariance sigma^2 (A^T A)^-1."""
        ones = np.ones(len(problem.classes))
        factor = factor_of(problem, ones)
        values = factor.solve()
        root = factor.inverse_root()
        freedom = max(factor.rows - factor.parameters, 1)
        variance = max(factor.sum_of_squares(values) / freedom, np.finfo(float).tiny)
        return estimate_from(
            problem,
            method="OLS",
            values=values,
            weights=ones / variance,
            bread=variance * (root @ root.T),
            consumed=consumed_parameters(problem, ones, root),
            settings=self.covariance,
            plain=textbook(variance * (root @ root.T)),
        )


@dataclass(frozen=True)
class WeightedLeastSquares:
    """Minimises sum over classes of ||e_c||^2 / sigma_c^2 with sigma_c^2 iterated from the residuals.

    tolerance : the iteration stops at this largest relative change of a variance.
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
) -> tuple[Floats, Floats, TriangularFactor, int, bool]:
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


# Constants for 95 % efficiency with normal residuals.
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
        """Estimate (p,), with the M-estimator's sandwich covariance from the scores psi(e / sigma) / sigma."""
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
        self, problem: Problem, values: Floats, consumed: Floats, loss: str, tuning: float
    ) -> tuple[Floats, Floats, int, bool]:
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


def _loss(u: Floats, loss: str, tuning: float) -> tuple[Floats, Floats]:
    """Weight psi(u) / u and slope psi'(u)."""
    size = np.abs(u)
    if loss == "huber":
        return np.minimum(1.0, tuning / np.maximum(size, 1e-300)), (size <= tuning).astype(float)
    ratio = np.minimum((u / tuning) ** 2, 1.0)
    return (1.0 - ratio) ** 2, (1.0 - ratio) * (1.0 - 5.0 * ratio)


def _scales(problem: Problem, values: Floats, consumed: Floats) -> Floats:
    """Robust standard deviation (classes,): 1.4826 median |e|, corrected for the parameters consumed."""
    residuals = problem.residuals(values)
    result = []
    for row_class, share in zip(problem.classes, consumed, strict=True):
        size = np.abs(np.concatenate([residuals[index] for index in row_class.groups]))
        correction = np.sqrt(len(size) / max(len(size) - share, 1.0))
        largest = max(float(size.max(initial=0.0)), np.finfo(float).tiny)
        result.append(max(1.4826 * float(np.median(size)) * correction, 1e-9 * largest))
    return np.array(result)


def _row_weighted(problem: Problem, row_weights: list[Floats]) -> TriangularFactor:
    parts = []
    for group, weight in zip(problem.groups, row_weights, strict=True):
        root = np.sqrt(weight)
        parts.append(TriangularFactor.of(group.matrix * root[:, None], group.target * root))
    return TriangularFactor.combine(parts, [1.0] * len(parts))
