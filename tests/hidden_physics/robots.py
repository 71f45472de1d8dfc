"""Healthy arms with their honest tolerances, and the settings by which a cabinet becomes one of them.

Every day the same arm is a little different: stiffness, damping, presliding and the lateness of its channels
move by a few per cent within what nobody would call a fault.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from tests.hidden_physics.traits import JOINTS, every, merged

__all__ = ["SESSIONS", "Day", "Encoder", "Setting", "session_settings"]

SESSIONS = 3
"""Sessions of a case: without payload, with payload, and one held out, with payload."""

Encoder = Literal["link", "motor"]

_STIFFNESS, _DAMPING, _PRESLIDING = 0.03, 0.1, 0.03
_JOINT_LATE_S, _MOTOR_LATE_S = (0.1e-3, 0.4e-3), (0.7e-3, 1.3e-3)


@dataclass(frozen=True)
class Setting:
    """What is different in one session of an arm; the neutral one changes nothing.

    traits, faults : values by name and joint. leak, held : see `sensing.SensorChain`. tilt, contacts, load :
    see `arm.HiddenArm`
    """

    traits: Mapping[str, Mapping[int, float]] = field(default_factory=dict)
    faults: Mapping[str, Mapping[int, float]] = field(default_factory=dict)
    leak: Mapping[int, Mapping[int, float]] = field(default_factory=dict)
    held: Mapping[str, Any] = field(default_factory=dict)
    tilt: tuple[float, float] = (0.0, 0.0)
    contacts: tuple[Mapping[str, Any], ...] = ()
    load: Mapping[str, Any] = field(default_factory=dict)

    def joined(self, other: Setting) -> Setting:
        """Both at once. ValueError where both change the same thing."""
        for mine, others in ((self.traits, other.traits), (self.faults, other.faults)):
            for name, values in others.items():
                if set(values) & set(mine.get(name, {})):
                    raise ValueError(f"{name!r} of a joint would be changed twice")
        for name in ("held", "load"):
            if getattr(self, name) and getattr(other, name):
                raise ValueError(f"{name!r} would be changed twice")
        return Setting(
            merged(self.traits, other.traits),
            merged(self.faults, other.faults),
            {**self.leak, **other.leak},
            {**self.held, **other.held},
            (self.tilt[0] + other.tilt[0], self.tilt[1] + other.tilt[1]),
            (*self.contacts, *other.contacts),
            {**self.load, **other.load},
        )


@dataclass(frozen=True)
class Day:
    """The healthy arm on one day.

    number : of the day; encoder : which side of the joints is published. ideal : without tolerances
    """

    number: int
    encoder: Encoder = "link"
    ideal: bool = False

    def setting(self) -> Setting:
        """Its tolerances."""
        random = np.random.default_rng((20_000 + self.number, 1))
        spread = 0.0 if self.ideal else 1.0

        def around(middle: float, relative: float) -> Mapping[int, float]:
            return every(middle * (1.0 + spread * relative * random.uniform(-1.0, 1.0, JOINTS)))

        def late(bounds: Sequence[float]) -> Mapping[int, float]:
            low, high = bounds
            value = 0.5 * (low + high) + spread * 0.5 * (high - low) * random.uniform(-1.0, 1.0)
            return every([value] * JOINTS)

        return Setting(
            traits={
                "stiffness": around(1.0, _STIFFNESS),
                "damping": around(1.0, _DAMPING),
                "presliding": around(1e-4, _PRESLIDING),
            },
            faults={"late": late(_JOINT_LATE_S), "motor_late": late(_MOTOR_LATE_S)},
        )

    def seed(self, session: int) -> int:
        """Seed of the noise in a session of this day."""
        return int(np.random.SeedSequence((self.number, session)).generate_state(1)[0])


def session_settings(day: Day, hidden: Setting) -> dict[str, Any]:
    """Settings of the emulated cabinet for a session of `day` with `hidden` in it.

    A hidden lateness comes on top of the day's, a hidden stiffness or presliding multiplies it.
    """
    base = day.setting()
    traits, faults = merged(base.traits, hidden.traits), merged(base.faults, hidden.faults)
    for name, values in hidden.traits.items():
        if name in ("stiffness", "presliding"):
            for joint, value in values.items():
                factor = value if name == "stiffness" else value / 1e-4
                traits[name][joint] = factor * base.traits[name][joint]
    for name in ("late", "motor_late"):
        for joint, value in hidden.faults.get(name, {}).items():
            faults[name][joint] = value + base.faults[name][joint]
    plant: dict[str, Any] = {"traits": _plain(traits)}
    if hidden.tilt != (0.0, 0.0):
        plant["tilt"] = list(hidden.tilt)
    if hidden.contacts:
        plant["contacts"] = [dict(contact) for contact in hidden.contacts]
    if hidden.load:
        plant["load"] = dict(hidden.load)
    chain: dict[str, Any] = {"faults": _plain(faults)}
    if hidden.leak:
        chain["leak"] = _plain(hidden.leak)
    if hidden.held:
        chain["held"] = dict(hidden.held)
    return {
        "sensors.position_sensor": day.encoder,
        "robot.plant": {"type": "tests.hidden_physics.arm:HiddenArm", "options": plant},
        "robot.effects": [{"type": "tests.hidden_physics.sensing:SensorChain", "options": chain}],
    }


def _plain(values: Mapping[Any, Mapping[int, float]]) -> dict[str, dict[str, float]]:
    """Keys as text: what a configuration file and a command line can carry."""
    return {
        str(name): {str(joint): float(value) for joint, value in row.items()} for name, row in values.items()
    }
