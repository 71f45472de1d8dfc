"""A wrong torque constant of the motor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ident.effects.effect import Column, Effect, Parameter, Setting, Shape, Simulated
from ident.effects.motion import Motion


class MotorTorqueGain(Effect):
    """The motor torque is reported `1 + error` times too large.

    Friction and drive inertia take up their share of the error; what shows is the load of the joint.
    """

    cause = "motor_torque_gain"
    side = "motor"
    physics = "the torque constant that turns current into torque is wrong"
    source = "Gautier and Briot, ICRA 2011; Jubien, Gautier and Janot, IFAC 2014"
    parameters = (Parameter("error", "1", "relative error of the scale", low=-0.9, high=2.0),)
    tell_apart = "static poses of joint {joint} with a weighed mass and without it"

    def shapes(self, setting: Setting, joint: int) -> Sequence[Shape]:
        """Linear in everything."""
        return [{}]

    def columns(self, motion: Motion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """The predicted motor torque."""
        return (Column(motor=motion.motor_torque[:, joint]),)

    def simulate(self, joint: int, parameters: Mapping[str, float]) -> Simulated:
        """Scales the reported motor torque."""
        return _Gain(joint, float(parameters["error"]))


class _Gain(Simulated):
    def __init__(self, joint: int, error: float) -> None:
        self.joint, self.error = joint, error

    def sense_motor(self, time_s: float, plant: Any, reading: Any) -> None:
        reading.motor_torque[self.joint] *= 1.0 + self.error
