"""A base that does not stand upright."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ident.effects.effect import Column, Effect, Parameter, Setting, Shape, Simulated
from ident.effects.motion import Floats, Motion


def sideways_gravity(gravity: Floats, axes: Floats) -> Floats:
    """Derivatives (k, 3) of gravity (3,) in the base's axes, for rotations of the base about `axes` (k, 3)."""
    return np.array([-np.cross(axis, gravity) for axis in axes])


class BaseTilt(Effect):
    """Gravity is turned by `tilt_x` about x and `tilt_y` about y of the base frame (small angles)."""

    cause = "base_tilt"
    side = "joint"
    physics = "the base is not level, so gravity is not along the assumed axis"
    source = "Khalil and Dombre, Modeling, Identification and Control of Robots (2002), chapter 12"
    parameters = (
        Parameter("tilt_x", "rad", "rotation of the base about its x axis", low=-0.5, high=0.5),
        Parameter("tilt_y", "rad", "rotation of the base about its y axis", low=-0.5, high=0.5),
    )
    whole_arm = True
    tell_apart = "static poses over a whole turn of joint 1 with the arm stretched out; a spirit level"

    def shapes(self, setting: Setting, joint: int) -> Sequence[Shape]:
        """Linear in everything."""
        return [{}]

    def columns(self, motion: Motion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """Gravity torques of the sideways parts of gravity, in all rows."""
        down = motion.chain.gravity / np.linalg.norm(motion.chain.gravity)
        torques = [motion.gravity_along(direction) for direction in sideways_gravity(down, np.eye(3)[:2])]
        return tuple(Column(motor=torque, joint=torque) for torque in torques)

    def simulate(self, joint: int, parameters: Mapping[str, float]) -> Simulated:
        """Gravity of the simulated arm turned."""
        return _Tilt(float(parameters["tilt_x"]), float(parameters["tilt_y"]))


class _Tilt(Simulated):
    def __init__(self, tilt_x: float, tilt_y: float) -> None:
        self.tilt = np.array([tilt_x, tilt_y, 0.0])
        self.turned: Any = None

    def start(self, joints: int, random: np.random.Generator) -> None:
        self.turned = None

    def load(self, time_s: float, plant: Any, loads: Any) -> None:
        gravity = np.array(plant.model.gravity.linear)
        if self.turned is None:
            self.turned = gravity - np.cross(self.tilt, gravity)
        if not np.array_equal(gravity, self.turned):
            # The links may be another arm's as well, and a payload that is mounted brings new ones.
            model = plant.model.copy()
            model.gravity.linear = self.turned
            plant.model = model
