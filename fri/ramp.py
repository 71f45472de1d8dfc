"""The controller's own stop: every joint brakes to rest with bounded acceleration and jerk.

Deceleration rises linearly to its bound, stays, and falls linearly to zero (seven-segment profile without its
first half). For a speed v, a bound a and a jerk j the ends of the segments are at

    t_j = min(a / j, sqrt(v / j)),   t_j + max(0, v / a - t_j),   and t_j later.
"""

from __future__ import annotations

import numpy as np

__all__ = ["StopRamp"]


class StopRamp:
    """Positions of seven joints that brake from (q, v) at their bounds, each joint by itself.

    Parameters
    ----------
    q, v : np.ndarray
        (7,) position [rad] and velocity [rad/s] where the stop begins.
    a, j : np.ndarray
        (7,) bounds of deceleration [rad/s^2] and jerk [rad/s^3].
    q_min, q_max : np.ndarray
        (7,) ends of travel [rad]; the ramp does not leave them, or does not go further out if it begins
        outside.
    """

    def __init__(
        self,
        q: np.ndarray,
        v: np.ndarray,
        a: np.ndarray,
        j: np.ndarray,
        q_min: np.ndarray,
        q_max: np.ndarray,
    ) -> None:
        self._q = np.array(q, dtype=float)
        self._sign = np.sign(v)
        speed = np.abs(v)
        self._speed = speed
        self._jerk = np.array(j, dtype=float)
        self._rise = np.minimum(a / j, np.sqrt(speed / j))
        self._hold = np.maximum(0.0, speed / a - self._rise)
        self._peak = self._jerk * self._rise
        self._low = np.minimum(q_min, self._q)
        self._high = np.maximum(q_max, self._q)
        self.duration_s = float(np.max(2.0 * self._rise + self._hold))

    def position(self, t: np.ndarray) -> np.ndarray:
        """Positions (n, 7) [rad] at the times `t` (n,) [s]; at rest from `duration_s` on."""
        t = np.asarray(t, dtype=float)[:, np.newaxis]
        rising = np.clip(t, 0.0, self._rise)
        holding = np.clip(t - self._rise, 0.0, self._hold)
        falling = np.clip(t - self._rise - self._hold, 0.0, self._rise)
        speed_1 = self._speed - 0.5 * self._jerk * self._rise**2
        speed_2 = speed_1 - self._peak * self._hold
        path = self._speed * rising - self._jerk * rising**3 / 6.0
        path += speed_1 * holding - 0.5 * self._peak * holding**2
        path += speed_2 * falling - 0.5 * self._peak * falling**2 + self._jerk * falling**3 / 6.0
        return np.clip(self._q + self._sign * path, self._low, self._high)
