"""Causes on the link side, seen in both torques: elastic joints, hoses, the base, the encoders' reading."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ident.dynamics.parameters import joint_unit
from ident.dynamics.structure import EncoderSide
from ident.effects.effect import (
    Column,
    Discriminator,
    Effect,
    Form,
    Law,
    Loads,
    Parameter,
    Parameters,
    Plant,
    Reading,
    Setting,
    Shape,
    Simulated,
    both_sides,
)
from ident.effects.motion import ArmMotion, Floats, dahl
from ident.effects.springs import Springs
from ident.effects.words import MODELS, Values, one_joint, quantity, times, wave
from ident.rows.filters import differentiate, low_pass, settling

# Cut-off of a twist before it is differentiated, with the link and with the motor displaced [Hz].
_LINK_HZ, _MOTOR_HZ = 8.0, 30.0
# Samples in reach of a derivative.
_REACH = 4


class _Encoder(Form):
    """Side of the published positions; the other end of the joint is elsewhere."""

    MOTOR = "encoder at the motor", "compliance", "gap", "width", "size"
    LINK = "encoder at the link", "compliance", "gap", "width"


class _Twisting(Effect):
    """A joint with link and motor at different angles."""

    side = "joint"
    forms = _Encoder
    depends_on = "load"
    displaces = True
    evidence_factor = 2.0
    against = ""
    """What the size is on top of, in words."""

    @abstractmethod
    def twist(self, torque: Any, parameters: Parameters) -> Any:
        """Angle of the motor minus angle of the link [rad] under a joint torque [Nm]."""

    def load(self, run: Simulated, time_s: float, plant: Plant, loads: Loads) -> None:
        """With the link's encoder, the motor drags against its friction."""
        if run.shape.form is not _Encoder.MOTOR:
            past = [*(run.state or []), float(self.twist(plant.joint_torque[run.joint], run.values))][-3:]
            run.state = past
            if len(past) == 3:
                loads.motor_torque[run.joint] -= loads.Fvm[run.joint] * (past[2] - past[0]) / 2e-3

    def sense(self, run: Simulated, time_s: float, plant: Plant, reading: Reading) -> None:
        """Displaces the position published by the motor's encoder."""
        if run.shape.form is _Encoder.MOTOR:
            reading.position[run.joint] += self.twist(plant.joint_torque[run.joint], run.values)

    def sentence(self, values: Values, form: Form | None, names: Sequence[str]) -> list[str]:
        """Size, and the place of the encoder."""
        first = self.linear[0].name
        width = [f"crossed within {quantity(values['width'])}"] if "width" in values else []
        place = "the motors" if form is _Encoder.MOTOR else "the links"
        return [f"{first} {quantity(values[first])}{self.against}", *width, f"the encoders sit at {place}"]


def _places(setting: Setting) -> tuple[_Encoder, ...]:
    known = {"motor": (_Encoder.MOTOR,), "link": (_Encoder.LINK,)}
    return tuple(_Encoder) if setting.encoder is None else known[setting.encoder]


# Initial compliances over the joint's own (a smaller one is within the joint's tolerance), and a step [rad/Nm].
_SHARES = (0.3, 0.45, 0.65, 1.0, 1.6, 2.6, 4.2, 7.0)
_SMALL = 1e-6


class JointElasticity(_Twisting):
    """The joint twists by `compliance tau_l` beyond the model's twist."""

    cause = "joint_elasticity"
    character = True
    summary = "the link is not where the motor encoder says"
    physics = (
        "the gear's flexspline and the torque sensor twist under load: the link is not where the motor is"
    )
    source = "Spong, J. Dyn. Syst. Meas. Control 109 (1987); Janot, Gautier, Jubien and Vandanjon, 2014"
    parameters = (
        Parameter("compliance", "rad/Nm", "twist per torque beyond the model's", low=0.0, high=0.02),
        Parameter("size", "rad/Nm", "of the ringing links", shape=True, low=1e-7, high=0.02, optional=True),
    )
    against = f" more than {MODELS}"
    confused_with = ("backlash", "joint_zero_offset", "joint_torque_delay")
    experiment = Discriminator.CHIRP
    tell_apart = "a 1 to 15 Hz chirp of joint {joint} with two payloads"

    def shapes(self, setting: Setting, joint: int) -> Sequence[Shape]:
        """Places of the encoder; sizes for links ringing on springs of known stiffness."""
        found = []
        for place in _places(setting):
            if place is _Encoder.MOTOR and setting.compliance is not None:
                own = float(setting.compliance[joint])
                found += [Shape(place, size=share * own) for share in _SHARES] if own else [Shape(place)]
            else:
                found.append(Shape(place))
        return found

    def plausible(self, coefficients: Floats, shape: Shape) -> bool:
        """Whether the compliance is about the size of the ringing."""
        more, size = float(coefficients[0]), shape.get("size")
        return super().plausible(coefficients, shape) and (size is None or 0.6 * size < more < 1.7 * size)

    def columns(self, motion: ArmMotion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """Change of all torques with the displaced link, or of the motor torque with the displaced motor."""
        if motion.springs is not None and shape.form is _Encoder.MOTOR:
            size = shape.get("size", _SMALL)
            return _changed_springs(motion, joint, motion.springs.softer(joint, size), size, "softer")
        at_motor = shape.form is _Encoder.MOTOR
        return _deflected(motion, joint, lambda torque: torque, at_motor, 1e-5)

    def twist(self, torque: Any, parameters: Parameters) -> Any:
        """In proportion to the torque."""
        return parameters["compliance"] * torque

    def at_encoder(self, encoder: EncoderSide) -> Shape:
        """The shape with the encoder at the `motor` or at the `link`."""
        return Shape(_Encoder.MOTOR if encoder == "motor" else _Encoder.LINK)


# Gaps to begin with [rad].
_GAPS = (1e-4, 3e-4, 1e-3, 3e-3, 1e-2)


class Backlash(_Twisting):
    """The link lags the motor by half the `gap`, to the side of the joint torque.

    With published motors the link crosses the gap almost free, arrives, and rings on its spring in a way that depends
    on the `size` of the gap.
    """

    cause = "backlash"
    summary = "lost motion when the torque reverses"
    physics = "gear teeth lose contact and cross a gap when the transmitted torque changes its sign"
    source = "Nordin and Gutman, Automatica 38 (2002)"
    parameters = (
        Parameter("gap", "rad", "lost motion", low=0.0, high=0.1),
        Parameter("width", "Nm", "range of torque for crossing the gap", shape=True, fixed=True),
        Parameter("size", "rad", "gap of the ringing links", shape=True, low=1e-5, high=0.1, optional=True),
    )
    confused_with = ("joint_elasticity", "joint_zero_offset", "presliding_hysteresis")
    experiment = Discriminator.SLOW_SWEEP
    tell_apart = "a slow sweep of joint {joint} through the poses where its gravity torque is zero"

    def shapes(self, setting: Setting, joint: int) -> Sequence[Shape]:
        """Places of the encoder, sharp and soft crossing; none if the torque keeps its sign."""
        if not setting.torque_turns[joint]:
            return []
        top = float(setting.torque_range[joint])
        found = []
        for place in _places(setting):
            if place is _Encoder.MOTOR and setting.compliance is not None:
                found += [Shape(place, width=0.01 * top, size=size) for size in _GAPS]
            else:
                found += [Shape(place, width=max(1e-3, w * top)) for w in (0.01, 0.05)]
        return found

    def plausible(self, coefficients: Floats, shape: Shape) -> bool:
        """Whether the gap is about the size of the crossing."""
        gap, size = float(coefficients[0]), shape.get("size")
        return super().plausible(coefficients, shape) and (size is None or 0.5 * size < gap < 2.0 * size)

    def columns(self, motion: ArmMotion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """Change of all torques with the displaced link, or of the motor torque with the displaced motor."""
        size = shape.get("size", 0.0)
        if motion.springs is not None and size > 0.0 and shape.form is _Encoder.MOTOR:
            return _changed_springs(motion, joint, motion.springs.with_play(joint, size), size, "play")

        def half(torque: Floats) -> Floats:
            return np.asarray(0.5 * np.tanh(torque / shape["width"]))

        at_motor = shape.form is _Encoder.MOTOR
        return _deflected(motion, joint, half, at_motor, 1e-3)

    def twist(self, torque: Any, parameters: Parameters) -> Any:
        """Half the gap to the side of the torque."""
        return 0.5 * parameters["gap"] * np.tanh(torque / parameters["width"])


def _deflected(
    motion: ArmMotion,
    joint: int,
    twist: Callable[[Floats], Floats],
    encoder_at_motor: bool,
    scale: float,
) -> tuple[Column, ...]:
    """Column for a twist of the joint, motor minus link, by a unit coefficient [rad].

    With the encoder at the motor the link stands at q - twist, and all torques change. With the encoder at the link
    the motor moves by the twist beside it: drive inertia and drive friction see its derivatives. twist : as a function
    of the joint torque (N,). scale : coefficient of the linearisation. The links are taken to
    follow at once.
    """
    # Two derivatives amplify the noisy acceleration part of the torque, with the link's inertia as a factor more than
    # with the drive's friction.
    cutoff = min(_LINK_HZ if encoder_at_motor else _MOTOR_HZ, 0.2 / motion.dt)

    def turned(around: ArmMotion) -> Floats:
        smooth = low_pass(twist(around.joint_torque[:, joint])[:, None], around.dt, cutoff)
        return np.hstack([smooth, *differentiate(smooth, around.dt)])

    turn, first, second = motion.beside(settling(cutoff) + _REACH * motion.dt, turned).T
    if encoder_at_motor:
        return (both_sides(motion.displaced(joint, -scale * turn, -scale * first, -scale * second) / scale),)
    # Without the jump of Coulomb friction: it moves by a millisecond or so, and would give a column of spikes.
    here, there = motion.motor_speed, motion.motor_speed.copy()
    there[:, joint] += scale * first
    friction = (motion.friction(there) - motion.friction(here))[:, joint]
    friction -= motion.motor_coulomb[joint] * (np.sign(there) - np.sign(here))[:, joint]
    friction /= scale
    return (Column(motor=motion.inertia[joint] * second + friction),)


def _changed_springs(
    motion: ArmMotion, joint: int, changed: Springs, size: float, kind: str
) -> tuple[Column, ...]:
    """Column of a change of a joint's spring behind the published motors, over its `size`; remembered by its `kind`.

    The links ring on their springs, which is not proportional to the size. The column belongs to one size, and its
    coefficient equals that size for the right one.
    """

    def torque(whole: ArmMotion) -> Floats:
        assert whole.springs is not None
        # The springs' equation has gravity and inertia where the links were before the change.
        further = (changed.links[0] - whole.springs.links[0])[:, joint]
        still = np.zeros_like(further)
        elsewhere = whole.displaced(joint, further, still, still)
        return (changed.torque - whole.springs.torque + elsewhere) / size

    return (both_sides(motion.along(torque, kind, joint, size)),)


class _Spring(Form):
    LINEAR = "linear", "stiffness"
    CUBIC = "cubic", "stiffness"
    HARDENING = "hardening", "stiffness", "quadratic", "cubic"
    TAUT_ABOVE = "taut above", "stiffness", "slack"
    TAUT_BELOW = "taut below", "stiffness", "slack"
    PLAY = "play", "stiffness", "slack", "play"
    TWO_JOINTS = "over two joints", "stiffness", "source", "ratio"


# Angle of the second joint over that of the first, in the length of a hose, to begin with.
_RATIOS = (-1.8, -0.7, 0.7, 1.8)
# Distance in which the friction of a hose along the arm reverses [rad].
_RUB_RAD = 0.1


# Slope of a spring against its pull, over the steepest one, that passes for none.
_FLAT = 0.1


class CableSpring(Effect):
    """Hoses and cables pull with `stiffness f(q)`.

    f is q; q^3 (cubic); the angle above or below `slack` (taut above, taut below); the angle beyond `play` on either
    side of `slack` (play). A hardening one pulls with `stiffness q + quadratic q^2 + cubic q^3`, equal to
    `k (q - c) + h (q - c)^3` about its angle of rest c. A hose over two joints is longer by `q + ratio q_source`, and
    pulls at both: with `stiffness` times that here, and `ratio` times as much at joint `source`.
    """

    cause = "cable_spring"
    side = "joint"
    summary = "a torque that depends on the joint angle (hoses, cables)"
    physics = "hoses and cables along the arm are bent or stretched, and pull the link back"
    source = "Swevers, Verdonck and De Schutter, IEEE Control Systems Magazine 27 (2007)"
    parameters = (
        Parameter("stiffness", "Nm/rad", "of the spring (Nm/rad^3 for a cubic one)"),
        Parameter("quadratic", "Nm/rad^2", "of a hardening one with its rest away from zero"),
        Parameter("cubic", "Nm/rad^3", "of a hardening one"),
        Parameter("slack", "rad", "angle at which the cable becomes taut, or middle of its play", shape=True),
        Parameter("play", "rad", "half the range without a pull", shape=True, low=0.0),
        Parameter("source", "1", "the other joint of a hose over two, from 1", shape=True, fixed=True),
        Parameter("ratio", "1", "its angle over that of the first", shape=True, low=-2.5, high=2.5, away=0.4),
    )
    forms = _Spring
    depends_on = "position"
    law = Law("q")
    confused_with = (
        "joint_zero_offset",
        "payload_error",
        "sensor_ripple",
        "sensor_crosstalk",
        "encoder_eccentricity",
    )
    experiment = Discriminator.SLOW_SWEEP
    tell_apart = "the same slow sweep of joint {joint} in two postures of the other joints"

    def units(self, form: Form | str | None = None, *, prismatic: bool = False) -> dict[str, str]:
        """A cubic spring's stiffness is its torque over the cube of the angle."""
        cubic = (form.value if isinstance(form, Form) else form) == _Spring.CUBIC.value
        stiffness = joint_unit("Nm/rad^3" if cubic else "Nm/rad", prismatic=prismatic)
        return super().units(form, prismatic=prismatic) | {"stiffness": stiffness}

    def shapes(self, setting: Setting, joint: int) -> Sequence[Shape]:
        """Linear, cubic, hardening and one-sided springs, springs with play, and hoses on to the next two joints."""
        low, high = setting.position_range[joint]
        angles = [float(low + share * (high - low)) for share in (0.3, 0.5, 0.7)]
        taut, plays = (
            (_Spring.TAUT_ABOVE, _Spring.TAUT_BELOW),
            [share * (high - low) for share in (0.1, 0.25)],
        )
        return [
            *(Shape(form) for form in (_Spring.LINEAR, _Spring.CUBIC, _Spring.HARDENING)),
            *(Shape(form, slack=angle) for form in taut for angle in angles),
            *(Shape(_Spring.PLAY, slack=angle, play=play) for angle in angles for play in plays),
            *(
                Shape(_Spring.TWO_JOINTS, source=other + 1, ratio=ratio)
                for other in range(joint + 1, min(joint + 3, len(setting.position_range)))
                for ratio in _RATIOS
            ),
        ]

    def special_cases(self, shape: Shape, joint: int) -> Sequence[tuple[str, int]]:
        """A hose over two joints with a ratio far from one is a spring at one of them."""
        both = shape.form is _Spring.TWO_JOINTS
        return [(self.cause, joint), (self.cause, round(shape["source"]) - 1)] if both else []

    def plausible(self, coefficients: Floats, shape: Shape) -> bool:
        """Whether it pulls back; a hardening one at least in the mean over a radian to both sides."""
        if shape.form is _Spring.HARDENING:
            return bool(coefficients[0] + coefficients[2] >= 0.0)
        return bool(coefficients[0] >= 0.0)

    def familiar(self, shape: Shape, coefficients: Floats, setting: Setting, joint: int) -> bool:
        """Whether it pulls the more, the further the joint turns: a wave of the angle does not."""
        if shape.form is not _Spring.HARDENING:
            return True
        low, high = setting.position_range[joint]
        pull = np.polynomial.Polynomial([0.0, *coefficients])
        slopes = pull.deriv()(np.linspace(low, high, 50))
        return bool(slopes.min() >= -_FLAT * slopes.max())

    def simpler(self, shape: Shape) -> Shape | None:
        """A hardening spring that does not harden is a linear one."""
        return Shape(_Spring.LINEAR) if shape.form is _Spring.HARDENING else None

    def columns(self, motion: ArmMotion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """The same torque on both sides."""
        if shape.form is _Spring.TWO_JOINTS:
            other, ratio = round(shape["source"]) - 1, shape["ratio"]
            pull = motion.q[:, joint] + ratio * motion.q[:, other]
            both = np.zeros_like(motion.q)
            both[:, joint], both[:, other] = pull, ratio * pull
            return (both_sides(both),)
        return tuple(both_sides(pull) for pull in _pulls(motion.q[:, joint], shape))

    def companions(self, motion: ArmMotion, joint: int, setting: Setting) -> tuple[Column, ...]:
        """A hose rubs along the arm: Dahl's friction along the angle."""

        def rub(whole: ArmMotion) -> Floats:
            return np.asarray(dahl(np.ascontiguousarray(whole.q[:, joint]), _RUB_RAD, 0.0))

        return (both_sides(motion.along(rub, "rub", joint)),)

    def load(self, run: Simulated, time_s: float, plant: Plant, loads: Loads) -> None:
        """A torque on the link, or on both."""
        if run.shape.form is _Spring.TWO_JOINTS:
            other, ratio = round(run.values["source"]) - 1, run.values["ratio"]
            pull = run.values["stiffness"] * (plant.position[run.joint] + ratio * plant.position[other])
            loads.link_torque[run.joint] -= pull
            loads.link_torque[other] -= ratio * pull
            return
        pulls = _pulls(plant.position[run.joint], run.shape)
        pull = sum(c * one for c, one in zip(run.coefficients, pulls, strict=False))
        loads.link_torque[run.joint] -= pull

    def sentence(self, values: Values, form: Form | None, names: Sequence[str]) -> list[str]:
        """Stiffness, and the curve of the pull."""
        stiffness = quantity(values["stiffness"])
        if form is _Spring.CUBIC:
            return [f"grows with the cube of the angle, {stiffness}"]
        if form is _Spring.HARDENING:
            terms = [name for name in ("quadratic", "cubic") if name in values]
            bent = ", ".join(f"{name} {quantity(values[name])}" for name in terms)
            return [f"{stiffness}, hardening: {bent}"]
        if form is _Spring.PLAY:
            play, slack = quantity(values["play"]), quantity(values["slack"])
            return [f"{stiffness}, with no pull within {play} of {slack}"]
        if form is _Spring.LINEAR:
            return [stiffness]
        if form is _Spring.TWO_JOINTS:
            other, ratio = one_joint(round(values["source"][0]), names), quantity(values["ratio"])
            return [f"{stiffness}, of its angle plus {ratio} times that of {other}"]
        sense = "above" if form is _Spring.TAUT_ABOVE else "below"
        return [f"{stiffness}, taut {sense} {quantity(values['slack'])} and slack elsewhere"]


def _pulls(angle: Any, shape: Shape) -> tuple[Any, ...]:
    """Torque of unit coefficients at `angle` [rad]."""
    if shape.form is _Spring.LINEAR:
        return (1.0 * angle,)
    if shape.form is _Spring.CUBIC:
        return (angle**3,)
    if shape.form is _Spring.HARDENING:
        return angle, angle**2, angle**3
    away = angle - shape["slack"]
    if shape.form is _Spring.PLAY:
        return (away - np.clip(away, -shape["play"], shape["play"]),)
    return (np.maximum(away, 0.0) if shape.form is _Spring.TAUT_ABOVE else np.minimum(away, 0.0),)


def sideways_gravity(gravity: Floats, axes: Floats) -> Floats:
    """Derivatives (k, 3) of gravity (3,) in the base's axes, for rotations of the base about `axes` (k, 3)."""
    # The base turned by +angle sees gravity turned by -angle.
    return np.array([-np.cross(axis, gravity) for axis in axes])


class BaseTilt(Effect):
    """Gravity is turned by `tilt_x` about x and `tilt_y` about y of the base frame (small angles)."""

    cause = "base_tilt"
    side = "joint"
    summary = "gravity is not along the assumed axis"
    physics = "the base is not level, so gravity is not along the assumed axis"
    source = "Khalil and Dombre, Modeling, Identification and Control of Robots (2002), chapter 12"
    remembers = False
    parameters = (
        Parameter("tilt_x", "rad", "rotation of the base about its x axis", low=-0.5, high=0.5),
        Parameter("tilt_y", "rad", "rotation of the base about its y axis", low=-0.5, high=0.5),
    )
    depends_on = "position"
    whole_arm = True
    confused_with = ("joint_zero_offset", "payload_error")
    experiment = Discriminator.STATIC_POSES
    tell_apart = "static poses over a whole turn of joint 1 with the arm stretched out; a spirit level"

    def columns(self, motion: ArmMotion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """Gravity torques of the sideways parts of gravity, in all rows."""
        down = motion.chain.gravity / np.linalg.norm(motion.chain.gravity)
        return tuple(both_sides(motion.gravity_along(side)) for side in sideways_gravity(down, np.eye(3)[:2]))

    def start(self, run: Simulated) -> None:
        """Gravity is that of the new arm."""
        run.state = None

    def load(self, run: Simulated, time_s: float, plant: Plant, loads: Loads) -> None:
        """Turns gravity of the simulated arm."""
        gravity = np.array(plant.model.gravity.linear)
        if run.state is None:
            run.state = gravity - np.cross(np.append(run.coefficients, 0.0), gravity)
        if not np.array_equal(gravity, run.state):
            # Other arms may share the links, and a mounted payload brings new ones.
            model = plant.model.copy()
            model.gravity.linear = run.state
            plant.model = model


class JointZeroOffset(Effect):
    """The joint stands at q + `offset` for a published q."""

    cause = "joint_zero_offset"
    side = "joint"
    summary = "the zero of the encoder is off"
    physics = "the encoder's zero is off, so the arm stands elsewhere than the positions say"
    source = "Khalil and Dombre, Modeling, Identification and Control of Robots (2002), chapter 11"
    parameters = (Parameter("offset", "rad", "true minus published position", low=-0.3, high=0.3),)
    depends_on = "position"
    confused_with = ("base_tilt", "payload_error", "cable_spring", "encoder_eccentricity", "backlash")
    mean_of = ("joint_elasticity",)
    experiment = Discriminator.STATIC_POSES
    tell_apart = (
        "static poses with joint {joint} on both sides of its gravity-free position; a mastering gauge"
    )

    def columns(self, motion: ArmMotion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """Derivative of the joint torque by the joint's position, in all rows."""
        still = np.zeros(len(motion.q))
        upper = motion.displaced(joint, still + 1e-4, still, still)
        lower = motion.displaced(joint, still - 1e-4, still, still)
        return (both_sides((upper - lower) / 2e-4),)

    def same_as(self, setting: Setting, joint: int) -> str | None:
        """Backlash behind the motor's encoder: a gap under a torque of one sign holds the link to one side."""
        return "backlash" if setting.encoder == "motor" and not setting.torque_turns[joint] else None

    def sense(self, run: Simulated, time_s: float, plant: Plant, reading: Reading) -> None:
        """Shifts the published positions."""
        reading.position[run.joint] -= run.values["offset"]


# Reading error of the linearisation [rad].
_STEP_RAD = 1e-4


class EncoderEccentricity(Effect):
    """The encoder reads `cosine cos(k q) + sine sin(k q)` too much, with k cycles a turn of the joint.

    Link and drive move by the published motion minus that error and its derivatives, so all rows see it.
    """

    cause = "encoder_eccentricity"
    side = "joint"
    summary = "the reading of the encoder errs with the turn of the joint"
    physics = (
        "the code disc runs out of true (one cycle a turn) or is oval (two), so positions err with the angle"
    )
    source = (
        "Lu, Graetz, Amin-Shahidi and Smeds, CIRP Annals 59 (2010); Renishaw, The accuracy of rotary encoders"
    )
    parameters = (
        Parameter("cosine", "rad", "reading error with cos(k q)", low=-0.1, high=0.1),
        Parameter("sine", "rad", "reading error with sin(k q)", low=-0.1, high=0.1),
        Parameter("cycles_per_turn", "1", "k", shape=True, fixed=True),
    )
    depends_on = "position"
    law = Law("q")
    confused_with = ("joint_zero_offset", "cable_spring", "sensor_ripple")
    contains = ("joint_zero_offset",)
    experiment = Discriminator.STATIC_POSES
    every_payload = True
    tell_apart = "static poses over a whole turn of joint {joint} with two payloads; a gauge at the link"

    def shapes(self, setting: Setting, joint: int) -> Sequence[Shape]:
        """One and two cycles a turn."""
        return [Shape(cycles_per_turn=k) for k in (1, 2)]

    def columns(self, motion: ArmMotion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """Change of the joint torque with the joint displaced by the error, in all rows, and of its drive's own."""
        k = shape["cycles_per_turn"]
        q, qd, qdd = (values[:, joint] for values in (motion.q, motion.qd, motion.qdd))
        cos, sin = np.cos(k * q), np.sin(k * q)
        here, found = np.eye(motion.n)[joint], []
        # Error e(q), its slope e' and curvature e'': the rate is e' qd, the acceleration e'' qd^2 + e' qdd.
        for error, slope, curvature in ((cos, -k * sin, -(k**2) * cos), (sin, k * cos, -(k**2) * sin)):
            rate, acceleration = slope * qd, curvature * qd**2 + slope * qdd
            shifts = (-_STEP_RAD * part for part in (error, rate, acceleration))
            links = motion.displaced(joint, *shifts) / _STEP_RAD
            drive = motion.inertia[joint] * acceleration + motion.viscous[joint] * rate
            found.append(Column(motor=links - drive[:, None] * here, joint=links))
        return tuple(found)

    def sense(self, run: Simulated, time_s: float, plant: Plant, reading: Reading) -> None:
        """Shifts the published position."""
        cosine, sine = run.coefficients
        angle = run.values["cycles_per_turn"] * plant.position[run.joint]
        reading.position[run.joint] += cosine * np.cos(angle) + sine * np.sin(angle)

    def sentence(self, values: Values, form: Form | None, names: Sequence[str]) -> list[str]:
        """Amplitude and cycles."""
        return [f"{wave(values)}, {times(values['cycles_per_turn'][0])} a turn of the joint"]
