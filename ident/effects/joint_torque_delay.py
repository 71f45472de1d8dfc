"""Joint torques that come late against the positions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ident.effects.effect import Column, Effect, Parameter, Setting, Shape, Simulated
from ident.effects.motion import Motion


class JointTorqueDelay(Effect):
    """The joint torque is `delay` older than the positions beside it."""

    cause = "joint_torque_delay"
    side = "timing"
    physics = "the joint torques take longer through the controller than the positions"
    source = "Swevers, Verdonck and De Schutter, IEEE Control Systems Magazine 27 (2007)"
    parameters = (
        Parameter("share", "1", "share of the torque that is late", low=0.5, high=1.5),
        Parameter("delay", "s", "age of the joint torques", shape=True, low=-0.2, high=0.2),
    )
    hidden = ("share",)
    whole_arm = True
    tell_apart = "a 1 to 15 Hz chirp of one joint"

    def shapes(self, setting: Setting, joint: int) -> Sequence[Shape]:
        """From half a millisecond to forty, late and early."""
        return [
            {"delay": sign * d} for d in (0.001, 0.002, 0.004, 0.008, 0.016, 0.032) for sign in (1.0, -1.0)
        ]

    def columns(self, motion: Motion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """Predicted torque of before less that of now, without the jumps at reversals, in all joint rows."""
        before = motion.time - shape["delay"]
        torque = motion.smooth_torque("joint")
        late = np.column_stack([np.interp(before, motion.time, column) for column in torque.T])
        return (Column(joint=late - torque),)

    def simulate(self, joint: int, parameters: Mapping[str, float]) -> Simulated:
        """Reports old joint torques."""
        return _Late(float(parameters["delay"]))


class _Late(Simulated):
    def __init__(self, delay: float) -> None:
        self.cycles = max(0, round(1e3 * delay))
        self.past: list[Any] = []

    def sense(self, time_s: float, plant: Any, reading: Any) -> None:
        self.past.append(reading.joint_torque.copy())
        if len(self.past) > self.cycles + 1:
            self.past.pop(0)
        reading.joint_torque[:] = self.past[0]
