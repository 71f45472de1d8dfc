"""A spring between links: hoses and cables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ident.effects.effect import Column, Effect, Parameter, Setting, Shape, Simulated
from ident.effects.motion import Motion


class CableSpring(Effect):
    """Hoses and cables pull with `stiffness f(q)`: a spring, or one that is slack up to an angle.

    kind : 0 linear, 1 cubic, 2 taut above the angle `slack`, -2 taut below it.
    """

    cause = "cable_spring"
    side = "joint"
    physics = "hoses and cables along the arm are bent or stretched, and pull the link back"
    source = "Swevers, Verdonck and De Schutter, IEEE Control Systems Magazine 27 (2007)"
    parameters = (
        Parameter("stiffness", "Nm/rad", "of the spring (Nm/rad^3 for a cubic one)", low=0.0),
        Parameter("kind", "1", "0 linear, 1 cubic, 2 taut above `slack`, -2 taut below", shape=True),
        Parameter("slack", "rad", "angle at which the cable becomes taut", shape=True),
    )
    tell_apart = "the same slow sweep of joint {joint} in two postures of the other joints"

    def shapes(self, setting: Setting, joint: int) -> Sequence[Shape]:
        """Linear, cubic and one-sided springs."""
        low, high = setting.position_range[joint]
        angles = [float(low + share * (high - low)) for share in (0.3, 0.5, 0.7)]
        return [
            {"kind": 0.0, "slack": 0.0},
            {"kind": 1.0, "slack": 0.0},
            *({"kind": kind, "slack": angle} for kind in (2.0, -2.0) for angle in angles),
        ]

    def continuous(self, shape: Shape) -> tuple[str, ...]:
        """The angle of a one-sided spring."""
        return ("slack",) if abs(shape["kind"]) == 2.0 else ()

    def columns(self, motion: Motion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """The same torque on both sides."""
        force = pull(motion.q[:, joint], shape["kind"], shape["slack"])
        return (Column(motor=force, joint=force),)

    def simulate(self, joint: int, parameters: Mapping[str, float]) -> Simulated:
        """A torque on the link."""
        return _Cable(joint, *(float(parameters[p.name]) for p in self.parameters))


def pull(angle: Any, kind: float, slack: float) -> Any:
    """Torque of a unit stiffness at `angle` [rad], against which the arm has to work."""
    if kind == 0.0:
        return 1.0 * angle
    if kind == 1.0:
        return angle**3
    return np.maximum(angle - slack, 0.0) if kind > 0.0 else np.minimum(angle - slack, 0.0)


class _Cable(Simulated):
    def __init__(self, joint: int, stiffness: float, kind: float, slack: float) -> None:
        self.joint, self.stiffness, self.kind, self.slack = joint, stiffness, kind, slack

    def load(self, time_s: float, plant: Any, loads: Any) -> None:
        angle = plant.position[self.joint]
        loads.link_torque[self.joint] -= self.stiffness * pull(angle, self.kind, self.slack)
