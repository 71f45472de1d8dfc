"""A joint that gives way: the link is not where the encoder says."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ident.effects.deflection import changed_springs, deflected
from ident.effects.effect import Column, Effect, Parameter, Setting, Shape, Simulated, encoder_sides
from ident.effects.motion import Floats, Motion

# Compliances to begin with, over the joint's own: less is no other joint. And one [rad/Nm] for a derivative.
_SHARES = (0.3, 0.45, 0.65, 1.0, 1.6)
_SMALL = 1e-6


class JointElasticity(Effect):
    """The joint twists by `compliance tau_l` beyond what the model knows of.

    encoder : 1 where the published position is the motor's, so that the links are elsewhere; 0 where it is
    the link's, so that the motor is elsewhere.
    """

    cause = "joint_elasticity"
    side = "joint"
    physics = (
        "the gear's flexspline and the torque sensor twist under load: the link is not where the motor is"
    )
    source = "Spong, J. Dyn. Syst. Meas. Control 109 (1987); Janot, Gautier, Jubien and Vandanjon, 2014"
    parameters = (
        Parameter("compliance", "rad/Nm", "twist per torque beyond the model's", low=0.0, high=0.02),
        Parameter("encoder", "1", "1: positions of the motors, 0: of the links", shape=True),
        Parameter(
            "size", "rad/Nm", "compliance with which the links are let ring", shape=True, low=1e-7, high=0.02
        ),
    )
    scrutiny = 2.0
    optional = ("size",)
    tell_apart = "a 1 to 15 Hz chirp of joint {joint} with two payloads"

    def shapes(self, setting: Setting, joint: int) -> Sequence[Shape]:
        """Places of the encoder; sizes where the links ring on springs that are known."""
        found = []
        for encoder in encoder_sides(setting):
            if encoder > 0.5 and setting.compliance is not None:
                found += [
                    {"encoder": 1.0, "size": share * float(setting.compliance[joint])} for share in _SHARES
                ]
            else:
                found.append({"encoder": encoder})
        return found

    def continuous(self, shape: Shape) -> tuple[str, ...]:
        """The size."""
        return ("size",) if "size" in shape else ()

    def plausible(self, coefficients: Floats, shape: Shape) -> bool:
        """Whether the compliance is about the size with which the links were let ring."""
        more, size = float(coefficients[0]), shape.get("size")
        return super().plausible(coefficients, shape) and (size is None or 0.6 * size < more < 1.7 * size)

    def columns(self, motion: Motion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """Change of all torques with the displaced link, or of the motor torque with the displaced motor."""
        if motion.springs is not None and shape["encoder"] > 0.5:
            size = shape.get("size", _SMALL)
            return changed_springs(motion.springs, motion.springs.softer(joint, size), size)
        twist = motion.joint_torque[:, joint]
        return deflected(motion, joint, twist, bool(shape["encoder"] > 0.5), 1e-5)

    def simulate(self, joint: int, parameters: Mapping[str, float]) -> Simulated:
        """Displaces the published position; with the link's encoder, softens the joint."""
        return _Soft(joint, float(parameters["compliance"]), float(parameters["encoder"]) > 0.5)


class _Soft(Simulated):
    def __init__(self, joint: int, compliance: float, encoder: bool) -> None:
        self.joint, self.compliance, self.encoder = joint, compliance, encoder
        self.past: list[float] = []

    def load(self, time_s: float, plant: Any, loads: Any) -> None:
        if self.encoder:
            return
        self.past = [*self.past[-2:], self.compliance * float(plant.joint_torque[self.joint])]
        if len(self.past) == 3:
            speed = (self.past[2] - self.past[0]) / 2e-3
            loads.motor_torque[self.joint] -= loads.Fvm[self.joint] * speed

    def sense(self, time_s: float, plant: Any, reading: Any) -> None:
        if self.encoder:
            reading.position[self.joint] += self.compliance * plant.joint_torque[self.joint]
