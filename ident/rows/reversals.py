"""Samples beside the reversals of a joint."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ident.dynamics.parameters import Floats

TURNING_RAD = 1e-3
"""Friction of a drive turns over a path: tenths of a milliradian in strain-wave gears, whatever the time it takes."""
_LONGEST_S = 10.0
RINGING_S = 0.1
"""A link that swings at 5 Hz or faster rings on its spring, beside a drive that may stand still."""


def away_from_reversals(
    speed: Floats, dt: float, window_s: float, standstill_rad_s: float, turning_rad: float
) -> NDArray[np.bool_]:
    """Samples (n, J) whose joint keeps its direction, faster than standstill, for `window_s` before and after, has gone
    `turning_rad` since its reversal or rest, and does not ring.

    speed : (n, J) every `dt` seconds [rad/s].
    """
    away = np.empty(speed.shape, dtype=bool)
    for joint in range(speed.shape[1]):
        own = np.ascontiguousarray(speed[:, joint])
        _mark(own, dt, round(window_s / dt), standstill_rad_s, turning_rad, away[:, joint])
    return away


def away_of_drives(
    speed: Floats,
    dt: float,
    window_s: float,
    standstill_rad_s: float,
    turning_rad: float,
    *,
    slow_rad_s: float = 0.0,
    coupled: Sequence[tuple[int, int]] = (),
) -> NDArray[np.bool_]:
    """Samples (n, J) away from the reversals and the slow motion of their joint, and of the drives it shares.

    Arguments as for `away_from_reversals`. slow_rad_s : speed up to which motion is slow. coupled : numbers of the two
    joints of each pair; their shared drive turns with the sum of their speeds.
    """
    shared = np.column_stack([speed, *(speed[:, a] + speed[:, b] for a, b in coupled)])
    away = away_from_reversals(shared, dt, window_s, standstill_rad_s, turning_rad)
    away &= np.abs(shared) > slow_rad_s
    found = away[:, : speed.shape[1]]
    for pair, of_both in zip(coupled, away.T[speed.shape[1] :], strict=True):
        found[:, list(pair)] &= of_both[:, None]
    return found


def ringing(speed: Floats, dt: float) -> NDArray[np.bool_]:
    """Samples (n,) between two reversals within `RINGING_S` of one another.

    speed : (n,) of a joint every `dt` seconds [rad/s].
    """
    turns = np.flatnonzero(np.diff(np.signbit(speed))) + 1
    quick = np.diff(turns) * dt < RINGING_S
    # No swing is known before the first reversal and after the last one.
    lengths = np.diff(np.concatenate([[0], turns, [len(speed)]]))
    return np.repeat(np.concatenate([[False], quick, [False]])[: len(lengths)], lengths)


def turning_reach(window_s: float, standstill_rad_s: float, turning_rad: float) -> float:
    """Time [s] that `away_from_reversals` looks back and ahead: that of the path at the slowest speed, 10 s at most."""
    return max(window_s + min(turning_rad / max(standstill_rad_s, 1e-4), _LONGEST_S), RINGING_S)


@njit(cache=True, nogil=True)
def _mark(speed, dt, window, standstill_rad_s, turning_rad, away):  # type: ignore[no-untyped-def]
    """`away_from_reversals` of the speed (n,) of one joint, to `away` (n,). window : samples on either side."""
    count = len(speed)
    gone, start = 0.0, 0.0
    way, since, turn = 0, 0, -1
    for k in range(count):
        now = 0
        if speed[k] > standstill_rad_s:
            now = 1
        elif speed[k] < -standstill_rad_s:
            now = -1
        step = abs(speed[k]) * dt
        gone += step
        if k == 0 or now == 0 or now != way:
            # What the samples before within the window see ahead; those before a rest have seen its begin.
            for before in range(max(k - window, 0) if now != 0 or way != 0 else k, k):
                away[before] = False
            start = max(start, gone - step)
            way, since = now, k
        # No sample is missing before the first one.
        kept = since == 0 or k - since >= window
        away[k] = now != 0 and kept and (turning_rad <= 0.0 or gone - start >= turning_rad)
        if k > 0 and (np.signbit(speed[k]) != np.signbit(speed[k - 1])):
            # No swing is known before the first reversal and after the last one.
            if turn >= 0 and (k - turn) * dt < RINGING_S:
                for before in range(turn, k):
                    away[before] = False
            turn = k
