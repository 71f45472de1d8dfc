"""The command monitor: every position command in command mode, as float32, against the arm's limits.

Velocity, acceleration and jerk are divided differences over the cycles with commands. A missing command does
not count against the sender: by the mean value theorem a motion within limits stays within them. The largest
effect of float32 rounding is subtracted before a value is compared with its limit.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from lwr_driver.arm import Arm

QUANTITIES = ("position", "velocity", "acceleration", "jerk")


@njit(cache=True)
def _judge(command, time_s, times, values, middle, limits, worst, ratio, violations):  # type: ignore[no-untyped-def]
    """Number of violations of `command` (n,) at `time_s` after the last `values` (4, n) at `times` (4,) [s].

    middle : (n,) of the position range. limits : (4, n) half the range, velocity, acceleration, jerk
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
        scale = 1.0
        for order in range(4):
            scale *= max(order, 1)
            end = order - 1 if order > 0 else 3
            for k in range(3, end, -1):
                span = times[k] - times[k - order]
                difference[k] = (difference[k] - difference[k - 1]) / span
                rounding[k] = (rounding[k] + rounding[k - 1]) / span
            value = scale * difference[3]
            size = abs(value - middle[i]) if order == 0 else abs(value)
            if not np.isfinite(value):
                ratio[order, i] = np.inf
                violations[order, i] += 1
                count += 1
                continue
            if abs(value) > abs(worst[order, i]):
                worst[order, i] = value
            share = max(0.0, size - scale * rounding[3]) / limits[order, i]
            ratio[order, i] = max(ratio[order, i], share)
            if share > 1.0 + 1e-9:
                violations[order, i] += 1
                count += 1
    return count


@njit(cache=True)
def _judge_rows(commands, cycle, period_s, times, values, middle, limits, worst, ratio, violations):  # type: ignore[no-untyped-def]
    """`_judge` for commands of successive cycles, up to the first with a violation; how many, and whether one has."""
    for k in range(commands.shape[0]):
        if _judge(
            commands[k], (cycle + k) * period_s, times, values, middle, limits, worst, ratio, violations
        ):
            return k + 1, True
    return commands.shape[0], False


class CommandMonitor:
    """Worst values per joint since the last `reset`.

    ratio : (4, 7) worst value beyond rounding divided by its limit, rows as in `QUANTITIES`
    worst : (4, 7) the worst values themselves, sign kept. violations : (4, 7) counts
    """

    def __init__(self, arm: Arm, period_s: float) -> None:
        q_min, q_max = np.array(arm.q_min, dtype=float), np.array(arm.q_max, dtype=float)
        self._middle = 0.5 * (q_min + q_max)
        self._limits = np.array([0.5 * (q_max - q_min), arm.v_max, arm.a_max, arm.j_max], dtype=float)
        self.joint_names = arm.joint_names
        self.period_s = period_s
        joints = self._middle.size
        self.worst = np.zeros((4, joints))
        self.ratio = np.zeros((4, joints))
        self.violations = np.zeros((4, joints), dtype=np.int64)
        self.reset()
        self._values = np.zeros((4, joints))
        self._times = np.zeros(4)
        self._begun = False

    def reset(self) -> None:
        """Forget the extremes; a motion under way goes on being judged."""
        self.worst[:] = 0.0
        self.ratio[:] = 0.0
        self.violations[:] = 0
        self.commands = 0
        self.first_violation: str | None = None

    def rest(self, position: np.ndarray, cycle: int) -> None:
        """Command mode begins at `cycle` from the setpoint `position` (7,), at rest."""
        self._values[:] = np.float32(position)
        self._times[:] = (np.arange(-3, 1) + cycle) * self.period_s
        self._begun = True

    def take(self, command: np.ndarray, cycle: int) -> None:
        """Judge the command (7,) float32 of `cycle`; of two in one cycle the later counts."""
        if not self._begun:
            self.rest(command, cycle - 1)
        self.commands += 1
        broken = _judge(
            command,
            cycle * self.period_s,
            self._times,
            self._values,
            self._middle,
            self._limits,
            self.worst,
            self.ratio,
            self.violations,
        )
        if broken and self.first_violation is None:
            self.first_violation = self._describe(cycle)

    def take_rows(self, commands: np.ndarray, cycle: int) -> None:
        """As `take` for commands (m, 7) float32 of the cycles from `cycle` on, if one was taken before."""
        done = 0
        while done < len(commands):
            some = commands[done:]
            count, broken = _judge_rows(
                some,
                cycle + done,
                self.period_s,
                self._times,
                self._values,
                self._middle,
                self._limits,
                self.worst,
                self.ratio,
                self.violations,
            )
            done += count
            if broken and self.first_violation is None:
                self.first_violation = self._describe(cycle + done - 1)
        self.commands += len(commands)

    def _describe(self, cycle: int) -> str:
        row, joint = (int(i) for i in np.unravel_index(np.argmax(self.ratio), self.ratio.shape))
        return (
            f"{self.joint_names[joint]} {QUANTITIES[row]} {self.worst[row, joint]:.6g} is "
            f"{self.ratio[row, joint]:.4g} of its limit in cycle {cycle}"
        )

    def summary(self) -> dict[str, Any]:
        """For the status reply: per quantity the worst values (7,), their ratios to the limits, and counts."""
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
