"""Viscous friction that is not proportional to the speed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ident.effects.effect import Column, Effect, Parameter, Setting, Shape, Simulated
from ident.effects.motion import Floats, Motion


class ViscousNonlinear(Effect):
    """Friction `coefficient |v|^exponent sign(v)` beside the linear viscous one.

    It bends the course of the viscous friction; a friction that falls as the speed rises is Stribeck's.
    """

    cause = "viscous_nonlinear"
    side = "motor"
    physics = "the lubricant thins under shear, so viscous friction grows slower (or faster) than the speed"
    source = "Wolf and Iskandar, ICRA 2018; Tjahjowidodo et al., Mech. Mach. Theory 2013"
    parameters = (
        Parameter("coefficient", "Nm (s/rad)^exponent", "friction at 1 rad/s beside the linear one"),
        Parameter("exponent", "1", "power of the speed", shape=True, low=0.2, high=4.0),
    )
    tell_apart = "a staircase of constant speeds of joint {joint} up to its limit, in random order"

    def shapes(self, setting: Setting, joint: int) -> Sequence[Shape]:
        """Powers below and above one."""
        return [{"exponent": p} for p in (0.4, 0.6, 0.8, 1.25, 1.6, 2.0, 3.0)]

    def columns(self, motion: Motion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """sign(v) |v|^exponent in the motor torque."""
        speed = motion.motor_speed[:, joint]
        return (Column(motor=np.sign(speed) * np.abs(speed) ** shape["exponent"]),)

    def plausible(self, coefficients: Floats, shape: Shape) -> bool:
        """Whether friction rises from standstill on."""
        rises = shape["exponent"] > 1.0 or bool(coefficients[0] > 0.0)
        return super().plausible(coefficients, shape) and rises

    def simulate(self, joint: int, parameters: Mapping[str, float]) -> Simulated:
        """A resisting torque at the motor."""
        return _Power(joint, float(parameters["coefficient"]), float(parameters["exponent"]))


class _Power(Simulated):
    def __init__(self, joint: int, coefficient: float, exponent: float) -> None:
        self.joint, self.coefficient, self.exponent = joint, coefficient, exponent

    def load(self, time_s: float, plant: Any, loads: Any) -> None:
        speed = plant.motor_velocity[self.joint]
        loads.motor_torque[self.joint] -= self.coefficient * np.sign(speed) * abs(speed) ** self.exponent
