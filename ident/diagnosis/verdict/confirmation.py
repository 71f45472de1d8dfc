"""Held-out rows and remainders as tests of claims, and the confidence that is left."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ident.diagnosis.causes.claims import Claim
from ident.diagnosis.causes.model_form import model_form_error
from ident.diagnosis.causes.probes import Remainder, find_remainders
from ident.diagnosis.gain.held_out import HeldOut, fall, held_out, spread_out, worse_rows
from ident.diagnosis.gain.products import Rows
from ident.diagnosis.healthy.bench import DiagnosisBench
from ident.diagnosis.healthy.reference import USUAL_DAYS
from ident.diagnosis.outcome.result import Finding
from ident.diagnosis.verdict.agreement import in_one_joint, on_both_sides, uneven
from ident.diagnosis.verdict.confidence import Grounds, probability
from ident.diagnosis.verdict.findings import finding_of, timing_finding
from ident.diagnosis.verdict.task import State, Task
from ident.estimators.estimate import fisher_tail

# Its least gain over the usual one.
_TO_SPARE = 2.0
# Lowest tolerated lower bound of the held-out gain, as a share of its upper bound; with hardly any excitation in the
# held-out sessions the lowest upper bound, as a share of the claim's gain.
_ALL_BUT = 0.05
# Least fall of the error on held-out rows by a sure claim, as a share: less is felt by nobody.
_FELT = 0.05
# The same for a brief event in the rows of its session, and for a remainder without a name: power over the noise of
# 2 % of the error.
FELT_POWER = 0.98**-2 - 1.0
# Largest share of a sure claim's gain replaceable by unnamed functions of other variables.
_REPLACEABLE = 0.8
# Largest gain of another function of the variable beside a law that is exact, as a share of its own. One bent cause is
# ten times as likely as a scale and a second cause with this variable on the same torque; a bend this small is as rare.
_BENT = 0.05
# The same beside any other law: a wave of the angle is no spring, though a cubic one takes most of it. Hoses and
# friction of other forms than ours left 0.01 at most, other causes told by the name of a law 0.4 and more.
_OTHER = 0.25
# Standard deviations by which the delay in slow rows contradicts that in the others.
_CONTRADICTED = 3.0
# Least power of a cause in the held-out rows for a test there, over that in the rows fitted.
_EXCITED = 0.1


@dataclass(frozen=True, eq=False)
class Confirmed:
    """A claim not refuted by held-out rows."""

    claim: Claim
    finding: Finding
    grounds: Grounds


def confirmed(task: Task, state: State) -> tuple[list[Confirmed], list[Finding]]:
    """The claims of a selection not refuted by held-out rows or by the other side of their drive, and findings of the
    others, of confidence zero.

    A deviation of the healthy arm, or the error of a stronger cause's law, is significant in the rows fitted but
    predicts nothing.
    """
    bench, nuisance, seed = state.bench, state.selection.nuisance_rows, task.settings.seed
    claims = state.selection.claims
    rows_of = [c.trial.rows for c in claims]
    after = held_out(bench.evidence, [*rows_of, *nuisance])
    elsewhere = [on_both_sides(bench.dictionary, claim) for claim in claims]
    at_odds = [uneven(bench.dictionary, c) or in_one_joint(bench.dictionary, c) for c in claims]
    kept, refuted = list[Confirmed](), list[Finding]()
    for k, claim in enumerate(claims):
        without = held_out(bench.evidence, [*(r for i, r in enumerate(rows_of) if i != k), *nuisance])
        finding = finding_of(claim, bench, without, after, seed)
        weights = {(side, j): float(bench.evidence.sigma[side][j]) ** -2 for side, j in claim.trial.rows}
        fallen = fall(without, after, weights, seed)
        hardly = _excitation(claim, bench) < _EXCITED
        if elsewhere[k] or _refuted(claim, finding, bench, fallen, hardly):
            refuted.append(replace(finding, confidence=0.0))
            continue
        untested = _untested(claim) or hardly
        grounds = _grounds(task, claim, claims, finding, bench, without, after, fallen, untested)
        plain = not at_odds[k] and _plain(claim, finding, bench, grounds, fallen)
        kept.append(Confirmed(claim, finding, replace(grounds, held=float(not plain))))
    return kept, refuted


def doubted(
    task: Task, state: State, kept: Sequence[Confirmed], remainders: tuple[Remainder, ...]
) -> list[Finding]:
    """The findings with their confidence, beside the remainders in their rows."""
    bench, nuisance = state.bench, state.selection.nuisance_rows
    doubts = _beyond(task, bench, [one.claim for one in kept], nuisance, remainders)
    unnamed = {(r.side, r.joint - 1) for r in remainders}
    findings = []
    for one in kept:
        claim, mine = one.claim, set(one.claim.trial.rows)
        others = [c.claim.trial.rows for c in kept if c is not one]
        left = sum(r.gain for r in doubts if (r.side, r.joint - 1) in mine)
        if len(mine) > bench.nominal.arm.chain.n:
            left /= 2.0
        replaceable = _encompassed(claim, [*others, *nuisance], bench, doubts)
        # No held-out session confirms a change between sessions, and a dependence on the motion is similar to one.
        like = claim.trial.passing and bool(unnamed & mine)
        strange = not _familiar(claim, bench)
        open_ = like or strange or replaceable > _REPLACEABLE or _bent(claim, remainders)
        open_ = open_ or _one_way(claim, [c.claim for c in kept])
        held = max(one.grounds.held, float(open_))
        grounds = replace(one.grounds, rest=left / claim.gain, replaceable=replaceable, held=held)
        confidence = min(claim.confidence, probability(grounds))
        findings.append(replace(one.finding, confidence=confidence, grounds=grounds.to_dict()))
    return findings


def _familiar(claim: Claim, bench: DiagnosisBench) -> bool:
    """Whether arms are known with the torque of a claim."""
    trial, setting = claim.trial, bench.dictionary.setting
    joint = max(trial.candidate.joint, 0)
    return trial.candidate.effect.familiar(trial.shape, claim.score.coefficients, setting, joint)


def _one_way(claim: Claim, claims: Sequence[Claim]) -> bool:
    """Whether a claim may be half of a stronger one of its joint and variable, one of them with the sign of the
    direction and the other without: friction in one direction alone is the sum of both."""
    candidate, law = claim.trial.candidate, claim.trial.candidate.effect.law

    def is_other_half(one: Claim) -> bool:
        other = one.trial.candidate
        if other.joint != candidate.joint or other.effect.law is None or law is None:
            return False
        halves = other.effect.law.variable == law.variable and other.effect.law.signed != law.signed
        return halves and bool(set(claim.trial.rows) & set(one.trial.rows))

    return any(one.gain > claim.gain and is_other_half(one) for one in claims)


def _bent(claim: Claim, remainders: Sequence[Remainder]) -> bool:
    """Whether another function of its variable is left in the rows of a claim, more than its law may be wrong by."""
    law = claim.trial.candidate.effect.law
    if law is None:
        return False
    variable = f"{law.variable}{claim.trial.candidate.joint + 1}"
    left = [
        r.gain
        for r in remainders
        if (r.side, r.joint - 1) in claim.trial.rows
        and any(term.form.split(" ")[0] == variable for term in r.terms)
    ]
    return sum(left) > (_BENT if law.exact else _OTHER) * claim.gain


def contradicted(finding: Finding) -> Finding:
    """The finding with the confidence left where its torque raises the torque error of held-out sessions."""
    grounds = {**finding.grounds, "worse": 1.0, "held": 1.0}
    confidence = min(finding.confidence, probability(Grounds(**grounds)))
    return replace(finding, confidence=confidence, grounds=grounds)


def confirmed_delay(
    task: Task, after: State, claim: Claim, rest: tuple[float, float], slow: tuple[float, float]
) -> Finding:
    """Finding of a late channel, see `timing_finding`, its p-value against the healthy delays of other days.

    Their standard deviation comes from few days, so the probability is that of Student's distribution. slow : the delay
    in slow rows and its standard deviation [s]. Springs that the model lacks turn the phase of fast motion alone: where
    slow rows contradict the others, no row tells which is right, and the difference is part of the uncertainty.
    """
    assert after.baseline is not None
    bench, selection = after.bench, after.selection
    before = after.baseline.held
    now = held_out(bench.evidence, [*(c.trial.rows for c in selection.claims), *selection.nuisance_rows])
    finding = timing_finding(task, after, claim, rest, before, now)
    delay, sets = finding.parameters["delay"], 1 if task.reference is None else max(task.reference.sets, 1)
    p_value = fisher_tail((delay.value / delay.std) ** 2, 1, USUAL_DAYS + sets - 1)
    apart = slow[0] - delay.value
    if abs(apart) > _CONTRADICTED * np.hypot(slow[1], rest[1]):
        delay = replace(delay, std=float(np.hypot(delay.std, apart)))
    finding = replace(
        finding, parameters={"delay": delay}, evidence=replace(finding.evidence, p_value=p_value)
    )
    low, high = finding.evidence.gain_interval_95
    grounds = _grounds(task, claim, selection.claims, finding, bench, before, now, (low, high), False)
    grounds = replace(grounds, held=float(not _seen(low, grounds)))
    confidence = min(claim.confidence, probability(grounds))
    return replace(finding, confidence=confidence, grounds=grounds.to_dict())


def _untested(claim: Claim) -> bool:
    """Whether held-out sessions say nothing: of a change between sessions, a brief event, or what samples show."""
    trial, effect = claim.trial, claim.trial.candidate.effect
    return trial.passing or effect.repeats or effect.seen_in_samples(trial.shape)


def _refuted(
    claim: Claim, finding: Finding, bench: DiagnosisBench, fallen: tuple[float, float], hardly: bool
) -> bool:
    """Whether the held-out rows contradict a claim.

    fallen : interval of the fall of their chi-square by it; above zero it confirms the claim. hardly : the held-out
    sessions hardly excite the cause, so they need only not contradict it. A cause with ample evidence in the rows
    fitted, or almost confirmed by the others, may be this one or another, if what it takes off their error is felt.
    """
    low, high = fallen
    if _untested(claim) or low > 0.0:
        return False
    if hardly and high > -_ALL_BUT * claim.gain:
        return False
    least = claim.trial.candidate.effect.evidence_factor * bench.evidence.settings.least_gain
    likely = low + high > 0.0 and claim.gain > _TO_SPARE * least
    return not (likely or low > -_ALL_BUT * high) or (not hardly and _share(finding) < _FELT)


def _share(finding: Finding) -> float:
    """Share of the held-out error of its rows that a finding takes away."""
    return 1.0 - finding.evidence.test_rms_after / max(finding.evidence.test_rms_before, 1e-12)


def _plain(
    claim: Claim, finding: Finding, bench: DiagnosisBench, grounds: Grounds, fallen: tuple[float, float]
) -> bool:
    """Whether held-out rows show a claim plainly: a fall of the error by `_FELT` in the rows of its joints, in two
    blocks at least, with no other row worse beyond chance. Of changes between sessions and causes seen in the samples
    they need not. A brief event has to be felt in the rows of its own session. A gain that healthy sets reached is no
    plain one.
    """
    if claim.changed_alone:
        return False
    if claim.trial.candidate.effect.repeats:
        return _power(claim, bench) > FELT_POWER
    if _untested(claim):
        return True
    return _seen(fallen[0], grounds)


def _seen(low: float, grounds: Grounds) -> bool:
    """Whether the gain on held-out rows, at least `low`, is certain, felt, spread over blocks, and free of harm."""
    return low > 0.0 and grounds.felt >= _FELT and not grounds.one_block and not grounds.worse


def _grounds(
    task: Task,
    claim: Claim,
    claims: Sequence[Claim],
    finding: Finding,
    bench: DiagnosisBench,
    without: HeldOut,
    after: HeldOut,
    fallen: tuple[float, float],
    untested: bool,
) -> Grounds:
    """The grounds from the rows fitted and, unless untested, held out. claims : of the selection."""
    effect, shown, (low, high) = claim.trial.candidate.effect, finding.evidence, fallen
    least = effect.evidence_factor * bench.evidence.settings.least_gain
    sure = min(max(claim.confidence, 1e-6), 1.0 - 1e-6)
    # What the samples themselves show needs no significance by blocks.
    p_value = 0.0 if effect.seen_in_samples(claim.trial.shape) else shown.p_value
    acting = {key for key, columns in claim.trial.rows.items() if np.any(columns)}
    usual = None if task.reference is None else task.reference.left
    worse = not untested and bool(worse_rows(without, after, task.settings.seed, acting, usual))
    return Grounds(
        gain=math.log(max(claim.gain / least, 1e-3)),
        significance=-math.log10(max(p_value, 1e-300)),
        rivals=math.log(sure / (1.0 - sure)),
        held_out=0.0 if untested else (low + high) / max(high - low, 1e-12),
        untested=float(untested),
        felt=0.0 if untested else _share(finding),
        one_block=float(not untested and not spread_out(without, after, list(claim.trial.rows))),
        worse=float(worse),
        habitual=float(effect.character),
        alone=float(not bench.dictionary.setting.compared),
        company=float(sum(other.gain > claim.gain for other in claims)),
    )


def _power(claim: Claim, bench: DiagnosisBench) -> float:
    """Power of a claim's torque over the noise, in the rows of the side and joint with most of it."""
    found = [0.0]
    for (side, joint), columns in claim.trial.rows.items():
        rows = bench.nominal.rows[side]
        keep = rows.valid[:, joint] & ~rows.test
        torque = columns[keep] @ claim.score.coefficients
        active = np.isin(rows.session[keep], rows.session[keep][torque != 0.0])
        if active.any():
            found.append(float(np.mean(torque[active] ** 2)) / float(bench.evidence.sigma[side][joint]) ** 2)
    return max(found)


def _excitation(claim: Claim, bench: DiagnosisBench) -> float:
    """Power of the claim's torque in the held-out rows over that in the rows fitted, 1 without held-out sessions."""
    power, counts = np.zeros(2), np.zeros(2)
    for (side, joint), columns in claim.trial.rows.items():
        rows = bench.nominal.rows[side]
        torque = columns @ claim.score.coefficients
        weight = 1.0 / bench.evidence.sigma[side][joint] ** 2
        for k, chosen in enumerate((~rows.test, rows.test)):
            keep = chosen & rows.valid[:, joint]
            if keep.any():
                power[k] += weight * float(np.sum((torque[keep] - torque[keep].mean()) ** 2))
            counts[k] += float(keep.sum())
    if not any(rows.test.any() for rows in bench.nominal.rows.values()) or power[0] <= 0.0:
        return 1.0
    return float(power[1] / max(counts[1], 1.0) / (power[0] / max(counts[0], 1.0)))


def _beyond(
    task: Task,
    bench: DiagnosisBench,
    claims: Sequence[Claim],
    nuisance: Sequence[Rows],
    remainders: tuple[Remainder, ...],
) -> tuple[Remainder, ...]:
    """Remainders beside the claims and the errors of their laws.

    A hose unlike a plain spring leaves a large function of the joint's angle on both sides: evidence of a coarse law,
    not of a wrong name.
    """
    errors = (model_form_error(bench.dictionary, c.trial) for c in claims)
    wide = [rows for rows in errors if rows is not None]
    if not remainders or not wide:
        return remainders
    bench.evidence.replace([*(c.trial.rows for c in claims), *nuisance, *wide])
    return find_remainders(bench.dictionary, task.settings, task.limits)


def _encompassed(
    claim: Claim, others: Sequence[Rows], bench: DiagnosisBench, remainders: Sequence[Remainder]
) -> float:
    """Share of a claim's gain lost with all remainders in the base, beside the columns of the others.

    Friction as a function of another joint's angle differs between sessions, like a warmer drive. Its remainder then
    explains the same as that claim, and the claim is unnecessary.
    """
    if not remainders:
        return 0.0
    bench.evidence.replace([*others, *(rows for r in remainders for rows in r.rows)])
    again = bench.dictionary.trial(claim.trial.candidate, claim.trial.shape)
    return 1.0 if again is None else 1.0 - max(again.score.gain, 0.0) / claim.gain
