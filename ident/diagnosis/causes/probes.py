"""Unnamed functions of the motion with predictive value for the residual on held-back parts.

For each joint and side, groups of hat functions of one variable (angle, speed, acceleration or load of the joint,
angle or speed of another joint, time) are scored like any candidate: plain, times the sign of the joint's speed, and
those of an angle times the joint's load. So is a line in the spectrum. A remainder becomes a nameless term of the
extended model, or is reported by its variables; a large one casts doubt on the named causes.
"""

from __future__ import annotations

import re
from bisect import insort
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from scipy.ndimage import median_filter

from ident.diagnosis.causes.candidates import Dictionary
from ident.diagnosis.gain.evidence import Evidence
from ident.diagnosis.gain.products import Floats, Key, Products, Rows
from ident.diagnosis.gain.score import Score
from ident.diagnosis.rows.recording import TRAVEL_RAD
from ident.diagnosis.settings import DiagnosisSettings
from ident.effects import NAMELESS
from ident.effects.motion import ArmMotion
from ident.effects.nameless import KNOTS, hats
from ident.rows.filters import median_step
from lwr_driver.session.spool import Arena

# Lowest frequency distinguishable from a drift in a session [Hz].
_LOWEST_HZ = 0.3
# Width of the compared spectrum beside a line [Hz].
_BESIDE_HZ = 2.0
# Least power of a line over the spectrum beside it; ten by chance among a thousand frequencies.
_STANDS_OUT = 16.0
# The same in every session: a vibration lasts through all, the error of a wrong load belongs to its own session.
_IN_EACH = 4.0
# Zero padding of the spectrum, against lines between two of its frequencies.
_PADDING = 4
# Fewest rows of a torque in which functions of many knots are searched.
_LEAST_ROWS = 100
_RIDGE = 1e-3
# Least explained share of the noise; generic functions find a little everywhere.
_LEAST_INFLATION = 0.012
# Least explained share of the noise of a large function: with it the row's error is a third above the noise.
_LARGE = (4.0 / 3.0) ** 2 - 1.0
# Instead of a function's name.
_ANY = "any"
# Least gain of a function beside a line, over that of the line: its frequency is known to a bin, and what is left of it
# is no function of the motion.
_OF_LINE = 0.1


def find_line(evidence: Evidence, side: str, joint: int, residual: Floats) -> tuple[float, Rows, int] | None:
    """Frequency [Hz] of the strongest line in the rows of a joint (from 0) and side, its columns, and the number of
    frequencies tried; None without a clear line.

    residual : (m,) of these rows [Nm], NaN in unused rows.
    Columns: a cosine and a sine for each fitted session, since the phases of two sessions are independent.
    """
    rows = evidence.nominal.rows[side]
    sessions = np.unique(rows.session[~rows.test]).tolist()
    parts = [_not_repeating(evidence, side, residual, session) for session in sessions]
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
    grid = float(frequency[1] - frequency[0])
    width = int(_BESIDE_HZ / grid)
    around = [slice(max(0, k - width), k + width + 1) for k in range(len(power))]
    beside = _medians(power, width)
    best = int(np.argmax(power / np.maximum(beside, 1e-300)))
    rare = each[:, best] < _IN_EACH * np.median(each[:, around[best]], axis=1)
    if power[best] < _STANDS_OUT * beside[best] or np.any(rare):
        return None
    top = float(frequency[best])
    if 0 < best < len(power) - 1:
        # The top of the parabola through the three largest.
        left, here, right = power[best - 1 : best + 2]
        top += 0.5 * float((left - right) / (left - 2.0 * here + right)) * grid
    turn = 2.0 * np.pi * top * rows.time
    waves = [
        np.where((rows.session == session) & ~rows.test, wave(turn), 0.0)
        for session in sessions
        for wave in (np.cos, np.sin)
    ]
    return top, {(side, joint): np.column_stack(waves)}, len(frequency) // _PADDING


def _medians(power: Floats, width: int) -> Floats:
    """Median (m,) of each value and of `width` values on either side, fewer at the ends."""
    if len(power) <= 2 * width:
        return np.array([np.median(power[max(0, k - width) : k + width + 1]) for k in range(len(power))])
    found: Floats = median_filter(power, 2 * width + 1, mode="nearest")
    found[:width] = _growing(power[: 2 * width], width)
    found[len(power) - width :] = _growing(power[: -2 * width - 1 : -1], width)[::-1]
    return found


def _growing(values: Floats, width: int) -> list[float]:
    """Medians of the first `width` + 1, + 2, ... values, `width` of them."""
    ordered, found = sorted(values[:width].tolist()), []
    for value in values[width : 2 * width].tolist():
        insort(ordered, value)
        half = len(ordered) // 2
        found.append(0.5 * (ordered[half] + ordered[~half]))
    return found


def _spectrum(values: Floats, dt: float, size: int, frequency: Floats) -> Floats:
    """Power of a session at the frequencies, over its total power."""
    power = np.abs(np.fft.rfft(values, size)) ** 2 / max(float(np.sum(values**2)), 1e-300)
    return np.interp(frequency, np.fft.rfftfreq(size, dt), power)


def _not_repeating(
    evidence: Evidence, side: str, residual: Floats, session: int
) -> tuple[Floats, float] | None:
    """Part of a session's residual different in every period, on an even grid with zeros in gaps, and the grid's step
    [s]; all of it without repetition, None for too few rows."""
    rows = evidence.nominal.rows[side]
    recording = next(r for r in evidence.nominal.recordings if r.number == session)
    mine = (rows.session == session) & np.isfinite(residual)
    if mine.sum() < 200:
        return None
    time = rows.time[mine] - recording.start_s
    step = median_step(rows.time[rows.session == session])
    place = np.round((time - time[0]) / step).astype(np.int64)
    even, known = np.zeros(place[-1] + 1), np.zeros(place[-1] + 1, dtype=bool)
    even[place], known[place] = residual[mine], True
    even[known] -= even[known].mean()
    period = round(recording.period_s / step)
    if recording.repeats and 0 < period < len(even) / 1.5:
        phase = np.arange(len(even)) % period
        count = np.bincount(phase[known], minlength=period)
        mean = np.bincount(phase[known], even[known], minlength=period) / np.maximum(count, 1)
        known &= count[phase] > 1
        even = np.where(known, even - mean[phase], 0.0)
    return even, step


Null = Mapping[tuple[str, int], float]
"""Limit of a gain on a healthy arm, by cause and joint from 0."""


@dataclass(frozen=True, eq=False)
class Curve:
    """A variable over its range, with the knots of its hat functions evenly from `low` to `high`.

    of : its values (N,) in a motion.
    """

    low: float
    high: float
    of: Callable[[ArmMotion], Floats]

    def hats(self, motion: ArmMotion) -> Floats:
        """Hat functions (N, 7)."""
        return hats(self.of(motion), self.low, self.high)


@dataclass(frozen=True, eq=False)
class Term:
    """A function of the variables in `form` (`ident.effects.nameless`) with values at its knots (7,) [Nm].

    column : (m, 1) torque in the rows of its joint and side.
    """

    form: str
    low: float
    high: float
    values: Floats
    std: Floats
    column: Floats


@dataclass(frozen=True, eq=False)
class Remainder:
    """A remainder in the rows of a joint (from 1) and side, dependent on the named variables.

    rows : columns of its generic functions. line_hz : frequency of its line, 0 without one. terms : its functions,
    empty for a remainder that depends on time.
    """

    side: str
    joint: int
    depends_on: tuple[str, ...]
    gain: float
    inflation: float
    rows: tuple[Rows, ...] = ()
    line_hz: float = 0.0
    terms: tuple[Term, ...] = field(default=(), repr=False)


class _Searched(NamedTuple):
    """What is searched in the residual of a torque with rows enough: groups of columns by the names of their variables,
    and a line of its spectrum."""

    side: str
    joint: int
    groups: Mapping[str, Rows]
    line: tuple[float, Rows, int] | None


def _searched(dictionary: Dictionary, variables: Mapping[str, Curve]) -> Iterator[_Searched]:
    """For each torque beside the present columns of the evidence."""
    evidence = dictionary.evidence
    residuals = evidence.residuals()
    for side in evidence.nominal.rows:
        for joint in range(evidence.nominal.arm.chain.n):
            if evidence.mask[side, joint].sum() >= _LEAST_ROWS:
                line = find_line(evidence, side, joint, residuals[side][:, joint])
                yield _Searched(side, joint, groups(dictionary, variables, side, joint), line)


def find_remainders(
    dictionary: Dictionary, settings: DiagnosisSettings, null: Null | None = None
) -> tuple[Remainder, ...]:
    """Remainders beside the columns of the evidence, largest first; at most two variables each.

    null : limits of their gain on the healthy arm, by name of the nameless term, and by the kind of function
    of another joint's variable.
    """
    found = []
    evidence, variables = dictionary.evidence, hats_of(dictionary)
    for one in _searched(dictionary, variables):
        arena, prepared = Arena(), dict[str, tuple[Rows, Products]]()
        for name, rows in one.groups.items():
            known = evidence.products.alone(rows)
            prepared[name] = rows, replace(known, alone=arena.keep(known.alone))
        limits = {
            name: max(settings.least_gain, _limit(null or {}, one.side, one.joint, name))
            for name in (_ANY, *one.groups)
        }
        with evidence.beside(evidence.extra):
            remainder = _one(evidence, limits, prepared, one.line, one.side, one.joint, variables)
        if remainder is not None:
            found.append(remainder)
    return tuple(sorted(found, key=lambda r: -r.gain))


def _one(
    evidence: Evidence,
    limits: Mapping[str, float],
    prepared: dict[str, tuple[Rows, Products]],
    line: tuple[float, Rows, int] | None,
    side: str,
    joint: int,
    variables: Mapping[str, Curve],
) -> Remainder | None:
    """The remainder of a joint from its line and its `prepared` groups of columns.

    limits : least gain of any, and of a large one of each name.
    """
    taken: list[tuple[str, Score, Rows]] = []
    fixed, line_hz, beside_line = list(evidence.extra), 0.0, 0.0
    if line is not None:
        frequency, waves, choices = line
        score = evidence.score(waves)
        least = limits[_ANY] + 2.0 * (len(score.coefficients) + np.log(choices))
        if score.gain > least and score.inflation > _LEAST_INFLATION:
            line_hz = frequency
            beside_line = _OF_LINE * score.gain
            taken.append(("time", score, waves))
            evidence.replace([*fixed, waves])
    for _ in range(2):
        best: tuple[str, Score, Rows] | None = None
        scores = evidence.score_groups([*prepared.values()], ridge=_RIDGE)
        for (name, (rows, _)), score in zip(prepared.items(), scores, strict=True):
            limit = max(limits[name if score.inflation > _LARGE else _ANY], beside_line)
            least = max(limit + 2.0 * KNOTS, 0.0 if best is None else best[1].gain)
            if score.gain > least and score.inflation > _LEAST_INFLATION:
                best = name, score, rows
        if best is None:
            break
        prepared.pop(best[0])
        taken.append(best)
        evidence.replace([*fixed, *(rows for _, _, rows in taken)])
    if not taken:
        return None
    names = dict.fromkeys(part for name, _, _ in taken for part in name.split(" "))
    gain, inflation = np.sum([(score.gain, score.inflation) for _, score, _ in taken], axis=0).tolist()
    columns = tuple(rows for _, _, rows in taken)
    terms = () if "time" in names else tuple(_term(*one, variables) for one in taken)
    return Remainder(side, joint + 1, tuple(names), gain, inflation, columns, line_hz, terms)


def _term(name: str, score: Score, rows: Rows, variables: Mapping[str, Curve]) -> Term:
    curve, columns = variables[name.split(" ")[0]], next(iter(rows.values()))
    column = (columns @ score.coefficients)[:, None]
    return Term(name, curve.low, curve.high, score.coefficients, np.sqrt(np.diag(score.covariance)), column)


def remainder_gains(dictionary: Dictionary) -> dict[tuple[str, int], float]:
    """Largest gain of a function of the motion or of a line beside the columns of the evidence, by the name of the
    nameless term and the joint from 0, and of each kind of function of another joint's variable."""
    found = {}
    evidence = dictionary.evidence
    for one in _searched(dictionary, hats_of(dictionary)):
        scores = [evidence.score(rows, ridge=_RIDGE) for rows in one.groups.values()]
        scores += [] if one.line is None else [evidence.score(one.line[1])]
        found[NAMELESS[one.side].cause, one.joint] = max(0.0, *(score.gain for score in scores))
        for name, score in zip(one.groups, scores, strict=False):
            kind = _kind(one.side, one.joint, name)
            if kind is not None:
                found[kind] = max(found.get(kind, 0.0), score.gain)
    return found


def _kind(side: str, joint: int, name: str) -> tuple[str, int] | None:
    """Kind of a function of another joint's variable, and the joint (from 0); None for one of the joint's own."""
    variable, _, factor = name.partition(" ")
    of = variable.rstrip("0123456789")
    if variable in (of, f"{of}{joint + 1}"):
        return None
    return f"{NAMELESS[side].cause} {of} {re.sub('[0-9]', '', factor)}".rstrip(), joint


def _limit(null: Null, side: str, joint: int, name: str) -> float:
    """Of a large function on the healthy arm; a reference of an earlier version has that of any.

    Of another joint's variable a healthy arm hardly has any, and is asked for that kind alone. What it lacks in its own
    friction, inertia and load differs with the motion, and one of them looks like another.
    """
    of_any = null.get((NAMELESS[side].cause, joint), 0.0)
    kind = None if name == _ANY else _kind(side, joint, name)
    return of_any if kind is None else null.get(kind, of_any)


def hats_of(dictionary: Dictionary, only: str | None = None) -> dict[str, Curve]:
    """The curve of every variable by its name, or of one of them."""
    found = {}
    for name, of in _variables(dictionary.nominal.arm.chain.n).items():
        if only is not None and name != only:
            continue
        values = [of(m) for m in dictionary.nominal.motions]
        low, high = min(float(v.min()) for v in values), max(float(v.max()) for v in values)
        if high - low >= (TRAVEL_RAD if name[1:].isdigit() else 1e-6):
            found[name] = Curve(low, high, of)
    return found


def _variables(joints: int) -> dict[str, Callable[[ArmMotion], Floats]]:
    found: dict[str, Callable[[ArmMotion], Floats]] = {"time": lambda m: m.time}
    for k in range(joints):
        found[f"q{k + 1}"] = lambda m, k=k: m.q[:, k]  # type: ignore[misc]
        found[f"qd{k + 1}"] = lambda m, k=k: m.motor_speed[:, k]  # type: ignore[misc]
        found[f"qdd{k + 1}"] = lambda m, k=k: m.motor_acceleration[:, k]  # type: ignore[misc]
        found[f"load{k + 1}"] = lambda m, k=k: m.joint_torque[:, k]  # type: ignore[misc]
    return found


def groups(
    dictionary: Dictionary, variables: Mapping[str, Curve], side: str, joint: int
) -> dict[str, dict[Key, Floats]]:
    """Groups of columns by the names of their variables."""
    found: dict[str, dict[Key, Floats]] = {}
    # All together exceed the memory.
    arena = Arena()
    for name, curve in variables.items():
        of = name.rstrip("0123456789")
        if of in ("load", "qdd") and name != f"{of}{joint + 1}":
            continue
        factors: dict[str, Callable[[ArmMotion], Floats]] = {name: lambda m: np.ones(len(m.time))}
        if name != f"qd{joint + 1}":
            # A function of the own speed has both signs by itself.
            factors[f"{name} sign(qd{joint + 1})"] = lambda m: m.direction[:, joint]
        if of == "q":
            factors[f"{name} load{joint + 1}"] = lambda m: m.joint_torque[:, joint]
        columns = dictionary.nominal.functions(side, curve.of, curve.low, curve.high, [*factors.values()])
        kept = map(arena.keep, columns)
        found |= {one: {(side, joint): values} for one, values in zip(factors, kept, strict=True)}
    return found
