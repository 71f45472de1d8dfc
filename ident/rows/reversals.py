"""Samples beside the reversals of a joint."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d, minimum_filter1d

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
    size = 2 * round(window_s / dt) + 1
    lowest, highest = minimum_filter1d(speed, size, axis=0), maximum_filter1d(speed, size, axis=0)
    away = np.asarray((lowest > standstill_rad_s) | (highest < -standstill_rad_s))
    if turning_rad > 0.0:
        away &= _path(speed, dt, standstill_rad_s) >= turning_rad
    for joint, own in enumerate(speed.T):
        away[:, joint] &= ~ringing(own, dt)
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


def _path(speed: Floats, dt: float, standstill_rad_s: float) -> Floats:
    """Path (n, J) since the joint last reversed or rested [rad]."""
    way = np.where(np.abs(speed) > standstill_rad_s, np.sign(speed), 0.0)
    turned = np.ones(speed.shape, dtype=bool)
    turned[1:] = (way[1:] != way[:-1]) | (way[1:] == 0.0)
    step = np.abs(speed) * dt
    gone = np.cumsum(step, axis=0)
    # `gone` only grows, so the largest one before a turn is the last.
    return np.asarray(gone - np.maximum.accumulate(np.where(turned, gone - step, 0.0), axis=0))
