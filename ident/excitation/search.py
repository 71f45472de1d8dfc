"""Global search in small tasks for any number of processes, and the polish of the motions found.

The criteria have many local optima. A few random starts are optimised; the best become lanes, improved by basin
hopping (perturb, optimise anew, keep improvements) and thinned out by successive halving. Every task is a pure
function of its arguments, so the result depends on the seed and not on the number of processes.

The polish sharpens a candidate, checks it against every limit, tightens violated limits and checks again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from threadpoolctl import threadpool_limits

from ident.excitation.assembly import Assembled
from ident.excitation.check import KINEMATIC, Check
from ident.excitation.motions import Array, ParametricMotion
from ident.excitation.program import Constraints, Program, Setup
from ident.excitation.sqp import minimise

_FEASIBLE = 3e-3
_FIRST = ((50, 8.0, 50.0), (60, 32.0, 150.0))
_SHORT = ((40, 16.0, 100.0), (40, 64.0, 300.0))
_HOP_SIZE = 0.12
_HOP_SPREAD = 0.5
_AMPLITUDE = 0.4
_ROUNDS = 6
_GRID_TOLERANCE = 5e-3
_HOPELESS = 0.05
_ORDERS = [name for name, _ in KINEMATIC]
_SPACE_STEP = 2e-4
_SHARE_STEP = 2e-4
_BOUND_TOLERANCE = 1e-9
_BOUND_RESERVE = 1e-3


@dataclass(frozen=True, eq=False)
class Candidate:
    """A motion in the search: coefficients, exact target value, worst scaled violation on the optimiser's grids."""

    x: Array
    value: float
    violation: float
    evaluations: int = 0

    @property
    def feasible(self) -> bool:
        """True if every violation is small enough for the final polish."""
        return self.violation <= _FEASIBLE and np.isfinite(self.value)

    def better_than(self, other: Candidate) -> bool:
        """Feasible before infeasible, then by value or by violation."""
        if self.feasible != other.feasible:
            return self.feasible
        return self.value < other.value if self.feasible else self.violation < other.violation


def random_start(setup: Setup, rng: np.random.Generator) -> Array:
    """Random series of moderate size around a random posture, (joints * free,)."""
    limits, basis = setup.limits, setup.basis
    joints = setup.mechanism.joints
    middle, half = 0.5 * (limits.q_low + limits.q_high), 0.5 * (limits.q_high - limits.q_low)
    x = rng.normal(size=(joints, basis.free))
    times = np.linspace(0.0, basis.duration, 200)
    scale = np.full(joints, np.inf)
    for order, bound in enumerate((half, limits.v_max, limits.a_max, limits.j_max)):
        signal = basis.matrix(times, order) @ x.T
        if order == 0:
            signal = signal - signal.mean(axis=0)
        scale = np.minimum(scale, bound / np.maximum(np.abs(signal).max(axis=0), 1e-12))
    x *= _AMPLITUDE * scale[:, None]
    posture = middle + half * rng.uniform(-0.5, 0.5, size=joints)
    # the constant motion is in every basis; its coefficients shift the series to the posture
    constant = np.linalg.lstsq(basis.matrix(times), np.ones(times.size), rcond=None)[0]
    mean = (basis.matrix(times) @ x.T).mean(axis=0)
    return (x + np.outer(posture - mean, constant)).ravel()


def begin(setup: Setup, seed: Sequence[int]) -> Candidate:
    """Optimise from one random start; after an infeasible result again, from the nearest feasible motion."""
    with threadpool_limits(1):
        rng = np.random.default_rng(list(seed))
        program = setup.program()
        found = _solve(program, random_start(setup, rng), _FIRST)
        if not found.feasible:
            again = _solve(program, restore(setup, found.x).x, _SHORT)
            found = again if again.better_than(found) else found
        return found


def hop(setup: Setup, start: Candidate, seed: Sequence[int], hops: int) -> Candidate:
    """Improve a candidate by some hops."""
    with threadpool_limits(1):
        rng = np.random.default_rng(list(seed))
        program = setup.program()
        best, shape = start, (setup.mechanism.joints, setup.basis.free)
        for _ in range(hops):
            size = _HOP_SIZE * np.exp(_HOP_SPREAD * rng.normal())
            step = rng.normal(size=shape)
            if rng.random() < 0.3:
                step[rng.permutation(shape[0])[: int(rng.integers(3, shape[0]))]] = 0.0
                step *= 2.0
            found = _solve(program, best.x + size * step.ravel(), _SHORT)
            if found.better_than(best):
                best = found
        return Candidate(best.x, best.value, best.violation, program.evaluations)


def restore(setup: Setup, x: Array, iterations: int = 80) -> Candidate:
    """The nearest motion within every limit, at any value of the target."""
    program = setup.program(feasibility=True)
    program.anchor = x.copy()
    program.constraints.rate = 200.0
    solution = minimise(program, x, iterations=iterations, tolerance=1e-6)
    return Candidate(solution.x, np.inf, _violation(solution.constraints), program.evaluations)


def judge(setup: Setup, x: Array) -> Candidate:
    """Target value and violation of the coefficients x under a set-up, without optimisation."""
    program = setup.program()
    program.sharpness, program.constraints.rate = 64.0, 300.0
    program.constraints.refresh_deviation(program.signals(x))
    _, constraints = program.values(program.variables(x))
    limits = constraints[: len(program.constraints.rows)]
    return Candidate(x, program.exact(x), _violation(limits), program.evaluations)


def _solve(program: Program, x: Array, schedule: Sequence[tuple[int, float, float]]) -> Candidate:
    hessian = program.curvature()
    for iterations, sharpness, rate in schedule:
        program.sharpness, program.constraints.rate = sharpness, rate
        program.constraints.refresh_deviation(program.signals(x))
        program.calibrate(x)
        solution = minimise(program, program.variables(x), iterations=iterations, hessian=hessian)
        x, hessian = program.coefficients(solution.x), solution.hessian
    limits = solution.constraints[: len(program.constraints.rows)]
    return Candidate(x, program.exact(x), _violation(limits), program.evaluations)


def _violation(constraints: Array) -> float:
    return float(np.max(-constraints, initial=0.0))


@dataclass(frozen=True, eq=False)
class Outcome:
    """A polished motion with its check; `bounds_kept`: the bounds on other criteria hold."""

    motion: ParametricMotion
    check: Check
    value: float
    bounds_kept: bool
    bound_excess: float


def polish(assembled: Assembled, candidate: Candidate, *, quick: bool = False) -> Outcome:
    """Optimise with sharp criteria and tight aggregation, then check and tighten until every limit is proven."""
    setup = assembled.setup
    with threadpool_limits(1):
        program = setup.program()
        x = candidate.x
        program.sharpness, program.constraints.rate = 256.0, 1000.0
        best: Outcome | None = None
        best_x = x
        reserve = _BOUND_RESERVE
        for round_ in range(_ROUNDS):
            program.constraints.refresh_deviation(program.signals(x))
            program.calibrate(x, reserve)
            solution = minimise(program, program.variables(x), iterations=15 if quick else 60, tolerance=1e-5)
            x = program.coefficients(solution.x)
            limits = solution.constraints[: len(program.constraints.rows)]
            if limits.min(initial=0.0) < -_GRID_TOLERANCE and round_ < _ROUNDS - 1:
                x = restore(setup, x).x
                continue
            outcome = _outcome(assembled, program, x)
            if best is None or shortfall(best) > shortfall(outcome):
                best, best_x = outcome, x
            if outcome.check.ok and outcome.bounds_kept:
                return outcome
            if outcome.bound_excess > _HOPELESS:
                break
            tighten(program.constraints, outcome.check, setup.mechanism.joint_names)
            if outcome.bound_excess > 0.0:
                reserve += 1.2 * outcome.bound_excess + 1e-5
        if best is None:
            best, best_x = _outcome(assembled, program, x), x
        return best if best.bound_excess > _HOPELESS else _nearest(assembled, program, best, best_x)


def _nearest(assembled: Assembled, program: Program, best: Outcome, x: np.ndarray) -> Outcome:
    """The motion nearest to x within every limit, at any cost in value; `best` if there is none."""
    near = Program(program.evaluator, program.constraints, None)
    near.sharpness, near.anchor = program.sharpness, x.copy()
    for _ in range(_ROUNDS):
        tighten(near.constraints, best.check, assembled.setup.mechanism.joint_names)
        x = minimise(near, x, iterations=60, tolerance=1e-6).x
        outcome = _outcome(assembled, program, x)
        if shortfall(outcome) < shortfall(best) or outcome.check.ok:
            best = outcome
        if outcome.check.ok and outcome.bounds_kept:
            return outcome
    return best


def shortfall(outcome: Outcome) -> float:
    """Worst violation of a limit or bound, as a share of it."""
    return max([outcome.bound_excess, 0.0, *(-margin.share for margin in outcome.check.violations)])


def _outcome(assembled: Assembled, program: Program, x: np.ndarray) -> Outcome:
    setup = assembled.setup
    motion = setup.basis.motion(x.reshape(setup.mechanism.joints, -1))
    check = assembled.check(motion)
    excess = assembled.bound_excess(motion)
    return Outcome(motion, check, program.exact(x), excess <= _BOUND_TOLERANCE, excess)


def tighten(constraints: Constraints, check: Check, joint_names: tuple[str, ...]) -> None:
    """Move each violated limit inwards by a little more than its violation."""
    for margin in check.violations:
        short = max(-margin.slack, 0.0)
        if margin.constraint in _ORDERS:
            joint = joint_names.index(margin.subject)
            order = _ORDERS.index(margin.constraint)
            constraints.half[order, joint] *= 1.0 - _SHARE_STEP - 1.2 * short / constraints.half[order, joint]
        elif margin.constraint in ("joint torque", "motor torque"):
            joint = joint_names.index(margin.subject)
            share = short / constraints.limits.tau_max[joint]
            constraints.torque_limit[joint] *= 1.0 - _SHARE_STEP - 1.2 * share
        else:
            rows = {"distance from axis 1": [0], "height": [1]}.get(margin.constraint)
            eased = [row for row, _ in constraints.space.eased]
            if rows is None:
                rows = (
                    eased if "payload" in margin.subject and eased else list(range(2, constraints.space.rows))
                )
            constraints.floor[rows] += _SPACE_STEP + 1.2 * short
