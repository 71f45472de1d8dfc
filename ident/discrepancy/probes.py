"""What has no name: generic functions of the motion that still predict the residual on held-back parts.

For each joint and side a group of hat functions of one variable (angle, speed or load of the joint, angle of
another joint, time), plain and times the sign of the joint's speed, is scored like any candidate. What it
finds is reported by its variables, and names that were given while much was left are doubted.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ident.discrepancy.candidates import Dictionary
from ident.discrepancy.evidence import Evidence, Floats, Key
from ident.discrepancy.settings import DiagnosisSettings
from ident.effects.motion import Motion

__all__ = ["Remainder", "find_remainders"]

_HATS = 7
_RIDGE = 1e-3
# Generic functions find a little everywhere; less than this share of the noise is not worth a word.
_LEAST_INFLATION = 0.012


@dataclass(frozen=True)
class Remainder:
    """Something left in the rows of a joint (from 1) and side that depends on the named variables."""

    side: str
    joint: int
    depends_on: tuple[str, ...]
    gain: float
    inflation: float


def find_remainders(
    dictionary: Dictionary, evidence: Evidence, settings: DiagnosisSettings
) -> tuple[Remainder, ...]:
    """Remainders beside the columns that the evidence holds, largest first; at most two variables each."""
    fixed = list(evidence.extra)
    found = []
    for side in evidence.nominal.rows:
        for joint in range(evidence.nominal.arm.chain.n):
            if evidence.mask[side, joint].sum() < 100:
                continue
            remainder = _one(dictionary, evidence, settings, side, joint)
            evidence.replace(fixed)
            if remainder is not None:
                found.append(remainder)
    return tuple(sorted(found, key=lambda r: -r.gain))


def _one(
    dictionary: Dictionary, evidence: Evidence, settings: DiagnosisSettings, side: str, joint: int
) -> Remainder | None:
    names: list[str] = []
    total = inflation = 0.0
    groups = _groups(dictionary, side, joint)
    fixed = list(evidence.extra)
    for _ in range(2):
        best_name, best_gain, best_rows, best_inflation = "", 0.0, None, 0.0
        for name, rows in groups.items():
            score = evidence.score(evidence.padded(rows), ridge=_RIDGE)
            least = settings.least_gain + 2.0 * _HATS
            if score.gain > max(least, best_gain) and score.inflation > _LEAST_INFLATION:
                best_name, best_gain, best_rows = name, score.gain, rows
                best_inflation = score.inflation
        if best_rows is None:
            break
        total += best_gain
        inflation += best_inflation
        names += [part for part in best_name.split(" ") if part not in names]
        groups.pop(best_name)
        fixed = [*fixed, best_rows]
        evidence.replace(fixed)
    return Remainder(side, joint + 1, tuple(names), total, inflation) if names else None


def _groups(dictionary: Dictionary, side: str, joint: int) -> dict[str, dict[Key, Floats]]:
    """Groups of columns by the names of their variables."""
    n = dictionary.nominal.arm.chain.n
    variables: dict[str, Callable[[Motion], Floats]] = {
        f"q{joint + 1}": lambda m: m.q[:, joint],
        f"qd{joint + 1}": lambda m: m.motor_speed[:, joint],
        f"load{joint + 1}": lambda m: m.joint_torque[:, joint],
        "time": lambda m: m.time,
    }
    for k in range(n):
        if k != joint:
            variables[f"q{k + 1}"] = lambda m, k=k: m.q[:, k]  # type: ignore[misc]
            variables[f"qd{k + 1}"] = lambda m, k=k: m.motor_speed[:, k]  # type: ignore[misc]
    found: dict[str, dict[Key, Floats]] = {}
    for name, variable in variables.items():
        values = [variable(m) for m in dictionary.nominal.motions]
        low = min(float(v.min()) for v in values)
        high = max(float(v.max()) for v in values)
        if high - low < 1e-6:
            continue
        hats = [_hats(v, low, high) for v in values]
        found[name] = {(side, joint): dictionary.nominal.reduce(side, hats)}
        if not name.startswith("qd"):
            signed = [
                h * np.sign(m.motor_speed[:, joint : joint + 1])
                for h, m in zip(hats, dictionary.nominal.motions, strict=True)
            ]
            found[f"{name} sign(qd{joint + 1})"] = {(side, joint): dictionary.nominal.reduce(side, signed)}
    return found


def _hats(values: Floats, low: float, high: float) -> Floats:
    """Piecewise linear functions (N, 7) with knots evenly over the range."""
    place = (values - low) / (high - low) * (_HATS - 1)
    return np.maximum(0.0, 1.0 - np.abs(place[:, None] - np.arange(_HATS)))
