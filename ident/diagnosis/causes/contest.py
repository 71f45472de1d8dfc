"""Trials against one another, beside what is accepted and tolerated."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Container, Iterator, Sequence
from functools import partial
from itertools import islice

import numpy as np

from ident.diagnosis.causes.candidates import Dictionary, Trial
from ident.diagnosis.causes.healthy_null import HealthyNull
from ident.diagnosis.causes.model_form import model_form_error
from ident.diagnosis.causes.sufficiency import Sufficiency, choices, share_at
from ident.diagnosis.causes.tolerated import Tolerated
from ident.diagnosis.causes.usual_sizes import Healthy
from ident.diagnosis.gain.evidence import Evidence
from ident.diagnosis.gain.rivals import exceeds
from ident.diagnosis.settings import DiagnosisSettings

log = logging.getLogger(__name__)

# Least share of a claim's gain taken away by a rival's columns.
_TAKEN = 0.5
# Number of foremost trials with refined shapes.
_CONTEST = 4
# Remainder of a law over its gain, and least share of a trial's power in the rows of that law's joint to be it.
_LAW_ERROR, _MOSTLY = 0.1, 0.8
# Least time between two separate pushes [s].
_PAUSE_S = 0.2
# Habits of the arm that are tolerated: least gain, least share of the best candidate's gain, number of candidates, and
# of shapes of each.
_LEAST_HABIT, _NEAR, _MOST_HABITS, _SHAPES = 100.0, 0.5, 4, 2
# Latest sets of columns whose best shapes are kept.
_LATEST = 6


def gain_of(trial: Trial) -> float:
    """Gain for the order of candidates, with a penalty for freedom."""
    return trial.score.gain - 2.0 * trial.shape.freedom


def _is_near(trial: Trial, *, least: float, taken: Container[tuple[str, int]]) -> bool:
    """Whether a trial of another candidate than those `taken` has more than the least gain."""
    return trial.candidate.key not in taken and gain_of(trial) > least


def same_moment(trial: Trial, other: Trial) -> bool:
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


class Contest:
    """The candidates of a dictionary against one another. healthy : what healthy sets say of them.

    tolerated : the deviations beside all of them. enough : the tests of their evidence.
    """

    def __init__(
        self, dictionary: Dictionary, settings: DiagnosisSettings, healthy: Healthy | None = None
    ) -> None:
        self.dictionary = dictionary
        self.null = HealthyNull(dictionary, settings, healthy or Healthy())
        self.tolerated = Tolerated(dictionary, settings)
        self.enough = Sufficiency(dictionary, self.null, self.tolerated)
        self._latest: dict[tuple[int, ...], list[Trial]] = {}

    @property
    def evidence(self) -> Evidence:
        """That of the dictionary."""
        return self.dictionary.evidence

    def contenders(self, accepted: Sequence[Trial]) -> list[Trial]:
        """Best shapes of all candidates beside the accepted ones, best first."""
        self.tolerated.beside(accepted)
        taken = {t.candidate.key for t in accepted if not t.candidate.effect.repeats}
        found = [t for t in self.simplest() if t.candidate.key not in taken]
        found = [t for t in found if not any(same_moment(t, other) for other in accepted)]
        return sorted(found, key=gain_of, reverse=True)

    def simplest(self) -> list[Trial]:
        """Best shapes of all candidates, without those replaceable by a special case; beside the same columns they
        are the same."""
        beside = self.evidence.beside_what
        found = self._latest.pop(beside, None) or self._simplest()
        self._latest[beside] = found
        if len(self._latest) > _LATEST:
            self._latest.pop(next(iter(self._latest)))
        return found

    def _simplest(self) -> list[Trial]:
        found = list(self.dictionary.trials())
        gain = {t.candidate.key: gain_of(t) for t in found}

        def needed(trial: Trial) -> bool:
            cases = trial.candidate.effect.special_cases(trial.shape, trial.candidate.joint)
            return all(
                exceeds(gain_of(trial), gain[case])
                for case in cases
                if case in gain and case != trial.candidate.key
            )

        return [t for t in found if needed(t)]

    def rivals(self, wanted: Callable[[Trial], bool]) -> Iterator[Trial]:
        """The wanted ones of the simplest candidates, best first, each looked at as it is asked for. A gain as on the
        healthy arm explains nothing."""
        found = sorted(filter(wanted, self.simplest()), key=gain_of, reverse=True)
        return filter(self.null.exceeded, found)

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
            self.tolerated.beside(accepted)
            carried = [t for t in carried if t.candidate.key != best.candidate.key]
        return None

    def habit(self, found: Sequence[Trial]) -> bool:
        """Tolerates the best candidate of a gain as on healthy days, near that of the best one of all; whether there is
        one. A change from day to day that is not in the model would pass for other causes."""
        near = [t for t in found if t.score.gain > max(_LEAST_HABIT, _NEAR * found[0].score.gain)]
        shapes = Counter(one.of for one in self.tolerated.habits)
        for trial in near:
            key = trial.candidate.key
            if shapes[key] == _SHAPES or (key not in shapes and len(shapes) == _MOST_HABITS):
                continue
            single = len(trial.score.coefficients) == 1 and not trial.candidate.effect.timed(trial.shape)
            if single and not self.enough.carried(trial) and self.enough.carried(trial, healthy=False):
                log.info("%s: gain %.0f, as on healthy days", trial.candidate.key, trial.score.gain)
                self.tolerated.add_habit(trial)
                return True
        return False

    def refined(self, trial: Trial) -> Trial:
        """The trial with its shape at the best fit, unless cross-validation contradicts that shape."""
        found = self.dictionary.refine(trial, choices(trial, self.evidence))
        return found if self.enough.carried(found) else trial

    def foremost(self, accepted: Sequence[Trial], contest: Sequence[Trial]) -> Trial:
        """The best of several trials; of close ones, the one with the smallest remainder beside the tolerated
        deviations.
        """
        top = max(gain_of(t) for t in contest)
        close = [t for t in contest if gain_of(t) > 0.7 * top]
        if len(close) == 1:
            return close[0]
        left = []
        for trial in close:
            self.tolerated.beside([*accepted, trial])
            left.append(self.evidence.chi_square + 2.0 * trial.shape.freedom)
        self.tolerated.beside(accepted)
        return close[int(np.argmin(left))]

    def without(self, accepted: Sequence[Trial], k: int) -> list[Trial]:
        """All but number k of the accepted, in the base."""
        rest = [t for i, t in enumerate(accepted) if i != k]
        self.tolerated.beside(rest)
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
                rest = self.without(accepted, k)
                taken = {t.candidate.key for t in rest if not t.candidate.effect.repeats}
                again = self.dictionary.trial(here.candidate, here.shape, choices(here, self.evidence))
                least = -np.inf if again is None else 0.9 * gain_of(again)
                near = self.rivals(partial(_is_near, least=least, taken=taken))
                contest = [self.dictionary.refine(t, choices(t, self.evidence)) for t in islice(near, 3)]
                if again is not None:
                    contest = [*self.competing(again, contest, rest), again]
                best = max(contest, key=gain_of) if contest else None
                if best is None or not self.enough.carried(best):
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
                self.tolerated.beside(rest)
                alone = self.dictionary.best(general.candidate)
                if alone is None:
                    continue
                alone = self.dictionary.refine(alone, choices(alone, self.evidence))
                self.tolerated.beside([*rest, alone])
                left = self.dictionary.best(special.candidate)
                if left is None or not self.enough.carried(left):
                    return [*rest, alone]
        return accepted

    def competing(self, here: Trial, rivals: Sequence[Trial], rest: Sequence[Trial]) -> list[Trial]:
        """The rivals of a trial beside the rest: with one of them in the model, most of the trial's gain is gone.

        Two causes may act in the same rows and explain different parts of them, so gains alone say nothing about a
        competition.
        """
        found = []
        for rival in rivals:
            self.tolerated.beside([*rest, rival])
            again = self.dictionary.trial(here.candidate, here.shape, choices(here, self.evidence))
            if again is None or again.score.gain < (1.0 - _TAKEN) * here.score.gain:
                found.append(rival)
        if rivals:
            self.tolerated.beside(rest)
        return found

    def leftover(self, trial: Trial, others: Sequence[Trial]) -> bool:
        """Whether a trial is a remainder of the others.

        It is one if it follows from another or is a weaker push at the same moment, if the least error of a stronger
        one's law explains it in the rows of that joint, or if it lacks evidence beside model-form errors of the
        stronger ones in its rows.
        """
        wide = []
        if any(_follows(trial, other) for other in others):
            return True
        if any(same_moment(trial, other) and other.score.gain > trial.score.gain for other in others):
            # A search of times may end at the push beside it.
            return True
        for other in others:
            stronger = other.score.gain > trial.score.gain or _is_its_mean(trial, other)
            if stronger and set(trial.rows) & set(other.rows):
                small = trial.score.gain < _LAW_ERROR * other.score.gain
                small = small and not other.candidate.effect.whole_arm
                if small and share_at(trial, other.candidate.joint, self.dictionary) > _MOSTLY:
                    return True
                rows = model_form_error(self.dictionary, other)
                wide += [] if rows is None else [rows]
        if not wide:
            return False
        self.tolerated.beside(others)
        self.evidence.replace([*self.evidence.extra, *wide])
        again = self.dictionary.trial(trial.candidate, trial.shape, choices(trial, self.evidence))
        return again is None or not self.enough.carried(again)

    def others(self, accepted: Sequence[Trial], k: int) -> list[Trial]:
        """The accepted trials without number k, each with its gain beside the rest of them: what two of almost equal
        torque explain belongs to neither while both are in the base."""
        found = [t for i, t in enumerate(accepted) if i != k]
        for i, trial in enumerate(found):
            self.without(found, i)
            found[i] = (
                self.dictionary.trial(trial.candidate, trial.shape, choices(trial, self.evidence)) or trial
            )
        return found
