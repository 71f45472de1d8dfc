"""The guard of every cycle: position, velocity, acceleration and jerk of the float32 value that is about to
be sent.

With the rows x0..x3 sent at the cycles t0 < t1 < t2 < t3, the derivatives are divided differences,

    v = (x3 - x2) / h3,   a = 2 (v - v') / (h3 + h2),   j = 3 (a - a') / (h3 + h2 + h1),

which for lost packets (h of several periods) stay within the bounds that hold on the full grid: a divided
difference over some points of a grid is a weighted mean, with weights above zero, of those over neighbouring
points.

A float32 of magnitude 2 to 4 rad is rounded by up to 1.2e-7 rad. At 1 ms that alone makes 2.4e-4 rad/s, 0.48
rad/s² and 950 rad/s³ of apparent motion, so each limit is widened by the largest amount that rounding can
account for, and by nothing else.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lwr_driver.arm import JOINTS, Limits

__all__ = ["ROUNDING", "Guard", "Violation"]

# Half the spacing of float32 numbers between 2 and 4 rad; joint positions of the arm are below 3 rad.
ROUNDING = 2.0**-23

_UNITS = {"position": "rad", "velocity": "rad/s", "acceleration": "rad/s²", "jerk": "rad/s³"}
_SLACK = 1e-9


@dataclass(frozen=True)
class Violation:
    """One limit that a row would break: joint index from 0, value and limit in SI units."""

    quantity: str
    joint: int
    value: float
    limit: float

    def describe(self, joint_names: tuple[str, ...]) -> str:
        """The message with subject, value and limit."""
        unit = _UNITS[self.quantity]
        name = joint_names[self.joint]
        return f"{name} {self.quantity} {self.value:.5g} {unit} exceeds {self.limit:.5g} {unit}"


class Guard:
    """Watches the values that are sent, cycle by cycle.

    limits : of the arm; where the controller has the arm outside the position limits already, it may rest
        there and come back, but go no further
    period_s : time of one cycle [s]
    """

    def __init__(self, limits: Limits, period_s: float) -> None:
        self._limits, self._period = limits, period_s
        self._middle = 0.5 * (limits.q_low + limits.q_high)
        self._half = 0.5 * (limits.q_high - limits.q_low)
        # Distance from the middle, velocity, acceleration, jerk.
        self._bounds = np.array([self._half, limits.v_max, limits.a_max, limits.j_max])
        self._values = np.zeros((4, JOINTS))
        self._errors = np.zeros((4, 1))
        self._errors[0] = ROUNDING
        self._excess = np.zeros((4, JOINTS))
        self.reset(np.zeros(JOINTS, dtype=np.float32))

    def reset(self, q: NDArray[np.float32], v: NDArray[np.float64] | None = None) -> None:
        """Begin at the value q that was sent in this cycle, at rest or with the velocity v [rad/s]."""
        self._q = q.astype(np.float64)
        self._v, self._a = np.zeros(JOINTS) if v is None else v, np.zeros(JOINTS)
        self._v_error = 0.0 if v is None else 2.0 * ROUNDING / self._period
        self._a_error = 0.0 if v is None else 2.0 * self._v_error / self._period
        self._h1 = self._h2 = self._period
        np.maximum(self._half, np.abs(self._q - self._middle), out=self._bounds[0])
        self._outside = bool(np.any(self._bounds[0] > self._half))

    def copy(self) -> Guard:
        """Another guard that has seen the same values."""
        twin = copy(self)
        twin._bounds = self._bounds.copy()
        return twin

    def scale_velocity(self, factor: float) -> None:
        """Shrink the velocity limit by the controller's `safety_limits`, where that is below 1."""
        self._bounds[1] = self._limits.v_max * (factor if 0.0 < factor < 1.0 else 1.0)

    def check(self, q: NDArray[np.float32], cycles: int, *, remember: bool = True) -> Violation | None:
        """Why q must not be sent `cycles` cycles after the last value, or None; then it is remembered."""
        h3 = cycles * self._period
        two, three = h3 + self._h2, h3 + self._h2 + self._h1
        x = q.astype(np.float64)
        v = (x - self._q) / h3
        a = (v - self._v) * (2.0 / two)
        values, errors = self._values, self._errors
        np.subtract(x, self._middle, out=values[0])
        values[1], values[2] = v, a
        np.multiply(a - self._a, 3.0 / three, out=values[3])
        v_error = 2.0 * ROUNDING / h3
        a_error = 2.0 * (v_error + self._v_error) / two
        errors[1], errors[2], errors[3] = v_error, a_error, 3.0 * (a_error + self._a_error) / three
        excess = np.abs(values, out=self._excess)
        excess -= self._bounds
        excess -= errors
        # Also false for values that are no numbers.
        if not excess.max() <= _SLACK:
            return self._violation(x)
        if not remember:
            return None
        if self._outside:
            # The way back is one-way.
            np.maximum(self._half, np.abs(values[0]), out=self._bounds[0])
            self._outside = bool(np.any(self._bounds[0] > self._half))
        self._q, self._v, self._a = x, v, a
        self._v_error, self._a_error = v_error, a_error
        self._h1, self._h2 = self._h2, h3
        return None

    def _violation(self, x: NDArray[np.float64]) -> Violation:
        limits = self._limits
        broken = ~(self._excess <= _SLACK)
        kind = int(np.argmax(broken.any(axis=1)))
        joint = int(np.argmax(broken[kind]))
        if kind == 0:
            edge = limits.q_low if x[joint] < self._middle[joint] else limits.q_high
            return Violation("position", joint, float(x[joint]), float(edge[joint]))
        value, bound = abs(self._values[kind, joint]), self._bounds[kind, joint]
        return Violation(tuple(_UNITS)[kind], joint, float(value), float(bound))
