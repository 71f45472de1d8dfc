"""A joint torque sensor that remembers where the torque came from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ident.effects.effect import Column, Effect, Parameter, Setting, Shape, Simulated
from ident.effects.motion import Motion
from ident.effects.operators import dahl


class SensorHysteresis(Effect):
    """The sensor lags by up to `amplitude`, the lag turning over within the torque `width`."""

    cause = "sensor_hysteresis"
    side = "sensor"
    physics = "screws and glue of the sensor slip a little, so loading and unloading curves differ"
    source = "Seyfferth, Maghzal and Angeles, ICRA 1995"
    parameters = (
        Parameter("amplitude", "Nm", "half the width of the loop", low=0.0),
        Parameter("width", "Nm", "torque in which the lag turns by 63 %", shape=True, low=0.1),
    )
    scrutiny = 3.0
    tell_apart = "load joint {joint} quasi-statically up and down over its range, twice"

    def shapes(self, setting: Setting, joint: int) -> Sequence[Shape]:
        """From one to thirty per cent of the torque's range."""
        top = float(setting.torque_range[joint])
        return [{"width": share * top} for share in (0.03, 0.1, 0.3) if share * top > 0.1]

    def columns(self, motion: Motion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """Less Dahl's state along the predicted torque, in the joint torque only."""
        return (
            Column(joint=-dahl(np.ascontiguousarray(motion.joint_torque[:, joint]), shape["width"], 0.0)),
        )

    def simulate(self, joint: int, parameters: Mapping[str, float]) -> Simulated:
        """Delays the reported joint torque."""
        return _Loop(joint, float(parameters["amplitude"]), float(parameters["width"]))


class _Loop(Simulated):
    def __init__(self, joint: int, amplitude: float, width: float) -> None:
        self.joint, self.amplitude, self.width = joint, amplitude, width
        self.state = 0.0
        self.before: float | None = None

    def sense(self, time_s: float, plant: Any, reading: Any) -> None:
        here = float(plant.joint_torque[self.joint])
        step = 0.0 if self.before is None else here - self.before
        self.before = here
        sign = 1.0 if step > 0.0 else -1.0
        self.state = sign - (sign - self.state) * float(np.exp(-abs(step) / self.width))
        reading.joint_torque[self.joint] -= self.amplitude * self.state
