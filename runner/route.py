"""The way of one session: approach, settle, excite, brake and return, as one motion that is checked first."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from lwr_driver.arm import Arm
from lwr_driver.motion import Motion, move_to

__all__ = ["dwell", "route", "way"]

Vector = npt.NDArray[np.float64]


def dwell(q: Vector, duration_s: float, period_s: float, phase: str) -> Motion:
    """Rest at q, (n,) [rad], for `duration_s` [s]."""
    rows = max(2, round(duration_s / period_s) + 1)
    return Motion(np.tile(q, (rows, 1)), period_s, ((0, phase),))


def way(arm: Arm, points: Sequence[Vector], period_s: float, speed_scale: float, phase: str) -> Motion:
    """Straight jerk-limited moves in joint space from point to point, at rest in each, (n,) [rad]."""
    motion = dwell(points[0], 0.0, period_s, phase)
    for start, goal in itertools.pairwise(points):
        motion = motion.join(move_to(arm, start, goal, period_s, speed_scale=speed_scale, phase=phase))
    return motion


def route(
    arm: Arm,
    approach: Sequence[Vector],
    excitation: Motion,
    retreat: Sequence[Vector],
    *,
    speed_scale: float,
    settle_s: float,
    brake_s: float,
) -> Motion:
    """One session as one motion.

    approach : points from where the arm is to the first row of the excitation. retreat : points from its last
    row to where the arm shall rest. speed_scale : of the velocity limits, for both. settle_s, brake_s : rest
    before and after the excitation [s].
    """
    period = excitation.period_s
    first, last = excitation.q[0], excitation.q[-1]
    motion = way(arm, [*approach, first], period, speed_scale, "move_to_start")
    motion = motion.join(dwell(first, settle_s, period, "settle"))
    motion = motion.join(excitation)
    motion = motion.join(dwell(last, brake_s, period, "brake"))
    return motion.join(way(arm, [last, *retreat], period, speed_scale, "return"))
