"""Motions of the discriminating experiments, as splines from rest to rest.

A spline through dense points of a path of straight lines rounds its corners and keeps its speeds, so one form
serves slow sweeps, reversals of growing size, poses and chirps alike. Every motion lasts a multiple of `GRAIN_S`, a
multiple of the usual FRI cycles.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ident.excitation.motions import SplineMotion
from lwr_driver.arm import Arm

Floats = NDArray[np.float64]

GRAIN_S = 0.12
_REST_S = 1.0
_COARSE_S, _FINE_S = 0.1, 0.04

_SWEEPS = (
    (1.0, 0.6),
    (1.0, 0.6),
    (1.0, 0.3),
    (0.6, 0.15),
    (0.5, 0.09),
    (0.35, 0.055),
    (0.2, 0.033),
    (0.12, 0.02),
    (0.08, 0.013),
)
"""Share of the range and speed [rad/s], each there and back."""

_SWINGS, _SWING_SPEED, _SWING_STEP_S = 8, 1.4, 0.1
"""Number of the fast swings that follow, their highest speed [rad/s], and the time between points of their path."""

_LADDER = ((0.01, 2.0, 6), (0.02, 1.2, 6), (0.05, 0.5, 4), (0.1, 0.25, 3), (0.3, 0.08, 1))
"""Amplitude [rad], frequency [Hz] and number of the cycles."""

_CHIRP = (1.0, 8.0, 14.0)
"""First and last frequency [Hz], duration [s]."""

_POSE_SPEED = 0.25
_POSE_REST_S = 0.4


def slow_sweep(arm: Arm, home: Floats, joint: int, span: float) -> SplineMotion:
    """Constant speeds of `joint` (from 0) from 0.6 down to 0.013 rad/s, there and back, over `span` [rad].

    Swings of up to 1.4 rad/s follow, because low and high speeds together separate the Stribeck effect from nonlinear
    viscous friction. The large sweeps are repeated with the next joint turned, to separate load from angle.
    """
    middle = _centred(arm, home, joint, span)
    points = [middle]
    speeds: list[float] = []
    for share, speed in _SWEEPS:
        _there_and_back(points, speeds, joint, 0.5 * share * span, speed)
    _swing(arm, points, speeds, joint, 0.5 * span)
    other = joint - 1 if joint > 0 else joint + 1
    turned = np.array(middle)
    turned[other] += 0.35 if turned[other] < 0.5 * (arm.q_low[other] + arm.q_high[other]) else -0.35
    points.append(turned)
    speeds.append(_POSE_SPEED)
    _there_and_back(points, speeds, joint, 0.5 * span, 0.15)
    points.append(middle)
    speeds.append(_POSE_SPEED)
    return _along(points, speeds, 0.0)


def reversal_ladder(arm: Arm, home: Floats, joint: int, span: float) -> SplineMotion:
    """Reversals of `joint` (from 0) at amplitudes from 0.01 rad to half of `span`."""
    middle = _centred(arm, home, joint, span)
    rungs = [(min(a, 0.5 * span), f, n) for a, f, n in _LADDER]
    ends = np.cumsum([n / f for _, f, n in rungs])

    def offset(t: Floats) -> Floats:
        out = np.zeros_like(t)
        for (amplitude, frequency, count), end in zip(rungs, ends, strict=True):
            since = t - (end - count / frequency)
            mine = (since >= 0.0) & (since < count / frequency)
            out[mine] = amplitude * np.sin(2.0 * np.pi * frequency * since[mine])
        return out

    return _about(middle, joint, offset, float(ends[-1]))


def chirp(arm: Arm, home: Floats, joint: int, span: float) -> SplineMotion:
    """Oscillation of `joint` (from 0) from 1 to 8 Hz, well within the limits of acceleration and jerk."""
    middle = _centred(arm, home, joint, span)
    first, last, duration = _CHIRP
    a_most, j_most = 0.3 * float(arm.a_max[joint]), 0.5 * float(arm.j_max[joint])

    def offset(t: Floats) -> Floats:
        share = np.clip(t / duration, 0.0, 1.0)
        phase = 2.0 * np.pi * duration * (first * share + 0.5 * (last - first) * share**2)
        omega = 2.0 * np.pi * (first + (last - first) * share)
        size = np.minimum.reduce([np.full_like(t, 0.1 * span), a_most / omega**2, j_most / omega**3])
        edge = np.minimum(1.0, 4.0 * np.minimum(share, 1.0 - share) / 0.2)
        return np.asarray(size * edge * np.sin(phase))

    return _about(middle, joint, offset, duration)


def poses(
    arm: Arm, home: Floats, spread: float, free: Callable[[Floats], bool], count: int = 7
) -> SplineMotion:
    """Slowly through `count` poses within `spread` [rad] of home and back the same way, with a rest in each.

    free : whether a pose (n,) is clear of collisions. Slow motion both ways, because friction at rest is unknown.
    """
    random = np.random.default_rng(1)
    low, high = np.maximum(arm.q_low, home - spread), np.minimum(arm.q_high, home + spread)
    chosen: list[Floats] = [np.asarray(home, dtype=float)]
    while len(chosen) < count + 1:
        pose = random.uniform(low, high)
        for share in (1.0, 0.5, 0.25, 0.0):
            nearer = home + share * (pose - home)
            if free(nearer):
                break
        chosen.append(nearer + 1e-3)
    points = [*chosen, *chosen[-2::-1]]
    return _along(points, [_POSE_SPEED] * (len(points) - 1), _POSE_REST_S)


def _centred(arm: Arm, home: Floats, joint: int, span: float) -> Floats:
    """Home, with room for `span` around the joint."""
    middle = np.array(home, dtype=float)
    half = 0.5 * span
    middle[joint] = np.clip(middle[joint], arm.q_low[joint] + half, arm.q_high[joint] - half)
    return middle


def _there_and_back(points: list[Floats], speeds: list[float], joint: int, half: float, speed: float) -> None:
    """From the end of the path to one side, to the other, and back."""
    middle = np.array(points[-1])
    for offset in (half, -half, 0.0):
        point = np.array(middle)
        point[joint] += offset
        points.append(point)
        speeds.append(speed)


def _swing(arm: Arm, points: list[Floats], speeds: list[float], joint: int, half: float) -> None:
    """Sinusoids about the end of the path, well within the limits of speed and acceleration."""
    middle = np.array(points[-1])
    fastest = min(_SWING_SPEED, 0.8 * float(arm.v_max[joint]), float(np.sqrt(0.5 * arm.a_max[joint] * half)))
    count = max(8, round(2.0 * np.pi * half / fastest / _SWING_STEP_S))
    for k in range(1, _SWINGS * count + 1):
        point = np.array(middle)
        # The first and the last swing grow and fade.
        size = min(1.0, k / count, _SWINGS - k / count)
        point[joint] += size * half * np.sin(2.0 * np.pi * k / count)
        speeds.append(max(abs(float(point[joint] - points[-1][joint])) / _SWING_STEP_S, 1e-3))
        points.append(point)


def _along(points: Sequence[Floats], speeds: Sequence[float], rest_s: float) -> SplineMotion:
    """Straight lines through points (n,), each at its speed of the fastest joint [rad/s], with rests [s]."""
    times, places, now = [0.0, _REST_S], [points[0], points[0]], _REST_S
    for (start, stop), speed in zip(pairwise(points), speeds, strict=True):
        moving = max(float(np.max(np.abs(stop - start))) / speed, _COARSE_S)
        for lasting in (moving, rest_s) if rest_s else (moving,):
            now += lasting
            times.append(now)
            places.append(stop)
    path = np.array(places)

    def at(t: Floats) -> Floats:
        return np.column_stack([np.interp(t, times, column) for column in path.T])

    return _spline(at, now + _REST_S, _COARSE_S)


def _about(middle: Floats, joint: int, offset: Callable[[Floats], Floats], duration_s: float) -> SplineMotion:
    """`joint` moves by `offset` of the time about the middle (n,)."""

    def at(t: Floats) -> Floats:
        q = np.tile(middle, (len(t), 1))
        q[:, joint] += offset(t - _REST_S)
        return q

    return _spline(at, duration_s + 2.0 * _REST_S, _FINE_S)


def _spline(at: Callable[[Floats], Floats], duration_s: float, step_s: float) -> SplineMotion:
    whole = float(np.ceil(duration_s / GRAIN_S - 1e-9)) * GRAIN_S
    # Six decimals of a second, for a clean number in the file.
    whole = round(whole, 6)
    count = max(12, round(whole / step_s))
    points = at(np.linspace(0.0, whole, count)).T.copy()
    points[:, :3], points[:, -3:] = points[:, :1], points[:, :1]
    return SplineMotion(whole, np.round(points, 9))
