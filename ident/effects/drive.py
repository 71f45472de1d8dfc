"""Causes in the drive, seen in the motor torque only: gear ripple, torque constant."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import ClassVar

import numpy as np

from ident.effects.effect import (
    Column,
    Discriminator,
    Effect,
    Form,
    Law,
    Loads,
    Parameter,
    Plant,
    Reading,
    Setting,
    Shape,
    Simulated,
)
from ident.effects.motion import ArmMotion, Floats
from ident.effects.words import Values, quantity, quantity_text, times, wave

# Largest ripple of the motor torque made by the controller, over the ripple of the sensor's reading.
_ANSWER = 0.4


class _Ripple(Form):
    BY_DIRECTION = (
        "by direction",
        *("cosine", "sine", "cosine_backward", "sine_backward"),
        *("cycles_per_turn", "gear_ratio", "delay", "compliance"),
    )


# Least phase of a ripple that is another one [rad].
_TURNED = 0.1
# Delays of a ripple to begin with [s].
_RIPPLE_DELAYS = (0.0, 0.01, 0.025, 0.045)


class GearRipple(Effect):
    """Motor torque `cosine cos(k N q) + sine sin(k N q)`, N the gear ratio, q the angle of the motor.

    Where the links' positions are published, the motor is ahead of its link by `compliance` times the joint torque.
    By direction, forward and backward motion have a cosine and a sine each, since the teeth touch with their other
    flanks, and the angle is that of `delay` ago, for a current that comes late.
    """

    cause = "gear_ripple"
    side = "motor"
    character = True
    summary = "torque periodic in the motor angle"
    physics = "the elliptic wave generator and the teeth give a torque with one or two cycles a motor turn"
    source = "Taghirad and Belanger, J. Dyn. Syst. Meas. Control 120 (1998)"
    parameters = (
        Parameter("cosine", "Nm", "torque with cos(k N q)"),
        Parameter("sine", "Nm", "torque with sin(k N q)"),
        Parameter("cosine_backward", "Nm", "in backward motion, if it differs by direction"),
        Parameter("sine_backward", "Nm", "in backward motion, if it differs by direction"),
        Parameter("cycles_per_turn", "1/turn of the motor", "k", shape=True, fixed=True),
        Parameter("gear_ratio", "1", "N", shape=True, fixed=True),
        Parameter("delay", "s", "of the ripple against the angle", shape=True, low=0.0, high=0.1),
        Parameter(
            "compliance",
            "rad/Nm",
            "twist of the joint between published link and motor",
            shape=True,
            optional=True,
            fixed=True,
        ),
    )
    forms = _Ripple
    plain = ("cosine", "sine", "cycles_per_turn", "gear_ratio", "compliance")
    depends_on = "motor angle"
    law = Law("q")
    confused_with = ("sensor_ripple", "friction_position", "motor_torque_delay")
    experiment = Discriminator.SLOW_SWEEP
    tell_apart = "the same path of joint {joint} both ways at two constant speeds below 0.1 rad/s and with two payloads"

    def shapes(self, setting: Setting, joint: int) -> Sequence[Shape]:
        """Once and twice a turn of the motor, in both directions alike, and apart with a delay."""
        ratio = float(setting.gear_ratio[joint])
        if ratio <= 1.0:
            return []
        twist = setting.motor_ahead(joint)
        elastic = {"compliance": twist} if twist > 0.0 else {}
        plain = [Shape(cycles_per_turn=k, gear_ratio=ratio).at(**elastic) for k in (1.0, 2.0)]
        delayed = product(plain, _RIPPLE_DELAYS)
        return [*plain, *(Shape(_Ripple.BY_DIRECTION, **one, delay=delay) for one, delay in delayed)]

    def columns(self, motion: ArmMotion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """Cosine and sine in the motor torque, of each direction if they differ."""
        here = motion.motor_angle(joint, shape.get("compliance", 0.0))
        late = shape.get("delay", 0.0) * motion.motor_speed[:, joint]
        angle = shape["cycles_per_turn"] * shape["gear_ratio"] * (here - late)
        waves = np.cos(angle), np.sin(angle)
        if shape.form is None:
            return tuple(Column(motor=one) for one in waves)
        forward = 0.5 * (1.0 + motion.direction[:, joint])
        return tuple(Column(motor=share * one) for share in (forward, 1.0 - forward) for one in waves)

    def follows_from(self, shape: Shape, coefficients: Floats, other: Effect, at: Shape, of: Floats) -> bool:
        """Whether the controller makes it from a larger ripple of the joint torque sensor's reading, or another zero of
        the joint turns the phase of the healthy one."""
        if other.cause == "joint_zero_offset":
            return shape["cycles_per_turn"] * shape["gear_ratio"] * float(np.abs(of[0])) > _TURNED
        if other.cause != "sensor_ripple":
            return False
        same = (shape["cycles_per_turn"], shape["gear_ratio"]) == (at["cycles_per_turn"], at["ratio"])
        return same and float(np.linalg.norm(coefficients)) < _ANSWER * float(np.linalg.norm(of))

    def load(self, run: Simulated, time_s: float, plant: Plant, loads: Loads) -> None:
        """A torque at the motor."""
        cosine, sine = run.coefficients[:2]
        speed = float(plant.motor_velocity[run.joint])
        if run.shape.form is not None:
            forward = 0.5 * (1.0 + np.sign(speed))
            cosine, sine = forward * run.coefficients[:2] + (1.0 - forward) * run.coefficients[2:]
        cycles = run.values["cycles_per_turn"] * run.values["gear_ratio"]
        angle = cycles * (plant.motor_position[run.joint] - run.values.get("delay", 0.0) * speed)
        loads.motor_torque[run.joint] -= cosine * np.cos(angle) + sine * np.sin(angle)

    def sentence(self, values: Values, form: Form | None, names: Sequence[str]) -> list[str]:
        """Amplitude and cycles."""
        often = f"{times(values['cycles_per_turn'][0])} a turn of the motor"
        if form is None:
            return [f"{wave(values)}, {often}"]
        back = {name: values[f"{name}_backward"] for name in ("cosine", "sine")}
        late = f"{quantity(values['delay'])} late"
        return [f"{wave(values)} forward, {wave(back)} backward with another phase, {often}, {late}"]


class ScaleError(Effect):
    """A torque is reported `1 + error` times too large."""

    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("error", "1", "relative error of the scale", low=-0.9, high=2.0, share=True),
    )
    depends_on = "load"
    law = Law("load", exact=True)
    experiment = Discriminator.STATIC_POSES
    every_payload = True
    usual_change = 0.01 / 3.0**0.5  # within a per cent, evenly
    tell_apart = "static poses of joint {joint} with a weighed mass and without it"

    def sentence(self, values: Values, form: Form | None, names: Sequence[str]) -> list[str]:
        """Too much or too little."""
        error, std, _ = values["error"]
        much = "much" if error > 0.0 else "little"
        return [f"reads {quantity_text(100.0 * abs(error), 100.0 * std, '1')} % too {much}"]


# Standard deviations from which a growth is told.
_CLEAR = 2.0


class _Constant(Form):
    SATURATING = "saturating", "error", "cubic"


class MotorTorqueGain(ScaleError):
    """The motor torque is reported `1 + error` times too large.

    Friction and drive inertia take up their share of the error; the load of the joint shows the rest. A saturating
    constant falls with the current: `1 + error + cubic tau^2` times too large.
    """

    cause = "motor_torque_gain"
    side = "motor"
    summary = "wrong torque constant"
    physics = "the constant between current and torque is wrong"
    source = "Gautier and Briot, ICRA 2011; Jubien, Gautier and Janot, IFAC 2014"
    parameters = (
        *ScaleError.parameters,
        Parameter("cubic", "1/Nm^2", "growth of the error with the torque squared", low=0.0),
    )
    forms = _Constant
    plain = ("error",)
    confused_with = ("friction_load", "sensor_gain", "friction_temperature")

    def shapes(self, setting: Setting, joint: int) -> Sequence[Shape]:
        """A constant error, and one that grows with the torque."""
        return [Shape(), Shape(_Constant.SATURATING)]

    def columns(self, motion: ArmMotion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """The predicted motor torque, and its cube."""
        torque = motion.motor_torque[:, joint]
        first = Column(motor=torque)
        return (first,) if shape.form is None else (first, Column(motor=torque**3))

    def sense_motor(self, run: Simulated, time_s: float, plant: Plant, reading: Reading) -> None:
        """Scales the reported motor torque."""
        torque = float(reading.motor_torque[run.joint])
        reading.motor_torque[run.joint] *= (
            1.0 + run.values["error"] + run.values.get("cubic", 0.0) * torque**2
        )

    def sentence(self, values: Values, form: Form | None, names: Sequence[str]) -> list[str]:
        """The error, and its growth where it is clear."""
        found = super().sentence(values, form, names)
        value, std, _ = values.get("cubic", (0.0, 0.0, ""))
        if abs(value) > _CLEAR * std:
            found.append(f"growing with the torque squared, {quantity(values['cubic'])}")
        return found
