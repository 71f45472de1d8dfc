"""The check that every planned motion must pass.

Position, velocity, acceleration and jerk are compared at their exact extrema on the continuous motion.
Torque, flange position and collision are compared on a 1 ms grid and, on request, proven for every instant
between the samples by the Lipschitz bounds of `certificate`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from fri.errors import ConfigurationError
from ident.excitation.capsules import space_of
from ident.excitation.certificate import Proof, prove, reach, speed_bound, torque_rate
from ident.excitation.estimate import ArmEstimate
from ident.excitation.mechanism import Mechanism, tip_path
from ident.excitation.motion import Array, ParametricMotion, Samples
from ident.excitation.torque import torque_bounds

__all__ = ["Check", "Limits", "Margin", "PathChecker", "Workspace", "check_motion"]

_ROUNDING = 1e-12
KINEMATIC = (("position", "rad"), ("velocity", "rad/s"), ("acceleration", "rad/s²"), ("jerk", "rad/s³"))


class Nearest(Protocol):
    """Tightest moment of a path: distance [m], the two bodies, the row."""

    @property
    def distance(self) -> float:
        """Clearance [m], below zero in collision."""

    @property
    def pair(self) -> tuple[str, str]:
        """Names of the two bodies."""

    @property
    def row(self) -> int:
        """Row of the path."""


class PathChecker(Protocol):
    """What the check needs of a collision checker (`lwr_driver.arm.collision.CollisionChecker`)."""

    def clearance(self, q: Array) -> Nearest:
        """Smallest distance in one posture (joints,)."""

    def check_path(self, q: Array, *, period_s: float = 0.0) -> Nearest:
        """Tightest moment of the path q (n, joints)."""


@dataclass(frozen=True, eq=False)
class Limits:
    """What the motion may use of the arm; arrays (joints,).

    q_low, q_high [rad]; v_max [rad/s]; a_max [rad/s²]; j_max [rad/s³]; tau_max [Nm], for the joint torque
    and for the motor torque (both on the joint side of the gear).
    """

    q_low: Array
    q_high: Array
    v_max: Array
    a_max: Array
    j_max: Array
    tau_max: Array

    def __post_init__(self) -> None:
        for name in ("q_low", "q_high", "v_max", "a_max", "j_max", "tau_max"):
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
        return Limits(
            self.q_low,
            self.q_high,
            self.v_max * speed,
            self.a_max * speed**2,
            self.j_max * speed**3,
            self.tau_max,
        )


@dataclass(frozen=True)
class Workspace:
    """Where the flange may be: at least `radius_m` from the axis of joint 1, at least `height_m` high.

    Heights count from the origin of the first joint's frame, the base frame of the Denavit-Hartenberg table
    (for the LWR4+ 0.31 m above the base plate). None switches a bound off.
    """

    radius_m: float | None = 0.3
    height_m: float | None = -0.2


@dataclass(frozen=True)
class Margin:
    """How far a motion stays from one limit. `slack` = room left, negative if violated, in `unit`.

    proven : False if a proof for the instants between the samples was asked for and not found.
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
        """Limits that are not kept, worst share of the limit first."""
        broken = [margin for margin in self.margins if not margin.ok]
        return tuple(sorted(broken, key=lambda margin: margin.slack / max(abs(margin.limit), 1e-9)))

    def tightest(self) -> tuple[Margin, ...]:
        """The tightest margin of each constraint."""
        best: dict[str, Margin] = {}
        for margin in self.margins:
            share = margin.slack / max(abs(margin.limit), 1e-9)
            known = best.get(margin.constraint)
            if known is None or share < known.slack / max(abs(known.limit), 1e-9):
                best[margin.constraint] = margin
        return tuple(best.values())

    def __str__(self) -> str:
        return "\n".join(str(margin) for margin in self.tightest())


def check_motion(
    motion: ParametricMotion,
    mechanism: Mechanism,
    limits: Limits,
    *,
    workspace: Workspace | None = None,
    estimate: ArmEstimate | None = None,
    coverage: float = 3.0,
    checker: PathChecker | None = None,
    clearance_m: float = 0.0,
    step_s: float = 1e-3,
    collision_step_s: float = 1e-2,
    continuous: bool = False,
) -> Check:
    """Compare a motion with every limit.

    step_s, collision_step_s : sampling of torque and flange, and of the collision checker's path
    continuous : also prove torque, flange and clearance for every instant, if the samples are clean
    """
    if motion.joints != mechanism.joints:
        raise ConfigurationError(f"the motion has {motion.joints} joints, the arm {mechanism.joints}")
    margins = _kinematic_margins(motion, mechanism, limits)
    count = max(2, round(motion.duration / step_s))
    times = np.linspace(0.0, motion.duration, count, endpoint=False)
    samples = motion.sample(times)
    if estimate is not None:
        margins += _torque_margins(samples, times, mechanism, limits, estimate, coverage)
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
    """Constraints of the workspace that could not be proven."""
    extents = np.zeros(mechanism.joints)
    extents[-1] = np.linalg.norm(mechanism.tip)
    rate = speed_bound(motion, reach(mechanism, extents))

    def radius(times: Array) -> Array:
        points = tip_path(mechanism, motion.sample(times).q)
        return np.hypot(points[:, 0], points[:, 1]) - float(workspace.radius_m or 0.0)

    def height(times: Array) -> Array:
        return tip_path(mechanism, motion.sample(times).q)[:, 2] - float(workspace.height_m or 0.0)

    unproven = set()
    if workspace.radius_m is not None and not prove(motion, radius, rate).proven:
        unproven.add("distance from axis 1")
    if workspace.height_m is not None and not prove(motion, height, rate).proven:
        unproven.add("height")
    return unproven


def _clearance_proof(
    motion: ParametricMotion, mechanism: Mechanism, checker: PathChecker, clearance_m: float
) -> Proof:
    space, _ = space_of(mechanism, getattr(checker, "geometry", None))
    rate = speed_bound(motion, reach(mechanism, space.extents(mechanism.joints)))

    def slack(times: Array) -> Array:
        postures = motion.sample(times).q
        return np.array([checker.clearance(posture).distance for posture in postures]) - clearance_m

    return prove(motion, slack, rate)


def _kinematic_margins(motion: ParametricMotion, mechanism: Mechanism, limits: Limits) -> list[Margin]:
    margins = []
    for order, (constraint, unit) in enumerate(KINEMATIC):
        extrema = motion.extrema(order)
        for joint, name in enumerate(mechanism.joint_names):
            if order == 0:
                low, high = float(limits.q_low[joint]), float(limits.q_high[joint])
            else:
                bound = (limits.v_max, limits.a_max, limits.j_max)[order - 1]
                low, high = -float(bound[joint]), float(bound[joint])
            below, above = float(extrema.low[joint]) - low, high - float(extrema.high[joint])
            if below < above:
                found = (float(extrema.low[joint]), low, below, float(extrema.t_low[joint]))
            else:
                found = (float(extrema.high[joint]), high, above, float(extrema.t_high[joint]))
            margins.append(Margin(constraint, name, found[0], found[1], found[2], unit, found[3]))
    return margins


def _torque_margins(
    samples: Samples,
    times: Array,
    mechanism: Mechanism,
    limits: Limits,
    estimate: ArmEstimate,
    coverage: float,
) -> list[Margin]:
    margins = []
    bounds = torque_bounds(mechanism, samples, estimate, coverage)
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
    radius = np.hypot(points[:, 0], points[:, 1])
    for constraint, values, limit in (
        ("distance from axis 1", radius, workspace.radius_m),
        ("height", points[:, 2], workspace.height_m),
    ):
        if limit is not None:
            row = int(np.argmin(values))
            value = float(values[row])
            margins.append(Margin(constraint, "flange", value, limit, value - limit, "m", float(times[row])))
    return margins


def _clearance_margin(
    motion: ParametricMotion, checker: PathChecker, clearance_m: float, step_s: float
) -> Margin:
    count = max(2, int(np.ceil(motion.duration / step_s)))
    times = np.linspace(0.0, motion.duration, count, endpoint=False)
    nearest = checker.check_path(motion.sample(times).q, period_s=float(times[1]))
    distance = float(nearest.distance)
    subject = " and ".join(nearest.pair)
    return Margin(
        "clearance", subject, distance, clearance_m, distance - clearance_m, "m", float(times[nearest.row])
    )
