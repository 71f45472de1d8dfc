"""From sessions to a diagnosis: prepare, fit, select, check what is left, extend, measure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from fri.errors import DataError
from ident.discrepancy.bench import (
    ArmData,
    Bench,
    again_with,
    nominal_arm,
    prepare_bench,
    slow_delay,
    some_joint_moves,
)
from ident.discrepancy.candidates import Candidate, Dictionary
from ident.discrepancy.conclusion import Baseline, Simulate, conclude, timing_finding
from ident.discrepancy.evidence import Rows, Score
from ident.discrepancy.hygiene import sample_loss
from ident.discrepancy.nominal import Arm
from ident.discrepancy.recording import Recording, record
from ident.discrepancy.reference import Reference
from ident.discrepancy.result import Diagnosis, Finding
from ident.discrepancy.selection import Claim, Null, Selection, hopeful, select
from ident.discrepancy.settings import DiagnosisSettings
from ident.dynamics.kinematics import Chain
from ident.effects import EFFECTS
from ident.model.dynamic_model import DynamicModel

if TYPE_CHECKING:
    from lwr_driver.session import Session

__all__ = ["diagnose"]

_REPEATS = 1
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
    sessions: Sequence[Session],
    chain: Chain,
    *,
    test: Sequence[Session] = (),
    arm: ArmData | None = None,
    model: DynamicModel | None = None,
    reference: Reference | None = None,
    settings: DiagnosisSettings | None = None,
    simulate: Simulate | None = None,
    causes: Sequence[str] | None = None,
) -> Diagnosis:
    """What the base model gets wrong in `sessions`, by cause and joint, with an extended model.

    test : sessions for measuring only. arm : stiffness and gear ratios, from its description. model : the
    present model, whose simulation the extended one is compared with; default the base model fitted here.
    reference : the healthy arm. simulate : replay, for the error of the simulation. causes : names
    to consider.
    Raises DataError, with advice, for sessions that cannot be used.
    """
    settings = settings or DiagnosisSettings()
    if not sessions:
        raise DataError("no session given; name at least one session file")
    everything = sorted([*sessions, *test], key=lambda s: s.start)
    held = {id(s) for s in test}
    recordings = [record(s, k, chain, settings, test=id(s) in held) for k, s in enumerate(everything)]
    some_joint_moves(recordings)
    loss = sample_loss(list(sessions))
    known = nominal_arm(chain, arm, reference)
    bench = prepare_bench(known, recordings, settings, reference, causes, fit_compliance=reference is None)
    null = reference.limits() if reference is not None else None
    timing: list[Finding] = []
    baseline: Baseline | None = None
    notes: list[str] = []
    selection = select(bench.dictionary, bench.evidence, settings, null)
    if not bench.told and not selection.claims:
        bench, selection = _with_hope(bench, selection, settings, causes, null)
    late = [c for c in selection.claims if c.trial.candidate.effect.side == "timing"]
    doubtful = [
        c.trial.candidate.cause
        for c in late
        if not (_late_at_all_speeds(bench, c) and _late_in_all_joints(bench, c))
    ]
    if doubtful:
        causes = [cause for cause in causes or EFFECTS if cause not in doubtful]
        bench.dictionary = Dictionary(bench.nominal, bench.evidence, causes)
        selection = select(bench.dictionary, bench.evidence, settings, null)
        late = [c for c in selection.claims if c.trial.candidate.effect.side == "timing"]
    if late:
        baseline = Baseline.of(bench, _in_time(selection))
        shifted, amounts = known, {c.trial.candidate.cause: _made(c) for c in late}
        healthy = _at_another_phase(reference) if "motor_torque_delay" in amounts else reference
        for _ in range(_SHIFTS):
            shifted = _shifted(shifted, amounts)
            present = replace(shifted, compliance=bench.nominal.arm.compliance)
            bench = prepare_bench(present, recordings, settings, healthy, causes, fit_compliance=False)
            again = select(bench.dictionary, bench.evidence, settings, null)
            # What spoilt the first estimate may be in the model now, and be itself in its place only now.
            rest = {cause: _rest(bench, again, cause) for cause in amounts}
            amounts = {cause: value for cause, (value, _) in rest.items()}
            if max(map(abs, amounts.values())) < _IN_PLACE * settings.delay_tolerance_s:
                break
        unknown = {c.trial.candidate.cause: _unknown_delay(known, recordings, c) for c in late}
        timing = [
            timing_finding(
                c, known, bench, again, rest[c.trial.candidate.cause], baseline.held, settings, reference
            )
            for c in late
        ]
        left = {f.cause: f.parameters["delay"] for f in timing}
        notes = [
            _own_delay(c, unknown)
            for c in late
            if abs(left[c.trial.candidate.cause].value) <= unknown[c.trial.candidate.cause]
        ]
        # A claim of which nothing is left once all else is in the model was something else.
        timing = [
            f for f in timing if abs(left[f.cause].value) > max(unknown[f.cause], 3.0 * left[f.cause].std)
        ]
        again.claims = [c for c in again.claims if c.trial.candidate.effect.side != "timing"]
        selection = again
    for _ in range(_REPEATS):
        better = again_with(bench, selection, settings, causes)
        if better is None:
            break
        bench = better
        selection = select(bench.dictionary, bench.evidence, settings, null)
        selection.claims = [c for c in selection.claims if c.trial.candidate.effect.side != "timing"]
    found = conclude(
        bench,
        selection,
        timing,
        loss,
        settings,
        reference,
        model,
        simulate,
        sessions,
        test,
        baseline if timing else None,
    )
    return replace(found, notes=(*found.notes, *notes)) if notes else found


def _made(claim: Claim) -> float:
    """Delay [s] that a claim of a late channel means."""
    return float(claim.trial.shape["delay"]) * float(claim.score.coefficients[0])


def _in_time(selection: Selection) -> list[Rows]:
    """Columns of the tolerated deviations but delays."""
    named = zip(selection.nuisance, selection.nuisance_rows, strict=True)
    return [rows for name, rows in named if "delay" not in name]


def _rest(bench: Bench, selection: Selection, cause: str) -> tuple[float, float]:
    """How much later a channel still is, and its standard deviation [s], beside all claims but slow turning, which a
    late motor resembles.
    """
    side = cause.partition("_")[0]
    alike = (cause, "presliding_hysteresis")
    taken = [c.trial.rows for c in selection.claims if c.trial.candidate.cause not in alike]
    tolerated = [
        rows
        for name, rows in zip(selection.nuisance, selection.nuisance_rows, strict=True)
        if not name.startswith(f"{side} delay")
    ]
    bench.evidence.replace([*taken, *tolerated])
    columns = bench.dictionary.rows(Candidate(EFFECTS[cause], -1), {"delay": _UNIT_S})
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
        motor_delay_s=arm.motor_delay_s + amounts.get("motor_torque_delay", 0.0),
        joint_delay_s=arm.joint_delay_s + amounts.get("joint_torque_delay", 0.0),
    )


def _unknown_delay(known: Arm, recordings: Sequence[Recording], claim: Claim) -> float:
    """Delay [s] up to which a late channel may be what the arm is like, 0 where a healthy arm told what it is.

    A motor torque that is published by another clock than the positions waits for a tick of its own and for the
    next packet: that much is a property of the controller's program, and no fault that could be told from it.
    """
    if known.encoder_known or claim.trial.candidate.cause != "motor_torque_delay":
        return 0.0
    stretches = [s for r in recordings for s in r.stretches if len(s.motor_time) > 1]
    own = max(float(np.median(np.diff(s.motor_time))) for s in stretches)
    positions = max(float(np.median(np.diff(s.time))) for s in stretches)
    return own + positions if own > 1.5 * positions else 0.0


def _own_delay(claim: Claim, unknown: Mapping[str, float]) -> str:
    made = _made(claim)
    limit = unknown[claim.trial.candidate.cause]
    return (
        f"motor torques come {1e3 * made:.1f} ms after the positions, which was corrected; without a reference "
        f"nobody knows how late they are when all is well, so less than {1e3 * limit:.0f} ms, a sample of each "
        "channel, is no finding"
    )


def _with_hope(
    bench: Bench,
    selection: Selection,
    settings: DiagnosisSettings,
    causes: Sequence[str] | None,
    null: Null | None,
) -> tuple[Bench, Selection]:
    """Selection with the noise that the best candidate leaves, where that carries a claim; else the one given."""
    hope = hopeful(bench.dictionary, bench.evidence, settings)
    quieter = None if hope is None else again_with(bench, hope, settings, causes)
    if quieter is None:
        return bench, selection
    again = select(quieter.dictionary, quieter.evidence, settings, null)
    return (quieter, again) if again.claims else (bench, selection)


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
    padded = evidence.padded(bench.dictionary.rows(claim.trial.candidate, {"delay": _UNIT_S}))
    if len(padded) < _MOST_ALONE:
        return True
    loudest = max(padded, key=lambda key: evidence.score({key: padded[key]}).fitted)
    delay, std = _delay_of(
        evidence.score({key: columns for key, columns in padded.items() if key != loudest})
    )
    made = _made(claim)
    return abs(delay - made) < 0.5 * abs(made) + 4.0 * std
