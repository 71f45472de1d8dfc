"""Friction of a drive, seen in the motor torque only: by speed, before sliding, by load, place and warmth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ident.effects.course import TIME_CONSTANT, Course, Drifting
from ident.effects.effect import (
    Column,
    Discriminator,
    Effect,
    Form,
    Law,
    Loads,
    Parameter,
    Plant,
    Setting,
    Shape,
    Simulated,
)
from ident.effects.motion import ArmMotion, Floats, dahl_after, turned_friction
from ident.effects.words import Values, quantity, quantity_text, times, wave

# Usual standard deviation of an effect of friction from day to day as a share of it: films depend on everything.
_FRICTION = 0.2


def dahl_step(run: Simulated, here: float, length: float) -> float:
    """Dahl's state of a simulated effect at the coordinate `here`, one cycle later."""
    state, before = run.state or (0.0, here)
    run.state = float(dahl_after(state, here - before, length)), here
    return float(run.state[0])


# Longest way in which the friction of a drive is known to turn [rad].
_LONGEST = 0.1


class _Turning(Form):
    SMOOTH = "smooth in speed", "amplitude", "velocity"


class PreslidingHysteresis(Effect):
    """Part of the Coulomb friction is Dahl's: it reverses within a sliding distance, not at once.

    Smooth in speed, that part is `amplitude tanh(v / velocity)`: a film that creeps, without friction at standstill.
    """

    cause = "presliding_hysteresis"
    side = "motor"
    character = True
    summary = "hysteresis around reversals"
    physics = "asperities bend before they slide, so friction turns over a distance after each reversal"
    source = "Dahl, AIAA Journal 14 (1976); Swevers et al., IEEE Trans. Autom. Control 45 (2000)"
    remembers = False
    parameters = (
        Parameter("amplitude", "Nm", "Coulomb friction that turns over slowly", low=0.0),
        Parameter("length", "rad", "distance in which it turns by 63 %", shape=True, low=1e-5, high=0.5),
        Parameter("velocity", "rad/s", "speed with 76 % of it", shape=True, low=2e-3, high=0.3),
    )
    forms = _Turning
    plain = ("amplitude", "length")
    depends_on = "velocity"
    evidence_factor = 2.0
    confused_with = ("stribeck", "backlash", "motor_torque_delay")
    experiment = Discriminator.REVERSAL_LADDER
    tell_apart = "reversals of joint {joint} at three accelerations and amplitudes (0.5, 2 and 10 mrad)"

    def shapes(self, setting: Setting, joint: int) -> Sequence[Shape]:
        """From half a milliradian, or ten times the presliding length of the model, to more than of any drive."""
        least = self.least(setting, joint).get("length", 0.0)
        lengths = [Shape(length=x) for x in (5e-4, 1.5e-3, 5e-3, 1.5e-2, 5e-2, 0.15) if x >= least]
        return [*lengths, *(Shape(_Turning.SMOOTH, velocity=v) for v in (0.01, 0.025, 0.06))]

    def familiar(self, shape: Shape, coefficients: Floats, setting: Setting, joint: int) -> bool:
        """Whether it turns over a tenth of a radian at most: what lasts longer is a memory of the speed."""
        return shape.get("length", 0.0) <= _LONGEST

    def least(self, setting: Setting, joint: int) -> Mapping[str, float]:
        """A length near that of the healthy drive is a small change of the latter, not another friction; a film that
        shows at a standstill alone is that of any drive at rest."""
        found = {"velocity": setting.standstill_rad_s}
        if setting.presliding is not None:
            found["length"] = 10.0 * float(setting.presliding[joint])
        return found

    def columns(self, motion: ArmMotion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """Dahl's state, or the hyperbolic tangent of the speed, less sign(v) in the motor torque."""
        if shape.form is _Turning.SMOOTH:
            speed = motion.motor_speed[:, joint]
            return (Column(motor=np.tanh(speed / shape["velocity"]) - motion.direction[:, joint]),)

        def turning(whole: ArmMotion) -> Floats:
            speed = whole.motor_speed[:, joint]
            return turned_friction(np.cumsum(speed) * whole.dt, speed, shape["length"])

        state = motion.along(turning, "turning", joint, shape["length"])
        return (Column(motor=state - motion.direction[:, joint]),)

    def load(self, run: Simulated, time_s: float, plant: Plant, loads: Loads) -> None:
        """Moves the amplitude from the set-valued friction to Dahl's: the drive's, then that of the link, which holds
        both where no joint torque was measured."""
        joint, amplitude = run.joint, run.values["amplitude"]
        loads.Fcl[joint] = max(0.0, loads.Fcl[joint] - max(0.0, amplitude - loads.Fcm[joint]))
        loads.Fcm[joint] = max(0.0, loads.Fcm[joint] - amplitude)
        if run.shape.form is _Turning.SMOOTH:
            # As a viscous friction it is integrated with the speed, stable for any slope.
            speed, slow = float(plant.motor_velocity[joint]), run.values["velocity"]
            secant = np.tanh(speed / slow) / speed if abs(speed) > 1e-6 * slow else 1.0 / slow
            loads.Fvm[joint] += amplitude * secant
            return
        state = dahl_step(run, float(plant.motor_position[joint]), run.values["length"])
        loads.motor_torque[joint] -= amplitude * state


class Stribeck(Effect):
    """Coulomb friction gains `amplitude exp(-(|v| / velocity)^exponent)` near standstill."""

    cause = "stribeck"
    side = "motor"
    usual_share = _FRICTION
    # At standstill at most twice the Coulomb level.
    largest_share = 0.5
    character = True
    summary = "friction rises as the velocity falls towards zero"
    physics = "the lubricant film breaks down at low speed, so friction rises as the speed falls towards zero"
    source = "Armstrong-Helouvry, Dupont and Canudas de Wit, Automatica 30 (1994)"
    parameters = (
        Parameter("amplitude", "Nm", "friction at standstill above the Coulomb level", low=0.0),
        Parameter("velocity", "rad/s", "speed at which 1/e of it is left", shape=True, low=1e-3, high=1.0),
        Parameter("exponent", "1", "1: Tustin, 2: Gauss", shape=True, low=0.5, high=3.0, optional=True),
    )
    depends_on = "velocity"
    law = Law("qd")
    beside_companions = True
    confused_with = ("viscous_nonlinear", "presliding_hysteresis", "friction_load")
    experiment = Discriminator.SLOW_SWEEP
    tell_apart = "a slow constant-velocity sweep of joint {joint} through 0.01 to 0.2 rad/s"

    def shapes(self, setting: Setting, joint: int) -> Sequence[Shape]:
        """Speeds between those of the slowest and the fastest rows."""
        slowest, fastest = setting.standstill_rad_s, setting.speed_range[joint]
        speeds = [v for v in (0.01, 0.02, 0.04, 0.08, 0.16, 0.3) if slowest <= v < fastest]
        return [Shape(velocity=v, exponent=e) for e in (1.0, 2.0) for v in speeds]

    def least(self, setting: Setting, joint: int) -> Mapping[str, float]:
        """Of a fall below the slowest rows these show the foot alone: the rest of it would be made up."""
        return {"velocity": setting.standstill_rad_s}

    def columns(self, motion: ArmMotion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """sign(v) exp(-(|v| / velocity)^exponent) in the motor torque."""
        speed = motion.motor_speed[:, joint]
        fall = np.exp(-((np.abs(speed) / shape["velocity"]) ** shape.get("exponent", 1.0)))
        return (Column(motor=motion.direction[:, joint] * fall),)

    def companions(self, motion: ArmMotion, joint: int, setting: Setting) -> tuple[Column, ...]:
        """Bristles with a higher load at low speed are no stiffer: they bend further before they slip."""
        turning = PreslidingHysteresis()
        shapes = [shape for shape in turning.shapes(setting, joint) if shape.form is None]
        return tuple(column for shape in shapes for column in turning.columns(motion, joint, shape))

    def load(self, run: Simulated, time_s: float, plant: Plant, loads: Loads) -> None:
        """Raises the Coulomb friction of the drive."""
        values, speed = run.values, abs(plant.motor_velocity[run.joint])
        fall = np.exp(-((speed / values["velocity"]) ** values.get("exponent", 1.0)))
        loads.Fcm[run.joint] += values["amplitude"] * fall


class ViscousNonlinear(Effect):
    """Friction `coefficient |v|^exponent sign(v)` beside the linear viscous one.

    It bends the curve of the viscous friction; friction falling with rising speed is Stribeck's.
    """

    cause = "viscous_nonlinear"
    side = "motor"
    usual_share = _FRICTION
    character = True
    summary = "viscous friction is not proportional to velocity"
    physics = "the lubricant thins under shear, so viscous friction grows slower (or faster) than the speed"
    source = "Wolf and Iskandar, ICRA 2018; Tjahjowidodo et al., Mech. Mach. Theory 2013"
    parameters = (
        Parameter("coefficient", "Nm (s/rad)^exponent", "friction at 1 rad/s beside the linear one"),
        Parameter("exponent", "1", "power of the speed", shape=True, low=0.2, high=4.0),
    )
    depends_on = "velocity"
    law = Law("qd")
    confused_with = ("stribeck", "friction_temperature")
    experiment = Discriminator.SLOW_SWEEP
    tell_apart = "a staircase of constant speeds of joint {joint} up to its limit, in random order"

    def shapes(self, setting: Setting, joint: int) -> Sequence[Shape]:
        """Powers below and above one."""
        return [Shape(exponent=p) for p in (0.4, 0.6, 0.8, 1.25, 1.6, 2.0, 3.0)]

    def columns(self, motion: ArmMotion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """sign(v) |v|^exponent in the motor torque."""
        speed = motion.motor_speed[:, joint]
        return (Column(motor=np.sign(speed) * np.abs(speed) ** shape["exponent"]),)

    def plausible(self, coefficients: Floats, shape: Shape) -> bool:
        """Whether friction rises from standstill on."""
        rises = shape["exponent"] > 1.0 or bool(coefficients[0] > 0.0)
        return super().plausible(coefficients, shape) and rises

    def load(self, run: Simulated, time_s: float, plant: Plant, loads: Loads) -> None:
        """A resisting torque at the motor."""
        speed = plant.motor_velocity[run.joint]
        signed = run.values["coefficient"] * np.sign(speed)
        loads.motor_torque[run.joint] -= signed * abs(speed) ** run.values["exponent"]

    def sentence(self, values: Values, form: Form | None, names: Sequence[str]) -> list[str]:
        """The curve, and the power law."""
        (coefficient, std, _), (exponent, spread, _) = values["coefficient"], values["exponent"]
        slower = (coefficient > 0.0) == (exponent < 1.0)
        power = quantity_text(exponent, spread, "1")
        size = quantity_text(coefficient, std, "Nm")
        return [
            f"the drag grows {'slower' if slower else 'faster'} than the speed",
            f"beside the linear term {size} at 1 rad/s with the power {power} of the speed",
        ]


class _Asymmetric(Form):
    VISCOUS = "viscous", "viscous"
    VISCOUS_AND_COULOMB = "viscous and Coulomb", "viscous", "coulomb"


class FrictionAsymmetry(Effect):
    """Friction larger one way than the other: `viscous |v| + coulomb`.

    The Coulomb part is a constant torque, taken up by the drive's offset; without a reference only the viscous part
    shows.
    """

    cause = "friction_asymmetry"
    side = "motor"
    usual_share = _FRICTION
    character = True
    summary = "friction depends on the direction"
    physics = "gear teeth and bearings engage differently in the two directions"
    source = "Armstrong-Helouvry, Control of Machines with Friction (1991)"
    parameters = (
        Parameter("viscous", "Nm s/rad", "half the difference of the viscous friction of both ways"),
        Parameter("coulomb", "Nm", "half the difference of the Coulomb friction; 0 without a reference"),
    )
    forms = _Asymmetric
    depends_on = "velocity"
    law = Law("qd")
    confused_with = ("friction_position", "motor_torque_gain")
    experiment = Discriminator.SLOW_SWEEP
    tell_apart = "the same constant-speed sweep of joint {joint} both ways, twice"

    def shapes(self, setting: Setting, joint: int) -> Sequence[Shape]:
        """The viscous part alone, and both."""
        return [Shape(form) for form in _Asymmetric]

    def columns(self, motion: ArmMotion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """|v| in the motor torque, and a constant."""
        viscous = Column(motor=np.abs(motion.motor_speed[:, joint]))
        if shape.form is _Asymmetric.VISCOUS:
            return (viscous,)
        # Constant at reversals, too: as much as has built up there is a bump, which other causes make as well.
        return viscous, Column(motor=np.ones(len(motion.q)))

    def load(self, run: Simulated, time_s: float, plant: Plant, loads: Loads) -> None:
        """A torque at the motor."""
        viscous, coulomb = run.coefficients
        loads.offm[run.joint] += coulomb
        loads.motor_torque[run.joint] -= viscous * abs(plant.motor_velocity[run.joint])

    def sentence(self, values: Values, form: Form | None, names: Sequence[str]) -> list[str]:
        """Both parts, as far as they are seen."""
        parts = [f"viscous {quantity(values['viscous'])}"]
        if form is _Asymmetric.VISCOUS_AND_COULOMB:
            parts.append(f"Coulomb {quantity(values['coulomb'])}")
        return [", ".join(parts) + " of half difference"]


class FrictionLoad(Effect):
    """Friction `factor |tau_l| sign(v)`."""

    cause = "friction_load"
    side = "motor"
    usual_share = _FRICTION
    character = True
    summary = "friction grows with the transmitted torque"
    physics = (
        "the load presses the gear teeth together, so Coulomb friction grows with the transmitted torque"
    )
    source = (
        "Hamon, Gautier and Garrec, IROS 2010; Bittencourt and Gunnarsson, J. Dyn. Syst. Meas. Control 2012"
    )
    parameters = (
        Parameter("factor", "1", "Coulomb friction per transmitted torque", low=0.0, high=1.0, share=True),
    )
    depends_on = "load"
    law = Law("load", signed=True)
    confused_with = ("friction_position", "motor_torque_gain", "stribeck")
    experiment = Discriminator.SLOW_SWEEP
    every_payload = True
    tell_apart = "a slow back and forth of joint {joint} with gravity for and against, with two payloads"

    def columns(self, motion: ArmMotion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """|tau_l| sign(v) in the motor torque."""
        return (Column(motor=np.abs(motion.joint_torque[:, joint]) * motion.direction[:, joint]),)

    def load(self, run: Simulated, time_s: float, plant: Plant, loads: Loads) -> None:
        """Raises the Coulomb friction of the drive."""
        loads.Fcm[run.joint] += run.values["factor"] * abs(plant.joint_torque[run.joint])


class FrictionTemperature(Drifting):
    """Drive friction times `1 + change w`, with w from 0 to 1 as the drive warms up.

    Within a session w starts anew in each: as 1 - exp(-t / time_constant), or heated by the power of the friction
    itself, `time_constant w' = P / P1 - w` with P1 the power at 1 rad/s; carried over, w keeps its value from session
    to session and falls in the pauses. Between sessions w is 1 from the session `since` on, beside a `level` of all
    sessions; against a reference it is 1 in all.
    """

    cause = "friction_temperature"
    side = "motor"
    usual_share = _FRICTION
    character = True
    summary = "friction drifts as the joint warms up"
    physics = "the lubricant thins as it warms up, so friction drifts with the time in use"
    source = "Bittencourt, Wernholt, Sander-Tavallaey and Brogardh, IROS 2010; Simoni et al., Robotica 2017"
    parameters = (
        Parameter("change", "1", "relative change, cold to warm", low=-0.9, high=2.0, share=True),
        Parameter(
            "level", "1", "the same in all sessions, from the reference", low=-0.9, high=2.0, share=True
        ),
        *TIME_CONSTANT,
    )
    courses = (Course.WITHIN, Course.HEATED, Course.CARRIED)
    law = Law("time", signed=True)
    confused_with = ("viscous_nonlinear", "motor_torque_gain")
    experiment = Discriminator.HOT_AND_COLD
    tell_apart = (
        "the same speed staircase of joint {joint} cold, after twenty minutes, and after a pause of twenty more, in "
        "random order"
    )

    def columns(self, motion: ArmMotion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """The model's friction times w in the motor torque."""
        friction = motion.drive_friction[:, joint]
        return tuple(Column(motor=friction * factor) for factor in self.course(motion, joint, shape))

    def load(self, run: Simulated, time_s: float, plant: Plant, loads: Loads) -> None:
        """Scales the friction of the drive."""
        joint = run.joint
        factor = 1.0 + self.drift(run.values, run.form, time_s)
        if run.shape.form in (Course.HEATED, Course.CARRIED):
            change, level = run.coefficients
            coulomb, viscous = loads.Fcm[joint], loads.Fvm[joint]
            speed = abs(float(plant.motor_velocity[joint]))
            power = (coulomb + viscous * speed) * speed / max(coulomb + viscous, 1e-9)
            warmth = run.state or 0.0
            run.state = warmth + (power - warmth) * plant.cycle_s / run.values["time_constant"]
            factor = 1.0 + change * run.state + level
        loads.Fcm[joint] *= factor
        loads.Fvm[joint] *= factor


class _Place(Form):
    WAVE = "wave", "cosine", "sine", "cycles_per_turn"
    SPOT = "spot", "cosine", "centre", "half_width"


# Half widths of spots to begin with [rad], and how far apart they are tried, over their half width.
_HALF_WIDTHS, _APART = (0.4, 0.9), 0.5


class FrictionPosition(Effect):
    """Coulomb friction varies with the joint angle: as a wave, `cosine cos(k q) + sine sin(k q)`, or in a spot, by
    `cosine (1 + cos(pi (q - centre) / half_width)) / 2` within `half_width` of `centre`.
    """

    cause = "friction_position"
    side = "motor"
    usual_share = _FRICTION
    summary = "friction depends on the joint angle"
    physics = "a gear or bearing with run-out or a worn spot grips more at some angles of the joint"
    source = "Armstrong-Helouvry, Control of Machines with Friction (1991), chapter 4"
    parameters = (
        Parameter("cosine", "Nm", "Coulomb friction with cos(k q), or at the centre of a spot"),
        Parameter("sine", "Nm", "Coulomb friction with sin(k q)"),
        Parameter("cycles_per_turn", "1", "k, of a wave", shape=True, fixed=True),
        Parameter("centre", "rad", "of a spot", shape=True),
        Parameter("half_width", "rad", "of a spot", shape=True, low=0.1, high=1.5),
    )
    forms = _Place
    depends_on = "position"
    law = Law("q", signed=True)
    confused_with = ("friction_load", "friction_asymmetry", "cable_spring")
    experiment = Discriminator.SLOW_SWEEP
    tell_apart = (
        "a slow sweep of joint {joint} over its whole range, both ways, in two postures of the others"
    )

    def shapes(self, setting: Setting, joint: int) -> Sequence[Shape]:
        """One to four cycles a turn, and spots all over the range."""
        low, high = (float(limit) for limit in setting.position_range[joint])
        spots = [
            Shape(_Place.SPOT, centre=float(centre), half_width=width)
            for width in _HALF_WIDTHS
            if width < high - low
            for centre in np.linspace(low, high, 1 + int(np.ceil((high - low) / (_APART * width))))
        ]
        return [*(Shape(_Place.WAVE, cycles_per_turn=k) for k in (1, 2, 3, 4)), *spots]

    def columns(self, motion: ArmMotion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """sign(v) cos(k q) and sign(v) sin(k q), or sign(v) in the spot, in the motor torque."""
        sign = motion.direction[:, joint]
        return tuple(Column(motor=sign * curve) for curve in _curves(motion.q[:, joint], shape))

    def load(self, run: Simulated, time_s: float, plant: Plant, loads: Loads) -> None:
        """Changes the Coulomb friction of the drive."""
        curves = _curves(plant.motor_position[run.joint], run.shape)
        change = sum(c * x for c, x in zip(run.coefficients, curves, strict=False))
        loads.Fcm[run.joint] = max(0.0, loads.Fcm[run.joint] + change)

    def sentence(self, values: Values, form: Form | None, names: Sequence[str]) -> list[str]:
        """Amplitude and cycles, or size and place."""
        if form is _Place.WAVE:
            return [f"{wave(values)}, {times(values['cycles_per_turn'][0])} a turn of the joint"]
        size, std, unit = values["cosine"]
        more = f"{quantity_text(abs(size), std, unit)} {'more' if size > 0.0 else 'less'}"
        width, centre = quantity(values["half_width"]), quantity(values["centre"])
        return [f"{more} in the middle of a spot, {width} to either side of {centre}"]


def _curves(angle: Any, shape: Shape) -> tuple[Any, ...]:
    """Factors of the coefficients of a shape at `angle` [rad]."""
    if shape.form is _Place.SPOT:
        away = np.clip((angle - shape["centre"]) / shape["half_width"], -1.0, 1.0)
        return (0.5 * (1.0 + np.cos(np.pi * away)),)
    cycles = shape["cycles_per_turn"]
    return np.cos(cycles * angle), np.sin(cycles * angle)
