"""From sessions to a diagnosis: prepare, fit, select, check what is left, extend, measure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

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
from ident.discrepancy.candidates import Dictionary
from ident.discrepancy.conclusion import Simulate, conclude, timing_finding
from ident.discrepancy.gain import held_out
from ident.discrepancy.hygiene import sample_loss
from ident.discrepancy.recording import record
from ident.discrepancy.reference import Reference
from ident.discrepancy.result import Diagnosis, Finding
from ident.discrepancy.selection import Claim, Null, Selection, hopeful, select
from ident.discrepancy.settings import DiagnosisSettings
from ident.effects import EFFECTS
from ident.kinematics import Chain
from ident.model import DynamicModel

if TYPE_CHECKING:
    from lwr_driver.session import Session

__all__ = ["diagnose"]

_REPEATS = 1


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
    selection = select(bench.dictionary, bench.evidence, settings, null)
    if not bench.told and not selection.claims:
        bench, selection = _with_hope(bench, selection, settings, causes, null)
    late = [c for c in selection.claims if c.trial.candidate.effect.side == "timing"]
    doubtful = [c.trial.candidate.cause for c in late if not _late_at_all_speeds(bench, c)]
    if doubtful:
        causes = [cause for cause in causes or EFFECTS if cause not in doubtful]
        bench.dictionary = Dictionary(bench.nominal, bench.evidence, causes)
        selection = select(bench.dictionary, bench.evidence, settings, null)
        late = [c for c in selection.claims if c.trial.candidate.effect.side == "timing"]
    if late:
        shifted = known
        for claim in late:
            delay = float(claim.trial.shape["delay"]) * float(claim.score.coefficients[0])
            if claim.trial.candidate.cause == "motor_torque_delay":
                shifted = replace(shifted, motor_delay_s=shifted.motor_delay_s + delay)
            else:
                shifted = replace(shifted, joint_delay_s=shifted.joint_delay_s + delay)
        before = held_out(bench.evidence, [])
        bench = prepare_bench(
            replace(shifted, compliance=bench.nominal.arm.compliance),
            recordings,
            settings,
            reference,
            causes,
            fit_compliance=False,
        )
        again = select(bench.dictionary, bench.evidence, settings, null)
        timing = [timing_finding(c, known, bench, again, before, settings) for c in late]
        again.claims = [c for c in again.claims if c.trial.candidate.effect.side != "timing"]
        selection = again
    for _ in range(_REPEATS):
        better = again_with(bench, selection, settings, causes)
        if better is None:
            break
        bench = better
        selection = select(bench.dictionary, bench.evidence, settings, null)
        selection.claims = [c for c in selection.claims if c.trial.candidate.effect.side != "timing"]
    return conclude(bench, selection, timing, loss, settings, reference, model, simulate, sessions, test)


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
    made = float(claim.trial.shape["delay"]) * float(claim.score.coefficients[0])
    slow, std = slow_delay(bench, claim.trial)
    return abs(slow - made) < 0.3 * abs(made) + 4.0 * std and abs(slow) > 0.3 * abs(made)
