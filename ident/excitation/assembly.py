"""The planning problem with its files read: arm, limits, criteria, prior information, optimiser set-up, checks.

Prior sessions count by their information: the criteria act on the sum of prior and planned information (sequential
design), so a new motion is strong where earlier motions were weak.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from fri.errors import ConfigurationError
from ident.dynamics.base_closed_form import closed_form_base
from ident.dynamics.structure import Condition, ModelStructure
from ident.excitation.arm_model import BODY, ArmEstimate, Mechanism, Noise, split_name
from ident.excitation.check import Check, Limits, check_motion
from ident.excitation.clearance import space_of
from ident.excitation.criteria import (
    ConditionNumber,
    Criterion,
    DOptimality,
    GoalAttainment,
    MeanTorque,
    RelativeDeviation,
)
from ident.excitation.information import Assembly, Columns, Rows, View, motion_view, samples_view
from ident.excitation.motions import Array, Basis, FourierBasis, ParametricMotion, Samples, SplineBasis
from ident.excitation.plan import ExcitationPlan
from ident.excitation.problem import Objective, PlanProblem, Prior
from ident.excitation.program import Bound, Setup
from ident.model.model_file import read_model
from ident.rows.prepare import prepare
from ident.rows.sessions import payload_name
from lwr_driver.arm import Arm
from lwr_driver.arm.cell import Cell
from lwr_driver.arm.collision import CollisionChecker
from lwr_driver.configuration import find, read_mapping
from lwr_driver.session import read_session

_FLANGE_RESERVE = 2e-3
_CLEARANCE_RESERVE = 3e-3
_PAYLOAD_NAME = "load"
_NEGLIGIBLE = 1e-9  # parameters this small are zero up to arithmetic


@dataclass(frozen=True, eq=False)
class Assembled:
    """The problem, the optimiser's set-up, the criteria, and the inputs of the final check."""

    problem: PlanProblem
    setup: Setup
    criteria: Criteria
    arm_name: str
    resonance_hz: float
    checker: CollisionChecker | None
    clearance_m: float
    row_names: tuple[str, ...]

    def __repr__(self) -> str:
        return (
            f"Assembled problem {self.problem.name}: {self.arm_name}, {len(self.criteria.names)} parameters"
        )

    def check(self, motion: ParametricMotion, *, continuous: bool = True) -> Check:
        """Every limit, at the exact extrema, on the 1 ms grid and proven in between."""
        return check_motion(
            motion,
            self.setup.mechanism,
            self.setup.limits,
            workspace=self.problem.workspace,
            estimate=self.setup.estimate,
            coverage=self.setup.coverage,
            checker=self.checker,
            clearance_m=self.clearance_m,
            continuous=continuous,
        )

    def view(self, motion: ParametricMotion, step_s: float = 0.01) -> View:
        """The motion on a dense grid with the true sign of the velocities."""
        setup = self.setup
        return motion_view(motion, setup.mechanism, setup.estimate, setup.columns, step_s)

    def bound_excess(self, motion: ParametricMotion) -> float:
        """Largest excess over a bound on another criterion, on its logarithmic scale."""
        if not self.setup.bounds:
            return 0.0
        view = self.view(motion)
        return max(bound.criterion.evaluate(view, np.inf)[0] - bound.limit for bound in self.setup.bounds)

    def describe(self, motion: ParametricMotion) -> tuple[dict[str, float], dict[str, float]]:
        """Reported value of every criterion, and the predicted relative deviation of every parameter [%]."""
        view = self.view(motion)
        values: dict[str, float] = {}
        listed: list[Criterion] = list(self.criteria.all())
        target = self.setup.target
        if isinstance(target, GoalAttainment):
            listed += [target, *target.criteria]
        elif target is not None and all(target.name != criterion.name for criterion in listed):
            listed.append(target)
        for criterion in listed:
            values[criterion.name] = criterion.exact(view)
        for joint, name in enumerate(self.setup.mechanism.joint_names):
            values[f"mean |joint torque| {name} [Nm]"] = float(np.mean(np.abs(view.torque[:, joint])))
        deviations = self.criteria.rsd_mean.deviations(view)
        names = self.criteria.rsd_mean.assembly.names
        return values, {name: float(value) for name, value in zip(names, deviations, strict=True)}


def arm_limits(arm: Arm, speed_scale: float = 1.0) -> Limits:
    """The limits of an arm, less its position margin, with speeds scaled in time."""
    return Limits(arm.q_low, arm.q_high, arm.v_max, arm.a_max, arm.j_max, arm.tau_max).scaled(speed_scale)


def assemble(problem: PlanProblem) -> Assembled:
    """Read every file named by the problem and build the criteria; ConfigurationError for contradictions."""
    beside = problem.source.parent if problem.source is not None else None
    arm = Arm.load(problem.arm, beside=beside)
    cell = Cell.load(problem.cell, beside=beside)
    mechanism = Mechanism.from_urdf(arm.urdf)
    limits = arm_limits(arm, problem.speed_scale)
    checker = CollisionChecker(arm, cell, problem.payload_shape)
    clearance = cell.margin_m if problem.clearance_m is None else problem.clearance_m
    estimate, model_names = _estimate(problem, mechanism, beside)
    names, values = _parameters(problem, mechanism, estimate, model_names)
    sessions = tuple(session == "loaded" for session in problem.sessions)
    if not any(sessions):
        kept = [k for k, name in enumerate(names) if split_name(name)[1] <= mechanism.joints]
        names, values = tuple(names[k] for k in kept), values[kept]
    columns = Columns.of(mechanism.joints, names)
    criteria = reported_criteria(problem, mechanism, estimate, columns, names, values, sessions)
    target, bounds = target_and_bounds(problem, criteria, limits, mechanism)
    space, row_names = space_of(mechanism, checker.geometry)
    work = problem.workspace
    floor = space.floor(clearance + _CLEARANCE_RESERVE, (work.radius_m, work.height_m), _FLANGE_RESERVE)
    form = problem.motion
    basis: Basis = (
        FourierBasis(form.period_s, form.harmonics)
        if form.type == "fourier"
        else SplineBasis(form.period_s, form.control_points)
    )
    setup = Setup(
        mechanism=mechanism,
        basis=basis,
        limits=limits,
        space=space,
        floor=floor,
        estimate=estimate,
        columns=columns,
        target=target,
        bounds=bounds,
        coverage=problem.knowledge.coverage,
        **sampling(basis),
    )
    return Assembled(problem, setup, criteria, arm.name, arm.resonance_hz, checker, clearance, row_names)


def sampling(basis: Basis) -> dict[str, Any]:
    """Samples for the Gram matrices (a few per shortest period) and refinement for everything kinematic."""
    functions = getattr(basis, "harmonics", None)
    samples = 64 if functions is None else max(64, 10 * int(functions))
    return {"samples": samples, "refine": max(3, int(np.ceil(basis.duration / 0.0625 / samples)))}


def _estimate(
    problem: PlanProblem, mechanism: Mechanism, beside: Path | None
) -> tuple[ArmEstimate, tuple[str, ...]]:
    knowledge = problem.knowledge
    path = find(knowledge.file, beside=beside)
    names: tuple[str, ...] = ()
    content = read_mapping(path)
    if "chain" in content:
        model = read_model(path)
        estimate = ArmEstimate.from_model(model, knowledge.payload)
        names = model.names
    else:
        estimate = ArmEstimate.from_file(path, mechanism.joints, knowledge.payload)
    if estimate.joints != mechanism.joints:
        raise ConfigurationError(f"{path}: {estimate.joints} joints; the arm has {mechanism.joints}")
    if estimate.covariance is None and knowledge.relative_uncertainty > 0.0:
        estimate = estimate.with_relative_uncertainty(knowledge.relative_uncertainty)
    if knowledge.noise_motor or knowledge.noise_joint:
        noise = Noise(np.array(knowledge.noise_motor), np.array(knowledge.noise_joint))
    elif mechanism.joints == 7:
        noise = Noise.published()
    else:
        noise = Noise(np.ones(mechanism.joints), np.ones(mechanism.joints))
    for side in (noise.motor, noise.joint):
        if side.size != mechanism.joints:
            raise ConfigurationError(
                f"knowledge: noise of {side.size} rows; the arm has {mechanism.joints} joints"
            )
    return replace(estimate, noise=replace(noise, samples=knowledge.samples)), names


def _parameters(
    problem: PlanProblem, mechanism: Mechanism, estimate: ArmEstimate, model_names: tuple[str, ...]
) -> tuple[tuple[str, ...], Array]:
    """Names and (regrouped) values of the parameters in the criteria."""
    payloads = (_PAYLOAD_NAME,) if "loaded" in problem.sessions else ()
    conditions = {
        session: Condition(_PAYLOAD_NAME if session == "loaded" else None) for session in problem.sessions
    }
    structure = ModelStructure(mechanism.chain, problem.model, payloads=payloads)
    base = closed_form_base(structure, tuple(conditions.values()))
    standard = np.zeros(base.structure.n_columns)
    for column, name in enumerate(base.structure.names):
        kind, link = split_name(name)
        if link <= mechanism.joints or kind in BODY:
            standard[column] = estimate.value(name)
    all_values = base.reduce(standard)
    if problem.parameters == "base":
        return base.names, all_values
    if problem.parameters == "model":
        if not model_names:
            raise ConfigurationError(
                "parameters `model` needs a model.yaml as `knowledge.file`; use base or a list"
            )
        chosen = model_names
    else:
        chosen = tuple(problem.parameters)
    index = [base.index(name) for name in chosen]
    return tuple(base.names[k] for k in index), all_values[index]


@dataclass(frozen=True, eq=False)
class Criteria:
    """The reported criteria, independent of the objective."""

    condition: ConditionNumber
    condition_columns: ConditionNumber
    d_optimality: DOptimality
    rsd_mean: RelativeDeviation
    rsd_worst: RelativeDeviation

    def all(self) -> tuple[Criterion, ...]:
        """In the order of the report."""
        return (self.condition, self.condition_columns, self.d_optimality, self.rsd_mean, self.rsd_worst)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return self.condition.assembly.names


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
    label = "base" if problem.parameters == "base" else "essential"
    plain = Assembly(columns, names, Rows.unweighted(mechanism.joints, problem.model, sessions))
    weighted = Assembly(columns, names, Rows(problem.model, sessions, noise.joint**-2.0, noise.motor**-2.0))
    prior_plain, prior_weighted = prior_information(problem, mechanism, estimate, columns, names)
    # a parameter near zero has no meaningful relative deviation, and its noise would dominate the mean
    known = np.where(np.abs(values) > _NEGLIGIBLE, np.abs(values), np.inf)
    usable = np.isfinite(known)
    judged, judged_prior = weighted, prior_weighted
    if not usable.all():
        kept = tuple(name for name, use in zip(names, usable, strict=True) if use)
        judged = Assembly(columns, kept, weighted.rows)
        if prior_weighted is not None:
            judged_prior = prior_weighted[np.ix_(usable, usable)]
        known = known[usable]
    condition = ConditionNumber(assembly=plain, label=label, prior=prior_plain)
    rsd_mean = RelativeDeviation(
        assembly=judged, label=label, samples=noise.samples, prior=judged_prior, values=known
    )
    return Criteria(
        condition=condition,
        condition_columns=replace(condition, scaling="columns"),
        d_optimality=DOptimality(assembly=weighted, label=label, samples=noise.samples, prior=prior_weighted),
        rsd_mean=rsd_mean,
        rsd_worst=replace(rsd_mean, statistic="worst"),
    )


def target_and_bounds(
    problem: PlanProblem, criteria: Criteria, limits: Limits, mechanism: Mechanism
) -> tuple[Criterion, tuple[Bound, ...]]:
    """The criterion to minimise and the bounds on others."""
    objective = problem.objective
    condition: ConditionNumber = criteria.condition
    if objective.scaling == "columns":
        condition = criteria.condition_columns
    elif objective.scaling == "parameters":
        values = criteria.rsd_mean.values
        if values.size != len(criteria.names):
            raise ConfigurationError("scaling by parameters needs a value for each parameter; some are zero")
        condition = replace(condition, scaling="parameters", values=values)
    single: dict[str, Criterion] = {
        "condition_number": condition,
        "d_optimality": criteria.d_optimality,
        "mean_rsd": criteria.rsd_mean,
        "worst_rsd": criteria.rsd_worst,
    }
    target: Criterion
    if objective.criterion == "goal_attainment":
        target = _goals(condition, limits, mechanism, objective)
    else:
        target = single[objective.criterion]
    bounds = []
    for criterion, limit in (
        (condition, objective.condition_at_most),
        (criteria.rsd_mean, objective.mean_rsd_at_most),
        (criteria.rsd_worst, objective.worst_rsd_at_most),
    ):
        if limit is not None:
            if limit <= 0.0 or (criterion is condition and limit < 1.0):
                raise ConfigurationError(f"objective: bound {limit} on the {criterion.name} can never be met")
            bounds.append(Bound(criterion, float(np.log(limit))))
    return target, tuple(bounds)


def _goals(
    condition: ConditionNumber, limits: Limits, mechanism: Mechanism, objective: Objective
) -> GoalAttainment:
    """Equation (10): goals for the condition number and, as a share of tau_max, for each wrist joint."""
    if objective.goal_condition is None:
        raise ConfigurationError(
            "objective: `goal_condition` is missing; `plan` finds it by a search for the condition number alone"
        )
    criteria: list[Criterion] = [condition]
    goals = [objective.goal_condition]
    for number in objective.wrist:
        if not 1 <= number <= mechanism.joints:
            raise ConfigurationError(f"objective: wrist joint {number} does not exist")
        peak = float(limits.tau_max[number - 1])
        criteria.append(MeanTorque(number - 1, peak, mechanism.joint_names[number - 1]))
        goals.append(objective.goal_wrist * peak)
    return GoalAttainment(tuple(criteria), tuple(goals))


def prior_information(
    problem: PlanProblem,
    mechanism: Mechanism,
    estimate: ArmEstimate,
    columns: Columns,
    names: tuple[str, ...],
) -> tuple[Array, Array] | tuple[None, None]:
    """Information (p, p) of all priors, unweighted and weighted by the noise; None without any.

    Unweighted in multiples of one planned session, for the condition number; weighted in independent samples at the
    rate of the planned sessions.
    """
    if not problem.prior:
        return None, None
    noise = estimate.noise
    assert noise is not None
    planned = problem.motion.periods * problem.motion.period_s
    plain, weighted = np.zeros((2, len(names), len(names)))
    for entry in problem.prior:
        for loaded, view, duration in _motions(problem, entry, mechanism, estimate, columns):
            rows = Rows.unweighted(mechanism.joints, problem.model, (loaded,))
            plain += duration / planned * Assembly(columns, names, rows).information(view.gram)
            rows = Rows(problem.model, (loaded,), noise.joint**-2.0, noise.motor**-2.0)
            share = noise.samples * duration / planned
            weighted += share * Assembly(columns, names, rows).information(view.gram)
    return plain, weighted


def _motions(
    problem: PlanProblem, entry: Prior, mechanism: Mechanism, estimate: ArmEstimate, columns: Columns
) -> list[tuple[bool, View, float]]:
    """Loaded or not, view and duration [s] of each session of one prior."""
    beside = problem.source.parent if problem.source is not None else None
    if entry.plan is not None:
        done = ExcitationPlan.load(find(entry.plan, beside=beside))
        if done.joint_names != mechanism.joint_names:
            raise ConfigurationError(f"prior plan {entry.plan} is for joints {' '.join(done.joint_names)}")
        view = motion_view(done.motion, mechanism, estimate, columns)
        return [(session == "loaded", view, done.duration_s) for session in entry.sessions]
    assert entry.session is not None
    return [_recorded(find(entry.session, beside=beside), mechanism, estimate, columns)]


def _recorded(
    path: Path, mechanism: Mechanism, estimate: ArmEstimate, columns: Columns
) -> tuple[bool, View, float]:
    session = read_session(path).select(mechanism.joint_names)
    prepared = prepare(session, motor=False)
    parts = [[getattr(passage.joint, key) for passage in prepared.passages] for key in ("q", "qd", "qdd")]
    q, qd, qdd = (np.ascontiguousarray(np.vstack(part)) for part in parts)
    duration = sum(len(passage.rows) for passage in prepared.passages) * prepared.row_time_s
    loaded = payload_name(session) is not None
    view = samples_view(Samples(q, qd, qdd, np.zeros_like(q)), mechanism, estimate, columns)
    return loaded, view, float(duration)
