"""What of a trial is more than in the sets of a healthy arm, as much as their motions and the present ones tell."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from ident.diagnosis.causes.candidates import Candidate, Dictionary, Trial
from ident.diagnosis.causes.tolerances import HABITUAL, usual_change
from ident.diagnosis.causes.usual_sizes import Healthy, Key, UsualSize
from ident.diagnosis.gain.score import Score
from ident.diagnosis.settings import DiagnosisSettings
from ident.effects import Shape

# Least and largest ratio of the information to that of the healthy sets: less of it makes no limit smaller, for what
# the model lacks differs from motion to motion, too.
_INFORMATION = (1.0, 25.0)
# Least number of other joints that tell the state of a day.
_OTHERS = 2
# Largest share of a trial's gain that its shape has more than the nearest one of the grid, of the same size otherwise.
_OF_SHAPE = 0.1


def _counterpart(shape: str, here: Iterable[str], there: Iterable[str]) -> str:
    """The shape in the grid of other sessions in the place of one in these, of the same form; itself without one.

    Times and torques of a grid are shares of the sessions' own.
    """

    def alike(table: Iterable[str]) -> list[str]:
        return [one for one in table if one.partition("=")[0] == shape.partition("=")[0]]

    mine, others = alike(here), alike(there)
    if shape in others or shape not in mine or len(mine) != len(others):
        return shape
    return others[mine.index(shape)]


def _is_step(trial: Trial) -> bool:
    """Whether a trial is a step of what may drift as well."""
    effect = trial.candidate.effect
    return trial.shape.form in effect.onsets and not effect.event


def _of_the_day(trial: Trial) -> bool:
    """Whether a trial follows from the state of a day in all joints on a healthy arm, such as its warmth: a drift with
    it, or any step between sessions."""
    effect = trial.candidate.effect
    return effect.together or effect.mode(trial.shape) == "between"


class HealthyNull:
    """The gains of candidates that a healthy arm reaches in the present sessions."""

    def __init__(self, dictionary: Dictionary, settings: DiagnosisSettings, healthy: Healthy) -> None:
        self.dictionary, self.settings, self.healthy = dictionary, settings, healthy
        self._present: dict[Key, float] = {}

    def meet(self, found: Sequence[Trial]) -> None:
        """Takes the state of the day from the best trials of all candidates before any claim: their gains over the
        means of the healthy sets, as much as the motions of either show."""
        for trial in found:
            key = trial.candidate.key
            days = self.healthy.days.get(key)
            if days is not None and days.mean > 0.0:
                usual = days.mean * self._shown_more(trial.candidate, self.dictionary.nearest(trial))
                self._present[key] = trial.score.gain / usual

    def _state(self, key: Key) -> float:
        """Square of the state of the day in units of that on the days of the healthy sets, at least 1: the median over
        the other joints, which a fault of one of them leaves alone; infinite where they are too few to tell."""
        cause, joint = key
        others = [one for (name, at), one in self._present.items() if name == cause and at != joint]
        return max(1.0, float(np.median(others))) if len(others) >= _OTHERS else np.inf

    def limit(self, trial: Trial) -> float:
        """Upper limit of the gain of such a trial on a healthy arm; 0 for a step, see `exceeded`."""
        if _is_step(trial):
            return 0.0
        key = trial.candidate.key
        limit, days = self.healthy.limits.get(key, 0.0), self.healthy.days.get(key)
        if days is not None and days.mean > 0.0 and _of_the_day(trial):
            limit = min(days.by_days, self._state(key) * days.by_joints)
        return self._in_these(trial.candidate, limit, self.dictionary.nearest(trial), trial.score)

    def exceeded(self, trial: Trial) -> bool:
        """Whether a trial is more than on a healthy arm: its difference from the usual size. Its gain alone suffices
        where the healthy sets have no clear size, and for a change between sessions, which has none: it is that of the
        day's state. A step has to be more than a drift in its place: that of a healthy arm has a gain as a step, too.
        """
        candidate = trial.candidate
        if _is_step(trial):
            drifts = [one.gain for one in self.dictionary.scores(candidate).values()]
            return trial.score.gain - max([0.0, *drifts]) > self.least(candidate, trial.score)
        more = trial.score.gain > self.limit(trial)
        usual = self.healthy.sizes.get(candidate.key)
        here = None if usual is None else self.dictionary.scored(candidate, usual[0].shape)
        if usual is None:
            return more
        size, limit = usual
        if self._is_known(trial, size, here):
            return False
        if here is None or self._between(trial, size):
            return more
        change = size.beyond(here)
        other = trial.score.gain - max(here.gain, 0.0)
        # Days alike by chance have a limit below that of noise.
        limit = max(self._in_these(candidate, limit, size.shape, here), self.least(candidate, here))
        changed = change > 0.0 and change + other > limit
        scatter = self._in_these(candidate, size.scatter, size.shape, here)
        return changed or (more and not size.clear(here, scatter))

    def _between(self, trial: Trial, size: UsualSize) -> bool:
        """Whether a trial or the usual size is a change between sessions."""
        effect = trial.candidate.effect
        usual = self.dictionary.shape(trial.candidate, size.shape) if effect.mode(trial.shape) else None
        shapes = [trial.shape, *([] if usual is None else [usual])]
        return any(effect.mode(shape) == "between" for shape in shapes)

    def _is_known(self, trial: Trial, size: UsualSize, usual: Score | None) -> bool:
        """Whether a trial is a size that the healthy sets have as well, however little they show of it. usual : its
        score in the usual shape."""
        candidate = trial.candidate
        for shape in dict.fromkeys((self.dictionary.nearest(trial), size.shape)):
            known = size.known.get(shape)
            if known is None:
                continue
            here = usual if shape == size.shape else self.dictionary.scored(candidate, shape)
            if here is None or not known.holds(here):
                continue
            other = trial.score.gain - max(here.gain, 0.0)
            if other <= max(_OF_SHAPE * trial.score.gain, self.least(candidate, here)):
                return True
        return False

    def least(self, candidate: Candidate, score: Score) -> float:
        """Least gain of a claim."""
        return self.settings.least_of_claim(candidate.effect.evidence_factor, len(score.coefficients))

    def _in_these(self, candidate: Candidate, limit: float, shape: str, score: Score) -> float:
        """A limit in the healthy sets for a score, in sessions with as much information on a candidate of a shape.

        Few healthy days may be alike by chance, so it is no less than that of the usual change of a scale.
        """
        least = self._scaled(candidate, score)
        return max(limit * self._shown_more(candidate, shape), least) if limit else least

    def hardly_shown(self, trial: Trial) -> bool:
        """Whether the healthy sets show so little of a trial that its limit in them tells nothing, or it is unknown how
        much."""
        more = self._information(trial.candidate, self.dictionary.nearest(trial))
        return not more <= _INFORMATION[1]

    def _shown_more(self, candidate: Candidate, shape: str) -> float:
        """Information of these sessions on a shape over that of the healthy sets, within limits; 1 if unknown."""
        more = self._information(candidate, shape)
        return float(np.clip(more, *_INFORMATION)) if np.isfinite(more) else 1.0

    def _information(self, candidate: Candidate, shape: str) -> float:
        """Information of these sessions on a shape over that of the healthy sets, NaN if unknown."""
        shown, here = self.healthy.shown.get(candidate.key, {}), self.dictionary.information(candidate)
        before = shown.get(_counterpart(shape, here, shown), 0.0)
        return here.get(shape, 0.0) / before if before > 0.0 else np.nan

    def _scaled(self, candidate: Candidate, score: Score) -> float:
        """Gain by the largest usual change from day to day of a cause that is a scale, 0 for others and without a
        reference: as much as the score's own size tells beside the present columns."""
        if not candidate.effect.usual_change or not self.healthy.limits:
            return 0.0
        largest = HABITUAL * usual_change(candidate.effect, self.dictionary.nominal.arm)
        size = float(np.abs(score.coefficients[0])) if len(score.coefficients) == 1 else 0.0
        if size > 0.0:
            return score.gain * (largest / size) ** 2
        return self.dictionary.information(candidate).get(repr(Shape()), 0.0) * largest**2
