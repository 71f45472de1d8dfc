"""Motor torques that come late against the positions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ident.effects.effect import Column, Effect, Parameter, Setting, Shape, Simulated
from ident.effects.motion import Motion

# Time in which friction turns after a reversal, about: a reach of 0.1 mrad at 5 rad/s^2.
_TURN_S = 5e-3


class MotorTorqueDelay(Effect):
    """The motor torque is `delay` older than the positions beside it."""

    cause = "motor_torque_delay"
    side = "timing"
    physics = "the motor torques take longer through the controller than the positions"
    source = "Swevers, Verdonck and De Schutter, IEEE Control Systems Magazine 27 (2007)"
    parameters = (
        Parameter("share", "1", "share of the torque that is late", low=0.5, high=1.5),
        Parameter("delay", "s", "age of the motor torques", shape=True, low=-0.2, high=0.2),
    )
    hidden = ("share",)
    whole_arm = True
    tell_apart = "a 1 to 15 Hz chirp of one joint"

    def shapes(self, setting: Setting, joint: int) -> Sequence[Shape]:
        """From half a millisecond to forty, late and early, close enough that friction's turns overlap."""
        grid = (0.001, 0.002, 0.004, 0.007, 0.011, 0.015, 0.021, 0.03)
        return [{"delay": sign * d} for d in grid for sign in (1.0, -1.0)]

    def columns(self, motion: Motion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """Predicted torque of before less that of now, in all motor rows.

        Coulomb friction is in it where the delay is longer than it takes to turn after a reversal. A shorter delay
        and another length of presliding look alike there.
        """
        before = motion.time - shape["delay"]
        torque = motion.motor_torque if abs(shape["delay"]) > _TURN_S else motion.smooth_torque("motor")
        late = np.column_stack([np.interp(before, motion.time, column) for column in torque.T])
        return (Column(motor=late - torque),)

    def simulate(self, joint: int, parameters: Mapping[str, float]) -> Simulated:
        """Reports old motor torques."""
        return _Late(float(parameters["delay"]))


class _Late(Simulated):
    def __init__(self, delay: float) -> None:
        self.cycles = max(0, round(1e3 * delay))
        self.past: list[Any] = []

    def sense_motor(self, time_s: float, plant: Any, reading: Any) -> None:
        self.past.append(reading.motor_torque.copy())
        if len(self.past) > self.cycles + 1:
            self.past.pop(0)
        reading.motor_torque[:] = self.past[0]
