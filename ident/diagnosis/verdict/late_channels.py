"""Late channels: held against the rows that tell a delay, shifted in time, and told as a finding or a note."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ident.diagnosis.causes.candidates import Candidate
from ident.diagnosis.causes.claims import Claim
from ident.diagnosis.causes.selection import Selection
from ident.diagnosis.gain.score import Score
from ident.diagnosis.healthy.bench import DiagnosisBench, slow_delay
from ident.diagnosis.healthy.channel_delays import ONE_IN
from ident.diagnosis.healthy.reference import INERTIA_BY_PHASE, Reference
from ident.diagnosis.outcome.result import Finding
from ident.diagnosis.rows.recording import usual_step
from ident.diagnosis.verdict.confidence import believable
from ident.diagnosis.verdict.confirmation import confirmed_delay
from ident.diagnosis.verdict.models import staying
from ident.diagnosis.verdict.task import Baseline, State, Task
from ident.effects import DELAYS, EFFECTS, PRESLIDING, Shape

# Largest number of shifts of a late channel.
_SHIFTS = 5
# Unit of delay for a column [s].
_UNIT_S = 1e-3
# Least number of joints for a delay to be confirmed by more than one.
_MOST_ALONE = 3
# Lead of a torque over the positions that elastic joints and late stamps may give it [s].
_EARLIEST_S = 5e-3
# Largest remaining delay after a shift, as a share of the tolerance for delays.
_IN_PLACE = 0.2


def in_time(task: Task, state: State) -> State:
    """The same with late channels shifted in time, and findings or notes of them."""
    late = _late(state.selection)
    slow = {c.trial.candidate.cause: _elsewhere(task, state.bench, c) for c in late}
    doubtful = [
        c.trial.candidate.cause
        for c in late
        if not (
            _possible(task, c)
            and _late_at_all_speeds(c, *slow[c.trial.candidate.cause])
            and (_told_apart(task, c) is not None or _late_in_all_joints(state.bench, c))
        )
    ]
    if doubtful:
        task = replace(task, causes=[cause for cause in task.causes or EFFECTS if cause not in doubtful])
        state.bench.dictionary = state.bench.dictionary.of(task.causes)
        state = State(state.bench, task.select(state.bench))
        late = _late(state.selection)
    if not late:
        return replace(state, left_out=tuple(doubtful))
    tolerated = [one.tolerance.rows for one in state.selection.deviations if not one.tolerance.delays]
    beside = [one for one in staying(state.selection) if not one.delays]
    baseline = Baseline.of(state.bench, tolerated, beside)
    shifted, bench, amounts = task.arm, state.bench, {c.trial.candidate.cause: _made(c) for c in late}
    healthy = _at_another_phase(task.reference) if DELAYS["motor"].cause in amounts else task.reference
    for _ in range(_SHIFTS):
        shifted = replace(
            shifted,
            motor_delay_s=shifted.motor_delay_s + amounts.get(DELAYS["motor"].cause, 0.0),
            joint_delay_s=shifted.joint_delay_s + amounts.get(DELAYS["joint"].cause, 0.0),
        )
        compliant = replace(shifted, compliance=bench.nominal.arm.compliance)
        bench = task.bench(compliant, healthy, fit_compliance=False)
        selection = task.select(bench)
        # Causes with an influence on the first estimate may be in the model by now.
        rest = {cause: _rest(bench, selection, cause) for cause in amounts}
        amounts = {cause: value for cause, (value, _) in rest.items()}
        if max(map(abs, amounts.values())) < _IN_PLACE * task.settings.delay_tolerance_s:
            break
    timing, hardly = list[Finding](), list[Finding]()
    notes: dict[str, str] = {}
    after = State(bench, selection, baseline=baseline, left_out=tuple(doubtful))
    for claim in late:
        cause = claim.trial.candidate.cause
        finding = confirmed_delay(task, after, claim, rest[cause], slow[cause])
        unknown = _unknown_delay(task, claim)
        if abs(finding.parameters["delay"].value) <= unknown:
            notes[_channel(claim)] = _own_delay(claim, unknown)
        # A delay explained by the rest of the model, or usual from day to day, is no finding.
        elif finding.evidence.p_value < ONE_IN:
            if believable(finding.grounds):
                timing.append(finding)
            else:
                hardly.append(finding)
                notes[_channel(claim)] = _corrected_delay(claim, finding)
    return replace(
        after,
        selection=without_late(selection),
        timing=tuple(timing),
        notes=tuple(notes.values()),
        corrected=tuple(notes),
        hardly=tuple(hardly),
    )


def without_late(selection: Selection) -> Selection:
    """The same without claims of late channels."""
    late = _late(selection)
    return replace(selection, claims=[claim for claim in selection.claims if claim not in late])


def late_by_themselves(apart: Mapping[str, tuple[float, float]], state: State) -> list[str]:
    """Channels that rows away from reversals alone tell late, or early: the other rows have a finding or a note of the
    others.

    apart : as of `sides_apart`.
    """
    known = {EFFECTS[finding.cause].channel for finding in state.timing} | {*state.corrected}
    return [
        f"{side} torques look {1e3 * abs(delay):.1f} ± {1e3 * std:.1f} ms {'late' if delay > 0 else 'early'} against "
        "the healthy arm in rows away from reversals; with reversals no row shows it, so it is no finding. A fast "
        "motion with few reversals tells"
        for side, (delay, std) in apart.items()
        if side not in known
    ]


def _late(selection: Selection) -> list[Claim]:
    return [c for c in selection.claims if c.trial.candidate.effect.side == "timing"]


def _channel(claim: Claim) -> str:
    channel = claim.trial.candidate.effect.channel
    assert channel is not None, "the timing of a channel"
    return channel


def _made(claim: Claim) -> float:
    """Delay [s] in a claim of a late channel."""
    return float(claim.trial.shape["delay"]) * float(claim.score.coefficients[0])


def _rest(bench: DiagnosisBench, selection: Selection, cause: str) -> tuple[float, float]:
    """Remaining delay of a channel and its standard deviation [s], beside all claims but presliding, similar to a
    late motor.
    """
    alike = (cause, PRESLIDING.cause)
    taken = [c.trial.rows for c in selection.claims if c.trial.candidate.cause not in alike]
    tolerated = [one.tolerance.rows for one in selection.deviations if one.tolerance.cause != cause]
    bench.evidence.replace([*taken, *tolerated])
    columns = bench.dictionary.rows(Candidate(EFFECTS[cause], -1), Shape(delay=_UNIT_S))
    return _delay_of(bench.evidence.score(columns))


def _delay_of(score: Score) -> tuple[float, float]:
    """Delay and standard deviation [s] from the score of a channel late by `_UNIT_S`."""
    return _UNIT_S * float(score.coefficients[0]), _UNIT_S * float(np.sqrt(score.covariance[0, 0]))


def _at_another_phase(reference: Reference | None) -> Reference | None:
    """The healthy arm for motor torques with a new delay.

    The cabinet interpolates linearly between two commands, so the motor torque has a ripple of their period that
    grows with the acceleration. Samples whole periods apart see it at one phase, like an inertia; after a change of
    the delay they see another phase. With inertias held at their healthy values, a further error of the viscous
    friction would compensate for it.
    """
    return None if reference is None else reference.loosened("Ia", INERTIA_BY_PHASE)


def _unknown_delay(task: Task, claim: Claim) -> float:
    """Largest delay [s] of a late channel on a healthy arm, 0 if a reference gives it.

    A motor torque published by another clock than the positions waits for a tick of its own and for the next packet,
    one of the same clock for the latter alone: a property of the controller's program, indistinguishable from a fault
    of this size.
    """
    if task.arm.encoder_known or _channel(claim) != "motor":
        return 0.0
    stretches = [s for r in task.recordings for s in r.stretches if len(s.motor_time) > 1]
    waits = [usual_step(s.motor_time) + (usual_step(s.time) if s.own_clock else 0.0) for s in stretches]
    return max(waits, default=0.0)


def _corrected_delay(claim: Claim, finding: Finding) -> str:
    delay = 1e3 * finding.parameters["delay"].value
    return (
        f"{_channel(claim)} torques look {abs(delay):.1f} ms {'late' if delay > 0 else 'early'} "
        "against the healthy arm; this was corrected, and the evidence is too small for a finding"
    )


def _own_delay(claim: Claim, limit: float) -> str:
    return (
        f"motor torques come {1e3 * _made(claim):.1f} ms after the positions; this delay was corrected. The healthy "
        f"delay is unknown without a reference, so a delay below {1e3 * limit:.0f} ms (the wait for a sample) is "
        "not reported as a finding"
    )


def _told_apart(task: Task, claim: Claim) -> tuple[float, float] | None:
    """Delay of a late channel beyond the healthy one and its standard deviation [s] in rows away from reversals, in
    which joints agree; None where these tell none."""
    return task.apart.get(_channel(claim))


def _elsewhere(task: Task, bench: DiagnosisBench, claim: Claim) -> tuple[float, float]:
    """Delay of a late channel and its standard deviation [s] in rows away from reversals, where these tell one, for
    friction that turns has no part in them; else in slow rows."""
    told = _told_apart(task, claim)
    if told is not None:
        return told
    bench.evidence.replace([])
    return slow_delay(bench, claim.trial)


def _possible(task: Task, claim: Claim) -> bool:
    """Whether a channel comes no earlier than the positions: no torque is there before it acts, but play lets a motor
    turn back before its link."""
    known = task.arm.motor_delay_s if _channel(claim) == "motor" else task.arm.joint_delay_s
    return known + _made(claim) > -_EARLIEST_S


def _late_at_all_speeds(claim: Claim, slow: float, std: float) -> bool:
    made = _made(claim)
    return abs(slow - made) < 0.3 * abs(made) + 4.0 * std and abs(slow) > 0.3 * abs(made)


def _late_in_all_joints(bench: DiagnosisBench, claim: Claim) -> bool:
    """Whether the other joints confirm the delay of the joint with most of the evidence, unlike drag in one joint."""
    evidence = bench.evidence
    evidence.replace([])
    rows = bench.dictionary.rows(claim.trial.candidate, Shape(delay=_UNIT_S))
    if len(rows) < _MOST_ALONE:
        return True
    loudest = max(rows, key=lambda key: evidence.score({key: rows[key]}).fitted)
    others = {key: columns for key, columns in rows.items() if key != loudest}
    delay, std = _delay_of(evidence.score(others))
    made = _made(claim)
    return abs(delay - made) < 0.5 * abs(made) + 4.0 * std
