"""Friction that depends on the joint angle."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ident.effects.effect import Column, Effect, Parameter, Setting, Shape, Simulated
from ident.effects.motion import Motion


class FrictionPosition(Effect):
    """Coulomb friction varies as `cosine cos(k q) + sine sin(k q)` over the joint angle."""

    cause = "friction_position"
    side = "motor"
    physics = "a gear or bearing that runs out of true grips more at some angles of the joint"
    source = "Armstrong-Helouvry, Control of Machines with Friction (1991), chapter 4"
    parameters = (
        Parameter("cosine", "Nm", "Coulomb friction with cos(k q)"),
        Parameter("sine", "Nm", "Coulomb friction with sin(k q)"),
        Parameter("cycles_per_turn", "1", "k", shape=True),
    )
    tell_apart = (
        "a slow sweep of joint {joint} over its whole range, both ways, in two postures of the others"
    )

    def shapes(self, setting: Setting, joint: int) -> Sequence[Shape]:
        """One to four cycles a turn."""
        return [{"cycles_per_turn": float(k)} for k in (1, 2, 3, 4)]

    def continuous(self, shape: Shape) -> tuple[str, ...]:
        """Cycles are whole numbers."""
        return ()

    def columns(self, motion: Motion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """sign(v) cos(k q) and sign(v) sin(k q) in the motor torque."""
        sign = motion.direction[:, joint]
        angle = shape["cycles_per_turn"] * motion.q[:, joint]
        return Column(motor=sign * np.cos(angle)), Column(motor=sign * np.sin(angle))

    def simulate(self, joint: int, parameters: Mapping[str, float]) -> Simulated:
        """Changes the Coulomb friction of the drive."""
        return _Position(joint, *(float(parameters[p.name]) for p in self.parameters))


class _Position(Simulated):
    def __init__(self, joint: int, cosine: float, sine: float, cycles: float) -> None:
        self.joint, self.cosine, self.sine, self.cycles = joint, cosine, sine, cycles

    def load(self, time_s: float, plant: Any, loads: Any) -> None:
        angle = self.cycles * plant.motor_position[self.joint]
        friction = loads.Fcm[self.joint] + self.cosine * np.cos(angle) + self.sine * np.sin(angle)
        loads.Fcm[self.joint] = max(0.0, friction)
