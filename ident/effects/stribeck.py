"""Friction that rises as the speed falls towards zero."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ident.effects.effect import Column, Effect, Parameter, Setting, Shape, Simulated
from ident.effects.motion import Motion


class Stribeck(Effect):
    """Coulomb friction gains `amplitude exp(-(|v| / velocity)^exponent)` near standstill."""

    cause = "stribeck"
    side = "motor"
    physics = "the lubricant film breaks down at low speed, so friction rises as the speed falls towards zero"
    source = "Armstrong-Helouvry, Dupont and Canudas de Wit, Automatica 30 (1994)"
    parameters = (
        Parameter("amplitude", "Nm", "friction at standstill above the Coulomb level", low=0.0),
        Parameter("velocity", "rad/s", "speed at which 1/e of it is left", shape=True, low=1e-3, high=1.0),
        Parameter("exponent", "1", "1: Tustin, 2: Gauss", shape=True, low=0.5, high=3.0),
    )
    tell_apart = "a slow constant-velocity sweep of joint {joint} through 0.01 to 0.2 rad/s"

    def shapes(self, setting: Setting, joint: int) -> Sequence[Shape]:
        """Speeds from 0.01 rad/s to half the largest one."""
        speeds = [v for v in (0.01, 0.02, 0.04, 0.08, 0.16, 0.3) if v < setting.speed_range[joint]]
        return [{"velocity": v, "exponent": e} for e in (1.0, 2.0) for v in speeds]

    def continuous(self, shape: Shape) -> tuple[str, ...]:
        """Speed and exponent: what is taken for granted of either is missing from the other's uncertainty."""
        return ("velocity", "exponent")

    def columns(self, motion: Motion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """sign(v) exp(-(|v| / velocity)^exponent) in the motor torque."""
        speed = motion.motor_speed[:, joint]
        fall = np.exp(-((np.abs(speed) / shape["velocity"]) ** shape.get("exponent", 1.0)))
        return (Column(motor=motion.direction[:, joint] * fall),)

    def simulate(self, joint: int, parameters: Mapping[str, float]) -> Simulated:
        """Raises the Coulomb friction of the drive."""
        amplitude, velocity = float(parameters["amplitude"]), float(parameters["velocity"])
        return _Stribeck(joint, amplitude, velocity, float(parameters.get("exponent", 1.0)))


class _Stribeck(Simulated):
    def __init__(self, joint: int, amplitude: float, velocity: float, exponent: float) -> None:
        self.joint, self.amplitude, self.velocity, self.exponent = joint, amplitude, velocity, exponent

    def load(self, time_s: float, plant: Any, loads: Any) -> None:
        speed = abs(plant.motor_velocity[self.joint])
        loads.Fcm[self.joint] += self.amplitude * np.exp(-((speed / self.velocity) ** self.exponent))
