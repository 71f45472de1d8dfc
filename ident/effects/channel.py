"""Causes in the recorded channels: errors of the joint torque sensor, late torques, lost samples."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import ClassVar

import numpy as np

from ident.effects.course import MOMENT, TIME_CONSTANT, Course, Drifting
from ident.effects.drive import ScaleError
from ident.effects.effect import (
    Column,
    Discriminator,
    Effect,
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
from ident.effects.friction import dahl_step
from ident.effects.motion import ArmMotion, Floats, dahl
from ident.effects.words import Values, one_joint, quantity, times, wave


class SensorGain(ScaleError):
    """The joint torque is reported `1 + error` times."""

    cause = "sensor_gain"
    side = "sensor"
    summary = "scale of the joint torque sensor"
    physics = "the strain gauges' bridge is calibrated wrongly"
    source = "Jubien, Gautier and Janot, IFAC 2014; Gautier and Briot, ICRA 2011"
    remembers = False
    confused_with = ("sensor_crosstalk", "payload_error", "sensor_saturation")

    def columns(self, motion: ArmMotion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """The predicted joint torque."""
        return (Column(joint=motion.joint_torque[:, joint]),)

    def sense(self, run: Simulated, time_s: float, plant: Plant, reading: Reading) -> None:
        """Scales the reported joint torque."""
        reading.joint_torque[run.joint] *= 1.0 + run.values["error"]


class SensorCrosstalk(Effect):
    """The sensor adds `factor` times the torque of the joint number `source`."""

    cause = "sensor_crosstalk"
    side = "sensor"
    summary = "the torque of another joint leaks in"
    physics = "the sensor bends under the torque of a neighbouring axis as well"
    source = "Hirzinger et al., ICRA 2002; Aksman, Carignan and Akin, ICRA 2007"
    parameters = (
        Parameter("factor", "1", "share of the other joint's torque", low=-0.5, high=0.5, share=True),
        Parameter("source", "1", "number of the other joint", shape=True, fixed=True),
    )
    depends_on = "load"
    confused_with = ("sensor_gain", "joint_zero_offset")
    experiment = Discriminator.STATIC_POSES
    every_payload = True
    tell_apart = "load joint {joint} and the other one after another in static poses"

    def shapes(self, setting: Setting, joint: int) -> Sequence[Shape]:
        """All other joints."""
        return [Shape(source=k + 1) for k in range(len(setting.gear_ratio)) if k != joint]

    def columns(self, motion: ArmMotion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """The other joint's predicted torque."""
        return (Column(joint=motion.joint_torque[:, round(shape["source"]) - 1]),)

    def sense(self, run: Simulated, time_s: float, plant: Plant, reading: Reading) -> None:
        """Adds to the reported joint torque."""
        other = plant.joint_torque[round(run.values["source"]) - 1]
        reading.joint_torque[run.joint] += run.values["factor"] * other

    def sentence(self, values: Values, form: Form | None, names: Sequence[str]) -> list[str]:
        """Share and source."""
        source = one_joint(round(values["source"][0]), names)
        return [f"{quantity(values['factor'], share=True)} of the torque of {source}"]


class SensorHysteresis(Effect):
    """The sensor lags by up to `amplitude`, with the lag reversing within the torque `width`."""

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
    experiment = Discriminator.REVERSAL_LADDER
    tell_apart = "load joint {joint} quasi-statically up and down over its range, twice"

    def shapes(self, setting: Setting, joint: int) -> Sequence[Shape]:
        """From three to thirty per cent of the torque's range."""
        top = float(setting.torque_range[joint])
        return [Shape(width=share * top) for share in (0.03, 0.1, 0.3) if share * top > 0.1]

    def columns(self, motion: ArmMotion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """Minus Dahl's state along the predicted torque."""

        def lag(whole: ArmMotion) -> Floats:
            return -dahl(np.ascontiguousarray(whole.joint_torque[:, joint]), shape["width"], 0.0)

        return (Column(joint=motion.along(lag, "lag", joint, shape["width"])),)

    def sense(self, run: Simulated, time_s: float, plant: Plant, reading: Reading) -> None:
        """Delays the reported joint torque."""
        state = dahl_step(run, float(plant.joint_torque[run.joint]), run.values["width"])
        reading.joint_torque[run.joint] -= run.values["amplitude"] * state


class _Clipping(Form):
    FITTED = "fitted", "limit"
    SEEN = "seen in the samples", "limit"


# Standard deviation of a limit read from the samples, over the limit.
_SHARP = 1e-3


class SensorSaturation(Effect):
    """Joint torques beyond `limit` are reported as the limit: a fitted one, or the end of the samples."""

    cause = "sensor_saturation"
    side = "sensor"
    summary = "clipped torque"
    physics = "the amplifier of the sensor reaches its range"
    source = "Haddadin, De Luca and Albu-Schaeffer, IEEE Trans. Robotics 33 (2017)"
    parameters = (
        Parameter("share", "1", "share of the excess that is cut", low=0.2, high=1.3, share=True),
        Parameter("limit", "Nm", "largest reported torque", shape=True, low=1e-2),
    )
    forms = _Clipping
    depends_on = "load"
    law = Law("load")
    hidden = ("share",)
    confused_with = ("sensor_gain", "sensor_hysteresis")
    experiment = Discriminator.STATIC_POSES
    tell_apart = "raise the load of joint {joint} slowly in a static pose until the reading stops"

    def shapes(self, setting: Setting, joint: int) -> Sequence[Shape]:
        """The end of the samples, if there is one; else from half to all of the predicted range."""
        if setting.clipped is not None and np.isfinite(setting.clipped[joint]):
            return [self.seen_at(float(setting.clipped[joint]))]
        top = float(setting.torque_range[joint])
        shares = (0.5, 0.65, 0.75, 0.85, 0.92, 0.97)
        return [Shape(_Clipping.FITTED, limit=share * top) for share in shares if top > 0.1]

    def seen_at(self, limit: float) -> Shape:
        """The shape of a limit [Nm] that the samples show."""
        return Shape(_Clipping.SEEN, limit=limit)

    def continuous(self, shape: Shape) -> tuple[str, ...]:
        """The limit, unless the samples show it."""
        return () if self.seen_in_samples(shape) else ("limit",)

    def seen_in_samples(self, shape: Shape) -> bool:
        """Whether the samples stop at the limit."""
        return shape.form is _Clipping.SEEN

    def law_std(self, parameters: Parameters, form: Form | None) -> Parameters:
        """Of a limit read from the samples: the sharpness of an amplifier's end."""
        return {"limit": _SHARP * parameters["limit"]} if form is _Clipping.SEEN else {}

    def plausible(self, coefficients: Floats, shape: Shape) -> bool:
        """Within its range; at a limit that the samples show, above it too. A model fitted to clipped torques predicts
        too little beyond the limit until the cause is in it."""
        low = self.linear[0].low
        return (
            bool(coefficients[0] > low)
            if self.seen_in_samples(shape)
            else super().plausible(coefficients, shape)
        )

    def columns(self, motion: ArmMotion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """The clipped part of the predicted torque."""
        torque = motion.joint_torque[:, joint]
        return (Column(joint=np.clip(torque, -shape["limit"], shape["limit"]) - torque),)

    def sense(self, run: Simulated, time_s: float, plant: Plant, reading: Reading) -> None:
        """Clips the reported joint torque."""
        limit = run.values["limit"]
        reading.joint_torque[run.joint] = min(limit, max(-limit, reading.joint_torque[run.joint]))

    def sentence(self, values: Values, form: Form | None, names: Sequence[str]) -> list[str]:
        """The limit."""
        seen = ["its samples stop there"] if form is _Clipping.SEEN else []
        return [f"reads no more than {quantity(values['limit'])}", *seen]


class SensorOffsetDrift(Drifting):
    """The sensor's zero moves by `drift`, beside a `zero` of all sessions."""

    cause = "sensor_offset_drift"
    side = "sensor"
    summary = "the zero of a sensor moves"
    physics = "the strain gauges' zero moves with temperature, and jumps by an overload or a loose contact"
    source = "Hirzinger et al., ICRA 2002"
    parameters = (
        Parameter("drift", "Nm", "change of the zero; of a steady one, in a minute"),
        Parameter("zero", "Nm", "of all sessions, against the reference"),
        *TIME_CONSTANT,
        *MOMENT,
    )
    together = True
    courses = (Course.WITHIN, Course.STEADY)
    singly = (Course.STEADY_IN_ONE,)
    onsets = (Course.STEP_WITHIN, Course.STEP_UNDONE)
    law = Law("time")
    confused_with = ("payload_change", "joint_zero_offset")
    experiment = Discriminator.HOT_AND_COLD
    tell_apart = "hold one static pose for a minute at the start, in the middle and at the end of the session"

    def columns(self, motion: ArmMotion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """The drift of the zero."""
        return tuple(Column(joint=factor) for factor in self.course(motion, joint, shape))

    def sense(self, run: Simulated, time_s: float, plant: Plant, reading: Reading) -> None:
        """Shifts the reported joint torque."""
        reading.joint_torque[run.joint] += self.drift(run.values, run.form, time_s)


# Least number of turns of a ripple's source for a turn of the joint to be the motor's.
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
        Parameter("cycles_per_turn", "1", "k", shape=True, fixed=True),
        Parameter("ratio", "1", "r: turns of its source for a turn of the joint", shape=True, fixed=True),
    )
    depends_on = "position"
    law = Law("q")
    confused_with = ("gear_ripple", "cable_spring", "encoder_eccentricity")
    experiment = Discriminator.SLOW_SWEEP
    tell_apart = "the same path of joint {joint} at two constant speeds below 0.1 rad/s and with two payloads"

    def shapes(self, setting: Setting, joint: int) -> Sequence[Shape]:
        """One to six cycles a turn of the joint (run-out, ellipse, spokes and bolts), one and two of the motor."""
        ratio = float(setting.gear_ratio[joint])
        own = [Shape(cycles_per_turn=k, ratio=1.0) for k in (1, 2, 3, 4, 5, 6)]
        return [*own, *(Shape(cycles_per_turn=k, ratio=ratio) for k in (1, 2) if ratio > 1.0)]

    def variable(self, parameters: Parameters) -> Variable:
        """The angle of the joint or of the motor."""
        return "motor angle" if parameters.get("ratio", 1.0) > _MOTOR_TURNS else "position"

    def columns(self, motion: ArmMotion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """Cosine and sine."""
        angle = shape["cycles_per_turn"] * shape["ratio"] * motion.q[:, joint]
        return Column(joint=np.cos(angle)), Column(joint=np.sin(angle))

    def sense(self, run: Simulated, time_s: float, plant: Plant, reading: Reading) -> None:
        """Adds to the reported joint torque."""
        cosine, sine = run.coefficients
        angle = run.values["cycles_per_turn"] * run.values["ratio"] * plant.position[run.joint]
        reading.joint_torque[run.joint] += cosine * np.cos(angle) + sine * np.sin(angle)

    def sentence(self, values: Values, form: Form | None, names: Sequence[str]) -> list[str]:
        """Amplitude and cycles."""
        turn = "a turn of the motor" if values["ratio"][0] > _MOTOR_TURNS else "a turn of the joint"
        return [f"{wave(values)}, {times(values['cycles_per_turn'][0])} {turn}"]


class _Delay(Effect):
    """The torques of a channel are `delay` older than the positions beside them."""

    side = "timing"
    source = "Swevers, Verdonck and De Schutter, IEEE Control Systems Magazine 27 (2007)"
    depends_on = "velocity"
    hidden = ("share",)
    whole_arm = True
    experiment = Discriminator.CHIRP
    tell_apart = "a 1 to 15 Hz chirp of one joint"
    parameters = (
        Parameter("share", "1", "late share of the torque", low=0.5, high=1.5, share=True),
        Parameter("delay", "s", "age of the torques", shape=True, low=-0.2, high=0.2),
    )
    grid_s: ClassVar[tuple[float, ...]]

    def shapes(self, setting: Setting, joint: int) -> Sequence[Shape]:
        """From a millisecond to thirty, late and early."""
        return [Shape(delay=sign * delay) for delay in self.grid_s for sign in (1.0, -1.0)]

    def late(self, motion: ArmMotion, torque: Callable[[ArmMotion], Floats], delay: float) -> Floats:
        """Torque (N, n) of `delay` before, minus that of now."""
        before, around = motion.time - delay, motion.around(delay)
        earlier = [np.interp(before, around.time, column) for column in torque(around).T]
        return np.column_stack(earlier) - torque(motion)

    def sense(self, run: Simulated, time_s: float, plant: Plant, reading: Reading) -> None:
        """Reports old joint torques."""
        if self.channel == "joint":
            _hold_back(run, reading.joint_torque)

    def sense_motor(self, run: Simulated, time_s: float, plant: Plant, reading: Reading) -> None:
        """Reports old motor torques."""
        if self.channel == "motor":
            _hold_back(run, reading.motor_torque)


def _hold_back(run: Simulated, torque: Floats) -> None:
    """Replace the torques of a simulated cycle by those of `delay` before."""
    cycles = max(0, round(1e3 * run.values["delay"]))
    run.state = [*(run.state or []), torque.copy()][-cycles - 1 :]
    torque[:] = run.state[0]


# Time in which friction reverses, about: a presliding length of 0.1 mrad at 5 rad/s^2.
_TURN_S = 5e-3


class MotorTorqueDelay(_Delay):
    """The motor torque is `delay` older than the positions beside it."""

    cause = "motor_torque_delay"
    summary = "motor torque late against the position"
    physics = "the motor torques take longer through the controller than the positions"
    channel = "motor"
    confused_with = ("presliding_hysteresis", "joint_elasticity")
    # Close enough for friction's reversals to overlap.
    grid_s = (0.001, 0.002, 0.004, 0.007, 0.011, 0.015, 0.021, 0.03)

    def columns(self, motion: ArmMotion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """Earlier minus present predicted torque, in all motor rows.

        Coulomb friction is in it for a delay longer than the friction's reversal. A shorter delay looks like another
        presliding length there.
        """
        with_jumps = abs(shape["delay"]) > _TURN_S

        def torque(one: ArmMotion) -> Floats:
            return one.motor_torque if with_jumps else one.smooth_torque("motor")

        return (Column(motor=self.late(motion, torque, shape["delay"])),)


class JointTorqueDelay(_Delay):
    """The joint torque is `delay` older than the positions beside it."""

    cause = "joint_torque_delay"
    summary = "joint torque late against the position"
    physics = "the joint torques take longer through the controller than the positions"
    channel = "joint"
    confused_with = ("sensor_hysteresis", "joint_elasticity")
    grid_s = (0.001, 0.002, 0.004, 0.008, 0.016, 0.032)

    def columns(self, motion: ArmMotion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """Earlier minus present predicted torque without the jumps at reversals, in all joint rows."""
        return (Column(joint=self.late(motion, lambda one: one.smooth_torque("joint"), shape["delay"])),)


class LostSamples(Effect):
    """A share of the samples of a channel repeats the one before, or is missing."""

    cause = "lost_samples"
    side = "timing"
    summary = "dropped, repeated or held samples"
    physics = "packets are lost, come twice, or a value is held on its way"
    source = "the channels themselves: equal values in a row, gaps of the counter"
    parameters = (Parameter("share", "1", "share of the samples", low=0.0, high=1.0, share=True),)
    depends_on = "time"
    whole_arm = True
    counted = True
    experiment = Discriminator.REPEATED_RUN
    tell_apart = "record at rest for ten seconds and look at the counter and at repeated values"

    def shapes(self, setting: Setting, joint: int) -> Sequence[Shape]:
        """None: seen in the channels, not in residuals."""
        return []

    def columns(self, motion: ArmMotion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """No torque of its own."""
        return (Column(motor=np.zeros_like(motion.q), joint=np.zeros_like(motion.q)),)

    def sense(self, run: Simulated, time_s: float, plant: Plant, reading: Reading) -> None:
        """Holds the reported joint torque for a cycle, at random."""
        if run.state is not None and run.random.random() < run.values["share"]:
            reading.joint_torque[:] = run.state
        run.state = reading.joint_torque.copy()
