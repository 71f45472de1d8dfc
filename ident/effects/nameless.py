"""Terms without a name: a smooth function of known variables, fitted where no cause of the catalogue fits.

The function is piecewise linear over evenly spaced knots of one variable, constant beyond them, and may be scaled by a
second signal. Its form is the text `VARIABLE` or `VARIABLE FACTOR`: the variables `q3` (angle), `qd3` (speed of the
motor), `qdd3` (its acceleration), `load3` (predicted joint torque), the factors `sign(qd3)` and `load3`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from numba import njit

from fri.errors import ConfigurationError
from ident.effects.effect import (
    Column,
    Discriminator,
    Effect,
    EffectSide,
    Form,
    FormName,
    Loads,
    Parameter,
    Parameters,
    Plant,
    Reading,
    Shape,
    Simulated,
)
from ident.effects.motion import ArmMotion, Floats
from ident.effects.words import Values, quantity_text

KNOTS = 7
"""Number of knots of a function."""

_VARIABLE = re.compile(r"(qdd|qd|q|load)([1-9]\d*)")
_FACTOR = re.compile(r"sign\(qd([1-9]\d*)\)|load([1-9]\d*)")


def hats(values: Floats, low: float, high: float) -> Floats:
    """Piecewise linear functions (N, 7) of values (N,), with knots evenly from `low` to `high`, constant beyond."""
    found = np.zeros((len(values), KNOTS))
    _add_hats(knot_places(values, low, high), found)
    return found


def knot_places(values: Floats, low: float, high: float) -> Floats:
    """Places (N,) of values among the knots, from 0 to 6."""
    return np.asarray(np.clip((values - low) / (high - low), 0.0, 1.0) * (KNOTS - 1), dtype=np.float64)


@njit(cache=True, nogil=True)
def _add_hats(place, out):  # type: ignore[no-untyped-def]
    for k in range(len(place)):
        knot = min(int(place[k]), KNOTS - 2)
        out[k, knot] = 1.0 - (place[k] - knot)
        out[k, knot + 1] = place[k] - knot


def between_knots(value: Any, low: float, high: float, knots: Sequence[float]) -> Any:
    """The function of a number or of (N,): `knots[k]` at the evenly spaced knot k, constant beyond the outer ones."""
    place = (value - low) * ((KNOTS - 1) / (high - low))
    rises = (step * np.clip(place - k, 0.0, 1.0) for k, step in enumerate(np.diff(knots)))
    return sum(rises, np.float64(knots[0]))


class _Term(Simulated):
    """A term in a simulated arm; the acceleration is the change of the motors' speed in a cycle."""

    def __init__(self, effect: Effect, joint: int, values: Parameters, form: FormName) -> None:
        self.effect, self.joint, self.form = effect, joint, form
        self.values = {name: float(value) for name, value in values.items()}
        self.name, self.factor = _parts(str(form))
        self.knots = np.linspace(self.values["low"], self.values["high"], KNOTS)
        self.at_knots = np.array([self.values[f"value_{k + 1}"] for k in range(KNOTS)])
        self.speed: Floats | None = None
        self.acceleration = np.zeros(0)

    def start(self, joints: int, random: np.random.Generator) -> None:
        """Begin a run."""
        self.speed, self.acceleration = None, np.zeros(joints)

    def torque(self, plant: Plant) -> float:
        """Torque of the term in the present state [Nm]."""
        signals = {
            "q": plant.position,
            "qd": plant.motor_velocity,
            "qdd": self.acceleration,
            "load": plant.joint_torque,
        }
        kind, joint = _variable(self.name)
        value = float(np.interp(signals[kind][joint], self.knots, self.at_knots))
        if self.factor.startswith("sign"):
            return value * float(np.sign(plant.motor_velocity[_factor_joint(self.factor)]))
        return value * float(plant.joint_torque[_factor_joint(self.factor)]) if self.factor else value

    def load(self, time_s: float, plant: Plant, loads: Loads) -> None:
        """A torque at the motor."""
        if self.speed is not None:
            self.acceleration = (plant.motor_velocity - self.speed) / plant.cycle_s
        self.speed = plant.motor_velocity.copy()
        if self.effect.side == "motor":
            loads.motor_torque[self.joint] -= self.torque(plant)

    def sense(self, time_s: float, plant: Plant, reading: Reading) -> None:
        """A torque in the reading of the joint torque sensor."""
        if self.effect.side == "joint":
            reading.joint_torque[self.joint] += self.torque(plant)


class _Nameless(Effect):
    """A function of known variables in the torque of one side."""

    summary = "a torque without a name"
    physics = "unknown: the error of the model depends on these variables, and no cause of the catalogue explains it"
    source = "Hastie and Tibshirani, Generalized Additive Models (1990)"
    parameters = (
        *(Parameter(f"value_{k + 1}", "Nm", f"torque at knot {k + 1}") for k in range(KNOTS)),
        Parameter("low", "SI", "variable at the first knot", shape=True),
        Parameter("high", "SI", "variable at the last knot", shape=True),
    )
    depends_on = "position"
    experiment = Discriminator.SLOW_SWEEP
    tell_apart = "motions of joint {joint} in which these variables change one at a time"
    simulated: ClassVar[type[Simulated]] = _Term

    def form_of(self, name: FormName) -> Form | None:
        """None: the form is the text of its variables."""
        return None

    def check(self, parameters: Mapping[str, Any], form: FormName, *, whole: bool = False) -> None:
        """Raise ConfigurationError for unknown variables and wrong parameters."""
        _parts(str(form))
        super().check(parameters, None, whole=True)

    def columns(self, motion: ArmMotion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """None: a nameless term is no candidate."""
        return ()

    def weighted(
        self, motion: ArmMotion, joint: int, parameters: Parameters, form: FormName = None
    ) -> Iterator[tuple[float, Column]]:
        """The function as a column of its own."""
        name, factor = _parts(str(form))
        kind, at = _variable(name)
        signals = {
            "q": motion.q,
            "qd": motion.motor_speed,
            "qdd": motion.motor_acceleration,
            "load": motion.joint_torque,
        }
        knots = [parameters[f"value_{k + 1}"] for k in range(KNOTS)]
        value = between_knots(signals[kind][:, at], parameters["low"], parameters["high"], knots)
        if factor.startswith("sign"):
            value = value * motion.direction[:, _factor_joint(factor)]
        elif factor:
            value = value * motion.joint_torque[:, _factor_joint(factor)]
        yield 1.0, Column(motor=value) if self.side == "motor" else Column(joint=value)

    def sentence(self, values: Values, form: Form | None, names: Sequence[str]) -> list[str]:
        """Range of the torque and of the variable."""
        torques = [values[f"value_{k + 1}"] for k in range(KNOTS)]
        top = max(torques, key=lambda one: abs(one[0]))
        low, high = values["low"][0], values["high"][0]
        return [f"up to {quantity_text(*top)} between {low:.3g} and {high:.3g}"]


class NamelessMotor(_Nameless):
    """A function of known variables in the motor torque."""

    cause = "nameless_motor"
    side: ClassVar[EffectSide] = "motor"


class NamelessJoint(_Nameless):
    """A function of known variables in the joint torque."""

    cause = "nameless_joint"
    side: ClassVar[EffectSide] = "joint"


def _parts(form: str) -> tuple[str, str]:
    """Variable and factor of a form, the factor empty without one."""
    name, _, factor = form.partition(" ")
    if not _VARIABLE.fullmatch(name) or (factor and not _FACTOR.fullmatch(factor)):
        raise ConfigurationError(
            f"nameless term: `form` is {form!r}; give a variable such as q3, qd3, qdd3 or load3, and a factor "
            "sign(qd3) or load3 if there is one"
        )
    return name, factor


def _variable(name: str) -> tuple[str, int]:
    """Kind of a variable and its joint (from 0)."""
    match = _VARIABLE.fullmatch(name)
    assert match is not None
    return match[1], int(match[2]) - 1


def _factor_joint(factor: str) -> int:
    return int(re.sub(r"\D", "", factor)) - 1
