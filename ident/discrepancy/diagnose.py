"""From sessions to a diagnosis: prepare, fit, select, check what is left, extend, measure."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from fri.errors import DataError
from ident.discrepancy.candidates import Candidate, Dictionary, Trial
from ident.discrepancy.evidence import Evidence, Floats, Rows, noise_floor
from ident.discrepancy.gain import HeldOut, held_out, interval
from ident.discrepancy.hygiene import SampleLoss, sample_loss
from ident.discrepancy.nominal import Arm, Nominal, structure_of
from ident.discrepancy.probes import Remainder, find_remainders
from ident.discrepancy.recording import Recording, record
from ident.discrepancy.reference import Reference
from ident.discrepancy.result import Diagnosis, Evident, Finding, SimulationError, Unexplained, Value
from ident.discrepancy.selection import Claim, Selection, select
from ident.discrepancy.settings import DiagnosisSettings
from ident.effects import EFFECTS
from ident.kinematics import Chain
from ident.model import DynamicModel

if TYPE_CHECKING:
    from lwr_driver.session import Session

__all__ = ["ArmData", "Simulate", "commission", "diagnose"]

log = logging.getLogger(__name__)

Simulate = Callable[[DynamicModel, "Sequence[Session]"], SimulationError | None]
"""Replays sessions with a model and says how far off it is; what the runner gives."""

_DOUBT = 0.2
_REPEATS = 2


@dataclass(frozen=True, eq=False)
class ArmData:
    """What the arm's description knows: stiffness (n,) [Nm/rad] and gear ratio (n,); None where unknown."""

    stiffness: Floats | None = None
    gear_ratio: Floats | None = None


@dataclass(eq=False)
class _Bench:
    """The nominal arm with its evidence and dictionary."""

    nominal: Nominal
    evidence: Evidence
    dictionary: Dictionary
    told: bool


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
    _every_joint_moves(recordings, chain)
    loss = sample_loss(list(sessions))
    known = _arm(chain, arm, reference)
    bench = _bench(known, recordings, settings, reference, causes, fit_compliance=reference is None)
    null = reference.null if reference is not None else None
    timing: list[Finding] = []
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
        bench = _bench(
            replace(shifted, compliance=bench.nominal.arm.compliance),
            recordings,
            settings,
            reference,
            causes,
            fit_compliance=False,
        )
        again = select(bench.dictionary, bench.evidence, settings, null)
        timing = [_timing(c, known, bench, again, before, settings) for c in late]
        selection = replace_selection(
            again, [c for c in again.claims if c.trial.candidate.effect.side != "timing"]
        )
    for _ in range(_REPEATS):
        sharper = _sharper(bench, selection)
        if sharper is None:
            break
        bench.evidence = Evidence(bench.nominal, settings, *sharper, prior=bench.evidence.prior)
        bench.dictionary = Dictionary(bench.nominal, bench.evidence, causes)
        selection = select(bench.dictionary, bench.evidence, settings, null)
        selection.claims = [c for c in selection.claims if c.trial.candidate.effect.side != "timing"]
    return _conclude(bench, selection, timing, loss, settings, reference, model, simulate, sessions, test)


def replace_selection(selection: Selection, claims: list[Claim]) -> Selection:
    """The same selection with other claims."""
    return Selection(claims, selection.nuisance, selection.scores, selection.nuisance_rows)


def commission(
    sets: Sequence[Sequence[Session]],
    chain: Chain,
    *,
    arm: ArmData | None = None,
    settings: DiagnosisSettings | None = None,
    robot: str = "",
) -> Reference:
    """The healthy arm from sets of sessions, each as a later diagnosis will get them.

    The model and its healthy properties come from all sessions together; the null, the largest gain of each
    candidate, from each set by itself. Raises DataError for sessions that cannot be used.
    """
    settings = settings or DiagnosisSettings()
    everything = sorted((s for part in sets for s in part), key=lambda s: s.start)
    if not everything:
        raise DataError("no session given; name at least one healthy session")
    recordings = [record(s, k, chain, settings) for k, s in enumerate(everything)]
    _every_joint_moves(recordings, chain)
    bench = _bench(_arm(chain, arm, None), recordings, settings, None, None, fit_compliance=True)
    selection = select(bench.dictionary, bench.evidence, replace(settings, rounds=1), None)
    evidence = bench.evidence
    evidence.replace(selection.nuisance_rows)
    p = evidence.base_count
    values = evidence.full.values[:p]
    nominal = bench.nominal
    model = DynamicModel(
        robot or everything[0].metadata.get("robot", "") or "arm",
        nominal.structure,
        nominal.base.names,
        values,
        evidence.covariance()[:p, :p],
        nominal.base,
        {"sessions": [s.path.name for s in everything]},
    )
    known = replace(
        nominal.arm,
        motor_delay_s=mean_delay(selection.nuisance, "motor")[0],
        joint_delay_s=mean_delay(selection.nuisance, "joint")[0],
    )
    null: dict[tuple[str, int], float] = {}
    for part in sets:
        mine = [record(s, k, chain, settings) for k, s in enumerate(sorted(part, key=lambda s: s.start))]
        own = _bench(known, mine, settings, None, None, fit_compliance=False)
        found = select(own.dictionary, own.evidence, replace(settings, rounds=1), None)
        for key, gain in found.scores.items():
            null[key] = max(null.get(key, 0.0), gain)
    return Reference(
        model,
        known.compliance,
        known.motor_delay_s,
        known.joint_delay_s,
        {side: evidence.sigma[side] for side in evidence.sigma},
        null,
        len(sets),
    )


# ---- preparation ----


def _arm(chain: Chain, data: ArmData | None, reference: Reference | None) -> Arm:
    data = data or ArmData()
    n = chain.n
    ratio = np.ones(n) if data.gear_ratio is None else np.asarray(data.gear_ratio, dtype=float)
    compliance = np.zeros(n) if data.stiffness is None else 1.0 / np.asarray(data.stiffness, dtype=float)
    if reference is not None and len(reference.compliance) == n:
        return Arm(chain, reference.compliance, ratio, reference.motor_delay_s, reference.joint_delay_s)
    return Arm(chain, compliance, ratio)


def _every_joint_moves(recordings: Sequence[Recording], chain: Chain) -> None:
    for joint, name in enumerate(chain.joint_names):
        if not any(np.ptp(s.q[:, joint]) > 0.01 for r in recordings for s in r.stretches):
            raise DataError(
                f"joint {name} never moves by more than 0.01 rad; a diagnosis needs motion of every joint. "
                "Record an excitation, or use a chain in which the joint is fixed"
            )


def _bench(
    arm: Arm,
    recordings: Sequence[Recording],
    settings: DiagnosisSettings,
    reference: Reference | None,
    causes: Sequence[str] | None,
    *,
    fit_compliance: bool,
) -> _Bench:
    """Rows, noise and evidence of the nominal arm, its stiffness fitted where nothing better is known."""
    structure, base = structure_of(arm, recordings)
    nominal = Nominal.of(arm, recordings, settings, structure, base)
    prior = None if reference is None else reference.prior(base)
    rounds = 3 if fit_compliance and np.any(arm.compliance > 0.0) and len(nominal.rows) == 2 else 1
    evidence, _ = _evidence(nominal, settings, None)
    for _ in range(rounds):
        nominal.refine(evidence.full.values[: len(base)])
        evidence, told = _evidence(nominal, settings, prior)
        if rounds > 1:
            change = _compliance_step(nominal, evidence, arm)
            if np.all(np.abs(change) < 0.03 * arm.compliance):
                break
            nominal.arm = replace(nominal.arm, compliance=nominal.arm.compliance + change)
    return _Bench(nominal, evidence, Dictionary(nominal, evidence, causes), told)


def _evidence(
    nominal: Nominal, settings: DiagnosisSettings, prior: tuple[Floats, Floats] | None
) -> tuple[Evidence, bool]:
    """Evidence with the noise floor that a first fit leaves."""
    n = nominal.arm.chain.n
    one = {side: np.ones(n) for side in nominal.rows}
    first = Evidence(nominal, settings, one, one)
    floors = _floors(nominal, first.residuals())
    sigma = {side: floor[0] for side, floor in floors.items()}
    dilution = {side: floor[1] for side, floor in floors.items()}
    return Evidence(nominal, settings, sigma, dilution, prior), all(floor[2] for floor in floors.values())


def _floors(nominal: Nominal, residual: Mapping[str, Floats]) -> dict[str, tuple[Floats, Floats, bool]]:
    periods = {r.number: (r.start_s, r.period_s) for r in nominal.recordings}
    return {side: noise_floor(nominal.rows[side], residual[side], periods) for side in nominal.rows}


def _compliance_step(nominal: Nominal, evidence: Evidence, arm: Arm) -> Floats:
    """Gauss-Newton step (n,) of the joints' compliance from the motor rows."""
    step = np.zeros(nominal.arm.chain.n)
    dictionary = Dictionary(nominal, evidence, ["joint_elasticity"])
    for candidate in dictionary.candidates:
        rows = dictionary.rows(candidate, {"encoder": 0.0})
        score = evidence.score(evidence.padded(rows))
        j = candidate.joint
        value, std = float(score.coefficients[0]), float(np.sqrt(score.covariance[0, 0]))
        if abs(value) > 3.0 * std:
            wanted = nominal.arm.compliance[j] + value
            step[j] = np.clip(wanted, 0.0, 3.0 * arm.compliance[j]) - nominal.arm.compliance[j]
    return step


def _sharper(bench: _Bench, selection: Selection) -> tuple[dict[str, Floats], dict[str, Floats]] | None:
    """Noise floor with the findings taken out, None where it hardly differs from the one that was used."""
    if not selection.claims:
        return None
    evidence = bench.evidence
    evidence.replace([*(c.trial.rows for c in selection.claims), *selection.nuisance_rows])
    floors = _floors(bench.nominal, evidence.residuals())
    sigma = {side: floor[0] for side, floor in floors.items()}
    dilution = {side: floor[1] for side, floor in floors.items()}
    ratio = min(
        float(
            np.min(sigma[side] ** 2 * dilution[side] / (evidence.sigma[side] ** 2 * evidence.dilution[side]))
        )
        for side in sigma
    )
    return (sigma, dilution) if ratio < 0.9 else None


# ---- conclusions ----


def _conclude(
    bench: _Bench,
    selection: Selection,
    timing: list[Finding],
    loss: tuple[SampleLoss, ...],
    settings: DiagnosisSettings,
    reference: Reference | None,
    model: DynamicModel | None,
    simulate: Simulate | None,
    sessions: Sequence[Session],
    test: Sequence[Session],
) -> Diagnosis:
    evidence, nominal = bench.evidence, bench.nominal
    nuisance = selection.nuisance_rows
    before = held_out(evidence, nuisance)
    rows_of = [c.trial.rows for c in selection.claims]
    after = held_out(evidence, [*rows_of, *nuisance])
    kept: list[tuple[Claim, Finding]] = []
    for k, claim in enumerate(selection.claims):
        others = [*(r for i, r in enumerate(rows_of) if i != k), *nuisance]
        without = held_out(evidence, others)
        evidence.replace(others)
        finding = _finding(claim, bench, without, after, settings)
        # An extension that makes the held-out error larger is none.
        if finding.evidence.gain_interval_95[1] > 0.0:
            kept.append((claim, finding))
    claims = [claim for claim, _ in kept]
    evidence.replace([*(c.trial.rows for c in claims), *nuisance])
    after = held_out(evidence, [*(c.trial.rows for c in claims), *nuisance])
    remainders = find_remainders(bench.dictionary, evidence, settings)
    findings = [_doubted(claim, finding, remainders, nominal.arm.chain.n) for claim, finding in kept]
    findings += timing
    if loss:
        findings.append(_loss_finding(loss))
    findings.sort(key=lambda f: -f.gain)
    extended_rms, base_rms = after.rms(), before.rms()
    base_model, extended, changes = _models(bench, claims, nuisance, findings, sessions)
    unexplained = tuple(
        Unexplained(
            r.side,
            r.joint,
            r.depends_on,
            float(extended_rms[r.side][r.joint - 1]),
            float(evidence.sigma[r.side][r.joint - 1]),
        )
        for r in remainders
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
        noise_floor=evidence.sigma,
        rms_base=base_rms,
        rms_extended=extended_rms,
        base_model=base_model,
        extended_model=extended,
        changes=changes,
        scores=selection.scores,
        nuisance=selection.nuisance,
        simulation_base=simulation,
        simulation_extended=extended_simulation,
        notes=_notes(bench, reference),
        residuals={"base": before.residual, "extended": after.residual},
    )


def _finding(
    claim: Claim, bench: _Bench, without: HeldOut, after: HeldOut, settings: DiagnosisSettings
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
    )


def _relative(without: HeldOut, after: HeldOut, key: tuple[str, int]) -> float:
    side, joint = key
    a, b = without.residual[side][:, joint], after.residual[side][:, joint]
    power = np.nanmean(b**2) if np.isfinite(b).any() else 1.0
    return float((np.nanmean(a**2) - power) / power) if np.isfinite(a).any() else 0.0


def _parameters(trial: Trial, bench: _Bench) -> dict[str, Value]:
    """Values with standard deviations; those of the shape from the columns' derivatives."""
    evidence, dictionary = bench.evidence, bench.dictionary
    effect, shape = trial.candidate.effect, dict(trial.shape)
    joint_rows: dict[tuple[str, int], list[Floats]] = {key: [v] for key, v in trial.rows.items()}
    moved = []
    for name in effect.continuous(shape):
        step = 0.02 * abs(shape[name]) or 0.02
        upper = dictionary.rows(trial.candidate, {**shape, name: shape[name] + step})
        lower = dictionary.rows(trial.candidate, {**shape, name: shape[name] - step})
        derivative = {
            key: ((upper.get(key, 0.0) - lower.get(key, 0.0)) / (2.0 * step) @ trial.score.coefficients)[
                :, None
            ]
            for key in trial.rows
        }
        if any(np.any(v) for v in derivative.values()):
            moved.append(name)
            for key, column in derivative.items():
                joint_rows[key].append(column)
    rows: Rows = {key: np.concatenate(parts, axis=1) for key, parts in joint_rows.items()}
    wide = evidence.score(evidence.padded(rows))
    k = len(trial.score.coefficients)
    if np.isfinite(wide.gain) and len(wide.coefficients) == k + len(moved):
        std = np.sqrt(np.maximum(np.diag(wide.covariance), 0.0))
    else:
        std = np.append(np.sqrt(np.maximum(np.diag(trial.score.covariance), 0.0)), np.zeros(len(moved)))
    found = {}
    for parameter, value, s in zip(effect.linear, trial.score.coefficients, std[:k], strict=False):
        if parameter.name not in effect.hidden:
            found[parameter.name] = Value(float(value), float(s), parameter.unit)
    spread = dict(zip(moved, std[k:], strict=True))
    for parameter in effect.shape_parameters:
        if parameter.name in shape:
            found[parameter.name] = Value(
                float(shape[parameter.name]), float(spread.get(parameter.name, 0.0)), parameter.unit
            )
    return found


def _doubted(claim: Claim, finding: Finding, remainders: Sequence[Remainder], joints: int) -> Finding:
    """Less confidence in a name that leaves much in the rows that it explains."""
    mine = set(claim.trial.rows)
    left = sum(r.gain for r in remainders if (r.side, r.joint - 1) in mine)
    if len(mine) > joints:
        left /= 2.0
    if left > _DOUBT * claim.gain:
        return replace(finding, confidence=min(finding.confidence, 0.75 * claim.gain / (claim.gain + left)))
    return finding


def _timing(
    claim: Claim, known: Arm, bench: _Bench, after: Selection, before: HeldOut, settings: DiagnosisSettings
) -> Finding:
    """Finding of a late channel: the shift that was made and what is left of it."""
    candidate = claim.trial.candidate
    side = "motor" if candidate.cause == "motor_torque_delay" else "joint"
    arm = bench.nominal.arm
    made = (
        arm.motor_delay_s - known.motor_delay_s
        if side == "motor"
        else arm.joint_delay_s - known.joint_delay_s
    )
    rest, std = mean_delay(after.nuisance, side)
    now = held_out(bench.evidence, [*(c.trial.rows for c in after.claims), *after.nuisance_rows])
    same = all(now.residual[s].shape == before.residual[s].shape for s in now.residual)
    keys = [(side, j) for j in range(bench.nominal.arm.chain.n)]
    numbers = interval(before, now, keys, settings.seed) if same else (0.0, 0.0, 0.0, 0.0)
    return Finding(
        candidate.cause,
        "timing",
        (),
        {"delay": Value(made + rest, std, "s")},
        Evident(-claim.score.fitted, claim.score.p_value, numbers[0], numbers[1], (numbers[2], numbers[3])),
        claim.confidence,
        tuple((c.cause, c.joints, -g) for c, g in claim.alternatives),
        candidate.effect.tell_apart,
        claim.gain,
    )


def mean_delay(nuisance: Mapping[str, tuple[float, float]], side: str) -> tuple[float, float]:
    """Weighted mean of the delays of a side that were tolerated, and its standard deviation [s]."""
    entries = [value for name, value in nuisance.items() if name.startswith(f"{side} delay")]
    weights = [1.0 / max(std, 1e-6) ** 2 for _, std in entries]
    if not entries:
        return 0.0, 2e-4
    mean = sum(w * value for w, (value, _) in zip(weights, entries, strict=True)) / sum(weights)
    return float(mean), float(1.0 / np.sqrt(sum(weights)))


def _loss_finding(loss: tuple[SampleLoss, ...]) -> Finding:
    worst = loss[0]
    effect = EFFECTS["lost_samples"]
    count = worst.samples + worst.lost
    std = float(np.sqrt(worst.share * (1.0 - worst.share) / count))
    return Finding(
        "lost_samples",
        "timing",
        (),
        {"share": Value(worst.share, std, "1")},
        Evident(-float(count) * worst.share, 1e-12, 0.0, 0.0, (0.0, 0.0)),
        0.99,
        (),
        effect.tell_apart,
        float(worst.lost + worst.repeated),
        mode=f"{worst.lost} lost and {worst.repeated} repeated of {count} {worst.channel} samples in "
        f"{worst.session}",
    )


def _models(
    bench: _Bench,
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
    models = []
    for rows, effects in (
        ([], ()),
        ([c.trial.rows for c in claims], tuple(_entry(f) for f in findings if f.cause != "lost_samples")),
    ):
        evidence.replace([*rows, *nuisance])
        models.append(
            DynamicModel(
                robot,
                nominal.structure,
                nominal.base.names,
                evidence.full.values[:p].copy(),
                evidence.covariance()[:p, :p],
                nominal.base,
                provenance,
                effects,
            )
        )
    base, extended = models
    assert extended.std is not None
    shift = (extended.values - base.values) / np.maximum(extended.std, 1e-300)
    order = np.argsort(-np.abs(shift))[:10]
    changes = {base.names[k]: float(shift[k]) for k in order if abs(shift[k]) > 2.0} if claims else {}
    return base, extended, changes


def _entry(finding: Finding) -> dict[str, Any]:
    """A finding as an entry of a model's effects."""
    return {
        "cause": finding.cause,
        "side": finding.side,
        "joints": list(finding.joints),
        "parameters": {
            name: {"value": v.value, "std": v.std, "unit": v.unit} for name, v in finding.parameters.items()
        },
    }


def _notes(bench: _Bench, reference: Reference | None) -> tuple[str, ...]:
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
            "constant, wear, offsets) cannot be seen; run `lwr-run commission` when the arm is healthy"
        )
    elif bench.evidence.prior is None:
        notes.append(
            "the reference shares no base parameter with these sessions: parameters are not compared"
        )
    if not bench.told:
        notes.append("the motion does not repeat: the noise is taken from neighbouring rows")
    return tuple(notes)


def candidate_name(candidate: Candidate) -> str:
    """Cause and joint in words."""
    return candidate.cause + (f" joint {candidate.joint + 1}" if candidate.joint >= 0 else "")
