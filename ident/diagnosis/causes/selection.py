"""Selection of causes: greedy acceptance, reconsideration, look-alikes, remainders.

A round scores every candidate beside the base and the accepted causes, and accepts the best with enough evidence.
Then it reconsiders each earlier one: it may be unnecessary now, or another cause or joint may be better in its place.
Small deviations of the nominal arm (sub-millisecond delays, joint stiffness) are columns of the base within their
tolerance, so they neither hide nor mimic a cause.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from ident.diagnosis.causes.candidates import Candidate, Dictionary, Trial
from ident.diagnosis.causes.healthy_null import HealthyNull
from ident.diagnosis.causes.model_form import model_form_error
from ident.diagnosis.causes.tolerances import Deviation, Kind, Tolerance, tolerances
from ident.diagnosis.causes.usual_sizes import Healthy
from ident.diagnosis.gain.evidence import Evidence
from ident.diagnosis.gain.products import Floats, Key, Rows, width_of
from ident.diagnosis.gain.rivals import confidence, exceeds, look_alikes
from ident.diagnosis.gain.score import Score
from ident.diagnosis.settings import DiagnosisSettings
from ident.effects import EFFECTS

log = logging.getLogger(__name__)

# Least square of the correlation of two laws of one drive's speed that stand for each other.
_ALIKE = 0.5
# Obvious evidence, over the usual one.
_PLAIN = 10.0
# Least share of a claim's gain taken away by a rival's columns.
_TAKEN = 0.5
# Number of foremost trials with refined shapes.
_CONTEST = 4
# Least share of a claim's power in the rows of a rival.
_SAME_ROWS = 0.2
# Remainder of a law over its gain, and least share of a trial's power in the rows of that law's joint to be it.
_LAW_ERROR, _MOSTLY = 0.1, 0.8
# Least time between two separate pushes [s].
_PAUSE_S = 0.2
# Habits of the arm that are tolerated: least gain, least share of the best candidate's gain, number of candidates, and
# of shapes of each.
_LEAST_HABIT, _NEAR, _MOST_HABITS, _SHAPES = 100.0, 0.5, 4, 2
# Least gain of `best_candidate`.
_LEAST_GAIN = 10.0
# Confidence in a sensor's error with a record of the joint torque only.
_SHAPE_ALONE = 0.7
# Confidence in one of two causes of the same torque in these motions.
_EITHER = 0.5
# A change of a length over its standard deviation.
_CERTAIN = 3.0
# Latest sets of columns whose best shapes are kept.
_LATEST = 6


@dataclass(frozen=True, eq=False)
class Claim:
    """An accepted trial: its score beside all other claims, and the candidates of similar gain.

    outdone : a rival without enough evidence of its own has a larger gain in the same rows. changed_alone : healthy
    sets reached its gain, and it is more than there by its difference from the usual size alone.
    """

    trial: Trial
    score: Score
    alternatives: tuple[tuple[Candidate, float], ...] = ()
    confidence: float = 1.0
    outdone: bool = False
    changed_alone: bool = False

    @property
    def gain(self) -> float:
        """Fall of the cross-validated chi-square by adding it to all others."""
        return self.score.gain


@dataclass(eq=False)
class Selection:
    """Result of `select`. deviations : the tolerated ones within their tolerance. scores : gain of each candidate
    beside them alone."""

    claims: list[Claim]
    deviations: Sequence[Deviation] = ()
    scores: dict[tuple[str, int], float] = field(default_factory=dict)

    @property
    def nuisance(self) -> dict[str, tuple[float, float]]:
        """Value and standard deviation of the tolerated deviations by name."""
        return {one.tolerance.name: (one.value, one.std) for one in self.deviations}

    @property
    def nuisance_rows(self) -> list[Rows]:
        """Rows of the tolerated deviations."""
        return [one.tolerance.rows for one in self.deviations]


def select(
    dictionary: Dictionary,
    evidence: Evidence,
    settings: DiagnosisSettings,
    healthy: Healthy | None = None,
) -> Selection:
    """Accept causes one after the other as long as the evidence suffices."""
    state = State(dictionary, evidence, settings, healthy or Healthy())
    state.tolerate([])
    first: dict[tuple[str, int], float] = {}
    accepted: list[Trial] = []
    for _ in range(settings.rounds):
        found = state.contenders(accepted)
        first = first or {t.candidate.key: max(t.score.gain, 0.0) for t in found}
        while state.habit(found):
            found = state.contenders(accepted)
        best = state.next(accepted, [t for t in found if state.carried(t)])
        if best is None:
            break
        log.info("%s: gain %.0f", best.candidate.key, best.score.gain)
        accepted = state.merged(state.reconsider([*accepted, best]))
        if best.candidate.key not in [t.candidate.key for t in accepted]:
            break
    claims = [state.claim(accepted, k) for k in range(len(accepted))]
    while doubtful := [
        k for k, c in enumerate(claims) if c.outdone or state.leftover(c.trial, state.others(accepted, k))
    ]:
        # A better explanation of the same rows lacks evidence itself, or the claim is the remainder of another.
        accepted.pop(min(doubtful, key=lambda k: claims[k].gain))
        claims = [state.claim(accepted, k) for k in range(len(accepted))]
    state.tolerate(accepted)
    claims.sort(key=lambda c: -c.gain)
    return Selection(claims, state.deviations, first)


def gains(
    dictionary: Dictionary, evidence: Evidence, settings: DiagnosisSettings
) -> dict[tuple[str, int], float]:
    """Gain of each candidate before any acceptance, for the null of a healthy arm."""
    found = State(dictionary, evidence, settings).contenders([])
    return {t.candidate.key: max(t.score.gain, 0.0) for t in found}


def best_candidate(
    dictionary: Dictionary, evidence: Evidence, settings: DiagnosisSettings
) -> Selection | None:
    """The best candidate as if accepted, even without enough evidence; None if none explains anything.

    With noise known from the residual alone, a strong cause counts as noise until it is in the model. Its gain must
    be compared with its own residual.
    """
    state = State(dictionary, evidence, settings)
    best = next(iter(state.contenders([])), None)
    if best is None or best.score.gain < _LEAST_GAIN:
        return None
    return Selection([Claim(best, best.score)], state.deviations)


def longer_turns(dictionary: Dictionary, evidence: Evidence, settings: DiagnosisSettings) -> Floats:
    """Logarithms (n,) of the factors on the drives' presliding lengths in a reference, beside the other tolerated
    deviations; 0 where it is no more than its own uncertainty."""
    state = State(dictionary, evidence, settings)
    state.tolerate([])
    found = np.zeros(dictionary.nominal.arm.chain.n)
    for one in state.deviations:
        if one.tolerance.kind is Kind.LENGTH and abs(one.value) > _CERTAIN * one.std:
            found[one.tolerance.number] = one.value
    return found


def _same_moment(trial: Trial, other: Trial) -> bool:
    """Whether two trials are one cause at one time: the remainder of a push while it lasts."""
    one, two = trial.shape, other.shape
    if trial.candidate.key != other.candidate.key or not {"duration", "session"} <= set(one):
        return False
    apart = abs(one["time"] - two["time"]) - 0.5 * (one["duration"] + two["duration"])
    return one["session"] == two["session"] and apart < _PAUSE_S


def _is_its_mean(trial: Trial, other: Trial) -> bool:
    """Whether a trial may be the mean of the model-form error of another in the same joint."""
    one, two = trial.candidate, other.candidate
    return one.joint == two.joint and two.cause in one.effect.mean_of


def _follows(trial: Trial, other: Trial) -> bool:
    """Whether a trial is a consequence of another in the same joint."""
    one, two = trial.candidate, other.candidate
    return one.joint == two.joint and one.effect.follows_from(
        trial.shape, trial.score.coefficients, two.effect, other.shape, other.score.coefficients
    )


def _gain(trial: Trial) -> float:
    """Gain for the order of candidates, with a penalty for freedom."""
    return trial.score.gain - 2.0 * trial.shape.freedom


@dataclass(eq=False)
class State:
    """What is accepted and tolerated so far, and the candidates beside it."""

    dictionary: Dictionary
    evidence: Evidence
    settings: DiagnosisSettings
    healthy: Healthy = field(default_factory=Healthy)
    deviations: Sequence[Deviation] = ()
    null: HealthyNull = field(init=False)
    _tolerances: list[Tolerance] | None = None
    _accepted: Sequence[Trial] = ()
    _latest: dict[tuple[int, ...], list[Trial]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.null = HealthyNull(self.dictionary, self.settings, self.healthy)

    # ---- tolerated deviations ----

    def tolerated(self) -> list[Tolerance]:
        """The tolerated deviations."""
        if self._tolerances is None:
            self._tolerances = tolerances(self.dictionary, self.evidence, self.settings)
        return self._tolerances

    def tolerate(self, accepted: Sequence[Trial]) -> None:
        """Base with the accepted columns and the deviations within their tolerance, but for those of an accepted
        cause: of two equal columns each would take a half."""
        self._accepted = accepted
        taken = {t.candidate.key for t in accepted}
        entries = [one for one in self.tolerated() if one.of not in taken]
        fixed = [t.rows for t in accepted]
        place = self.evidence.base_count + sum(width_of(rows) for rows in fixed)
        inside = entries
        while True:
            self.evidence.replace([*fixed, *(one.rows for one in inside)])
            values = self.evidence.full.values[place:]
            over = [abs(v) * one.unit / max(one.size, 1e-300) for one, v in zip(inside, values, strict=True)]
            if max(over, default=0.0) <= 1.0:
                break
            # Without the farthest one the others may be inside.
            inside = [one for one, share in zip(inside, over, strict=True) if share < max(over)]
        # A motion without information on a deviation leaves its variance open.
        std = np.sqrt(np.maximum(np.diag(self.evidence.full.inverse), 0.0))[place:]
        self.deviations = [
            Deviation(one, float(v) * one.unit, float(s) * one.unit)
            for one, v, s in zip(inside, values, std, strict=True)
        ]

    # ---- rounds ----

    def contenders(self, accepted: Sequence[Trial]) -> list[Trial]:
        """Best shapes of all candidates beside the accepted ones, best first."""
        self.tolerate(accepted)
        taken = {t.candidate.key for t in accepted if not t.candidate.effect.repeats}
        found = [t for t in self.simplest() if t.candidate.key not in taken]
        found = [t for t in found if not any(_same_moment(t, other) for other in accepted)]
        return sorted(found, key=_gain, reverse=True)

    def simplest(self) -> list[Trial]:
        """Best shapes of all candidates, without those replaceable by a special case; beside the same columns they
        are the same."""
        # The evidence keeps the columns, so their identity stays theirs.
        beside = tuple(map(id, self.evidence.extra))
        found = self._latest.pop(beside, None) or self._simplest()
        self._latest[beside] = found
        if len(self._latest) > _LATEST:
            self._latest.pop(next(iter(self._latest)))
        return found

    def _simplest(self) -> list[Trial]:
        found = list(self.dictionary.trials())
        gain = {t.candidate.key: _gain(t) for t in found}

        def needed(trial: Trial) -> bool:
            cases = trial.candidate.effect.special_cases(trial.shape, trial.candidate.joint)
            return all(
                exceeds(_gain(trial), gain[case])
                for case in cases
                if case in gain and case != trial.candidate.key
            )

        return [t for t in found if needed(t)]

    def rivals(self) -> list[Trial]:
        """The simplest candidates by their gain, best first. A gain as on the healthy arm explains nothing."""
        found = [t for t in self.simplest() if self.null.exceeded(t)]
        return sorted(found, key=_gain, reverse=True)

    def next(self, accepted: Sequence[Trial], carried: list[Trial]) -> Trial | None:
        """The foremost of the trials, without remainders of the accepted ones; None if there is none."""
        refined: dict[tuple[str, int], Trial] = {}
        while carried:
            for trial in carried[:_CONTEST]:
                if trial.candidate.key not in refined:
                    refined[trial.candidate.key] = self.refined(trial)
            best = self.foremost(accepted, [refined[t.candidate.key] for t in carried[:_CONTEST]])
            if not self.leftover(best, accepted):
                return best
            self.tolerate(accepted)
            carried = [t for t in carried if t.candidate.key != best.candidate.key]
        return None

    def habit(self, found: Sequence[Trial]) -> bool:
        """Tolerates the best candidate of a gain as on healthy days, near that of the best one of all; whether there is
        one. A change from day to day that is not in the model would pass for other causes."""
        known = [one for one in self.tolerated() if one.kind is Kind.HABIT]
        near = [t for t in found if t.score.gain > max(_LEAST_HABIT, _NEAR * found[0].score.gain)]
        shapes = Counter(one.of for one in known)
        for trial in near:
            key = trial.candidate.key
            if shapes[key] == _SHAPES or (key not in shapes and len(shapes) == _MOST_HABITS):
                continue
            single = len(trial.score.coefficients) == 1 and not trial.candidate.effect.timed(trial.shape)
            if single and not self.carried(trial) and self.carried(trial, healthy=False):
                log.info("%s: gain %.0f, as on healthy days", trial.candidate.key, trial.score.gain)
                self.tolerated().append(Tolerance(Kind.HABIT, len(known), trial.rows, np.inf, key))
                return True
        return False

    def _of_unknown_stiffness(self, trial: Trial) -> bool:
        """Whether a trial is a change of a compliance by no more than commissioning leaves unknown."""
        known = [
            one.size
            for one in self.tolerated()
            if one.of == trial.candidate.key and one.kind is Kind.COMPLIANCE
        ]
        return bool(known) and float(np.abs(trial.score.coefficients[0])) <= known[0]

    def _by_habits(self, trial: Trial) -> bool:
        """Whether a trial is more than on a healthy arm only beside habits in its rows: the healthy sets were without
        them, and columns of friction share it among them."""
        known = self.tolerated()
        others = [one for one in known if not (one.kind is Kind.HABIT and set(one.rows) & set(trial.rows))]
        if len(others) == len(known):
            return False
        present, deviations = list(self.evidence.extra), self.deviations
        self._tolerances = others
        self.tolerate(self._accepted)
        alone = self.dictionary.trial(trial.candidate, trial.shape, self.choices(trial))
        found = alone is None or not self.null.exceeded(alone)
        self._tolerances, self.deviations = known, deviations
        self.evidence.replace(present)
        return found

    def _of_own_law(self, trial: Trial) -> bool:
        """Whether a law of a drive's speed is like the healthy arm's own one, and no larger than the error of that:
        where the healthy sets were not as slow, its size follows from the form alone."""
        candidate, law = trial.candidate, trial.candidate.effect.law
        if law is None or law.variable != "qd":
            return False
        key = ("motor", candidate.joint)
        own = [
            one
            for one in self.tolerated()
            if one.kind is Kind.SIZE
            and one.of is not None
            and one.of[1] == candidate.joint
            and EFFECTS[one.of[0]].law == law
            and key in one.rows
        ]
        for one in own:
            used = self.dictionary.nominal.rows["motor"].valid[:, candidate.joint]
            torque = (trial.rows[key] @ trial.score.coefficients)[used]
            largest = one.rows[key][used, 0] * one.size
            alike = np.corrcoef(torque, largest)[0, 1] ** 2 > _ALIKE
            if alike and np.var(torque) <= np.var(largest):
                return True
        return False

    def refined(self, trial: Trial) -> Trial:
        """The trial with its shape at the best fit, unless cross-validation contradicts that shape."""
        found = self.dictionary.refine(trial, self.choices(trial))
        return found if self.carried(found) else trial

    def foremost(self, accepted: Sequence[Trial], contest: Sequence[Trial]) -> Trial:
        """The best of several trials; of close ones, the one with the smallest remainder beside the tolerated
        deviations.
        """
        top = max(_gain(t) for t in contest)
        close = [t for t in contest if _gain(t) > 0.7 * top]
        if len(close) == 1:
            return close[0]
        left = []
        for trial in close:
            self.tolerate([*accepted, trial])
            left.append(self.evidence.chi_square + 2.0 * trial.shape.freedom)
        self.tolerate(accepted)
        return close[int(np.argmin(left))]

    def choices(self, trial: Trial) -> int:
        """Number of shapes in the choice of an event."""
        return self.evidence.blocks if trial.candidate.effect.timed(trial.shape) else 1

    def carried(self, trial: Trial, score: Score | None = None, *, healthy: bool = True) -> bool:
        """Whether the evidence for the trial suffices: gain, significance, and size. healthy : False asks for no more
        gain than on healthy days."""
        score = trial.score if score is None else score
        settings = self.settings
        least = self.null.least(trial.candidate, score)
        if score.gain <= least:
            return False
        if healthy and (
            not self.null.exceeded(trial)
            or self._of_unknown_stiffness(trial)
            or self._by_habits(trial)
            or self._of_own_law(trial)
        ):
            return False
        if trial.candidate.effect.seen_in_samples(trial.shape):
            return True
        if score.p_value >= settings.alpha_rare:
            return False
        least = max(least, self.null.limit(trial)) if healthy else least
        # A brief event is large for a moment, and small in the whole session.
        size = np.inf if trial.candidate.effect.event else score.inflation * self.concentration(trial, score)
        needed = trial.candidate.effect.evidence_factor * settings.least_inflation
        # A cause in few blocks cannot be significant by blocks, however large; cross-validation decides instead.
        rare = score.gain > _PLAIN * least and _PLAIN * needed < size < np.inf
        return size > needed and score.p_value < (settings.alpha_rare if rare else settings.alpha)

    def concentration(self, trial: Trial, score: Score) -> float:
        """Number of a trial's groups of rows over their effective number `(sum p)^2 / sum p^2`.

        p is the power of its torque in the rows of each joint and side, in units of the noise. A small turn of one
        joint's zero acts on every row, and is visible in two or three.
        """
        if len(trial.rows) == 1:
            return 1.0
        power = np.array(list(self.powers(trial, score).values()))
        squares = float(np.sum(np.square(power)))
        return len(power) * squares / float(np.sum(power)) ** 2 if squares > 0.0 else 1.0

    def powers(self, trial: Trial, score: Score) -> dict[Key, float]:
        """Power of a trial's torque in the rows of each joint and side, in units of the noise."""
        found = {}
        for (side, joint), columns in trial.rows.items():
            used = self.dictionary.nominal.rows[side].valid[:, joint]
            torque = columns[used] @ score.coefficients / self.evidence.sigma[side][joint]
            found[side, joint] = float(np.var(torque)) if used.any() else 0.0
        return found

    def share_at(self, trial: Trial, joint: int) -> float:
        """Share of a trial's power in the rows of a joint."""
        powers = self.powers(trial, trial.score)
        return sum(p for (_, at), p in powers.items() if at == joint) / max(sum(powers.values()), 1e-300)

    def beside(self, accepted: Sequence[Trial], without: int) -> list[Trial]:
        """All but one of the accepted, in the base."""
        rest = [t for k, t in enumerate(accepted) if k != without]
        self.tolerate(rest)
        return rest

    def reconsider(self, accepted: list[Trial]) -> list[Trial]:
        """Each of the accepted beside the others: drop it, refine it, or replace it."""
        if len(accepted) == 1:
            return accepted
        for _ in range(2):
            changed = False
            k = 0
            while k < len(accepted) and len(accepted) > 1:
                here = accepted[k]
                rest = self.beside(accepted, k)
                taken = {t.candidate.key for t in rest if not t.candidate.effect.repeats}
                again = self.dictionary.trial(here.candidate, here.shape, self.choices(here))
                rivals = [t for t in self.rivals() if t.candidate.key not in taken]
                contest = [t for t in rivals[:3] if again is None or _gain(t) > 0.9 * _gain(again)]
                contest = [self.dictionary.refine(t, self.choices(t)) for t in contest]
                if again is not None:
                    contest = [*self.competing(again, contest, rest), again]
                best = max(contest, key=_gain) if contest else None
                if best is None or not self.carried(best):
                    accepted = rest
                    changed = True
                    continue
                if best.candidate.key != here.candidate.key or best is not again:
                    changed = changed or best.candidate.key != here.candidate.key
                    accepted = [*accepted[:k], best, *accepted[k + 1 :]]
                k += 1
            if not changed:
                break
        return accepted

    def merged(self, accepted: list[Trial]) -> list[Trial]:
        """Without special cases that a cause containing them, fitted in their stead, leaves nothing to explain of."""
        for general in accepted:
            cases = general.candidate.effect.special_cases(general.shape, general.candidate.joint)
            for special in (t for t in accepted if t is not general and t.candidate.key in cases):
                rest = [t for t in accepted if t is not general and t is not special]
                self.tolerate(rest)
                alone = self.dictionary.best(general.candidate)
                if alone is None:
                    continue
                alone = self.dictionary.refine(alone, self.choices(alone))
                self.tolerate([*rest, alone])
                left = self.dictionary.best(special.candidate)
                if left is None or not self.carried(left):
                    return [*rest, alone]
        return accepted

    def competing(self, here: Trial, rivals: Sequence[Trial], rest: Sequence[Trial]) -> list[Trial]:
        """The rivals of a trial beside the rest: with one of them in the model, most of the trial's gain is gone.

        Two causes may act in the same rows and explain different parts of them, so gains alone say nothing about a
        competition.
        """
        found = []
        for rival in rivals:
            self.tolerate([*rest, rival])
            again = self.dictionary.trial(here.candidate, here.shape, self.choices(here))
            if again is None or again.score.gain < (1.0 - _TAKEN) * here.score.gain:
                found.append(rival)
        if rivals:
            self.tolerate(rest)
        return found

    # ---- claims ----

    def leftover(self, trial: Trial, others: Sequence[Trial]) -> bool:
        """Whether a trial is a remainder of the others.

        It is one if it follows from another or is a weaker push at the same moment, if the least error of a stronger
        one's law explains it in the rows of that joint, or if it lacks evidence beside model-form errors of the
        stronger ones in its rows.
        """
        wide = []
        if any(_follows(trial, other) for other in others):
            return True
        if any(_same_moment(trial, other) and other.score.gain > trial.score.gain for other in others):
            # A search of times may end at the push beside it.
            return True
        for other in others:
            stronger = other.score.gain > trial.score.gain or _is_its_mean(trial, other)
            if stronger and set(trial.rows) & set(other.rows):
                small = trial.score.gain < _LAW_ERROR * other.score.gain
                small = small and not other.candidate.effect.whole_arm
                if small and self.share_at(trial, other.candidate.joint) > _MOSTLY:
                    return True
                rows = model_form_error(self.dictionary, other)
                wide += [] if rows is None else [rows]
        if not wide:
            return False
        self.tolerate(others)
        self.evidence.replace([*self.evidence.extra, *wide])
        again = self.dictionary.trial(trial.candidate, trial.shape, self.choices(trial))
        return again is None or not self.carried(again)

    def others(self, accepted: Sequence[Trial], k: int) -> list[Trial]:
        """The accepted trials without number k, each with its gain beside the rest of them: what two of almost equal
        torque explain belongs to neither while both are in the base."""
        found = [t for i, t in enumerate(accepted) if i != k]
        for i, trial in enumerate(found):
            self.beside(found, i)
            found[i] = self.dictionary.trial(trial.candidate, trial.shape, self.choices(trial)) or trial
        return found

    def claim(self, accepted: Sequence[Trial], k: int) -> Claim:
        """The accepted trial number k with its look-alikes, given all others."""
        here = accepted[k]
        rest = self.beside(accepted, k)
        taken = {t.candidate.key for t in rest if not t.candidate.effect.repeats}
        again = self.dictionary.trial(here.candidate, here.shape, self.choices(here)) or here
        rivals = [t for t in self.rivals() if t.candidate.key not in {*taken, here.candidate.key}]
        # A rival in other rows, or in rows with little power of this one, explains something else.
        mine = self.powers(again, again.score)
        least = _SAME_ROWS * sum(mine.values())
        rivals = [t for t in rivals if sum(mine.get(key, 0.0) for key in t.rows) > least]
        close = [t for t in rivals[:6] if _gain(t) > 0.6 * _gain(again)]
        close = self.competing(again, [self.dictionary.refine(t, self.choices(t)) for t in close], rest)
        scores = sorted(((t.candidate, _gain(t)) for t in close), key=lambda pair: -pair[1])
        sure = confidence(_gain(again), [g for _, g in scores])
        alike = look_alikes(_gain(again), scores, sure)
        if here.candidate.effect.side == "sensor" and "motor" not in self.dictionary.nominal.rows:
            # Without a motor torque only the shape distinguishes a sensor's error from a torque of the arm.
            sure = min(sure, _SHAPE_ALONE)
            physical = (
                (t.candidate, _gain(t))
                for t in rivals
                if t.candidate.joint == here.candidate.joint and t.candidate.effect.side == "joint"
            )
            alike = alike or tuple(physical)[:1]
        twin = self.same_torque(here.candidate)
        if twin is not None:
            sure, alike = min(sure, _EITHER), (*alike, (twin, _gain(again)))
        # Of many times tried, one always fits to some degree.
        lasting = (t for t in close if not t.candidate.effect.timed(t.shape))
        outdone = any(_gain(t) > _gain(again) and not self.carried(t) for t in lasting)
        changed_alone = again.score.gain <= self.null.limit(again)
        return Claim(again, again.score, alike, sure, outdone, changed_alone)

    def same_torque(self, candidate: Candidate) -> Candidate | None:
        """The candidate of the same torque in these sessions, by the physics of the effect."""
        cause = candidate.effect.same_as(self.dictionary.setting, candidate.joint)
        return next((c for c in self.dictionary.candidates if c.key == (cause, candidate.joint)), None)
