"""Estimators for a noisy regressor: instrumental variables and total least squares.

Instrumental variables (IDIM-IV, Janot, Vandanjon and Gautier 2014) stay consistent under noise. The instruments
are the regressor on motions free of measurement noise: the states of a simulation with the present estimate
under the same controller and reference, or the commanded motion itself.

Total least squares, mixed and scaled (Golub and Van Loan 1980; Van Huffel and Vandewalle 1991), has errors in the
columns as well as in the torque. Exact columns (offsets) have no error, the others an error of known size
relative to their own root mean square.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from fri.errors import DataError
from ident.dynamics.parameters import Floats
from ident.estimators.covariance import CovarianceSettings, textbook
from ident.estimators.estimate import Estimate
from ident.estimators.least_squares import (
    class_variances,
    consumed_parameters,
    estimate_from,
    factor_of,
    weighted_solution,
)
from ident.estimators.problem import Problem

Instruments = Callable[[Floats], Sequence[Floats]]


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
                    "recorded motion, all joints moving"
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

    def _checked(self, problem: Problem, values: Floats) -> list[Floats]:
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


def _moments(problem: Problem, matrices: Sequence[Floats], weights: Floats) -> tuple[Floats, Floats]:
    p = len(problem.names)
    cross, moment = np.zeros((p, p)), np.zeros(p)
    for group, matrix, number in zip(problem.groups, matrices, problem.class_of_group, strict=True):
        cross += weights[number] * (matrix.T @ group.matrix)
        moment += weights[number] * (matrix.T @ group.target)
    return cross, moment


@dataclass(frozen=True)
class TotalLeastSquares:
    """Minimises ||Y - Omega chi||^2 / (1 + chi^T D chi) over rows weighted as in WLS.

    D holds the variances of the columns' errors over that of the torque. The torque's variance is the residual's
    minus the columns' share; the two are solved for in turn.

    relative_noise : standard deviation of a column's error as a share of the column's root mean square, one
        for all or by parameter name. Encoder noise behind a 10 Hz position filter and a 2 Hz parallel filter
        is 1e-4 to 1e-3, so TLS and WLS agree on such data.
    exact : pattern of the names of columns without error (default: the offsets, columns of ones).
    """

    relative_noise: float | Mapping[str, float] = 1e-3
    exact: str = r"off[lm]"
    covariance: CovarianceSettings = field(default_factory=CovarianceSettings)
    iterations: int = 50

    def fit(self, problem: Problem) -> Estimate:
        """Estimate (p,) from the smallest singular vector, covariance from the scores of the criterion."""
        values, weights, factor, _, _ = weighted_solution(problem)
        p = factor.parameters
        column = self._noise(problem, factor.r[:, :p], factor.rows)
        noisy, clean = np.flatnonzero(column > 0), np.flatnonzero(column == 0)
        consumed = consumed_parameters(problem, weights, factor.inverse_root())
        torque, done, converged = 1.0, 0, not len(noisy)
        while not converged and done < self.iterations:
            done += 1
            new = _solve(factor.r, clean, noisy, column / torque)
            power = factor.sum_of_squares(new) / max(factor.rows - p, 1)
            remaining = power - float(new @ (column**2 * new))
            if remaining < 1e-3 * power:
                raise DataError(
                    "the assumed errors of the columns exceed the whole residual; lower `relative_noise`, "
                    "1e-3 is typical for filtered positions"
                )
            converged = abs(np.sqrt(remaining) / torque - 1.0) < 1e-6
            values, torque = new, float(np.sqrt(remaining))
        spread = (column / torque) ** 2
        scale = 1.0 + float(values @ (spread * values))
        residuals = problem.residuals(values)
        smallest = factor.sum_of_squares(values) / scale
        hessian = (factor.normal - smallest * np.diag(spread)) / (torque**2 * scale)
        bread = np.asarray(np.linalg.inv(hessian), dtype=np.float64)
        weights = weights / (torque**2 * scale)
        # The criterion's gradient is a row's a w e + D chi w e^2 / scale; the second part, summed,
        # cancels the bias.
        correction = spread * values / scale
        matrices = [
            group.matrix + residual[:, None] * correction
            for group, residual in zip(problem.groups, residuals, strict=True)
        ]
        return estimate_from(
            problem,
            method="TLS (mixed, scaled)",
            values=values,
            weights=weights,
            bread=bread,
            consumed=consumed,
            settings=self.covariance,
            matrices=matrices,
            iterations=done,
            converged=converged,
            notes=(f"{len(noisy)} columns with errors, {len(clean)} exact",),
        )

    def _noise(self, problem: Problem, r: Floats, rows: int) -> Floats:
        """Standard deviation (p,) of each column's error in units of the weighted torque noise."""
        rms = np.linalg.norm(r, axis=0) / np.sqrt(rows)
        if isinstance(self.relative_noise, Mapping):
            unknown = set(self.relative_noise) - set(problem.names)
            if unknown:
                raise DataError(f"relative noise is given for {sorted(unknown)[0]!r}, not a parameter")
            share = np.array([self.relative_noise.get(name, 0.0) for name in problem.names])
        else:
            share = np.full(len(problem.names), float(self.relative_noise))
        pattern = re.compile(self.exact)
        share[[bool(pattern.match(name)) for name in problem.names]] = 0.0
        return share * rms


def _solve(r: Floats, clean: NDArray[np.intp], noisy: NDArray[np.intp], level: Floats) -> Floats:
    """Mixed LS-TLS from the weighted triangular factor (p + 1, p + 1)."""
    p = r.shape[1] - 1
    order = np.concatenate([clean, noisy, [p]]).astype(np.int64)
    ordered = np.asarray(np.linalg.qr(r[:, order], mode="r"), dtype=np.float64)
    k = len(clean)
    lower = ordered[k:, k:] / np.append(level[noisy], 1.0)
    vector = np.linalg.svd(lower)[2][-1]
    if abs(vector[-1]) < 1e-12:
        raise DataError(
            "total least squares has no solution: the smallest singular vector leaves the torque out"
        )
    values = np.zeros(p)
    values[noisy] = -vector[:-1] / vector[-1] / level[noisy]
    if k:
        right = ordered[:k, -1] - ordered[:k, k:-1] @ values[noisy]
        values[clean] = solve_triangular(ordered[:k, :k], right)
    return values
