"""Which causes the data carry: greedy acceptance, second thoughts, look-alikes, and what they leave.

A round scores every candidate against the base with what was accepted before, takes the best if the data
carry it, and asks each earlier one again: whether it is still needed, and whether another cause or joint now
does better in its place. Small deviations of the nominal arm (sub-millisecond delays, joint stiffness) are
columns of the base as long as they stay within their tolerance, so they neither hide nor feign a cause.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from ident.diagnosis.candidates import Candidate, Dictionary, Trial
from ident.diagnosis.evidence import Evidence, Key, Rows, Score
from ident.diagnosis.model_form import model_form_error
from ident.diagnosis.settings import DiagnosisSettings
from ident.effects import DELAYS, ELASTICITY, Shape
from ident.estimators.estimate import normal_tail

__all__ = ["Claim", "Null", "Selection", "best_candidate", "confidence", "gains", "margin", "select"]

log = logging.getLogger(__name__)

Null = Mapping[tuple[str, int], float]
"""Gain of each candidate that a healthy set stays below."""


@dataclass(frozen=True, eq=False)
class Claim:
    """An accepted trial: its score beside all other claims, and the candidates that do almost as well.

    outdone : a rival that the data do not carry does better on the same rows. weak : too little for a claim by
    itself, and a finding only where held-out sessions bear it out.
    """

    trial: Trial
    score: Score
    alternatives: tuple[tuple[Candidate, float], ...] = ()
    confidence: float = 1.0
    outdone: bool = False
    weak: bool = False

    @property
    def gain(self) -> float:
        """Fall of the held-back chi-square when it is added to all others."""
        return self.score.gain


@dataclass(eq=False)
class Selection:
    """Result of `select`. `nuisance` : tolerated deviations by name, value and standard deviation."""

    claims: list[Claim]
    nuisance: dict[str, tuple[float, float]]
    scores: dict[tuple[str, int], float]
    nuisance_rows: list[Rows] = field(default_factory=list)


def select(
    dictionary: Dictionary,
    evidence: Evidence,
    settings: DiagnosisSettings,
    null: Null | None = None,
) -> Selection:
    """Accept causes one after the other until the data carry no more; where they carry none, the one that comes
    nearest, if there are held-out sessions that it can be held against and a healthy arm told what is usual.
    """
    state = _State(dictionary, evidence, settings, null or {})
    state.tolerate([])
    first: dict[tuple[str, int], float] = {}
    accepted: list[Trial] = []
    for _ in range(settings.rounds):
        found = state.contenders(accepted)
        first = first or {t.candidate.key: max(t.score.gain, 0.0) for t in found}
        best = state.next(accepted, [t for t in found if state.carried(t)])
        if best is None:
            break
        log.info("%s: gain %.0f", best.candidate.key, best.score.gain)
        accepted = state.reconsider([*accepted, best])
        if best.candidate.key not in [t.candidate.key for t in accepted]:
            break
    if not accepted and null and dictionary.nominal.held_out:
        accepted = state.weak_claims()
    claims = [state.claim(accepted, k) for k in range(len(accepted))]
    while doubtful := [
        k for k, c in enumerate(claims) if c.outdone or state.leftover(c.trial, _others(claims, k))
    ]:
        # What explains the same rows better is itself not carried by the data, or it is what another leaves.
        accepted.pop(min(doubtful, key=lambda k: claims[k].gain))
        claims = [state.claim(accepted, k) for k in range(len(accepted))]
    state.tolerate(accepted)
    claims.sort(key=lambda c: -c.gain)
    return Selection(claims, state.nuisance, first, state.nuisance_rows)


def gains(
    dictionary: Dictionary, evidence: Evidence, settings: DiagnosisSettings
) -> dict[tuple[str, int], float]:
    """Gain of each candidate where nothing is accepted yet: what a healthy arm adds to the null."""
    found = _State(dictionary, evidence, settings, {}).contenders([])
    return {t.candidate.key: max(t.score.gain, 0.0) for t in found}


def best_candidate(
    dictionary: Dictionary, evidence: Evidence, settings: DiagnosisSettings
) -> Selection | None:
    """The best candidate as if it were accepted, whether the data carry it or not; None where none explains
    anything.

    Where noise is known from the residual alone, a strong cause counts as noise until it is in the model: how
    much it explains must be held against what it leaves.
    """
    state = _State(dictionary, evidence, settings, {})
    best = next(iter(state.contenders([])), None)
    if best is None or best.score.gain < _LEAST_GAIN:
        return None
    return Selection([Claim(best, best.score)], state.nuisance, {}, state.nuisance_rows)


def _others(claims: Sequence[Claim], k: int) -> list[Trial]:
    """Trials of all claims but one."""
    return [claim.trial for i, claim in enumerate(claims) if i != k]


def _same_moment(trial: Trial, other: Trial) -> bool:
    """Whether two trials are one cause at one time: what a push leaves while it lasts is its own course."""
    one, two = trial.shape, other.shape
    if trial.candidate.key != other.candidate.key or not {"duration", "session"} <= set(one):
        return False
    apart = abs(one["time"] - two["time"]) - 0.5 * (one["duration"] + two["duration"])
    return one["session"] == two["session"] and apart < _PAUSE_S


def _lasting(trial: Trial) -> bool:
    """Whether a trial says something about other motions: not what lasts a moment or is another in each session."""
    effect = trial.candidate.effect
    return not effect.event and effect.side != "timing" and effect.mode(trial.shape) != "between"


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
    """Gain by which candidates are ordered: of two that explain the same, the one with less freedom."""
    return trial.score.gain - 2.0 * trial.shape.freedom


@dataclass(eq=False)
class _State:
    dictionary: Dictionary
    evidence: Evidence
    settings: DiagnosisSettings
    null: Null
    nuisance: dict[str, tuple[float, float]] = field(default_factory=dict)
    nuisance_rows: list[Rows] = field(default_factory=list)
    weak: bool = False
    _tolerances: list[tuple[str, Rows, float, float]] | None = None

    # ---- tolerated deviations ----

    def tolerances(self) -> list[tuple[str, Rows, float, float]]:
        """Name, rows, unit of the coefficient and tolerance of each deviation that is no finding."""
        if self._tolerances is not None:
            return self._tolerances
        nominal, found = self.dictionary.nominal, []
        limit = self.settings.delay_tolerance_s
        for side in nominal.rows:
            candidate = Candidate(DELAYS[side], -1)
            rows = self.dictionary.rows(candidate, Shape(delay=1e-3))
            if side == "motor":
                found.append(("motor delay", rows, 1e-3, limit))
                continue
            found += self._joint_delays(rows, limit)
        if "motor" in nominal.rows and np.any(nominal.arm.compliance > 0.0):
            for joint in range(nominal.arm.chain.n):
                candidate = Candidate(ELASTICITY, joint)
                rows = self.dictionary.rows(candidate, ELASTICITY.at_encoder(nominal.arm.encoder))
                if rows:
                    # Behind published motors the links' ringing tells a stiffness that a healthy arm told once.
                    told = nominal.arm.encoder == "motor" and nominal.arm.encoder_known
                    share = self.settings.compliance_tolerance * (_TOLD_COMPLIANCE if told else 1.0)
                    size = share * float(nominal.arm.compliance[joint])
                    found.append((f"compliance {joint + 1}", rows, 1.0, size))
        self._tolerances = found
        return found

    def _joint_delays(self, rows: Rows, limit: float) -> list[tuple[str, Rows, float, float]]:
        """Tolerated delays of the torque sensors: one that all share, and what each differs from it by.

        Each sensor has electronics of its own, so each may be late by itself. A delay of the whole channel is the
        mean of them, weighted by what the rows say of each: seven sensors say it much better than one, and where
        a healthy arm told what it was, a smaller one is a finding.
        """
        evidence, keys = self.evidence, sorted(rows)
        told = self.dictionary.nominal.arm.encoder_known
        weight = {
            key: float(np.sum(part**2)) / float(evidence.sigma[key[0]][key[1]] ** 2)
            for key, part in evidence.padded(rows).items()
        }
        best = max(keys, key=lambda key: weight[key])
        found = [("joint delay", rows, 1e-3, (_TOLD_DELAY if told else 2.0) * limit)]
        for key in keys:
            if key != best and weight[best] > 0.0:
                apart = {key: rows[key], best: -weight[key] / weight[best] * rows[best]}
                found.append((f"delay of joint {key[1] + 1} apart", apart, 1e-3, 2.0 * limit))
        return found

    def tolerate(self, accepted: Sequence[Trial]) -> None:
        """Base with the accepted columns and with the deviations that stay within their tolerance."""
        entries = self.tolerances()
        fixed = [t.rows for t in accepted]
        self.evidence.replace([*fixed, *(rows for _, rows, _, _ in entries)])
        place = self.evidence.base_count + sum(_width(rows) for rows in fixed)
        values = self.evidence.full.values[place:]
        inside = [
            entry for entry, value in zip(entries, values, strict=True) if abs(value) * entry[2] <= entry[3]
        ]
        if len(inside) < len(entries):
            self.evidence.replace([*fixed, *(rows for _, rows, _, _ in inside)])
        values = self.evidence.full.values[place:]
        # A motion that says nothing about a deviation leaves its variance open.
        std = np.sqrt(np.maximum(np.diag(self.evidence.full.inverse), 0.0))[place:]
        self.nuisance = {
            name: (float(v) * unit, float(s) * unit)
            for (name, _, unit, _), v, s in zip(inside, values, std, strict=True)
        }
        self.nuisance_rows = [rows for _, rows, _, _ in inside]

    # ---- rounds ----

    def contenders(self, accepted: Sequence[Trial]) -> list[Trial]:
        """Best shapes of all candidates beside the accepted ones, best first."""
        self.tolerate(accepted)
        taken = {t.candidate.key for t in accepted if not t.candidate.effect.repeats}
        found = [t for t in self.simplest() if t.candidate.key not in taken]
        found = [t for t in found if not any(_same_moment(t, other) for other in accepted)]
        return sorted(found, key=_gain, reverse=True)

    def simplest(self) -> list[Trial]:
        """Best shapes of all candidates, without those that a special case of them explains as well."""
        found = list(self.dictionary.trials())
        gain = {t.candidate.key: _gain(t) for t in found}

        def needed(trial: Trial) -> bool:
            cases = [(cause, trial.candidate.joint) for cause in trial.candidate.effect.contains]
            return all(_gain(trial) - gain[case] > margin(gain[case]) for case in cases if case in gain)

        return [t for t in found if needed(t)]

    def next(self, accepted: Sequence[Trial], carried: list[Trial]) -> Trial | None:
        """The foremost of the trials that is not just what the accepted ones leave, None where there is none."""
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

    def weak_claims(self) -> list[Trial]:
        """The foremost of what takes less evidence because other motions can bear it out; none where there is none."""
        self.weak = True
        found = [t for t in self.contenders([]) if _lasting(t) and self.carried(t)]
        best = self.next([], found)
        return [] if best is None else [best]

    def refined(self, trial: Trial) -> Trial:
        """The trial with its shape at the best fit, where that is still carried: a fit that held-back parts
        contradict is none."""
        found = self.dictionary.refine(trial, self.choices(trial))
        return found if self.carried(found) else trial

    def foremost(self, accepted: Sequence[Trial], contest: Sequence[Trial]) -> Trial:
        """The best of several trials; of those that come close, the one that leaves least together with the
        deviations that are tolerated beside it.
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
        """Number of shapes that an event was chosen from."""
        return self.evidence.blocks if trial.candidate.effect.event else 1

    def carried(self, trial: Trial, score: Score | None = None) -> bool:
        """Whether the data carry the trial: gain, significance, and size."""
        score = trial.score if score is None else score
        settings = self.settings
        strict = trial.candidate.effect.evidence_factor * (settings.weak if self.weak else 1.0)
        least = strict * (settings.least_gain + 6.0 * (len(score.coefficients) - 1))
        known = self.null.get(trial.candidate.key, 0.0)
        least = max(least, known)
        if trial.candidate.effect.seen_in_samples(trial.shape):
            return score.gain > least
        if score.gain <= least or score.p_value >= settings.alpha_rare:
            return False
        # What lasts a moment is large then, and little of the whole session.
        size = np.inf if trial.candidate.effect.event else score.inflation * self.concentration(trial, score)
        needed = strict * settings.least_inflation
        # What acts in a few blocks only cannot be significant by blocks, however large; predicting parts that were
        # held back then tells.
        rare = score.gain > _PLAIN * least and _PLAIN * needed < size < np.inf
        eased = rare or self.weak
        return size > needed and score.p_value < (settings.alpha_rare if eased else settings.alpha)

    def concentration(self, trial: Trial, score: Score) -> float:
        """Rows that a trial acts on over the rows that it matters in: all over the effective number of them,
        `(sum p)^2 / sum p^2` of the power p of its torque in the rows of each joint and side, in units of the noise.

        A small turn of one joint's zero acts on every row, and shows in two or three.
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
        """Share of a trial's power that is in the rows of a joint."""
        powers = self.powers(trial, trial.score)
        return sum(p for (_, at), p in powers.items() if at == joint) / max(sum(powers.values()), 1e-300)

    def beside(self, accepted: Sequence[Trial], without: int) -> list[Trial]:
        """All but one of the accepted, in the base."""
        rest = [t for k, t in enumerate(accepted) if k != without]
        self.tolerate(rest)
        return rest

    def reconsider(self, accepted: list[Trial]) -> list[Trial]:
        """Each of the accepted beside the others: drop it, refine it, or let another take its place."""
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
                rivals = [t for t in self.simplest() if t.candidate.key not in taken]
                rivals.sort(key=_gain, reverse=True)
                contest = [t for t in rivals[:3] if again is None or _gain(t) > 0.9 * _gain(again)]
                contest = [self.dictionary.refine(t, self.choices(t)) for t in contest]
                if again is not None:
                    contest.append(again)
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

    # ---- claims ----

    def leftover(self, trial: Trial, others: Sequence[Trial]) -> bool:
        """Whether a trial beside others is no more carried once the stronger ones in its rows may be of any form, or
        is so small beside one of them, in the rows of its joint, that the least error of its law explains it; or
        answers to one.
        """
        wide = []
        if any(_follows(trial, other) for other in others):
            return True
        for other in others:
            stronger = other.score.gain > trial.score.gain or _is_its_mean(trial, other)
            if stronger and set(trial.rows) & set(other.rows):
                small = (
                    trial.score.gain < _LAW_ERROR * other.score.gain and not other.candidate.effect.whole_arm
                )
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

    def claim(self, accepted: Sequence[Trial], k: int) -> Claim:
        """The accepted trial number k with its look-alikes, given all others."""
        here = accepted[k]
        rest = self.beside(accepted, k)
        taken = {t.candidate.key for t in rest if not t.candidate.effect.repeats}
        again = self.dictionary.trial(here.candidate, here.shape, self.choices(here)) or here
        rivals = sorted(
            (t for t in self.simplest() if t.candidate.key not in {*taken, here.candidate.key}),
            key=_gain,
            reverse=True,
        )
        # What acts on other rows, or where this one hardly does, explains something else.
        mine = self.powers(again, again.score)
        least = _SAME_ROWS * sum(mine.values())
        rivals = [t for t in rivals if sum(mine.get(key, 0.0) for key in t.rows) > least]
        close = [t for t in rivals[:6] if _gain(t) > 0.6 * _gain(again)]
        close = [self.dictionary.refine(t, self.choices(t)) for t in close]
        scores = sorted(((t.candidate, _gain(t)) for t in close), key=lambda pair: -pair[1])
        sure = confidence(_gain(again), [g for _, g in scores])
        alike = tuple((c, g) for c, g in scores if _gain(again) - g < margin(_gain(again)))
        if here.candidate.effect.side == "sensor" and "motor" not in self.dictionary.nominal.rows:
            # Without a motor torque nothing but the shape tells a sensor's error from a torque of the arm.
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
        # Of moments many were tried, and one of them always suits somewhat.
        lasting = (t for t in close if not t.candidate.effect.event)
        outdone = any(_gain(t) > _gain(again) and not self.carried(t) for t in lasting)
        return Claim(again, again.score, alike, sure, outdone, self.weak)

    def same_torque(self, candidate: Candidate) -> Candidate | None:
        """The candidate of the same torque in these sessions, by the physics of the effect."""
        cause = candidate.effect.same_as(self.dictionary.setting, candidate.joint)
        return next((c for c in self.dictionary.candidates if c.key == (cause, candidate.joint)), None)


# How many times the usual evidence is plain to see.
_PLAIN = 10.0
# Of so many that come first the shapes are refined before one is taken.
_CONTEST = 4
# Share of a claim's power in the rows of a rival from which on both speak of the same.
_SAME_ROWS = 0.2
# Share of what a law explains that it may leave, and share of a trial's power in the rows of that law's joint from
# which on the trial may be just that.
_LAW_ERROR, _MOSTLY = 0.1, 0.8
# Least time between two pushes that are told from one [s].
_PAUSE_S = 0.2
# Gain from which on it is worth seeing what a candidate leaves.
_LEAST_GAIN = 10.0
# Share of the tolerance for a whole channel's delay that is left where a healthy arm told what it is.
_TOLD_DELAY = 0.4
# The same of a stiffness behind published motors.
_TOLD_COMPLIANCE = 0.4
# Confidence in a sensor's error where only the joint torque was recorded.
_SHAPE_ALONE = 0.7
# Confidence in one of two causes that these motions show alike.
_EITHER = 0.5


def margin(gain: float) -> float:
    """Difference of gains within which two causes are not told apart."""
    return 12.0 + 0.1 * gain


def confidence(gain: float, rivals: Sequence[float]) -> float:
    """Probability that the best is the right one, among itself, its rivals and chance.

    Gains are differences of chi-square, and count as such up to the misfit that any form of an effect has,
    taken as 3 % of the gain.
    """
    scale = 2.0 * (1.0 + 0.03 * gain)
    others = sum(float(np.exp(-max(gain - g, 0.0) / scale)) for g in rivals)
    chance = float(2.0 * normal_tail(np.sqrt(max(gain, 0.0)))) * 500.0
    return 1.0 / (1.0 + others + chance)


def _width(rows: Rows) -> int:
    return next(iter(rows.values())).shape[1]
