"""The total setpoint of the arm over time: commanded, extrapolated, braking, or moved by KRL.

Within a period the setpoint moves linearly, in steps of 1 ms, to its new value. The controller's own stop
brakes each joint with bounded deceleration and jerk: the deceleration rises linearly to its bound, stays, and
falls linearly to zero (second half of a seven-segment profile). For a speed v, a bound a and a jerk j the
segments end at

    t_j = min(a / j, sqrt(v / j)),   t_j + max(0, v / a - t_j),   and t_j later.
"""

from __future__ import annotations

import numpy as np

from fri.packets import JOINTS
from fri.policy import KrcLimits, KrcPolicy


class StopRamp:
    """Positions of seven joints braking from (q, v), each joint at its own bounds.

    q, v : (7,) position [rad] and velocity [rad/s] at the beginning of the stop. a, j : (7,) bounds of
    deceleration [rad/s^2] and jerk [rad/s^3]. q_min, q_max : (7,) ends of travel [rad]; the ramp stays inside, or
    goes no further out if it begins outside.
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


class SetpointTrack:
    """Setpoint of seven joints over time, from `q` (7,) [rad] on; limits and policy bound the braking.

    target : (7,) setpoint at the end of the present period [rad]; never written in place. missed : commands missing
    since the last one
    """

    def __init__(self, limits: KrcLimits, policy: KrcPolicy, q: np.ndarray) -> None:
        self._limits = limits
        self._deceleration = limits.a_max * policy.stop_acceleration_factor
        self._jerk = self._deceleration / policy.stop_jerk_time_s
        self._ramp: StopRamp | None = None
        self._ramp_ms = 0
        self._goal = q
        self.target = q
        self.missed = 0
        self.set_period(1)
        self.place(q)

    @property
    def ramping(self) -> bool:
        """Whether the setpoint is braking."""
        return self._ramp is not None

    def set_period(self, period_ms: int) -> None:
        """Set the period [ms]."""
        self._period_ms = period_ms
        self._fractions = np.arange(1, period_ms + 1)[:, np.newaxis] / period_ms

    def place(self, q: np.ndarray) -> None:
        """Set the setpoint to `q` at once, at rest."""
        self.target = q.copy()
        self.rest()

    def shift(self, change: np.ndarray) -> None:
        """Move by `change` (7,) [rad] in the next period without commands; not while braking."""
        if self._ramp is None:
            self._goal = self._goal + change

    def rest(self) -> None:
        """Forget the velocity of the commands."""
        # The last command, its mean step per cycle, and the number of cycles in this mean.
        self._previous = self._goal = self._accepted = self.target
        self._step = np.zeros(JOINTS)
        self._span = 1
        self.missed = 0

    def change_of_step(self, q: np.ndarray) -> tuple[np.ndarray, float]:
        """Change of the step per cycle, (7,) [rad], if `q` were the next command, and its cycles."""
        span = self.missed + 1
        return (q - self._accepted) / span - self._step, (span + self._span) / 2

    def command(self, q: np.ndarray) -> np.ndarray:
        """Go on to the command `q`; the setpoints of the period, (n, 7)."""
        self._accept(q)
        return self._go(q)

    def _accept(self, q: np.ndarray) -> None:
        self._span = self.missed + 1
        self._step = (q - self._accepted) / self._span
        self._accepted = q
        self.missed = 0

    def lines(self, commands: np.ndarray) -> np.ndarray:
        """The setpoints of the periods of the commands (m, 7), one after the other, (m n, 7)."""
        if self._period_ms == 1:
            return commands
        starts = np.concatenate([self.target[np.newaxis], commands[:-1]])[:, np.newaxis]
        ends = commands[:, np.newaxis]
        positions = starts + self._fractions * (ends - starts)
        positions[:, -1:] = ends
        return positions.reshape(-1, JOINTS)

    def follow(self, before: np.ndarray, q: np.ndarray) -> None:
        """Be where ``command`` leads with q after `before`, (7,) each; `accept` completes it."""
        self._previous, self.target, self._goal = before, q, q

    def accept(self, commands: np.ndarray) -> None:
        """The commands (m, 7) that were followed, all after the last one of ``command`` or ``accept``."""
        # Nothing of a command is left after the next two.
        for q in commands[-2:]:
            self._accept(q)

    def extrapolated(self) -> np.ndarray:
        """The setpoint one step further on, (7,)."""
        return self.target + self._step

    def bridge(self) -> np.ndarray:
        """Go on to the extrapolated setpoint; the setpoints of the period, (n, 7)."""
        self.missed += 1
        return self._go(self.extrapolated())

    def brake(self) -> None:
        """Come to rest from the present velocity; ``coast`` gives the setpoints."""
        velocity = (self.target - self._previous) / (self._period_ms * 1e-3)
        self.rest()
        if not velocity.any():
            return
        limits = self._limits
        self._ramp = StopRamp(
            self.target, velocity, self._deceleration, self._jerk, limits.q_min, limits.q_max
        )
        self._ramp_ms = 0

    def coast(self) -> np.ndarray:
        """The setpoints of a period without commands, (n, 7): braking, or moved by ``shift``."""
        if self._ramp is None:
            positions = self._line(self.target, self._goal)
            self.target = self._goal
            self.rest()
            return positions
        times = (self._ramp_ms + np.arange(1, self._period_ms + 1)) * 1e-3
        positions = self._ramp.position(times)
        self._ramp_ms += self._period_ms
        if self._ramp_ms * 1e-3 >= self._ramp.duration_s:
            self._ramp = None
        self.target = positions[-1].copy()
        self.rest()
        return positions

    def _go(self, q: np.ndarray) -> np.ndarray:
        positions = self._line(self.target, q)
        self._previous, self.target = self.target, q
        self._goal = q
        return positions

    def _line(self, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        if self._period_ms == 1:
            return end.reshape(1, JOINTS).copy()
        positions = start + self._fractions * (end - start)
        positions[-1] = end
        return positions
