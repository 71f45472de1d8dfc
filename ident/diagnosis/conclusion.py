"""From claims to findings: parameters, evidence on held-out rows, doubts, the extended model, the notes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ident.diagnosis.bench import DiagnosisBench
from ident.diagnosis.candidates import Trial
from ident.diagnosis.evidence import Floats, Key, Rows
from ident.diagnosis.held_out import HeldOut, fall, held_out, interval, spread_out, worse_rows
from ident.diagnosis.intervals import estimated
from ident.diagnosis.model_form import companions, model_form_error
from ident.diagnosis.nominal import TRAVEL_RAD, Nominal
from ident.diagnosis.probes import Remainder, find_remainders
from ident.diagnosis.reference import DELAY_STD_S, Reference
from ident.diagnosis.result import Diagnosis, Evident, Finding, Nameless, RowStates, Unexplained, Value
from ident.diagnosis.selection import Claim
from ident.diagnosis.task import Baseline, State, Task
from ident.diagnosis.wear import is_level, wear
from ident.effects import EFFECTS, LOST_SAMPLES, NAMELESS, entry_of
from ident.model import DynamicModel
from ident.model.signals import SIGNALS, signals_entry
from ident.rows.data_quality import SampleLoss, sample_loss

# Largest unexplained part in the rows of a claim without a loss of confidence, over the claim's gain.
_DOUBT = 0.2
# Confidence in a claim supported by the rows fitted and not fully by the held-out ones, and its least gain over the
# usual one.
_OPEN, _TO_SPARE = 0.7, 2.0
# Lowest tolerated lower bound of the held-out gain, as a share of its upper bound; with hardly any excitation in the
# held-out sessions the lowest upper bound, as a share of the claim's gain.
_ALL_BUT = 0.05
# Largest share of a claim's gain replaceable by unnamed functions of other variables.
_ENCOMPASSED = 0.8
# Least fall of the error on held-out rows by a sure claim, as a share: less is felt by nobody.
_FELT = 0.05
# The same for a brief event in the rows of its session, and for a remainder without a name: power over the noise of
# 2 % of the error.
_FELT_POWER = 0.98**-2 - 1.0
# Least confidence of a finding.
_HARDLY = 0.1
# Least power of a cause in the held-out rows for a test there, over that in the rows fitted.
_EXCITED = 0.1


def conclude(task: Task, state: State) -> Diagnosis:
    """The diagnosis from the claims of a selection, the timing findings and the lost samples."""
    bench, nuisance, settings = state.bench, state.selection.nuisance_rows, task.settings
    evidence, nominal = bench.evidence, bench.nominal
    baseline = state.baseline if state.timing else None
    baseline = baseline or Baseline.of(bench, nuisance)
    kept = [pair for pair in _confirmed_findings(task, state) if not is_level(pair[0])]
    evidence.replace([*(c.trial.rows for c, _ in kept), *nuisance])
    remainders = find_remainders(bench.dictionary, evidence, settings, task.null)
    findings = _doubted(task, state, kept, remainders)
    if any(finding.confidence < _HARDLY for finding in findings):
        # A name hardly believed is no finding; what it explained is left to the remainders.
        kept = [one for one, f in zip(kept, findings, strict=True) if f.confidence >= _HARDLY]
        findings = [f for f in findings if f.confidence >= _HARDLY]
        evidence.replace([*(c.trial.rows for c, _ in kept), *nuisance])
        remainders = find_remainders(bench.dictionary, evidence, settings, task.null)
    worn = []
    if task.reference is not None:
        shown = held_out(evidence, [*(c.trial.rows for c, _ in kept), *nuisance])
        worn = wear(bench, task.reference, shown)
    members = [
        _Member((claim.trial.rows,), claim.gain, finding=finding)
        for (claim, _), finding in zip(kept, findings, strict=True)
        # A change between sessions has no value in a further one, and an event cannot be predicted.
        if finding.mode != "between" and (nominal.held_out or not claim.trial.candidate.effect.event)
    ]
    members += [
        _Member(tuple(dict.fromkeys([(r.side, r.joint - 1)], t.column) for t in r.terms), r.gain, remainder=r)
        for r in remainders
        if r.terms
    ]
    members, after = _extension(bench, baseline, members, nuisance, settings.seed)
    findings += [*state.timing, *worn]
    loss = sample_loss(list(task.sessions))
    if loss:
        findings.append(_loss_finding(loss[0]))
    findings.sort(key=lambda f: -f.gain)
    shipped = [m.finding for m in members if m.finding is not None]
    nameless = _nameless(bench, members, nuisance, after, settings.seed)
    before, after = baseline.held.where(after), after.where(baseline.held)
    extended_rms = after.rms()
    entries = [_entry(f) for f in findings if f in shipped or f in state.timing]
    base_model, extended, changes = _models(
        task, bench, baseline, (*entries, *(e for term in nameless for e in term.entries))
    )
    fitted = {(term.side, term.joint) for term in nameless}
    left = [
        (r.side, r.joint, r.depends_on)
        for r in remainders
        if (r.side, r.joint) not in fitted and r.inflation > _FELT_POWER
    ]
    replayed = list(task.test) or list(task.sessions)
    simulation = extended_simulation = None
    if task.simulate is not None:
        simulation = task.simulate(task.model or base_model, replayed)
        changed = extended.effects != base_model.effects
        extended_simulation = task.simulate(extended, replayed) if changed else simulation
    is_character = {id(f): task.reference is None and EFFECTS[f.cause].character for f in findings}
    return Diagnosis(
        train=tuple(r.name for r in nominal.recordings if not r.test),
        test=tuple(r.name for r in nominal.recordings if r.test),
        model_number=nominal.structure.model,
        findings=tuple(f for f in findings if not is_character[id(f)]),
        character=tuple(f for f in findings if is_character[id(f)]),
        nameless=nameless,
        extension=tuple(_title(entry) for entry in extended.effects[len(base_model.effects) :]),
        unexplained=tuple(
            Unexplained(
                side, j, variables, float(extended_rms[side][j - 1]), float(evidence.floor[side][j - 1])
            )
            for side, j, variables in (*_stuck(nominal), *left)
        ),
        noise_floor=evidence.floor,
        rms_base=before.rms(),
        rms_extended=extended_rms,
        base_model=base_model,
        extended_model=extended,
        changes=changes,
        scores=state.selection.scores,
        nuisance=state.selection.nuisance,
        simulation_base=simulation,
        simulation_extended=extended_simulation,
        notes=(*_notes(bench, task.reference), *_channel_notes(nominal, remainders), *state.notes),
        residuals={"base": before.residual, "extended": after.residual},
        states={side: _states(nominal, side, before.block[side]) for side in nominal.rows},
    )


# ---- the extension ----


@dataclass(frozen=True, eq=False)
class _Member:
    """A claim or a remainder of the extended model: its columns and gain."""

    rows: tuple[Rows, ...]
    gain: float
    finding: Finding | None = None
    remainder: Remainder | None = None


def _extension(
    bench: DiagnosisBench, baseline: Baseline, members: list[_Member], nuisance: Sequence[Rows], seed: int
) -> tuple[list[_Member], HeldOut]:
    """The members of the extension, and the held-out rows with them.

    A member acting on a row worse than the base model beyond chance goes, if the power of the error, over the base
    model's in each row, is less without it on average. A remainder has to lower the error of its own row beyond chance.
    The columns of the evidence are those of the result.
    """

    def with_members(chosen: Sequence[_Member]) -> HeldOut:
        return held_out(bench.evidence, [*(rows for m in chosen for rows in m.rows), *nuisance])

    while True:
        after = with_members(members)
        for member in sorted((m for m in members if m.remainder is not None), key=lambda m: m.gain):
            assert member.remainder is not None
            rest = [m for m in members if m is not member]
            key = (member.remainder.side, member.remainder.joint - 1)
            if interval(with_members(rest), after, [key], seed)[2] <= 0.0:
                members, after = rest, with_members(rest)
        worse = set(worse_rows(baseline.held.where(after), after.where(baseline.held), seed))
        if not worse or not members:
            return members, with_members(members)
        acting = [m for m in members if any(worse & set(rows) for rows in m.rows)] or members
        left = [[m for m in members if m is not out] for out in acting]
        errors = [_power_left(baseline.held, with_members(rest)) for rest in left]
        best = int(np.argmin(errors))
        if errors[best] > _power_left(baseline.held, after):
            return members, with_members(members)
        members = left[best]


def _power_left(before: HeldOut, after: HeldOut) -> float:
    """Power of the error after over that before, mean of all rows of a side and joint."""
    was, now = before.where(after).rms(), after.where(before).rms()
    share = np.concatenate([(now[side] / np.maximum(was[side], 1e-12)) ** 2 for side in was])
    return float(np.nanmean(share))


def _nameless(
    bench: DiagnosisBench, members: Sequence[_Member], nuisance: Sequence[Rows], after: HeldOut, seed: int
) -> tuple[Nameless, ...]:
    """The nameless terms of an extension, their functions scaled as in the common fit."""
    evidence, found = bench.evidence, []
    groups = iter(evidence.coefficients())
    scales = {id(member): np.concatenate([next(groups) for _ in member.rows]) for member in members}
    for member in members:
        remainder = member.remainder
        if remainder is None:
            continue
        others = [rows for m in members if m is not member for rows in m.rows]
        key = (remainder.side, remainder.joint - 1)
        without = held_out(evidence, [*others, *nuisance])
        before, rms, low, high = interval(without, after, [key], seed)
        entries = tuple(
            entry_of(
                NAMELESS[remainder.side],
                [remainder.joint],
                {
                    **{
                        f"value_{k + 1}": (c * v, abs(c) * s)
                        for k, (v, s) in enumerate(zip(term.values, term.std, strict=True))
                    },
                    "low": (term.low, 0.0),
                    "high": (term.high, 0.0),
                },
                term.form,
            )
            for c, term in zip(scales[id(member)], remainder.terms, strict=True)
        )
        found.append(
            Nameless(remainder.side, remainder.joint, remainder.depends_on, entries, before, rms, (low, high))
        )
    evidence.replace([*(rows for m in members for rows in m.rows), *nuisance])
    return tuple(found)


def _title(entry: Mapping[str, Any]) -> str:
    """An entry of the extended model in short: the cause and its joints."""
    joints = ", ".join(map(str, entry["joints"]))
    return f"{entry['cause']}({joints})" if joints else str(entry["cause"])


# ---- confirmation by held-out rows ----


def _confirmed_findings(task: Task, state: State) -> list[tuple[Claim, Finding]]:
    """The claims confirmed by held-out rows, with their findings."""
    bench, nuisance, seed = state.bench, state.selection.nuisance_rows, task.settings.seed
    rows_of = [c.trial.rows for c in state.selection.claims]
    after = held_out(bench.evidence, [*rows_of, *nuisance])
    kept = []
    for k, claim in enumerate(state.selection.claims):
        others = [*(r for i, r in enumerate(rows_of) if i != k), *nuisance]
        without = held_out(bench.evidence, others)
        finding = _finding(claim, bench, without, after, seed)
        weights = {(side, j): float(bench.evidence.sigma[side][j]) ** -2 for side, j in claim.trial.rows}
        most = _confirmed(claim, finding, bench, fall(without, after, weights, seed))
        if most > 0.0 and not _felt(claim, finding, bench, without, after, seed):
            most = min(most, _OPEN)
        if most > 0.0:
            kept.append((claim, _at_most(most, finding)))
    return kept


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


def _felt(
    claim: Claim, finding: Finding, bench: DiagnosisBench, without: HeldOut, after: HeldOut, seed: int
) -> bool:
    """Whether held-out rows show a claim plainly: a fall of the error by `_FELT` in the rows of its joints, in two
    blocks at least, with no other row worse beyond chance. Of changes between sessions and causes seen in the samples
    they need not. A brief event has to be felt in the rows of its own session."""
    effect = claim.trial.candidate.effect
    if effect.repeats:
        return bool(_power(claim, bench) > _FELT_POWER)
    if finding.mode == "between" or effect.seen_in_samples(claim.trial.shape):
        return True
    shown = finding.evidence
    if shown.test_rms_after > (1.0 - _FELT) * shown.test_rms_before:
        return False
    keys = list(claim.trial.rows)
    return spread_out(without, after, keys) and not worse_rows(without, after, seed)


def _confirmed(claim: Claim, finding: Finding, bench: DiagnosisBench, fallen: tuple[float, float]) -> float:
    """Largest confidence in a claim after the test on held-out rows: 1 confirmed, 0 refuted.

    fallen : interval of the fall of their chi-square by the claim; above zero it confirms the claim. A deviation of
    the healthy arm, or the error of a stronger cause's law, is significant in the rows fitted but predicts nothing.
    If the held-out sessions hardly excite the cause, they need only not contradict it. They say nothing about a
    change between sessions or a brief event, and a cause visible in the samples themselves needs no test.
    A cause with ample evidence in the rows fitted, or almost confirmed by the others, may be this one or another. So
    may a weak claim, reported only after a confirmation.
    """
    effect = claim.trial.candidate.effect
    if finding.mode == "between" or effect.repeats or effect.seen_in_samples(claim.trial.shape):
        return 1.0
    low, high = fallen
    if claim.weak:
        return _OPEN if low > 0.0 else 0.0
    hardly = _excitation(claim, bench) < _EXCITED
    if low > 0.0 or (hardly and high > 0.0):
        return 1.0
    least = effect.evidence_factor * bench.evidence.settings.least_gain
    shown = low + high > 0.0 and claim.gain > _TO_SPARE * least
    silent = hardly and high > -_ALL_BUT * claim.gain
    return _OPEN if shown or silent or low > -_ALL_BUT * high else 0.0


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


def _states(nominal: Nominal, side: str, block: Floats) -> RowStates:
    rows, motions = nominal.rows[side], nominal.motions
    signals = ([m.q for m in motions], [m.motor_speed for m in motions], [m.joint_torque for m in motions])
    return RowStates(rows.time, rows.session, block, *(nominal.reduce(side, parts) for parts in signals))


# ---- findings ----


def _finding(claim: Claim, bench: DiagnosisBench, without: HeldOut, after: HeldOut, seed: int) -> Finding:
    """The finding of a claim beside the columns of the evidence, with all other claims among them."""
    candidate, score, form = claim.trial.candidate, claim.score, claim.trial.shape.form
    keys = [key for key in claim.trial.rows if np.any(claim.trial.rows[key])]
    keys = sorted(keys, key=lambda key: -_relative(without, after, key))[: max(1, len(keys) // 7)]
    rms_before, rms_after, low, high = interval(without, after, keys, seed)
    cost = np.log(sum(float(m.sum()) for m in bench.evidence.mask.values()))
    delta_bic = float(-score.fitted + len(candidate.effect.parameters) * cost)
    return Finding(
        cause=candidate.cause,
        side=candidate.effect.side,
        joints=candidate.joints,
        parameters=_parameters(claim.trial, bench),
        evidence=Evident(delta_bic, score.p_value, rms_before, rms_after, (low, high)),
        confidence=claim.confidence,
        alternatives=tuple((c.cause, c.joints, float(-gain + cost)) for c, gain in claim.alternatives),
        tell_apart=candidate.effect.tell_apart.format(joint=candidate.joint + 1),
        gain=score.gain,
        mode=candidate.effect.mode(claim.trial.shape),
        form=None if form is None else str(form.value),
    )


def _relative(without: HeldOut, after: HeldOut, key: Key) -> float:
    side, joint = key
    a, b = without.residual[side][:, joint], after.residual[side][:, joint]
    power = np.nanmean(b**2) if np.isfinite(b).any() else 1.0
    return float((np.nanmean(a**2) - power) / power) if np.isfinite(a).any() else 0.0


def _parameters(trial: Trial, bench: DiagnosisBench) -> dict[str, Value]:
    """Values with standard deviations, see `intervals`.

    Friction near standstill is estimated beside all ways of reversing, beyond its law; the change of the values is
    part of the uncertainty.
    """
    effect, evidence = trial.candidate.effect, bench.evidence
    values, deviations = estimated(bench.dictionary, evidence, trial)
    columns = companions(bench.dictionary, trial) if effect.beside_companions else None
    if columns is not None:
        kept = list(evidence.extra)
        evidence.replace([*kept, columns])
        beside = bench.dictionary.trial(trial.candidate, trial.shape)
        if beside is not None:
            alone = values
            values, own = estimated(bench.dictionary, evidence, bench.dictionary.refine(beside))
            deviations = {name: float(np.hypot(own[name], values[name] - alone[name])) for name in own}
        evidence.replace(kept)
    return {
        p.name: Value(values[p.name], deviations[p.name], p.unit)
        for p in effect.parameters
        if p.name in values and p.name not in effect.hidden
    }


def timing_finding(task: Task, after: State, claim: Claim, rest: tuple[float, float]) -> Finding:
    """Finding of a late channel.

    after : with the shift made, and the baseline before it. rest : remaining delay and its standard deviation [s].
    """
    assert after.baseline is not None
    bench, selection, effect = after.bench, after.selection, claim.trial.candidate.effect
    side = effect.channel or ""
    arm, known = bench.nominal.arm, task.arm
    motor, joint = arm.motor_delay_s - known.motor_delay_s, arm.joint_delay_s - known.joint_delay_s
    # The delay of the healthy channel itself varies from day to day.
    days = (task.reference.delay_std_s if task.reference is not None else {}).get(side, DELAY_STD_S)
    std = float(np.hypot(rest[1], days))
    now = held_out(bench.evidence, [*(c.trial.rows for c in selection.claims), *selection.nuisance_rows])
    keys = [(side, j) for j in range(arm.chain.n)]
    rms_before, rms_after, low, high = interval(after.baseline.held, now, keys, task.settings.seed)
    return Finding(
        effect.cause,
        "timing",
        (),
        {"delay": Value((motor if side == "motor" else joint) + rest[0], std, "s")},
        Evident(-claim.score.fitted, claim.score.p_value, rms_before, rms_after, (low, high)),
        claim.confidence,
        tuple((c.cause, c.joints, -g) for c, g in claim.alternatives),
        effect.tell_apart,
        claim.gain,
    )


def _loss_finding(worst: SampleLoss) -> Finding:
    count = worst.samples + worst.lost
    std = float(np.sqrt(worst.share * (1.0 - worst.share) / count))
    return Finding(
        LOST_SAMPLES.cause,
        LOST_SAMPLES.side,
        (),
        {"share": Value(worst.share, std, "1")},
        Evident(-float(count) * worst.share, 1e-12, 0.0, 0.0, (0.0, 0.0)),
        0.99,
        (),
        LOST_SAMPLES.tell_apart,
        float(worst.amiss),
        mode=f"{worst.lost} lost, {worst.repeated} repeated and {worst.stale} stale of {count} {worst.channel} "
        f"samples in {worst.session}",
    )


# ---- doubts ----


def _doubted(
    task: Task, state: State, kept: Sequence[tuple[Claim, Finding]], remainders: tuple[Remainder, ...]
) -> list[Finding]:
    """The findings, with less confidence in a name with a large remainder in its rows, or replaceable by one."""
    bench, nuisance = state.bench, state.selection.nuisance_rows
    doubts = _beyond(task, bench, [claim for claim, _ in kept], nuisance, remainders)
    # No held-out session confirms a change between sessions, and a dependence on the motion is similar to one.
    unnamed = {(r.side, r.joint - 1) for r in remainders}
    findings = []
    for claim, finding in kept:
        others = [c.trial.rows for c, _ in kept if c is not claim]
        if _encompassed(claim, [*others, *nuisance], bench, doubts) > _ENCOMPASSED:
            finding = _at_most(_OPEN, finding)
        mine = set(claim.trial.rows)
        left = sum(r.gain for r in doubts if (r.side, r.joint - 1) in mine)
        if len(mine) > bench.nominal.arm.chain.n:
            left /= 2.0
        if left > _DOUBT * claim.gain:
            finding = _at_most(float(0.75 * claim.gain / (claim.gain + left)), finding)
        if finding.mode == "between" and unnamed & mine:
            finding = _at_most(_OPEN, finding)
        findings.append(finding)
    return findings


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
    return find_remainders(bench.dictionary, bench.evidence, task.settings, task.null)


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


def _at_most(confidence: float, finding: Finding) -> Finding:
    return replace(finding, confidence=min(finding.confidence, confidence))


# ---- models ----


def _models(
    task: Task, bench: DiagnosisBench, baseline: Baseline, effects: tuple[Mapping[str, Any], ...]
) -> tuple[DynamicModel, DynamicModel, dict[str, float]]:
    """Base model, extended model with the columns of the evidence, and the change of the base parameters in their
    standard deviations.
    """
    evidence, nominal = bench.evidence, bench.nominal
    p = evidence.base_count
    robot = task.sessions[0].metadata.get("robot", "") or "arm"
    provenance: dict[str, Any] = {
        "sessions": [r.name for r in nominal.recordings if not r.test],
        "estimator": "diagnosis",
        SIGNALS: signals_entry(task.settings.signals) | {"motor_delay_s": nominal.arm.motor_delay_s},
    }
    structure = replace(nominal.structure, coulomb=task.settings.law or nominal.structure.coulomb)
    base = DynamicModel(
        robot,
        structure,
        nominal.base.names,
        baseline.values,
        baseline.covariance,
        replace(nominal.base, structure=structure),
        provenance,
        nominal.arm.healthy,
    )
    values, covariance = evidence.full.values[:p].copy(), evidence.covariance()[:p, :p]
    extended = replace(base, values=values, covariance=covariance, effects=(*base.effects, *effects))
    assert extended.std is not None
    shift = (extended.values - base.values) / np.maximum(extended.std, 1e-300)
    order = np.argsort(-np.abs(shift))[:10]
    changes = {base.names[k]: float(shift[k]) for k in order if abs(shift[k]) > 2.0} if effects else {}
    return base, extended, changes


def _entry(finding: Finding) -> dict[str, Any]:
    content = finding.to_dict()
    names = ("cause", "side", "joints", "form", "parameters")
    return {name: content[name] for name in names if name in content}


# ---- notes ----


def _stuck(nominal: Nominal) -> list[tuple[str, int, tuple[str, ...]]]:
    """Side, joint (from 1) and variable of motor torques with stuck values."""
    joints = {one.joint for r in nominal.recordings if not r.test for one in r.stuck}
    return [("motor", joint + 1, (f"load{joint + 1}",)) for joint in sorted(joints)]


def _channel_notes(nominal: Nominal, remainders: Sequence[Remainder]) -> list[str]:
    names = nominal.arm.chain.joint_names
    lines = [
        f"the {r.side} torque of {names[r.joint - 1]} swings at {r.line_hz:.3g} Hz independently of the motion; look "
        "for a vibration of the arm or hum in the channel at this frequency"
        for r in remainders
        if r.line_hz > 0.0
    ]
    stuck = [
        f"{r.name}: the motor torque of {names[one.joint]} reads exactly {one.value:.4g} Nm in {one.count} of "
        f"{one.samples} samples in motion; torques near this value are misreported, and these samples are left out"
        for r in nominal.recordings
        for one in r.stuck
    ]
    return lines + stuck


def _notes(bench: DiagnosisBench, reference: Reference | None) -> list[str]:
    notes, nominal, evidence = [], bench.nominal, bench.evidence
    if "motor" not in nominal.rows:
        notes.append(
            "no motor torque: causes on the motor side are invisible, and a sensor error differs from a torque of "
            "the arm by its shape alone"
        )
    if reference is None:
        notes.append(
            "no reference of the healthy arm: a constant change absorbed by base parameters (payload, torque "
            "constant, wear, offsets) is invisible, and what such drives have when healthy is told as character of the "
            "arm, not as a finding; run `lwr-run commission` with the healthy arm"
        )
    elif evidence.prior is None:
        notes.append(
            "the reference shares no base parameter with these sessions: parameters are not compared"
        )
    for side, band in nominal.band_hz.items():
        if band is not None:
            notes.append(
                f"the {side} torque was low-passed before recording, with nothing left above {2.0 * band:.2g} Hz: "
                f"rows are compared below {band:.2g} Hz; delays, reversals and ripple per motor turn are invisible"
            )
    still = np.flatnonzero(~nominal.moving)
    if len(still):
        names = ", ".join(nominal.arm.chain.joint_names[j] for j in still)
        notes.append(f"{names}: no motion of {TRAVEL_RAD} rad or more, so no diagnosis there")
    if not bench.repeatable:
        notes.append(
            "no motion repeats within a session: the residual of the model is the only measure of noise, so only "
            "causes of a large part of it are named"
        )
    if evidence.prior is not None and not evidence.compared:
        notes.append(
            "hardly excited parameters are held near the inertia of the URDF, within 20 %: a wrong URDF would show "
            "as a cause"
        )
    return notes
