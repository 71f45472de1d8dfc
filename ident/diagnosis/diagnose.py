"""From sessions to a diagnosis: prepare, fit, select, check the remainder, extend, measure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from fri.errors import DataError
from ident.diagnosis.against_healthy import against_healthy
from ident.diagnosis.bench import (
    ArmData,
    DiagnosisBench,
    again_with,
    nominal_arm,
    slow_delay,
    some_joint_moves,
)
from ident.diagnosis.broken_data import (
    BrokenChannel,
    blamed,
    broken_channels,
    is_broken,
    without_broken,
    worthless,
)
from ident.diagnosis.candidates import Candidate
from ident.diagnosis.channel_delays import ONE_IN, sides_apart
from ident.diagnosis.conclusion import conclude
from ident.diagnosis.confidence import believable
from ident.diagnosis.confirmation import confirmed_delay
from ident.diagnosis.models import lasting
from ident.diagnosis.payloads import other_masses, payload_finding, unstated_body, with_masses
from ident.diagnosis.recording import record, settled, usual_step
from ident.diagnosis.reference import INERTIA_BY_PHASE, Reference
from ident.diagnosis.result import Diagnosis, Finding
from ident.diagnosis.score import Score
from ident.diagnosis.selection import Claim, Selection, best_candidate, longer_turns
from ident.diagnosis.settings import DiagnosisSettings
from ident.diagnosis.task import Baseline, Simulate, State, Task
from ident.dynamics.kinematics import Chain
from ident.effects import DELAYS, EFFECTS, PRESLIDING, Shape
from ident.model import Model, as_model
from ident.model.signals import signal_settings
from ident.rows.content import Recall
from ident.rows.sessions import require
from lwr_driver.session import Sessions, as_sessions

# Largest number of shifts of a late channel.
_SHIFTS = 5
# Unit of delay for a column [s].
_UNIT_S = 1e-3
# Least number of joints for a delay to be confirmed by more than one.
_MOST_ALONE = 3
# Rounds of the presliding lengths of these days, the factor on one that is none, and the largest one.
_LENGTHS, _ALIKE, _USUAL_LENGTHS = 3, 1.2, 2.5
# Largest remaining delay after a shift, as a share of the tolerance for delays.
_IN_PLACE = 0.2


def diagnose(
    sessions: Sessions,
    chain: Chain,
    *,
    test: Sessions = (),
    arm: ArmData | None = None,
    model: Model | None = None,
    reference: Reference | Model | None = None,
    settings: DiagnosisSettings | None = None,
    simulate: Simulate | None = None,
    causes: Sequence[str] | None = None,
) -> Diagnosis:
    """Errors of the base model in `sessions`, by cause and joint, with an extended model.

    sessions : a session, the path of a log, or several of either. test : the same, for measuring only.
    arm : stiffness and gear ratios, from its description. model : the present model, or its file, whose
    simulation the extended one is compared with; default the base model fitted here. reference : the healthy
    arm, or its model file. simulate : replay, for the error of the simulation. causes : names to consider.
    Raises ConfigurationError for arguments of a wrong type, DataError, with advice, for unusable sessions.
    """
    settings = settings or DiagnosisSettings()
    require(chain, Chain, "chain", "read one with `Chain.from_urdf`")
    require(settings, DiagnosisSettings, "settings", "make one with `DiagnosisSettings()`")
    sessions, test = as_sessions(sessions), as_sessions(test)
    model = None if model is None else as_model(model)
    if reference is not None and not isinstance(reference, Reference):
        reference = Reference.of(as_model(reference, "reference"))
    if not sessions:
        raise DataError("no session given; name at least one session file")
    everything = sorted([*sessions, *test], key=lambda s: s.start)
    held = {id(s) for s in test}
    couplings, recall = () if arm is None else arm.couplings, Recall()
    # As `identify` does, whatever a reference filters with.
    broken = broken_channels(everything, chain, settings.signals, couplings, recall=recall)
    known = None if reference is None else signal_settings(reference.model)
    if known is not None:
        # Of the reference's sessions, not of these.
        known = replace(known, motor_delay_s="estimate", joint_delay_s="estimate")
        settings = replace(settings, signals=known)
    with blamed(broken, chain.joint_names):
        settings = settled(settings, sessions, chain, couplings, recall=recall)
        recordings = tuple(
            record(s, k, chain, settings, test=id(s) in held, recall=recall) for k, s in enumerate(everything)
        )
        del recall
        some_joint_moves(recordings)
        recordings = without_broken(recordings, broken)
        nominal = nominal_arm(chain, arm, reference)
        task = Task(
            sessions, test, nominal, recordings, settings, reference, causes, model, simulate, not broken
        )
        if worthless(broken):
            return _ended(task, broken)
        whole = task
        task, first = _begun(whole)
        contradicted = _contradicted(first.bench, reference)
        if contradicted:
            broken = (*broken, *contradicted)
            whole = replace(whole, recordings=without_broken(recordings, contradicted), sound=False)
            if worthless(broken):
                return _ended(whole, broken)
            task, first = _begun(whole)
        others = other_masses(first.bench, reference)
        body = None if reference is None else unstated_body(first.bench, reference)
        if reference is not None and (others or body is not None):
            # With a mass of its own it pulls at nothing else.
            task = with_masses(task, {one.payload: one.mass for one in others})
            if body is not None:
                task = replace(task, reference=reference.carrying(body.values, body.covariance))
            first = _first(task, _bench(task))
        state = _refined(task, _in_time(task, first))
        state = replace(state, notes=(*state.notes, *late_by_themselves(task.apart, state)))
        if reference is not None:
            loads = [payload_finding(one) for one in (*others, body) if one is not None]
            state = replace(state, loads=tuple(loads))
        else:
            state = replace(state, notes=(*state.notes, *(one.text for one in others)))
        found = conclude(task, state)
        nameless = tuple(u for u in found.unexplained if not is_broken(broken, u.side, u.joint))
        return replace(found, unexplained=nameless, data=broken)


def _ended(task: Task, broken: Sequence[BrokenChannel]) -> Diagnosis:
    """The base model alone, without a cause: from worthless data nothing is concluded."""
    task = replace(task, simulate=None)
    state = State(task.bench(task.arm, task.reference, fit_compliance=False), Selection([], {}, {}))
    return replace(conclude(task, state), findings=(), unexplained=(), data=tuple(broken))


def _contradicted(bench: DiagnosisBench, reference: Reference | None) -> tuple[BrokenChannel, ...]:
    """The torque channels that the healthy arm contradicts; none without one."""
    healthy = None if reference is None else reference.prior(bench.nominal.base, bench.nominal.masses)
    if healthy is None:
        return ()
    return against_healthy(bench.nominal.rows, healthy[1], bench.nominal.arm.chain.joint_names)


def _bench(task: Task) -> DiagnosisBench:
    return task.bench(task.arm, task.reference, fit_compliance=task.reference is None)


def _begun(task: Task) -> tuple[Task, State]:
    """The task with the presliding lengths of these days, and its first selection. A claim of presliding pulls at the
    length of its drive, and a late motor, which reverses later, at all of them: these are the usual ones then."""
    if task.reference is not None and task.arm.encoder_known and task.sound:
        apart = sides_apart(task.sessions, task.arm, task.settings, task.reference)
        task = replace(task, apart=apart)
    usual = task.arm.presliding
    task, bench = _of_these_days(task)
    first = _first(task, bench)
    if usual is None or task.arm.presliding is None:
        return task, first
    claims = [claim.trial.candidate for claim in first.selection.claims]
    pulled = np.array([(PRESLIDING.cause, joint) in [c.key for c in claims] for joint in range(len(usual))])
    pulled |= any(candidate.effect is DELAYS["motor"] for candidate in claims)
    lengths = np.where(pulled, usual, task.arm.presliding)
    if np.array_equal(lengths, task.arm.presliding):
        return task, first
    task = replace(task, arm=replace(task.arm, presliding=lengths))
    return task, _first(task, _bench(task))


def _of_these_days(task: Task) -> tuple[Task, DiagnosisBench]:
    """The task with the presliding lengths of these days, and its bench: friction that turns over half or twice the
    length is not linear in the change of it."""
    bench, usual = _bench(task), task.arm.presliding
    if task.reference is None or usual is None or "motor" in task.apart:
        return task, bench
    lengths = usual
    for _ in range(_LENGTHS):
        change = longer_turns(bench.dictionary, bench.evidence, task.settings)
        if np.max(np.abs(change)) < np.log(_ALIKE):
            break
        lengths = np.clip(lengths * np.exp(change), usual / _USUAL_LENGTHS, usual * _USUAL_LENGTHS)
        task = replace(task, arm=replace(task.arm, presliding=lengths))
        bench = _bench(task)
    return task, bench


def _first(task: Task, bench: DiagnosisBench) -> State:
    """The first selection, with the noise from the best candidate's residual if neither repetition nor the healthy arm
    gives it: the limits of the healthy arm hold with its own noise."""
    selection = task.select(bench)
    known = bench.repeatable or (task.reference is not None and bool(task.reference.correlated))
    if known or selection.claims:
        return State(bench, selection)
    best = best_candidate(bench.dictionary, bench.evidence, task.settings)
    quieter = None if best is None else again_with(bench, best, task.settings, task.causes)
    if quieter is None:
        return State(bench, selection)
    again = task.select(quieter)
    return State(quieter, again) if again.claims else State(bench, selection)


def _in_time(task: Task, state: State) -> State:
    """The same with late channels shifted in time, and findings of them."""
    late = _late(state.selection)
    slow = {c.trial.candidate.cause: _elsewhere(task, state.bench, c) for c in late}
    doubtful = [
        c.trial.candidate.cause
        for c in late
        if not (
            _late_at_all_speeds(c, *slow[c.trial.candidate.cause])
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
    tolerated, beside = (
        {name: rows for name, rows in found.items() if "delay" not in name}
        for found in (state.selection.tolerated, lasting(state.selection))
    )
    baseline = Baseline.of(state.bench, list(tolerated.values()), beside)
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
    timing, notes = [], []
    after = State(bench, selection, baseline=baseline, left_out=tuple(doubtful))
    for claim in late:
        cause = claim.trial.candidate.cause
        finding = confirmed_delay(task, after, claim, rest[cause], slow[cause])
        unknown = _unknown_delay(task, claim)
        if abs(finding.parameters["delay"].value) <= unknown:
            notes.append(_own_delay(claim, unknown))
        # A delay explained by the rest of the model, or usual from day to day, is no finding.
        elif finding.evidence.p_value < ONE_IN:
            if believable(finding.grounds):
                timing.append(finding)
            else:
                notes.append(_corrected_delay(claim, finding))
    selection.claims = [c for c in selection.claims if c not in _late(selection)]
    return replace(after, timing=tuple(timing), notes=tuple(notes))


def _refined(task: Task, state: State) -> State:
    """The selection once more, with predictions and noise of the model with the claims."""
    causes = [cause for cause in task.causes or EFFECTS if cause not in state.left_out]
    bench = again_with(state.bench, state.selection, task.settings, causes)
    if bench is None:
        return state
    selection = task.select(bench)
    selection.claims = [c for c in selection.claims if c not in _late(selection)]
    return replace(state, bench=bench, selection=selection)


def _late(selection: Selection) -> list[Claim]:
    return [c for c in selection.claims if c.trial.candidate.effect.side == "timing"]


def _made(claim: Claim) -> float:
    """Delay [s] in a claim of a late channel."""
    return float(claim.trial.shape["delay"]) * float(claim.score.coefficients[0])


def _rest(bench: DiagnosisBench, selection: Selection, cause: str) -> tuple[float, float]:
    """Remaining delay of a channel and its standard deviation [s], beside all claims but presliding, similar to a
    late motor.
    """
    side = EFFECTS[cause].channel
    alike = (cause, PRESLIDING.cause)
    taken = [c.trial.rows for c in selection.claims if c.trial.candidate.cause not in alike]
    tolerated = [
        rows
        for name, rows in selection.tolerated.items()
        if not (name.startswith(f"{side} delay") or cause in name)
    ]
    bench.evidence.replace([*taken, *tolerated])
    columns = bench.dictionary.rows(Candidate(EFFECTS[cause], -1), Shape(delay=_UNIT_S))
    return _delay_of(bench.evidence.score(bench.evidence.padded(columns)))


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

    A motor torque published by another clock than the positions waits for a tick of its own and for the next packet:
    a property of the controller's program, indistinguishable from a fault of this size.
    """
    if task.arm.encoder_known or claim.trial.candidate.effect.channel != "motor":
        return 0.0
    stretches = [s for r in task.recordings for s in r.stretches if s.own_clock]
    return max((usual_step(s.motor_time) + usual_step(s.time) for s in stretches), default=0.0)


def _corrected_delay(claim: Claim, finding: Finding) -> str:
    delay = 1e3 * finding.parameters["delay"].value
    return (
        f"{claim.trial.candidate.effect.channel} torques look {abs(delay):.1f} ms {'late' if delay > 0 else 'early'} "
        "against the healthy arm; this was corrected, and the evidence is too small for a finding"
    )


def _own_delay(claim: Claim, limit: float) -> str:
    return (
        f"motor torques come {1e3 * _made(claim):.1f} ms after the positions; this delay was corrected. The healthy "
        f"delay is unknown without a reference, so a delay below {1e3 * limit:.0f} ms (one sample of each channel) is "
        "not reported as a finding"
    )


def late_by_themselves(apart: Mapping[str, tuple[float, float]], state: State) -> list[str]:
    """Channels that rows away from reversals alone tell late, or early: the other rows have a finding or a note of the
    others.

    apart : as of `sides_apart`.
    """
    known: set[str | None] = {EFFECTS[finding.cause].channel for finding in state.timing}
    known |= {side for side in apart for note in state.notes if note.startswith(f"{side} torques")}
    return [
        f"{side} torques look {1e3 * abs(delay):.1f} ± {1e3 * std:.1f} ms {'late' if delay > 0 else 'early'} against "
        "the healthy arm in rows away from reversals; with reversals no row shows it, so it is no finding. A fast "
        "motion with few reversals tells"
        for side, (delay, std) in apart.items()
        if side not in known
    ]


def _told_apart(task: Task, claim: Claim) -> tuple[float, float] | None:
    """Delay of a late channel beyond the healthy one and its standard deviation [s] in rows away from reversals, in
    which joints agree; None where these tell none."""
    return task.apart.get(claim.trial.candidate.effect.channel or "")


def _elsewhere(task: Task, bench: DiagnosisBench, claim: Claim) -> tuple[float, float]:
    """Delay of a late channel and its standard deviation [s] in rows away from reversals, where these tell one, for
    friction that turns has no part in them; else in slow rows."""
    told = _told_apart(task, claim)
    if told is not None:
        return told
    bench.evidence.replace([])
    return slow_delay(bench, claim.trial)


def _late_at_all_speeds(claim: Claim, slow: float, std: float) -> bool:
    made = _made(claim)
    return abs(slow - made) < 0.3 * abs(made) + 4.0 * std and abs(slow) > 0.3 * abs(made)


def _late_in_all_joints(bench: DiagnosisBench, claim: Claim) -> bool:
    """Whether the other joints confirm the delay of the joint with most of the evidence, unlike drag in one joint."""
    evidence = bench.evidence
    evidence.replace([])
    padded = evidence.padded(bench.dictionary.rows(claim.trial.candidate, Shape(delay=_UNIT_S)))
    if len(padded) < _MOST_ALONE:
        return True
    loudest = max(padded, key=lambda key: evidence.score({key: padded[key]}).fitted)
    others = {key: columns for key, columns in padded.items() if key != loudest}
    delay, std = _delay_of(evidence.score(others))
    made = _made(claim)
    return abs(delay - made) < 0.5 * abs(made) + 4.0 * std
