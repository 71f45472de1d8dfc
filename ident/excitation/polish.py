"""The last steps before a motion is handed out: sharpen, check against every limit, tighten what slipped,
check again.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from threadpoolctl import threadpool_limits

from ident.excitation.assembly import Assembled
from ident.excitation.check import Check, Margin
from ident.excitation.constraints import Constraints
from ident.excitation.motion import ParametricMotion
from ident.excitation.program import Program
from ident.excitation.search import Candidate, restore
from ident.excitation.sqp import minimise

__all__ = ["Outcome", "polish", "shortfall"]

_ROUNDS = 6
_GRID_TOLERANCE = 5e-3
_HOPELESS = 0.05
_ORDERS = {"position": 0, "velocity": 1, "acceleration": 2, "jerk": 3}
_SPACE_STEP = 2e-4
_SHARE_STEP = 2e-4
_BOUND_TOLERANCE = 1e-9
_BOUND_RESERVE = 1e-3


@dataclass(frozen=True, eq=False)
class Outcome:
    """A polished motion with its check; `bounds_kept` tells whether the bounds on other criteria hold."""

    motion: ParametricMotion
    check: Check
    value: float
    bounds_kept: bool
    bound_excess: float


def polish(assembled: Assembled, candidate: Candidate, *, quick: bool = False) -> Outcome:
    """Optimise with sharp criteria and tight aggregation, then check and tighten until every limit is
    proven.
    """
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
    """The motion nearest to x that keeps every limit, whatever it costs in value; `best` where none is found."""
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
    shares = [-margin.slack / max(abs(margin.limit), 1e-9) for margin in outcome.check.violations]
    return max([outcome.bound_excess, 0.0, *shares])


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
            order = _ORDERS[margin.constraint]
            constraints.half[order, joint] *= 1.0 - _SHARE_STEP - 1.2 * short / constraints.half[order, joint]
        elif margin.constraint in ("joint torque", "motor torque"):
            joint = joint_names.index(margin.subject)
            share = short / constraints.limits.tau_max[joint]
            constraints.torque_limit[joint] *= 1.0 - _SHARE_STEP - 1.2 * share
        else:
            _raise_floor(constraints, margin, short)


def _raise_floor(constraints: Constraints, margin: Margin, short: float) -> None:
    rows = {"distance from axis 1": [0], "height": [1]}.get(margin.constraint)
    if rows is None:
        rows = list(range(2, constraints.space.rows))
    constraints.floor[rows] += _SPACE_STEP + 1.2 * short
