"""From sessions to a diagnosis: prepare, fit, select, check what is left, extend, measure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from fri.errors import DataError
from ident.diagnosis.bench import (
    ArmData,
    Bench,
    again_with,
    nominal_arm,
    prepare_bench,
    slow_delay,
    some_joint_moves,
)
from ident.diagnosis.candidates import Candidate, Dictionary
from ident.diagnosis.conclusion import Baseline, Simulate, conclude, timing_finding
from ident.diagnosis.evidence import Rows, Score
from ident.diagnosis.hygiene import sample_loss
from ident.diagnosis.nominal import Arm
from ident.diagnosis.recording import Recording, record
from ident.diagnosis.reference import Reference
from ident.diagnosis.result import Diagnosis, Finding
from ident.diagnosis.selection import Claim, Null, Selection, best_candidate, select
from ident.diagnosis.settings import DiagnosisSettings
from ident.dynamics.kinematics import Chain
from ident.effects import DELAYS, EFFECTS, PRESLIDING, Shape
from ident.model import Model, as_model
from ident.rows.sessions import Sessions, as_sessions, require

__all__ = ["diagnose"]

# How often at most a late channel is shifted and looked at again.
_SHIFTS = 5
# Delay whose trace stands for what is left of a larger one [s].
_UNIT_S = 1e-3
# Joints from which on a delay must be seen in more than one.
_MOST_ALONE = 3
# Share of the tolerance for delays within which a channel that was shifted is in its place.
_IN_PLACE = 0.2
# Share of a drive's inertia that the phase of the samples may make up.
_INERTIA_BY_PHASE = 0.05


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
    """What the base model gets wrong in `sessions`, by cause and joint, with an extended model.

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
    recordings = tuple(record(s, k, chain, settings, test=id(s) in held) for k, s in enumerate(everything))
    some_joint_moves(recordings)
    task = _Task(nominal_arm(chain, arm, reference), recordings, settings, reference, causes)
    state = _refined(task, _in_time(task, _first(task)))
    found = conclude(
        state.bench,
        state.selection,
        list(state.timing),
        sample_loss(sessions),
        settings,
        reference,
        model,
        simulate,
        sessions,
        test,
        state.baseline if state.timing else None,
    )
    return replace(found, notes=(*found.notes, *state.notes)) if state.notes else found


@dataclass(frozen=True, eq=False)
class _Task:
    """What a diagnosis starts from. causes : names to consider, None for all."""

    arm: Arm
    recordings: tuple[Recording, ...]
    settings: DiagnosisSettings
    reference: Reference | None
    causes: Sequence[str] | None

    @cached_property
    def null(self) -> Null | None:
        """Gain of each candidate in healthy sets."""
        return None if self.reference is None else self.reference.limits()

    def bench(self, arm: Arm, reference: Reference | None, *, fit_compliance: bool) -> Bench:
        """Rows, noise and candidates for an arm."""
        return prepare_bench(
            arm, self.recordings, self.settings, reference, self.causes, fit_compliance=fit_compliance
        )

    def select(self, bench: Bench) -> Selection:
        """The causes that the data of a bench carry."""
        return select(bench.dictionary, bench.evidence, self.settings, self.null)


@dataclass(frozen=True, eq=False)
class _State:
    """A diagnosis under way. timing : findings of late channels, put in time on the bench. baseline : before that.
    left_out : causes dropped from the candidates.
    """

    bench: Bench
    selection: Selection
    timing: tuple[Finding, ...] = ()
    baseline: Baseline | None = None
    notes: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()


def _first(task: _Task) -> _State:
    """The first selection, with the noise of the best candidate's residual where repetition does not give it."""
    bench = task.bench(task.arm, task.reference, fit_compliance=task.reference is None)
    selection = task.select(bench)
    if bench.told or selection.claims:
        return _State(bench, selection)
    best = best_candidate(bench.dictionary, bench.evidence, task.settings)
    quieter = None if best is None else again_with(bench, best, task.settings, task.causes)
    if quieter is None:
        return _State(bench, selection)
    again = task.select(quieter)
    return _State(quieter, again) if again.claims else _State(bench, selection)


def _in_time(task: _Task, state: _State) -> _State:
    """The same with late channels shifted in time, and findings of them."""
    late = _late(state.selection)
    doubtful = [
        c.trial.candidate.cause
        for c in late
        if not (_late_at_all_speeds(state.bench, c) and _late_in_all_joints(state.bench, c))
    ]
    if doubtful:
        task = replace(task, causes=[cause for cause in task.causes or EFFECTS if cause not in doubtful])
        state.bench.dictionary = Dictionary(state.bench.nominal, state.bench.evidence, task.causes)
        state = _State(state.bench, task.select(state.bench))
        late = _late(state.selection)
    if not late:
        return replace(state, left_out=tuple(doubtful))
    baseline = Baseline.of(state.bench, _without_delays(state.selection))
    shifted, bench, amounts = task.arm, state.bench, {c.trial.candidate.cause: _made(c) for c in late}
    healthy = _at_another_phase(task.reference) if DELAYS["motor"].cause in amounts else task.reference
    for _ in range(_SHIFTS):
        shifted = _shifted(shifted, amounts)
        bench = task.bench(
            replace(shifted, compliance=bench.nominal.arm.compliance), healthy, fit_compliance=False
        )
        selection = task.select(bench)
        # What spoilt the first estimate may be in the model now, and be itself in its place only now.
        rest = {cause: _rest(bench, selection, cause) for cause in amounts}
        amounts = {cause: value for cause, (value, _) in rest.items()}
        if max(map(abs, amounts.values())) < _IN_PLACE * task.settings.delay_tolerance_s:
            break
    timing, notes = [], []
    for claim in late:
        left = rest[claim.trial.candidate.cause]
        finding = timing_finding(
            claim, task.arm, bench, selection, left, baseline.held, task.settings, task.reference
        )
        delay, unknown = finding.parameters["delay"], _unknown_delay(task.arm, task.recordings, claim)
        if abs(delay.value) <= unknown:
            notes.append(_own_delay(claim, unknown))
        # A claim of which nothing is left once all else is in the model was something else.
        elif abs(delay.value) > 3.0 * delay.std:
            timing.append(finding)
    selection.claims = [c for c in selection.claims if c not in _late(selection)]
    return _State(bench, selection, tuple(timing), baseline, tuple(notes), tuple(doubtful))


def _refined(task: _Task, state: _State) -> _State:
    """The selection once more, with predictions and noise that know of the claims."""
    causes = [cause for cause in task.causes or EFFECTS if cause not in state.left_out]
    bench = again_with(state.bench, state.selection, task.settings, causes)
    if bench is None:
        return state
    selection = task.select(bench)
    selection.claims = [c for c in selection.claims if c not in _late(selection)]
    return replace(state, bench=bench, selection=selection)


def _late(selection: Selection) -> list[Claim]:
    """Claims of late channels."""
    return [c for c in selection.claims if c.trial.candidate.effect.side == "timing"]


def _made(claim: Claim) -> float:
    """Delay [s] that a claim of a late channel means."""
    return float(claim.trial.shape["delay"]) * float(claim.score.coefficients[0])


def _without_delays(selection: Selection) -> list[Rows]:
    """Columns of the tolerated deviations but delays."""
    named = zip(selection.nuisance, selection.nuisance_rows, strict=True)
    return [rows for name, rows in named if "delay" not in name]


def _rest(bench: Bench, selection: Selection, cause: str) -> tuple[float, float]:
    """How much later a channel still is, and its standard deviation [s], beside all claims but slow turning, which a
    late motor resembles.
    """
    side = EFFECTS[cause].channel
    alike = (cause, PRESLIDING.cause)
    taken = [c.trial.rows for c in selection.claims if c.trial.candidate.cause not in alike]
    tolerated = [
        rows
        for name, rows in zip(selection.nuisance, selection.nuisance_rows, strict=True)
        if not name.startswith(f"{side} delay")
    ]
    bench.evidence.replace([*taken, *tolerated])
    columns = bench.dictionary.rows(Candidate(EFFECTS[cause], -1), Shape(delay=_UNIT_S))
    return _delay_of(bench.evidence.score(bench.evidence.padded(columns)))


def _delay_of(score: Score) -> tuple[float, float]:
    """Delay and standard deviation [s] from the score of a channel that is late by `_UNIT_S`."""
    return _UNIT_S * float(score.coefficients[0]), _UNIT_S * float(np.sqrt(score.covariance[0, 0]))


def _at_another_phase(reference: Reference | None) -> Reference | None:
    """The healthy arm for motor torques that are later than they were then.

    The cabinet fills the time between two commands with a line, so the motor torque has a ripple of their period that
    grows with the acceleration. A channel whose samples are whole periods apart meets it at one phase, where it looks
    like inertia; a late channel meets it at another. With inertias held at their healthy values, viscous friction that
    comes later still would make up for that.
    """
    return None if reference is None else reference.loosened("Ia", _INERTIA_BY_PHASE)


def _shifted(arm: Arm, amounts: Mapping[str, float]) -> Arm:
    """The arm with channels that are later by so much [s], by cause."""
    return replace(
        arm,
        motor_delay_s=arm.motor_delay_s + amounts.get(DELAYS["motor"].cause, 0.0),
        joint_delay_s=arm.joint_delay_s + amounts.get(DELAYS["joint"].cause, 0.0),
    )


def _unknown_delay(known: Arm, recordings: Sequence[Recording], claim: Claim) -> float:
    """Delay [s] up to which a late channel may be what the arm is like, 0 where a healthy arm told what it is.

    A motor torque that is published by another clock than the positions waits for a tick of its own and for the
    next packet: that much is a property of the controller's program, and no fault that could be told from it.
    """
    if known.encoder_known or claim.trial.candidate.effect.channel != "motor":
        return 0.0
    stretches = [s for r in recordings for s in r.stretches if len(s.motor_time) > 1]
    own = max(float(np.median(np.diff(s.motor_time))) for s in stretches)
    positions = max(float(np.median(np.diff(s.time))) for s in stretches)
    return own + positions if own > 1.5 * positions else 0.0


def _own_delay(claim: Claim, limit: float) -> str:
    return (
        f"motor torques come {1e3 * _made(claim):.1f} ms after the positions, which was corrected; without a reference "
        f"nobody knows how late they are when all is well, so less than {1e3 * limit:.0f} ms, a sample of each "
        "channel, is no finding"
    )


def _late_at_all_speeds(bench: Bench, claim: Claim) -> bool:
    """Whether the slow part of the motion confirms a late channel."""
    bench.evidence.replace([])
    made = _made(claim)
    slow, std = slow_delay(bench, claim.trial)
    return abs(slow - made) < 0.3 * abs(made) + 4.0 * std and abs(slow) > 0.3 * abs(made)


def _late_in_all_joints(bench: Bench, claim: Claim) -> bool:
    """Whether a channel is as late in the other joints as in the one that says most of it: drag that resembles a delay
    is in one joint.
    """
    evidence = bench.evidence
    evidence.replace([])
    padded = evidence.padded(bench.dictionary.rows(claim.trial.candidate, Shape(delay=_UNIT_S)))
    if len(padded) < _MOST_ALONE:
        return True
    loudest = max(padded, key=lambda key: evidence.score({key: padded[key]}).fitted)
    delay, std = _delay_of(
        evidence.score({key: columns for key, columns in padded.items() if key != loudest})
    )
    made = _made(claim)
    return abs(delay - made) < 0.5 * abs(made) + 4.0 * std
