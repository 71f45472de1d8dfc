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
from ident.diagnosis.nominal import TRAVEL_RAD
from ident.diagnosis.settings import DiagnosisSettings
from ident.effects.motion import Motion

__all__ = ["Remainder", "find_line", "find_remainders", "groups", "hats", "hats_of"]

# Of slower swings a session shows too few to tell them from a drift [Hz].
_LOWEST_HZ = 0.3
# Width of the spectrum beside a line that it is held against [Hz].
_BESIDE_HZ = 2.0
# Power of a line over the spectrum beside it; of a thousand frequencies chance makes ten of one.
_STANDS_OUT = 16.0
# The same in every session: what shakes the arm does not stop for one, what a wrong load leaves is in its own only.
_IN_EACH = 4.0
# Zero padding of the spectrum, so that a line falls between no two of its frequencies.
_PADDING = 4


def find_line(evidence: Evidence, side: str, joint: int, residual: Floats) -> tuple[float, Rows, int] | None:
    """Frequency [Hz] of the strongest line in the rows of a joint (from 0) and side, its columns, and the number of
    frequencies that it was chosen from; None where none stands out.

    residual : (m,) of these rows [Nm], NaN where a row is not used.
    Columns: a cosine and a sine for each session that is fitted, for nothing ties the phases of two together.
    """
    rows = evidence.nominal.rows[side]
    parts = [
        _not_repeating(evidence, side, residual, int(session))
        for session in np.unique(rows.session[~rows.test])
    ]
    even = [part for part in parts if part is not None]
    if not even:
        return None
    step = max(dt for _, dt in even)
    size = _PADDING * max(len(values) for values, _ in even)
    frequency: Floats = np.fft.rfftfreq(size, step).astype(np.float64)
    frequency = frequency[(frequency >= _LOWEST_HZ) & (frequency <= 0.4 / step)]
    if len(frequency) < 8 * _PADDING:
        return None
    each = np.array([_spectrum(values, dt, size, frequency) for values, dt in even])
    power = each.sum(axis=0)
    width = int(_BESIDE_HZ / (frequency[1] - frequency[0]))
    around = [slice(max(0, k - width), k + width + 1) for k in range(len(power))]
    beside = np.array([np.median(power[near]) for near in around])
    best = int(np.argmax(power / np.maximum(beside, 1e-300)))
    if power[best] < _STANDS_OUT * beside[best]:
        return None
    if np.any(each[:, best] < _IN_EACH * np.median(each[:, around[best]], axis=1)):
        return None
    top = float(frequency[best])
    if 0 < best < len(power) - 1:
        # The top of the parabola through the three largest.
        left, here, right = power[best - 1 : best + 2]
        top += 0.5 * float((left - right) / (left - 2.0 * here + right)) * float(frequency[1] - frequency[0])
    turn = 2.0 * np.pi * top * rows.time
    waves = [
        np.where((rows.session == session) & ~rows.test, wave(turn), 0.0)
        for session in np.unique(rows.session[~rows.test])
        for wave in (np.cos, np.sin)
    ]
    key: Key = (side, joint)
    return top, {key: np.column_stack(waves)}, len(frequency) // _PADDING


def _spectrum(values: Floats, dt: float, size: int, frequency: Floats) -> Floats:
    """Power of a session at the frequencies, over all its power."""
    power = np.abs(np.fft.rfft(values, size)) ** 2 / max(float(np.sum(values**2)), 1e-300)
    return np.interp(frequency, np.fft.rfftfreq(size, dt), power)


def _not_repeating(
    evidence: Evidence, side: str, residual: Floats, session: int
) -> tuple[Floats, float] | None:
    """What of a session's residual is another in every period, on an even grid with zeros in gaps, and the grid's
    step [s]; without repetition all of it. None where there is too little.
    """
    rows = evidence.nominal.rows[side]
    recording = next(r for r in evidence.nominal.recordings if r.number == session)
    mine = (rows.session == session) & np.isfinite(residual)
    if mine.sum() < 200:
        return None
    time, values = rows.time[mine] - recording.start_s, residual[mine]
    step = float(np.median(np.diff(rows.time[rows.session == session])))
    place = np.round((time - time[0]) / step).astype(np.int64)
    even, known = np.zeros(place[-1] + 1), np.zeros(place[-1] + 1, dtype=bool)
    even[place], known[place] = values, True
    even[known] -= even[known].mean()
    period = round(recording.period_s / step)
    if recording.repeats and 0 < period < len(even) / 1.5:
        phase = np.arange(len(even)) % period
        count = np.bincount(phase[known], minlength=period)
        mean = np.bincount(phase[known], even[known], minlength=period) / np.maximum(count, 1)
        known &= count[phase] > 1
        even = np.where(known, even - mean[phase], 0.0)
    return even, step


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
