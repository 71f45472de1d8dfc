"""An encoder whose zero is off."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ident.effects.effect import Column, Effect, Parameter, Setting, Shape, Simulated
from ident.effects.motion import Motion


class JointZeroOffset(Effect):
    """The joint stands at q + `offset` when q is published."""

    cause = "joint_zero_offset"
    side = "joint"
    physics = "the encoder's zero is off, so the arm stands elsewhere than the positions say"
    source = "Khalil and Dombre, Modeling, Identification and Control of Robots (2002), chapter 11"
    parameters = (Parameter("offset", "rad", "true less published position", low=-0.3, high=0.3),)
    tell_apart = (
        "static poses with joint {joint} on both sides of its gravity-free position; a mastering gauge"
    )

    def shapes(self, setting: Setting, joint: int) -> Sequence[Shape]:
        """Linear in the small angle."""
        return [{}]

    def columns(self, motion: Motion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """Derivative of the joint torque by the joint's position, in all rows."""
        step = np.zeros_like(motion.q)
        step[:, joint] = 1e-4
        upper = motion.rigid_torque(motion.q + step, motion.qd, motion.qdd)
        lower = motion.rigid_torque(motion.q - step, motion.qd, motion.qdd)
        change = (upper - lower) / 2e-4
        return (Column(motor=change, joint=change),)

    def simulate(self, joint: int, parameters: Mapping[str, float]) -> Simulated:
        """Shifts the published positions."""
        return _Zero(joint, float(parameters["offset"]))


class _Zero(Simulated):
    def __init__(self, joint: int, offset: float) -> None:
        self.joint, self.offset = joint, offset

    def sense(self, time_s: float, plant: Any, reading: Any) -> None:
        reading.position[self.joint] -= self.offset
