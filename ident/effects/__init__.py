"""Effects: physics beyond the linear model, one cause a class.

`EFFECTS` maps the name of each cause to its effect. An entry of a model's `effects` is a mapping with `cause`, `side`,
`joints` (from 1; empty for the whole arm), `form` for an effect of several forms, and `parameters`, each with `value`,
`std` and `unit`.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from fri.errors import ConfigurationError
from ident.dynamics.structure import Side
from ident.effects import channel, drive, friction, link, load, nameless
from ident.effects.effect import (
    Column,
    Discriminator,
    Effect,
    Form,
    Law,
    Parameter,
    Parameters,
    Setting,
    Shape,
    Simulated,
)
from ident.effects.motion import ArmMotion, Floats
from ident.effects.words import Values, quantity, spoken

__all__ = [
    "BASE_TILT",
    "DELAYS",
    "ECCENTRICITY",
    "EFFECTS",
    "ELASTICITY",
    "FRICTION_TEMPERATURE",
    "LOST_SAMPLES",
    "MOTOR_GAIN",
    "NAMELESS",
    "PAYLOAD_CHANGE",
    "PAYLOAD_ERROR",
    "PRESLIDING",
    "SENSOR_GAIN",
    "SENSOR_SATURATION",
    "WEAR",
    "ZERO_OFFSET",
    "ArmMotion",
    "Column",
    "Discriminator",
    "Effect",
    "Form",
    "Law",
    "Parameter",
    "Parameters",
    "Setting",
    "Shape",
    "Simulated",
    "check_entry",
    "described",
    "effects_torque",
    "entry_of",
    "find_effect",
    "in_force",
    "parameter_values",
    "sized",
    "summary_of",
]

_ENTRY = frozenset({"cause", "side", "joints", "form", "parameters"})

FRICTION_TEMPERATURE = friction.FrictionTemperature()
PRESLIDING = friction.PreslidingHysteresis()
ELASTICITY = link.JointElasticity()
BASE_TILT = link.BaseTilt()
PAYLOAD_ERROR = load.PayloadError()
PAYLOAD_CHANGE = load.PayloadChange()
SENSOR_GAIN = channel.SensorGain()
SENSOR_SATURATION = channel.SensorSaturation()
ZERO_OFFSET = link.JointZeroOffset()
ECCENTRICITY = link.EncoderEccentricity()
MOTOR_GAIN = drive.MotorTorqueGain()
LOST_SAMPLES = channel.LostSamples()
DELAYS = {"motor": channel.MotorTorqueDelay(), "joint": channel.JointTorqueDelay()}
"""The effect of a late channel, by side."""

EFFECTS: dict[str, Effect] = {
    effect.cause: effect
    for effect in (
        friction.Stribeck(),
        friction.ViscousNonlinear(),
        friction.FrictionAsymmetry(),
        friction.FrictionLoad(),
        FRICTION_TEMPERATURE,
        friction.FrictionPosition(),
        PRESLIDING,
        drive.GearRipple(),
        MOTOR_GAIN,
        link.Backlash(),
        ELASTICITY,
        link.CableSpring(),
        BASE_TILT,
        PAYLOAD_ERROR,
        PAYLOAD_CHANGE,
        ZERO_OFFSET,
        ECCENTRICITY,
        load.Contact(),
        SENSOR_GAIN,
        channel.SensorCrosstalk(),
        channel.SensorHysteresis(),
        SENSOR_SATURATION,
        channel.SensorOffsetDrift(),
        channel.SensorRipple(),
        *DELAYS.values(),
        LOST_SAMPLES,
    )
}
"""The catalogue of causes by name."""

NAMELESS: dict[str, Effect] = {"motor": nameless.NamelessMotor(), "joint": nameless.NamelessJoint()}
"""Terms of a model without a name, by side; no causes."""

WEAR = "wear"
"""Name of a change of a drive's base parameters against the healthy arm: a cause without a torque of its own."""

_KNOWN = EFFECTS | {effect.cause: effect for effect in NAMELESS.values()}


def find_effect(cause: str) -> Effect:
    """The effect of a cause, or a term without a name. Raises ConfigurationError, with the nearest name, for an
    unknown one."""
    if cause not in _KNOWN:
        near = difflib.get_close_matches(cause, EFFECTS, n=1)
        advice = f"did you mean {near[0]!r}?" if near else f"known: {', '.join(EFFECTS)}"
        raise ConfigurationError(f"effect {cause!r} is unknown; {advice}")
    return _KNOWN[cause]


def summary_of(cause: str) -> str:
    """The fault in a few words; the name itself of a cause from a file of another version."""
    if cause == WEAR:
        return "friction or inertia of the drive changed against the healthy arm"
    return EFFECTS[cause].summary if cause in EFFECTS else spoken(cause)


def described(cause: str, values: Values, form: Any, names: Sequence[str]) -> str:
    """The parameters of a finding as a phrase.

    values : value, standard deviation and unit by name. form : of the effect, None for its only one. names : of the
    joints. A finding from a file of another version is listed as it stands.
    """
    if cause in EFFECTS:
        effect = EFFECTS[cause]
        try:
            return "; ".join(effect.sentence(values, effect.form_of(form), names))
        except (ConfigurationError, KeyError):
            return "; ".join(Effect.sentence(effect, values, None, names))
    if cause == WEAR:
        return ", ".join(f"{spoken(name)} {quantity(value, share=True)}" for name, value in values.items())
    return ", ".join(f"{spoken(name)} {value:.4g} {unit}" for name, (value, _, unit) in values.items())


def check_entry(entry: Mapping[str, Any], joints: int) -> None:
    """Check an entry of a model's effects: known cause and parameters, joints from 1 to `joints`.

    Raises ConfigurationError with the entry, the value and the allowed ones.
    """
    unknown = set(entry) - _ENTRY
    if unknown or not {"cause", "joints", "parameters"} <= set(entry):
        raise ConfigurationError(
            f"effect {dict(entry)!r}: an entry has the keys cause, side, joints, form if there are several, "
            "parameters, each with value, std, unit"
        )
    effect = find_effect(str(entry["cause"]))
    numbers = list(entry["joints"])
    if any(not isinstance(j, int) or not 1 <= j <= joints for j in numbers):
        raise ConfigurationError(f"effect {effect.cause}: joints {numbers} must lie between 1 and {joints}")
    if effect.whole_arm == bool(numbers):
        wanted = "no joint, for it belongs to the whole arm" if effect.whole_arm else "the joints it acts on"
        raise ConfigurationError(f"effect {effect.cause}: `joints` is {numbers}; give {wanted}")
    effect.check(entry["parameters"], entry.get("form"))


def entry_of(
    effect: Effect,
    joints: Sequence[int],
    values: Mapping[str, tuple[float, float]],
    form: str | None = None,
    *,
    prismatic: bool = False,
) -> dict[str, Any]:
    """An entry of a model's effects. joints : from 1. values : value and standard deviation by parameter.
    prismatic : whether the joint slides."""
    units = effect.units(form, prismatic=prismatic)
    return {
        "cause": effect.cause,
        "side": effect.side,
        "joints": list(joints),
        **({} if form is None else {"form": form}),
        "parameters": {
            name: {"value": float(value), "std": float(std), "unit": units[name]}
            for name, (value, std) in values.items()
            if name not in effect.hidden
        },
    }


def parameter_values(entry: Mapping[str, Any]) -> dict[str, float]:
    """Values of an entry's parameters by name."""
    return {
        name: float(value["value"] if isinstance(value, Mapping) else value)
        for name, value in entry["parameters"].items()
    }


def sized(entry: Mapping[str, Any], factor: float) -> Mapping[str, Any]:
    """An entry of a model's effects with `factor` times its torque."""
    linear = {p.name for p in find_effect(str(entry["cause"])).linear}
    values = {
        name: {**one, "value": factor * one["value"], "std": abs(factor) * one["std"]}
        if name in linear
        else one
        for name, one in entry["parameters"].items()
    }
    return entry if factor == 1.0 else {**entry, "parameters": values}


def in_force(
    entries: Iterable[Mapping[str, Any]], *, measured: bool = False
) -> Iterator[tuple[Effect, int, dict[str, float], Any]]:
    """Effect, joint (from 0), values and form of the entries that add to a torque, joint by joint.

    measured : with the errors of the sensors. Events (a contact, a loosened payload) and delayed channels are
    properties of a session, not of the arm, and are left out.
    """
    for entry in entries:
        effect = find_effect(str(entry["cause"]))
        if effect.event or effect.side == "timing" or (effect.side == "sensor" and not measured):
            continue
        values = parameter_values(entry)
        for joint in entry["joints"] or [1]:
            yield effect, int(joint) - 1, values, entry.get("form")


def effects_torque(
    entries: Iterable[Mapping[str, Any]], motion: ArmMotion, *, side: Side, measured: bool = False
) -> Floats:
    """Torque (N, n) [Nm] added to one side by the entries of a model's effects, see `in_force`."""
    total = np.zeros_like(motion.q)
    for effect, joint, values, form in in_force(entries, measured=measured):
        motor, link = effect.torque(motion, joint, values, form)
        total += motor if side == "motor" else link if side == "joint" else motor - link
    return total
