"""Lost motion where the joint torque changes its sign."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ident.effects.deflection import changed_springs, deflected
from ident.effects.effect import Column, Effect, Parameter, Setting, Shape, Simulated, encoder_sides
from ident.effects.motion import Floats, Motion

# Lost motions to begin with [rad].
_SIZES = (1e-4, 3e-4, 1e-3, 3e-3, 1e-2)


class Backlash(Effect):
    """The link lags the motor by half the `gap`, to the side that the joint torque pulls it.

    encoder : 1 where the published position is the motor's, so that the links are elsewhere; 0 where it is
    the link's, so that the motor moves across the gap. In the first case the link crosses the gap almost free,
    arrives, and rings on its spring: how, depends on the `size` of the gap.
    """

    cause = "backlash"
    side = "joint"
    physics = "gear teeth lose contact and cross a gap where the transmitted torque changes its sign"
    source = "Nordin and Gutman, Automatica 38 (2002)"
    parameters = (
        Parameter("gap", "rad", "lost motion", low=0.0, high=0.1),
        Parameter("encoder", "1", "1: positions of the motors, 0: of the links", shape=True),
        Parameter("width", "Nm", "torque over which the gap is crossed", shape=True),
        Parameter("size", "rad", "gap that the links are let cross", shape=True, low=1e-5, high=0.1),
    )
    scrutiny = 2.0
    optional = ("size",)
    tell_apart = "a slow sweep of joint {joint} through the poses where its gravity torque is zero"

    def shapes(self, setting: Setting, joint: int) -> Sequence[Shape]:
        """Places of the encoder, sharp and soft crossing; none where the torque keeps its sign."""
        if not setting.torque_turns[joint]:
            return []
        top = float(setting.torque_range[joint])
        found = []
        for encoder in encoder_sides(setting):
            if encoder > 0.5 and setting.compliance is not None:
                found += [{"encoder": 1.0, "width": 0.01 * top, "size": size} for size in _SIZES]
            else:
                found += [{"encoder": encoder, "width": max(1e-3, w * top)} for w in (0.01, 0.05)]
        return found

    def continuous(self, shape: Shape) -> tuple[str, ...]:
        """The size."""
        return ("size",) if "size" in shape else ()

    def plausible(self, coefficients: Floats, shape: Shape) -> bool:
        """Whether the gap is about the size that the links were let cross."""
        gap, size = float(coefficients[0]), shape.get("size")
        return super().plausible(coefficients, shape) and (size is None or 0.5 * size < gap < 2.0 * size)

    def columns(self, motion: Motion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """Change of all torques with the displaced link, or of the motor torque with the displaced motor."""
        size = shape.get("size", 0.0)
        if motion.springs is not None and size > 0.0 and shape["encoder"] > 0.5:
            return changed_springs(motion.springs, motion.springs.with_play(joint, size), size)
        half = 0.5 * np.tanh(motion.joint_torque[:, joint] / shape["width"])
        return deflected(motion, joint, half, bool(shape["encoder"] > 0.5), 1e-3)

    def simulate(self, joint: int, parameters: Mapping[str, float]) -> Simulated:
        """Displaces the published position; with the link's encoder, pulls the motor across the gap."""
        return _Gap(joint, *(float(parameters[name]) for name in ("gap", "encoder", "width")))


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
