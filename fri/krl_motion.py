"""Motions of a KRL program: `PTP`, all axes in step."""

from __future__ import annotations

import numpy as np

from fri.krc import KrcSession
from fri.states import State

_SHORTEST_MOTION_MS = 50.0


class PointToPoint:
    """A synchronous motion of all axes with the least jerk, from KRL's setpoint to `goal` (7,) [rad].

    begin_ms : by the interpreter's clock. share : of the session's limits of velocity and acceleration
    """

    def __init__(self, session: KrcSession, goal: np.ndarray, begin_ms: float, share: float) -> None:
        self.start, self.goal, self.begin_ms = session.krl_setpoint, goal, begin_ms
        way, limits = np.abs(goal - self.start), session.limits
        # Peaks of the polynomial 10 s^3 - 15 s^4 + 6 s^5.
        fast = 1.875 * way / (limits.v_max * share)
        hard = np.sqrt(5.774 * way / (limits.a_max * share))
        self.duration_ms = max(_SHORTEST_MOTION_MS, 1000.0 * float(np.max(np.maximum(fast, hard))))
        self.commanded = session.state is State.CMD

    def position(self, now_ms: float) -> np.ndarray:
        """Setpoint (7,) [rad]."""
        s = min(1.0, max(0.0, (now_ms - self.begin_ms) / self.duration_ms))
        return (
            self.goal
            if s == 1.0
            else self.start + s**3 * (10 - 15 * s + 6 * s * s) * (self.goal - self.start)
        )
