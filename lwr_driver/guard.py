"""The guard of every cycle, and the jerk-limited stop.

The guard checks position, velocity, acceleration and jerk of the float32 value about to be sent. With the
rows x0..x3 sent at the cycles t0 < t1 < t2 < t3, the derivatives are divided differences,

    v = (x3 - x2) / h3,   a = 2 (v - v') / (h3 + h2),   j = 3 (a - a') / (h3 + h2 + h1).

After lost packets (h of several periods) they keep the bounds of the full grid: a divided difference over
some points of a grid is a mean, with positive weights, of those over neighbouring points.

A float32 of magnitude 2 to 4 rad is rounded by up to 1.2e-7 rad. At 1 ms that alone makes 2.4e-4 rad/s,
0.48 rad/s² and 950 rad/s³ of apparent motion. Each limit is widened by the largest such rounding, and by
nothing else.

The stop is exact in discrete time. From the last three commanded rows follow the discrete velocity
v0 = (q0 - q1)/T and acceleration a0 = (q0 - 2 q1 + q2)/T². Ruckig's velocity interface brings (v0, a0) to
rest in the shortest time with |a| <= A and |j| <= J (Berscheid and Kroeger 2021), each joint by itself. The
rows are q(k) = q(k-1) + T v(kT). Then

- first differences are v(kT), and second differences (v(kT) - v(kT - T))/T are means of a, so at most A;
- third differences are at most J: within the profile as second differences of v, and across the beginning
  because v(T) - v0 - T a0 is at most J T²/2. This leaves room to begin the profile at a0 + d with
  |d| <= J T/2, half a period of jerk earlier; without it a stop at the peak of an acceleration would
  overshoot by a0 T/2.

So the stop keeps the limits in the discrete sense of guard and controller. The distance of a stop has a
closed form, used to check a motion beforehand: wherever it is stopped, the arm stays inside its position
limits.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from copy import copy
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from ruckig import ControlInterface, InputParameter, Ruckig, Synchronization, Trajectory

from fri.packets import leading
from lwr_driver.arm import JOINTS, ArmLimits

# Half the spacing of float32 numbers between 2 and 4 rad; joint positions of the arm are below 3 rad.
ROUNDING = 2.0**-23

RETREAT_SPEED = 0.25
"""Of a joint on the way back from a contact [rad/s]; some 0.2 m/s at the flange."""

_UNITS = {"position": "rad", "velocity": "rad/s", "acceleration": "rad/s²", "jerk": "rad/s³"}
_SLACK = 1e-9

Rows = NDArray[np.float64]


@dataclass(frozen=True)
class Violation:
    """One limit broken by a row: joint index from 0, value and limit in SI units."""

    quantity: str
    joint: int
    value: float
    limit: float

    def describe(self, joint_names: tuple[str, ...]) -> str:
        """The message with subject, value and limit."""
        unit = _UNITS[self.quantity]
        name = joint_names[self.joint]
        return f"{name} {self.quantity} {self.value:.5g} {unit} exceeds {self.limit:.5g} {unit}"


def sound_factor(factor: float) -> bool:
    """Whether the controller's `safety_limits` can be a share of the limits."""
    return math.isfinite(factor) and factor > 0.0


class Guard:
    """Checks the values to be sent, cycle by cycle.

    limits : of the arm; an arm already outside the position limits may rest there and come back, but go no
        further
    period_s : time of one cycle [s]
    """

    def __init__(self, limits: ArmLimits, period_s: float) -> None:
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
        """Begin at the value q sent in this cycle, at rest or with the velocity v [rad/s]."""
        self._q = q.astype(np.float64)
        self._v, self._a = np.zeros(JOINTS) if v is None else v, np.zeros(JOINTS)
        self._v_error = 0.0 if v is None else 2.0 * ROUNDING / self._period
        self._a_error = 0.0 if v is None else 2.0 * self._v_error / self._period
        self._h1 = self._h2 = self._period
        np.maximum(self._half, np.abs(self._q - self._middle), out=self._bounds[0])
        self._outside = bool(np.any(self._bounds[0] > self._half))

    def copy(self) -> Guard:
        """Another guard in the same state."""
        twin = copy(self)
        twin._bounds = self._bounds.copy()
        return twin

    def scale_velocity(self, factor: float) -> None:
        """Reduce the velocity limit by the controller's `safety_limits` below 1.

        No controller gives a factor of zero or less, or none that is finite: nothing may move with it.
        """
        self._bounds[1] = self._limits.v_max * (min(factor, 1.0) if sound_factor(factor) else 0.0)

    def check(self, q: NDArray[np.float32], cycles: int, *, remember: bool = True) -> Violation | None:
        """The limit broken by sending q `cycles` cycles after the last value, or None; then q is remembered."""
        h3 = cycles * self._period
        two, three = h3 + self._h2, h3 + self._h2 + self._h1
        x = q.astype(np.float64)
        values, errors = self._values, self._errors
        np.subtract(x, self._middle, out=values[0])
        v, a, j = self._derivatives(x, h3, two, three, _last)
        values[1], values[2], values[3] = v, a, j
        v_error, a_error, j_error = self._roundings(h3, two, three)
        errors[1], errors[2], errors[3] = v_error, a_error, j_error
        excess = np.abs(values, out=self._excess)
        excess -= self._bounds
        excess -= errors
        # Also false for NaN.
        if not np.maximum.reduce(excess, axis=None) <= _SLACK:
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

    def check_rows(self, q: NDArray[np.float32]) -> int:
        """How many leading rows of q (n, 7), each sent one cycle after the row before it, pass `check`.

        Nothing is remembered, see `remember_rows`. 0 as well while something of the values before is still special:
        a gap between them, a beginning, or an arm outside the position limits.
        """
        spans = self._period, self._period + self._h2, self._period + self._h2 + self._h1
        v_error, a_error, j_error = self._roundings(*spans)
        regular = self._h1 == self._h2 == self._period
        if not regular or self._outside or (v_error, a_error) != (self._v_error, self._a_error):
            return 0
        x = q.astype(np.float64)
        v, a, j = self._derivatives(x, *spans, _before)
        excess = np.abs(np.stack([x - self._middle, v, a, j], axis=1))
        excess -= self._bounds
        excess -= np.array([[ROUNDING], [v_error], [a_error], [j_error]])
        # Also false for NaN.
        return leading(excess <= _SLACK)

    def remember_rows(self, q: NDArray[np.float32]) -> None:
        """Rows of q (n, 7) that have passed `check_rows` are sent."""
        x = q.astype(np.float64)
        spans = self._period, self._period + self._h2, self._period + self._h2 + self._h1
        v, a, _ = self._derivatives(x, *spans, _before)
        self._q, self._v, self._a = x[-1], v[-1], a[-1]

    def _derivatives(
        self, x: Rows, h3: float, two: float, three: float, before: Callable[[Rows, Rows], Rows]
    ) -> tuple[Rows, Rows, Rows]:
        """Velocity, acceleration and jerk at x. before : the value before each of the values, given the last one"""
        v = (x - before(self._q, x)) / h3
        a = (v - before(self._v, v)) * (2.0 / two)
        return v, a, (a - before(self._a, a)) * (3.0 / three)

    def _roundings(self, h3: float, two: float, three: float) -> tuple[float, float, float]:
        """Largest effects of rounding on velocity, acceleration and jerk."""
        v_error = 2.0 * ROUNDING / h3
        a_error = 2.0 * (v_error + self._v_error) / two
        return v_error, a_error, 3.0 * (a_error + self._a_error) / three

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


def _last(last: Rows, rows: Rows) -> Rows:
    """For a single value: the last one."""
    return last


def _before(last: Rows, rows: Rows) -> Rows:
    """For rows (n, 7): the row before each."""
    return np.concatenate([last[np.newaxis], rows[:-1]])


class Stop:
    """Plans and executes jerk-limited stops, one at a time; all memory is allocated on construction.

    limits : acceleration and jerk of the stop; period_s : time of one cycle [s]
    """

    def __init__(self, limits: ArmLimits, period_s: float) -> None:
        self._period, self._limits = period_s, limits
        self._otg = Ruckig(JOINTS, period_s)
        self._trajectory = Trajectory(JOINTS)
        start = InputParameter(JOINTS)
        start.control_interface = ControlInterface.Velocity
        start.synchronization = Synchronization.No
        start.current_position = [0.0] * JOINTS
        start.target_velocity = [0.0] * JOINTS
        start.target_acceleration = [0.0] * JOINTS
        start.max_velocity = limits.v_max.tolist()
        start.max_acceleration = limits.a_max.tolist()
        start.max_jerk = limits.j_max.tolist()
        self._start = start
        self._q = np.zeros(JOINTS)
        self._cycle = 0
        self._cycles = 0

    def begin(self, q0: Rows, q1: Rows, q2: Rows) -> None:
        """Plan the stop from the rows commanded now, one and two cycles ago, each (7,) [rad].

        Raises ValueError if no stop can be computed (rows not finite).
        """
        velocity = (q0 - q1) / self._period
        acceleration = (q0 - 2.0 * q1 + q2) / self._period**2
        if not (np.all(np.isfinite(velocity)) and np.all(np.isfinite(acceleration))):
            raise ValueError("the last commanded rows are not finite")
        acceleration = _let_go(self._limits, self._period, velocity, acceleration)
        self._start.current_velocity = velocity.tolist()
        self._start.current_acceleration = acceleration.tolist()
        try:
            result = self._otg.calculate(self._start, self._trajectory)
        except RuntimeError as error:
            raise ValueError(f"no stop from {velocity} rad/s, {acceleration} rad/s²: {error}") from error
        if int(result) < 0:
            raise ValueError(f"no stop from {velocity} rad/s, {acceleration} rad/s²: {result}")
        self._q = q0.astype(np.float64)
        self._cycle = 0
        self._cycles = int(np.ceil(self._trajectory.duration / self._period - 1e-9))

    def advance(self, cycles: int) -> Rows:
        """Row `cycles` cycles further on, (7,) [rad]."""
        for _ in range(min(cycles, self._cycles - self._cycle)):
            self._cycle += 1
            velocity = self._trajectory.at_time(self._cycle * self._period)[1]
            self._q = self._q + self._period * np.array(velocity)
        return self._q

    @property
    def finished(self) -> bool:
        """Whether the commanded position rests."""
        return self._cycle >= self._cycles


class Retreat:
    """A straight jerk-limited move in joint space from rest to rest, slow, for the way back from a contact.

    limits : of velocity, acceleration and jerk; period_s : time of one cycle [s]

    way : from the beginning to the end (7,) [rad]
    """

    def __init__(self, limits: ArmLimits, period_s: float) -> None:
        self._period = period_s
        self._otg = Ruckig(JOINTS, period_s)
        self._trajectory = Trajectory(JOINTS)
        move = InputParameter(JOINTS)
        move.synchronization = Synchronization.Phase
        move.max_velocity = np.minimum(limits.v_max, RETREAT_SPEED).tolist()
        move.max_acceleration = limits.a_max.tolist()
        move.max_jerk = limits.j_max.tolist()
        self._move = move
        self.way = np.zeros(JOINTS)
        self._cycle = self._cycles = 0

    def begin(self, start: Rows, goal: Rows) -> None:
        """Plan the way from `start` to `goal`, (7,) [rad]; without a way nothing begins."""
        self._move.current_position = start.tolist()
        self._move.target_position = goal.tolist()
        self.way = goal - start
        self._cycle = self._cycles = 0
        if int(self._otg.calculate(self._move, self._trajectory)) >= 0:
            self._cycles = int(np.ceil(self._trajectory.duration / self._period - 1e-9))

    def advance(self, cycles: int) -> Rows:
        """Row `cycles` cycles further on, (7,) [rad]."""
        self._cycle = min(self._cycle + cycles, self._cycles)
        return self.row(0)

    def row(self, back: int) -> Rows:
        """Row `back` cycles ago, (7,) [rad]."""
        return np.array(self._trajectory.at_time(max(self._cycle - back, 0) * self._period)[0])

    def end(self) -> None:
        """Give the way up or close it."""
        self._cycle = self._cycles = 0

    @property
    def under_way(self) -> bool:
        """Whether a way has begun and not been closed."""
        return self._cycles > 0

    @property
    def arrived(self) -> bool:
        """Whether the goal has been commanded."""
        return self._cycle >= self._cycles


def stop_extent(limits: ArmLimits, period_s: float, q: Rows) -> tuple[Rows, Rows, Rows]:
    """Lowest and highest position and highest speed of a stop begun at any row of q.

    q : (n, 7) [rad]; rows before the first equal the first

    Returns three (n, 7): lowest position [rad], highest position [rad], highest speed [rad/s]. The positions
    are bounds, too wide by about one period at the highest speed at most.
    """
    braking, j_max = _Braking.of(limits, period_s, q, np.arange(len(q))), limits.j_max
    sign, v, a, peak = braking.sign, braking.v, braking.a, braking.peak
    t1, t2, t3, v1, v2 = braking.t1, braking.t2, braking.t3, braking.v1, braking.v2
    x1 = v * t1 + 0.5 * a * t1**2 - j_max * t1**3 / 6.0
    x2 = x1 + v1 * t2 - 0.5 * peak * t2**2
    end = x2 + v2 * t3 - 0.5 * peak * t3**2 + j_max * t3**3 / 6.0
    # A negative initial velocity changes sign once, in the first phase.
    root = (a - np.sqrt(np.maximum(a**2 + 2.0 * j_max * v, 0.0))) / j_max
    turn = np.where(v < 0.0, np.clip(root, 0.0, t1), 0.0)
    back = v * turn + 0.5 * a * turn**2 - j_max * turn**3 / 6.0
    peak_speed = np.where(a > 0.0, v + a**2 / (2.0 * j_max), v)
    # T times the sum of v(kT) exceeds the integral only while v rises, by the height of the rise at most.
    above = np.maximum(np.maximum(end, back), 0.0) + period_s * (peak_speed - v)
    below = np.minimum(np.minimum(end, back), 0.0)
    lowest = q + np.where(sign > 0.0, below, -above)
    highest = q + np.where(sign > 0.0, above, -below)
    return lowest, highest, np.maximum(np.abs(v), peak_speed)


def stop_paths(limits: ArmLimits, period_s: float, q: Rows, rows: NDArray[np.intp], every: int = 1) -> Rows:
    """The rows that `Stop` commands when it begins at `rows` (m,) of q, all at once.

    q : (n, 7) [rad]; rows before the first equal the first. every : only each so many rows of a stop

    Returns (m, k, 7) [rad]: entry 0 is the row of q itself, the last one is at rest.
    """
    braking = _Braking.of(limits, period_s, q, rows)
    cycles = int(np.ceil(np.max(braking.duration, initial=0.0) / period_s - 1e-9))
    cycles = every * math.ceil(cycles / every)
    times = np.asarray(period_s * np.arange(1, cycles + 1), dtype=np.float64)
    way = period_s * np.cumsum(braking.velocity(times), axis=1)
    start = q[rows][:, np.newaxis].astype(np.float64)
    return np.concatenate([start, start + way[:, every - 1 :: every]], axis=1)


@dataclass(frozen=True)
class _Braking:
    """Shortest stops in closed form, of every joint by itself; arrays (n, 7), and limits of jerk j_max (7,).

    Each is mirrored by its sign so that the velocity is positive after a is brought to zero at full jerk. Then the
    stop has three phases, t1, t2, t3 [s] long: jerk downwards, acceleration at -peak, jerk back to zero. v1 and v2 are
    the velocities at their borders.
    """

    sign: Rows
    v: Rows
    a: Rows
    peak: Rows
    t1: Rows
    t2: Rows
    t3: Rows
    v1: Rows
    v2: Rows
    j_max: Rows

    @classmethod
    def of(cls, limits: ArmLimits, period_s: float, q: Rows, rows: NDArray[np.intp]) -> _Braking:
        """Stops begun at `rows` of q (n, 7) [rad]; rows before the first equal the first."""
        q0, q1, q2 = (q[np.maximum(rows - back, 0)] for back in range(3))
        v = (q0 - q1) / period_s
        a = (q0 - 2.0 * q1 + q2) / period_s**2
        a_max, j_max = limits.a_max, limits.j_max
        a = _let_go(limits, period_s, v, a)
        sign = np.where(v + a * np.abs(a) / (2.0 * j_max) >= 0.0, 1.0, -1.0)
        v, a = sign * v, sign * a
        peak = np.minimum(np.sqrt(np.maximum(j_max * v + 0.5 * a**2, 0.0)), np.maximum(a_max, -a))
        t1, t3 = (a + peak) / j_max, peak / j_max
        v1 = v + a * t1 - 0.5 * j_max * t1**2
        v2 = 0.5 * peak**2 / j_max
        t2 = np.where(peak > 0.0, np.maximum(v1 - v2, 0.0) / np.where(peak > 0.0, peak, 1.0), 0.0)
        return cls(sign, v, a, peak, t1, t2, t3, v1, v2, j_max)

    @property
    def duration(self) -> Rows:
        """Time until each joint rests [s]."""
        return self.t1 + self.t2 + self.t3

    def velocity(self, times: Rows) -> Rows:
        """Velocity at `times` (k,) [s] after the beginning, (n, k, 7) [rad/s]."""
        t = times[np.newaxis, :, np.newaxis]
        v, a, peak, v1, t1, t2 = (
            part[:, np.newaxis] for part in (self.v, self.a, self.peak, self.v1, self.t1, self.t2)
        )
        left = np.maximum(self.duration[:, np.newaxis] - t, 0.0)
        first = v + a * t - 0.5 * self.j_max * t**2
        second = v1 - peak * (t - t1)
        third = 0.5 * self.j_max * left**2
        return self.sign[:, np.newaxis] * np.where(t < t1, first, np.where(t < t1 + t2, second, third))


def _let_go(limits: ArmLimits, period_s: float, v: Rows, a: Rows) -> Rows:
    """First acceleration of the profile: a, shifted by up to half a period of jerk against the motion."""
    excess = v + a * np.abs(a) / (2.0 * limits.j_max)
    half = 0.5 * period_s * limits.j_max
    moved = np.clip(a - excess / period_s, -limits.a_max, limits.a_max)
    return np.clip(moved, a - half, a + half)
