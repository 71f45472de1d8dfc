"""Figures of a diagnosis beside its verdict: errors of each row, parameters moved, errors of each session."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from ident.diagnosis.gain.held_out import HeldOut, interval
from ident.estimation.scores import finite

if TYPE_CHECKING:  # a diagnosis states its details itself
    from ident.diagnosis.outcome.result import Diagnosis

_SEED = 1


def row_gains(diagnosis: Diagnosis) -> list[dict[str, Any]]:
    """Held-out torque error of each joint (from 1) and side [Nm], as plain content of details.json.

    noise_floor : of the error of any model. healthy : the same error on the healthy arm of the reference, None if
    unknown. gain : base minus extended, with its 95 % interval from blocks drawn with replacement. avoidable : the part
    of the base model's error above the noise, its share as a share of power.
    """
    found = []
    for side, base in diagnosis.residuals.get("base", {}).items():
        block = {side: diagnosis.states[side].block}
        before = HeldOut({side: base}, block)
        after = HeldOut({side: diagnosis.residuals["extended"][side]}, block)
        if after.residual[side].shape != base.shape:
            continue
        for joint in np.flatnonzero(np.isfinite(base).any(axis=0)).tolist():
            rms_base, rms_extended, low, high = interval(before, after, [(side, joint)], _SEED)
            noise = float(diagnosis.noise_floor[side][joint])
            healthy = diagnosis.healthy_left.get(side, np.full(base.shape[1], np.nan))[joint]
            avoidable = math.sqrt(max(0.0, rms_base**2 - noise**2))
            found.append(
                {
                    "side": side,
                    "joint": joint + 1,
                    "noise_floor": noise,
                    "healthy": float(healthy) if np.isfinite(healthy) else None,
                    "test_rms_base": rms_base,
                    "test_rms_extended": rms_extended,
                    "gain": rms_base - rms_extended,
                    "gain_interval_95": [low, high],
                    "avoidable": avoidable,
                    "avoidable_share": avoidable**2 / rms_base**2 if rms_base > 0.0 else 0.0,
                }
            )
    return found


def moved_parameters(diagnosis: Diagnosis) -> list[dict[str, Any]]:
    """Base parameters moved by the extension by more than two standard deviations, the furthest first: plain content.

    They had absorbed the findings. change_in_std : in standard deviations of the extended estimate.
    """
    base, extended = diagnosis.base_model, diagnosis.extended_model
    std = extended.std
    if std is None or not diagnosis.extension:
        return []
    units = dict(zip(extended.names, extended.units, strict=True))
    spread = dict(zip(extended.names, map(float, std), strict=True))
    found: list[dict[str, Any]] = []
    for name in diagnosis.changes:
        before, after, deviation = base.value(name), extended.value(name), spread[name]
        entry = {"name": name, "unit": units[name], "base": before, "extended": after, "std": deviation}
        found.append({**entry, "change_in_std": (after - before) / deviation if deviation > 0.0 else 0.0})
    return sorted(found, key=lambda entry: -abs(entry["change_in_std"]))


def session_errors(diagnosis: Diagnosis) -> list[dict[str, Any]]:
    """Relative torque error of base and extended model in each test session, the figure of `validate`: plain content;
    of sessions with both. present : of the present model, where there is one."""
    if diagnosis.torque_base is None or diagnosis.torque_extended is None:
        return []
    present = diagnosis.torque_present
    known = {} if present is None else {one.session: one.relative for one in present.scores}
    return [
        {
            "session": one.session,
            "by_side": {
                side: {"base": finite(error), "extended": finite(other.relative.get(side))}
                | ({"present": finite(known[one.session].get(side))} if one.session in known else {})
                for side, error in one.relative.items()
            },
        }
        for one, other in zip(diagnosis.torque_base.scores, diagnosis.torque_extended.scores, strict=True)
        if all(map(np.isfinite, (*one.relative.values(), *other.relative.values())))
    ]
