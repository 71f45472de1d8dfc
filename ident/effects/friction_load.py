"""Friction that grows with the transmitted torque."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ident.effects.effect import Column, Effect, Parameter, Setting, Shape, Simulated
from ident.effects.motion import Motion


class FrictionLoad(Effect):
    """Friction `factor |tau_l| sign(v)`."""

    cause = "friction_load"
    side = "motor"
    physics = (
        "the load presses the gear teeth together, so Coulomb friction grows with the transmitted torque"
    )
    source = (
        "Hamon, Gautier and Garrec, IROS 2010; Bittencourt and Gunnarsson, J. Dyn. Syst. Meas. Control 2012"
    )
    parameters = (Parameter("factor", "1", "Coulomb friction per transmitted torque", low=0.0, high=1.0),)
    tell_apart = "a slow back and forth of joint {joint} with gravity for and against, with two payloads"

    def shapes(self, setting: Setting, joint: int) -> Sequence[Shape]:
        """Linear in everything."""
        return [{}]

    def columns(self, motion: Motion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """|tau_l| sign(v) in the motor torque."""
        load = np.abs(motion.joint_torque[:, joint])
        return (Column(motor=load * motion.direction[:, joint]),)

    def simulate(self, joint: int, parameters: Mapping[str, float]) -> Simulated:
        """Raises the Coulomb friction of the drive."""
        return _Load(joint, float(parameters["factor"]))


class _Load(Simulated):
    def __init__(self, joint: int, factor: float) -> None:
        self.joint, self.factor = joint, factor

    def load(self, time_s: float, plant: Any, loads: Any) -> None:
        loads.Fcm[self.joint] += self.factor * abs(plant.joint_torque[self.joint])
