"""Selection of causes: greedy acceptance, reconsideration, look-alikes, remainders.

A round scores every candidate beside the base and the accepted causes, and accepts the best with enough evidence.
Then it reconsiders each earlier one: it may be unnecessary now, or another cause or joint may be better in its place.
Small deviations of the nominal arm (sub-millisecond delays, joint stiffness) are columns of the base within their
tolerance, so they neither hide nor mimic a cause.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from ident.diagnosis.causes.candidates import Dictionary, Trial
from ident.diagnosis.causes.claims import Claim, claim_of
from ident.diagnosis.causes.contest import Contest
from ident.diagnosis.causes.tolerances import Deviation, Kind
from ident.diagnosis.causes.usual_sizes import Healthy
from ident.diagnosis.gain.products import Floats, Rows
from ident.diagnosis.settings import DiagnosisSettings

log = logging.getLogger(__name__)

# Least gain of `best_candidate`.
_LEAST_GAIN = 10.0
# A change of a length over its standard deviation.
_CERTAIN = 3.0


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


def select(dictionary: Dictionary, settings: DiagnosisSettings, healthy: Healthy | None = None) -> Selection:
    """Accept causes one after the other as long as the evidence suffices."""
    contest = Contest(dictionary, settings, healthy)
    contest.tolerated.beside([])
    first: dict[tuple[str, int], float] = {}
    accepted: list[Trial] = []
    for _ in range(settings.rounds):
        found = contest.contenders(accepted)
        if not first:
            first = {t.candidate.key: max(t.score.gain, 0.0) for t in found}
            contest.null.meet(found)
        while contest.habit(found):
            found = contest.contenders(accepted)
        best = contest.next(accepted, [t for t in found if contest.enough.carried(t)])
        if best is None:
            break
        log.info("%s: gain %.0f", best.candidate.key, best.score.gain)
        accepted = contest.merged(contest.reconsider([*accepted, best]))
        if best.candidate.key not in [t.candidate.key for t in accepted]:
            break
    claims = [claim_of(contest, accepted, k) for k in range(len(accepted))]
    while doubtful := [
        k for k, c in enumerate(claims) if c.outdone or contest.leftover(c.trial, contest.others(accepted, k))
    ]:
        # A better explanation of the same rows lacks evidence itself, or the claim is the remainder of another.
        accepted.pop(min(doubtful, key=lambda k: claims[k].gain))
        claims = [claim_of(contest, accepted, k) for k in range(len(accepted))]
    contest.tolerated.beside(accepted)
    claims.sort(key=lambda c: -c.gain)
    return Selection(claims, contest.tolerated.deviations, first)


def gains(dictionary: Dictionary, settings: DiagnosisSettings) -> dict[tuple[str, int], float]:
    """Gain of each candidate before any acceptance, for the null of a healthy arm."""
    found = Contest(dictionary, settings).contenders([])
    return {t.candidate.key: max(t.score.gain, 0.0) for t in found}


def best_candidate(dictionary: Dictionary, settings: DiagnosisSettings) -> Selection | None:
    """The best candidate as if accepted, even without enough evidence; None if none explains anything.

    With noise known from the residual alone, a strong cause counts as noise until it is in the model. Its gain must
    be compared with its own residual.
    """
    contest = Contest(dictionary, settings)
    best = next(iter(contest.contenders([])), None)
    if best is None or best.score.gain < _LEAST_GAIN:
        return None
    return Selection([Claim(best, best.score)], contest.tolerated.deviations)


def longer_turns(dictionary: Dictionary, settings: DiagnosisSettings) -> Floats:
    """Logarithms (n,) of the factors on the drives' presliding lengths in a reference, beside the other tolerated
    deviations; 0 where it is no more than its own uncertainty."""
    contest = Contest(dictionary, settings)
    contest.tolerated.beside([])
    found = np.zeros(dictionary.nominal.arm.chain.n)
    for one in contest.tolerated.deviations:
        if one.tolerance.kind is Kind.LENGTH and abs(one.value) > _CERTAIN * one.std:
            found[one.tolerance.number] = one.value
    return found
