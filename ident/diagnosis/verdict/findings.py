"""Findings from claims: parameters with intervals, and evidence on held-out rows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ident.diagnosis.causes.candidates import Trial
from ident.diagnosis.causes.claims import Claim
from ident.diagnosis.causes.intervals import estimated
from ident.diagnosis.causes.model_form import companions
from ident.diagnosis.causes.tolerances import usual_change
from ident.diagnosis.gain.held_out import HeldOut, interval
from ident.diagnosis.gain.products import Floats, Key
from ident.diagnosis.healthy.bench import DiagnosisBench
from ident.diagnosis.healthy.reference import DELAY_STD_S
from ident.diagnosis.outcome.result import Finding, FindingEvidence, Value
from ident.diagnosis.rows.recording import SessionRecord, sensor_limits
from ident.diagnosis.verdict.task import State, Task
from ident.effects import EFFECTS, LOST_SAMPLES, SENSOR_SATURATION
from ident.rows.data_quality import SampleLoss

# Standard deviations of a size from zero, 95 %.
_TOLD = 2.0
# Confidence in what is counted in the samples: no model has a part in it, only the reading of the channel.
_COUNTED = 0.99


def finding_of(claim: Claim, bench: DiagnosisBench, without: HeldOut, after: HeldOut, seed: int) -> Finding:
    """The finding of a claim beside the columns of the evidence, with all other claims among them."""
    candidate, score = claim.trial.candidate, claim.score
    keys = [key for key in claim.trial.rows if np.any(claim.trial.rows[key])]
    keys = sorted(keys, key=lambda key: -_relative(without, after, key))[: max(1, len(keys) // 7)]
    rms_before, rms_after, low, high = interval(without, after, keys, seed)
    cost = np.log(sum(float(m.sum()) for m in bench.evidence.mask.values()))
    delta_bic = float(-score.fitted + len(candidate.effect.parameters) * cost)
    return Finding(
        candidate.cause,
        candidate.effect.side,
        candidate.joints,
        parameters=_parameters(claim.trial, bench),
        evidence=FindingEvidence(
            delta_bic,
            score.p_value,
            rms_before,
            rms_after,
            (low, high),
            tuple((side, joint + 1) for side, joint in keys),
        ),
        confidence=claim.confidence,
        alternatives=tuple((c.cause, c.joints, float(-gain + cost)) for c, gain in claim.alternatives),
        tell_apart=candidate.effect.tell_apart.format(joint=candidate.joint + 1),
        gain=score.gain,
        mode=candidate.effect.mode(claim.trial.shape),
        form=claim.trial.shape.form_name,
    )


def _relative(without: HeldOut, after: HeldOut, key: Key) -> float:
    side, joint = key
    a, b = without.residual[side][:, joint], after.residual[side][:, joint]
    power = np.nanmean(b**2) if np.isfinite(b).any() else 1.0
    return float((np.nanmean(a**2) - power) / power) if np.isfinite(a).any() else 0.0


def _parameters(trial: Trial, bench: DiagnosisBench) -> dict[str, Value]:
    """Values with standard deviations, see `intervals`.

    Friction near standstill is estimated beside all ways of reversing, beyond its law; the change of the values is
    part of the uncertainty. So is the usual change of a scale from the day of a reference.
    """
    effect, evidence = trial.candidate.effect, bench.evidence
    values, deviations = estimated(bench.dictionary, evidence, trial)
    columns = companions(bench.dictionary, trial) if effect.beside_companions else None
    if columns is not None:
        with evidence.beside([*evidence.extra, columns]):
            beside = bench.dictionary.trial(trial.candidate, trial.shape)
            if beside is not None:
                alone = values
                values, own = estimated(bench.dictionary, evidence, bench.dictionary.refine(beside))
                deviations = {name: float(np.hypot(own[name], values[name] - alone[name])) for name in own}
    change = usual_change(effect, bench.nominal.arm) if evidence.compared else 0.0
    if change:
        # The scale of a healthy arm differs from that of its reference.
        scale = effect.linear[0].name
        deviations[scale] = float(np.hypot(deviations[scale], change))
    slides = not effect.whole_arm and bool(bench.nominal.arm.chain.prismatic[trial.candidate.joint])
    units = effect.units(trial.shape.form, prismatic=slides)
    return {
        p.name: Value(values[p.name], deviations[p.name], units[p.name])
        for p in effect.parameters
        if p.name in values and p.name not in effect.hidden
    }


def timing_finding(
    task: Task, after: State, claim: Claim, rest: tuple[float, float], before: HeldOut, now: HeldOut
) -> Finding:
    """Finding of a late channel.

    after : with the shift made. rest : remaining delay and its standard deviation [s]. before, now : without the shift
    and with it.
    """
    bench, effect = after.bench, claim.trial.candidate.effect
    side = effect.channel or ""
    arm, known = bench.nominal.arm, task.arm
    motor, joint = arm.motor_delay_s - known.motor_delay_s, arm.joint_delay_s - known.joint_delay_s
    # The delay of the healthy channel itself varies from day to day.
    days = (task.reference.delay_std_s if task.reference is not None else {}).get(side, DELAY_STD_S)
    std = float(np.hypot(rest[1], days))
    keys = [(side, j) for j in range(arm.chain.n)]
    rows = tuple((side, j + 1) for side, j in keys)
    rms_before, rms_after, low, high = interval(before, now, keys, task.settings.seed)
    return Finding(
        effect.cause,
        "timing",
        (),
        parameters={"delay": Value((motor if side == "motor" else joint) + rest[0], std, "s")},
        evidence=FindingEvidence(
            -claim.score.fitted, claim.score.p_value, rms_before, rms_after, (low, high), rows
        ),
        confidence=claim.confidence,
        alternatives=tuple((c.cause, c.joints, -g) for c, g in claim.alternatives),
        tell_apart=effect.tell_apart,
        gain=claim.gain,
    )


def sizeless(finding: Finding) -> bool:
    """Whether no parameter that its torque is proportional to is told from zero: its torque is there beyond chance, but
    a time constant or a shape trades with its size, or its parts cancel. That is no change of an arm.

    Look-alikes have a size between them.
    """
    if finding.alternatives:
        return False
    linear = EFFECTS[finding.cause].linear
    sizes = [finding.parameters[p.name] for p in linear if p.name in finding.parameters]
    return bool(sizes) and not any(abs(one.value) > _TOLD * one.std for one in sizes)


def in_order(findings: Sequence[Finding], floor: Mapping[str, Floats]) -> list[Finding]:
    """The findings by the power that each removes in its rows, in units of their noise, equal ones as given; those
    without an error measured in their rows before the first with a smaller gain. floor : noise (n,) [Nm] by side.
    """
    powers = [(finding, _removed(finding.evidence, floor)) for finding in findings]
    measured = [(finding, power) for finding, power in powers if power is not None]
    ordered = [finding for finding, _ in sorted(measured, key=lambda pair: -pair[1])]
    others = [finding for finding, power in powers if power is None]
    for finding in sorted(others, key=lambda one: -one.gain):
        places = (place for place, one in enumerate(ordered) if one.gain < finding.gain)
        ordered.insert(next(places, len(ordered)), finding)
    return ordered


def _removed(shown: FindingEvidence, floor: Mapping[str, Floats]) -> float | None:
    """Power that a finding removes over that of the noise, sum over its rows; None without an error measured."""
    if not shown.rows or not shown.test_rms_before > 0.0:
        return None
    noise = float(np.mean([floor[side][joint - 1] ** 2 for side, joint in shown.rows]))
    return len(shown.rows) * (shown.test_rms_before**2 - shown.test_rms_after**2) / max(noise, 1e-300)


def loss_finding(worst: SampleLoss) -> Finding:
    """Finding of lost, repeated or stale samples, counted in the channel with most of them."""
    count = worst.samples + worst.lost
    std = float(np.sqrt(worst.share * (1.0 - worst.share) / count))
    return Finding(
        LOST_SAMPLES.cause,
        LOST_SAMPLES.side,
        (),
        parameters={"share": Value(worst.share, std, "1")},
        evidence=FindingEvidence.counted(-float(count) * worst.share),
        confidence=_COUNTED,
        tell_apart=LOST_SAMPLES.tell_apart,
        gain=float(worst.amiss),
        detail=f"{worst.lost} lost, {worst.repeated} repeated and {worst.stale} stale of {count} {worst.channel} "
        f"samples in {worst.session}",
    )


def limit_findings(records: Sequence[SessionRecord], found: Sequence[Finding]) -> list[Finding]:
    """Findings of sensors that stop at a limit in the samples of any session, but for those `found`: too few samples
    for a gain, or none in the sessions fitted."""
    limits = sensor_limits(records, len(records[0].joint_names))
    known = {f.joints for f in found if f.cause == SENSOR_SATURATION.cause}
    told = []
    for joint in np.flatnonzero(np.isfinite(limits)).tolist():
        limit = float(limits[joint])
        shape = SENSOR_SATURATION.seen_at(limit)
        if (joint + 1,) in known:
            continue
        std = SENSOR_SATURATION.law_std({"limit": limit}, shape.form)["limit"]
        told.append(
            Finding(
                SENSOR_SATURATION.cause,
                SENSOR_SATURATION.side,
                (joint + 1,),
                parameters={"limit": Value(limit, std, "Nm")},
                evidence=FindingEvidence.counted(0.0),
                confidence=_COUNTED,
                tell_apart=SENSOR_SATURATION.tell_apart.format(joint=joint + 1),
                gain=0.0,
                form=shape.form_name,
            )
        )
    return told
