"""What a cause may look like beyond its law: so that what a strong one leaves is not taken for another.

A law is an idealisation. A hose is no plain spring, friction falls with speed in its own way, a payload that is
not the announced one has another inertia too. What the law of a strong cause leaves may exceed the noise by far,
and then another cause that happens to resemble it is significant. It is a cause of its own only if it remains
beside any function of the first one's own variable, acting on the same rows in the same proportion.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ident.discrepancy.candidates import Dictionary, Trial
from ident.discrepancy.evidence import Floats, Key, Rows
from ident.discrepancy.probes import groups, hats, hats_of
from ident.effects import EFFECTS
from ident.effects.body import inertia_columns
from ident.effects.operators import dahl

__all__ = ["beyond_law", "turning"]

# Variable of a law, and whether it scales what has the sign of the drive's direction.
_OWN: Mapping[str, tuple[str, bool]] = {
    "cable_spring": ("q", False),
    "sensor_ripple": ("q", False),
    "gear_ripple": ("q", False),
    "friction_position": ("q", True),
    "stribeck": ("qd", False),
    "viscous_nonlinear": ("qd", False),
    "friction_asymmetry": ("qd", False),
    "friction_load": ("load", True),
    "motor_torque_gain": ("load", False),
    "sensor_gain": ("load", False),
    "sensor_saturation": ("load", False),
    "sensor_hysteresis": ("load", False),
    "friction_temperature": ("time", True),
    "sensor_offset_drift": ("time", False),
}
_BODIES = ("payload_error", "payload_change")
_TWISTS = ("joint_elasticity", "backlash")
# Distance in which a hose that rubs along the arm turns its friction [rad].
_RUB_RAD = 0.1


def beyond_law(dictionary: Dictionary, trial: Trial) -> Rows | None:
    """Columns of what the trial's cause may show beyond its law, None where nothing is known of it.

    Hat functions of its own variable on the sides that it acts on, one coefficient for all of them; of a hose its
    rubbing too; of a body that differs the rest of its inertial parameters; of a joint that gives way any turn of
    the link that depends on the load.
    """
    cause, joint = trial.candidate.cause, trial.candidate.joint
    if cause in _BODIES:
        return _inertia(dictionary, trial)
    if cause in _TWISTS:
        return _twist(dictionary, joint)
    if cause not in _OWN:
        return None
    variable, signed = _OWN[cause]
    name = "time" if variable == "time" else f"{variable}{joint + 1}"
    found: dict[Key, Floats] = {}
    own = {key: value for key, value in hats_of(dictionary).items() if key == name}
    for side, at in trial.rows:
        if at != joint or not own:
            continue
        if variable == "qd":
            columns = _of_speed(dictionary, side, joint)
            if cause == "stribeck":
                columns = np.column_stack([columns, _turning(dictionary, side, joint)])
            found[side, joint] = columns
            continue
        group = groups(dictionary, own, side, joint)
        wanted = f"{name} sign(qd{joint + 1})" if signed else name
        # All hats together are a constant, which the base has.
        columns = group[wanted][side, joint][:, 0 if signed else 1 :]
        if cause == "cable_spring":
            columns = np.column_stack([columns, _rubbing(dictionary, side, joint)])
        found[side, joint] = columns
    return found or None


def turning(dictionary: Dictionary, trial: Trial) -> Rows | None:
    """Columns of how the friction of a trial may turn after a reversal, None of what is no such friction."""
    if trial.candidate.cause != "stribeck":
        return None
    joint = trial.candidate.joint
    return {(side, at): _turning(dictionary, side, at) for side, at in trial.rows if at == joint}


def _of_speed(dictionary: Dictionary, side: str, joint: int) -> Floats:
    """Functions (m, k) of a drive's speed and of its direction, finer the slower it is: laws of friction differ most
    there.
    """
    motions = dictionary.nominal.motions
    roots = [np.sqrt(np.abs(m.motor_speed[:, joint])) for m in motions]
    high = max(float(root.max()) for root in roots)
    parts = [hats(root, 0.0, high)[:, 1:] for root in roots]
    signed = [part * m.direction[:, joint : joint + 1] for part, m in zip(parts, motions, strict=True)]
    both = [np.column_stack(pair) for pair in zip(parts, signed, strict=True)]
    return dictionary.nominal.reduce(side, both)


def _turning(dictionary: Dictionary, side: str, joint: int) -> Floats:
    """Friction (m, k) that turns over other ways after a reversal: bristles that carry more at low speed are no
    stiffer, so they bend further before they slip.
    """
    effect, motions = EFFECTS["presliding_hysteresis"], dictionary.nominal.motions
    found = []
    for shape in effect.shapes(dictionary.setting, joint):
        for columns in zip(*(effect.columns(m, joint, shape) for m in motions), strict=True):
            parts = [part for part in (getattr(column, side) for column in columns) if part is not None]
            if parts:
                found.append(dictionary.nominal.reduce(side, parts))
    return np.column_stack(found)


def _twist(dictionary: Dictionary, joint: int) -> Rows | None:
    """What a turn of the joint by each hat function of its load does to all torques."""
    nominal = dictionary.nominal
    loads = hats_of(dictionary).get(f"load{joint + 1}")
    if loads is None:
        return None
    turns = [EFFECTS["joint_zero_offset"].columns(m, joint, {})[0] for m in nominal.motions]
    found: dict[Key, Floats] = {}
    for side in nominal.rows:
        parts = [
            turn.wide(joint, m.n)[side == "joint"] for turn, m in zip(turns, nominal.motions, strict=True)
        ]
        for k in range(nominal.arm.chain.n):
            signals = [p[:, k : k + 1] * h for p, h in zip(parts, loads, strict=True) if p is not None]
            columns = nominal.reduce(side, signals)
            if np.any(columns):
                found[side, k] = columns
    # A turn about an axis along gravity changes no torque.
    return found or None


def _rubbing(dictionary: Dictionary, side: str, joint: int) -> Floats:
    """Dahl's friction (m,) along the angle of a joint, in rows of a side."""
    motions = dictionary.nominal.motions
    states = [dahl(np.ascontiguousarray(m.q[:, joint]), _RUB_RAD, 0.0) for m in motions]
    return dictionary.nominal.reduce(side, states)


def _inertia(dictionary: Dictionary, trial: Trial) -> Rows:
    """Torque of unit moments and products of inertia of the last link, where the trial acts."""
    nominal = dictionary.nominal
    by_motion = [inertia_columns(m) for m in nominal.motions]
    found: dict[Key, Floats] = {}
    for side, joint in trial.rows:
        # What the trial's own columns are zero at is not loaded, or was before.
        on = np.any(trial.rows[side, joint] != 0.0, axis=1)
        parts = [
            nominal.reduce(side, [columns[k][:, joint] for columns in by_motion])
            for k in range(len(by_motion[0]))
        ]
        found[side, joint] = np.stack(parts, axis=1) * on[:, None]
    return found
