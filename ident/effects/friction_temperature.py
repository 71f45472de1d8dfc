"""Friction that changes as the drive warms up."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ident.effects.effect import Column, Effect, Parameter, Setting, Shape, Simulated
from ident.effects.motion import Motion
from ident.effects.operators import first_order
from ident.effects.sessions import shares_of_session, steps_between


class FrictionTemperature(Effect):
    """Drive friction times `1 + change w`, with w running from 0 to 1 as the drive warms up.

    Within a session w starts anew in each: as 1 - exp(-t / time_constant), or, with `heat`, by the power that
    friction itself turns into heat, `time_constant w' = P / P1 - w` with P1 the power at 1 rad/s. Between sessions w
    is 1 from the session number `since` on, beside a `level` that all sessions share; against a reference it is 1
    in all.
    """

    cause = "friction_temperature"
    side = "motor"
    physics = "the lubricant thins as it warms up, so friction drifts with the time in use"
    source = "Bittencourt, Wernholt, Sander-Tavallaey and Brogardh, IROS 2010; Simoni et al., Robotica 2017"
    parameters = (
        Parameter("change", "1", "relative change of the friction, cold to warm", low=-0.9, high=2.0),
        Parameter("level", "1", "relative change in all sessions, against the reference", low=-0.9, high=2.0),
        Parameter(
            "time_constant",
            "s",
            "of the warming up within a session; 0: between the sessions, -1: since the reference",
            shape=True,
        ),
        Parameter(
            "since", "1", "number of the first session after a change between the sessions", shape=True
        ),
        Parameter("own", "1", "1: the sessions before it have a level of their own too", shape=True),
        Parameter(
            "heat",
            "1",
            "1: warmed by the friction's own power, which differs from motion to motion",
            shape=True,
        ),
    )
    optional = ("heat",)
    tell_apart = "the same speed staircase of joint {joint} cold and after twenty minutes, in random order"

    def shapes(self, setting: Setting, joint: int) -> Sequence[Shape]:
        """From a fifth of the session to a steady drift, and between sessions where there are several."""
        longest = max(setting.durations_s)
        within = [
            {"time_constant": share * longest, "heat": heat}
            for heat in (0.0, 1.0)
            for share in (0.15, 0.4, 1.0, 5.0)
        ]
        return [*within, *steps_between(setting), {"time_constant": -1.0}]

    def continuous(self, shape: Shape) -> tuple[str, ...]:
        """The time constant, where it is one."""
        return ("time_constant",) if shape["time_constant"] > 0.0 else ()

    def mode(self, shape: Shape) -> str | None:
        """Within a session or between sessions."""
        return "within" if shape["time_constant"] > 0.0 else "between"

    def columns(self, motion: Motion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """The model's friction times w in the motor torque."""
        friction = motion.drive_friction[:, joint]
        constant = shape["time_constant"]
        if constant > 0.0 and shape.get("heat", 0.0) > 0.5:
            power = np.ascontiguousarray(friction * motion.motor_speed[:, joint])
            usual = max(float(motion.friction(np.ones((1, motion.n)))[0, joint]), 1e-9)
            warm = first_order(power / usual, np.exp(-motion.dt / constant), 0.0)
            return (Column(motor=friction * warm),)
        if constant > 0.0:
            return (Column(motor=friction * (1.0 - np.exp(-motion.time / constant))),)
        return tuple(Column(motor=share * friction) for share in shares_of_session(motion.session, shape))

    def simulate(self, joint: int, parameters: Mapping[str, float]) -> Simulated:
        """Scales the friction of the drive."""
        change, constant = float(parameters["change"]), float(parameters.get("time_constant", 0.0))
        heat = float(parameters.get("heat", 0.0)) > 0.5
        return _Warm(joint, change, constant, float(parameters.get("level", 0.0)), heat)


class _Warm(Simulated):
    def __init__(self, joint: int, change: float, constant: float, level: float, heat: bool) -> None:
        self.joint, self.change, self.constant, self.level = joint, change, constant, level
        self.heat, self.warmth = heat and constant > 0.0, 0.0

    def load(self, time_s: float, plant: Any, loads: Any) -> None:
        warm = 1.0 - np.exp(-time_s / self.constant) if self.constant > 0.0 else 1.0
        if self.heat:
            coulomb, viscous = loads.Fcm[self.joint], loads.Fvm[self.joint]
            speed = abs(float(plant.motor_velocity[self.joint]))
            power = (coulomb + viscous * speed) * speed / max(coulomb + viscous, 1e-9)
            self.warmth += (power - self.warmth) * plant.cycle_s / self.constant
            warm = self.warmth
        factor = 1.0 + self.change * warm + self.level
        loads.Fcm[self.joint] *= factor
        loads.Fvm[self.joint] *= factor
