"""Friction that needs a distance to build up after a reversal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ident.effects.effect import Column, Effect, Parameter, Setting, Shape, Simulated
from ident.effects.motion import Motion
from ident.effects.operators import dahl


class PreslidingHysteresis(Effect):
    """Part of the Coulomb friction is Dahl's: it turns over within a sliding distance, not at once."""

    cause = "presliding_hysteresis"
    side = "motor"
    physics = "asperities bend before they slide, so friction turns over a distance after each reversal"
    source = "Dahl, AIAA Journal 14 (1976); Swevers et al., IEEE Trans. Autom. Control 45 (2000)"
    parameters = (
        Parameter("amplitude", "Nm", "Coulomb friction that turns over slowly", low=0.0),
        Parameter("length", "rad", "distance in which it turns by 63 %", shape=True, low=1e-5, high=0.5),
    )
    scrutiny = 2.0
    tell_apart = "reversals of joint {joint} at three accelerations and amplitudes (0.5, 2 and 10 mrad)"

    def shapes(self, setting: Setting, joint: int) -> Sequence[Shape]:
        """From half a milliradian, or ten times the reach that the model has, to a tenth of a radian."""
        # Near the reach of the healthy drive it is that reach which is a little different.
        least = 0.0 if setting.reach is None else 10.0 * float(setting.reach[joint])
        return [{"length": x} for x in (5e-4, 1.5e-3, 5e-3, 1.5e-2, 5e-2, 0.15) if x >= least]

    def columns(self, motion: Motion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """Dahl's state less sign(v) in the motor torque."""
        speed = motion.motor_speed[:, joint]
        path = np.cumsum(speed) * motion.dt
        state = dahl(path, shape["length"], float(np.sign(speed[0])))
        return (Column(motor=state - motion.direction[:, joint]),)

    def simulate(self, joint: int, parameters: Mapping[str, float]) -> Simulated:
        """Takes the amplitude out of the set-valued friction and gives it back through Dahl's state."""
        return _Dahl(joint, float(parameters["amplitude"]), float(parameters["length"]))


class _Dahl(Simulated):
    def __init__(self, joint: int, amplitude: float, length: float) -> None:
        self.joint, self.amplitude, self.length = joint, amplitude, length
        self.state = 0.0
        self.before: float | None = None

    def load(self, time_s: float, plant: Any, loads: Any) -> None:
        here = float(plant.motor_position[self.joint])
        step = 0.0 if self.before is None else here - self.before
        self.before = here
        sign = 1.0 if step > 0.0 else -1.0
        self.state = sign - (sign - self.state) * float(np.exp(-abs(step) / self.length))
        loads.Fcm[self.joint] = max(0.0, loads.Fcm[self.joint] - self.amplitude)
        loads.motor_torque[self.joint] -= self.amplitude * self.state
