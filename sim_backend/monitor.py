"""The command monitor: every position command that arrived in command mode, as float32, against the arm's
limits.

Velocity, acceleration and jerk are divided differences over the cycles in which commands arrived, so a
missing one does not count against the sender: by the mean value theorem a motion within limits stays within
them. What float32 rounding alone can produce is subtracted before a value is compared with its limit.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from lwr_driver.arm import Arm

__all__ = ["QUANTITIES", "CommandMonitor"]

QUANTITIES = ("position", "velocity", "acceleration", "jerk")


@njit(cache=True)
def _judge(
    command: np.ndarray,
    time_s: float,
    times: np.ndarray,
    values: np.ndarray,
    q_min: np.ndarray,
    q_max: np.ndarray,
    limits: np.ndarray,
    worst: np.ndarray,
    ratio: np.ndarray,
    violations: np.ndarray,
) -> int:
    """Take in `command` (n,) at `time_s` after the last four `values` (4, n) at `times` (4,) [s]; counts
    violations.
    """
    n = values.shape[1]
    if time_s > times[3]:
        for k in range(3):
            times[k] = times[k + 1]
            for i in range(n):
                values[k, i] = values[k + 1, i]
        times[3] = time_s
    for i in range(n):
        values[3, i] = command[i]
    count = 0
    difference = np.empty(4)
    rounding = np.empty(4)
    for i in range(n):
        for k in range(4):
            difference[k] = values[k, i]
            # Half a unit in the last place of float32, with the exponent of the value.
            rounding[k] = 2.0**-25 * 2.0 ** np.ceil(np.log2(max(abs(values[k, i]), 1e-30)))
        middle = 0.5 * (q_min[i] + q_max[i])
        half = 0.5 * (q_max[i] - q_min[i])
        count += _keep(
            0, i, values[3, i], abs(values[3, i] - middle) - rounding[3], half, worst, ratio, violations
        )
        scale = 1.0
        for order in range(1, 4):
            scale *= order
            for k in range(3, order - 1, -1):
                span = times[k] - times[k - order]
                difference[k] = (difference[k] - difference[k - 1]) / span
                rounding[k] = (rounding[k] + rounding[k - 1]) / span
            value = scale * difference[3]
            count += _keep(
                order,
                i,
                value,
                abs(value) - scale * rounding[3],
                limits[order - 1, i],
                worst,
                ratio,
                violations,
            )
    return count


@njit(cache=True)
def _keep(
    row: int,
    i: int,
    value: float,
    certain: float,
    limit: float,
    worst: np.ndarray,
    ratio: np.ndarray,
    violations: np.ndarray,
) -> int:
    if not np.isfinite(value):
        ratio[row, i] = np.inf
        violations[row, i] += 1
        return 1
    if abs(value) > abs(worst[row, i]):
        worst[row, i] = value
    share = max(0.0, certain) / limit
    ratio[row, i] = max(ratio[row, i], share)
    if share > 1.0 + 1e-9:
        violations[row, i] += 1
        return 1
    return 0


class CommandMonitor:
    """Worst values per joint since the last `reset`.

    ratio : (4, 7) worst value beyond rounding as a share of its limit, rows as in `QUANTITIES`; above 1 is
    outside
    worst : (4, 7) the worst values themselves, sign kept. violations : (4, 7) counts
    """

    def __init__(self, arm: Arm, period_s: float) -> None:
        self._q_min = np.ascontiguousarray(arm.q_min, dtype=float)
        self._q_max = np.ascontiguousarray(arm.q_max, dtype=float)
        self._limits = np.array([arm.v_max, arm.a_max, arm.j_max], dtype=float)
        self.joint_names = arm.joint_names
        self.period_s = period_s
        joints = self._q_min.size
        self.worst = np.zeros((4, joints))
        self.ratio = np.zeros((4, joints))
        self.violations = np.zeros((4, joints), dtype=np.int64)
        self.commands = 0
        self.first_violation: str | None = None
        self._values = np.zeros((4, joints))
        self._times = np.zeros(4)
        self._begun = False

    def reset(self) -> None:
        """Forget the extremes; a motion under way goes on being judged."""
        self.worst[:] = 0.0
        self.ratio[:] = 0.0
        self.violations[:] = 0
        self.commands = 0
        self.first_violation = None

    def rest(self, position: np.ndarray, cycle: int) -> None:
        """Command mode begins at `cycle` from the setpoint `position` (7,), at rest."""
        self._values[:] = np.float32(position)
        self._times[:] = (np.arange(-3, 1) + cycle) * self.period_s
        self._begun = True

    def take(self, command: np.ndarray, cycle: int) -> None:
        """The command (7,) float32 that arrived in `cycle`. Of two in one cycle the later counts."""
        if not self._begun:
            self.rest(command, cycle - 1)
        self.commands += 1
        broken = _judge(
            command,
            cycle * self.period_s,
            self._times,
            self._values,
            self._q_min,
            self._q_max,
            self._limits,
            self.worst,
            self.ratio,
            self.violations,
        )
        if broken and self.first_violation is None:
            self.first_violation = self._describe(cycle)

    def _describe(self, cycle: int) -> str:
        row, joint = (int(i) for i in np.unravel_index(np.argmax(self.ratio), self.ratio.shape))
        return (
            f"{self.joint_names[joint]} {QUANTITIES[row]} {self.worst[row, joint]:.6g} is "
            f"{self.ratio[row, joint]:.4g} of its limit in cycle {cycle}"
        )

    def summary(self) -> dict[str, Any]:
        """For the status reply: per quantity the worst values (7,), their shares of the limits, and the
        counts.
        """
        return {
            "commands": self.commands,
            "violations": int(self.violations.sum()),
            "first_violation": self.first_violation,
            **{
                name: {
                    "worst": self.worst[row].tolist(),
                    "ratio": self.ratio[row].tolist(),
                    "violations": self.violations[row].tolist(),
                }
                for row, name in enumerate(QUANTITIES)
            },
        }
