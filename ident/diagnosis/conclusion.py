"""From claims to findings: parameters, evidence on held-out rows, doubts, the extended model, the notes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ident.diagnosis.bench import Bench
from ident.diagnosis.candidates import Trial
from ident.diagnosis.data_quality import SampleLoss
from ident.diagnosis.evidence import Floats, Key, Rows
from ident.diagnosis.held_out import HeldOut, fall, held_out, interval
from ident.diagnosis.intervals import estimated
from ident.diagnosis.model_form import companions, model_form_error
from ident.diagnosis.nominal import TRAVEL_RAD, Arm, Nominal
from ident.diagnosis.probes import Remainder, find_remainders
from ident.diagnosis.reference import DELAY_STD_S, Reference
from ident.diagnosis.result import (
    Diagnosis,
    Evident,
    Finding,
    RowStates,
    SimulationError,
    Unexplained,
    Value,
)
from ident.diagnosis.selection import Claim, Selection
from ident.diagnosis.settings import DiagnosisSettings
from ident.effects import LOST_SAMPLES
from ident.model import DynamicModel

if TYPE_CHECKING:
    from lwr_driver.session import Session

__all__ = ["Baseline", "Simulate", "conclude", "timing_finding"]

Simulate = Callable[[DynamicModel, "Sequence[Session]"], SimulationError | None]
"""Replays sessions with a model and says how far off it is; what the runner gives."""

_DOUBT = 0.2
# Confidence in what the rows fitted show and others bear out on the whole only, and gain over the least one from
# which on that is said at all.
_OPEN, _TO_SPARE = 0.7, 2.0
# How far below nothing the interval of what a claim takes off the held-out chi-square may begin, over its end, where
# it all but excludes nothing; or end, over the claim's gain, where held-out sessions that hardly excite the cause say
# nothing.
_ALL_BUT = 0.05
# Share of a claim's gain that nameless functions of other variables may take over.
_ENCOMPASSED = 0.8
# Power of a cause in the held-out rows, over that in the rows fitted, from which on these must show it.
_EXCITED = 0.1


@dataclass(frozen=True, eq=False)
class Baseline:
    """The base model alone: its residuals on held-out rows, its parameters (p,) and their covariance."""

    held: HeldOut
    values: Floats
    covariance: Floats

    @classmethod
    def of(cls, bench: Bench, tolerated: Sequence[Rows]) -> Baseline:
        """Fitted on a bench, beside deviations that are no finding."""
        evidence = bench.evidence
        held, p = held_out(evidence, tolerated), evidence.base_count
        return cls(held, evidence.full.values[:p].copy(), evidence.covariance()[:p, :p])


def conclude(
    bench: Bench,
    selection: Selection,
    timing: list[Finding],
    loss: tuple[SampleLoss, ...],
    settings: DiagnosisSettings,
    reference: Reference | None,
    model: DynamicModel | None,
    simulate: Simulate | None,
    sessions: Sequence[Session],
    test: Sequence[Session],
    baseline: Baseline | None = None,
) -> Diagnosis:
    """The diagnosis from the claims of a selection, the timing findings and the lost samples.

    baseline : before channels were put in time; None where none was late
    """
    evidence, nominal = bench.evidence, bench.nominal
    nuisance = selection.nuisance_rows
    baseline = baseline or Baseline.of(bench, nuisance)
    rows_of = [c.trial.rows for c in selection.claims]
    after = held_out(evidence, [*rows_of, *nuisance])
    kept: list[tuple[Claim, Finding]] = []
    for k, claim in enumerate(selection.claims):
        others = [*(r for i, r in enumerate(rows_of) if i != k), *nuisance]
        without = held_out(evidence, others)
        evidence.replace(others)
        finding = _finding(claim, bench, without, after, settings)
        most = _confirmed(claim, finding, bench, fall(without, after, _weights(claim, bench), settings.seed))
        if most > 0.0:
            kept.append((claim, _at_most(most, finding)))
    claims = [claim for claim, _ in kept]
    evidence.replace([*(c.trial.rows for c in claims), *nuisance])
    after = held_out(evidence, [*(c.trial.rows for c in claims), *nuisance])
    remainders = find_remainders(bench.dictionary, evidence, settings)
    doubts = _beyond(bench, claims, nuisance, remainders, settings)
    findings = [
        _doubted(
            claim, finding, doubts, nominal.arm.chain.n, _encompassed(claim, claims, bench, nuisance, doubts)
        )
        for claim, finding in kept
    ]
    # No held-out session bears out what was another between the sessions, and what differs between motions is easily
    # taken for such a change.
    unnamed = {(r.side, r.joint - 1) for r in remainders}
    findings = [
        _at_most(_OPEN, finding) if finding.mode == "between" and unnamed & set(claim.trial.rows) else finding
        for finding, (claim, _) in zip(findings, kept, strict=True)
    ]
    evidence.replace([*(c.trial.rows for c in claims), *nuisance])
    findings += timing
    if loss:
        findings.append(_loss_finding(loss))
    findings.sort(key=lambda f: -f.gain)
    before, after = baseline.held.where(after), after.where(baseline.held)
    extended_rms, base_rms = after.rms(), before.rms()
    base_model, extended, changes = _models(bench, baseline, claims, nuisance, findings, sessions)
    nameless = [*_stuck(nominal), *((r.side, r.joint, r.depends_on) for r in remainders)]
    unexplained = tuple(
        Unexplained(
            side,
            joint,
            depends_on,
            float(extended_rms[side][joint - 1]),
            float(evidence.floor[side][joint - 1]),
        )
        for side, joint, depends_on in nameless
    )
    replayed = list(test) or list(sessions)
    simulation = extended_simulation = None
    if simulate is not None:
        simulation = simulate(model or base_model, replayed)
        extended_simulation = simulate(extended, replayed) if findings else simulation
    return Diagnosis(
        train=tuple(r.name for r in nominal.recordings if not r.test),
        test=tuple(r.name for r in nominal.recordings if r.test),
        model_number=nominal.structure.model,
        findings=tuple(findings),
        unexplained=unexplained,
        noise_floor=evidence.floor,
        rms_base=base_rms,
        rms_extended=extended_rms,
        base_model=base_model,
        extended_model=extended,
        changes=changes,
        scores=selection.scores,
        nuisance=selection.nuisance,
        simulation_base=simulation,
        simulation_extended=extended_simulation,
        notes=(*_notes(bench, reference), *_lines(nominal, remainders), *_stuck_notes(nominal)),
        residuals={"base": before.residual, "extended": after.residual},
        states={side: _states(nominal, side, before.block[side]) for side in nominal.rows},
    )


def _weights(claim: Claim, bench: Bench) -> dict[Key, float]:
    """Weight of a row's square [1/Nm^2] for the joints and sides that a claim acts on."""
    return {(side, j): float(bench.evidence.sigma[side][j]) ** -2 for side, j in claim.trial.rows}


def _confirmed(claim: Claim, finding: Finding, bench: Bench, fallen: tuple[float, float]) -> float:
    """Largest confidence that motions which were not fitted leave a claim: 1 where they bear it out, the interval of
    what it takes off their chi-square excluding nothing; 0 where they do not.

    What the healthy arm is a little like, and what a stronger cause of another form than its law leaves behind,
    is significant in the rows fitted but makes no prediction. Where the held-out sessions hardly excite the cause,
    they need only not speak against it; of what was another in other sessions or lasted a moment they say nothing, and
    what the samples themselves show needs no other.
    A cause that the rows fitted show with room to spare, or that the others all but bear out for sure, may be it or
    another. So may one that the rows fitted show weakly; that is said only where the others do bear it out.
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


def _excitation(claim: Claim, bench: Bench) -> float:
    """Power of the claim's torque in the held-out rows over that in the rows fitted, 1 without held-out sessions."""
    power, counts = np.zeros(2), np.zeros(2)
    for (side, joint), columns in claim.trial.rows.items():
        rows = bench.nominal.rows[side]
        torque = columns @ claim.score.coefficients
        weight = 1.0 / bench.evidence.sigma[side][joint] ** 2
        for k, chosen in enumerate((~rows.test, rows.test)):
            keep = chosen & rows.valid[:, joint]
            power[k] += (
                weight * float(np.sum((torque[keep] - torque[keep].mean()) ** 2)) if keep.any() else 0.0
            )
            counts[k] += float(keep.sum())
    if not any(rows.test.any() for rows in bench.nominal.rows.values()) or power[0] <= 0.0:
        return 1.0
    return float(power[1] / max(counts[1], 1.0) / (power[0] / max(counts[0], 1.0)))


def _states(nominal: Nominal, side: str, block: Floats) -> RowStates:
    """Where the arm was in the rows of a side."""
    rows, motions = nominal.rows[side], nominal.motions
    return RowStates(
        rows.time,
        rows.session,
        block,
        nominal.reduce(side, [m.q for m in motions]),
        nominal.reduce(side, [m.motor_speed for m in motions]),
        nominal.reduce(side, [m.joint_torque for m in motions]),
    )


def _finding(
    claim: Claim, bench: Bench, without: HeldOut, after: HeldOut, settings: DiagnosisSettings
) -> Finding:
    """The finding of a claim, all others being in the base."""
    candidate, score = claim.trial.candidate, claim.score
    keys = [key for key in claim.trial.rows if np.any(claim.trial.rows[key])]
    keys = sorted(keys, key=lambda key: -_relative(without, after, key))[: max(1, len(keys) // 7)]
    rms_before, rms_after, low, high = interval(without, after, keys, settings.seed)
    count = sum(float(m.sum()) for m in bench.evidence.mask.values())
    parameters = len(candidate.effect.parameters)
    return Finding(
        cause=candidate.cause,
        side=candidate.effect.side,
        joints=candidate.joints,
        parameters=_parameters(claim.trial, bench),
        evidence=Evident(
            float(-score.fitted + parameters * np.log(count)),
            score.p_value,
            rms_before,
            rms_after,
            (low, high),
        ),
        confidence=claim.confidence,
        alternatives=tuple(
            (c.cause, c.joints, float(-gain + np.log(count))) for c, gain in claim.alternatives
        ),
        tell_apart=candidate.effect.tell_apart.format(joint=candidate.joint + 1),
        gain=score.gain,
        mode=candidate.effect.mode(claim.trial.shape),
        form=None if claim.trial.shape.form is None else str(claim.trial.shape.form.value),
    )


def _relative(without: HeldOut, after: HeldOut, key: tuple[str, int]) -> float:
    side, joint = key
    a, b = without.residual[side][:, joint], after.residual[side][:, joint]
    power = np.nanmean(b**2) if np.isfinite(b).any() else 1.0
    return float((np.nanmean(a**2) - power) / power) if np.isfinite(a).any() else 0.0


def _parameters(trial: Trial, bench: Bench) -> dict[str, Value]:
    """Values with standard deviations, see `intervals`.

    Of friction near standstill, those beside any way in which it may turn after a reversal, which no law of it
    says; what that changes is part of the uncertainty.
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


def _beyond(
    bench: Bench,
    claims: Sequence[Claim],
    nuisance: Sequence[Rows],
    remainders: tuple[Remainder, ...],
    settings: DiagnosisSettings,
) -> tuple[Remainder, ...]:
    """What is left beside the claims if each cause may also be of another form than its law.

    A hose that is no plain spring leaves much, all of it a function of the joint's angle on both sides: that says
    the law is coarse, not that the name is wrong.
    """
    wide = [
        rows for rows in (model_form_error(bench.dictionary, c.trial) for c in claims) if rows is not None
    ]
    if not remainders or not wide:
        return remainders
    fixed = [*(c.trial.rows for c in claims), *nuisance]
    bench.evidence.replace([*fixed, *wide])
    found = find_remainders(bench.dictionary, bench.evidence, settings)
    bench.evidence.replace(fixed)
    return found


def _encompassed(
    claim: Claim,
    claims: Sequence[Claim],
    bench: Bench,
    nuisance: Sequence[Rows],
    remainders: Sequence[Remainder],
) -> float:
    """Share of a claim's gain that is gone once all that has no name is in the base.

    Friction that follows another joint's angle is another in every session, as if the drive had been warmer; what
    is left beside that claim explains all that the claim does, and the claim is not needed with it.
    """
    if not remainders:
        return 0.0
    others = [c.trial.rows for c in claims if c is not claim]
    bench.evidence.replace([*others, *nuisance, *(rows for r in remainders for rows in r.rows)])
    again = bench.dictionary.trial(claim.trial.candidate, claim.trial.shape)
    return 1.0 if again is None else 1.0 - max(again.score.gain, 0.0) / claim.gain


def _at_most(confidence: float, finding: Finding) -> Finding:
    """The finding with no more than that confidence."""
    return replace(finding, confidence=min(finding.confidence, confidence))


def _doubted(
    claim: Claim, finding: Finding, remainders: Sequence[Remainder], joints: int, encompassed: float
) -> Finding:
    """Less confidence in a name that leaves much in the rows that it explains, or that what it leaves explains."""
    if encompassed > _ENCOMPASSED:
        finding = _at_most(_OPEN, finding)
    mine = set(claim.trial.rows)
    left = sum(r.gain for r in remainders if (r.side, r.joint - 1) in mine)
    if len(mine) > joints:
        left /= 2.0
    if left > _DOUBT * claim.gain:
        return _at_most(float(0.75 * claim.gain / (claim.gain + left)), finding)
    return finding


def timing_finding(
    claim: Claim,
    known: Arm,
    bench: Bench,
    after: Selection,
    rest: tuple[float, float],
    before: HeldOut,
    settings: DiagnosisSettings,
    reference: Reference | None,
) -> Finding:
    """Finding of a late channel: the shift that was made and the `rest` of it, with its standard deviation [s]."""
    candidate = claim.trial.candidate
    side = candidate.effect.channel or ""
    arm = bench.nominal.arm
    made = (
        arm.motor_delay_s - known.motor_delay_s
        if side == "motor"
        else arm.joint_delay_s - known.joint_delay_s
    )
    left, std = rest
    # The healthy channel itself is a little later on one day than on another.
    days = (reference.delay_std_s if reference is not None else {}).get(side, DELAY_STD_S)
    std = float(np.hypot(std, days))
    now = held_out(bench.evidence, [*(c.trial.rows for c in after.claims), *after.nuisance_rows])
    keys = [(side, j) for j in range(bench.nominal.arm.chain.n)]
    numbers = interval(before, now, keys, settings.seed)
    return Finding(
        candidate.cause,
        "timing",
        (),
        {"delay": Value(made + left, std, "s")},
        Evident(-claim.score.fitted, claim.score.p_value, numbers[0], numbers[1], (numbers[2], numbers[3])),
        claim.confidence,
        tuple((c.cause, c.joints, -g) for c, g in claim.alternatives),
        candidate.effect.tell_apart,
        claim.gain,
    )


def _loss_finding(loss: tuple[SampleLoss, ...]) -> Finding:
    worst = loss[0]
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


def _models(
    bench: Bench,
    baseline: Baseline,
    claims: Sequence[Claim],
    nuisance: Sequence[Rows],
    findings: Sequence[Finding],
    sessions: Sequence[Session],
) -> tuple[DynamicModel, DynamicModel, dict[str, float]]:
    """Base and extended model, and the change of the base parameters in their standard deviations."""
    evidence, nominal = bench.evidence, bench.nominal
    p = evidence.base_count
    robot = sessions[0].metadata.get("robot", "") or "arm"
    provenance: dict[str, Any] = {
        "sessions": [r.name for r in nominal.recordings if not r.test],
        "estimator": "diagnosis",
    }
    evidence.replace([*(c.trial.rows for c in claims), *nuisance])
    effects = tuple(_entry(f) for f in findings if f.cause != LOST_SAMPLES.cause)

    def fitted(values: Floats, covariance: Floats, entries: tuple[dict[str, Any], ...]) -> DynamicModel:
        return DynamicModel(
            robot,
            nominal.structure,
            nominal.base.names,
            values,
            covariance,
            nominal.base,
            provenance,
            entries,
        )

    base = fitted(baseline.values, baseline.covariance, ())
    extended = fitted(evidence.full.values[:p].copy(), evidence.covariance()[:p, :p], effects)
    assert extended.std is not None
    shift = (extended.values - base.values) / np.maximum(extended.std, 1e-300)
    order = np.argsort(-np.abs(shift))[:10]
    changes = {base.names[k]: float(shift[k]) for k in order if abs(shift[k]) > 2.0} if effects else {}
    return base, extended, changes


def _entry(finding: Finding) -> dict[str, Any]:
    """A finding as an entry of a model's effects."""
    return {
        "cause": finding.cause,
        "side": finding.side,
        "joints": list(finding.joints),
        **({} if finding.form is None else {"form": finding.form}),
        "parameters": {
            name: {"value": v.value, "std": v.std, "unit": v.unit} for name, v in finding.parameters.items()
        },
    }


def _stuck(nominal: Nominal) -> list[tuple[str, int, tuple[str, ...]]]:
    """Side, joint (from 1) and variable of motor torques that the channel does not report as they are."""
    joints = {one.joint for r in nominal.recordings if not r.test for one in r.stuck}
    return [("motor", joint + 1, (f"load{joint + 1}",)) for joint in sorted(joints)]


def _stuck_notes(nominal: Nominal) -> list[str]:
    names = nominal.arm.chain.joint_names
    return [
        f"{r.name}: the motor torque of {names[one.joint]} reads exactly {one.value:.4g} Nm in {one.count} of "
        f"{one.samples} samples in motion, so torques near that are not reported as they are; these samples are "
        "left out"
        for r in nominal.recordings
        for one in r.stuck
    ]


def _lines(nominal: Nominal, remainders: Sequence[Remainder]) -> list[str]:
    names = nominal.arm.chain.joint_names
    return [
        f"the {r.side} torque of {names[r.joint - 1]} swings at {r.line_hz:.3g} Hz whatever the arm does: look "
        "for what shakes the arm, or hums in the channel, at that frequency"
        for r in remainders
        if r.line_hz > 0.0
    ]


def _notes(bench: Bench, reference: Reference | None) -> tuple[str, ...]:
    notes = []
    if "motor" not in bench.nominal.rows:
        notes.append(
            "no motor torque: causes on the motor side cannot be seen, and sensor causes are told "
            "from physical "
            "ones by their shape alone"
        )
    if reference is None:
        notes.append(
            "no reference of the healthy arm: a constant change that base parameters absorb (payload, torque "
            "constant, wear, offsets) cannot be seen, and what the arm always had, such as friction that turns over "
            "some distance after a reversal, is named like a fault; run `lwr-run commission` when the arm is healthy"
        )
    elif bench.evidence.prior is None:
        notes.append(
            "the reference shares no base parameter with these sessions: parameters are not compared"
        )
    for side, band in bench.nominal.band_hz.items():
        if band is not None:
            notes.append(
                f"the {side} torque was low-passed before it came here, nothing is left above {2.0 * band:.2g} "
                f"Hz: rows are compared below {band:.2g} Hz; delays, reversals and ripple of the motor's turn "
                "cannot be seen"
            )
    still = np.flatnonzero(~bench.nominal.moving)
    if len(still):
        names = ", ".join(bench.nominal.arm.chain.joint_names[j] for j in still)
        notes.append(f"{names}: no motion of {TRAVEL_RAD} rad, so nothing can be said there")
    if not bench.repeatable:
        notes.append(
            "no motion repeats within a session: what the model leaves is itself the noise that claims are "
            "held against, so only what explains much of it is named"
        )
    if bench.evidence.prior is not None and not bench.evidence.compared:
        notes.append(
            "what the motion hardly excites is held near the inertia of the URDF, within 20 %: a wrong URDF "
            "would show as a cause"
        )
    return tuple(notes)
