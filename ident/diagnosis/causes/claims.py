"""Claims: accepted trials with their look-alikes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice

from ident.diagnosis.causes.candidates import Candidate, Dictionary, Trial
from ident.diagnosis.causes.contest import Contest, gain_of
from ident.diagnosis.causes.sufficiency import choices, powers
from ident.diagnosis.gain.rivals import confidence, look_alikes
from ident.diagnosis.gain.score import Score

# Least share of a claim's power in the rows of a rival.
_SAME_ROWS = 0.2
# Confidence in a sensor's error with a record of the joint torque only.
_SHAPE_ALONE = 0.7
# Confidence in one of two causes of the same torque in these motions.
_EITHER = 0.5


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


def claim_of(contest: Contest, accepted: Sequence[Trial], k: int) -> Claim:
    """The accepted trial number k with its look-alikes, given all others."""
    dictionary, evidence, here = contest.dictionary, contest.evidence, accepted[k]
    rest = contest.without(accepted, k)
    taken = {t.candidate.key for t in rest if not t.candidate.effect.repeats}
    again = dictionary.trial(here.candidate, here.shape, choices(here, evidence)) or here
    taken.add(here.candidate.key)
    mine = powers(again, dictionary)
    least = _SAME_ROWS * sum(mine.values())

    def in_its_rows(trial: Trial) -> bool:
        # A rival in other rows, or in rows with little power of this one, explains something else.
        return trial.candidate.key not in taken and sum(mine.get(key, 0.0) for key in trial.rows) > least

    def near(trial: Trial) -> bool:
        return gain_of(trial) > 0.6 * gain_of(again) and in_its_rows(trial)

    def physical(trial: Trial) -> bool:
        one = trial.candidate
        return one.joint == here.candidate.joint and one.effect.side == "joint" and in_its_rows(trial)

    close = list(islice(contest.rivals(near), 6))
    close = contest.competing(again, [dictionary.refine(t, choices(t, evidence)) for t in close], rest)
    scores = sorted(((t.candidate, gain_of(t)) for t in close), key=lambda pair: -pair[1])
    sure = confidence(gain_of(again), [g for _, g in scores])
    alike = look_alikes(gain_of(again), scores, sure)
    if here.candidate.effect.side == "sensor" and "motor" not in dictionary.nominal.rows:
        # Without a motor torque only the shape distinguishes a sensor's error from a torque of the arm.
        sure = min(sure, _SHAPE_ALONE)
        alike = alike or tuple((t.candidate, gain_of(t)) for t in islice(contest.rivals(physical), 1))
    twin = _same_torque(dictionary, here.candidate)
    if twin is not None:
        sure, alike = min(sure, _EITHER), (*alike, (twin, gain_of(again)))
    # Of many times tried, one always fits to some degree.
    lasting = (t for t in close if not t.candidate.effect.timed(t.shape))
    outdone = any(gain_of(t) > gain_of(again) and not contest.enough.carried(t) for t in lasting)
    changed_alone = again.score.gain <= contest.null.limit(again)
    return Claim(again, again.score, alike, sure, outdone, changed_alone)


def _same_torque(dictionary: Dictionary, candidate: Candidate) -> Candidate | None:
    """The candidate of the same torque in these sessions, by the physics of the effect."""
    cause = candidate.effect.same_as(dictionary.setting, candidate.joint)
    return next((c for c in dictionary.candidates if c.key == (cause, candidate.joint)), None)
