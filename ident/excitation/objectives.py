"""What makes a motion good: criteria with one interface, exact derivatives, and a name that says what was
measured.

A criterion reads a `View` of the motion (Gram matrices and joint torques) and returns its value and a
pullback, which adds the criterion's derivative to the view's adjoints. Values are logarithms where the
criterion is positive, so that several can be compared, bounded and mixed on one scale; `report` undoes it for
people.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal, Protocol

import numpy as np

from fri.errors import ConfigurationError
from ident.excitation.criteria import (
    d_optimality,
    log_condition,
    relative_deviations,
    rsd_mean,
    rsd_worst,
    scaled,
    unscale,
)
from ident.excitation.information import Assembly
from ident.excitation.motion import Array

__all__ = [
    "ConditionNumber",
    "Criterion",
    "DOptimality",
    "GoalAttainment",
    "MeanTorque",
    "Pullback",
    "RelativeDeviation",
    "TorqueLevel",
    "View",
]

Pullback = Callable[[float], None]

_SMALLEST = -0.999  # of (F - goal) / goal, so that its logarithm exists


@dataclass(eq=False)
class View:
    """One motion as the criteria see it, and the adjoints that they fill.

    gram (n, c, c): mean over the samples of z_j z_j^T
    torque (m, n): joint torque under the last load case [Nm]
    """

    gram: Array
    torque: Array
    gram_bar: Array = field(init=False)
    torque_bar: Array = field(init=False)

    def __post_init__(self) -> None:
        self.gram_bar = np.zeros_like(self.gram)
        self.torque_bar = np.zeros_like(self.torque)

    def clear(self) -> None:
        """Set the adjoints to zero."""
        self.gram_bar[:] = 0.0
        self.torque_bar[:] = 0.0


class Criterion(Protocol):
    """Something to be made small."""

    @property
    def name(self) -> str:
        """What is measured, in full: `condition number, essential 49, unscaled`."""

    def evaluate(self, view: View, sharpness: float) -> tuple[float, Pullback]:
        """Value, smoothed by norms of order `sharpness` (inf: exact), and a function adding weight *
        derivative.
        """

    def report(self, value: float) -> float:
        """The number a person wants to read."""


@dataclass(frozen=True, eq=False)
class ConditionNumber:
    """Condition number of the stacked observation matrix of some parameters.

    scaling : "none", "columns" (each column to length one) or "parameters" (each column times its parameter's
    value)
    prior : information of earlier sessions in the same weighting, per sample of the planned motion; (p, p)
    """

    assembly: Assembly
    label: str
    scaling: Literal["none", "columns", "parameters"] = "none"
    values: Array | None = None
    prior: Array | None = None

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
        information = self.assembly.information(view.gram)
        if self.prior is not None:
            information = information + self.prior
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
        return value, lambda weight: self.assembly.adjoint(weight * bar, view.gram_bar)

    def report(self, value: float) -> float:
        """The condition number itself."""
        return float(np.exp(value))


@dataclass(frozen=True, eq=False)
class DOptimality:
    """-log det of the information per parameter: the size of the confidence ellipsoid, whatever the units."""

    assembly: Assembly
    label: str
    samples: float = 1.0
    prior: Array | None = None

    @property
    def name(self) -> str:
        """Set of columns."""
        return f"D-optimality, {self.label} {len(self.assembly.names)}, -log det per parameter"

    def evaluate(self, view: View, sharpness: float) -> tuple[float, Pullback]:
        """-log det(information) / p."""
        information = self.samples * self.assembly.information(view.gram)
        if self.prior is not None:
            information = information + self.prior
        value, bar = d_optimality(information)
        bar = bar * self.samples
        return value, lambda weight: self.assembly.adjoint(weight * bar, view.gram_bar)

    def report(self, value: float) -> float:
        """The value as it is."""
        return value


@dataclass(frozen=True, eq=False)
class RelativeDeviation:
    """Mean or largest predicted relative standard deviation (15) of the named parameters [%].

    The assembly carries the weights 1/sigma² of the rows, `samples` the independent samples of each session.
    """

    assembly: Assembly
    values: Array
    label: str
    statistic: Literal["mean", "worst"] = "mean"
    samples: float = 100.0
    prior: Array | None = None

    @property
    def name(self) -> str:
        """Statistic and set of parameters."""
        return f"{self.statistic} predicted relative deviation, {self.label} {len(self.assembly.names)} [%]"

    def information(self, view: View) -> Array:
        """Weighted information of the planned sessions and the prior ones."""
        information = self.samples * self.assembly.information(view.gram)
        return information if self.prior is None else information + self.prior

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
        bar = bar * self.samples
        return value, lambda weight: self.assembly.adjoint(weight * bar, view.gram_bar)

    def report(self, value: float) -> float:
        """The deviation in percent."""
        return float(np.exp(value))


@dataclass(frozen=True)
class MeanTorque:
    """Mean over time of tau_max - |joint torque| of one joint, the wrist's criterion of equation (10)
    [Nm].
    """

    joint: int
    tau_max: float
    joint_name: str
    softness: float = 0.02

    @property
    def name(self) -> str:
        """Which joint."""
        return f"mean of tau_max - |joint torque|, {self.joint_name} [Nm]"

    def evaluate(self, view: View, sharpness: float) -> tuple[float, Pullback]:
        """tau_max - mean |tau|; the magnitude is rounded off near zero unless exact."""
        torque = view.torque[:, self.joint]
        soft = 0.0 if np.isinf(sharpness) else self.softness
        magnitude = np.sqrt(torque**2 + soft**2)
        slope = -torque / np.maximum(magnitude, 1e-300) / torque.size

        def pull(weight: float) -> None:
            view.torque_bar[:, self.joint] += weight * slope

        return self.tau_max - float(magnitude.mean()), pull

    def report(self, value: float) -> float:
        """The value as it is."""
        return value


@dataclass(frozen=True)
class TorqueLevel:
    """-sum of weighted logs of the mean |joint torque| of some joints: raises all of them, the low ones
    first.
    """

    joints: tuple[int, ...]
    weights: tuple[float, ...]
    joint_names: tuple[str, ...]
    softness: float = 0.02

    @property
    def name(self) -> str:
        """Which joints, with which weights."""
        parts = ", ".join(f"{w:g} log {name}" for w, name in zip(self.weights, self.joint_names, strict=True))
        return f"- level of mean |joint torque| ({parts})"

    def evaluate(self, view: View, sharpness: float) -> tuple[float, Pullback]:
        """The weighted sum; magnitudes are rounded off near zero unless exact."""
        soft = 0.0 if np.isinf(sharpness) else self.softness
        value, slopes = 0.0, []
        for joint, weight in zip(self.joints, self.weights, strict=True):
            torque = view.torque[:, joint]
            magnitude = np.sqrt(torque**2 + soft**2)
            level = float(magnitude.mean())
            value -= weight * float(np.log(level))
            slopes.append((joint, -weight / level * torque / np.maximum(magnitude, 1e-300) / torque.size))

        def pull(scale: float) -> None:
            for joint, slope in slopes:
                view.torque_bar[:, joint] += scale * slope

        return value, pull

    def report(self, value: float) -> float:
        """The value as it is."""
        return value


@dataclass(frozen=True, eq=False)
class GoalAttainment:
    """gamma of equation (10): the largest (F_i - goal_i) / |goal_i|, with F_i in reported units."""

    criteria: tuple[Criterion, ...]
    goals: tuple[float, ...]

    def __post_init__(self) -> None:
        if len(self.criteria) != len(self.goals) or not self.criteria:
            raise ConfigurationError(
                f"{len(self.criteria)} criteria with {len(self.goals)} goals; one goal each is needed"
            )
        if any(not goal > 0.0 for goal in self.goals):
            raise ConfigurationError(
                f"goals {', '.join(f'{goal:g}' for goal in self.goals)}: each must be positive, it is its own weight"
            )

    @property
    def name(self) -> str:
        """Goals of each criterion."""
        pairs = zip(self.criteria, self.goals, strict=True)
        return "goal attainment gamma: " + "; ".join(
            f"{criterion.name} -> {goal:g}" for criterion, goal in pairs
        )

    def attainment(self, view: View) -> Array:
        """(F_i - goal_i) / |goal_i| of each criterion, exact."""
        parts = [self._part(k, view, np.inf)[0] for k in range(len(self.criteria))]
        return np.array(parts)

    def log_ratios(self, view: View, sharpness: float) -> tuple[Array, list[Pullback]]:
        """log(F_i / goal_i) of each criterion, (k,), with its pullback; the largest is log(1 + gamma)."""
        parts = [self._part(k, view, sharpness) for k in range(len(self.criteria))]
        values = np.array([np.log1p(max(value, _SMALLEST)) for value, _ in parts])

        def scaled(k: int) -> Pullback:
            pull, ratio = parts[k][1], float(np.exp(values[k]))
            return lambda weight: pull(weight / ratio)

        return values, [scaled(k) for k in range(len(parts))]

    def _part(self, k: int, view: View, sharpness: float) -> tuple[float, Pullback]:
        criterion, goal = self.criteria[k], self.goals[k]
        value, pull = criterion.evaluate(view, sharpness)
        size = criterion.report(value)
        slope = (size if not isinstance(criterion, (MeanTorque, TorqueLevel, DOptimality)) else 1.0) / abs(
            goal
        )
        return (size - goal) / abs(goal), lambda weight: pull(weight * slope)

    def evaluate(self, view: View, sharpness: float) -> tuple[float, Pullback]:
        """Largest part; smoothed by a log-sum-exp of rate 20 * sharpness."""
        parts = [self._part(k, view, sharpness) for k in range(len(self.criteria))]
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

    def report(self, value: float) -> float:
        """Gamma as it is."""
        return value
