"""From sessions to a diagnosis: prepare, fit, select, check the remainder, extend, measure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fri.errors import DataError
from ident.diagnosis.causes.selection import Selection, best_candidate, longer_turns
from ident.diagnosis.healthy.against_healthy import against_healthy
from ident.diagnosis.healthy.bench import (
    ArmData,
    DiagnosisBench,
    again_with,
    known_drives,
    nominal_arm,
)
from ident.diagnosis.healthy.channel_delays import sides_apart
from ident.diagnosis.healthy.preparation import preparation
from ident.diagnosis.healthy.reference import Reference
from ident.diagnosis.outcome.result import Diagnosis
from ident.diagnosis.rows.broken_data import (
    BrokenChannel,
    blamed,
    in_doubt,
    is_broken,
    without_broken,
    worthless,
)
from ident.diagnosis.settings import DiagnosisSettings
from ident.diagnosis.verdict.conclusion import conclude
from ident.diagnosis.verdict.doubtful_channels import bending, held_back, unconfirmed, without_payloads
from ident.diagnosis.verdict.late_channels import in_time, late_by_themselves, without_late
from ident.diagnosis.verdict.payloads import other_masses, payload_findings, unstated_body, with_masses
from ident.diagnosis.verdict.task import Simulate, State, Task
from ident.dynamics.kinematics import Chain
from ident.effects import DELAYS, EFFECTS, PRESLIDING
from ident.model import Model, as_model
from ident.rows.sessions import require
from ident.screening.doubts import Doubt
from lwr_driver.session import Sessions, as_sessions

# Rounds of the presliding lengths of these days, the factor on one that is none, and the largest one.
_LENGTHS, _ALIKE, _USUAL_LENGTHS = 3, 1.2, 2.5


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
    arm = known_drives(arm, reference)
    ready = preparation(sessions, test, chain, settings, arm.couplings, reference)
    settings, recordings, broken = ready.settings, ready.recordings, ready.broken
    with blamed(broken, chain.joint_names):
        nominal = nominal_arm(chain, arm, reference, settings.signals)
        task = Task(
            sessions, test, nominal, recordings, settings, reference, causes, model, simulate, not broken
        )
        if worthless(broken):
            return _ended(task, broken)
        whole = task
        task, state = _begun(whole)
        contradicted = _contradicted(state.bench, reference, ready.doubts)
        broken = (*broken, *contradicted)
        doubts = unconfirmed(ready.doubts, broken, chain.joint_names)
        if contradicted:
            whole = replace(whole, recordings=without_broken(recordings, contradicted), sound=False)
            if worthless(broken):
                return _ended(whole, broken)
        payloads_told = not bending(doubts)
        if contradicted or not payloads_told:
            task, state = _begun(whole if payloads_told else without_payloads(whole))
        others = other_masses(state.bench, reference)
        body = None if reference is None else unstated_body(state.bench, reference)
        if reference is not None and (others or body is not None):
            # With a mass of its own it pulls at nothing else.
            task = with_masses(task, {one.payload: one.mass for one in others})
            if body is not None:
                task = replace(task, reference=reference.carrying(body.values, body.covariance))
            state = _first(task, _bench(task))
        state = in_time(task, state)
        # Of the benches, the memory holds the latest alone.
        state = _refined(task, state)
        state = replace(state, notes=(*state.notes, *late_by_themselves(task.apart, state)))
        if reference is not None and payloads_told:
            state = replace(state, loads=tuple(payload_findings(others, body, recordings)))
        else:
            state = replace(state, notes=(*state.notes, *(one.text for one in others)))
        found = held_back(conclude(task, state), doubts, chain.joint_names)
        nameless = tuple(u for u in found.unexplained if not is_broken(broken, u.side, u.joint))
        return replace(found, unexplained=nameless, data=broken, in_doubt=in_doubt(doubts, chain))


def _ended(task: Task, broken: Sequence[BrokenChannel]) -> Diagnosis:
    """The base model alone, without a cause: from worthless data nothing is concluded."""
    task = replace(task, simulate=None)
    state = State(task.bench(task.arm, task.reference, fit_compliance=False), Selection([]))
    return replace(conclude(task, state), findings=(), unexplained=(), data=tuple(broken))


def _contradicted(
    bench: DiagnosisBench, reference: Reference | None, doubts: Sequence[Doubt]
) -> tuple[BrokenChannel, ...]:
    """The torque channels that the healthy arm contradicts; none without one. doubts : see `against_healthy`."""
    healthy = None if reference is None else reference.prior(bench.nominal.base, bench.nominal.masses)
    if healthy is None:
        return ()
    return against_healthy(bench.nominal.rows, healthy[1], bench.nominal.arm.chain.joint_names, doubts)


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
        change = longer_turns(bench.dictionary, task.settings)
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
    best = best_candidate(bench.dictionary, task.settings)
    quieter = None if best is None else again_with(bench, best, task.settings, task.causes)
    if quieter is None:
        return State(bench, selection)
    again = task.select(quieter)
    return State(quieter, again) if again.claims else State(bench, selection)


def _refined(task: Task, state: State) -> State:
    """The selection once more, with predictions and noise of the model with the claims."""
    causes = [cause for cause in task.causes or EFFECTS if cause not in state.left_out]
    bench = again_with(state.bench, state.selection, task.settings, causes)
    if bench is None:
        return state
    return replace(state, bench=bench, selection=without_late(task.select(bench)))
