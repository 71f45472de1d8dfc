"""A planning problem made concrete: the arm, its limits, the criteria, and the checks, built from the
problem file.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fri.errors import ConfigurationError
from ident.base import BaseSet, closed_form_base
from ident.excitation.bspline import SplineBasis
from ident.excitation.capsules import space_of
from ident.excitation.check import Check, Limits, PathChecker, check_motion
from ident.excitation.estimate import ArmEstimate, Noise, split_name
from ident.excitation.fourier import FourierBasis
from ident.excitation.information import Columns
from ident.excitation.mechanism import Mechanism
from ident.excitation.motion import Array, Basis, ParametricMotion
from ident.excitation.objectives import (
    Criterion,
    GoalAttainment,
    View,
)
from ident.excitation.problem import PlanProblem
from ident.excitation.search import Setup
from ident.excitation.views import motion_view
from ident.excitation.wanted import Criteria, reported_criteria, wanted_target
from ident.model_file import read_model
from ident.structure import Condition, ModelStructure
from lwr_driver.arm import Arm
from lwr_driver.arm.cell import Cell
from lwr_driver.arm.collision import CollisionChecker
from lwr_driver.configuration import find, read_mapping

__all__ = ["Assembled", "assemble"]

_FLANGE_RESERVE = 2e-3
_CLEARANCE_RESERVE = 3e-3
_PAYLOAD_NAME = "load"


@dataclass(frozen=True, eq=False)
class Assembled:
    """The problem, the optimiser's set-up, and what the final check needs."""

    problem: PlanProblem
    setup: Setup
    criteria: Criteria
    arm_name: str
    resonance_hz: float
    checker: PathChecker | None
    clearance_m: float
    row_names: tuple[str, ...]

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
        """By how much the worst bound on another criterion is exceeded, on its logarithmic scale."""
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
            values[criterion.name] = criterion.report(criterion.evaluate(view, np.inf)[0])
        for joint, name in enumerate(self.setup.mechanism.joint_names):
            values[f"mean |joint torque| {name} [Nm]"] = float(np.mean(np.abs(view.torque[:, joint])))
        deviations = self.criteria.rsd_mean.deviations(view)
        return values, {
            name: float(value)
            for name, value in zip(self.criteria.rsd_mean.assembly.names, deviations, strict=True)
        }


def assemble(problem: PlanProblem) -> Assembled:
    """Read every file that the problem names and build the criteria; ConfigurationError where they do not
    fit.
    """
    beside = problem.source.parent if problem.source is not None else None
    arm = Arm.load(problem.arm, beside=beside)
    cell = Cell.load(problem.cell, beside=beside)
    mechanism = Mechanism.from_urdf(arm.urdf)
    limits = Limits(arm.q_low, arm.q_high, arm.v_max, arm.a_max, arm.j_max, arm.tau_max).scaled(
        problem.speed_scale
    )
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
    target, bounds = wanted_target(problem, criteria, limits, mechanism)
    space, row_names = space_of(mechanism, checker.geometry)
    floor = np.full(space.rows, clearance + _CLEARANCE_RESERVE)
    work = problem.workspace
    floor[0] = -np.inf if work.radius_m is None else work.radius_m + _FLANGE_RESERVE
    floor[1] = -np.inf if work.height_m is None else work.height_m + _FLANGE_RESERVE
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
        **_grid(basis),
    )
    return Assembled(problem, setup, criteria, arm.name, arm.resonance_hz, checker, clearance, row_names)


def _grid(basis: Basis) -> dict[str, int]:
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
    noise = Noise.published() if mechanism.joints == 7 else None
    if knowledge.noise_motor or knowledge.noise_joint:
        noise = Noise(np.array(knowledge.noise_motor), np.array(knowledge.noise_joint))
    if noise is None:
        noise = Noise(np.ones(mechanism.joints), np.ones(mechanism.joints))
    for side in (noise.motor, noise.joint):
        if side.size != mechanism.joints:
            raise ConfigurationError(
                f"knowledge: noise of {side.size} rows; the arm has {mechanism.joints} joints"
            )
    noise = Noise(noise.motor, noise.joint, knowledge.samples)
    return _with_noise(estimate, noise), names


def _with_noise(estimate: ArmEstimate, noise: Noise) -> ArmEstimate:
    return ArmEstimate(
        estimate.bodies,
        estimate.drives,
        estimate.payload,
        estimate.covariance_names,
        estimate.covariance,
        noise,
    )


def _base(problem: PlanProblem, mechanism: Mechanism) -> BaseSet:
    loaded = "loaded" in problem.sessions
    structure = ModelStructure(mechanism.chain, problem.model, payloads=(_PAYLOAD_NAME,) if loaded else ())
    conditions = tuple(
        dict.fromkeys(
            Condition(_PAYLOAD_NAME if session == "loaded" else None) for session in problem.sessions
        )
    )
    return closed_form_base(structure, conditions)


def _parameters(
    problem: PlanProblem, mechanism: Mechanism, estimate: ArmEstimate, model_names: tuple[str, ...]
) -> tuple[tuple[str, ...], Array]:
    """Names of the parameters that the criteria are about, and their (regrouped) values."""
    base = _base(problem, mechanism)
    standard = np.zeros(base.structure.n_columns)
    for column, name in enumerate(base.structure.names):
        kind, link = split_name(name)
        if link <= mechanism.joints or kind not in ("Ia", "Fvl", "Fcl", "offl", "Fvm", "Fcm", "offm"):
            standard[column] = estimate.value(name)
    all_values = base.reduce(standard)
    if problem.parameters == "base":
        return base.names, all_values
    if problem.parameters == "model":
        if not model_names:
            raise ConfigurationError(
                "parameters `model` needs a model.yaml as `knowledge.file`; use base or a list"
            )
        wanted = model_names
    else:
        wanted = tuple(problem.parameters)
    index = [base.index(name) for name in wanted]
    return tuple(base.names[k] for k in index), all_values[index]
