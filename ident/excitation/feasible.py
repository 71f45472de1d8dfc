"""A simple feasible excitation: no optimisation, in well under a second, for first runs and as a start for
planning.
"""

from __future__ import annotations

import logging
from collections.abc import Callable

import numpy as np

from fri.errors import RefusedError
from ident.excitation.check import Check, Limits, PathChecker, Workspace, check_motion
from ident.excitation.estimate import ArmEstimate
from ident.excitation.fourier import FourierBasis, FourierSeries
from ident.excitation.mechanism import Mechanism, tip_path
from ident.excitation.motion import Array, ParametricMotion
from ident.excitation.plan import ExcitationPlan
from lwr_driver.arm import Arm

__all__ = ["arm_limits", "feasible_fourier"]

_log = logging.getLogger(__name__)

_CENTRES = 200
_DIRECTIONS = 24
_BISECTIONS = 8


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
    """Random Fourier motion, as large as the limits allow, that passes every check.

    Around random postures with room on all sides, random series are grown until a limit stops them; the
    largest is taken. `estimate` defaults to the URDF's inertias without friction. Raises RefusedError where
    no posture or no motion passes, naming the limit that stands in the way most often.
    """
    mechanism = Mechanism.from_urdf(arm.urdf)
    limits = arm_limits(arm, speed_scale)
    space = workspace if workspace is not None else Workspace()
    known = estimate if estimate is not None else ArmEstimate.nominal(mechanism)
    basis = FourierBasis(period_s, harmonics)
    rng = np.random.default_rng(seed)

    def coarse(motion: ParametricMotion) -> Check:
        return check_motion(
            motion,
            mechanism,
            limits,
            workspace=space,
            estimate=known,
            checker=checker,
            clearance_m=clearance_m,
            step_s=period_s / 200,
            collision_step_s=period_s / 100,
        )

    def fine(motion: ParametricMotion) -> Check:
        return check_motion(
            motion,
            mechanism,
            limits,
            workspace=space,
            estimate=known,
            checker=checker,
            clearance_m=clearance_m,
        )

    centres = _roomy_postures(rng, mechanism, limits, space)
    best: tuple[float, FourierSeries] | None = None
    blocked: dict[str, int] = {}
    for trial in range(_DIRECTIONS):
        direction = _random_direction(rng, basis, limits)
        centre = centres[trial % len(centres)]
        size, reason = _grow(centre, direction, basis, coarse)
        if reason:
            blocked[reason] = blocked.get(reason, 0) + 1
        if size > 0.0 and (best is None or size > best[0]):
            candidate = basis.motion(_coefficients(centre, direction, 0.97 * size))
            if fine(candidate).ok:
                best = (size, candidate)
    if best is None:
        culprit = max(blocked, key=lambda key: blocked[key]) if blocked else "every limit at once"
        raise RefusedError(
            f"no feasible exciting motion found in {_DIRECTIONS} tries; {culprit} stands in the way most "
            "often; widen that limit or choose another seed"
        )
    _log.info("feasible excitation: size %.2f of the largest drawn", best[0])
    return ExcitationPlan(
        motion=best[1],
        joint_names=arm.joint_names,
        periods=periods,
        check=fine(best[1]),
        provenance={"method": "feasible_fourier", "seed": seed, "speed_scale": speed_scale, "arm": arm.name},
    )


def _roomy_postures(
    rng: np.random.Generator, mechanism: Mechanism, limits: Limits, space: Workspace
) -> Array:
    """Random postures, those with most room in the workspace first, (k, joints)."""
    middle = 0.5 * (limits.q_low + limits.q_high)
    half = 0.5 * (limits.q_high - limits.q_low)
    postures = middle + half * rng.uniform(-0.6, 0.6, size=(_CENTRES, mechanism.joints))
    points = tip_path(mechanism, postures)
    room = np.hypot(points[:, 0], points[:, 1]) - (space.radius_m or 0.0)
    if space.height_m is not None:
        room = np.minimum(room, points[:, 2] - space.height_m)
    return postures[np.argsort(-room)[:_DIRECTIONS]]


def _random_direction(rng: np.random.Generator, basis: FourierBasis, limits: Limits) -> Array:
    """Random series around zero that reaches some limit of range, velocity, acceleration or jerk in each
    joint.
    """
    x = rng.normal(size=(limits.q_low.size, basis.free))
    x[:, 0] = 0.0
    motion = basis.motion(x)
    half = 0.5 * (limits.q_high - limits.q_low)
    scale = np.full(half.shape, np.inf)
    for order, bound in enumerate((half, limits.v_max, limits.a_max, limits.j_max)):
        extrema = motion.extrema(order)
        scale = np.minimum(scale, bound / np.maximum(np.abs(extrema.low), np.abs(extrema.high)))
    return x * scale[:, None]


def _coefficients(centre: Array, direction: Array, size: float) -> Array:
    x = size * direction
    x[:, 0] += centre
    return x


def _grow(
    centre: Array, direction: Array, basis: FourierBasis, check: Callable[[ParametricMotion], Check]
) -> tuple[float, str]:
    """Largest share of `direction` around `centre` that passes, by bisection, and what stopped it."""
    passed, failed, reason = 0.0, 1.0, ""
    for _ in range(_BISECTIONS):
        size = 0.5 * (passed + failed) if failed - passed < 1.0 else 1.0
        result = check(basis.motion(_coefficients(centre, direction, size)))
        if result.ok:
            passed = size
            if size == 1.0:
                break
        else:
            failed = size if size < 1.0 else 0.999
            worst = result.violations[0]
            reason = f"{worst.subject} {worst.constraint}"
    return passed, reason
