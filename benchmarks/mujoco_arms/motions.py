"""Motions of the arms: sums of sines, sweeps, and point to point with dwell."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from benchmarks.mujoco_arms.arms import Kind
from benchmarks.mujoco_arms.simulation import RECORD_S

Floats = NDArray[np.float64]

STYLES = ("fourier", "points", "chirp")
_FADE_S = 1.5
_REST_S = 0.3
_ACCELERATION = 6.0


def motion(kind: Kind, style: str, seconds: float, random: np.random.Generator) -> tuple[Floats, Floats]:
    """Commands q, qd (m, n) every `RECORD_S` [rad, rad/s], from rest to rest, within the spans and speeds."""
    moving = round((seconds - 2.0 * _REST_S) / RECORD_S)
    times = np.arange(moving) * RECORD_S
    shape = {"fourier": _fourier, "points": _points, "chirp": _chirp}[style](kind, times, random)
    rest = round(_REST_S / RECORD_S)
    q = np.vstack([np.tile(shape[:1], (rest, 1)), shape, np.tile(shape[-1:], (rest, 1))])
    return q, np.gradient(q, RECORD_S, axis=0)


def _fitted(kind: Kind, shape: Floats, random: np.random.Generator) -> Floats:
    """(m, n) without unit, moved and scaled into a part of the span, speed and acceleration."""
    low, high = kind.span
    shape = shape - 0.5 * (shape.max(axis=0) + shape.min(axis=0))
    speed = np.abs(np.gradient(shape, RECORD_S, axis=0)).max(axis=0)
    sharp = np.abs(np.gradient(np.gradient(shape, RECORD_S, axis=0), RECORD_S, axis=0)).max(axis=0)
    reach = np.ptp(shape, axis=0)
    wanted = random.uniform(0.45, 0.9, kind.size)
    scale = np.minimum(wanted * (high - low) / reach, wanted * kind.speed / speed)
    scale = np.minimum(scale, _ACCELERATION / sharp)
    room = 0.5 * ((high - low) - scale * reach)
    return np.asarray(0.5 * (low + high) + random.uniform(-1.0, 1.0, kind.size) * room + scale * shape)


def _window(times: Floats) -> Floats:
    x = np.clip(np.minimum(times, times[-1] - times) / _FADE_S, 0.0, 1.0)
    return np.asarray(x**3 * (10.0 - 15.0 * x + 6.0 * x**2))[:, None]


def _fourier(kind: Kind, times: Floats, random: np.random.Generator) -> Floats:
    period = random.uniform(7.0, 14.0)
    shape = np.zeros((len(times), kind.size))
    for harmonic in range(1, random.integers(4, 8)):
        size = random.normal(0.0, 1.0 / harmonic, (2, kind.size))
        angle = 2.0 * np.pi * harmonic / period * times[:, None]
        shape += size[0] * np.sin(angle) + size[1] * np.cos(angle)
    return _fitted(kind, shape * _window(times), random)


def _chirp(kind: Kind, times: Floats, random: np.random.Generator) -> Floats:
    slow, fast = random.uniform(0.04, 0.1, kind.size), random.uniform(0.3, 0.8, kind.size)
    fast, slow = np.where(random.random(kind.size) < 0.5, (fast, slow), (slow, fast))
    share = times[:, None] / times[-1]
    # The amplitude falls as the frequency, for one speed all along.
    hertz = slow * (fast / slow) ** share
    angle = np.cumsum(2.0 * np.pi * hertz, axis=0) * RECORD_S + random.uniform(0.0, 2.0 * np.pi, kind.size)
    return _fitted(kind, np.sin(angle) / hertz * _window(times), random)


def _points(kind: Kind, times: Floats, random: np.random.Generator) -> Floats:
    low, high = kind.span
    low, high = low + 0.06 * (high - low), high - 0.06 * (high - low)
    here = random.uniform(low, high)
    q = np.empty((len(times), kind.size))
    k = 0
    while k < len(times):
        goal = here + random.uniform(0.1, 0.8) * (random.uniform(low, high) - here)
        share = random.uniform(0.5, 0.95)
        # Peaks of the quintic: speed 1.875 a period, acceleration 5.77 a period squared.
        longest = max(
            float(np.max(1.875 * np.abs(goal - here) / (share * kind.speed))),
            float(np.sqrt(np.max(5.77 * np.abs(goal - here)) / _ACCELERATION)),
            0.4,
        )
        if k * RECORD_S + longest + 0.2 > times[-1]:
            q[k:] = here
            break
        count = round(longest / RECORD_S)
        x = np.arange(count)[:, None] / count
        q[k : k + count] = here + (goal - here) * x**3 * (10.0 - 15.0 * x + 6.0 * x**2)
        dwell = round(random.uniform(0.1, 0.7) / RECORD_S)
        q[k + count : k + count + dwell] = goal
        here, k = goal, k + count + dwell
    return q
