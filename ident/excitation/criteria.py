"""Criteria of a good motion, with one interface and exact derivatives.

A criterion reads a `View` of the motion (Gram matrices and joint torques) and returns its value and a pullback; the
pullback adds the criterion's derivative to the view's adjoints. Positive criteria return their logarithm, so that all
of them can be compared, bounded and combined on one scale; `report` gives the number in its own units.

Condition number and largest relative deviation are not differentiable where extremes coincide, and their optimum lies
at such points. Norms of order `sharpness` replace them, bounding them from above and approaching them as the order
grows: Schatten norms of the matrix and of its inverse for the condition number, a p-norm for the maximum.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve, eigh
from scipy.linalg.lapack import dpotrf, dpotri

from fri.errors import ConfigurationError
from ident.excitation.information import Assembly, View
from ident.excitation.motions import Array

_HUGE = 50.0
_LEAST_EIGENVALUE = 1e-13
Pullback = Callable[[float], None]
_SMALLEST = -0.999  # floor of (F - goal) / goal for a finite logarithm
_SOFTNESS = 0.02  # [Nm]


def log_condition(information: Array, sharpness: float = np.inf) -> tuple[float, Array]:
    """log cond(Omega), half the log of the eigenvalue ratio of Omega^T Omega, and its derivative (p, p)."""
    if np.isinf(sharpness):
        return _log_condition_exact(information)
    power = int(sharpness)
    if power == sharpness and power >= 2 and power & (power - 1) == 0:
        return _log_condition_powers(information, power)
    raise ConfigurationError(f"sharpness {sharpness} is neither a power of two nor infinite")


def _log_condition_exact(information: Array) -> tuple[float, Array]:
    try:
        w, v = eigh(information, check_finite=False, driver="evd")
    except LinAlgError:
        return _HUGE, np.zeros_like(information)
    if not w[0] > _LEAST_EIGENVALUE * w[-1]:
        return _HUGE, np.zeros_like(information)
    value = 0.5 * float(np.log(w[-1] / w[0]))
    return value, 0.5 * (np.outer(v[:, -1], v[:, -1]) / w[-1] - np.outer(v[:, 0], v[:, 0]) / w[0])


def _log_condition_powers(information: Array, power: int) -> tuple[float, Array]:
    """Schatten norms by repeated squaring: several times cheaper than eigenvectors.

    log |H|_p = log(tr H^p) / p with derivative H^(p-1) / tr H^p, and the same for the inverse.
    """
    size = float(np.trace(information))
    inverse = _positive_inverse(information / size) if size > 0.0 else None
    if inverse is None:
        return _HUGE, np.zeros_like(information)
    upper, upper_bar = _log_norm(information / size, power)
    scale = float(np.trace(inverse))
    lower, lower_bar = _log_norm(inverse / scale, power)
    bar = upper_bar - inverse @ (lower_bar @ inverse) / scale
    return 0.5 * (upper + lower + float(np.log(scale))), 0.5 * bar / size


def _log_norm(matrix: Array, power: int) -> tuple[float, Array]:
    """log of the Schatten norm of even order `power` of a positive definite matrix, and its derivative."""
    below, square = matrix, matrix
    log_square = log_below = 0.0  # logs of the divisors of `square` and `below`, against underflow
    for _ in range(power.bit_length() - 2):
        square = square @ square
        size = float(np.trace(square))
        square = square / size
        log_square = 2.0 * log_square + float(np.log(size))
        below = below @ square
        log_below += log_square
    total = float(np.sum(square * square))
    value = (float(np.log(total)) + 2.0 * log_square) / power
    return value, below * (np.exp(log_below - 2.0 * log_square) / total)


def _positive_inverse(matrix: Array) -> Array | None:
    factor, failed = dpotrf(matrix, lower=True, overwrite_a=False)
    if failed:
        return None
    inverse, failed = dpotri(factor, lower=True, overwrite_c=True)
    if failed:
        return None
    lower = np.tril(inverse)
    return np.asarray(lower + np.tril(inverse, -1).T)


def d_optimality(information: Array) -> tuple[float, Array]:
    """-log det(information) / p, and its derivative."""
    p = information.shape[0]
    inverse, logdet = _inverse(information)
    if inverse is None:
        return _HUGE, np.zeros_like(information)
    return -logdet / p, -inverse / p


def relative_deviations(information: Array, values: Array) -> Array:
    """Relative standard deviations (15) in percent, (p,); infinite for singular information."""
    inverse, _ = _inverse(information)
    if inverse is None:
        return np.full(values.shape, np.inf)
    return 100.0 * np.sqrt(np.diag(inverse)) / np.abs(values)


def rsd_mean(information: Array, values: Array) -> tuple[float, Array]:
    """log of the mean relative standard deviation [%], and its derivative."""
    inverse, _ = _inverse(information)
    if inverse is None:
        return _HUGE, np.zeros_like(information)
    deviation = np.sqrt(np.diag(inverse))
    rsd = 100.0 * deviation / np.abs(values)
    total = float(rsd.sum())
    slope = 100.0 / (2.0 * np.abs(values) * deviation) / total
    return float(np.log(total / values.size)), -(inverse * slope) @ inverse


def rsd_worst(information: Array, values: Array, sharpness: float = np.inf) -> tuple[float, Array]:
    """log of the largest relative standard deviation [%] (a norm of order `sharpness`), and its derivative."""
    inverse, _ = _inverse(information)
    if inverse is None:
        return _HUGE, np.zeros_like(information)
    variance = np.diag(inverse)
    rsd = 100.0 * np.sqrt(variance) / np.abs(values)
    peak = float(rsd.max())
    if np.isinf(sharpness):
        share = np.zeros_like(rsd)
        share[int(np.argmax(rsd))] = 1.0
        value = float(np.log(peak))
    else:
        power = (rsd / peak) ** sharpness
        total = float(power.sum())
        share = power / total
        value = float(np.log(peak) + np.log(total) / sharpness)
    slope = share / (2.0 * variance)
    return value, -(inverse * slope) @ inverse


def scaled(information: Array) -> tuple[Array, Array]:
    """Information of the matrix with columns normalised to length one, and the scale 1 / length, (p,)."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-300))
    return information * np.outer(scale, scale), scale


def unscale(bar: Array, normalised: Array, scale: Array) -> Array:
    """Derivative with respect to the information, from the derivative with respect to its normalised form."""
    through = bar * np.outer(scale, scale)
    correction = np.sum(bar * normalised, axis=1) * scale**2
    through[np.diag_indices_from(through)] -= correction
    return through


def _inverse(information: Array) -> tuple[Array | None, float]:
    """Inverse by Cholesky with unit diagonal scaling, and log det; None if not positive definite."""
    normalised, scale = scaled(information)
    try:
        factor = cho_factor(normalised, lower=True, check_finite=False)
    except LinAlgError:
        return None, -np.inf
    diagonal = np.diag(factor[0])
    if diagonal.min() ** 2 < _LEAST_EIGENVALUE:
        return None, -np.inf
    inverse = cho_solve(factor, np.eye(information.shape[0]), check_finite=False)
    logdet = 2.0 * float(np.sum(np.log(diagonal)) - np.sum(np.log(scale)))
    return inverse * np.outer(scale, scale), logdet


class Criterion(ABC):
    """A quantity to be made small."""

    logarithmic: ClassVar[bool] = False

    @property
    @abstractmethod
    def name(self) -> str:
        """The quantity in full: `condition number, essential 49, unscaled`."""

    @abstractmethod
    def evaluate(self, view: View, sharpness: float) -> tuple[float, Pullback]:
        """Value, smoothed by norms of order `sharpness` (inf: exact), and its pullback (adds weight * derivative).

        The logarithm of the quantity for a `logarithmic` criterion, else the quantity itself.
        """

    def report(self, value: float) -> float:
        """The quantity in its own units, from a value of `evaluate`."""
        return float(np.exp(value)) if self.logarithmic else value

    def exact(self, view: View) -> float:
        """The quantity in its own units, without smoothing."""
        return self.report(self.evaluate(view, np.inf)[0])


@dataclass(frozen=True, eq=False, kw_only=True)
class _InformationCriterion(Criterion):
    """A function of the information of some parameters.

    samples : independent samples of each session
    prior : information of earlier sessions in the same weighting, (p, p)
    """

    assembly: Assembly
    label: str
    samples: float = 1.0
    prior: Array | None = None

    def information(self, view: View) -> Array:
        """Information of the planned sessions and the prior ones, (p, p)."""
        information = self.samples * self.assembly.information(view.gram)
        return information if self.prior is None else information + self.prior

    def pullback(self, view: View, bar: Array) -> Pullback:
        """Pullback of a criterion with the derivative `bar` (p, p) with respect to the information."""
        bar = bar * self.samples
        return lambda weight: self.assembly.adjoint(weight * bar, view.gram_bar)


@dataclass(frozen=True, eq=False, kw_only=True)
class ConditionNumber(_InformationCriterion):
    """Condition number of the stacked observation matrix of some parameters.

    scaling : "none", "columns" (each column to length one) or "parameters" (each column times its parameter's value)
    """

    scaling: Literal["none", "columns", "parameters"] = "none"
    values: Array | None = None

    logarithmic = True

    def __post_init__(self) -> None:
        if self.scaling == "parameters" and self.values is None:
            raise ConfigurationError("a condition number scaled by parameters needs their values")

    @property
    def name(self) -> str:
        """Set of columns and scaling."""
        how = {"none": "unscaled", "columns": "columns normalised", "parameters": "scaled by the parameters"}
        return f"condition number, {self.label} {len(self.assembly.names)}, {how[self.scaling]}"

    def evaluate(self, view: View, sharpness: float) -> tuple[float, Pullback]:
        """Logarithm of the condition number."""
        information = self.information(view)
        if self.scaling == "columns":
            normalised, scale = scaled(information)
            value, bar = log_condition(normalised, sharpness)
            bar = unscale(bar, normalised, scale)
        elif self.scaling == "parameters" and self.values is not None:
            outer = np.outer(self.values, self.values)
            value, bar = log_condition(information * outer, sharpness)
            bar = bar * outer
        else:
            value, bar = log_condition(information, sharpness)
        return value, self.pullback(view, bar)


@dataclass(frozen=True, eq=False, kw_only=True)
class DOptimality(_InformationCriterion):
    """-log det of the information per parameter: the size of the confidence ellipsoid, in any units."""

    @property
    def name(self) -> str:
        """Set of columns."""
        return f"D-optimality, {self.label} {len(self.assembly.names)}, -log det per parameter"

    def evaluate(self, view: View, sharpness: float) -> tuple[float, Pullback]:
        """-log det(information) / p."""
        value, bar = d_optimality(self.information(view))
        return value, self.pullback(view, bar)


@dataclass(frozen=True, eq=False, kw_only=True)
class RelativeDeviation(_InformationCriterion):
    """Mean or largest predicted relative standard deviation (15) of the named parameters [%].

    The assembly carries the weights 1/sigma² of the rows. values (p,): magnitudes of the parameters.
    """

    values: Array
    statistic: Literal["mean", "worst"] = "mean"

    logarithmic = True

    @property
    def name(self) -> str:
        """Statistic and set of parameters."""
        return f"{self.statistic} predicted relative deviation, {self.label} {len(self.assembly.names)} [%]"

    def deviations(self, view: View) -> Array:
        """Relative standard deviation of each parameter [%]."""
        return relative_deviations(self.information(view), self.values)

    def evaluate(self, view: View, sharpness: float) -> tuple[float, Pullback]:
        """Logarithm of the statistic."""
        information = self.information(view)
        if self.statistic == "mean":
            value, bar = rsd_mean(information, self.values)
        else:
            value, bar = rsd_worst(information, self.values, sharpness)
        return value, self.pullback(view, bar)


@dataclass(frozen=True)
class MeanTorque(Criterion):
    """Mean over time of tau_max - |joint torque| of one joint, the wrist's criterion of equation (10) [Nm]."""

    joint: int
    tau_max: float
    joint_name: str

    @property
    def name(self) -> str:
        """Quantity and joint."""
        return f"mean of tau_max - |joint torque|, {self.joint_name} [Nm]"

    def evaluate(self, view: View, sharpness: float) -> tuple[float, Pullback]:
        """tau_max - mean |tau|."""
        torque = view.torque[:, self.joint]
        magnitude = torque_magnitude(torque, sharpness)
        slope = -torque / np.maximum(magnitude, 1e-300) / torque.size

        def pull(weight: float) -> None:
            view.torque_bar[:, self.joint] += weight * slope

        return self.tau_max - float(magnitude.mean()), pull


def torque_magnitude(torque: Array, sharpness: float) -> Array:
    """|tau|, rounded off near zero unless exact (infinite sharpness)."""
    return np.sqrt(torque**2 + (0.0 if np.isinf(sharpness) else _SOFTNESS) ** 2)


@dataclass(frozen=True, eq=False)
class GoalAttainment(Criterion):
    """gamma of equation (10): the largest (F_i - goal_i) / |goal_i|, with F_i in reported units."""

    criteria: tuple[Criterion, ...]
    goals: tuple[float, ...]

    def __post_init__(self) -> None:
        if len(self.criteria) != len(self.goals) or not self.criteria:
            raise ConfigurationError(
                f"{len(self.criteria)} criteria with {len(self.goals)} goals; one goal each is needed"
            )
        if any(not goal > 0.0 for goal in self.goals):
            goals = ", ".join(f"{goal:g}" for goal in self.goals)
            raise ConfigurationError(f"goals {goals}: each must be positive, it is its own weight")

    @property
    def name(self) -> str:
        """Goals of each criterion."""
        pairs = zip(self.criteria, self.goals, strict=True)
        return "goal attainment gamma: " + "; ".join(
            f"{criterion.name} -> {goal:g}" for criterion, goal in pairs
        )

    def log_ratios(self, view: View, sharpness: float) -> tuple[Array, list[Pullback]]:
        """log(F_i / goal_i) of each criterion, (k,), with its pullback; the largest is log(1 + gamma)."""
        parts = self._parts(view, sharpness)
        values = np.array([np.log1p(max(value, _SMALLEST)) for value, _ in parts])

        def divided(k: int) -> Pullback:
            pull, ratio = parts[k][1], float(np.exp(values[k]))
            return lambda weight: pull(weight / ratio)

        return values, [divided(k) for k in range(len(parts))]

    def _parts(self, view: View, sharpness: float) -> list[tuple[float, Pullback]]:
        """(F_i - goal_i) / |goal_i| of each criterion with its pullback."""
        return [self._part(*pair, view, sharpness) for pair in zip(self.criteria, self.goals, strict=True)]

    @staticmethod
    def _part(criterion: Criterion, goal: float, view: View, sharpness: float) -> tuple[float, Pullback]:
        value, pull = criterion.evaluate(view, sharpness)
        size = criterion.report(value)
        slope = (size if criterion.logarithmic else 1.0) / abs(goal)
        return (size - goal) / abs(goal), lambda weight: pull(weight * slope)

    def evaluate(self, view: View, sharpness: float) -> tuple[float, Pullback]:
        """Largest part; smoothed by a log-sum-exp of rate 20 * sharpness."""
        parts = self._parts(view, sharpness)
        values = np.array([value for value, _ in parts])
        peak = float(values.max())
        if np.isinf(sharpness):
            share = (values == peak).astype(float)
            share /= share.sum()
            value = peak
        else:
            rate = 20.0 * sharpness
            power = np.exp(rate * (values - peak))
            share = power / power.sum()
            value = peak + float(np.log(power.sum())) / rate

        def pull(weight: float) -> None:
            for part, part_share in zip(parts, share, strict=True):
                if part_share > 0.0:
                    part[1](weight * float(part_share))

        return value, pull
