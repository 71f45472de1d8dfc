"""What an effect is: a cause with its physics, its torque, its simulation and its words.

An effect adds torque to the model's. It is linear in some parameters, the coefficients, and not in the others, its
*shape* (a speed, a length, a time): the torque is `sum_i c_i x_i(motion, shape)`, with the columns x_i as seen in the
motor torque and in the joint torque. Estimation needs the columns, a grid of shapes to begin with, and the way from
coefficients to physical parameters and back. Simulation needs the change of an arm in each millisecond.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum, StrEnum
from typing import Any, ClassVar, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from fri.errors import ConfigurationError
from ident.effects.motion import Floats, Motion
from ident.effects.words import Values, quantity, spoken

__all__ = [
    "Column",
    "Effect",
    "EffectSide",
    "Experiment",
    "Form",
    "Law",
    "Loads",
    "Parameter",
    "Parameters",
    "Plant",
    "Reading",
    "Setting",
    "Shape",
    "Simulated",
    "Variable",
    "both_sides",
]

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


class Experiment(StrEnum):
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

    signed : the law scales a torque with the sign of the drive's direction.
    """

    variable: Literal["q", "qd", "load", "time"]
    signed: bool = False


@dataclass(frozen=True)
class Parameter:
    """A parameter of an effect: name, SI unit, meaning.

    shape : the torque is not linear in it. low, high : physically sensible range. share : said in percent.
    optional : may be left out.
    """

    name: str
    unit: str
    meaning: str
    shape: bool = False
    low: float = -np.inf
    high: float = np.inf
    share: bool = False
    optional: bool = False


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
        parts = [] if self.form is None else [self.form.value]
        return f"Shape({', '.join([*parts, *(f'{name}={value:.6g}' for name, value in self.items())])})"

    @property
    def freedom(self) -> int:
        """Number of choices behind it: its values, and the form where there are several."""
        return len(self) + (self.form is not None)

    def at(self, **values: float) -> Shape:
        """The same shape with other values."""
        return Shape(self.form, **{**self._values, **values})


@dataclass(frozen=True, eq=False)
class Column:
    """Torque of a unit coefficient [Nm]: (N,) in the rows of the effect's own joint, or (N, n) in all rows.

    motor, joint : as seen in the motor torque and in the joint torque; None where it does not appear.
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
    """What the grid of shapes depends on.

    sessions : number of sessions. durations_s : of each. gear_ratio : (n,). torque_range, speed_range : (n,)
        largest predicted joint torque [Nm] and motor speed [rad/s]. position_range : (n, 2) [rad]. torque_turns :
        (n,) whether the joint torque changes its sign for more than a moment. encoder : side of the elastic joints
        with the published positions, None where unknown. presliding : (n,) presliding length of the model [rad],
        None where unknown. compared : whether the sessions are compared with a reference. compliance : (n,) [rad/Nm]
        of the springs behind published motors, None where the links' positions are published. clipped : (n,) torque
        limit seen in the samples of a joint's sensor [Nm], NaN for none.
    """

    sessions: int
    durations_s: tuple[float, ...]
    gear_ratio: Floats
    torque_range: Floats
    torque_turns: NDArray[np.bool_]
    speed_range: Floats
    position_range: Floats
    encoder: Literal["link", "motor"] | None = None
    presliding: Floats | None = None
    compared: bool = False
    compliance: Floats | None = None
    clipped: Floats | None = None


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


class Reading(Protocol):
    """What the sensors report in a cycle, (n,) each; an effect changes it in place."""

    position: Floats
    joint_torque: Floats
    motor_torque: Floats


Act = Callable[[float, Plant, Loads], None]
Sense = Callable[[float, Plant, Reading], None]


class Simulated:
    """The effect in a simulated arm, called each millisecond like `sim_backend.plant.Effect`.

    load, sense, sense_motor : what to do in place of the methods of these names; effects with a memory are subclasses.
    """

    def __init__(
        self, load: Act | None = None, sense: Sense | None = None, sense_motor: Sense | None = None
    ) -> None:
        self._load, self._sense, self._sense_motor = load, sense, sense_motor

    def start(self, joints: int, random: np.random.Generator) -> None:
        """Begin a run of an arm with `joints` joints."""

    def load(self, time_s: float, plant: Plant, loads: Loads) -> None:
        """Change the torques and the friction of the cycle from `time_s` on."""
        if self._load is not None:
            self._load(time_s, plant, loads)

    def sense(self, time_s: float, plant: Plant, reading: Reading) -> None:
        """Change position and joint torque as reported."""
        if self._sense is not None:
            self._sense(time_s, plant, reading)

    def sense_motor(self, time_s: float, plant: Plant, reading: Reading) -> None:
        """Change the motor torque as reported."""
        if self._sense_motor is not None:
            self._sense_motor(time_s, plant, reading)


class Effect(ABC):
    """One cause: all that the software knows of it. Subclasses state the class variables and implement the methods.

    cause, side : as in the table of the diagnosis. summary : what is wrong, in a few words. physics : a sentence.
    source : literature. parameters : all of them, the linear ones first in the order of the columns.
    forms : its forms, where it has several. depends_on : the variable that its torque follows.
    law : the variable of its law, for the model-form error; None where that is unknown.
    whole_arm : the effect belongs to no single joint. event : it acts during a part of the time only, found by a
        search over times. step : it sets in at its `time` and stays. displaces : it turns the link under load.
    channel : the torque channel it delays. counted : seen by counting samples, without a torque of its own.
    hidden : linear parameters that are 1 by the physics, left free in the search and not reported.
    evidence_factor : multiple of the usual evidence, where the nominal arm itself resembles it a little.
    beside_companions : its law is so coarse that parameters are estimated beside the companions.
    confused_with : causes alike in many motions.
    contains : causes that are special cases of it.
    mean_of : causes whose model-form error has this one as its mean.
    experiment, tell_apart : the motion that decides between it and the causes alike, and the same in words;
        `{joint}` stands for the joint's number. every_payload : the experiment needs every payload.
    """

    cause: ClassVar[str]
    side: ClassVar[EffectSide]
    summary: ClassVar[str]
    physics: ClassVar[str]
    source: ClassVar[str]
    parameters: ClassVar[tuple[Parameter, ...]]
    forms: ClassVar[type[Form] | None] = None
    depends_on: ClassVar[Variable]
    law: ClassVar[Law | None] = None
    whole_arm: ClassVar[bool] = False
    event: ClassVar[bool] = False
    step: ClassVar[bool] = False
    displaces: ClassVar[bool] = False
    channel: ClassVar[Literal["motor", "joint"] | None] = None
    counted: ClassVar[bool] = False
    hidden: ClassVar[tuple[str, ...]] = ()
    evidence_factor: ClassVar[float] = 1.0
    beside_companions: ClassVar[bool] = False
    confused_with: ClassVar[tuple[str, ...]] = ()
    contains: ClassVar[tuple[str, ...]] = ()
    mean_of: ClassVar[tuple[str, ...]] = ()
    experiment: ClassVar[Experiment]
    every_payload: ClassVar[bool] = False
    tell_apart: ClassVar[str]

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.cause}, {self.side} side: {self.summary})"

    # ---- torque ----

    def shapes(self, setting: Setting, joint: int) -> Sequence[Shape]:
        """Shapes to begin the search with; by default a single empty one, for a torque linear in everything."""
        return [Shape()]

    @abstractmethod
    def columns(self, motion: Motion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """Columns for the joint (counted from 0) and the shape."""

    def companions(self, motion: Motion, joint: int, setting: Setting) -> tuple[Column, ...]:
        """Columns of what comes with the cause in a real arm and is not in its law."""
        return ()

    @property
    def repeats(self) -> bool:
        """Whether it may be claimed several times: contacts come and go, what comes to stay comes once."""
        return self.event and not self.step

    @property
    def linear(self) -> tuple[Parameter, ...]:
        """The parameters that are the coefficients of the columns."""
        return tuple(p for p in self.parameters if not p.shape)

    @property
    def shape_parameters(self) -> tuple[Parameter, ...]:
        """The parameters that make the shape."""
        return tuple(p for p in self.parameters if p.shape)

    def continuous(self, shape: Shape) -> tuple[str, ...]:
        """Names of the shape parameters that may be refined between the points of the grid."""
        return tuple(p.name for p in self.shape_parameters if p.name in shape)

    def plausible(self, coefficients: Floats, shape: Shape) -> bool:
        """Whether the coefficients lie in their physically sensible ranges."""
        return all(p.low <= value <= p.high for p, value in zip(self.linear, coefficients, strict=False))

    def seen_in_samples(self, shape: Shape) -> bool:
        """Whether the samples themselves show the cause, so that significance by blocks is not needed as well."""
        return False

    def law_std(self, parameters: Parameters, form: Form | None) -> Parameters:
        """Standard deviations of parameters from the law itself, which is coarser than the physics."""
        return {}

    def mode(self, shape: Shape) -> Literal["within", "between"] | None:
        """Whether it acts within a session or between sessions, for causes with both."""
        return None

    def variable(self, parameters: Parameters) -> Variable:
        """The variable that its torque follows, with these parameters."""
        return self.depends_on

    # ---- beside other causes ----

    def follows_from(self, shape: Shape, coefficients: Floats, other: Effect, at: Shape, of: Floats) -> bool:
        """Whether this one, with these coefficients, is a consequence of `other` in the same joint.

        at, of : shape and coefficients of the other.
        """
        return False

    def same_as(self, setting: Setting, joint: int) -> str | None:
        """A cause of the same torque in these sessions, None where there is none."""
        return None

    # ---- values ----

    @property
    def known_forms(self) -> tuple[Form, ...]:
        """The forms of the effect, none where there is only one."""
        return () if self.forms is None else tuple(self.forms)

    def form_of(self, name: str | Form | None) -> Form | None:
        """The form of a name from a file. Raises ConfigurationError for a missing, unknown or foreign one."""
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
        return tuple(p for p in shown if form is None or p.name in form.uses)

    def check(self, parameters: Mapping[str, Any], form: str | Form | None, *, whole: bool = False) -> None:
        """Check names of parameters. whole : coefficients must be there too, and not only the shape.

        Raises ConfigurationError for a foreign and for a missing one.
        """
        used = self.used(self.form_of(form))
        foreign = sorted(set(parameters) - {p.name for p in (used if whole else self.parameters)})
        needed = [p.name for p in used if (p.shape or whole) and not p.optional]
        missing = [name for name in needed if name not in parameters]
        if foreign or missing:
            wrong = f"has no parameter {foreign[0]!r}" if foreign else f"needs `{missing[0]}`"
            listed = ", ".join(p.name for p in used)
            raise ConfigurationError(f"effect {self.cause} {wrong}; its parameters: {listed}")

    def shape_of(self, parameters: Parameters, form: str | Form | None = None) -> Shape:
        """The shape in a full set of parameter values."""
        values = {p.name: float(parameters[p.name]) for p in self.shape_parameters if p.name in parameters}
        return Shape(self.form_of(form), **values)

    def coefficients_of(self, parameters: Parameters) -> Floats:
        """The coefficients in a full set of parameter values."""
        return np.array(
            [float(parameters.get(p.name, 1.0 if p.name in self.hidden else 0.0)) for p in self.linear]
        )

    def torque(
        self, motion: Motion, joint: int, parameters: Parameters, form: str | Form | None = None
    ) -> tuple[Floats, Floats]:
        """Torque (N, n) [Nm] that the effect adds to the motor torque and to the joint torque."""
        total = np.zeros((2, len(motion.time), motion.n))
        columns = self.columns(motion, joint, self.shape_of(parameters, form))
        for value, column in zip(self.coefficients_of(parameters), columns, strict=False):
            for side, part in enumerate(column.wide(joint, motion.n)):
                if part is not None:
                    total[side] += value * part
        return total[0], total[1]

    def derivative(
        self, motion: Motion, joint: int, parameters: Parameters, name: str, form: str | Form | None = None
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

    def in_session(self, parameters: Parameters, form: str | Form | None, number: int | None) -> Parameters:
        """The parameters in force in a session (from 0), None for a further one."""
        return parameters

    # ---- simulation and words ----

    @abstractmethod
    def simulate(self, joint: int, parameters: Parameters, form: str | Form | None = None) -> Simulated:
        """The effect as a part of a simulated arm."""

    def sentence(self, values: Values, form: Form | None, names: Sequence[str]) -> list[str]:
        """Phrases that say a finding's parameters. names : of the joints. KeyError where a value is missing."""
        known = {p.name: p for p in self.parameters}
        return [
            f"{spoken(name)} {quantity(value, share=name in known and known[name].share)}"
            for name, value in values.items()
        ]
