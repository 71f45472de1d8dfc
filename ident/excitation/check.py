"""The check of a planned motion against every limit, with proofs for the instants between the samples.

Position, velocity, acceleration and jerk are compared at their exact extrema on the continuous motion. Torque,
flange position and clearance are compared on a grid and, on request, proven for every instant by Lipschitz bounds
and bisection in time.

A quantity g(t) with a rate bounded by L on an interval of half-width h around t is positive on the whole interval if
g(t) > L h. Intervals failing this test are halved until they pass, until g < 0 is found, or until they are too short.
L comes from bounds of joint velocity, acceleration and jerk on the interval itself: the value in the middle plus the
exact extreme value of the next derivative times h.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from fri.errors import ConfigurationError
from fri.quantities import within
from ident.excitation.arm_model import (
    ArmEstimate,
    Mechanism,
    TorqueBounds,
    split_name,
    tip_path,
    torque_bounds,
)
from ident.excitation.clearance import space_of
from ident.excitation.motions import Array, ParametricMotion, Samples
from lwr_driver.arm.collision import CollisionChecker

_ROUNDING = 1e-12
_Measure = Callable[[Array], Array]
KINEMATIC = (("position", "rad"), ("velocity", "rad/s"), ("acceleration", "rad/s²"), ("jerk", "rad/s³"))
_SMALLEST = 1e-6  # shortest half-width as a share of the motion: microseconds


@dataclass(frozen=True, eq=False)
class Limits:
    """Limits of the motion; arrays (joints,).

    q_low, q_high [rad]; v_max [rad/s]; a_max [rad/s²]; j_max [rad/s³]; tau_max [Nm], for the joint torque and for the
    motor torque (both on the joint side of the gear).
    """

    q_low: Array
    q_high: Array
    v_max: Array
    a_max: Array
    j_max: Array
    tau_max: Array

    def __post_init__(self) -> None:
        for name in vars(self):
            values = np.array(getattr(self, name), dtype=np.float64)
            if values.shape != np.shape(self.q_low) or values.ndim != 1:
                raise ConfigurationError(
                    f"limit {name} has shape {values.shape}; one number per joint is needed"
                )
            if np.any(np.isnan(values)) or (not name.startswith("q_") and np.any(values <= 0)):
                raise ConfigurationError(f"limit {name} is {values}; limits are positive numbers")
            object.__setattr__(self, name, values)
        if np.any(self.q_low >= self.q_high):
            raise ConfigurationError("a lower position limit is not below the upper one")

    def scaled(self, speed: float) -> Limits:
        """The same limits with velocity, acceleration and jerk at `speed`, speed², speed³ of themselves."""
        if not 0.0 < speed <= 1.0:
            raise ConfigurationError(f"speed_scale {speed} is outside 0 to 1")
        return replace(
            self, v_max=self.v_max * speed, a_max=self.a_max * speed**2, j_max=self.j_max * speed**3
        )


@dataclass(frozen=True)
class Workspace:
    """Bounds of the flange: at least `radius_m` from the axis of joint 1, at least `height_m` high.

    Heights count from the origin of the first joint's frame, the base frame of the Denavit-Hartenberg table
    (for the LWR4+ 0.31 m above the base plate). None switches a bound off.
    """

    radius_m: Annotated[float, within(0.0, 5.0, "m")] | None = 0.3
    height_m: Annotated[float, within(-5.0, 5.0, "m")] | None = -0.2


@dataclass(frozen=True)
class Margin:
    """Distance of a motion from one limit: `slack` in `unit`, negative if violated.

    proven : False if a requested proof for the instants between the samples failed
    """

    constraint: str
    subject: str
    value: float
    limit: float
    slack: float
    unit: str
    time_s: float
    proven: bool = True

    @property
    def ok(self) -> bool:
        """True if the limit is kept, to rounding."""
        return self.slack >= -_ROUNDING * abs(self.limit) and self.proven

    @property
    def share(self) -> float:
        """Slack as a share of the limit."""
        return self.slack / max(abs(self.limit), 1e-9)

    def __str__(self) -> str:
        state = "keeps" if self.ok else "violates" if self.proven else "is not proven to keep"
        return (
            f"{self.subject} {self.constraint} {self.value:.4g} {self.unit} at t = {self.time_s:.3f} s "
            f"{state} {self.limit:.4g} {self.unit} by {abs(self.slack):.3g}"
        )


@dataclass(frozen=True)
class Check:
    """Result of a check: one margin per constraint and joint, pair or point."""

    margins: tuple[Margin, ...]

    @property
    def ok(self) -> bool:
        """True if every limit is kept."""
        return all(margin.ok for margin in self.margins)

    @property
    def violations(self) -> tuple[Margin, ...]:
        """Margins of violated limits, worst share of the limit first."""
        return tuple(sorted((m for m in self.margins if not m.ok), key=lambda margin: margin.share))

    def tightest(self) -> tuple[Margin, ...]:
        """The tightest margin of each constraint."""
        best: dict[str, Margin] = {}
        for margin in self.margins:
            known = best.get(margin.constraint)
            if known is None or margin.share < known.share:
                best[margin.constraint] = margin
        return tuple(best.values())

    def __str__(self) -> str:
        return "\n".join(str(margin) for margin in self.tightest())

    def __repr__(self) -> str:
        broken = self.violations
        verdict = f"{len(broken)} violated" if broken else "all kept"
        shown = broken[:3] or sorted(self.tightest(), key=lambda margin: margin.share)[:3]
        return "\n".join(
            [f"Check: {len(self.margins)} limits, {verdict}", *(f"  {margin}" for margin in shown)]
        )


def check_motion(
    motion: ParametricMotion,
    mechanism: Mechanism,
    limits: Limits,
    *,
    workspace: Workspace | None = None,
    estimate: ArmEstimate | None = None,
    coverage: float = 3.0,
    checker: CollisionChecker | None = None,
    clearance_m: float = 0.0,
    step_s: float = 1e-3,
    collision_step_s: float = 1e-2,
    continuous: bool = False,
) -> Check:
    """Compare a motion with every limit.

    step_s, collision_step_s : sampling of torque and flange, and of the collision checker's path
    continuous : also prove torque, flange and clearance for every instant, if no sample violates a limit
    """
    if motion.joints != mechanism.joints:
        raise ConfigurationError(f"the motion has {motion.joints} joints, the arm {mechanism.joints}")
    margins = _kinematic_margins(motion, mechanism, limits)
    count = max(2, round(motion.duration / step_s))
    times = np.linspace(0.0, motion.duration, count, endpoint=False)
    samples = motion.sample(times)
    if estimate is not None:
        bounds = torque_bounds(mechanism, samples, estimate, coverage)
        margins += _torque_margins(bounds, times, mechanism, limits)
    if workspace is not None:
        margins += _workspace_margins(samples, times, mechanism, workspace)
    if checker is not None:
        margins.append(_clearance_margin(motion, checker, clearance_m, collision_step_s))
    if continuous and all(margin.ok for margin in margins):
        unproven = set()
        if estimate is not None and not _torque_proof(motion, mechanism, limits, estimate, coverage).proven:
            unproven |= {"joint torque", "motor torque"}
        if workspace is not None:
            unproven |= _workspace_proofs(motion, mechanism, workspace)
        if checker is not None and not _clearance_proof(motion, mechanism, checker, clearance_m).proven:
            unproven.add("clearance")
        margins = [replace(m, proven=m.constraint not in unproven) for m in margins]
    return Check(tuple(margins))


def _torque_proof(
    motion: ParametricMotion, mechanism: Mechanism, limits: Limits, estimate: ArmEstimate, coverage: float
) -> Proof:
    bound_rate = torque_rate(motion, mechanism, estimate, coverage)

    def slack(times: Array) -> Array:
        bounds = torque_bounds(mechanism, motion.sample(times), estimate, coverage)
        share = np.maximum(bounds.joint, bounds.motor) / limits.tau_max
        return 1.0 - share.max(axis=1)

    def rate(times: Array, half: float) -> Array:
        return np.max(bound_rate(times, half) / limits.tau_max, axis=1)

    return prove(motion, slack, rate)


def _workspace_proofs(motion: ParametricMotion, mechanism: Mechanism, workspace: Workspace) -> set[str]:
    """Bounds of the workspace without a proof."""
    extents = np.zeros(mechanism.joints)
    extents[-1] = np.linalg.norm(mechanism.tip)
    rate = speed_bound(motion, swept_radius(mechanism, extents))
    unproven = set()
    for constraint, limit, measure in flange_bounds(workspace):

        def slack(times: Array, measure: _Measure = measure, limit: float = limit) -> Array:
            return measure(tip_path(mechanism, motion.sample(times).q)) - limit

        if not prove(motion, slack, rate).proven:
            unproven.add(constraint)
    return unproven


def flange_bounds(workspace: Workspace) -> list[tuple[str, float, _Measure]]:
    """Constraint, limit [m] and quantity of each bound of the workspace."""
    bounds: list[tuple[str, float | None, _Measure]] = [
        ("distance from axis 1", workspace.radius_m, lambda points: np.hypot(points[:, 0], points[:, 1])),
        ("height", workspace.height_m, lambda points: points[:, 2]),
    ]
    return [(constraint, limit, measure) for constraint, limit, measure in bounds if limit is not None]


def _clearance_proof(
    motion: ParametricMotion, mechanism: Mechanism, checker: CollisionChecker, clearance_m: float
) -> Proof:
    space, _ = space_of(mechanism, getattr(checker, "geometry", None))
    rate = speed_bound(motion, swept_radius(mechanism, space.extents(mechanism.joints)))

    def slack(times: Array) -> Array:
        postures = motion.sample(times).q
        return np.array([checker.clearance(posture).distance for posture in postures]) - clearance_m

    return prove(motion, slack, rate)


def _kinematic_margins(motion: ParametricMotion, mechanism: Mechanism, limits: Limits) -> list[Margin]:
    margins = []
    lows = (limits.q_low, -limits.v_max, -limits.a_max, -limits.j_max)
    highs = (limits.q_high, limits.v_max, limits.a_max, limits.j_max)
    for order, ((constraint, unit), low, high) in enumerate(zip(KINEMATIC, lows, highs, strict=True)):
        extrema = motion.extrema(order)
        for joint, name in enumerate(mechanism.joint_names):
            below, above = extrema.low[joint] - low[joint], high[joint] - extrema.high[joint]
            if below < above:
                found = (extrema.low[joint], low[joint], below, extrema.t_low[joint])
            else:
                found = (extrema.high[joint], high[joint], above, extrema.t_high[joint])
            value, limit, slack, when = map(float, found)
            margins.append(Margin(constraint, name, value, limit, slack, unit, when))
    return margins


def _torque_margins(bounds: TorqueBounds, times: Array, mechanism: Mechanism, limits: Limits) -> list[Margin]:
    margins = []
    for constraint, values in (("joint torque", bounds.joint), ("motor torque", bounds.motor)):
        for joint, name in enumerate(mechanism.joint_names):
            row = int(np.argmax(values[:, joint]))
            value, limit = float(values[row, joint]), float(limits.tau_max[joint])
            margins.append(Margin(constraint, name, value, limit, limit - value, "Nm", float(times[row])))
    return margins


def _workspace_margins(
    samples: Samples, times: Array, mechanism: Mechanism, workspace: Workspace
) -> list[Margin]:
    margins = []
    points = tip_path(mechanism, samples.q)
    for constraint, limit, measure in flange_bounds(workspace):
        values = measure(points)
        row = int(np.argmin(values))
        value = float(values[row])
        margins.append(Margin(constraint, "flange", value, limit, value - limit, "m", float(times[row])))
    return margins


def _clearance_margin(
    motion: ParametricMotion, checker: CollisionChecker, clearance_m: float, step_s: float
) -> Margin:
    count = max(2, int(np.ceil(motion.duration / step_s)))
    times = np.linspace(0.0, motion.duration, count, endpoint=False)
    nearest = checker.check_path(motion.sample(times).q, period_s=float(times[1]))
    distance = float(nearest.distance)
    subject = " and ".join(nearest.pair)
    return Margin(
        "clearance", subject, distance, clearance_m, distance - clearance_m, "m", float(times[nearest.row])
    )


@dataclass(frozen=True)
class Proof:
    """Outcome: the smallest sampled value and its time, proven for all instants or not, samples used."""

    least: float
    time_s: float
    proven: bool
    samples: int


def prove(
    motion: ParametricMotion,
    slack: Callable[[Array], Array],
    rate: Callable[[Array, float], Array],
    *,
    step_s: float = 0.02,
    most: int = 400_000,
) -> Proof:
    """Try to prove slack(t) > 0 on the whole motion.

    slack : values at the times (n,); rate : bounds of |d slack / dt| on [t - h, t + h] from times (n,) and h.
    """
    count = max(8, int(np.ceil(motion.duration / step_s)))
    half = 0.5 * motion.duration / count
    times: Array = (np.arange(count, dtype=np.float64) + 0.5) * (2.0 * half)
    least, when, used = np.inf, 0.0, 0
    while times.size:
        values = slack(times)
        used += times.size
        lowest = int(np.argmin(values))
        if values[lowest] < least:
            least, when = float(values[lowest]), float(times[lowest])
        if least < 0.0:
            return Proof(least, when, False, used)
        open_ = values <= rate(times, half) * half
        times = times[open_]
        half *= 0.5
        if times.size and (half < _SMALLEST * motion.duration or used + 2 * times.size > most):
            return Proof(least, when, False, used)
        times = np.concatenate([times - half, times + half])
    return Proof(least, when, True, used)


def swept_radius(mechanism: Mechanism, extents: Array) -> Array:
    """Longest distance from each joint axis to any point moved by it, (n,) [m].

    extents (n,): distance of the farthest point of each body from its own frame's origin [m].
    """
    n = mechanism.joints
    lengths = np.linalg.norm(mechanism.translation, axis=1)
    radius = np.array(extents, dtype=np.float64)
    for joint in range(n - 2, -1, -1):
        radius[joint] = max(radius[joint], lengths[joint + 1] + radius[joint + 1])
    return radius


def speed_bound(motion: ParametricMotion, radius: Array) -> Callable[[Array, float], Array]:
    """Bound of the speed of any point within `radius` (n,) of each joint axis; see `prove`."""
    extrema = motion.extrema(2)
    acceleration = np.maximum(np.abs(extrema.low), np.abs(extrema.high))

    def rate(times: Array, half: float) -> Array:
        return (np.abs(motion.sample(times).qd) + acceleration * half) @ radius

    return rate


def torque_rate(
    motion: ParametricMotion, mechanism: Mechanism, estimate: ArmEstimate, coverage: float
) -> Callable[[Array, float], Array]:
    """Bound of the rate of the bounds of `torque_bounds`, (n, joints) [Nm/s].

    Norms are carried along the chain: angular velocity, acceleration and jerk add up joint by joint, origins and
    wrenches follow. Uncertainty adds the same bound, with standard deviations instead of parameter magnitudes.
    """
    found = [motion.extrema(order) for order in (2, 3)]
    peaks = [np.maximum(np.abs(extrema.low), np.abs(extrema.high)) for extrema in found] + [_snap(motion)]
    sizes = _sizes(mechanism, estimate, coverage)

    def rate(times: Array, half: float) -> Array:
        samples = motion.sample(times)
        v = np.abs(samples.qd) + peaks[0] * half
        a = np.abs(samples.qdd) + peaks[1] * half
        j = np.abs(samples.qddd) + peaks[2] * half
        return _wrench_rate(mechanism, sizes, v, a, j)

    return rate


def _snap(motion: ParametricMotion) -> Array:
    """Largest rate of the jerk, estimated from samples: only multiplied by h, so a small part of the bound."""
    times = np.linspace(0.0, motion.duration, 2001)
    jerk = motion.sample(times).qddd
    return 2.0 * np.max(np.abs(np.diff(jerk, axis=0)), axis=0) / (times[1] - times[0])


def _sizes(mechanism: Mechanism, estimate: ArmEstimate, coverage: float) -> tuple[Array, ...]:
    """Norms of mass, first moment and inertia of each body, inertia and viscous friction of each drive; (n,)."""
    bodies = estimate.loads
    mass = np.abs(bodies[:, :, 9]).max(axis=0)
    moment = np.linalg.norm(bodies[:, :, 6:9], axis=2).max(axis=0)
    weights = np.array([1.0, 2.0, 2.0, 1.0, 2.0, 1.0])
    inertia = np.sqrt(np.max(bodies[:, :, :6] ** 2 @ weights, axis=0))
    drive_inertia = np.abs(estimate.drives[:, 0]).copy()
    viscous = np.abs(estimate.drives[:, 1]) + np.abs(estimate.drives[:, 4])
    if estimate.covariance is not None and coverage > 0.0:
        deviation = coverage * np.sqrt(np.diag(estimate.covariance))
        for name, sigma in zip(estimate.covariance_names, deviation, strict=True):
            kind, link = split_name(name)
            body = min(link, mechanism.joints) - 1
            if kind == "M":
                mass[body] += sigma
            elif kind in ("MX", "MY", "MZ"):
                moment[body] += sigma
            elif len(kind) == 2 and kind[0] in "XYZ":
                inertia[body] += 1.5 * sigma
            elif kind == "Ia":
                drive_inertia[body] += sigma
            elif kind in ("Fvl", "Fvm"):
                viscous[body] += sigma
    return mass, moment, inertia, drive_inertia, viscous


def _wrench_rate(mechanism: Mechanism, sizes: tuple[Array, ...], v: Array, a: Array, j: Array) -> Array:
    masses, moments, inertias, drive_inertia, viscous = sizes
    n = mechanism.joints
    lengths = np.linalg.norm(mechanism.translation, axis=1)
    zero = np.zeros(v.shape[0])
    w, dw, ddw = zero, zero, zero
    acceleration, jolt = np.full(v.shape[0], float(np.linalg.norm(mechanism.gravity))), zero
    force, force_rate, couple, couple_rate, spin = [], [], [], [], []
    for b in range(n):
        if b:
            jolt = jolt + lengths[b] * (ddw + 3.0 * dw * w + w**3)
            acceleration = acceleration + lengths[b] * (dw + w**2)
        ddw = ddw + j[:, b] + 2.0 * a[:, b] * w + v[:, b] * (dw + w**2)
        dw = dw + w * v[:, b] + a[:, b]
        w = w + v[:, b]
        mass, moment, inertia = masses[b], moments[b], inertias[b]
        force.append(mass * acceleration + moment * (dw + w**2))
        force_rate.append(mass * jolt + moment * (ddw + 3.0 * dw * w + w**3))
        couple.append(inertia * (dw + w**2) + moment * acceleration)
        couple_rate.append(inertia * (ddw + 4.0 * dw * w + 2.0 * w**3) + moment * (jolt + w * acceleration))
        spin.append(w)
    out = np.empty_like(v)
    for joint in range(n):
        total, lever_arm = zero, 0.0
        for b in range(joint, n):
            if b > joint:
                lever_arm += lengths[b]
            total = total + couple_rate[b] + spin[b] * couple[b]
            total = total + lever_arm * (force_rate[b] + 2.0 * spin[b] * force[b])
        out[:, joint] = total + drive_inertia[joint] * j[:, joint] + viscous[joint] * a[:, joint]
    return out
