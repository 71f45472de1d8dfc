"""Torque of a model's effects, and the motion as the effects see it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from fri.errors import ConfigurationError
from ident import regressor
from ident.effects.motion import Floats, Motion

if TYPE_CHECKING:
    from ident.model import DynamicModel
    from ident.structure import Side

__all__ = ["check_entry", "effects_torque", "parameter_values"]

_ENTRY = frozenset({"cause", "side", "joints", "form", "parameters"})


def check_entry(entry: Mapping[str, Any], joints: int) -> None:
    """Check an entry of a model's effects: known cause and parameters, joints from 1 to `joints`.

    Raises ConfigurationError with the entry, the value and what is allowed.
    """
    from ident.effects import find_effect

    unknown = set(entry) - _ENTRY
    if unknown or not {"cause", "joints", "parameters"} <= set(entry):
        raise ConfigurationError(
            f"effect {dict(entry)!r}: an entry has the keys cause, side, joints, form where there are several, "
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
    model: DynamicModel,
    q: Floats,
    qd: Floats,
    qdd: Floats,
    linear: Mapping[str, Floats],
    *,
    side: Side,
    payload: str | None = None,
    time: Floats | None = None,
    measured: bool = False,
) -> Floats:
    """Torque (N, n) [Nm] that the model's effects add to one side.

    linear : torque (N, n) of the linear model by side, at least the joint's. time : (N,) [s], evenly spaced;
    default 1 ms steps. measured : what sensors add to the physics counts too. Effects of a moment (a contact,
    a payload that came loose) and late channels are properties of a session, not of the arm, and left out.
    """
    from ident.effects import find_effect

    total = np.zeros_like(q)
    motion = _motion(model, q, qd, qdd, linear, payload, time)
    for entry in model.effects:
        effect = find_effect(str(entry["cause"]))
        if effect.event or effect.side == "timing" or (effect.side == "sensor" and not measured):
            continue
        values = parameter_values(entry)
        for joint in entry["joints"] or [1]:
            motor, link = effect.torque(motion, int(joint) - 1, values, entry.get("form"))
            total += motor if side == "motor" else link if side == "joint" else motor - link
    return total


def _motion(
    model: DynamicModel,
    q: Floats,
    qd: Floats,
    qdd: Floats,
    linear: Mapping[str, Floats],
    payload: str | None,
    time: Floats | None,
) -> Motion:
    chain, drive = model.structure.chain, model.drive()
    bodies = model.inertial(payload)
    joint = linear.get("joint")
    if joint is None:
        joint = regressor.torque(chain, q, qd, qdd, bodies)
    stamps: Floats = np.arange(len(q), dtype=np.float64) * 1e-3
    if time is not None:
        stamps = time - time[0]

    def friction(speed: Floats) -> Floats:
        return drive["Fvm"] * speed + drive["Fcm"] * np.sign(speed)

    return Motion(
        chain=chain,
        bodies=bodies,
        session=1,
        time=stamps,
        duration_s=float(stamps[-1]) if len(stamps) else 0.0,
        q=q,
        qd=qd,
        qdd=qdd,
        motor_speed=qd,
        motor_acceleration=qdd,
        joint_torque=joint,
        motor_torque=linear.get("motor", joint),
        gear_ratio=np.ones(chain.n),
        inertia=drive["Ia"],
        link_coulomb=drive["Fcl"],
        motor_coulomb=drive["Fcm"],
        friction=friction,
    )
