"""A spring between links: hoses and cables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ident.effects.effect import Column, Effect, Parameter, Setting, Shape, Simulated
from ident.effects.motion import Floats, Motion


class CableSpring(Effect):
    """Hoses and cables pull with `stiffness f(q)`: a spring, one that hardens, or one that is slack in a range.

    kind : 0 linear; 1 cubic; 2 taut above the angle `slack`, -2 taut below it; 3 hardening, with
    `stiffness q + quadratic q^2 + cubic q^3`, which is `k (q - c) + h (q - c)^3` about whatever angle `c` it rests at;
    4 taut on both sides, further than `play` from `slack`.
    """

    cause = "cable_spring"
    side = "joint"
    physics = "hoses and cables along the arm are bent or stretched, and pull the link back"
    source = "Swevers, Verdonck and De Schutter, IEEE Control Systems Magazine 27 (2007)"
    parameters = (
        Parameter("stiffness", "Nm/rad", "of the spring (Nm/rad^3 for a cubic one)"),
        Parameter("quadratic", "Nm/rad^2", "of one that hardens: the angle it rests at is not zero"),
        Parameter("cubic", "Nm/rad^3", "of one that hardens"),
        Parameter(
            "kind", "1", "0 linear, 1 cubic, 2 or -2 taut above or below, 3 hardening, 4 play", shape=True
        ),
        Parameter(
            "slack", "rad", "angle at which the cable becomes taut, or the middle of its play", shape=True
        ),
        Parameter("play", "rad", "half the range without a pull", shape=True, low=0.0),
    )
    optional = ("quadratic", "cubic", "play")
    tell_apart = "the same slow sweep of joint {joint} in two postures of the other joints"

    def shapes(self, setting: Setting, joint: int) -> Sequence[Shape]:
        """Linear, cubic, hardening and one-sided springs, and springs with play."""
        low, high = setting.position_range[joint]
        angles = [float(low + share * (high - low)) for share in (0.3, 0.5, 0.7)]
        return [
            {"kind": 0.0, "slack": 0.0},
            {"kind": 1.0, "slack": 0.0},
            {"kind": 3.0, "slack": 0.0},
            *({"kind": kind, "slack": angle} for kind in (2.0, -2.0) for angle in angles),
            *(
                {"kind": 4.0, "slack": angle, "play": share * (high - low)}
                for angle in angles
                for share in (0.1, 0.25)
            ),
        ]

    def continuous(self, shape: Shape) -> tuple[str, ...]:
        """The angle of a one-sided spring, and the range of one with play."""
        if shape["kind"] == 4.0:
            return ("slack", "play")
        return ("slack",) if abs(shape["kind"]) == 2.0 else ()

    def plausible(self, coefficients: Floats, shape: Shape) -> bool:
        """Whether it pulls back, one that hardens over a radian to both sides at least in the mean."""
        if shape["kind"] == _HARDENING:
            return bool(coefficients[0] + coefficients[2] >= 0.0)
        return bool(coefficients[0] >= 0.0)

    def columns(self, motion: Motion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """The same torque on both sides."""
        angle = motion.q[:, joint]
        if shape["kind"] == _HARDENING:
            forces = [angle, angle**2, angle**3]
        else:
            forces = [pull(angle, shape["kind"], shape["slack"], shape.get("play", 0.0))]
        return tuple(Column(motor=force, joint=force) for force in forces)

    def simulate(self, joint: int, parameters: Mapping[str, float]) -> Simulated:
        """A torque on the link."""
        return _Cable(joint, {p.name: float(parameters.get(p.name, 0.0)) for p in self.parameters})


_HARDENING = 3.0


def pull(angle: Any, kind: float, slack: float, play: float = 0.0) -> Any:
    """Torque of a unit stiffness at `angle` [rad], against which the arm has to work."""
    if kind in (0.0, _HARDENING):
        return 1.0 * angle
    if kind == 1.0:
        return angle**3
    if kind == 4.0:
        return angle - slack - np.clip(angle - slack, -play, play)
    return np.maximum(angle - slack, 0.0) if kind > 0.0 else np.minimum(angle - slack, 0.0)


class _Cable(Simulated):
    def __init__(self, joint: int, values: Mapping[str, float]) -> None:
        self.joint, self.values = joint, values

    def load(self, time_s: float, plant: Any, loads: Any) -> None:
        angle, v = plant.position[self.joint], self.values
        torque = v["stiffness"] * pull(angle, v["kind"], v["slack"], v["play"])
        if v["kind"] == _HARDENING:
            torque += v["quadratic"] * angle**2 + v["cubic"] * angle**3
        loads.link_torque[self.joint] -= torque
