"""Causes in the joint torque sensor, seen in the joint torque only."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ident.effects.course import TIME_CONSTANT, Course, Drifting
from ident.effects.drive import gain_sentence
from ident.effects.effect import (
    Column,
    Effect,
    Experiment,
    Form,
    Law,
    Parameter,
    Parameters,
    Plant,
    Reading,
    Setting,
    Shape,
    Simulated,
    Variable,
)
from ident.effects.motion import Motion, dahl
from ident.effects.words import Values, one_joint, quantity, times, wave

__all__ = [
    "SensorCrosstalk",
    "SensorGain",
    "SensorHysteresis",
    "SensorOffsetDrift",
    "SensorRipple",
    "SensorSaturation",
]


class SensorGain(Effect):
    """The joint torque is reported `1 + error` times."""

    cause = "sensor_gain"
    side = "sensor"
    summary = "scale of the joint torque sensor"
    physics = "the strain gauges' bridge is calibrated wrongly"
    source = "Jubien, Gautier and Janot, IFAC 2014; Gautier and Briot, ICRA 2011"
    parameters = (Parameter("error", "1", "relative error of the scale", low=-0.9, high=2.0, share=True),)
    depends_on = "load"
    law = Law("load")
    confused_with = ("sensor_crosstalk", "payload_error", "sensor_saturation")
    experiment = Experiment.STATIC_POSES
    every_payload = True
    tell_apart = "static poses of joint {joint} with a weighed mass and without it"

    def columns(self, motion: Motion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """The predicted joint torque."""
        return (Column(joint=motion.joint_torque[:, joint]),)

    def simulate(self, joint: int, parameters: Parameters, form: str | Form | None = None) -> Simulated:
        """Scales the reported joint torque."""
        error = float(parameters["error"])

        def sense(time_s: float, plant: Plant, reading: Reading) -> None:
            reading.joint_torque[joint] *= 1.0 + error

        return Simulated(sense=sense)

    def sentence(self, values: Values, form: Form | None, names: Sequence[str]) -> list[str]:
        """Too much or too little."""
        return gain_sentence(values)


class SensorCrosstalk(Effect):
    """The sensor adds `factor` times the torque of the joint number `source`."""

    cause = "sensor_crosstalk"
    side = "sensor"
    summary = "the torque of another joint leaks in"
    physics = "the sensor bends under the torque of a neighbouring axis as well"
    source = "Hirzinger et al., ICRA 2002; Aksman, Carignan and Akin, ICRA 2007"
    parameters = (
        Parameter("factor", "1", "share of the other joint's torque", low=-0.5, high=0.5, share=True),
        Parameter("source", "1", "number of the other joint", shape=True),
    )
    depends_on = "load"
    confused_with = ("sensor_gain", "joint_zero_offset")
    experiment = Experiment.STATIC_POSES
    every_payload = True
    tell_apart = "load joint {joint} and the other one after another in static poses"

    def shapes(self, setting: Setting, joint: int) -> Sequence[Shape]:
        """All other joints."""
        return [Shape(source=k + 1) for k in range(len(setting.gear_ratio)) if k != joint]

    def continuous(self, shape: Shape) -> tuple[str, ...]:
        """A number of a joint is whole."""
        return ()

    def columns(self, motion: Motion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """The other joint's predicted torque."""
        return (Column(joint=motion.joint_torque[:, round(shape["source"]) - 1]),)

    def simulate(self, joint: int, parameters: Parameters, form: str | Form | None = None) -> Simulated:
        """Adds to the reported joint torque."""
        other, factor = round(float(parameters["source"])) - 1, float(parameters["factor"])

        def sense(time_s: float, plant: Plant, reading: Reading) -> None:
            reading.joint_torque[joint] += factor * plant.joint_torque[other]

        return Simulated(sense=sense)

    def sentence(self, values: Values, form: Form | None, names: Sequence[str]) -> list[str]:
        """Share and source."""
        source = one_joint(round(values["source"][0]), names)
        return [f"{quantity(values['factor'], share=True)} of the torque of {source}"]


class SensorHysteresis(Effect):
    """The sensor lags by up to `amplitude`, the lag turning over within the torque `width`."""

    cause = "sensor_hysteresis"
    side = "sensor"
    summary = "hysteresis of the joint torque sensor"
    physics = "screws and glue of the sensor slip a little, so loading and unloading curves differ"
    source = "Seyfferth, Maghzal and Angeles, ICRA 1995"
    parameters = (
        Parameter("amplitude", "Nm", "half the width of the loop", low=0.0),
        Parameter("width", "Nm", "torque in which the lag turns by 63 %", shape=True, low=0.1),
    )
    depends_on = "load"
    law = Law("load")
    evidence_factor = 3.0
    confused_with = ("joint_torque_delay", "sensor_ripple")
    experiment = Experiment.REVERSAL_LADDER
    tell_apart = "load joint {joint} quasi-statically up and down over its range, twice"

    def shapes(self, setting: Setting, joint: int) -> Sequence[Shape]:
        """From three to thirty per cent of the torque's range."""
        top = float(setting.torque_range[joint])
        return [Shape(width=share * top) for share in (0.03, 0.1, 0.3) if share * top > 0.1]

    def columns(self, motion: Motion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """Minus Dahl's state along the predicted torque."""
        return (
            Column(joint=-dahl(np.ascontiguousarray(motion.joint_torque[:, joint]), shape["width"], 0.0)),
        )

    def simulate(self, joint: int, parameters: Parameters, form: str | Form | None = None) -> Simulated:
        """Delays the reported joint torque."""
        return _Loop(joint, float(parameters["amplitude"]), float(parameters["width"]))


class _Loop(Simulated):
    def __init__(self, joint: int, amplitude: float, width: float) -> None:
        super().__init__()
        self.joint, self.amplitude, self.width = joint, amplitude, width
        self.state = 0.0
        self.before: float | None = None

    def sense(self, time_s: float, plant: Plant, reading: Reading) -> None:
        here = float(plant.joint_torque[self.joint])
        step = 0.0 if self.before is None else here - self.before
        self.before = here
        sign = 1.0 if step > 0.0 else -1.0
        self.state = sign - (sign - self.state) * float(np.exp(-abs(step) / self.width))
        reading.joint_torque[self.joint] -= self.amplitude * self.state


class _Clipping(Form):
    FITTED = "fitted", "limit"
    SEEN = "seen in the samples", "limit"


# Standard deviation of a limit read from the samples, over the limit.
_SHARP = 1e-3


class SensorSaturation(Effect):
    """Joint torques beyond `limit` are reported as the limit: a fitted one, or one where the samples stop."""

    cause = "sensor_saturation"
    side = "sensor"
    summary = "clipped torque"
    physics = "the amplifier of the sensor reaches its range"
    source = "Haddadin, De Luca and Albu-Schaeffer, IEEE Trans. Robotics 33 (2017)"
    parameters = (
        Parameter("share", "1", "share of the excess that is cut", low=0.2, high=1.3, share=True),
        Parameter("limit", "Nm", "largest torque that is reported", shape=True, low=1e-2),
    )
    forms = _Clipping
    depends_on = "load"
    law = Law("load")
    hidden = ("share",)
    confused_with = ("sensor_gain", "sensor_hysteresis")
    experiment = Experiment.STATIC_POSES
    tell_apart = "raise the load of joint {joint} slowly in a static pose until the reading stops"

    def shapes(self, setting: Setting, joint: int) -> Sequence[Shape]:
        """Where the samples stop, if they do; else from half to all of the predicted range."""
        if setting.clipped is not None and np.isfinite(setting.clipped[joint]):
            return [Shape(_Clipping.SEEN, limit=setting.clipped[joint])]
        top = float(setting.torque_range[joint])
        shares = (0.5, 0.65, 0.75, 0.85, 0.92, 0.97)
        return [Shape(_Clipping.FITTED, limit=share * top) for share in shares if top > 0.1]

    def continuous(self, shape: Shape) -> tuple[str, ...]:
        """The limit, unless the samples show it."""
        return () if self.seen_in_samples(shape) else ("limit",)

    def seen_in_samples(self, shape: Shape) -> bool:
        """Whether the samples stop at the limit."""
        return shape.form is _Clipping.SEEN

    def law_std(self, parameters: Parameters, form: Form | None) -> Parameters:
        """A limit that is read from the samples is as sure as an amplifier's end is sharp."""
        return {"limit": _SHARP * parameters["limit"]} if form is _Clipping.SEEN else {}

    def columns(self, motion: Motion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """The clipped part of the predicted torque."""
        torque = motion.joint_torque[:, joint]
        return (Column(joint=np.clip(torque, -shape["limit"], shape["limit"]) - torque),)

    def simulate(self, joint: int, parameters: Parameters, form: str | Form | None = None) -> Simulated:
        """Clips the reported joint torque."""
        limit = float(parameters["limit"])

        def sense(time_s: float, plant: Plant, reading: Reading) -> None:
            reading.joint_torque[joint] = min(limit, max(-limit, reading.joint_torque[joint]))

        return Simulated(sense=sense)

    def sentence(self, values: Values, form: Form | None, names: Sequence[str]) -> list[str]:
        """The limit."""
        seen = ["its samples stop there"] if form is _Clipping.SEEN else []
        return [f"reads no more than {quantity(values['limit'])}", *seen]


class SensorOffsetDrift(Drifting):
    """The sensor's zero moves by `drift`, beside a `zero` of all sessions."""

    cause = "sensor_offset_drift"
    side = "sensor"
    summary = "the zero of a sensor moves"
    physics = "the strain gauges' zero moves with temperature"
    source = "Hirzinger et al., ICRA 2002"
    parameters = (
        Parameter("drift", "Nm", "change of the zero"),
        Parameter("zero", "Nm", "of all sessions, against the reference"),
        *TIME_CONSTANT,
    )
    courses = (Course.WITHIN,)
    law = Law("time")
    confused_with = ("payload_change", "joint_zero_offset")
    experiment = Experiment.HOT_AND_COLD
    tell_apart = "hold one static pose for a minute at the start, in the middle and at the end of the session"

    def columns(self, motion: Motion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """The course of the zero."""
        return tuple(Column(joint=factor) for factor in self.course(motion, joint, shape))

    def simulate(self, joint: int, parameters: Parameters, form: str | Form | None = None) -> Simulated:
        """Shifts the reported joint torque."""

        def sense(time_s: float, plant: Plant, reading: Reading) -> None:
            reading.joint_torque[joint] += self.drift(parameters, form, time_s)

        return Simulated(sense=sense)


# Turns of the source of a ripple for a turn of the joint from which on it is the motor.
_MOTOR_TURNS = 1.5


class SensorRipple(Effect):
    """The sensor adds `cosine cos(k r q) + sine sin(k r q)`: r = 1 for the joint's angle, N for the motor's."""

    cause = "sensor_ripple"
    side = "sensor"
    summary = "sensor error periodic in the angle"
    physics = "the flexspline's ellipse passes under the strain gauges, or the sensor runs out of true"
    source = "Taghirad and Belanger, J. Dyn. Syst. Meas. Control 120 (1998); Hashimoto et al., 1993"
    parameters = (
        Parameter("cosine", "Nm", "torque with cos(k r q)"),
        Parameter("sine", "Nm", "torque with sin(k r q)"),
        Parameter("cycles_per_turn", "1", "k", shape=True),
        Parameter("ratio", "1", "r: turns of its source for a turn of the joint", shape=True),
    )
    depends_on = "position"
    law = Law("q")
    confused_with = ("gear_ripple", "cable_spring", "encoder_eccentricity")
    experiment = Experiment.SLOW_SWEEP
    tell_apart = "the same path of joint {joint} at two constant speeds below 0.1 rad/s and with two payloads"

    def shapes(self, setting: Setting, joint: int) -> Sequence[Shape]:
        """One to six cycles a turn of the joint (run-out, ellipse, spokes and bolts), one and two of the motor."""
        ratio = float(setting.gear_ratio[joint])
        own = [Shape(cycles_per_turn=k, ratio=1.0) for k in (1, 2, 3, 4, 5, 6)]
        return [*own, *(Shape(cycles_per_turn=k, ratio=ratio) for k in (1, 2) if ratio > 1.0)]

    def continuous(self, shape: Shape) -> tuple[str, ...]:
        """Cycles are whole numbers."""
        return ()

    def variable(self, parameters: Parameters) -> Variable:
        """The angle of the joint or of the motor."""
        return "motor angle" if parameters.get("ratio", 1.0) > _MOTOR_TURNS else "position"

    def columns(self, motion: Motion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """Cosine and sine."""
        angle = shape["cycles_per_turn"] * shape["ratio"] * motion.q[:, joint]
        return Column(joint=np.cos(angle)), Column(joint=np.sin(angle))

    def simulate(self, joint: int, parameters: Parameters, form: str | Form | None = None) -> Simulated:
        """Adds to the reported joint torque."""
        cosine, sine = self.coefficients_of(parameters)
        cycles = float(parameters["cycles_per_turn"]) * float(parameters["ratio"])

        def sense(time_s: float, plant: Plant, reading: Reading) -> None:
            angle = cycles * plant.position[joint]
            reading.joint_torque[joint] += cosine * np.cos(angle) + sine * np.sin(angle)

        return Simulated(sense=sense)

    def sentence(self, values: Values, form: Form | None, names: Sequence[str]) -> list[str]:
        """Amplitude and cycles."""
        turn = "a turn of the motor" if values["ratio"][0] > _MOTOR_TURNS else "a turn of the joint"
        return [f"{wave(values)}, {times(values['cycles_per_turn'][0])} {turn}"]
