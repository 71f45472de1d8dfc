"""What is hidden: the words for it, and what draws it.

A cause is drawn once (its joint, its shape, when it happens) and then has a size that can be turned up and
down. Size one is near what a person begins to see in a plot of the held-out error.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from tests.hidden_physics.motions import PERIOD_S, PERIODS, REST_S
from tests.hidden_physics.robots import SESSIONS, Encoder, Setting
from tests.hidden_physics.traits import JOINTS

__all__ = [
    "COULOMB",
    "JOINT_NOISE",
    "MOTOR_NOISE",
    "Cause",
    "Draw",
    "Hidden",
    "Random",
    "Scene",
    "Settings",
    "either_sign",
    "everywhere",
    "fault",
    "log_uniform",
    "trait",
]

COULOMB = (15.04, 16.48, 8.77, 9.96, 5.58, 4.41, 4.16)
MOTOR_NOISE = (0.4, 0.42, 0.26, 0.25, 0.18, 0.085, 0.1)
JOINT_NOISE = (0.155, 0.16, 0.096, 0.105, 0.098, 0.037, 0.045)

Random = np.random.Generator
Settings = tuple[Setting, ...]


@dataclass(frozen=True)
class Scene:
    """What a cause may depend on besides chance.

    peaks : (7,) largest joint torque of the healthy twin [Nm]. reached : (7,) what both the sessions to learn
    from and the one held out reach, and not for a moment only [Nm]. begin_s : cabinet's clock as motions begin [s]
    """

    peaks: tuple[float, ...]
    reached: tuple[float, ...]
    begin_s: float

    def moment(self, random: Random, low: float = 0.2, high: float = 0.8) -> float:
        """A time within the periods, on the cabinet's clock [s]."""
        return self.begin_s + REST_S + PERIODS * PERIOD_S * random.uniform(low, high)


@dataclass(frozen=True)
class Hidden:
    """One hidden cause, of one size: the truth.

    cause : name in the catalogue, or of an effect that it does not have. joints : 1 to 7, empty for the arm
    settings : of each session. parameters : what a diagnosis may state, by its name; time in seconds from the
    first row of the motion. depends_on : variables, for causes outside the catalogue
    passing : it is another in each session, so what was learnt of it predicts no other
    """

    cause: str
    side: str
    joints: tuple[int, ...]
    size: float
    settings: Settings
    parameters: Mapping[str, float] = field(default_factory=dict)
    depends_on: tuple[str, ...] = ()
    variant: str = ""
    passing: bool = False

    @property
    def listed(self) -> bool:
        """Whether the catalogue has it: what it has not is told by what it depends on."""
        return not self.depends_on


Draw = Callable[[Random, int, Scene], Callable[[float], Hidden]]


@dataclass(frozen=True)
class Cause:
    """A way to hide something.

    joints : where it can be; (0,) for the whole arm. encoder : side that must be published, None for either
    absorbed : the base parameters take most of it up, so that little shows without a reference
    """

    name: str
    side: str
    draw: Draw
    joints: tuple[int, ...] = tuple(range(1, JOINTS + 1))
    encoder: Encoder | None = None
    absorbed: bool = False


def everywhere(setting: Setting) -> Settings:
    """The same in all sessions."""
    return (setting,) * SESSIONS


def either_sign(random: Random) -> float:
    """1 or -1."""
    return float(random.choice((-1.0, 1.0)))


def log_uniform(random: Random, low: float, high: float) -> float:
    """Uniform in the logarithm."""
    return float(np.exp(random.uniform(math.log(low), math.log(high))))


def trait(joint: int, **values: float) -> Setting:
    """Values of a joint of the arm."""
    return Setting(traits={name: {joint: value} for name, value in values.items()})


def fault(joint: int, **values: float) -> Setting:
    """Values of a joint's sensors."""
    return Setting(faults={name: {joint: value} for name, value in values.items()})
