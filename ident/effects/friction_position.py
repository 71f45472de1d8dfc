"""Friction that depends on the joint angle."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from fri.errors import ConfigurationError
from ident.effects.effect import Column, Effect, Parameter, Setting, Shape, Simulated
from ident.effects.motion import Floats, Motion


class FrictionPosition(Effect):
    """Coulomb friction varies as `cosine cos(k q) + sine sin(k q)` over the joint angle; or, with k = 0, in a spot:
    by `cosine (1 + cos(pi (q - centre) / reach)) / 2` within `reach` of `centre`.
    """

    cause = "friction_position"
    side = "motor"
    physics = "a gear or bearing that runs out of true, or is worn in a spot, grips more at some angles of the joint"
    source = "Armstrong-Helouvry, Control of Machines with Friction (1991), chapter 4"
    parameters = (
        Parameter("cosine", "Nm", "Coulomb friction with cos(k q), or at the centre of a spot"),
        Parameter("sine", "Nm", "Coulomb friction with sin(k q)"),
        Parameter("cycles_per_turn", "1", "k; 0: a spot", shape=True),
        Parameter("centre", "rad", "of a spot", shape=True),
        Parameter("reach", "rad", "of a spot, to either side", shape=True, low=0.1, high=1.5),
    )
    optional = ("sine", "centre", "reach")
    tell_apart = (
        "a slow sweep of joint {joint} over its whole range, both ways, in two postures of the others"
    )

    def shapes(self, setting: Setting, joint: int) -> Sequence[Shape]:
        """One to four cycles a turn, and spots all over the range."""
        waves = [{"cycles_per_turn": float(k)} for k in (1, 2, 3, 4)]
        low, high = (float(limit) for limit in setting.position_range[joint])
        spots = [
            {"cycles_per_turn": 0.0, "centre": float(centre), "reach": reach}
            for reach in _REACHES
            if reach < high - low
            for centre in np.linspace(low, high, _places(high - low, reach))
        ]
        return [*waves, *spots]

    def continuous(self, shape: Shape) -> tuple[str, ...]:
        """Place and size of a spot; cycles are whole numbers."""
        return ("centre", "reach") if shape["cycles_per_turn"] == 0.0 else ()

    def columns(self, motion: Motion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """sign(v) cos(k q) and sign(v) sin(k q), or sign(v) in the spot, in the motor torque."""
        sign = motion.direction[:, joint]
        return tuple(Column(motor=sign * form) for form in _forms(motion.q[:, joint], shape))

    def simulate(self, joint: int, parameters: Mapping[str, float]) -> Simulated:
        """Changes the Coulomb friction of the drive. Raises ConfigurationError for a spot without a reach."""
        if parameters["cycles_per_turn"] == 0.0 and not parameters.get("reach", 0.0) > 0.0:
            raise ConfigurationError(
                f"{self.cause}: `cycles_per_turn` is 0, a spot, and `reach` is "
                f"{parameters.get('reach', 0.0):g} rad; give how far from `centre` it reaches"
            )
        return _Position(joint, self.coefficients_of(parameters), self.shape_of(parameters))


# Reaches of spots to begin with [rad], and how far apart they are tried, over their reach.
_REACHES, _APART = (0.4, 0.9), 0.5


def _places(span: float, reach: float) -> int:
    """Number of spots side by side in a range of angles."""
    return 1 + int(np.ceil(span / (_APART * reach)))


def _forms(angle: Any, shape: Shape) -> tuple[Any, ...]:
    """What the coefficients of a shape multiply, at `angle` [rad]."""
    cycles = shape["cycles_per_turn"]
    if cycles == 0.0:
        away = np.clip((angle - shape["centre"]) / shape["reach"], -1.0, 1.0)
        return (0.5 * (1.0 + np.cos(np.pi * away)),)
    return np.cos(cycles * angle), np.sin(cycles * angle)


class _Position(Simulated):
    def __init__(self, joint: int, coefficients: Floats, shape: Shape) -> None:
        self.joint, self.coefficients, self.shape = joint, coefficients, shape

    def load(self, time_s: float, plant: Any, loads: Any) -> None:
        forms = _forms(plant.motor_position[self.joint], self.shape)
        change = sum(c * form for c, form in zip(self.coefficients, forms, strict=False))
        loads.Fcm[self.joint] = max(0.0, loads.Fcm[self.joint] + change)
