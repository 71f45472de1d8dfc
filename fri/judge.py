"""The controller's judgement of a command: flags, finiteness, mirror, limits.

An objection is the kind and the text of the event at the end of command mode; nothing is ever clipped. Plain
floats are faster here than arrays of seven. NaN fails every comparison.
"""

from __future__ import annotations

from math import isfinite

import numpy as np

from fri.packets import JOINT_NAMES, JOINTS, CmdBuffer, leading
from fri.policy import KrcLimits, KrcPolicy
from fri.states import ALLOWED_FLAGS, CommandFlag, Control, EventKind

Objection = tuple[EventKind, str]

_JNTPOS = int(CommandFlag.JNTPOS)
# Only finiteness is judged here, unlike for the positions.
_OTHER_FIELDS = (
    (int(CommandFlag.JNTTRQ), "add_jnt_trq"),
    (int(CommandFlag.JNTSTIFF), "jnt_stiffness"),
    (int(CommandFlag.JNTDAMP), "jnt_damping"),
    (int(CommandFlag.CARTPOS), "cart_pos"),
    (int(CommandFlag.TCPFT), "add_tcp_ft"),
    (int(CommandFlag.CARTSTIFF), "cart_stiffness"),
    (int(CommandFlag.CARTDAMP), "cart_damping"),
)


class CommandJudge:
    """Judges commands against the limits of an arm; ``tighten`` sets period and speed factors."""

    def __init__(self, limits: KrcLimits, policy: KrcPolicy) -> None:
        self._limits = limits
        self._policy = policy
        self._q_min = (limits.q_min - policy.limit_tolerance).tolist()
        self._q_max = (limits.q_max + policy.limit_tolerance).tolist()
        self.tighten(0.001, 1.0, False)

    def tighten(self, period_s: float, safety_limits: float, t1: bool) -> None:
        """Set the period [s], the argument of friStart and whether the reduced speed of T1 applies."""
        factor = safety_limits * (self._policy.t1_velocity_factor if t1 else 1.0)
        self._period = period_s
        self._reason = f"limit factor {safety_limits:.2f}{' in T1' if t1 else ''}"
        self._steps = (self._limits.v_max * factor * period_s + self._policy.limit_tolerance).tolist()

    def flags(self, command: CmdBuffer, monitored: int | None, control: Control) -> Objection | None:
        """Flags as in monitor mode (`monitored`) and fit for the control mode; flagged fields are numbers."""
        flags = command.cmd_flags
        if monitored is not None and flags != monitored:
            return (
                EventKind.FLAGS_CHANGED,
                f"command flags changed from {monitored:#06x} to {flags:#06x} in command mode; "
                "they may change in monitor mode only",
            )
        needed = _JNTPOS if control is Control.POSITION else 0
        if flags & ~int(ALLOWED_FLAGS[control]) or flags & needed != needed:
            return EventKind.WRONG_FLAGS, f"command flags {flags:#06x} do not fit control {control.name}"
        if flags & ~_JNTPOS:
            for flag, name in _OTHER_FIELDS:
                if flags & flag and not np.isfinite(command.record[name]).all():
                    return EventKind.NOT_FINITE, f"command field {name} is not finite"
        return None

    def position(self, q: list[float], what: str) -> Objection | None:
        """All positions numbers and inside their limits."""
        low, high = self._q_min, self._q_max
        for joint in range(JOINTS):
            if low[joint] <= q[joint] <= high[joint]:
                continue
            name = JOINT_NAMES[joint]
            if not isfinite(q[joint]):
                return EventKind.NOT_FINITE, f"{name} {what} position is {q[joint]}"
            return (
                EventKind.POSITION,
                f"{name} {what} position {q[joint]:.5f} rad is outside "
                f"{self._limits.q_min[joint]:.5f}..{self._limits.q_max[joint]:.5f} rad",
            )
        return None

    def springs(self, command: CmdBuffer) -> Objection | None:
        """Flagged stiffness and damping of the joints within the bounds of the policy."""
        fields = (
            (CommandFlag.JNTSTIFF, "jnt_stiffness", "stiffness", self._policy.largest_stiffness, " Nm/rad"),
            (CommandFlag.JNTDAMP, "jnt_damping", "damping", self._policy.largest_damping, ""),
        )
        for flag, field, what, largest, unit in fields:
            values = command.record[field]
            if command.cmd_flags & flag and not (
                values.min() >= 0.0 and values.max() <= largest * (1.0 + 1e-6)
            ):
                joint = int(np.argmax(np.abs(values - 0.5 * largest)))
                return (
                    EventKind.IMPEDANCE,
                    f"{JOINT_NAMES[joint]} commanded {what} {values[joint]:g}{unit} is outside 0 to {largest:g}{unit}",
                )
        return None

    def mirror(
        self, command: CmdBuffer, target: np.ndarray, what: str, *, soft: bool = False
    ) -> Objection | None:
        """The commanded position equal to the total setpoint, within the tolerance; `soft` for a spring."""
        policy = self._policy
        tolerance = max(policy.mirror_tolerance, policy.mirror_speed * self._period)
        tolerance = policy.soft_mirror_tolerance if soft else tolerance
        q = command.jnt_pos.tolist()
        for joint, now in enumerate(target.tolist()):
            distance = abs(q[joint] - now)
            if distance <= tolerance:
                continue
            name = JOINT_NAMES[joint]
            if not isfinite(distance):
                return EventKind.NOT_FINITE, f"{name} commanded position is {q[joint]}"
            return (
                EventKind.NOT_MIRRORED,
                f"FRI interpolation error: {name} of {what} is {distance:.5f} rad from the mirror, "
                f"at most {tolerance:g} rad",
            )
        return None

    def velocity(self, command: CmdBuffer, target: np.ndarray) -> Objection | None:
        """The step from `target`, the present setpoint, to the commanded position within the speed limits."""
        q = command.jnt_pos.tolist()
        steps = self._steps
        for joint, now in enumerate(target.tolist()):
            step = q[joint] - now
            if not -steps[joint] <= step <= steps[joint]:
                return (
                    EventKind.VELOCITY,
                    f"excessive commanded joint speed: {JOINT_NAMES[joint]} {abs(step) / self._period:.4f} "
                    f"rad/s exceeds {steps[joint] / self._period:.4f} rad/s ({self._reason})",
                )
        return None

    def pass_rows(self, q: np.ndarray, target: np.ndarray) -> int:
        """How many leading rows of q (n, 7) pass ``position`` and ``velocity``, one commanded after the other.

        target : (7,) setpoint before the first row
        """
        step = q - np.concatenate([target[np.newaxis], q[:-1]])
        # Also false for NaN.
        good = (self._q_min <= q) & (q <= self._q_max)
        good &= (-np.array(self._steps) <= step) & (step <= self._steps)
        return leading(good)

    def acceleration(self, change: np.ndarray, cycles: float) -> Objection | None:
        """The `change` (7,) [rad] of the step between two commands `cycles` apart within the limits.

        No objection without an `acceleration_factor` of the policy.
        """
        factor = self._policy.acceleration_factor
        if factor is None:
            return None
        tolerance = 2.0 * self._policy.limit_tolerance
        allowed = self._limits.a_max * factor * self._period**2 * cycles + tolerance
        excess = np.abs(change) / allowed
        joint = int(excess.argmax())
        if excess[joint] <= 1.0:
            return None
        scale = 1.0 / (self._period**2 * cycles)
        return (
            EventKind.ACCELERATION,
            f"{JOINT_NAMES[joint]} commanded acceleration {abs(change[joint]) * scale:.2f} rad/s^2 exceeds "
            f"{allowed[joint] * scale:.2f} rad/s^2",
        )
