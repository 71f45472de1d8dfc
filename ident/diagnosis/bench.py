"""The bench of a diagnosis: rows, noise and evidence of the nominal arm for given sessions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fri.errors import DataError
from ident.diagnosis.candidates import Dictionary, Trial
from ident.diagnosis.evidence import Evidence, Floats
from ident.diagnosis.noise import noise_floor, repeatability
from ident.diagnosis.nominal import TRAVEL_RAD, Arm, Nominal, structure_of
from ident.diagnosis.recording import Recording
from ident.diagnosis.reference import Reference
from ident.diagnosis.selection import Selection
from ident.diagnosis.settings import DiagnosisSettings
from ident.dynamics.base_set import BaseSet
from ident.dynamics.kinematics import Chain
from ident.dynamics.structure import Coupling
from ident.effects import DELAYS, ELASTICITY, Shape
from ident.estimators.physical import cad_prior

__all__ = [
    "ArmData",
    "Bench",
    "every_joint_moves",
    "mean_delay",
    "nominal_arm",
    "prepare_bench",
    "slow_delay",
    "some_joint_moves",
]


_SLOW_S = 0.1
# Relative standard deviation of a stiffness that was read somewhere, and largest relative change in a step.
_UNSURE, _LARGEST_STEP = 0.5, 0.35
_FACTORS = (0.5, 0.7, 1.0, 1.4)


@dataclass(frozen=True, eq=False)
class ArmData:
    """What the arm's description knows: stiffness (n,) [Nm/rad] and gear ratio (n,), None where unknown, and pairs
    of joints whose drives are coupled."""

    stiffness: Floats | None = None
    gear_ratio: Floats | None = None
    couplings: tuple[Coupling, ...] = ()


@dataclass(eq=False)
class Bench:
    """The nominal arm with its evidence and dictionary."""

    nominal: Nominal
    evidence: Evidence
    dictionary: Dictionary
    told: bool


def nominal_arm(chain: Chain, data: ArmData | None, reference: Reference | None) -> Arm:
    """The nominal arm from a reference, else from the arm's description."""
    data = data or ArmData()
    n = chain.n
    ratio = np.ones(n) if data.gear_ratio is None else np.asarray(data.gear_ratio, dtype=float)
    compliance = np.zeros(n) if data.stiffness is None else 1.0 / np.asarray(data.stiffness, dtype=float)
    if reference is not None and len(reference.compliance) == n:
        return Arm(
            chain,
            reference.compliance,
            ratio,
            reference.motor_delay_s,
            reference.joint_delay_s,
            reference.encoder,
            encoder_known=True,
            reach=reference.presliding,
            far=reference.far,
            far_share=reference.far_share,
            couplings=data.couplings,
        )
    return Arm(chain, compliance, ratio, couplings=data.couplings)


def some_joint_moves(recordings: Sequence[Recording]) -> None:
    """Raises DataError where no joint moves in what is fitted."""
    fitted = [s for r in recordings if not r.test for s in r.stretches]
    if not any(np.any(np.ptp(s.q, axis=0) > TRAVEL_RAD) for s in fitted):
        raise DataError(
            f"no joint moves by more than {TRAVEL_RAD} rad; a pose says nothing about what moves. Record an "
            "excitation"
        )


def every_joint_moves(recordings: Sequence[Recording], chain: Chain) -> None:
    """Raises DataError for a joint that never moves."""
    for joint, name in enumerate(chain.joint_names):
        if not any(np.ptp(s.q[:, joint]) > 0.01 for r in recordings for s in r.stretches):
            raise DataError(
                f"joint {name} never moves by more than 0.01 rad; a diagnosis needs motion of every joint. "
                "Record an excitation, or use a chain in which the joint is fixed"
            )


def prepare_bench(
    arm: Arm,
    recordings: Sequence[Recording],
    settings: DiagnosisSettings,
    reference: Reference | None,
    causes: Sequence[str] | None,
    *,
    fit_compliance: bool,
) -> Bench:
    """Rows, noise and evidence of the nominal arm, its stiffness fitted where nothing better is known."""
    if fit_compliance and arm.encoder == "motor" and np.any(arm.compliance > 0.0):
        arm = _roughly_stiff(arm, recordings, settings, reference)
    structure, base = structure_of(arm, recordings)
    nominal = Nominal.of(arm, recordings, settings, structure, base)
    prior = reference.prior(base) if reference is not None else _drawn(base)
    fitted = fit_compliance and np.any(arm.compliance > 0.0) and len(nominal.rows) == 2
    # Predictions of the second round know what the reference knows; a third changes nothing.
    rounds = 3 if fitted else 2 if reference is not None else 1
    compared = reference is not None
    evidence, _ = _evidence(nominal, settings, None if compared else prior, compared=False)
    for _ in range(rounds):
        nominal.refine(evidence.full.values[: len(base)])
        evidence, told = _evidence(nominal, settings, prior, compared=compared)
        if fitted:
            change = _compliance_step(nominal, evidence, arm)
            if np.all(np.abs(change) < 0.03 * arm.compliance):
                break
            nominal.arm = replace(nominal.arm, compliance=nominal.arm.compliance + change)
    return Bench(nominal, evidence, Dictionary(nominal, evidence, causes), told)


def _drawn(base: BaseSet) -> tuple[Floats, Floats] | None:
    """Precision (p, p) and values (p,) of the base parameters as the arm was drawn; None without its inertia."""
    if base.structure.chain.urdf is None:
        return None
    prior = cad_prior(base).prior("pullback")
    return prior.precision, prior.mean


def _evidence(
    nominal: Nominal,
    settings: DiagnosisSettings,
    prior: tuple[Floats, Floats] | None,
    *,
    compared: bool = False,
) -> tuple[Evidence, bool]:
    """Evidence with the noise floor that a first fit leaves.

    A prior that is not `compared` keeps what the motion hardly excites near the drawing; where the excitation
    repeats, the data know what they do not know, and it is left out.
    """
    n = nominal.arm.chain.n
    one = {side: np.ones(n) for side in nominal.rows}
    first = Evidence(nominal, settings, one, one)
    floors = _floors(nominal, first.residuals())
    sigma = {side: floor[0] for side, floor in floors.items()}
    dilution = {side: floor[1] for side, floor in floors.items()}
    told = all(floor[2] for floor in floors.values())
    if told and not compared:
        prior = None
    floor = _repeated(nominal, first.residuals(), floors)
    return Evidence(nominal, settings, sigma, dilution, prior, compared=compared, floor=floor), told


def _repeated(
    nominal: Nominal, residual: Mapping[str, Floats], floors: Mapping[str, tuple[Floats, Floats, bool]]
) -> dict[str, Floats]:
    """What repeats of a motion differ by, within a session or from one to another, else what the model leaves."""
    found = {}
    for side, (sigma, _, told) in floors.items():
        between = np.full(len(sigma), np.nan)
        if not told:
            between = repeatability(nominal.recordings, nominal.rows[side], residual[side])[0]
        seen = np.isfinite(residual[side]).any(axis=0)
        found[side] = np.where(np.isfinite(between), between, np.where(seen, sigma, np.nan))
    return found


def _floors(nominal: Nominal, residual: Mapping[str, Floats]) -> dict[str, tuple[Floats, Floats, bool]]:
    periods = {r.number: (r.start_s, r.period_s) for r in nominal.recordings}
    return {side: noise_floor(nominal.rows[side], residual[side], periods) for side in nominal.rows}


def _roughly_stiff(
    arm: Arm, recordings: Sequence[Recording], settings: DiagnosisSettings, reference: Reference | None
) -> Arm:
    """The arm with its compliance times the factor that suits the motions best, for steps to begin with.

    Links that ring with another period than the model's are out of phase with it after a few, and no derivative
    knows which way to go.
    """
    tried = [replace(arm, compliance=factor * arm.compliance) for factor in _FACTORS]
    misfits = [
        prepare_bench(one, recordings, settings, reference, (), fit_compliance=False).evidence.chi_square
        for one in tried
    ]
    return tried[int(np.argmin(misfits))]


def _compliance_step(nominal: Nominal, evidence: Evidence, arm: Arm) -> Floats:
    """Gauss-Newton step (n,) of the joints' compliance.

    With the encoders at the links the twist of a joint shows in its own motor row alone; with the encoders at the
    motors it moves all links.
    """
    if nominal.arm.encoder == "motor":
        return _common_compliance_step(nominal, evidence, arm)
    step = np.zeros(nominal.arm.chain.n)
    dictionary = Dictionary(nominal, evidence, [ELASTICITY.cause])
    for candidate in dictionary.candidates:
        rows = dictionary.rows(candidate, ELASTICITY.at_encoder("link"))
        score = evidence.score(evidence.padded(rows))
        j = candidate.joint
        value, std = float(score.coefficients[0]), float(np.sqrt(score.covariance[0, 0]))
        if abs(value) > 3.0 * std:
            wanted = nominal.arm.compliance[j] + value
            step[j] = np.clip(wanted, 0.0, 3.0 * arm.compliance[j]) - nominal.arm.compliance[j]
    return step


def _common_compliance_step(nominal: Nominal, evidence: Evidence, arm: Arm) -> Floats:
    """Step (n,) of all joints' compliance at a time, beside the channels' delays, at most a third of each.

    The description's stiffness counts as known to a factor of about two: it decides where a motion hardly bends a
    joint, and nowhere else.
    """
    here, step = nominal.arm.compliance, np.zeros(nominal.arm.chain.n)
    dictionary = Dictionary(nominal, evidence, [e.cause for e in (ELASTICITY, *DELAYS.values())])
    bent = [c for c in dictionary.candidates if c.joint >= 0 and here[c.joint] > 0.0]
    late = [c for c in dictionary.candidates if c.joint < 0]
    kept = list(evidence.extra)
    evidence.replace(
        [
            *(dictionary.rows(c, Shape(delay=1e-3)) for c in late),
            *(dictionary.rows(c, ELASTICITY.at_encoder("motor")) for c in bent),
        ]
    )
    place = evidence.base_count + len(late)
    change, covariance = evidence.full.values[place:], evidence.covariance()[place:, place:]
    evidence.replace(kept)
    joints = [c.joint for c in bent]
    doubt = np.diag((_UNSURE * arm.compliance[joints]) ** -2.0)
    information = np.linalg.inv(covariance + np.diag(1e-12 * np.diag(covariance) + 1e-30))
    pull = information @ change + doubt @ (arm.compliance[joints] - here[joints])
    found = np.linalg.solve(information + doubt, pull)
    step[joints] = np.clip(found, -_LARGEST_STEP * here[joints], _LARGEST_STEP * here[joints])
    return step


def again_with(
    bench: Bench, selection: Selection, settings: DiagnosisSettings, causes: Sequence[str] | None
) -> Bench | None:
    """The bench with predictions and noise floor that know of the claims; None without any.

    The torque that effects of the load depend on is predicted by the base parameters, and these were wrong
    while the effects were not in the model.
    """
    if not selection.claims:
        return None
    nominal, evidence = bench.nominal, bench.evidence
    evidence.replace([*(c.trial.rows for c in selection.claims), *selection.nuisance_rows])
    left = evidence.residuals()
    floors = _floors(nominal, left)
    repeated = _repeated(nominal, left, floors)
    sigma = {side: value.copy() for side, value in evidence.sigma.items()}
    dilution = {side: value.copy() for side, value in evidence.dilution.items()}
    # Where nothing was claimed the noise stays what it was: the null was counted in it.
    for side, joint in {key for c in selection.claims for key in c.trial.rows}:
        sigma[side][joint], dilution[side][joint] = floors[side][0][joint], floors[side][1][joint]
    nominal.refine(evidence.full.values[: evidence.base_count])
    again = Evidence(
        nominal,
        settings,
        sigma,
        dilution,
        prior=evidence.prior,
        compared=evidence.compared,
        floor=repeated,
    )
    return Bench(nominal, again, Dictionary(nominal, again, causes), bench.told)


def slow_delay(bench: Bench, trial: Trial) -> tuple[float, float]:
    """Delay [s] of a trial of a late channel, and its standard deviation, from means over a tenth of a second.

    A late channel is late at every frequency; a vibration that the positions do not show is not there.
    """
    nominal = bench.nominal
    slow = Nominal(
        nominal.arm,
        nominal.recordings,
        replace(nominal.settings, bin_s=_SLOW_S),
        nominal.structure,
        nominal.base,
        nominal.motions,
    )
    slow.make_rows()
    evidence, _ = _evidence(slow, slow.settings, None)
    dictionary = Dictionary(slow, evidence, [trial.candidate.cause])
    rows = dictionary.rows(trial.candidate, trial.shape)
    score = evidence.score(evidence.padded(rows))
    delay = float(trial.shape["delay"])
    return delay * float(score.coefficients[0]), abs(delay) * float(np.sqrt(score.covariance[0, 0]))


def mean_delay(nuisance: Mapping[str, tuple[float, float]], side: str) -> tuple[float, float]:
    """Weighted mean of the delays of a side that were tolerated, and its standard deviation [s]."""
    entries = [value for name, value in nuisance.items() if name.startswith(f"{side} delay")]
    weights = [1.0 / max(std, 1e-6) ** 2 for _, std in entries]
    if not entries:
        return 0.0, 2e-4
    mean = sum(w * value for w, (value, _) in zip(weights, entries, strict=True)) / sum(weights)
    return float(mean), float(1.0 / np.sqrt(sum(weights)))
