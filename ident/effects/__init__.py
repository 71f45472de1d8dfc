"""Effects: physics beyond the linear model, one cause a class.

`EFFECTS` maps the name of each cause to its effect. An entry of a model's `effects` is a mapping with `cause`, `side`,
`joints` (from 1; empty for the whole arm), `form` for an effect of several forms, and `parameters`, each with `value`,
`std` and `unit`.
"""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from typing import Any

from fri.errors import ConfigurationError
from ident.effects import channel, drive, link, load
from ident.effects.effect import (
    Column,
    Effect,
    Experiment,
    Form,
    Law,
    Parameter,
    Parameters,
    Setting,
    Shape,
    Simulated,
)
from ident.effects.motion import Motion
from ident.effects.words import Values, spoken

__all__ = [
    "DELAYS",
    "EFFECTS",
    "ELASTICITY",
    "LOST_SAMPLES",
    "PRESLIDING",
    "ZERO_OFFSET",
    "Column",
    "Effect",
    "Experiment",
    "Form",
    "Law",
    "Motion",
    "Parameter",
    "Parameters",
    "Setting",
    "Shape",
    "Simulated",
    "described",
    "find_effect",
    "summary_of",
]

PRESLIDING = drive.PreslidingHysteresis()
ELASTICITY = link.JointElasticity()
ZERO_OFFSET = link.JointZeroOffset()
LOST_SAMPLES = channel.LostSamples()
DELAYS = {"motor": channel.MotorTorqueDelay(), "joint": channel.JointTorqueDelay()}
"""The effect of a late channel, by side."""

EFFECTS: dict[str, Effect] = {
    effect.cause: effect
    for effect in (
        drive.Stribeck(),
        drive.ViscousNonlinear(),
        drive.FrictionAsymmetry(),
        drive.FrictionLoad(),
        drive.FrictionTemperature(),
        drive.FrictionPosition(),
        PRESLIDING,
        drive.GearRipple(),
        drive.MotorTorqueGain(),
        link.Backlash(),
        ELASTICITY,
        link.CableSpring(),
        link.BaseTilt(),
        load.PayloadError(),
        load.PayloadChange(),
        ZERO_OFFSET,
        link.EncoderEccentricity(),
        load.Contact(),
        channel.SensorGain(),
        channel.SensorCrosstalk(),
        channel.SensorHysteresis(),
        channel.SensorSaturation(),
        channel.SensorOffsetDrift(),
        channel.SensorRipple(),
        *DELAYS.values(),
        LOST_SAMPLES,
    )
}


def find_effect(cause: str) -> Effect:
    """The effect of a cause. Raises ConfigurationError, with the nearest name, for an unknown one."""
    if cause not in EFFECTS:
        near = difflib.get_close_matches(cause, EFFECTS, n=1)
        advice = f"did you mean {near[0]!r}?" if near else f"known: {', '.join(EFFECTS)}"
        raise ConfigurationError(f"effect {cause!r} is unknown; {advice}")
    return EFFECTS[cause]


def summary_of(cause: str) -> str:
    """The fault in a few words; the name itself of a cause from a file of another version."""
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
    return ", ".join(f"{spoken(name)} {value:.4g} {unit}" for name, (value, _, unit) in values.items())
