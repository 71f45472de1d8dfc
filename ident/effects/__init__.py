"""Effects: physics that the linear model leaves out, one cause a class.

`EFFECTS` maps the name of each cause to its effect. An entry of a model's `effects` is a mapping
with `cause`,
`side`, `joints` (from 1; empty for the whole arm) and `parameters`, each with `value`, `std` and `unit`.
"""

from __future__ import annotations

import difflib

from fri.errors import ConfigurationError
from ident.effects.backlash import Backlash
from ident.effects.base_tilt import BaseTilt
from ident.effects.cable_spring import CableSpring
from ident.effects.contact import Contact
from ident.effects.effect import Column, Effect, Parameter, Setting, Shape, Simulated
from ident.effects.friction_asymmetry import FrictionAsymmetry
from ident.effects.friction_load import FrictionLoad
from ident.effects.friction_position import FrictionPosition
from ident.effects.friction_temperature import FrictionTemperature
from ident.effects.gear_ripple import GearRipple
from ident.effects.joint_elasticity import JointElasticity
from ident.effects.joint_torque_delay import JointTorqueDelay
from ident.effects.joint_zero_offset import JointZeroOffset
from ident.effects.lost_samples import LostSamples
from ident.effects.motion import Motion
from ident.effects.motor_torque_delay import MotorTorqueDelay
from ident.effects.motor_torque_gain import MotorTorqueGain
from ident.effects.payload_change import PayloadChange
from ident.effects.payload_error import PayloadError
from ident.effects.presliding_hysteresis import PreslidingHysteresis
from ident.effects.sensor_crosstalk import SensorCrosstalk
from ident.effects.sensor_gain import SensorGain
from ident.effects.sensor_hysteresis import SensorHysteresis
from ident.effects.sensor_offset_drift import SensorOffsetDrift
from ident.effects.sensor_ripple import SensorRipple
from ident.effects.sensor_saturation import SensorSaturation
from ident.effects.stribeck import Stribeck
from ident.effects.viscous_nonlinear import ViscousNonlinear

__all__ = [
    "EFFECTS",
    "Column",
    "Effect",
    "Motion",
    "Parameter",
    "Setting",
    "Shape",
    "Simulated",
    "find_effect",
]

EFFECTS: dict[str, Effect] = {
    effect.cause: effect
    for effect in (
        Stribeck(),
        ViscousNonlinear(),
        FrictionAsymmetry(),
        FrictionLoad(),
        FrictionTemperature(),
        FrictionPosition(),
        PreslidingHysteresis(),
        GearRipple(),
        MotorTorqueGain(),
        Backlash(),
        JointElasticity(),
        CableSpring(),
        BaseTilt(),
        PayloadError(),
        PayloadChange(),
        JointZeroOffset(),
        Contact(),
        SensorGain(),
        SensorCrosstalk(),
        SensorHysteresis(),
        SensorSaturation(),
        SensorOffsetDrift(),
        SensorRipple(),
        MotorTorqueDelay(),
        JointTorqueDelay(),
        LostSamples(),
    )
}


def find_effect(cause: str) -> Effect:
    """The effect of a cause. Raises ConfigurationError, with the nearest name, for an unknown one."""
    if cause not in EFFECTS:
        near = difflib.get_close_matches(cause, EFFECTS, n=1)
        advice = f"did you mean {near[0]!r}?" if near else f"known: {', '.join(EFFECTS)}"
        raise ConfigurationError(f"effect {cause!r} is unknown; {advice}")
    return EFFECTS[cause]
