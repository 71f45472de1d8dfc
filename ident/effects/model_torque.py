"""Entries of a model's effects: their check, their parameter values and the torque they add."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from fri.errors import ConfigurationError
from ident.dynamics.structure import Side
from ident.effects import find_effect
from ident.effects.motion import Floats, Motion

__all__ = ["check_entry", "effects_torque", "parameter_values"]

_ENTRY = frozenset({"cause", "side", "joints", "form", "parameters"})


def check_entry(entry: Mapping[str, Any], joints: int) -> None:
    """Check an entry of a model's effects: known cause and parameters, joints from 1 to `joints`.

    Raises ConfigurationError with the entry, the value and the allowed ones.
    """
    unknown = set(entry) - _ENTRY
    if unknown or not {"cause", "joints", "parameters"} <= set(entry):
        raise ConfigurationError(
            f"effect {dict(entry)!r}: an entry has the keys cause, side, joints, form if there are several, "
            "parameters, each with value, std, unit"
        )
    effect = find_effect(str(entry["cause"]))
    numbers = list(entry["joints"])
    if any(not isinstance(j, int) or not 1 <= j <= joints for j in numbers):
        raise ConfigurationError(f"effect {effect.cause}: joints {numbers} must lie between 1 and {joints}")
    if effect.whole_arm == bool(numbers):
        wanted = "no joint, for it belongs to the whole arm" if effect.whole_arm else "the joints it acts on"
        raise ConfigurationError(f"effect {effect.cause}: `joints` is {numbers}; give {wanted}")
    effect.check(entry["parameters"], entry.get("form"))


def parameter_values(entry: Mapping[str, Any]) -> dict[str, float]:
    """Values of an entry's parameters by name."""
    return {
        name: float(value["value"] if isinstance(value, Mapping) else value)
        for name, value in entry["parameters"].items()
    }


def effects_torque(
    entries: Iterable[Mapping[str, Any]], motion: Motion, *, side: Side, measured: bool = False
) -> Floats:
    """Torque (N, n) [Nm] added to one side by the entries of a model's effects.

    measured : add the errors of the sensors to the physics. Events (a contact, a loosened payload) and delayed
    channels are properties of a session, not of the arm, and are left out.
    """
    total = np.zeros_like(motion.q)
    for entry in entries:
        effect = find_effect(str(entry["cause"]))
        if effect.event or effect.side == "timing" or (effect.side == "sensor" and not measured):
            continue
        values = parameter_values(entry)
        for joint in entry["joints"] or [1]:
            motor, link = effect.torque(motion, int(joint) - 1, values, entry.get("form"))
            total += motor if side == "motor" else link if side == "joint" else motor - link
    return total
