"""A joint torque sensor that clips."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ident.effects.effect import Column, Effect, Parameter, Setting, Shape, Simulated
from ident.effects.motion import Motion


class SensorSaturation(Effect):
    """Joint torques beyond `limit` are reported as the limit."""

    cause = "sensor_saturation"
    side = "sensor"
    physics = "the amplifier of the sensor reaches its range"
    source = "Haddadin, De Luca and Albu-Schaeffer, IEEE Trans. Robotics 33 (2017)"
    parameters = (
        Parameter("share", "1", "share of the excess that is cut", low=0.2, high=1.3),
        Parameter("limit", "Nm", "largest torque that is reported", shape=True, low=1e-2),
        Parameter("seen", "1", "1: the samples stop at the limit", shape=True),
    )
    hidden = ("share",)
    optional = ("seen",)
    tell_apart = "raise the load of joint {joint} slowly in a static pose until the reading stops"

    def shapes(self, setting: Setting, joint: int) -> Sequence[Shape]:
        """Where the samples stop, if they do; else from half to all of the predicted range."""
        if setting.clipped is not None and np.isfinite(setting.clipped[joint]):
            return [{"limit": float(setting.clipped[joint]), "seen": 1.0}]
        top = float(setting.torque_range[joint])
        return [{"limit": share * top} for share in (0.5, 0.65, 0.75, 0.85, 0.92, 0.97) if top > 0.1]

    def continuous(self, shape: Shape) -> tuple[str, ...]:
        """The limit, where the samples do not tell it."""
        return () if self.witnessed(shape) else ("limit",)

    def witnessed(self, shape: Shape) -> bool:
        """Whether the samples stop at the limit."""
        return shape.get("seen", 0.0) > 0.5

    def coarse(self, parameters: Mapping[str, float]) -> Mapping[str, float]:
        """A limit that is read from the samples is as sure as an amplifier's end is sharp."""
        return {"limit": _SHARP * parameters["limit"]} if self.witnessed(parameters) else {}

    def columns(self, motion: Motion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """The clipped part of the predicted torque, in the joint torque only."""
        torque = motion.joint_torque[:, joint]
        return (Column(joint=np.clip(torque, -shape["limit"], shape["limit"]) - torque),)

    def simulate(self, joint: int, parameters: Mapping[str, float]) -> Simulated:
        """Clips the reported joint torque."""
        return _Clip(joint, float(parameters["limit"]))


# Standard deviation of a limit that the samples show, over the limit.
_SHARP = 1e-3


class _Clip(Simulated):
    def __init__(self, joint: int, limit: float) -> None:
        self.joint, self.limit = joint, limit

    def sense(self, time_s: float, plant: Any, reading: Any) -> None:
        value = reading.joint_torque[self.joint]
        reading.joint_torque[self.joint] = min(self.limit, max(-self.limit, value))
