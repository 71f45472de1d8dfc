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

    limits : of the arm
    period_s : time of one cycle [s]
    """

    def __init__(self, limits: Limits, period_s: float) -> None:
        self._limits = limits
        self._period = period_s
        self._v_max = limits.v_max.copy()
        self._q, self._v, self._a = np.zeros(JOINTS), np.zeros(JOINTS), np.zeros(JOINTS)
        self._v_error = self._a_error = 0.0
        self._h1 = self._h2 = period_s

    def reset(self, q: NDArray[np.float32]) -> None:
        """Begin at rest at the value q that was sent in this cycle; position limits do not apply to it."""
        self._q = q.astype(np.float64)
        self._v, self._a = np.zeros(JOINTS), np.zeros(JOINTS)
        self._v_error = self._a_error = 0.0
        self._h1 = self._h2 = self._period

    def scale_velocity(self, factor: float) -> None:
        """Shrink the velocity limit by the controller's `safety_limits`, where that is below 1."""
        if 0.0 < factor < 1.0:
            np.multiply(self._limits.v_max, factor, out=self._v_max)
        else:
            self._v_max[:] = self._limits.v_max

    def check(self, q: NDArray[np.float32], cycles: int) -> Violation | None:
        """Why q must not be sent `cycles` cycles after the last value sent, or None; accepted values are
        remembered.
        """
        limits, h3 = self._limits, cycles * self._period
        x = q.astype(np.float64)
        if not np.all(np.isfinite(x)):
            joint = int(np.argmin(np.isfinite(x)))
            return Violation("position", joint, float(x[joint]), float(limits.q_high[joint]))
        v = (x - self._q) / h3
        v_error = 2.0 * ROUNDING / h3
        a = 2.0 * (v - self._v) / (h3 + self._h2)
        a_error = 2.0 * (v_error + self._v_error) / (h3 + self._h2)
        j = 3.0 * (a - self._a) / (h3 + self._h2 + self._h1)
        j_error = 3.0 * (a_error + self._a_error) / (h3 + self._h2 + self._h1)
        excess = np.array(
            [
                np.maximum(limits.q_low - x, x - limits.q_high) - ROUNDING,
                np.abs(v) - self._v_max - v_error,
                np.abs(a) - limits.a_max - a_error,
                np.abs(j) - limits.j_max - j_error,
            ]
        )
        if excess.max() > _SLACK:
            return self._violation(excess, x, v, a, j)
        self._q, self._v, self._a = x, v, a
        self._v_error, self._a_error = v_error, a_error
        self._h1, self._h2 = self._h2, h3
        return None

    def _violation(
        self,
        excess: NDArray[np.float64],
        x: NDArray[np.float64],
        v: NDArray[np.float64],
        a: NDArray[np.float64],
        j: NDArray[np.float64],
    ) -> Violation:
        limits = self._limits
        kind = int(np.argmax(excess.max(axis=1) > _SLACK))
        joint = int(np.argmax(excess[kind]))
        edge = limits.q_high if x[joint] > limits.q_high[joint] else limits.q_low
        values = (x, np.abs(v), np.abs(a), np.abs(j))
        bounds = (edge, self._v_max, limits.a_max, limits.j_max)
        return Violation(tuple(_UNITS)[kind], joint, float(values[kind][joint]), float(bounds[kind][joint]))
