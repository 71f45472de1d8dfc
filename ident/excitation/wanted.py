"""Which criteria a problem minimises, bounds and reports."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fri.errors import ConfigurationError
from ident.excitation.check import Limits
from ident.excitation.constraints import Bound
from ident.excitation.estimate import ArmEstimate
from ident.excitation.information import Assembly, Columns, Rows
from ident.excitation.mechanism import Mechanism
from ident.excitation.motion import Array
from ident.excitation.objectives import (
    ConditionNumber,
    Criterion,
    DOptimality,
    GoalAttainment,
    MeanTorque,
    RelativeDeviation,
)
from ident.excitation.prior import prior_information
from ident.excitation.problem import PlanProblem

__all__ = ["Criteria", "goal_attainment", "reported_criteria", "wanted_target"]

_NEGLIGIBLE = 1e-9  # parameters this small are zero up to arithmetic


@dataclass(frozen=True, eq=False)
class Criteria:
    """Every criterion that is reported, whatever is optimised."""

    condition: ConditionNumber
    condition_columns: ConditionNumber
    d_optimality: DOptimality
    rsd_mean: RelativeDeviation
    rsd_worst: RelativeDeviation

    def all(self) -> tuple[Criterion, ...]:
        """In the order of the report."""
        return (self.condition, self.condition_columns, self.d_optimality, self.rsd_mean, self.rsd_worst)


def reported_criteria(
    problem: PlanProblem,
    mechanism: Mechanism,
    estimate: ArmEstimate,
    columns: Columns,
    names: tuple[str, ...],
    values: Array,
    sessions: tuple[bool, ...],
) -> Criteria:
    """Every reported criterion for the named parameters and their values."""
    noise = estimate.noise
    assert noise is not None
    label = {"base": "base"}.get(str(problem.parameters), "essential")
    plain = Assembly(columns, names, Rows.unweighted(mechanism.joints, problem.model, sessions))
    weighted = Assembly(columns, names, Rows(problem.model, sessions, noise.joint**-2.0, noise.motor**-2.0))
    prior_plain = prior_information(problem, mechanism, estimate, columns, names, None)
    prior_weighted = prior_information(problem, mechanism, estimate, columns, names, noise)
    # a parameter near zero has no meaningful relative deviation; its own noise floor would rule the mean
    known = np.where(np.abs(values) > _NEGLIGIBLE, np.abs(values), np.inf)
    usable = np.isfinite(known)
    judged, judged_prior = weighted, prior_weighted
    if not usable.all():
        kept = tuple(name for name, use in zip(names, usable, strict=True) if use)
        judged = Assembly(columns, kept, weighted.rows)
        if prior_weighted is not None:
            judged_prior = prior_weighted[np.ix_(usable, usable)]
        known = known[usable]
    condition = ConditionNumber(plain, label, "none", None, prior_plain)
    return Criteria(
        condition=condition,
        condition_columns=ConditionNumber(plain, label, "columns", None, prior_plain),
        d_optimality=DOptimality(weighted, label, noise.samples, prior_weighted),
        rsd_mean=RelativeDeviation(judged, known, label, "mean", noise.samples, judged_prior),
        rsd_worst=RelativeDeviation(judged, known, label, "worst", noise.samples, judged_prior),
    )


def wanted_target(
    problem: PlanProblem, criteria: Criteria, limits: Limits, mechanism: Mechanism
) -> tuple[Criterion, tuple[Bound, ...]]:
    """The criterion to minimise and the bounds on others, as the problem asks."""
    wanted = problem.objective
    condition: ConditionNumber = criteria.condition
    if wanted.scaling == "columns":
        condition = criteria.condition_columns
    elif wanted.scaling == "parameters":
        condition = ConditionNumber(
            condition.assembly, condition.label, "parameters", _scale(criteria), condition.prior
        )
    single: dict[str, Criterion] = {
        "condition_number": condition,
        "d_optimality": criteria.d_optimality,
        "mean_rsd": criteria.rsd_mean,
        "worst_rsd": criteria.rsd_worst,
    }
    target: Criterion
    if wanted.criterion == "goal_attainment":
        if wanted.goal_condition is None:
            raise ConfigurationError(
                "objective: `goal_condition` is not known yet; `plan` finds it by a search for the condition number "
                "alone"
            )
        target = goal_attainment(
            condition, limits, mechanism, wanted.goal_condition, wanted.goal_wrist, wanted.wrist
        )
    else:
        target = single[wanted.criterion]
    bounds = []
    for criterion, limit in (
        (condition, wanted.condition_at_most),
        (criteria.rsd_mean, wanted.mean_rsd_at_most),
        (criteria.rsd_worst, wanted.worst_rsd_at_most),
    ):
        if limit is not None:
            if limit <= 0.0 or (criterion is condition and limit < 1.0):
                raise ConfigurationError(f"objective: bound {limit} on the {criterion.name} can never be met")
            bounds.append(Bound(criterion, float(np.log(limit))))
    return target, tuple(bounds)


def goal_attainment(
    condition: ConditionNumber,
    limits: Limits,
    mechanism: Mechanism,
    goal: float,
    share: float,
    joints: tuple[int, ...],
) -> GoalAttainment:
    """Equation (10): goals `goal` for the condition number and `share` * tau_max for each listed joint (from
    1).
    """
    criteria: list[Criterion] = [condition]
    goals = [goal]
    for number in joints:
        if not 1 <= number <= mechanism.joints:
            raise ConfigurationError(f"objective: wrist joint {number} does not exist")
        peak = float(limits.tau_max[number - 1])
        criteria.append(MeanTorque(number - 1, peak, mechanism.joint_names[number - 1]))
        goals.append(share * peak)
    return GoalAttainment(tuple(criteria), tuple(goals))


def _scale(criteria: Criteria) -> Array:
    if criteria.rsd_mean.values.size != len(criteria.condition.assembly.names):
        raise ConfigurationError("scaling by parameters needs a value for each parameter; some are zero")
    return criteria.rsd_mean.values
