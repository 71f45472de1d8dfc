"""A joint torque sensor that also sees another joint's torque."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ident.effects.effect import Column, Effect, Parameter, Setting, Shape, Simulated
from ident.effects.motion import Motion


class SensorCrosstalk(Effect):
    """The sensor adds `factor` times the torque of the joint number `source`."""

    cause = "sensor_crosstalk"
    side = "sensor"
    physics = "the sensor bends under the torque of a neighbouring axis as well"
    source = "Hirzinger et al., ICRA 2002; Aksman, Carignan and Akin, ICRA 2007"
    parameters = (
        Parameter("factor", "1", "share of the other joint's torque", low=-0.5, high=0.5),
        Parameter("source", "1", "number of the other joint", shape=True),
    )
    tell_apart = "load joint {joint} and the other one after another in static poses"

    def shapes(self, setting: Setting, joint: int) -> Sequence[Shape]:
        """All other joints."""
        return [{"source": float(k + 1)} for k in range(len(setting.gear_ratio)) if k != joint]

    def continuous(self, shape: Shape) -> tuple[str, ...]:
        """A number of a joint."""
        return ()

    def columns(self, motion: Motion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """The other joint's predicted torque, in the joint torque only."""
        return (Column(joint=motion.joint_torque[:, round(shape["source"]) - 1]),)

    def simulate(self, joint: int, parameters: Mapping[str, float]) -> Simulated:
        """Adds to the reported joint torque."""
        return _Leak(joint, round(float(parameters["source"])) - 1, float(parameters["factor"]))


class _Leak(Simulated):
    def __init__(self, joint: int, source: int, factor: float) -> None:
        self.joint, self.source, self.factor = joint, source, factor

    def sense(self, time_s: float, plant: Any, reading: Any) -> None:
        reading.joint_torque[self.joint] += self.factor * plant.joint_torque[self.source]
