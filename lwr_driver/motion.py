"""A motion: the joint positions to command, one row per FRI cycle, and the checks before it may run."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from ruckig import (
    ControlInterface,
    DurationDiscretization,
    InputParameter,
    Ruckig,
    Synchronization,
    Trajectory,
)

from fri.errors import ConfigurationError, RefusedError
from lwr_driver.arm import JOINTS, Arm
from lwr_driver.configuration import expect
from lwr_driver.guard import ROUNDING, stop_extent

Rows = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Motion:
    """Rows of joint positions, one per FRI cycle, sent as float32.

    q : (n, 7) float64, joint positions [rad]; row 0 is sent in the first cycle of the motion
    period_s : time between rows [s]
    phases : (first row, name) in rising order of rows; rows before the first phase have no name
    """

    q: NDArray[np.float64]
    period_s: float
    phases: tuple[tuple[int, str], ...] = ()

    def __post_init__(self) -> None:
        try:
            q = np.array(self.q, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise ConfigurationError(f"motion: q is no array of numbers ({error}); give (rows, 7)") from error
        if q.ndim != 2 or q.shape[1] != JOINTS or q.shape[0] < 1:
            raise ConfigurationError(
                f"motion of shape {q.shape}; it must be (rows, {JOINTS}) with a row at least"
            )
        if not np.all(np.isfinite(q)):
            row, joint = np.argwhere(~np.isfinite(q))[0]
            raise ConfigurationError(
                f"motion row {row}, joint {joint + 1} is {q[row, joint]}; it must be finite"
            )
        if not 1e-3 - 1e-9 <= self.period_s <= 0.1 + 1e-9:
            raise ConfigurationError(f"motion period {self.period_s} s is not within 0.001 s to 0.1 s")
        rows = [row for row, _ in self.phases]
        if rows != sorted(set(rows)) or any(not 0 <= row < len(q) for row in rows):
            raise ConfigurationError(
                f"phases begin at rows {rows}; rows must rise and lie within 0 to {len(q) - 1}"
            )
        q.flags.writeable = False
        object.__setattr__(self, "q", q)
        object.__setattr__(self, "phases", tuple((int(row), str(name)) for row, name in self.phases))

    def __len__(self) -> int:
        return len(self.q)

    @property
    def duration_s(self) -> float:
        """Time from the first row to the last [s]."""
        return (len(self.q) - 1) * self.period_s

    def join(self, other: Motion) -> Motion:
        """This motion followed at once by `other`; its first row must repeat our last row and is dropped."""
        if other.period_s != self.period_s:
            raise ConfigurationError(
                f"motions of periods {self.period_s} s and {other.period_s} s cannot be joined"
            )
        gap = float(np.max(np.abs(other.q[0] - self.q[-1])))
        if gap > 1e-9:
            raise ConfigurationError(
                f"motions are {gap:.3g} rad apart where they join; begin where the other ends"
            )
        shift = len(self.q) - 1
        later = tuple((row + shift, name) for row, name in other.phases)
        kept = tuple(item for item in self.phases if not later or item[0] < later[0][0])
        if kept and later and kept[-1][1] == later[0][1]:
            later = later[1:]
        return Motion(np.vstack([self.q, other.q[1:]]), self.period_s, kept + later)


@dataclass(frozen=True)
class Extreme:
    """The closest approach of a motion to one kind of limit, or its largest excess.

    quantity : `position`, `velocity`, `acceleration`, `jerk` of the rows as sent; `stop position`,
        `stop velocity` of a stop begun at that row
    joint : name; row, time_s : place in the motion; value, limit : in `unit`; ok : whether the limit is kept
    """

    quantity: str
    joint: str
    row: int
    time_s: float
    value: float
    limit: float
    unit: str
    ok: bool

    def __str__(self) -> str:
        verb = "is within" if self.ok else "exceeds"
        return (
            f"{self.joint} {self.quantity} {self.value:.5g} {self.unit} at t = {self.time_s:.3f} s "
            f"{verb} {self.limit:.5g} {self.unit}"
        )


def extremes(arm: Arm, motion: Motion) -> tuple[Extreme, ...]:
    """The worst moment of the motion for each kind of limit, on the float32 values as sent.

    The arm rests at the first row before the motion and at the last row after it. Derivatives are differences
    of rows; each limit is widened by the rounding to float32. A motion within the limits can be stopped at
    any row without leaving them (`lwr_driver.guard`).
    """
    limits, period = arm.limits, motion.period_s
    sent = motion.q.astype(np.float32).astype(np.float64)
    planned, rounded = _at_rest_around(motion.q), _at_rest_around(sent)
    # Rows in float32 carry their rounding already; otherwise the plan itself must keep the limits too.
    exact = not np.array_equal(sent, motion.q)
    found = [_nearest(arm, motion, "position", sent, sent, ROUNDING)]
    for order, (quantity, unit, bound) in enumerate(
        (
            ("velocity", "rad/s", limits.v_max),
            ("acceleration", "rad/s²", limits.a_max),
            ("jerk", "rad/s³", limits.j_max),
        ),
        start=1,
    ):
        planned, rounded = np.diff(planned, axis=0) / period, np.diff(rounded, axis=0) / period
        # A difference of order k adds 2^k roundings at most.
        slack = 2.0**order * ROUNDING / period**order
        ok = bool(np.all(np.abs(rounded) <= bound + slack + 1e-9))
        ok &= not exact or bool(np.all(np.abs(planned) <= bound * (1.0 + 1e-6) + 1e-9))
        # Entry i ends at row i + order of the padded rows, row i + order - 3 of the motion.
        found.append(_largest(arm, motion, quantity, unit, np.abs(planned), bound, order - 3, ok))
    lowest, highest, speed = stop_extent(limits, period, motion.q)
    found.append(_nearest(arm, motion, "stop position", lowest, highest, ROUNDING))
    ok = bool(np.all(speed <= limits.v_max + 2.0 * ROUNDING / period))
    found.append(_largest(arm, motion, "stop velocity", "rad/s", speed, limits.v_max, 0, ok))
    return tuple(found)


def check_motion(arm: Arm, motion: Motion) -> None:
    """Raise RefusedError unless the motion keeps every limit of the arm."""
    broken = [str(extreme) for extreme in extremes(arm, motion) if not extreme.ok]
    if broken:
        raise RefusedError(
            f"motion refused: {'; '.join(broken)}; slow it down or keep it away from the limits"
        )


def check_start(arm: Arm, motion: Motion, q_command: NDArray[np.float64]) -> None:
    """Raise RefusedError unless row 0, rounded to float32, is the commanded position `q_command`, (7,) [rad]."""
    gap = np.abs(motion.q[0].astype(np.float32).astype(np.float64) - q_command)
    joint = int(np.argmax(gap))
    if gap[joint] > 0.0:
        raise RefusedError(
            f"motion begins with {arm.joint_names[joint]} at {motion.q[0, joint]:.7f} rad, commanded is "
            f"{q_command[joint]:.7f} rad; plan from the commanded position of the driver's state"
        )


def move_to(
    arm: Arm,
    start: NDArray[np.float64],
    goal: NDArray[np.float64],
    period_s: float,
    *,
    speed_scale: float = 0.2,
    phase: str = "move_to_start",
) -> Motion:
    """Jerk-limited straight line in joint space, from rest to rest in the fewest whole periods.

    start, goal : (7,) [rad]
    speed_scale : share of the velocity limits, above 0 to 1; acceleration scales with its square root, jerk
        does not

    All joints keep to the line (phase synchronisation), so a check of the line covers the motion.
    Raises RefusedError if start or goal is outside the position limits.
    """
    expect(arm, Arm, "arm of a motion", "give `Arm.load()`")
    if not 0.0 < speed_scale <= 1.0:
        raise ConfigurationError(f"speed_scale {speed_scale} is not above 0 and at most 1")
    limits = arm.limits
    try:
        ends = np.array([start, goal], dtype=np.float64)
    except (TypeError, ValueError):
        ends = np.empty(0)
    if ends.shape != (2, JOINTS) or not np.all(np.isfinite(ends)):
        raise ConfigurationError(f"start and goal must be {JOINTS} finite joint positions each")
    for name, q in zip(("start", "goal"), ends, strict=True):
        outside = np.maximum(limits.q_low - q, q - limits.q_high)
        joint = int(np.argmax(outside))
        if outside[joint] > 1e-6:
            advice = "move the arm inside by hand" if name == "start" else "choose a goal inside, in rad"
            raise RefusedError(
                f"{name} of {phase}: {arm.joint_names[joint]} {q[joint]:.4f} rad is outside "
                f"{limits.q_low[joint]:.4f} to {limits.q_high[joint]:.4f} rad; {advice}"
            )
    if np.array_equal(ends[0], ends[1]):
        return Motion(ends, period_s, ((0, phase),))
    request = InputParameter(JOINTS)
    request.control_interface = ControlInterface.Position
    request.synchronization = Synchronization.Phase
    request.duration_discretization = DurationDiscretization.Discrete
    request.current_position, request.target_position = ends[0].tolist(), ends[1].tolist()
    # A little below the limits: rounding uses up the last digit, and a stop begun while accelerating towards
    # full speed exceeds it by J T²/8 (`lwr_driver.guard`).
    keep = 1.0 - 1e-6
    full = keep * limits.v_max - 0.13 * limits.j_max * period_s**2
    request.max_velocity = (speed_scale * np.maximum(full, 0.1 * limits.v_max)).tolist()
    request.max_acceleration = (keep * np.sqrt(speed_scale) * limits.a_max).tolist()
    request.max_jerk = (keep * limits.j_max).tolist()
    otg, trajectory = Ruckig(JOINTS, period_s), Trajectory(JOINTS)
    otg.validate_input(request, check_current_state_within_limits=True)
    result = int(otg.calculate(request, trajectory))
    if result < 0:
        raise RefusedError(f"no motion from {ends[0]} to {ends[1]} rad could be computed (ruckig {result})")
    rows = round(trajectory.duration / period_s)
    q = np.array([trajectory.at_time(row * period_s)[0] for row in range(rows + 1)])
    q[0], q[-1] = ends
    lowest, highest = np.minimum(*ends) - 1e-9, np.maximum(*ends) + 1e-9
    if not np.all(np.isfinite(q)) or np.any(q < lowest) or np.any(q > highest):
        raise RefusedError(f"motion from {ends[0]} to {ends[1]} rad leaves the way between its ends")
    return Motion(q, period_s, ((0, phase),))


def _at_rest_around(q: NDArray[np.float64]) -> NDArray[np.float64]:
    """The rows with three more of rest before and after them."""
    return np.vstack([q[:1], q[:1], q[:1], q, q[-1:], q[-1:], q[-1:]])


def _nearest(arm: Arm, motion: Motion, quantity: str, lowest: Rows, highest: Rows, slack: float) -> Extreme:
    """The row and joint with the least room to a position limit."""
    limits = arm.limits
    below, above = lowest - limits.q_low, limits.q_high - highest
    row, joint = _place(np.minimum(below, above).argmin(), below.shape)
    upper = above[row, joint] <= below[row, joint]
    value, limit = (highest, limits.q_high) if upper else (lowest, limits.q_low)
    ok = min(below[row, joint], above[row, joint]) >= -slack
    found = float(value[row, joint]), float(limit[joint]), "rad", bool(ok)
    return Extreme(quantity, arm.joint_names[joint], row, row * motion.period_s, *found)


def _largest(
    arm: Arm, motion: Motion, quantity: str, unit: str, value: Rows, limit: Rows, shift: int, ok: bool
) -> Extreme:
    """The row and joint with the largest share of a limit; entry i of `value` belongs to row i + shift."""
    index, joint = _place((value / limit).argmax(), value.shape)
    row = min(max(index + shift, 0), len(motion) - 1)
    found = float(value[index, joint]), float(limit[joint]), unit, ok
    return Extreme(quantity, arm.joint_names[joint], row, row * motion.period_s, *found)


def _place(flat: np.intp, shape: tuple[int, ...]) -> tuple[int, int]:
    row, joint = np.unravel_index(flat, shape)
    return int(row), int(joint)
