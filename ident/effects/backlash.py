"""Lost motion where the joint torque changes its sign."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ident.effects.deflection import deflected
from ident.effects.effect import Column, Effect, Parameter, Setting, Shape, Simulated, encoder_sides
from ident.effects.motion import Motion


class Backlash(Effect):
    """The link lags the motor by half the `gap`, to the side that the joint torque pulls it.

    encoder : 1 where the published position is the motor's, so that the links are elsewhere; 0 where it is
    the link's, so that the motor moves across the gap.
    """

    cause = "backlash"
    side = "joint"
    physics = "gear teeth lose contact and cross a gap where the transmitted torque changes its sign"
    source = "Nordin and Gutman, Automatica 38 (2002)"
    parameters = (
        Parameter("gap", "rad", "lost motion", low=0.0, high=0.1),
        Parameter("encoder", "1", "1: positions of the motors, 0: of the links", shape=True),
        Parameter("width", "Nm", "torque over which the gap is crossed", shape=True),
    )
    scrutiny = 2.0
    tell_apart = "a slow sweep of joint {joint} through the poses where its gravity torque is zero"

    def shapes(self, setting: Setting, joint: int) -> Sequence[Shape]:
        """Places of the encoder, sharp and soft crossing; none where the torque keeps its sign."""
        if not setting.torque_turns[joint]:
            return []
        top = float(setting.torque_range[joint])
        return [
            {"encoder": e, "width": max(1e-3, w * top)} for e in encoder_sides(setting) for w in (0.01, 0.05)
        ]

    def continuous(self, shape: Shape) -> tuple[str, ...]:
        """The width, loosely."""
        return ()

    def columns(self, motion: Motion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """Change of all torques with the displaced link, or of the motor torque with the displaced motor."""
        half = 0.5 * np.tanh(motion.joint_torque[:, joint] / shape["width"])
        return deflected(motion, joint, half, bool(shape["encoder"] > 0.5), 1e-3)

    def simulate(self, joint: int, parameters: Mapping[str, float]) -> Simulated:
        """Displaces the published position; with the link's encoder, pulls the motor across the gap."""
        return _Gap(joint, *(float(parameters[p.name]) for p in self.parameters))


class _Gap(Simulated):
    def __init__(self, joint: int, gap: float, encoder: float, width: float) -> None:
        self.joint, self.gap, self.encoder, self.width = joint, gap, encoder > 0.5, width
        self.past: list[float] = []

    def load(self, time_s: float, plant: Any, loads: Any) -> None:
        if self.encoder:
            return
        self.past = [*self.past[-2:], 0.5 * self.gap * np.tanh(plant.joint_torque[self.joint] / self.width)]
        if len(self.past) == 3:
            speed = (self.past[2] - self.past[0]) / 2e-3
            loads.motor_torque[self.joint] -= loads.Fvm[self.joint] * speed

    def sense(self, time_s: float, plant: Any, reading: Any) -> None:
        if self.encoder:
            shift = 0.5 * self.gap * np.tanh(plant.joint_torque[self.joint] / self.width)
            reading.position[self.joint] += shift
