"""Proof that a limit holds between the samples too, by Lipschitz bounds and bisection in time.

A quantity g(t) >= 0 whose rate is bounded by L on an interval of half-width h around t is positive on all of
it if g(t) > L h. Intervals that fail the test are halved until they pass, g < 0 is found, or they are shorter
than a nanosecond share of the motion. L comes from bounds of joint velocity, acceleration and jerk on the
interval itself: value in the middle plus the exact extreme value of the next derivative times h.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ident.excitation.estimate import ArmEstimate, split_name
from ident.excitation.mechanism import Mechanism
from ident.excitation.motion import Array, ParametricMotion

__all__ = ["Proof", "prove", "reach", "speed_bound", "torque_rate"]

_SMALLEST = 1e-6  # shortest half-width as a share of the motion: microseconds


@dataclass(frozen=True)
class Proof:
    """Outcome: the smallest sampled value and its time, whether it is proven for all instants, samples
    used.
    """

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


def reach(mechanism: Mechanism, extents: Array) -> Array:
    """Longest distance from each joint axis to any point that it moves, (n,) [m].

    extents (n,): distance of the farthest point of each body from its own frame's origin [m].
    """
    n = mechanism.joints
    lengths = np.linalg.norm(mechanism.translation, axis=1)
    lever = np.array(extents, dtype=np.float64)
    for joint in range(n - 2, -1, -1):
        lever[joint] = max(lever[joint], lengths[joint + 1] + lever[joint + 1])
    return lever


def speed_bound(motion: ParametricMotion, lever: Array) -> Callable[[Array, float], Array]:
    """Bound of the speed of any point that the joints carry at most `lever` (n,) away; see `prove`."""
    extrema = motion.extrema(2)
    acceleration = np.maximum(np.abs(extrema.low), np.abs(extrema.high))

    def rate(times: Array, half: float) -> Array:
        return (np.abs(motion.sample(times).qd) + acceleration * half) @ lever

    return rate


def torque_rate(
    motion: ParametricMotion, mechanism: Mechanism, estimate: ArmEstimate, coverage: float
) -> Callable[[Array, float], Array]:
    """Bound of the rate of the joint and motor torque bounds of `torque.torque_bounds`, (n, joints) [Nm/s].

    Norms are carried along the chain: angular velocity, acceleration and jerk add up joint by joint, origins
    and wrenches follow. Uncertainty adds the same bound with standard deviations in place of the parameters'
    sizes.
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
    """Largest rate of the jerk, from its samples if the motion does not tell: only multiplies h, so it
    hardly matters.
    """
    times = np.linspace(0.0, motion.duration, 2001)
    jerk = motion.sample(times).qddd
    return 2.0 * np.max(np.abs(np.diff(jerk, axis=0)), axis=0) / (times[1] - times[0])


@dataclass(frozen=True, eq=False)
class _Sizes:
    """Norms of mass, first moment and inertia of each body (n,), and drive terms (n,)."""

    mass: Array
    moment: Array
    inertia: Array
    drive_inertia: Array
    viscous: Array


def _sizes(mechanism: Mechanism, estimate: ArmEstimate, coverage: float) -> _Sizes:
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
    return _Sizes(mass, moment, inertia, drive_inertia, viscous)


def _wrench_rate(mechanism: Mechanism, sizes: _Sizes, v: Array, a: Array, j: Array) -> Array:
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
        mass, moment, inertia = sizes.mass[b], sizes.moment[b], sizes.inertia[b]
        force.append(mass * acceleration + moment * (dw + w**2))
        force_rate.append(mass * jolt + moment * (ddw + 3.0 * dw * w + w**3))
        couple.append(inertia * (dw + w**2) + moment * acceleration)
        couple_rate.append(inertia * (ddw + 4.0 * dw * w + 2.0 * w**3) + moment * (jolt + w * acceleration))
        spin.append(w)
    out = np.empty_like(v)
    for joint in range(n):
        total, lever = zero, 0.0
        for b in range(joint, n):
            if b > joint:
                lever += lengths[b]
            total = total + couple_rate[b] + spin[b] * couple[b]
            total = total + lever * (force_rate[b] + 2.0 * spin[b] * force[b])
        out[:, joint] = total + sizes.drive_inertia[joint] * j[:, joint] + sizes.viscous[joint] * a[:, joint]
    return out
