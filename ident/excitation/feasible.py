"""A simple feasible excitation: no optimisation of any criterion, in a second, for first runs and as a
fallback.
"""

from __future__ import annotations

import logging

import numpy as np
from threadpoolctl import threadpool_limits

from fri.errors import RefusedError
from ident.excitation.capsules import space_of
from ident.excitation.check import Check, Limits, PathChecker, Workspace, check_motion
from ident.excitation.estimate import ArmEstimate
from ident.excitation.fourier import FourierBasis
from ident.excitation.information import Columns
from ident.excitation.mechanism import Mechanism
from ident.excitation.motion import ParametricMotion
from ident.excitation.plan import ExcitationPlan
from ident.excitation.polish import tighten
from ident.excitation.search import Setup, random_start
from ident.excitation.sqp import minimise
from lwr_driver.arm import Arm

__all__ = ["arm_limits", "feasible_fourier"]

_log = logging.getLogger(__name__)

_STARTS = 12
_ROUNDS = 4
_RESERVE = 3e-3
_NEAR = 5e-3


def arm_limits(arm: Arm, speed_scale: float = 1.0) -> Limits:
    """The limits of an arm, less its position margin, with speeds scaled in time."""
    return Limits(arm.q_low, arm.q_high, arm.v_max, arm.a_max, arm.j_max, arm.tau_max).scaled(speed_scale)


def feasible_fourier(
    arm: Arm,
    checker: PathChecker | None,
    *,
    period_s: float = 20.0,
    harmonics: int = 5,
    periods: int = 1,
    seed: int = 1,
    speed_scale: float = 1.0,
    workspace: Workspace | None = None,
    estimate: ArmEstimate | None = None,
    clearance_m: float = 0.02,
) -> ExcitationPlan:
    """Random Fourier motion of moderate size, moved as little as the limits ask for, that passes every check.

    `estimate` defaults to the URDF's inertias without friction. Raises RefusedError where none of a dozen
    random starts leads to a motion that passes, naming the limit that stands in the way most often.
    """
    mechanism = Mechanism.from_urdf(arm.urdf)
    space, _ = space_of(mechanism, getattr(checker, "geometry", None))
    work = workspace if workspace is not None else Workspace()
    floor = np.full(space.rows, clearance_m + _RESERVE)
    floor[0] = -np.inf if work.radius_m is None else work.radius_m + _RESERVE
    floor[1] = -np.inf if work.height_m is None else work.height_m + _RESERVE
    setup = Setup(
        mechanism=mechanism,
        basis=FourierBasis(period_s, harmonics),
        limits=arm_limits(arm, speed_scale),
        space=space,
        floor=floor,
        estimate=estimate if estimate is not None else ArmEstimate.nominal(mechanism),
        columns=Columns.of(mechanism.joints, ()),
        target=None,
        samples=max(64, 10 * harmonics),
        refine=max(3, int(np.ceil(period_s / 0.0625 / max(64, 10 * harmonics)))),
    )
    blocked: dict[str, int] = {}
    for start in range(_STARTS):
        plan, check = _from_start(setup, seed, start, work, checker, clearance_m)
        if plan is not None:
            _log.info("feasible excitation found from start %d of %d", start + 1, _STARTS)
            provenance = {
                "method": "feasible_fourier",
                "seed": seed,
                "speed_scale": speed_scale,
                "arm": arm.name,
            }
            return ExcitationPlan(plan, arm.joint_names, periods, check=check, provenance=provenance)
        worst = (check.violations or check.tightest())[0]
        blame = f"{worst.subject} {worst.constraint}"
        blocked[blame] = blocked.get(blame, 0) + 1
    culprit = max(blocked, key=lambda key: blocked[key])
    raise RefusedError(
        f"no feasible exciting motion found from {_STARTS} random starts; {culprit} stands in the way most "
        "often; widen that limit or choose another seed"
    )


def _from_start(
    setup: Setup, seed: int, start: int, work: Workspace, checker: PathChecker | None, clearance_m: float
) -> tuple[ParametricMotion | None, Check]:
    """The motion nearest to one random start, tightened until it passes; None if it does not."""
    with threadpool_limits(1):
        program = setup.program()
        program.constraints.rate = 200.0
        x = random_start(setup, np.random.default_rng([seed, start]))
        program.anchor = x.copy()
        for _ in range(_ROUNDS):
            program.constraints.refresh_deviation(program.signals(x))
            solution = minimise(program, x, iterations=40, tolerance=1e-6)
            x = solution.x
            near = float(solution.constraints.min()) > -_NEAR
            motion = setup.basis.motion(x.reshape(setup.mechanism.joints, -1))
            check = check_motion(
                motion,
                setup.mechanism,
                setup.limits,
                workspace=work,
                estimate=setup.estimate,
                checker=checker,
                clearance_m=clearance_m,
                step_s=1e-3 if near else 0.05,
                collision_step_s=1e-2 if near else 0.1,
                continuous=near,
            )
            if (check.ok and near) or not near:
                break
            tighten(program.constraints, check, setup.mechanism.joint_names)
        return (motion if check.ok and near else None), check
