"""Global search: random starts, then hops from the best, in small tasks that any process can run.

The criteria have many local optima. A few random starts are optimised; the best become lanes, which are
improved by basin hopping (perturb, optimise anew, keep what is better) and thinned out by successive halving.
Every task is a pure function of its arguments, so the result depends on the seed alone, not on the number of
processes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from threadpoolctl import threadpool_limits

from ident.excitation.check import Limits
from ident.excitation.constraints import Bound, Constraints
from ident.excitation.estimate import ArmEstimate
from ident.excitation.evaluation import Evaluator
from ident.excitation.information import Columns
from ident.excitation.mechanism import Mechanism
from ident.excitation.motion import Array, Basis
from ident.excitation.objectives import Criterion
from ident.excitation.program import Program
from ident.excitation.space import Space
from ident.excitation.sqp import minimise

__all__ = ["Candidate", "Setup", "begin", "hop", "judge", "random_start", "restore"]

_FEASIBLE = 3e-3
_FIRST = ((50, 8.0, 50.0), (60, 32.0, 150.0))
_SHORT = ((40, 16.0, 100.0), (40, 64.0, 300.0))
_HOP_SIZE = 0.12
_HOP_SPREAD = 0.5
_AMPLITUDE = 0.4


@dataclass(frozen=True, eq=False)
class Setup:
    """Everything that defines the optimisation problem; can be sent to another process."""

    mechanism: Mechanism
    basis: Basis
    limits: Limits
    space: Space
    floor: Array
    estimate: ArmEstimate
    columns: Columns
    target: Criterion | None
    bounds: tuple[Bound, ...] = ()
    coverage: float = 3.0
    samples: int = 64
    refine: int = 5

    def program(self, target: Criterion | str | None = "own") -> Program:
        """A fresh optimisation program; `target=None` asks for feasibility only."""
        evaluator = Evaluator(
            self.mechanism, self.basis, self.estimate, self.columns, samples=self.samples, refine=self.refine
        )
        wanted = self.target if isinstance(target, str) else target
        bounds = self.bounds if wanted is not None else ()
        constraints = Constraints(
            evaluator, self.limits, self.space, self.floor, bounds, coverage=self.coverage
        )
        return Program(evaluator, constraints, wanted)


@dataclass(frozen=True, eq=False)
class Candidate:
    """A motion on its way: coefficients, exact target value, worst scaled violation on the optimiser's
    grids.
    """

    x: Array
    value: float
    violation: float
    evaluations: int = 0

    @property
    def feasible(self) -> bool:
        """True if nothing is violated beyond what the final polish removes."""
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
    # the constant motion is in every basis; its coefficients shift the series to the wanted mean
    constant = np.linalg.lstsq(basis.matrix(times), np.ones(times.size), rcond=None)[0]
    mean = (basis.matrix(times) @ x.T).mean(axis=0)
    return (x + np.outer(posture - mean, constant)).ravel()


def begin(setup: Setup, seed: Sequence[int]) -> Candidate:
    """Optimise from one random start."""
    with threadpool_limits(1):
        rng = np.random.default_rng(list(seed))
        program = setup.program()
        found = _solve(program, random_start(setup, rng), _FIRST)
        if not found.feasible:
            found = _restored(setup, program, found)
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
    """The nearest motion that keeps every limit, whatever its value."""
    program = setup.program(target=None)
    program.anchor = x.copy()
    program.constraints.rate = 200.0
    solution = minimise(program, x, iterations=iterations, tolerance=1e-6)
    return Candidate(solution.x, np.inf, _violation(solution.constraints), program.evaluations)


def judge(setup: Setup, x: Array) -> Candidate:
    """The motion with coefficients x as the target and the bounds of a set-up see it; nothing is optimised."""
    program = setup.program()
    program.sharpness, program.constraints.rate = 64.0, 300.0
    program.constraints.refresh_deviation(program.signals(x))
    _, constraints = program.values(program.variables(x))
    limits = constraints[: len(program.constraints.rows)]
    return Candidate(x, program.exact(x), _violation(limits), program.evaluations)


def _restored(setup: Setup, program: Program, found: Candidate) -> Candidate:
    """Second try for a start that ended infeasible: go to the nearest feasible motion and optimise from
    there.
    """
    near = restore(setup, found.x)
    again = _solve(program, near.x, _SHORT)
    return again if again.better_than(found) else found


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
