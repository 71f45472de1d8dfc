"""What has no name: generic functions of the motion that still predict the residual on held-back parts.

For each joint and side a group of hat functions of one variable (angle, speed, acceleration or load of the joint,
angle or speed of another joint, time), plain and times the sign of the joint's speed, those of an angle times the
joint's load too, is scored like any candidate, and so is a line in the spectrum (`lines`). What it finds is reported
by its variables, and names that were given while much was left are doubted.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ident.diagnosis.candidates import Dictionary
from ident.diagnosis.evidence import Evidence, Floats, Key, Rows
from ident.diagnosis.lines import find_line
from ident.diagnosis.nominal import TRAVEL_RAD
from ident.diagnosis.settings import DiagnosisSettings
from ident.effects.motion import Motion

__all__ = ["Remainder", "find_remainders", "groups", "hats", "hats_of"]

_HATS = 7
_RIDGE = 1e-3
# Generic functions find a little everywhere; less than this share of the noise is not worth a word.
_LEAST_INFLATION = 0.012


@dataclass(frozen=True)
class Remainder:
    """Something left in the rows of a joint (from 1) and side that depends on the named variables.

    rows : columns of the generic functions that it is made of. line_hz : frequency of a swing of its own, 0 without
    """

    side: str
    joint: int
    depends_on: tuple[str, ...]
    gain: float
    inflation: float
    rows: tuple[Rows, ...] = ()
    line_hz: float = 0.0


def find_remainders(
    dictionary: Dictionary, evidence: Evidence, settings: DiagnosisSettings
) -> tuple[Remainder, ...]:
    """Remainders beside the columns that the evidence holds, largest first; at most two variables each."""
    fixed = list(evidence.extra)
    found = []
    variables, residuals = hats_of(dictionary), evidence.residuals()
    for side in evidence.nominal.rows:
        for joint in range(evidence.nominal.arm.chain.n):
            if evidence.mask[side, joint].sum() < 100:
                continue
            line = find_line(evidence, side, joint, residuals[side][:, joint])
            remainder = _one(dictionary, evidence, settings, variables, line, side, joint)
            evidence.replace(fixed)
            if remainder is not None:
                found.append(remainder)
    return tuple(sorted(found, key=lambda r: -r.gain))


def _one(
    dictionary: Dictionary,
    evidence: Evidence,
    settings: DiagnosisSettings,
    variables: Mapping[str, Sequence[Floats]],
    line: tuple[float, Rows, int] | None,
    side: str,
    joint: int,
) -> Remainder | None:
    names: list[str] = []
    total = inflation = 0.0
    prepared = {}
    for name, rows in groups(dictionary, variables, side, joint).items():
        padded = evidence.padded(rows)
        prepared[name] = rows, padded, evidence.alone(padded)
    fixed = list(evidence.extra)
    taken: list[Rows] = []
    line_hz = 0.0
    if line is not None:
        frequency, waves, choices = line
        score = evidence.score(evidence.padded(waves))
        least = settings.least_gain + 2.0 * (len(score.coefficients) + np.log(choices))
        if score.gain > least and score.inflation > _LEAST_INFLATION:
            total, inflation, line_hz = score.gain, score.inflation, frequency
            names.append("time")
            taken.append(waves)
            evidence.replace([*fixed, *taken])
    for _ in range(2):
        best_name, best_gain, best_rows, best_inflation = "", 0.0, None, 0.0
        for name, (rows, padded, known) in prepared.items():
            score = evidence.score(padded, ridge=_RIDGE, known=known)
            least = settings.least_gain + 2.0 * _HATS
            if score.gain > max(least, best_gain) and score.inflation > _LEAST_INFLATION:
                best_name, best_gain, best_rows = name, score.gain, rows
                best_inflation = score.inflation
        if best_rows is None:
            break
        total += best_gain
        inflation += best_inflation
        names += [part for part in best_name.split(" ") if part not in names]
        prepared.pop(best_name)
        taken.append(best_rows)
        evidence.replace([*fixed, *taken])
    if not names:
        return None
    return Remainder(side, joint + 1, tuple(names), total, inflation, tuple(taken), line_hz)


def hats_of(dictionary: Dictionary) -> dict[str, list[Floats]]:
    """Hat functions of every variable by its name, for each motion."""
    variables: dict[str, Callable[[Motion], Floats]] = {"time": lambda m: m.time}
    for k in range(dictionary.nominal.arm.chain.n):
        variables[f"q{k + 1}"] = lambda m, k=k: m.q[:, k]  # type: ignore[misc]
        variables[f"qd{k + 1}"] = lambda m, k=k: m.motor_speed[:, k]  # type: ignore[misc]
        variables[f"qdd{k + 1}"] = lambda m, k=k: m.motor_acceleration[:, k]  # type: ignore[misc]
        variables[f"load{k + 1}"] = lambda m, k=k: m.joint_torque[:, k]  # type: ignore[misc]
    found = {}
    for name, variable in variables.items():
        values = [variable(m) for m in dictionary.nominal.motions]
        low = min(float(v.min()) for v in values)
        high = max(float(v.max()) for v in values)
        if high - low >= (TRAVEL_RAD if name[1:].isdigit() else 1e-6):
            found[name] = [hats(v, low, high) for v in values]
    return found


def groups(
    dictionary: Dictionary, variables: Mapping[str, Sequence[Floats]], side: str, joint: int
) -> dict[str, dict[Key, Floats]]:
    """Groups of columns by the names of their variables."""
    nominal, found = dictionary.nominal, {}
    signs = [m.direction[:, joint : joint + 1] for m in nominal.motions]
    loads = [m.joint_torque[:, joint : joint + 1] for m in nominal.motions]
    for name, parts in variables.items():
        of = name.rstrip("0123456789")
        if of in ("load", "qdd") and name != f"{of}{joint + 1}":
            continue
        found[name] = {(side, joint): nominal.reduce(side, parts)}
        factors = {} if of == "qd" else {f"sign(qd{joint + 1})": signs}
        if of == "q":
            factors[f"load{joint + 1}"] = loads
        for factor, values in factors.items():
            scaled = [part * value for part, value in zip(parts, values, strict=True)]
            found[f"{name} {factor}"] = {(side, joint): nominal.reduce(side, scaled)}
    return found


def hats(values: Floats, low: float, high: float) -> Floats:
    """Piecewise linear functions (N, 7) with knots evenly over the range."""
    place = (values - low) / (high - low) * (_HATS - 1)
    return np.maximum(0.0, 1.0 - np.abs(place[:, None] - np.arange(_HATS)))
