"""Maximum a posteriori: least squares with a prior model (CAD, or another arm of the series).

The prior has a mean and a covariance; the data decide its weight. Rows count with their effective number, so
that thousands of correlated rows do not overrule the prior.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar, Literal

import numpy as np
from scipy.linalg import solve_triangular

from fri.errors import ConfigurationError, DataError
from ident.dynamics.parameters import Floats
from ident.estimators.covariance import CovarianceSettings, effective_rows
from ident.estimators.estimate import Covariance, Estimate, chi_square_tail
from ident.estimators.least_squares import (
    class_variances,
    consumed_parameters,
    estimate_from,
    nuisance_covariance,
    weighted_solution,
)
from ident.estimators.problem import Problem

# The data say nothing of a parameter while this share of its prior standard deviation is left.
_UNSEEN = 0.9
# Least common factor between data and prior worth a warning, and its standard deviations: masses of a URDF are off by
# up to a third.
_FACTOR, _FACTOR_DEVIATIONS = 0.2, 4.0
# Mean distance of data and prior, and largest probability of it, of which a prior is of another arm.
_FAR, _CHANCE = 3.0, 1e-6


@dataclass(frozen=True)
class Prior:
    """Normal prior: mean (p,) and precision (p, p), the inverse covariance, zero for free parameters."""

    mean: Floats
    precision: Floats

    def __post_init__(self) -> None:
        p = len(self.mean)
        if self.precision.shape != (p, p) or not np.all(np.isfinite(self.precision)):
            raise ConfigurationError(
                f"prior precision has shape {self.precision.shape} or is not finite; give ({p}, {p})"
            )
        if np.linalg.eigvalsh(self.precision)[0] < -1e-9 * max(
            np.abs(self.precision).max(initial=0.0), 1e-300
        ):
            raise ConfigurationError(
                "prior precision is not positive semi-definite; it is an inverse covariance"
            )

    @cached_property
    def root(self) -> Floats:
        """(k, p) with root^T root the precision, without its zero directions."""
        # Parameters of different units differ by many orders of magnitude.
        scale = np.sqrt(np.maximum(np.diag(self.precision), 0.0))
        size = np.where(scale > 0.0, scale, 1.0)
        values, vectors = np.linalg.eigh(self.precision / np.outer(size, size))
        keep = values > 1e-12 * max(values.max(initial=0.0), 1e-300)
        return np.asarray(np.sqrt(values[keep])[:, None] * vectors[:, keep].T * size)

    @classmethod
    def independent(cls, mean: Floats, std: Floats) -> Prior:
        """Independent parameters with standard deviations (p,), infinite for free ones."""
        return cls(
            np.where(np.isfinite(std), mean, 0.0), np.diag(1.0 / np.asarray(std, dtype=np.float64) ** 2)
        )

    @classmethod
    def projected(cls, mean: Floats, covariance: Floats, projection: Floats, known: Floats) -> Prior:
        """Prior of base parameters chi_B = P chi from one of standard parameters.

        mean, covariance : (n,), (n, n) of the standard parameters; projection : P (p, n); known : (p,) bool,
            base parameters under the prior, the others stay free.
        """
        chosen = np.flatnonzero(known)
        part = projection[chosen]
        inner = part @ covariance @ part.T
        scale = np.sqrt(np.diag(inner))
        if np.any(scale <= 0):
            raise ConfigurationError("a base parameter under the prior has no prior variance")
        precision = np.zeros((len(projection),) * 2)
        block = np.linalg.inv(inner / np.outer(scale, scale) + 1e-9 * np.eye(len(chosen))) / np.outer(
            scale, scale
        )
        precision[np.ix_(chosen, chosen)] = 0.5 * (block + block.T)
        full = np.zeros(len(projection))
        full[chosen] = part @ mean
        return cls(full, precision)

    @property
    def std(self) -> Floats:
        """Standard deviations (p,) before the data, infinite for free parameters."""
        known = np.flatnonzero(np.diag(self.precision) > 0.0)
        scale = np.sqrt(np.diag(self.precision)[known])
        block = np.linalg.pinv(self.precision[np.ix_(known, known)] / np.outer(scale, scale), hermitian=True)
        result = np.full(len(self.mean), np.inf)
        result[known] = np.sqrt(np.maximum(np.diag(block), 0.0)) / scale
        return result

    def completed(self, problem: Problem) -> Prior:
        """The same, with a weak prior of its free parameters if the rows leave one of them open.

        Its mean is zero. Its standard deviation is the value with which the parameter's torque has the root mean
        square of the measured torque in its rows: no friction and no offset exceeds the torque.
        """
        factor = problem.weighted(1.0 / np.maximum([c.factor.mean_square for c in problem.classes], 1e-300))
        norms = np.linalg.norm(factor.r[:, :-1], axis=0)
        penalty = self.root
        stacked = np.asarray(np.linalg.qr(np.vstack([factor.r[:, :-1], penalty]), mode="r"))
        if np.all(np.abs(np.diag(stacked)) > 1e-10 * np.linalg.norm(stacked, axis=0)):
            return self
        rows = np.zeros(len(norms))
        for row_class in problem.classes:
            rows += row_class.factor.rows * np.any(row_class.factor.r[:, :-1], axis=0)
        free = np.diag(self.precision) == 0.0
        weak = np.where(norms > 0.0, norms**2 / np.maximum(rows, 1.0), 1.0)
        return replace(self, precision=self.precision + np.diag(np.where(free, weak, 0.0)))


@dataclass(frozen=True)
class Disagreement:
    """Distance of the data from a prior, in standard deviations of prior and data together.

    chi_square, freedom : over the independent combinations of parameters that the data know better than the prior.
    names, deviations : parameters that the data know better than the prior, the farthest from it first.
    factor, factor_std : of the data over the prior, one for all parameters, and its standard deviation by both.
    """

    chi_square: float
    freedom: int
    names: tuple[str, ...]
    deviations: tuple[float, ...]
    factor: float = 1.0
    factor_std: float = np.inf

    @property
    def p_value(self) -> float:
        """Probability of so large a distance from a correct prior."""
        return chi_square_tail(self.chi_square, self.freedom) if self.freedom else 1.0

    @classmethod
    def between(cls, prior: Prior, problem: Problem, weights: Floats) -> Disagreement:
        """Of the rows with a weight for each class, the parameters without prior left free.

        With S the information of the rows and L the prior's, the rows' score at the prior's mean has the
        covariance S L^-1 S + S if the prior holds; the eigenvectors of S relative to L make it diagonal. With all
        parameters 1 + d times the prior's mean m its mean is d S m.
        """
        known = np.flatnonzero(np.diag(prior.precision) > 0.0)
        free = np.flatnonzero(np.diag(prior.precision) == 0.0)
        r = problem.weighted(weights).r
        norms = np.linalg.norm(r, axis=0)
        gram = r.T @ r / np.outer(*[np.where(norms > 0.0, norms, 1.0)] * 2)
        # The score at the prior's mean, in units of the columns' norms.
        score = gram[:-1, -1] * norms[-1] - gram[:-1, :-1][:, known] @ (prior.mean[known] * norms[known])
        inner, cross = gram[np.ix_(free, free)], gram[np.ix_(known, free)]
        solve = np.linalg.pinv(inner, rcond=1e-10, hermitian=True)
        information = gram[np.ix_(known, known)] - cross @ solve @ cross.T
        score = score[known] - cross @ solve @ score[free]
        size = np.where(norms[known] > 0.0, norms[known], 1.0)
        precision = prior.precision[np.ix_(known, known)] / np.outer(size, size)
        root = np.linalg.cholesky(np.linalg.inv(precision))
        gain, vectors = np.linalg.eigh(root.T @ information @ root)
        told = gain > 1.0
        spread = np.sqrt(gain[told] ** 2 + gain[told])
        z = (vectors.T @ root.T @ score)[told] / spread
        slope = (vectors.T @ root.T @ information @ (prior.mean[known] * size))[told] / spread
        power = float(slope @ slope)
        # Bodies whose double the rows would not tell give no factor.
        common = (1.0 + float(slope @ z) / power, power**-0.5) if power > 1.0 else (1.0, np.inf)
        alone = np.linalg.inv(information + 1e-6 * precision)
        std = np.sqrt(np.diag(alone))
        before = np.sqrt(np.diag(root @ root.T))
        single = (alone @ score) / np.hypot(std, before)
        order = [k for k in np.argsort(-np.abs(single)) if std[k] < before[k]]
        return cls(
            float(z @ z),
            int(told.sum()),
            tuple(problem.names[known[k]] for k in order),
            tuple(float(single[k]) for k in order),
            *common,
        )

    @property
    def scaled(self) -> bool:
        """Whether all parameters are off by a factor that is no chance."""
        off = abs(self.factor - 1.0)
        return off > max(_FACTOR, _FACTOR_DEVIATIONS * self.factor_std)

    @property
    def strong(self) -> bool:
        """Whether prior and data can hardly be of one arm."""
        return self.scaled or (self.p_value < _CHANCE and self.chi_square > _FAR**2 * self.freedom)

    def to_dict(self) -> dict[str, Any]:
        """Plain content for files."""
        return {
            "chi_square": self.chi_square,
            "freedom": self.freedom,
            "p_value": self.p_value,
            "deviations": dict(zip(self.names, self.deviations, strict=True)),
            "factor": self.factor,
            "factor_std": self.factor_std if np.isfinite(self.factor_std) else None,
        }

    def __str__(self) -> str:
        if not self.freedom:
            return "the data know no inertia better than the URDF"
        ratio = np.sqrt(self.chi_square / self.freedom)
        beyond = sum(abs(z) > 2.0 for z in self.deviations)
        pairs = zip(self.names[:5], self.deviations[:5], strict=True)
        worst = ", ".join(f"{name} {z:+.1f}" for name, z in pairs)
        single = f"{beyond} of {len(self.names)} parameters beyond two ({worst})"
        if not beyond:
            known = f"beyond two ({worst})" if worst else "known better than from the URDF"
            single = f"in combinations of parameters, no single one {known}"
        if self.scaled:
            return (
                f"the data are {self.factor:.2f} ± {self.factor_std:.2f} times what the URDF's inertials predict, in "
                "all bodies alike: check unit, gear ratio and torque constants, or the masses of the URDF"
            )
        if self.p_value > 0.01:
            return f"the URDF's inertials and the data agree (distance {ratio:.2f} standard deviations)"
        return (
            f"the URDF's inertials and the data disagree: {ratio:.1f} standard deviations on average, {single}; "
            "check masses and tool of the URDF and whether it is of this arm, or use looser deviations "
            "(`estimator.prior_std`)"
        )


@dataclass(frozen=True)
class MaximumAPosteriori:
    """Minimises sum of (n_eff / n) ||e_c||^2 / sigma_c^2 + (chi - chi_0)^T Lambda (chi - chi_0) / s.

    strength : choice of the prior's scale s: "evidence" maximises the marginal likelihood of the data (MacKay
        1992), "cross_validation" predicts blocks of time left out, a number states it (1 takes the prior's own
        standard deviations, a smaller one trusts it more).
    blocks : number of blocks of the cross-validation.

    The rows need not determine all parameters: see `Prior.completed`. The estimate names those that the prior
    determines.
    """

    needs_rank: ClassVar[bool] = False

    prior: Prior
    strength: Literal["evidence", "cross_validation"] | float = "evidence"
    covariance: CovarianceSettings = field(default_factory=CovarianceSettings)
    blocks: int = 6
    iterations: int = 20

    def fit(self, problem: Problem) -> Estimate:
        """Estimate (p,), with the posterior covariance of the effective rows."""
        if len(self.prior.mean) != len(problem.names):
            raise DataError(
                f"the prior has {len(self.prior.mean)} parameters, the problem {len(problem.names)}"
            )
        prior = self.prior.completed(problem)
        values, weights = _start(problem, prior)
        scale, converged = 1.0, False
        iteration = 0
        for iteration in range(1, self.iterations + 1):
            tempered = weights * _shares(problem, values)
            scale_new = self._scale(problem, prior, tempered)
            new, root = _posterior(problem, prior, tempered, scale_new)
            consumed = consumed_parameters(problem, tempered, root)
            weights = 1.0 / class_variances(problem, new, consumed)
            change = float(np.max(np.abs(new - values) / np.linalg.norm(root, axis=1)))
            values = new
            done = abs(np.log(scale_new / scale)) < 1e-3 and change < 1e-3
            scale = scale_new
            if iteration > 1 and done:
                converged = True
                break
        tempered = weights * _shares(problem, values)
        values, root = _posterior(problem, prior, tempered, scale)
        bread = root @ root.T
        before = prior.std * np.sqrt(scale)
        unseen = np.flatnonzero(np.isfinite(before) & (np.sqrt(np.diag(bread)) > _UNSEEN * before))
        how = self.strength.replace("_", "-") if isinstance(self.strength, str) else "stated"
        estimate = estimate_from(
            problem,
            method="MAP",
            values=values,
            weights=weights,
            bread=bread,
            consumed=consumed_parameters(problem, tempered, root),
            settings=self.covariance,
            class_weights=tempered,
            iterations=iteration,
            converged=converged,
            notes=(f"prior standard deviations x {np.sqrt(scale):.3g} ({how})",),
        )
        shared = nuisance_covariance(problem, bread, tempered)
        posterior = Covariance(
            bread if shared is None else bread + shared,
            "posterior with the effective number of rows: holds if the prior does",
        )
        return replace(
            estimate,
            covariance=posterior,
            prior_scale=scale,
            prior_only=tuple(problem.names[k] for k in unseen),
            covariances={**estimate.covariances, "posterior": posterior},
        )

    def _scale(self, problem: Problem, prior: Prior, tempered: Floats) -> float:
        if isinstance(self.strength, (int, float)):
            return float(self.strength)
        from scipy.optimize import minimize_scalar  # on use: its import is slow

        if self.strength == "evidence":
            cost = _evidence_cost(problem, prior, tempered)
        else:
            cost = _cross_validation_cost(problem, prior, tempered, self.blocks)
        grid = np.linspace(-12.0, 12.0, 25)
        coarse = [cost(point) for point in grid]
        best = int(np.argmin(coarse))
        low, high = grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)]
        found = minimize_scalar(cost, bounds=(low, high), method="bounded", options={"xatol": 1e-3})
        return float(np.exp(found.x))


def _start(problem: Problem, prior: Prior) -> tuple[Floats, Floats]:
    """First values and weights; the data alone need not determine the parameters."""
    if not np.any(prior.precision):
        values, weights, *_ = weighted_solution(problem)
        return values, weights
    ones = np.ones(len(problem.classes))
    factor = problem.weighted(ones)
    mean_square = factor.sum_of_squares(np.zeros(factor.parameters)) / max(factor.rows, 1)
    weights = ones / max(1e-4 * mean_square, np.finfo(float).tiny)
    values, root = _posterior(problem, prior, weights, 1.0)
    consumed = consumed_parameters(problem, weights, root)
    return values, 1.0 / class_variances(problem, values, consumed)


def _shares(problem: Problem, values: Floats) -> Floats:
    """n_eff / n of each class."""
    rows = np.array([max(row_class.factor.rows, 1) for row_class in problem.classes])
    return np.minimum(effective_rows(problem, problem.residuals(values)) / rows, 1.0)


def _posterior(problem: Problem, prior: Prior, weights: Floats, scale: float) -> tuple[Floats, Floats]:
    """Values (p,) and root (p, p) with root root^T the posterior covariance."""
    r = problem.weighted(weights).r
    penalty = prior.root / np.sqrt(scale)
    stacked = np.vstack([r, np.column_stack([penalty, penalty @ prior.mean])])
    factor = np.asarray(np.linalg.qr(stacked, mode="r"), dtype=np.float64)
    p = len(prior.mean)
    diagonal = np.abs(np.diag(factor))[:p]
    if np.any(diagonal <= 1e-10 * np.linalg.norm(factor[:, :p], axis=0)):
        problem.require_rank()
    root = np.asarray(solve_triangular(factor[:p, :p], np.eye(p)), dtype=np.float64)
    return root @ factor[:p, p], root


def _evidence_cost(problem: Problem, prior: Prior, weights: Floats) -> Callable[[float], float]:
    """Minus the log marginal likelihood as a function of log s."""
    r = problem.weighted(weights).r
    p = len(prior.mean)
    penalty = prior.root

    def cost(log_scale: float) -> float:
        firm = penalty * np.exp(-0.5 * log_scale)
        stacked = np.vstack([r, np.column_stack([firm, firm @ prior.mean])])
        factor = np.asarray(np.linalg.qr(stacked, mode="r"), dtype=np.float64)
        misfit = float(factor[p, p] ** 2) if len(factor) > p else 0.0
        return (
            float(np.sum(np.log(np.abs(np.diag(factor)[:p])))) + 0.5 * len(penalty) * log_scale + 0.5 * misfit
        )

    return cost


def _cross_validation_cost(
    problem: Problem, prior: Prior, weights: Floats, blocks: int
) -> Callable[[float], float]:
    """Weighted squared error on blocks of time left out, as a function of log s."""
    p = len(prior.mean)
    grams = np.zeros((blocks, p + 1, p + 1))
    for group, number in zip(problem.groups, problem.class_of_group, strict=True):
        if not len(group.target):
            continue
        span = int(group.time_index[-1]) + 1
        block = np.minimum(group.time_index * blocks // span, blocks - 1)
        for part in range(blocks):
            rows = block == part
            augmented = np.column_stack([group.matrix[rows], group.target[rows]])
            grams[part] += weights[number] * (augmented.T @ augmented)
    total = grams.sum(axis=0)

    def cost(log_scale: float) -> float:
        firm = prior.precision * np.exp(-log_scale)
        error = 0.0
        for part in range(blocks):
            rest = total - grams[part]
            normal = rest[:p, :p] + firm
            scale = np.sqrt(np.diag(normal))
            scale[scale == 0] = 1.0
            right = rest[:p, p] + firm @ prior.mean
            values = np.linalg.lstsq(normal / np.outer(scale, scale), right / scale, rcond=1e-12)[0] / scale
            vector = np.append(-values, 1.0)
            error += float(vector @ grams[part] @ vector)
        return error

    return cost
