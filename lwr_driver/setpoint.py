"""The controller's set point over the last packets, and its step from cycle to cycle."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lwr_driver.arm import JOINTS, ArmLimits

_STILL_RAD = 1e-5  # largest step per cycle of a set point at rest


class SetpointHistory:
    """Set points of the last three packets.

    past : newest first, each (7,) float32 [rad] with the number of cycles since the one before
    """

    def __init__(self, limits: ArmLimits) -> None:
        self._limits = limits
        self._period, self._fastest = 0.0, limits.v_max
        unknown = np.full(JOINTS, np.nan, dtype=np.float32)
        self.past: list[tuple[NDArray[np.float32], int]] = [(unknown, 1)] * 3

    def set_period(self, period_s: float) -> None:
        """Take the controller's sample time [s]."""
        self._period, self._fastest = period_s, self._limits.v_max * period_s

    def add(self, setpoint: NDArray[np.float32], cycles: int) -> None:
        """The set point (7,) [rad] of a packet that came `cycles` after the one before."""
        past = self.past
        past[2], past[1], past[0] = past[1], past[0], (setpoint, cycles)

    def add_packets(self, packets: NDArray[Any]) -> None:
        """The set points of `packets`, (n,) of `MSR`, each a cycle after the one before."""
        setpoints = (packets["cmd_jnt_pos"] + packets["cmd_jnt_pos_fri_offset"])[-3:]
        self.past = [*((setpoint.copy(), 1) for setpoint in setpoints[::-1]), *self.past][:3]

    def step(self) -> NDArray[np.float64] | None:
        """Step per cycle (7,) [rad], zero at rest; None if unknown.

        It is unknown at the first two packets, and if one of the last may be damaged: the steps must agree
        within the acceleration limits.
        """
        (now, cycles), (before, cycles_before), (first, _) = self.past
        step = (now - before).astype(np.float64) / cycles
        if float(np.abs(step).max()) <= _STILL_RAD:
            return np.zeros(JOINTS)
        change = np.abs(step - (before - first) / cycles_before)
        room = self._limits.a_max * self._period**2 * (cycles + cycles_before) / 2.0 + _STILL_RAD
        # Also false for NaN.
        return step if np.all(change <= room) and np.all(np.abs(step) <= self._fastest) else None
