"""Model-form error: the rest beside the law of a strong cause, so that it is not taken for another cause.

A law is an idealisation. A hose is no plain spring, friction falls with speed in its own way, an unannounced payload
has another inertia too. The rest may exceed the noise by far, and then another cause of a similar torque is
significant. It is a cause of its own only if it remains beside any function of the first one's own variable, acting
on the same rows in the same proportion (Kennedy and O'Hagan, J. R. Stat. Soc. B 63 (2001)).
"""

from __future__ import annotations

import numpy as np

from ident.diagnosis.causes.candidates import Dictionary, Trial
from ident.diagnosis.causes.probes import groups, hats_of
from ident.diagnosis.gain.products import Floats, Key, Rows
from ident.effects import ZERO_OFFSET, Column, Shape
from ident.effects.effect import both_sides
from ident.effects.motion import ArmMotion
from ident.effects.nameless import hats


def model_form_error(dictionary: Dictionary, trial: Trial) -> Rows | None:
    """Columns of the trial's cause beyond its law, None without such knowledge.

    Hat functions of the law's variable on the sides of the cause, with common coefficients, beside the companions of
    the cause; for a compliant joint any turn of the link by the load.
    """
    effect, joint = trial.candidate.effect, trial.candidate.joint
    if effect.displaces:
        return _twist(dictionary, joint)
    beside = companions(dictionary, trial) or {}
    if effect.law is None:
        return beside or None
    name = "time" if effect.law.variable == "time" else f"{effect.law.variable}{joint + 1}"
    found: dict[Key, Floats] = {}
    own = hats_of(dictionary, name)
    for side, at in trial.rows:
        if at != joint or not own:
            continue
        if effect.law.variable == "qd":
            columns = _of_speed(dictionary, side, joint)
        else:
            group = groups(dictionary, own, side, joint)
            wanted = f"{name} sign(qd{joint + 1})" if effect.law.signed else name
            # The sum of all hats is a constant, already in the base.
            columns = group[wanted][side, joint][:, 0 if effect.law.signed else 1 :]
        more = [beside[side, joint]] if (side, joint) in beside else []
        found[side, joint] = np.column_stack([columns, *more])
    return found or None


def companions(dictionary: Dictionary, trial: Trial) -> Rows | None:
    """Columns of the torques accompanying the trial's cause in a real arm, in the rows of the trial."""
    effect, joint, nominal = trial.candidate.effect, trial.candidate.joint, dictionary.nominal
    own = max(joint, 0)
    parts: dict[Key, list[Floats]] = {}
    columns = nominal.columns(lambda motion: effect.companions(motion, own, dictionary.setting))
    for side, at in trial.rows:
        if joint >= 0 and at != joint:
            continue
        # A column of one joint acts on no other.
        for rows in columns[side]:
            if rows.ndim == 2 or at == own:
                parts.setdefault((side, at), []).append(rows if rows.ndim == 1 else rows[:, at])
    found = {key: np.column_stack(columns) for key, columns in parts.items()}
    if effect.whole_arm:
        # A body adds nothing before it is attached, nor to other joints.
        found = {key: v * np.any(trial.rows[key] != 0.0, axis=1)[:, None] for key, v in found.items()}
    return found or None


def _of_speed(dictionary: Dictionary, side: str, joint: int) -> Floats:
    """Functions (m, k) of a drive's speed and its direction, finer at low speed, where friction laws differ most."""
    nominal = dictionary.nominal
    high = float(np.sqrt(max(np.abs(m.motor_speed[:, joint]).max() for m in nominal.motions)))

    def made(motion: ArmMotion) -> tuple[Column, ...]:
        part = hats(np.sqrt(np.abs(motion.motor_speed[:, joint])), 0.0, high)[:, 1:]
        both = np.column_stack([part, part * motion.direction[:, joint : joint + 1]])
        return (Column(motor=both, joint=both),)

    return nominal.columns(made, [side])[side][0]


def _twist(dictionary: Dictionary, joint: int) -> Rows | None:
    """Change of all torques by a turn of the joint by each hat function of its load."""
    nominal = dictionary.nominal
    loads = hats_of(dictionary, f"load{joint + 1}").get(f"load{joint + 1}")
    if loads is None:
        return None

    def made(motion: ArmMotion) -> list[Column]:
        turn = ZERO_OFFSET.columns(motion, joint, Shape())[0].motor
        assert turn is not None
        of_load = loads.hats(motion)
        return [both_sides(turn[:, k : k + 1] * of_load) for k in range(motion.n)]

    found: dict[Key, Floats] = {}
    for side, columns in nominal.columns(made).items():
        found |= {(side, k): rows for k, rows in enumerate(columns) if np.any(rows)}
    # A turn about an axis along gravity changes no torque.
    return found or None
