"""The lasting effects that healthy sets of sessions have in common: this arm's own, and no fault.

One set seldom shows a small effect clearly. So its evidence is the sum over all sets, and its size has to be the same
in each but for their own uncertainty: an effect of another size every day is no property of the arm. A cause is there
once in a joint, with the best shape beside the others. Columns of the speed are hardly independent, so a law of it is a
part of the drive's friction: no fit may hold a law larger than the whole against the other columns.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ident.diagnosis.causes.candidates import Candidate, Trial
from ident.diagnosis.causes.claims import Claim
from ident.diagnosis.causes.contest import Contest
from ident.diagnosis.causes.selection import Selection
from ident.diagnosis.gain.products import Floats
from ident.diagnosis.gain.rivals import likelihood
from ident.diagnosis.gain.size import Size
from ident.diagnosis.healthy.bench import DiagnosisBench, again_with
from ident.diagnosis.settings import DiagnosisSettings
from ident.effects import EFFECTS, ELASTICITY, PRESLIDING, Shape, entry_of

log = logging.getLogger(__name__)

# Searches, each with the noise that the one before left.
_SEARCHES = 2
# Shapes tried in all sets, those of the sets with most evidence.
_SHAPES = 2


@dataclass(eq=False)
class _Set:
    """A healthy set with what all sets were found to have in common."""

    bench: DiagnosisBench
    settings: DiagnosisSettings
    accepted: list[Trial] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.contest = Contest(self.bench.dictionary, self.settings)

    def take(self, candidate: Candidate, shape: Shape) -> Trial:
        """An effect of a given shape, whatever its size in this set."""
        dictionary = self.bench.dictionary
        rows = dictionary.rows(candidate, shape)
        return Trial(candidate, shape, dictionary.measure(candidate, rows), rows)

    def found(self) -> dict[tuple[str, int], Trial]:
        """The best shape of each candidate beside what was accepted."""
        self.contest.tolerated.beside(self.accepted)
        taken = {_kind(t.candidate, t.shape) for t in self.accepted}
        return {
            t.candidate.key: t
            for t in self.contest.simplest()
            if _kind(t.candidate, t.shape) not in taken and not t.passing
        }

    def trial(self, candidate: Candidate, shape: Shape) -> Trial | None:
        """A candidate of a given shape beside what was accepted."""
        return self.bench.dictionary.trial(candidate, shape)

    def quieter(self, causes: Sequence[str]) -> _Set:
        """The same with the noise that the accepted effects leave."""
        self.contest.tolerated.beside(self.accepted)
        claims = [Claim(trial, trial.score) for trial in self.accepted]
        bench = again_with(
            self.bench, Selection(claims, self.contest.tolerated.deviations), self.settings, causes
        )
        if bench is None:
            return self
        again = _Set(bench, self.settings)
        again.accepted = [again.take(trial.candidate, trial.shape) for trial in self.accepted]
        return again

    def parts(self, trials: Sequence[Trial]) -> list[bool]:
        """Whether each of some effects, fitted together, is part of its drive's friction where it is largest; True for
        those that are no law of the speed."""
        nominal, evidence = self.bench.nominal, self.bench.evidence
        with evidence.beside([*(trial.rows for trial in trials), *self.contest.tolerated.rows]):
            base, sizes = evidence.full.values[: evidence.base_count], evidence.coefficients()
        torques: dict[int, Floats] = {}
        for k, (trial, size) in enumerate(zip(trials, sizes, strict=False)):
            law, key = trial.candidate.effect.law, ("motor", trial.candidate.joint)
            if law is not None and law.variable == "qd" and key in trial.rows:
                torques[k] = trial.rows[key] @ size
        found = [True] * len(trials)
        for k, torque in torques.items():
            joint = trials[k].candidate.joint
            rows, names = nominal.rows["motor"], (f"Fcm{joint + 1}", f"Fvm{joint + 1}")
            drive = [place for place, name in enumerate(nominal.base.names) if name in names]
            at = int(np.argmax(np.abs(torque) * rows.valid[:, joint]))
            laws = sum(float(other[at]) for i, other in torques.items() if trials[i].candidate.joint == joint)
            whole = abs(float(rows.matrix[joint][at, drive] @ base[drive]) + laws)
            found[k] = abs(float(torque[at])) <= trials[k].candidate.effect.largest_share * whole
        return found


def character(benches: Sequence[DiagnosisBench], settings: DiagnosisSettings) -> tuple[dict[str, Any], ...]:
    """Entries of the lasting effects of a healthy arm: ripple, Stribeck friction, warmth, habits of the sensors.

    benches : of sets of sessions, each of one day. Stiffness and presliding are the nominal arm's own and not listed.
    """
    causes = [
        cause for cause, effect in EFFECTS.items() if not (effect.event or effect.channel or effect.counted)
    ]
    sets = [_Set(replace(bench, dictionary=bench.dictionary.of(causes)), settings) for bench in benches]
    chosen: list[tuple[Candidate, Shape]] = []
    for search in range(_SEARCHES):
        if search and chosen:
            sets = [one.quieter(causes) for one in sets]
            chosen = _reshaped(sets, chosen, settings)
        for _ in range(settings.rounds):
            more = _in_common(sets, settings)
            for trials in more:
                candidate, shape = next((t.candidate, t.shape) for t in trials if t is not None)
                log.info("in common: %s", candidate.key)
                chosen.append((candidate, shape))
                for one, trial in zip(sets, trials, strict=True):
                    one.accepted.append(one.take(candidate, shape) if trial is None else trial)
            if not more:
                break
    own = [c for c in chosen if c[0].effect not in (ELASTICITY, PRESLIDING)]
    return tuple(_entries(sets, own))


def _kind(candidate: Candidate, shape: Shape) -> tuple[Any, ...]:
    """What may be in the model once: a candidate, and a harmonic of its ripple."""
    continuous = candidate.effect.continuous(shape)
    return *candidate.key, *((name, value) for name, value in shape.items() if name not in continuous)


def _in_common(sets: Sequence[_Set], settings: DiagnosisSettings) -> list[list[Trial | None]]:
    """Further effects with enough evidence in all sets together, by set; the foremost of each joint."""
    found = [one.found() for one in sets]
    total: dict[tuple[str, int], float] = {}
    for trials in found:
        for key, trial in trials.items():
            total[key] = total.get(key, 0.0) + trial.score.gain
    joints, more = set[int](), list[list[Trial | None]]()
    for key in sorted(total, key=lambda key: -total[key]):
        if total[key] <= settings.least_gain:
            break
        if key[1] in joints:
            continue
        alike = _alike(sets, [trials.get(key) for trials in found], settings)
        if alike is not None:
            joints.add(key[1])
            more.append(alike)
    return more


def _alike(
    sets: Sequence[_Set],
    trials: Sequence[Trial | None],
    settings: DiagnosisSettings,
    without: int | None = None,
) -> list[Trial | None] | None:
    """An effect with one shape in all sets, None without enough evidence; None for a set that contradicts it.

    without : number of the accepted one that it replaces.
    """
    known = [(one, trial) for one, trial in zip(sets, trials, strict=True) if trial is not None]
    known = sorted(known, key=lambda pair: -pair[1].score.gain)[:_SHAPES]
    refined = (one.bench.dictionary.refine(trial).shape for one, trial in known)
    best: list[Trial | None] | None = None
    for shape in dict.fromkeys([*(trial.shape for _, trial in known), *refined]):
        tried = [
            trial if trial is not None and trial.shape == shape else one.trial(known[0][1].candidate, shape)
            for one, trial in zip(sets, trials, strict=True)
        ]
        if best is not None and _gain(tried) <= _gain(best):
            continue
        beside = [[t for k, t in enumerate(one.accepted) if k != without] for one in sets]
        parts = [
            one.parts([*rest, trial])[-1]
            for one, rest, trial in zip(sets, beside, tried, strict=True)
            if trial is not None
        ]
        if 2 * sum(parts) > len(parts):
            best = tried
    return best if best is not None and _carried(best, settings) else None


def _reshaped(
    sets: Sequence[_Set], chosen: Sequence[tuple[Candidate, Shape]], settings: DiagnosisSettings
) -> list[tuple[Candidate, Shape]]:
    """The effects in common, each with its best shape beside the others, without those that need no place there."""
    kept = list(chosen)
    for candidate, shape in chosen:
        if not candidate.effect.continuous(shape):
            continue
        place = kept.index((candidate, shape))
        for one in sets:
            one.contest.tolerated.beside([t for k, t in enumerate(one.accepted) if k != place])
        trials = _alike(sets, [one.trial(candidate, shape) for one in sets], settings, without=place)
        kept.pop(place)
        for one in sets:
            one.accepted.pop(place)
        if trials is None:
            continue
        shape = next(t.shape for t in trials if t is not None)
        kept.insert(place, (candidate, shape))
        for one, trial in zip(sets, trials, strict=True):
            one.accepted.insert(place, one.take(candidate, shape) if trial is None else trial)
    return kept


def _gain(trials: Sequence[Trial | None]) -> float:
    return sum(t.score.gain for t in trials if t is not None)


def _carried(trials: Sequence[Trial | None], settings: DiagnosisSettings) -> bool:
    """Whether the evidence of all sets together suffices, and most of them bear it out."""
    scores = [t.score for t in trials if t is not None]
    if 2 * sum(score.gain > 0.0 for score in scores) <= len(trials):
        return False
    effect = next(t.candidate.effect for t in trials if t is not None)
    size = Size.of(
        [s.coefficients for s in scores],
        [s.covariance for s in scores],
        effect.usual_change,
        blocks=sum(s.uncertainty[1] for s in scores),
    )
    visible = float(np.mean([score.inflation for score in scores]))
    return (
        _gain(trials) > settings.least_of_claim(effect.evidence_factor, len(size.mean))
        and visible > effect.evidence_factor * settings.least_inflation
        and size.p_value < settings.alpha
        and size.lasting
    )


def _entries(sets: Sequence[_Set], chosen: Sequence[tuple[Candidate, Shape]]) -> list[dict[str, Any]]:
    """Entries of effects with their sizes fitted together in each set, without those that do not last or that no drive
    has in that size."""
    chosen = list(chosen)
    table = [[one.take(*each) for each in chosen] for one in sets]
    while chosen:
        fits = [_fitted(one, trials) for one, trials in zip(sets, table, strict=True)]
        sizes = [
            Size.of([fit[k][0] for fit in fits], [fit[k][1] for fit in fits], candidate.effect.usual_change)
            for k, (candidate, _) in enumerate(chosen)
        ]
        agreed = [2 * sum(fit[k][2] for fit in fits) > len(fits) for k in range(len(chosen))]
        unsound = [
            k
            for k, ((candidate, shape), size) in enumerate(zip(chosen, sizes, strict=True))
            if not (size.lasting and agreed[k] and candidate.effect.plausible(size.mean, shape))
        ]
        if not unsound:
            break
        # Without the least certain one the others may be sound.
        least = min(unsound, key=lambda k: sizes[k].certainty)
        chosen.pop(least)
        for trials in table:
            trials.pop(least)
    found = []
    for k, (candidate, shape) in enumerate(chosen):
        each = [fit[k][0] for fit in fits]
        std = np.std(each, axis=0, ddof=1) if len(each) > 1 else np.zeros(len(sizes[k].mean))
        std = np.hypot(std, _of_shape(sets, table, k) * np.abs(sizes[k].mean))
        found.append(_entry(candidate, shape, sizes[k].mean, std))
        log.info("character: %s", candidate.key)
    return found


def _fitted(one: _Set, trials: Sequence[Trial]) -> list[tuple[Floats, Floats, bool]]:
    """Coefficients (k,) of effects fitted together, their covariance (k, k), and whether they are part of the
    friction, see `_Set.parts`."""
    evidence = one.bench.evidence
    evidence.replace([*(trial.rows for trial in trials), *one.contest.tolerated.rows])
    covariance, place, found = evidence.covariance(), evidence.base_count, []
    for value, part in zip(evidence.coefficients(), one.parts(trials), strict=False):
        here = slice(place, place + len(value))
        found.append((value, covariance[here, here], part))
        place = here.stop
    return found


def _of_shape(sets: Sequence[_Set], table: Sequence[Sequence[Trial]], k: int) -> float:
    """Standard deviation of the size of effect number k as a share of it, by the shapes of a law of the speed that
    explain the sets about as well.

    A law of the speed is known where the sets were slow. Where they were not its size follows from its shape, and a
    slower motion would take the error for a change.
    """
    candidate, shape = table[0][k].candidate, table[0][k].shape
    law = candidate.effect.law
    if law is None or law.variable != "qd":
        return 0.0
    gains, sizes = dict[Shape, float](), dict[Shape, Floats]()
    for one, trials in zip(sets, table, strict=True):
        one.contest.tolerated.beside([trial for i, trial in enumerate(trials) if i != k])
        for other in (shape, *candidate.effect.shapes(one.bench.dictionary.setting, candidate.joint)):
            trial = one.trial(candidate, other) if other.form is shape.form else None
            if trial is not None:
                gains[other] = gains.get(other, 0.0) + trial.score.gain
                sizes[other] = sizes.get(other, 0.0) + trial.score.coefficients / len(sets)
    if shape not in sizes:
        return 0.0
    size, best = sizes[shape], max(gains.values())
    weights = np.array([likelihood(gains[other], best) for other in sizes])
    apart = np.array([np.sum((values - size) ** 2) for values in sizes.values()])
    return float(np.sqrt(weights @ apart / weights.sum()) / np.linalg.norm(size))


def _entry(candidate: Candidate, shape: Shape, coefficients: Floats, std: Floats) -> dict[str, Any]:
    """An effect of a model."""
    effect = candidate.effect
    linear = {p.name: (c, s) for p, c, s in zip(effect.linear, coefficients, std, strict=False)}
    values = linear | {name: (value, 0.0) for name, value in shape.items()}
    return entry_of(effect, candidate.joints, values, shape.form_name)
