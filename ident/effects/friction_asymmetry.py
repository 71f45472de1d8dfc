"""Friction that depends on the direction of motion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ident.effects.effect import Column, Effect, Parameter, Setting, Shape, Simulated
from ident.effects.motion import Motion


class FrictionAsymmetry(Effect):
    """Friction larger one way than the other: `viscous |v| + coulomb`.

    The Coulomb part is a constant torque, which the drive's offset takes up; without a reference only the
    viscous part shows.
    """

    cause = "friction_asymmetry"
    side = "motor"
    physics = "gear teeth and bearings engage differently in the two directions"
    source = "Armstrong-Helouvry, Control of Machines with Friction (1991)"
    parameters = (
        Parameter("viscous", "Nm s/rad", "half the difference of the viscous friction of both ways"),
        Parameter("coulomb", "Nm", "half the difference of the Coulomb friction; 0 without a reference"),
        Parameter("parts", "1", "1: viscous alone, 2: against a reference, both", shape=True),
    )
    tell_apart = "the same constant-speed sweep of joint {joint} both ways, twice"

    def shapes(self, setting: Setting, joint: int) -> Sequence[Shape]:
        """The viscous part alone, and both."""
        return [{"parts": 1.0}, {"parts": 2.0}]

    def continuous(self, shape: Shape) -> tuple[str, ...]:
        """Either or."""
        return ()

    def columns(self, motion: Motion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """|v| in the motor torque, and a constant."""
        speed = np.abs(motion.motor_speed[:, joint])
        # Of the Coulomb part, as much as has built up since the last reversal.
        built = motion.direction[:, joint] * np.sign(motion.motor_speed[:, joint])
        both = Column(motor=speed), Column(motor=built)
        return both if shape.get("parts", 2.0) > 1.5 else both[:1]

    def simulate(self, joint: int, parameters: Mapping[str, float]) -> Simulated:
        """A torque at the motor."""
        viscous, coulomb = float(parameters.get("viscous", 0.0)), float(parameters.get("coulomb", 0.0))
        return _Asymmetry(joint, viscous, coulomb)


class _Asymmetry(Simulated):
    def __init__(self, joint: int, viscous: float, coulomb: float) -> None:
        self.joint, self.viscous, self.coulomb = joint, viscous, coulomb

    def load(self, time_s: float, plant: Any, loads: Any) -> None:
        speed = plant.motor_velocity[self.joint]
        loads.offm[self.joint] += self.coulomb
        loads.motor_torque[self.joint] -= self.viscous * abs(speed)
