"""The interface of an effect: a cause with its physics, torque, simulation and description.

An effect adds torque to the model's. The torque is linear in some parameters, the coefficients, and nonlinear in the
others, its *shape* (a speed, a length, a time): `sum_i c_i x_i(motion, shape)`, with the columns x_i as seen in the
motor torque and in the joint torque. Estimation needs the columns, a grid of initial shapes, and the conversion
between coefficients and physical parameters. Simulation needs the change of an arm in each millisecond.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum, StrEnum
from functools import cached_property
from typing import Any, ClassVar, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from fri.errors import ConfigurationError
from ident.dynamics.parameters import joint_unit
from ident.dynamics.structure import EncoderSide, TorqueSide
from ident.effects.motion import ArmMotion, Floats
from ident.effects.words import Values, quantity, spoken

EffectSide = Literal["motor", "joint", "sensor", "timing"]
Variable = Literal["velocity", "load", "position", "time", "motor angle"]
Parameters = Mapping[str, float]
"""Values by the names of an effect's parameters, SI units."""


class Form(Enum):
    """The form of an effect of several forms: its name in files, and the names of the parameters in use."""

    uses: tuple[str, ...]

    def __new__(cls, name: str, *uses: str) -> Form:
        """A member from its name and parameters."""
        member = object.__new__(cls)
        member._value_ = name
        member.uses = uses
        return member


FormName = str | Form | None
"""A form, its name in a file, or None for an effect of a single form."""


class Discriminator(StrEnum):
    """Discriminating experiments: motions to decide between causes alike in the sessions at hand."""

    SLOW_SWEEP = "slow sweep"
    REVERSAL_LADDER = "reversal ladder"
    STATIC_POSES = "static poses"
    CHIRP = "chirp"
    REPEATED_RUN = "repeated run"
    HOT_AND_COLD = "hot and cold"


@dataclass(frozen=True)
class Law:
    """The variable of a law: its model-form error is a function of the same variable.

    signed : the law scales a torque with the sign of the drive's direction. exact : it holds by definition, so any
    other function of its variable is another cause.
    """

    variable: Literal["q", "qd", "load", "time"]
    signed: bool = False
    exact: bool = False


@dataclass(frozen=True)
class Parameter:
    """A parameter of an effect: name, SI unit, meaning.

    shape : the torque is nonlinear in it. low, high : physically sensible range. share : reported in percent.
    optional : may be left out. fixed : a shape parameter with values on the grid only, such as a whole number.
    away : least size of one that keeps its sign.
    """

    name: str
    unit: str
    meaning: str
    shape: bool = False
    low: float = -np.inf
    high: float = np.inf
    share: bool = False
    optional: bool = False
    fixed: bool = False
    away: float = 0.0


class Shape(Mapping[str, float]):
    """Form and nonlinear parameters of an effect."""

    __slots__ = ("_values", "form")

    def __init__(self, form: Form | None = None, **values: float) -> None:
        self.form = form
        self._values = {name: float(value) for name, value in values.items()}

    def __getitem__(self, name: str) -> float:
        return self._values[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Shape) and (self.form, self._values) == (other.form, other._values)

    def __hash__(self) -> int:
        return hash((self.form, tuple(self._values.items())))

    def __repr__(self) -> str:
        parts = [] if self.form_name is None else [self.form_name]
        return f"Shape({', '.join([*parts, *(f'{name}={value:.6g}' for name, value in self.items())])})"

    @property
    def form_name(self) -> str | None:
        """Name of its form as in files, None for the plain one."""
        return None if self.form is None else str(self.form.value)

    @property
    def freedom(self) -> int:
        """Number of choices behind it: its values, and the form if there are several."""
        return len(self) + (self.form is not None)

    def at(self, **values: float) -> Shape:
        """The same shape with other values."""
        return Shape(self.form, **{**self._values, **values})


@dataclass(frozen=True, eq=False)
class Column:
    """Torque of a unit coefficient [Nm]: (N,) in the rows of the effect's own joint, or (N, n) in all rows.

    motor, joint : as seen in the motor torque and in the joint torque; None if it does not appear there.
    """

    motor: Floats | None = None
    joint: Floats | None = None

    def wide(self, joint: int, joints: int) -> tuple[Floats | None, Floats | None]:
        """The same as (N, joints) on both sides."""
        return _wide(self.motor, joint, joints), _wide(self.joint, joint, joints)


def both_sides(torque: Floats) -> Column:
    """Column of a torque on the links, seen in both torques."""
    return Column(motor=torque, joint=torque)


def _wide(values: Floats | None, joint: int, joints: int) -> Floats | None:
    if values is None or values.ndim == 2:
        return values
    full = np.zeros((len(values), joints))
    full[:, joint] = values
    return full


@dataclass(frozen=True)
class Setting:
    """The sessions and the arm, as far as the grid of shapes depends on them.

    sessions : number of sessions. durations_s : of each. gear_ratio : (n,). torque_range, speed_range : (n,)
        largest predicted joint torque [Nm] and motor speed [rad/s]. position_range : (n, 2) [rad]. torque_turns :
        (n,) whether the joint torque changes its sign for more than a moment. encoder : side of the elastic joints
        with the published positions, None if unknown. presliding : (n,) presliding length of the model [rad],
        None if unknown. standstill_rad_s : rows below this speed are left out. compared : whether the sessions are
        compared with a reference. compliance : (n,) [rad/Nm] of the springs behind published motors, None if the
        links' positions are published. twist : (n,) [rad/Nm] of the motors ahead of published links, None if the
        motors' positions are published. clipped : (n,) torque limit seen in the samples of a joint's sensor [Nm],
        NaN for none. pauses : whether the sessions follow one another by their clock, with pauses.
    """

    sessions: int
    durations_s: tuple[float, ...]
    gear_ratio: Floats
    torque_range: Floats
    torque_turns: NDArray[np.bool_]
    speed_range: Floats
    position_range: Floats
    encoder: EncoderSide | None = None
    presliding: Floats | None = None
    standstill_rad_s: float = 0.01
    compared: bool = False
    compliance: Floats | None = None
    twist: Floats | None = None
    clipped: Floats | None = None
    pauses: bool = False

    def motor_ahead(self, joint: int) -> float:
        """Twist [rad/Nm] of a motor (from 0) ahead of its published link, 0 where the motor's position is published."""
        return 0.0 if self.twist is None else float(self.twist[joint])


class Plant(Protocol):
    """A simulated arm of n joints as effects see it; arrays are (n,), SI units. model : its pinocchio model."""

    cycle_s: float
    model: Any
    position: Floats
    velocity: Floats
    motor_position: Floats
    motor_velocity: Floats
    joint_torque: Floats


class Loads(Protocol):
    """Torques [Nm] and friction of a cycle, (n,) each; an effect changes them in place."""

    motor_torque: Floats
    link_torque: Floats
    Fvm: Floats
    Fcm: Floats
    offm: Floats
    Fcl: Floats


class Reading(Protocol):
    """Sensor readings of a cycle, (n,) each; an effect changes them in place."""

    position: Floats
    joint_torque: Floats
    motor_torque: Floats


class Simulated:
    """An effect in a simulated arm, called each millisecond like `sim_backend.plant.PlantEffect`.

    joint : from 0. values, form : of the parameters. coefficients : of the columns. state : memory of the effect.
    """

    def __init__(self, effect: Effect, joint: int, values: Parameters, form: FormName) -> None:
        self.effect, self.joint, self.form = effect, joint, form
        self.values = {name: float(value) for name, value in values.items()}
        self.coefficients = effect.coefficients_of(values)
        self.random = np.random.default_rng(0)
        self.state: Any = None

    @cached_property
    def shape(self) -> Shape:
        """Form and nonlinear parameters."""
        return self.effect.shape_of(self.values, self.form)

    def start(self, joints: int, random: np.random.Generator) -> None:
        """Begin a run of an arm with `joints` joints."""
        self.random = random
        self.effect.start(self)

    def load(self, time_s: float, plant: Plant, loads: Loads) -> None:
        """Change the torques and the friction of the cycle from `time_s` on."""
        self.effect.load(self, time_s, plant, loads)

    def sense(self, time_s: float, plant: Plant, reading: Reading) -> None:
        """Change position and joint torque as reported."""
        self.effect.sense(self, time_s, plant, reading)

    def sense_motor(self, time_s: float, plant: Plant, reading: Reading) -> None:
        """Change the motor torque as reported."""
        self.effect.sense_motor(self, time_s, plant, reading)


class Effect(ABC):
    """One cause. Subclasses set the class variables and implement the methods.

    cause, side : as in the table of the diagnosis. summary : the fault in a few words. physics : a sentence.
    source : literature. parameters : all of them, the linear ones first in the order of the columns.
    forms : its forms, if it has several. plain : parameters of its form without a name, beside those with one.
    depends_on : the independent variable of its torque.
    law : the variable of its law, for the model-form error; None if unknown.
    whole_arm : the effect belongs to no single joint. event : it acts during a part of the time only, found by a
        search over times. onsets : forms that set in at their `time` in a `session`, found by a search over times, and
        stay. displaces : it turns the link under load.
    remembers : its torque may follow from the motion more than seconds ago.
    channel : the torque channel it delays. counted : seen by counting samples, without a torque of its own.
    hidden : linear parameters equal to 1 by the physics, free in the search and not reported.
    together : in all joints it follows from one state of a day, such as the arm's temperature.
    character : every drive of the kind has it, so it is no fault by itself.
    evidence_factor : multiple of the usual evidence, for a cause the nominal arm itself resembles slightly.
    usual_change : standard deviation of its size from day to day on any arm of the kind. usual_share : the same where
    a healthy arm has it, as a share of its size. largest_share : of the drive's friction, for a law of the speed.
    beside_companions : the law is coarse, so parameters are estimated beside the companions.
    confused_with : causes alike in many motions, for docs/effects.md only; the diagnosis finds look-alikes in the
    data. contains : special cases of it.
    mean_of : causes with this one as the mean of their model-form error.
    experiment, tell_apart : the motion to decide between it and similar causes, and the same in words;
        `{joint}` stands for the joint's number. every_payload : the experiment needs every payload.
    simulated : its class in a simulated arm.
    """

    cause: ClassVar[str]
    side: ClassVar[EffectSide]
    summary: ClassVar[str]
    physics: ClassVar[str]
    source: ClassVar[str]
    parameters: ClassVar[tuple[Parameter, ...]]
    forms: ClassVar[type[Form] | None] = None
    plain: ClassVar[tuple[str, ...]] = ()
    depends_on: ClassVar[Variable]
    law: ClassVar[Law | None] = None
    whole_arm: ClassVar[bool] = False
    event: ClassVar[bool] = False
    remembers: ClassVar[bool] = True
    onsets: ClassVar[tuple[Form, ...]] = ()
    displaces: ClassVar[bool] = False
    channel: ClassVar[TorqueSide | None] = None
    counted: ClassVar[bool] = False
    hidden: ClassVar[tuple[str, ...]] = ()
    together: ClassVar[bool] = False
    character: ClassVar[bool] = False
    evidence_factor: ClassVar[float] = 1.0
    usual_change: ClassVar[float] = 0.0
    usual_share: ClassVar[float] = 0.05
    largest_share: ClassVar[float] = 1.0
    beside_companions: ClassVar[bool] = False
    confused_with: ClassVar[tuple[str, ...]] = ()
    contains: ClassVar[tuple[str, ...]] = ()
    mean_of: ClassVar[tuple[str, ...]] = ()
    experiment: ClassVar[Discriminator]
    every_payload: ClassVar[bool] = False
    tell_apart: ClassVar[str]
    simulated: ClassVar[type[Simulated]] = Simulated

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.cause}, {self.side} side: {self.summary})"

    # ---- torque ----

    def special_cases(self, shape: Shape, joint: int) -> Sequence[tuple[str, int]]:
        """Causes and joints (from 0) with a special case of this shape's torque, in whose place it has to gain clearly
        more."""
        return [(cause, joint) for cause in self.contains]

    def least(self, setting: Setting, joint: int) -> Mapping[str, float]:
        """Least shape parameters: below them it is the healthy arm's own, or in no row; default those of the grid."""
        return {}

    def shapes(self, setting: Setting, joint: int) -> Sequence[Shape]:
        """Initial shapes of the search; by default a single empty one, for a torque linear in all parameters."""
        return [Shape()]

    @abstractmethod
    def columns(self, motion: ArmMotion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """Columns for the joint (counted from 0) and the shape."""

    def companions(self, motion: ArmMotion, joint: int, setting: Setting) -> tuple[Column, ...]:
        """Columns of side effects in a real arm, beyond the law of the cause."""
        return ()

    @property
    def seen_by(self) -> tuple[str, ...]:
        """Sides with a torque of its columns."""
        own = {"motor": ("motor",), "sensor": ("joint",)}
        return (self.channel,) if self.channel is not None else own.get(self.side, ("motor", "joint"))

    @property
    def repeats(self) -> bool:
        """Whether it may be claimed several times, like a contact and unlike a lasting change."""
        return self.event and not self.onsets

    def timed(self, shape: Shape) -> bool:
        """Whether the time of a shape is the best one of a search."""
        return self.event or shape.form in self.onsets

    def lasts(self, form: Form | None, motion: ArmMotion) -> bool:
        """Whether one of the `onsets` still acts in a motion of a later session."""
        return True

    def passing(self, shape: Shape) -> bool:
        """Whether it is a change between these sessions, or at a moment of one, with no value in a further one."""
        return self.mode(shape) == "between"

    @property
    def linear(self) -> tuple[Parameter, ...]:
        """The coefficients of the columns."""
        return tuple(p for p in self.parameters if not p.shape)

    @property
    def shape_parameters(self) -> tuple[Parameter, ...]:
        """The nonlinear parameters."""
        return tuple(p for p in self.parameters if p.shape)

    def continuous(self, shape: Shape) -> tuple[str, ...]:
        """Names of the shape parameters to refine between the points of the grid."""
        return tuple(p.name for p in self.shape_parameters if p.name in shape and not p.fixed)

    def plausible(self, coefficients: Floats, shape: Shape) -> bool:
        """Whether the coefficients lie in their physically sensible ranges."""
        return all(p.low <= value <= p.high for p, value in zip(self.linear, coefficients, strict=False))

    def familiar(self, shape: Shape, coefficients: Floats, setting: Setting, joint: int) -> bool:
        """Whether arms are known with such a torque; another one of the same law is often of another cause."""
        return True

    def seen_in_samples(self, shape: Shape) -> bool:
        """Whether the samples themselves show the cause, without a test of significance by blocks."""
        return False

    def law_std(self, parameters: Parameters, form: Form | None) -> Parameters:
        """Standard deviations of parameters from the coarseness of the law itself."""
        return {}

    def mode(self, shape: Shape) -> Literal["within", "between"] | None:
        """Whether it acts within a session or between sessions, for causes with both."""
        return None

    def variable(self, parameters: Parameters) -> Variable:
        """The independent variable of its torque, with these parameters."""
        return self.depends_on

    def simpler(self, shape: Shape) -> Shape | None:
        """A shape with the first of this one's columns alone, or None: the one to tell if the others may be zero."""
        return None

    # ---- beside other causes ----

    def follows_from(self, shape: Shape, coefficients: Floats, other: Effect, at: Shape, of: Floats) -> bool:
        """Whether this one, with these coefficients, is a consequence of `other` in the same joint.

        at, of : shape and coefficients of the other.
        """
        return False

    def same_as(self, setting: Setting, joint: int) -> str | None:
        """A cause of the same torque in these sessions, or None."""
        return None

    # ---- values ----

    @property
    def known_forms(self) -> tuple[Form, ...]:
        """The forms of the effect, empty for a single one."""
        return () if self.forms is None else tuple(self.forms)

    def form_of(self, name: FormName) -> Form | None:
        """The form of a name from a file. Raises ConfigurationError for a missing, unknown or foreign one."""
        if self.plain and name is None:
            return None
        if self.known_forms:
            known = {form.value: form for form in self.known_forms}
            found = known.get(name.value if isinstance(name, Form) else name)
            if found is None:
                raise ConfigurationError(
                    f"effect {self.cause}: `form` is {name!r}; give one of {', '.join(known)}"
                )
            return found
        if name is not None:
            raise ConfigurationError(
                f"effect {self.cause}: `form` is {name!r}; it has one form only, leave it out"
            )
        return None

    def used(self, form: Form | None) -> tuple[Parameter, ...]:
        """The parameters of a form, without the hidden ones."""
        shown = (p for p in self.parameters if p.name not in self.hidden)
        uses = self.plain if form is None else form.uses
        return tuple(p for p in shown if not uses or p.name in uses)

    def check(self, parameters: Mapping[str, Any], form: FormName, *, whole: bool = False) -> None:
        """Raise ConfigurationError for a foreign and for a missing parameter.

        whole : coefficients are needed too, besides the shape.
        """
        used = self.used(self.form_of(form))
        foreign = sorted(set(parameters) - {p.name for p in (used if whole else self.parameters)})
        needed = [p.name for p in used if (p.shape or whole) and not p.optional]
        missing = [name for name in needed if name not in parameters]
        if foreign or missing:
            wrong = f"has no parameter {foreign[0]!r}" if foreign else f"needs `{missing[0]}`"
            listed = ", ".join(p.name for p in used)
            raise ConfigurationError(f"effect {self.cause} {wrong}; its parameters: {listed}")

    def shape_of(self, parameters: Parameters, form: FormName = None) -> Shape:
        """The shape in a full set of parameter values."""
        values = {p.name: float(parameters[p.name]) for p in self.shape_parameters if p.name in parameters}
        return Shape(self.form_of(form), **values)

    def coefficients_of(self, parameters: Parameters) -> Floats:
        """The coefficients in a full set of parameter values."""
        return np.array(
            [float(parameters.get(p.name, 1.0 if p.name in self.hidden else 0.0)) for p in self.linear]
        )

    def torque(
        self, motion: ArmMotion, joint: int, parameters: Parameters, form: FormName = None
    ) -> tuple[Floats, Floats]:
        """Torque (N, n) [Nm] of the effect in the motor torque and in the joint torque."""
        total = np.zeros((2, len(motion.time), motion.n))
        for value, column in self.weighted(motion, joint, parameters, form):
            for side, part in enumerate(column.wide(joint, motion.n)):
                if part is not None:
                    total[side] += value * part
        return total[0], total[1]

    def weighted(
        self, motion: ArmMotion, joint: int, parameters: Parameters, form: FormName = None
    ) -> Iterator[tuple[float, Column]]:
        """The coefficients with their columns, for a full set of parameter values."""
        columns = self.columns(motion, joint, self.shape_of(parameters, form))
        yield from zip(self.coefficients_of(parameters), columns, strict=False)

    def derivative(
        self, motion: ArmMotion, joint: int, parameters: Parameters, name: str, form: FormName = None
    ) -> tuple[Floats, Floats]:
        """Derivative (N, n) of both torques by the parameter `name`.

        Exact for linear parameters, a central difference for the others. Raises ConfigurationError for a name
        foreign to the effect.
        """
        known = [p.name for p in self.parameters]
        if name not in known:
            raise ConfigurationError(f"{self.cause} has no parameter {name!r}; it has {', '.join(known)}")
        value = float(parameters.get(name, 0.0))
        linear = name in [p.name for p in self.linear]
        step = 1.0 if linear else 1e-3 * (abs(value) or 1.0)
        low, high = (0.0, 1.0) if linear else (value - step, value + step)
        upper = self.torque(motion, joint, {**parameters, name: high}, form)
        lower = self.torque(motion, joint, {**parameters, name: low}, form)
        return (upper[0] - lower[0]) / (high - low), (upper[1] - lower[1]) / (high - low)

    def in_session(self, parameters: Parameters, form: FormName, number: int | None) -> Parameters:
        """The parameters in force in a session (from 0), None for a further one."""
        return parameters

    # ---- simulation and words ----

    def simulate(self, joint: int, parameters: Parameters, form: FormName = None) -> Simulated:
        """The effect as a part of a simulated arm."""
        return self.simulated(self, joint, parameters, form)

    def start(self, run: Simulated) -> None:  # noqa: B027
        """Begin a run of a simulated arm."""

    def load(self, run: Simulated, time_s: float, plant: Plant, loads: Loads) -> None:  # noqa: B027
        """Change the torques and the friction of a simulated cycle."""

    def sense(self, run: Simulated, time_s: float, plant: Plant, reading: Reading) -> None:  # noqa: B027
        """Change position and joint torque as reported by a simulated arm."""

    def sense_motor(self, run: Simulated, time_s: float, plant: Plant, reading: Reading) -> None:  # noqa: B027
        """Change the motor torque as reported by a simulated arm."""

    def units(self, form: Form | str | None = None, *, prismatic: bool = False) -> dict[str, str]:
        """Unit by parameter, for an effect of that form. prismatic : whether the joint slides."""
        return {p.name: joint_unit(p.unit, prismatic=prismatic) for p in self.parameters}

    def sentence(self, values: Values, form: Form | None, names: Sequence[str]) -> list[str]:
        """Phrases with a finding's parameters. names : of the joints. KeyError for a missing value."""
        known = {p.name: p for p in self.parameters}
        return [
            f"{spoken(name)} {quantity(value, share=name in known and known[name].share)}"
            for name, value in values.items()
        ]
