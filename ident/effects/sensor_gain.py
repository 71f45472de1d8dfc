"""A joint torque sensor with a wrong scale."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ident.effects.effect import Column, Effect, Parameter, Setting, Shape, Simulated
from ident.effects.motion import Motion


class SensorGain(Effect):
    """The joint torque is reported `1 + error` times."""

    cause = "sensor_gain"
    side = "sensor"
    physics = "the strain gauges' bridge is calibrated wrongly"
    source = "Jubien, Gautier and Janot, IFAC 2014; Gautier and Briot, ICRA 2011"
    parameters = (Parameter("error", "1", "relative error of the scale", low=-0.9, high=2.0),)
    tell_apart = "static poses of joint {joint} with a weighed mass and without it"

    def shapes(self, setting: Setting, joint: int) -> Sequence[Shape]:
        """Linear in everything."""
        return [{}]

    def columns(self, motion: Motion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """The predicted joint torque in the joint torque only."""
        return (Column(joint=motion.joint_torque[:, joint]),)

    def simulate(self, joint: int, parameters: Mapping[str, float]) -> Simulated:
        """Scales the reported joint torque."""
        return _Gain(joint, float(parameters["error"]))


class _Gain(Simulated):
    def __init__(self, joint: int, error: float) -> None:
        self.joint, self.error = joint, error

    def sense(self, time_s: float, plant: Any, reading: Any) -> None:
        reading.joint_torque[self.joint] *= 1.0 + self.error
