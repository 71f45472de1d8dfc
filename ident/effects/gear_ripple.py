"""Torque that repeats with the motor angle."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ident.effects.effect import Column, Effect, Parameter, Setting, Shape, Simulated
from ident.effects.motion import Motion


class GearRipple(Effect):
    """Motor torque `cosine cos(k N q) + sine sin(k N q)`, N the gear ratio."""

    cause = "gear_ripple"
    side = "motor"
    physics = (
        "the elliptic wave generator and the teeth give a torque that repeats once or twice a motor turn"
    )
    source = "Taghirad and Belanger, J. Dyn. Syst. Meas. Control 120 (1998)"
    parameters = (
        Parameter("cosine", "Nm", "torque with cos(k N q)"),
        Parameter("sine", "Nm", "torque with sin(k N q)"),
        Parameter("cycles_per_turn", "1/turn of the motor", "k", shape=True),
        Parameter("gear_ratio", "1", "N", shape=True),
    )
    tell_apart = "the same path of joint {joint} at two constant speeds below 0.1 rad/s and with two payloads"

    def shapes(self, setting: Setting, joint: int) -> Sequence[Shape]:
        """Once and twice a turn of the motor."""
        ratio = float(setting.gear_ratio[joint])
        return [{"cycles_per_turn": k, "gear_ratio": ratio} for k in (1.0, 2.0)] if ratio > 1.0 else []

    def continuous(self, shape: Shape) -> tuple[str, ...]:
        """Cycles are whole numbers."""
        return ()

    def columns(self, motion: Motion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """Cosine and sine in the motor torque."""
        angle = shape["cycles_per_turn"] * shape["gear_ratio"] * motion.q[:, joint]
        return Column(motor=np.cos(angle)), Column(motor=np.sin(angle))

    def simulate(self, joint: int, parameters: Mapping[str, float]) -> Simulated:
        """A torque at the motor."""
        cycles = float(parameters["cycles_per_turn"]) * float(parameters["gear_ratio"])
        return _Ripple(joint, float(parameters["cosine"]), float(parameters["sine"]), cycles)


class _Ripple(Simulated):
    def __init__(self, joint: int, cosine: float, sine: float, cycles: float) -> None:
        self.joint, self.cosine, self.sine, self.cycles = joint, cosine, sine, cycles

    def load(self, time_s: float, plant: Any, loads: Any) -> None:
        angle = self.cycles * plant.motor_position[self.joint]
        loads.motor_torque[self.joint] -= self.cosine * np.cos(angle) + self.sine * np.sin(angle)
