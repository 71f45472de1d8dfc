"""Whether the evidence for a trial suffices: gain, significance, size, and more than on a healthy arm."""

from __future__ import annotations

import numpy as np

from ident.diagnosis.causes.candidates import Dictionary, Trial
from ident.diagnosis.causes.healthy_null import HealthyNull
from ident.diagnosis.causes.tolerances import Kind
from ident.diagnosis.causes.tolerated import Tolerated
from ident.diagnosis.gain.evidence import Evidence
from ident.diagnosis.gain.products import Key
from ident.effects import EFFECTS

# Least square of the correlation of two laws of one drive's speed that stand for each other.
_ALIKE = 0.5
# Obvious evidence, over the usual one.
_PLAIN = 10.0


class Sufficiency:
    """The tests of the evidence for trials. null : gains of a healthy arm. tolerated : beside the trials."""

    def __init__(self, dictionary: Dictionary, null: HealthyNull, tolerated: Tolerated) -> None:
        self.dictionary, self.null, self.tolerated = dictionary, null, tolerated

    def carried(self, trial: Trial, *, healthy: bool = True) -> bool:
        """Whether the evidence for the trial suffices: gain, significance, and size. healthy : False asks for no more
        gain than on healthy days."""
        score, settings = trial.score, self.null.settings
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
        size = np.inf if trial.candidate.effect.event else score.inflation * self._concentration(trial)
        needed = trial.candidate.effect.evidence_factor * settings.least_inflation
        # A cause in few blocks cannot be significant by blocks, however large; cross-validation decides instead.
        rare = score.gain > _PLAIN * least and _PLAIN * needed < size < np.inf
        return size > needed and score.p_value < (settings.alpha_rare if rare else settings.alpha)

    def _of_unknown_stiffness(self, trial: Trial) -> bool:
        """Whether a trial is a change of a compliance by no more than commissioning leaves unknown."""
        known = [
            one.size
            for one in self.tolerated.known
            if one.of == trial.candidate.key and one.kind is Kind.COMPLIANCE
        ]
        return bool(known) and float(np.abs(trial.score.coefficients[0])) <= known[0]

    def _by_habits(self, trial: Trial) -> bool:
        """Whether a trial is more than on a healthy arm only beside habits in its rows: the healthy sets were without
        them, and columns of friction share it among them."""
        known = self.tolerated.known
        others = [one for one in known if not (one.kind is Kind.HABIT and set(one.rows) & set(trial.rows))]
        if len(others) == len(known):
            return False
        with self.tolerated.only(others):
            alone = self.dictionary.trial(
                trial.candidate, trial.shape, choices(trial, self.dictionary.evidence)
            )
            return alone is None or not self.null.exceeded(alone)

    def _of_own_law(self, trial: Trial) -> bool:
        """Whether a law of a drive's speed is like the healthy arm's own one, and no larger than the error of that:
        where the healthy sets were not as slow, its size follows from the form alone. Where they were, their own gains
        tell how well it is known."""
        candidate, law = trial.candidate, trial.candidate.effect.law
        if law is None or law.variable != "qd":
            return False
        key = ("motor", candidate.joint)
        own = [
            one
            for one in self.tolerated.known
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
                return self.null.hardly_shown(trial)
        return False

    def _concentration(self, trial: Trial) -> float:
        """Number of a trial's groups of rows over their effective number `(sum p)^2 / sum p^2`.

        p is the power of its torque in the rows of each joint and side, in units of the noise. A small turn of one
        joint's zero acts on every row, and is visible in two or three.
        """
        if len(trial.rows) == 1:
            return 1.0
        power = np.array(list(powers(trial, self.dictionary).values()))
        squares = float(np.sum(np.square(power)))
        return len(power) * squares / float(np.sum(power)) ** 2 if squares > 0.0 else 1.0


def choices(trial: Trial, evidence: Evidence) -> int:
    """Number of shapes in the choice of an event."""
    return evidence.blocks if trial.candidate.effect.timed(trial.shape) else 1


def powers(trial: Trial, dictionary: Dictionary) -> dict[Key, float]:
    """Power of a trial's torque in the rows of each joint and side, in units of the noise."""
    found = {}
    for (side, joint), columns in trial.rows.items():
        used = dictionary.nominal.rows[side].valid[:, joint]
        torque = columns[used] @ trial.score.coefficients / dictionary.evidence.sigma[side][joint]
        found[side, joint] = float(np.var(torque)) if used.any() else 0.0
    return found


def share_at(trial: Trial, joint: int, dictionary: Dictionary) -> float:
    """Share of a trial's power in the rows of a joint."""
    found = powers(trial, dictionary)
    return sum(p for (_, at), p in found.items() if at == joint) / max(sum(found.values()), 1e-300)
