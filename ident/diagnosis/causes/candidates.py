"""Candidates: every cause on every joint, with its shapes, as columns in rows."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise, product

import numpy as np
from numpy.typing import NDArray

from ident.diagnosis.gain.evidence import Evidence
from ident.diagnosis.gain.products import Floats, Key, Products, Rows
from ident.diagnosis.gain.rivals import exceeds
from ident.diagnosis.gain.score import Score, chance
from ident.diagnosis.rows.nominal import Nominal
from ident.diagnosis.rows.recording import sensor_limits
from ident.diagnosis.rows.side_rows import SideRows
from ident.diagnosis.settings import A_COEFFICIENT
from ident.effects import DELAYS, EFFECTS, Column, Effect, Form, Setting, Shape
from ident.effects.motion import ArmMotion
from ident.rows.data_quality import run_bounds
from lwr_driver.session.spool import Arena

# Bursts: shortest, least excess over its standard deviation, longest, largest number.
_WINDOW_S, _FAR, _LONGEST_S, _MOST = 0.1, 8.0, 4.0, 4
# Distance from the ends of a session within which filters and wide bins are unreliable.
_EDGE_S = 0.6
# The same from a standstill of the whole arm, and its least length: joints stick and links ring there.
_BESIDE_REST_S, _REST_S = 0.3, 0.2
# Standard deviation of a coefficient equal to 1 by physics, for the gain on held-back parts.
_ABOUT_ONE = 0.3
# Least fall of the chi-square for a common search of a shape's parameters.
_VALLEY = 30.0
# Least further fall of the chi-square by a recurring push.
_TIED = 6.0
# Least gain of a step for its rows to be made.
_WORTH_ROWS = 10.0
# Least time of a lasting step from the ends of a session, against their transients.
_STEP_ROOM_S = 1.0
# Longest pause between sessions over which a drive stays warm [s].
_DAY_S = 86400.0
# Lengths of a push to try, over that of its burst: only the middle of a weak one stands out.
_LONGER = (1.0, 1.6)


@dataclass(frozen=True)
class Burst:
    """session : number. start_s, duration_s : from the start of the session. excess : chi-square above usual."""

    session: int
    start_s: float
    duration_s: float
    excess: float


def find_bursts(evidence: Evidence) -> tuple[Burst, ...]:
    """The strongest bursts, at most four, strongest first; none in an even residual."""
    found = []
    side = "joint" if "joint" in evidence.nominal.rows else "motor"
    rows = evidence.nominal.rows[side]
    normal = (evidence.residuals()[side] / evidence.sigma[side]) ** 2
    for session in np.unique(rows.session):
        mine = (rows.session == session) & ~rows.test
        if not mine.any():
            continue
        first, last = rows.time[mine].min() + _EDGE_S, rows.time[mine].max() - _EDGE_S
        mine &= (rows.time >= first) & (rows.time <= last) & ~_beside_rest(rows, mine)
        if mine.sum() < 3:
            continue
        time, values = rows.time[mine], normal[mine]
        window = ((time - time[0]) / _WINDOW_S).astype(int)
        counts = np.bincount(window, np.isfinite(values).sum(axis=1))
        sums = np.bincount(window, np.nansum(values, axis=1))
        for low, length, excess in _scan(counts.astype(np.float64), sums.astype(np.float64)):
            start = float(time[0] + low * _WINDOW_S)
            found.append(Burst(int(session), start, length * _WINDOW_S, excess))
    return tuple(sorted(found, key=lambda b: -b.excess)[:_MOST])


def _beside_rest(rows: SideRows, mine: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Rows (m,) among `mine`, of one session, close to a standstill of the whole arm."""
    time, moving = rows.time[mine], np.any(rows.valid[mine], axis=1)
    close = np.zeros(len(time), dtype=bool)
    for first, end in pairwise(run_bounds(moving.astype(np.float64)).tolist()):
        start, stop = time[first], time[min(end, len(time) - 1)]
        if not moving[first] and stop - start >= _REST_S:
            close |= (time > start - _BESIDE_REST_S) & (time < stop + _BESIDE_REST_S)
    found = np.zeros(len(mine), dtype=bool)
    found[mine] = close
    return found


def _scan(counts: Floats, sums: Floats) -> Iterator[tuple[int, int, float]]:
    """First window, number of windows and excess of bursts, the clearest first.

    counts, sums : rows and chi-square of each window. A weak push for two seconds stands out in no single window, so
    intervals of 1, 2, 4 ... windows are tried. An interval stands out from the level of the session and from those of
    its length before and after it.
    """
    usual = float(np.median(sums[counts > 0] / counts[counts > 0])) if np.any(counts > 0) else 1.0
    free = np.ones(len(counts), dtype=bool)
    number, total = (np.concatenate([[0.0], np.cumsum(values)]) for values in (counts, sums))
    for _ in range(_MOST):
        best = (0.0, 0, 0, 0.0)
        taken = np.concatenate([[0], np.cumsum(~free)])
        for length in (2**k for k in range(int(np.log2(_LONGEST_S / _WINDOW_S)) + 1)):
            if length > len(counts):
                break
            starts = np.arange(len(counts) - length + 1)
            rows, chi = (table[starts + length] - table[starts] for table in (number, total))
            level = np.full(len(starts), usual)
            for beside in (starts - length, starts + length):
                at = np.clip(beside, 0, len(counts) - length)
                there = (total[at + length] - total[at]) / np.maximum(number[at + length] - number[at], 1.0)
                # An end of the session has one neighbour only.
                level = np.where((at == beside) & (there > level), there, level)
            excess = chi - level * rows
            clear = excess / (level * np.sqrt(2.0 * np.maximum(rows, 1.0)))
            clear[(rows == 0.0) | (taken[starts + length] > taken[starts])] = 0.0
            place = int(np.argmax(clear))
            if clear[place] > best[0]:
                best = (float(clear[place]), place, length, float(excess[place]))
        if best[0] <= _FAR:
            return
        _, low, length, _ = best
        yield best[1:]
        free[max(low - length // 2, 0) : low + length + length // 2 + 1] = False


@dataclass(frozen=True, eq=False)
class Candidate:
    """A cause on a joint (counted from 0, -1 for the whole arm)."""

    effect: Effect
    joint: int

    @property
    def cause(self) -> str:
        """Name of the cause."""
        return self.effect.cause

    @property
    def joints(self) -> tuple[int, ...]:
        """Joints counted from 1, empty for the whole arm."""
        return () if self.joint < 0 else (self.joint + 1,)

    @property
    def key(self) -> tuple[str, int]:
        """Cause and joint."""
        return self.effect.cause, self.joint


@dataclass(frozen=True, eq=False)
class Trial:
    """A candidate with its best shape and the score."""

    candidate: Candidate
    shape: Shape
    score: Score
    rows: Rows = field(repr=False)

    @property
    def passing(self) -> bool:
        """Whether it has no value in a further session."""
        return self.candidate.effect.passing(self.shape)


@dataclass(frozen=True)
class _Span:
    """Range of a shape parameter in the coordinate of a search: itself, or its logarithm."""

    name: str
    low: float
    high: float
    logarithmic: bool

    def value(self, coordinate: float) -> float:
        """The parameter."""
        return float(np.exp(coordinate)) if self.logarithmic else float(coordinate)

    def coordinate(self, shape: Shape) -> float:
        """Coordinate of a shape."""
        here = float(shape[self.name])
        return float(np.clip(np.log(here) if self.logarithmic else here, self.low, self.high))


_Entry = tuple[Shape, Rows, Products]


class Dictionary:
    """Columns of all candidates for the rows of a nominal arm, made once and kept.

    causes : names to consider; None for all.
    """

    def __init__(self, nominal: Nominal, evidence: Evidence, causes: Sequence[str] | None = None) -> None:
        self.nominal = nominal
        self.evidence = evidence
        self.setting = _setting(nominal, compared=evidence.prior is not None and evidence.compared)
        wanted = list(EFFECTS) if causes is None else list(causes)
        motor = "motor" in nominal.rows
        # An earlier low-pass may have shifted a channel, without any fault of the arm.
        hidden = {DELAYS[side].cause for side, band in nominal.grid.band_hz.items() if band is not None}
        if nominal.moving.sum() < 2:
            # A late channel is late in all joints; in one joint alone it could be elasticity as well.
            hidden |= {delay.cause for delay in DELAYS.values()}
        self.candidates = tuple(
            Candidate(EFFECTS[cause], joint)
            for cause in wanted
            if cause not in hidden
            if motor or EFFECTS[cause].side != "motor"
            for joint in ([-1] if EFFECTS[cause].whole_arm else np.flatnonzero(nominal.moving).tolist())
        )
        self._kept: dict[tuple[str, int], list[_Entry]] = {}
        self._whole: dict[tuple[str, int, str], _Entry | None] = {}
        self._steps: dict[tuple[str, int, Shape], Rows] = {}
        self._pushes: dict[tuple[str, int, str], _Entry | None] = {}
        self._information: dict[tuple[str, int], dict[str, float]] = {}
        self._arena = Arena()

    def of(self, causes: Sequence[str] | None) -> Dictionary:
        """The same with fewer causes, and the columns made so far."""
        found = Dictionary(self.nominal, self.evidence, causes)
        found._kept, found._whole, found._steps = self._kept, self._whole, self._steps
        found._pushes, found._information, found._arena = self._pushes, self._information, self._arena
        return found

    def rows(self, candidate: Candidate, shape: Shape) -> Rows:
        """Columns of a candidate in rows: (m, k) by side and joint."""
        return self._rows(candidate, lambda _: shape)

    def _rows(self, candidate: Candidate, shape: Callable[[ArmMotion], Shape]) -> Rows:
        """The same with a shape for each motion."""
        effect, joint = candidate.effect, max(candidate.joint, 0)
        reduced = self.nominal.columns(lambda m: effect.columns(m, joint, shape(m)), effect.seen_by)
        return self._by_joint(candidate, reduced)

    def turned(self, candidate: Candidate, shape: Shape) -> Rows:
        """The columns as they were if motor and sensor changed places."""
        effect, joint = candidate.effect, max(candidate.joint, 0)

        def made(motion: ArmMotion) -> list[Column]:
            return [Column(motor=one.joint, joint=one.motor) for one in effect.columns(motion, joint, shape)]

        return self._by_joint(candidate, self.nominal.columns(made))

    def _by_joint(self, candidate: Candidate, reduced: Mapping[str, Sequence[Floats]]) -> Rows:
        found: dict[Key, Floats] = {}
        for side, columns in reduced.items():
            if not columns:
                continue
            if columns[0].ndim == 1:
                found[side, candidate.joint] = np.stack(columns, axis=1)
                continue
            for j in range(self.nominal.arm.chain.n):
                column = np.stack([r[:, j] for r in columns], axis=1)
                if np.any(column):
                    found[side, j] = column
        return found

    def _entry(self, shape: Shape, rows: Rows) -> _Entry:
        products = self.evidence.products.alone(rows)
        # All candidates together exceed the memory.
        kept = {key: self._arena.keep(values) for key, values in rows.items()}
        return shape, kept, replace(products, alone=self._arena.keep(products.alone))

    def _prepared(self, candidate: Candidate) -> list[_Entry]:
        if candidate.key not in self._kept:
            by_shape = ((shape, self.rows(candidate, shape)) for shape in self._grid(candidate))
            self._kept[candidate.key] = [self._entry(shape, rows) for shape, rows in by_shape if _acts(rows)]
        return self._kept[candidate.key]

    def _push(self, candidate: Candidate, shape: Shape) -> _Entry | None:
        """Of a contact, None without rows: the same bursts are left beside many sets of columns."""
        key = (*candidate.key, repr(shape))
        if key not in self._pushes:
            rows = self.rows(candidate, shape)
            self._pushes[key] = self._entry(shape, rows) if _acts(rows) else None
        return self._pushes[key]

    def _setting_in(self, candidate: Candidate, form: Form) -> _Entry | None:
        """Of a form that sets in at a time, as if that were before each session, None without rows."""
        key = (*candidate.key, str(form.value))
        if key not in self._whole:
            before = Shape(form, time=-np.inf, session=1)
            rows = self._rows(candidate, lambda motion: before.at(session=motion.session + 1))
            self._whole[key] = self._entry(before, rows) if _acts(rows) else None
        return self._whole[key]

    def _onset(self, candidate: Candidate) -> Trial | None:
        """The best edge of a block for the forms that set in at a time. Products after an edge are a part of their
        blocks, so those of all sessions are made once."""
        evidence, effect = self.evidence, candidate.effect
        best: tuple[Shape, Score, Rows] | None = None
        for form in effect.onsets:
            entry = self._setting_in(candidate, form)
            if entry is None:
                continue
            _, rows, known = entry
            whole = evidence.products.beside(rows, known)
            base = evidence.products.in_blocks(whole)
            lasting = np.unique([m.session for m in self.nominal.motions if effect.lasts(form, m)])
            fall = evidence.setting_in(whole, base, lasting)
            for session in np.unique(evidence.block_session).tolist():
                mine = np.flatnonzero(evidence.block_session == session)
                start, last = evidence.block_start[mine], self.setting.durations_s[session] - _STEP_ROOM_S
                inside = (start > start.min()) & (start >= _STEP_ROOM_S) & (start <= last)
                if not inside.any():
                    continue
                edge = mine[inside][np.argmax(fall[mine[inside]])]
                after = whole.only(evidence.after(edge, lasting), base)
                (score,) = evidence.score_products([after], [list(rows)])
                at = Shape(form, time=evidence.block_start[edge], session=session + 1)
                score = self._timed(candidate, at, score, evidence.blocks)
                if best is None or score.gain > best[1].gain:
                    best = (at, score, rows)
        if best is None or not effect.plausible(best[1].coefficients, best[0]):
            return None
        # The rows themselves are made only for a step with enough gain.
        shape, score, rows = best
        rows = rows if score.gain < _WORTH_ROWS else self._step(candidate, shape)
        return Trial(candidate, shape, score, rows)

    def _step(self, candidate: Candidate, shape: Shape) -> Rows:
        """Rows of a step, the same beside many sets of columns."""
        key = (*candidate.key, shape)
        if key not in self._steps:
            rows = self.rows(candidate, shape)
            self._steps[key] = {place: self._arena.keep(values) for place, values in rows.items()}
        return self._steps[key]

    def _grid(self, candidate: Candidate) -> Sequence[Shape]:
        return candidate.effect.shapes(self.setting, max(candidate.joint, 0))

    def _contacts(self, candidate: Candidate) -> Trial | None:
        """The best contact in a burst of the residual, on any link from the third on."""
        best: Trial | None = None
        n = self.nominal.arm.chain.n
        links = range(min(3, n), n + 1)
        for burst, link, longer in product(find_bursts(self.evidence), links, _LONGER):
            middle, duration = burst.start_s + 0.5 * burst.duration_s, longer * burst.duration_s + 0.1
            shape = Shape(time=middle, duration=duration, session=burst.session + 1, link=link)
            trial = self._tried(
                candidate, self._push(candidate, shape), 20 * len(_LONGER) * self.evidence.blocks
            )
            # Links whose frames share an origin tie, up to rounding.
            if trial is None or (best is not None and trial.score.gain < best.score.gain + 1e-6):
                continue
            if not self._recurs(trial):
                best = trial
        return best

    def _recurs(self, trial: Trial) -> bool:
        """Whether the same push explains more with a repetition a period earlier or later: then it depends on the
        pose, and is not an external push."""
        shape = trial.shape
        recording = next(r for r in self.nominal.recordings if r.number == int(shape["session"]) - 1)
        if not recording.repeats:
            return False
        for periods in (-1.0, 1.0):
            again = shape.at(time=shape["time"] + periods * recording.period_s)
            entry = self._push(trial.candidate, again)
            both = {} if entry is None else {**entry[1]}
            for key, columns in trial.rows.items():
                both[key] = columns + both[key] if key in both else columns
            if self.evidence.score(both).fitted > trial.score.fitted + _TIED:
                return True
        return False

    def best(self, candidate: Candidate) -> Trial | None:
        """The candidate with the best shape of its grid, None without a plausible one."""
        if candidate.effect.repeats:
            return self._contacts(candidate)
        onset = self._onset(candidate)
        # Shapes that hold others of this candidate, and the others.
        found: dict[bool, Trial] = {}
        for shape, rows, score in self._measured(candidate):
            general = candidate.key in candidate.effect.special_cases(shape, candidate.joint)
            better = general not in found or _worth(score) > _worth(found[general].score)
            if better and candidate.effect.plausible(score.coefficients, shape):
                found[general] = Trial(candidate, shape, score, rows)
        plain, wide = found.get(False), found.get(True)
        needed = wide is not None and (plain is None or exceeds(wide.score.gain, plain.score.gain))
        best = wide if needed else plain
        if onset is not None and (best is None or _worth(onset.score) > _worth(best.score)):
            return onset
        return None if best is None else self._simplified(best)

    def _simplified(self, trial: Trial) -> Trial:
        """The trial in its simpler form if the blocks do not tell its further coefficients from zero."""
        shape = trial.candidate.effect.simpler(trial.shape)
        plain = None if shape is None else self.trial(trial.candidate, shape)
        if plain is None:
            return trial
        kept, (covariance, blocks) = len(plain.score.coefficients), trial.score.uncertainty
        further = trial.score.coefficients[kept:]
        sure = chance(further, covariance[kept:, kept:], blocks) < self.evidence.settings.alpha_rare
        return trial if sure else plain

    def information(self, candidate: Candidate) -> dict[str, float]:
        """How much these motions show of a candidate, by shape of its grid: the mean fall of the chi-square for a unit
        of its coefficients, beside the base alone. Empty for events, which are anywhere."""
        if candidate.key not in self._information:
            entries = [] if candidate.effect.event else self._prepared(candidate)
            self._information[candidate.key] = {
                repr(shape): self.evidence.information(known) for shape, _, known in entries
            }
        return self._information[candidate.key]

    def products(self, candidate: Candidate) -> Iterator[Products]:
        """Products of each shape of a candidate's grid with the base alone; none for events."""
        entries = [] if candidate.effect.event else self._prepared(candidate)
        return (known for _, _, known in entries)

    def scores(self, candidate: Candidate) -> dict[str, Score]:
        """Score of each shape of a candidate's grid beside the present columns, by the shape as text; empty for
        events."""
        entries = [] if candidate.effect.event else self._measured(candidate)
        found = {repr(shape): score for shape, _, score in entries}
        return {shape: score for shape, score in found.items() if np.isfinite(score.gain)}

    def scored(self, candidate: Candidate, shape: str) -> Score | None:
        """Score of a shape of the grid beside the present columns; None without it."""
        for one, rows, known in self._kept.get(candidate.key, ()):
            if repr(one) == shape:
                return self.measure(candidate, rows, known)
        return None

    def shape(self, candidate: Candidate, text: str) -> Shape | None:
        """The shape of the grid with this text; None without it."""
        return next((one for one, *_ in self._kept.get(candidate.key, ()) if repr(one) == text), None)

    def nearest(self, trial: Trial) -> str:
        """The shape of the grid nearest to a trial's, empty without one."""
        shapes = [shape for shape, *_ in self._kept.get(trial.candidate.key, ())]
        alike = [shape for shape in shapes if shape.form == trial.shape.form]

        def distance(shape: Shape) -> float:
            pairs = ((shape[name], value) for name, value in trial.shape.items() if name in shape)
            return sum(abs(a - b) / max(abs(a) + abs(b), 1e-12) for a, b in pairs)

        return repr(min(alike, key=distance)) if alike else ""

    def measure(self, candidate: Candidate, rows: Rows, known: Products | None = None) -> Score:
        """Score of rows by the rules of the candidate's effect; `known` : their products with the base alone."""
        if known is None:
            return self.evidence.score(rows, pull=_pull(candidate))
        return self.evidence.score_groups([(rows, known)], pull=_pull(candidate))[0]

    def _measured(self, candidate: Candidate) -> Iterator[tuple[Shape, Rows, Score]]:
        """Each shape of a candidate's grid with its rows and their score."""
        entries = self._prepared(candidate)
        groups = [(rows, known) for _, rows, known in entries]
        scores = self.evidence.score_groups(groups, pull=_pull(candidate))
        return ((shape, rows, score) for (shape, rows, _), score in zip(entries, scores, strict=True))

    def _timed(self, candidate: Candidate, shape: Shape, score: Score, choices: int) -> Score:
        """The score of a shape, with the price of its time. An error of a sensor that stays has parts to be held back,
        too."""
        if not candidate.effect.timed(shape):
            return score
        priced = self.evidence.event_score(score, choices)
        return priced if candidate.effect.event else replace(priced, gain=min(priced.gain, score.gain))

    def trial(self, candidate: Candidate, shape: Shape, choices: int = 1) -> Trial | None:
        """The candidate with a given shape, None without rows or with implausible coefficients."""
        rows = self.rows(candidate, shape)
        return self._tried(candidate, (shape, rows, None) if _acts(rows) else None, choices)

    def _tried(
        self, candidate: Candidate, entry: tuple[Shape, Rows, Products | None] | None, choices: int
    ) -> Trial | None:
        if entry is None:
            return None
        shape, rows, known = entry
        score = self._timed(candidate, shape, self.measure(candidate, rows, known), choices)
        plausible = candidate.effect.plausible(score.coefficients, shape)
        return Trial(candidate, shape, score, rows) if plausible else None

    def refine(self, trial: Trial, choices: int = 1, evaluations: int = 12) -> Trial:
        """The trial with its continuous shape parameters at the best fit: one after the other, then together, since a
        speed and an exponent compensate each other along a narrow valley."""
        # A fifth of a short diagnosis' imports, and seldom needed.
        from scipy.optimize import minimize, minimize_scalar

        best = trial

        def loss(spans: Sequence[_Span], point: Sequence[float]) -> float:
            nonlocal best
            values = {span.name: span.value(x) for span, x in zip(spans, point, strict=True)}
            tried = self.trial(trial.candidate, best.shape.at(**values), choices)
            if tried is None:
                return 0.0
            if tried.score.fitted > best.score.fitted:
                best = tried
            return -tried.score.fitted

        for span in self._spans(trial):
            minimize_scalar(
                lambda x, span=span: loss([span], [x]),
                bounds=(span.low, span.high),
                method="bounded",
                options={"maxiter": evaluations},
            )
        spans = [] if trial.candidate.effect.timed(trial.shape) else self._spans(best)
        if len(spans) > 1 and best.score.fitted > _VALLEY:
            minimize(
                lambda point: loss(spans, point),
                [span.coordinate(best.shape) for span in spans],
                method="Nelder-Mead",
                bounds=[(span.low, span.high) for span in spans],
                options={"maxfev": 3 * evaluations * (len(spans) - 1), "fatol": 0.1, "xatol": 1e-3},
            )
        return best

    def _spans(self, trial: Trial) -> list[_Span]:
        """Range of each continuous parameter of a trial's shape: between its neighbours in the grid."""
        effect, found = trial.candidate.effect, []
        grid = self._grid(trial.candidate)
        for name in effect.continuous(trial.shape):
            values = sorted({s[name] for s in grid if name in s and _alike(s, trial.shape, name)})
            limits = next(p for p in effect.shape_parameters if p.name == name)
            here = float(trial.shape[name])
            low, high = _neighbours(values, here, signed=limits.low < 0.0 < limits.high)
            if trial.shape.form in effect.onsets:
                last = self.setting.durations_s[int(trial.shape["session"]) - 1] - _STEP_ROOM_S
                low, high = max(here - 2.5, _STEP_ROOM_S), min(here + 2.5, last)
            elif effect.event:
                low, high = (here - 0.3, here + 0.3) if name == "time" else (0.4 * here, 2.0 * here)
            if limits.away:
                low, high = (max(low, limits.away), high) if here > 0.0 else (low, min(high, -limits.away))
            least = effect.least(self.setting, max(trial.candidate.joint, 0)).get(name, limits.low)
            low, high = max(low, limits.low, least), min(high, limits.high)
            if low < high:
                logarithmic = low > 0.0 and not effect.timed(trial.shape)
                ends = (float(np.log(low)), float(np.log(high))) if logarithmic else (low, high)
                found.append(_Span(name, *ends, logarithmic))
        return found

    def trials(self) -> Iterator[Trial]:
        """The best shape of every candidate, in their order for any number of threads."""
        jobs = self.evidence.settings.jobs
        if jobs == 1:
            found = map(self.best, self.candidates)
        else:
            from joblib import Parallel, delayed

            # The same memory for all; numpy and the compiled loops let other threads run.
            found = Parallel(n_jobs=jobs, require="sharedmem", return_as="generator")(
                delayed(self.best)(candidate) for candidate in self.candidates
            )
        return (trial for trial in found if trial is not None)


def _pull(candidate: Candidate) -> float:
    """Precision of coefficients that the physics knows to be 1."""
    return _ABOUT_ONE**-2.0 if candidate.effect.hidden else 0.0


def _acts(rows: Rows) -> bool:
    return any(np.any(values) for values in rows.values())


def _worth(score: Score) -> float:
    """Gain minus the gain of further coefficients by chance."""
    return score.gain - A_COEFFICIENT * len(score.coefficients)


def _alike(a: Shape, b: Shape, besides: str) -> bool:
    return a.form is b.form and all(a[k] == b[k] for k in a if k != besides and k in b)


def _neighbours(values: Sequence[float], here: float, *, signed: bool) -> tuple[float, float]:
    """The values next to one, on its own side of zero unless the parameter is `signed`."""
    rounding = 1e-9 * abs(here) + 1e-12
    below = [v for v in values if v < here - rounding]
    above = [v for v in values if v > here + rounding]
    low = below[-1] if below else (0.4 * here if here > 0 else here - 0.5)
    high = above[0] if above else (2.5 * here if here > 0 else here + 0.5)
    if not signed and here > 0.0 and low <= 0.0:
        low = 0.3 * here
    if not signed and here < 0.0 and high >= 0.0:
        high = 0.3 * here
    return low, high


def _setting(nominal: Nominal, *, compared: bool) -> Setting:
    motions, arm = nominal.motions, nominal.arm
    sessions = sorted({m.session for m in motions})
    q = np.concatenate([m.q for m in motions])
    positive = np.mean(np.concatenate([m.joint_torque for m in motions]) > 0.0, axis=0)
    return Setting(
        sessions=len(sessions),
        durations_s=tuple(max(m.time[-1] for m in motions if m.session == k) for k in sessions),
        gear_ratio=arm.gear_ratio,
        torque_range=np.max([np.abs(m.joint_torque).max(axis=0) for m in motions], axis=0),
        torque_turns=np.minimum(positive, 1.0 - positive) > 0.02,
        speed_range=np.max([np.abs(m.motor_speed).max(axis=0) for m in motions], axis=0),
        position_range=np.stack([q.min(axis=0), q.max(axis=0)], axis=1),
        encoder=arm.encoder if arm.encoder_known else None,
        presliding=None
        if arm.presliding is None
        else np.where(arm.presliding > 0.0, arm.presliding, arm.usual_length),
        standstill_rad_s=nominal.settings.standstill_rad_s,
        compared=compared,
        compliance=arm.compliance if all(m.springs is not None for m in motions) else None,
        twist=arm.compliance if arm.encoder == "link" else None,
        clipped=sensor_limits([r for r in nominal.recordings if not r.test], arm.chain.n),
        pauses=_apart(nominal),
    )


def _apart(nominal: Nominal) -> bool:
    """Whether each session begins after the end of the one before, within a day."""
    ordered = sorted(nominal.recordings, key=lambda r: r.begun_s)
    pauses = [b.begun_s - a.begun_s - a.duration_s for a, b in pairwise(ordered)]
    return bool(pauses) and all(0.0 < pause < _DAY_S for pause in pauses)
