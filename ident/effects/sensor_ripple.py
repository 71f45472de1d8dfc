"""A joint torque sensor whose error repeats with the angle."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ident.effects.effect import Column, Effect, Parameter, Setting, Shape, Simulated
from ident.effects.motion import Motion


class SensorRipple(Effect):
    """The sensor adds `cosine cos(k r q) + sine sin(k r q)`: r = 1 for the joint's angle, N for
    the motor's.
    """

    cause = "sensor_ripple"
    side = "sensor"
    physics = "the flexspline's ellipse passes under the strain gauges, or the sensor runs out of true"
    source = "Taghirad and Belanger, J. Dyn. Syst. Meas. Control 120 (1998); Hashimoto et al., 1993"
    parameters = (
        Parameter("cosine", "Nm", "torque with cos(k r q)"),
        Parameter("sine", "Nm", "torque with sin(k r q)"),
        Parameter("cycles_per_turn", "1", "k", shape=True),
        Parameter("ratio", "1", "r: turns of what it repeats with for a turn of the joint", shape=True),
    )
    tell_apart = "the same path of joint {joint} at two constant speeds below 0.1 rad/s and with two payloads"

    def shapes(self, setting: Setting, joint: int) -> Sequence[Shape]:
        """One to six cycles a turn of the joint (run-out, ellipse, spokes and bolts), one and two of the motor."""
        ratio = float(setting.gear_ratio[joint])
        own = [{"cycles_per_turn": k, "ratio": 1.0} for k in (1.0, 2.0, 3.0, 4.0, 5.0, 6.0)]
        return [*own, *({"cycles_per_turn": k, "ratio": ratio} for k in (1.0, 2.0) if ratio > 1.0)]

    def continuous(self, shape: Shape) -> tuple[str, ...]:
        """Cycles are whole numbers."""
        return ()

    def columns(self, motion: Motion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """Cosine and sine in the joint torque only."""
        angle = shape["cycles_per_turn"] * shape["ratio"] * motion.q[:, joint]
        return Column(joint=np.cos(angle)), Column(joint=np.sin(angle))

    def simulate(self, joint: int, parameters: Mapping[str, float]) -> Simulated:
        """Adds to the reported joint torque."""
        cycles = float(parameters["cycles_per_turn"]) * float(parameters["ratio"])
        return _Ripple(joint, float(parameters["cosine"]), float(parameters["sine"]), cycles)


class _Ripple(Simulated):
    def __init__(self, joint: int, cosine: float, sine: float, cycles: float) -> None:
        self.joint, self.cosine, self.sine, self.cycles = joint, cosine, sine, cycles

    def sense(self, time_s: float, plant: Any, reading: Any) -> None:
        angle = self.cycles * plant.position[self.joint]
        reading.joint_torque[self.joint] += self.cosine * np.cos(angle) + self.sine * np.sin(angle)
