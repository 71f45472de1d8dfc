"""What an effect is: a cause with its physics, its torque, and a simulation of it.

An effect adds torque to the model's. It is linear in some of its parameters and not in the others, its
*shape* (a speed, a length, a time): the torque is `sum_i c_i x_i(motion, shape)`, the columns x_i as seen in
the motor torque and in the joint torque. Estimation needs the columns, a grid of shapes to begin with, and
the way from coefficients to physical parameters and back. Simulation needs what the effect does to an arm
each millisecond.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from fri.errors import ConfigurationError
from ident.effects.motion import Floats, Motion

__all__ = ["Column", "Effect", "EffectSide", "Parameter", "Setting", "Shape", "Simulated", "encoder_sides"]

EffectSide = Literal["motor", "joint", "sensor", "timing"]
Shape = Mapping[str, float]


@dataclass(frozen=True)
class Parameter:
    """A parameter of an effect: name, SI unit, meaning. `shape`: the torque is not linear in it.

    low, high : range that makes physical sense.
    """

    name: str
    unit: str
    meaning: str
    shape: bool = False
    low: float = -np.inf
    high: float = np.inf


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
        (n,) whether the joint torque changes its sign for more than a moment. encoder : side of the elastic
        joints that publishes the positions, None where unknown. reach : (n,) of the presliding that the model has
        already [rad], None where unknown. compared : whether the sessions are held against a reference.
        compliance : (n,) [rad/Nm] of the
        springs that the links hang on behind published motors, None where the links' positions are published.
        clipped : (n,) torque [Nm] at which the samples of a joint's sensor stop, NaN where they do not.
    """

    sessions: int
    durations_s: tuple[float, ...]
    gear_ratio: Floats
    torque_range: Floats
    torque_turns: NDArray[np.bool_]
    speed_range: Floats
    position_range: Floats
    encoder: Literal["link", "motor"] | None = None
    reach: Floats | None = None
    compared: bool = False
    compliance: Floats | None = None
    clipped: Floats | None = None


def encoder_sides(setting: Setting) -> tuple[float, ...]:
    """Values of a shape's `encoder` to try: 1 motor, 0 link."""
    known = {"motor": (1.0,), "link": (0.0,)}
    return (1.0, 0.0) if setting.encoder is None else known[setting.encoder]


class Simulated:
    """What an effect does to a simulated arm, called each millisecond in the way of
    `sim_backend.plant.Effect`.
    """

    def start(self, joints: int, random: np.random.Generator) -> None:
        """Begin a run of an arm with `joints` joints."""

    def load(self, time_s: float, plant: Any, loads: Any) -> None:
        """Change the torques and the friction of the cycle that begins at `time_s`."""

    def sense(self, time_s: float, plant: Any, reading: Any) -> None:
        """Change position and joint torque as the sensors report them."""

    def sense_motor(self, time_s: float, plant: Any, reading: Any) -> None:
        """Change the motor torque as it is reported."""


class Effect(ABC):
    """One cause. Subclasses state the class variables and implement the methods.

    cause, side : as in the table of the diagnosis. physics : a sentence. source : where it is described.
    parameters : all of them, the linear ones first in the order of the columns.
    whole_arm : the effect belongs to no single joint. event : it acts during a part of the time
    only, found by
        a search over times. step : it sets in at its `time` and stays.
    hidden : linear parameters that are 1 by the physics, left free in the search and not reported.
    optional : parameters that belong to some forms of the effect only, 0 for the others.
    scrutiny : how many times the usual evidence it takes, where the nominal arm itself is a little like it.
    tell_apart : the motion that decides between this cause and those that it is mistaken for;
    `{joint}` stands
        for the joint's number.
    """

    cause: ClassVar[str]
    side: ClassVar[EffectSide]
    physics: ClassVar[str]
    source: ClassVar[str]
    parameters: ClassVar[tuple[Parameter, ...]]
    whole_arm: ClassVar[bool] = False
    event: ClassVar[bool] = False
    step: ClassVar[bool] = False
    hidden: ClassVar[tuple[str, ...]] = ()
    optional: ClassVar[tuple[str, ...]] = ()
    scrutiny: ClassVar[float] = 1.0
    tell_apart: ClassVar[str] = "repeat the motion at half the speed and with another payload"

    @abstractmethod
    def shapes(self, setting: Setting, joint: int) -> Sequence[Shape]:
        """Shapes to begin the search with; a single empty one where the torque is linear in everything."""

    @abstractmethod
    def columns(self, motion: Motion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """Columns for the joint (counted from 0) and the shape."""

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
        """Whether the coefficients lie in the ranges that make physical sense."""
        return all(p.low <= value <= p.high for p, value in zip(self.linear, coefficients, strict=False))

    def witnessed(self, shape: Shape) -> bool:
        """Whether the samples themselves show the cause, so that it need not be significant by blocks as well."""
        return False

    def coarse(self, parameters: Mapping[str, float]) -> Mapping[str, float]:
        """Standard deviations of parameters that come from the law itself, which says less than what happens."""
        return {}

    def mode(self, shape: Shape) -> str | None:
        """A word on the way the cause shows, where there are several."""
        return None

    def shape_of(self, parameters: Mapping[str, float]) -> dict[str, float]:
        """The shape in a full set of parameter values."""
        return {p.name: float(parameters[p.name]) for p in self.shape_parameters if p.name in parameters}

    def coefficients_of(self, parameters: Mapping[str, float]) -> Floats:
        """The coefficients in a full set of parameter values."""
        return np.array(
            [float(parameters.get(p.name, 1.0 if p.name in self.hidden else 0.0)) for p in self.linear]
        )

    def torque(self, motion: Motion, joint: int, parameters: Mapping[str, float]) -> tuple[Floats, Floats]:
        """Torque (N, n) [Nm] that the effect adds to the motor torque and to the joint torque."""
        coefficients = self.coefficients_of(parameters)
        total = np.zeros((2, len(motion.time), motion.n))
        for value, column in zip(
            coefficients, self.columns(motion, joint, self.shape_of(parameters)), strict=False
        ):
            for side, part in enumerate(column.wide(joint, motion.n)):
                if part is not None:
                    total[side] += value * part
        return total[0], total[1]

    def derivative(
        self, motion: Motion, joint: int, parameters: Mapping[str, float], name: str
    ) -> tuple[Floats, Floats]:
        """Derivative (N, n) of both torques by the parameter `name`.

        Exact for linear parameters, a central difference for the others. Raises ConfigurationError for a name
        that the effect does not have.
        """
        known = [p.name for p in self.parameters]
        if name not in known:
            raise ConfigurationError(f"{self.cause} has no parameter {name!r}; it has {', '.join(known)}")
        value = float(parameters.get(name, 0.0))
        linear = name in [p.name for p in self.linear]
        step = 1.0 if linear else 1e-3 * (abs(value) or 1.0)
        low = 0.0 if linear else value - step
        high = 1.0 if linear else value + step
        upper = self.torque(motion, joint, {**parameters, name: high})
        lower = self.torque(motion, joint, {**parameters, name: low})
        span = high - low
        return (upper[0] - lower[0]) / span, (upper[1] - lower[1]) / span

    @abstractmethod
    def simulate(self, joint: int, parameters: Mapping[str, float]) -> Simulated:
        """The effect as a part of a simulated arm."""
