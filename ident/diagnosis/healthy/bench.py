"""The bench of a diagnosis: rows, noise and evidence of the nominal arm for given sessions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ident.diagnosis.causes.candidates import Dictionary, Trial
from ident.diagnosis.causes.selection import Selection
from ident.diagnosis.causes.tolerances import Deviation, gain_rows
from ident.diagnosis.gain.evidence import Evidence
from ident.diagnosis.gain.fitted_rows import FittedRows
from ident.diagnosis.gain.products import Floats
from ident.diagnosis.healthy.reference import Reference, joint_of, symbol_of
from ident.diagnosis.rows.noise import misfit, noise_floor, repeatability
from ident.diagnosis.rows.nominal import Nominal, structure_of
from ident.diagnosis.rows.nominal_arm import STATED_WITHIN, NominalArm
from ident.diagnosis.rows.recording import SessionRecord
from ident.diagnosis.settings import DiagnosisSettings
from ident.dynamics.kinematics import Chain
from ident.dynamics.known_arm import known_arm
from ident.dynamics.structure import Coupling, Side
from ident.effects import DELAYS, ELASTICITY, PRESLIDING, Shape
from ident.estimators.physical import cad_prior, lacking_bodies
from ident.rows.filters import SignalSettings

_BySide = dict[str, Floats]
_SLOW_S = 0.1
# Sides of the parameters of friction in units of torque.
_BORNE: dict[str, Side] = {"Fcl": "joint", "offl": "joint", "Fcm": "motor", "offm": "motor"}
# Standard deviation of a parameter that neither rows nor a healthy arm tell: beyond those of any arm [SI units].
_ANYTHING = 1e3
# Largest relative change of a compliance in a step.
_LARGEST_STEP = 0.35
_FACTORS = (0.5, 0.7, 1.0, 1.4)

# Largest noise beside the claims, over that before: the law of a cause is coarse, and a healthy arm's noise is known.
_LOUDER = 2.0

UNSURE = 0.5
"""Relative standard deviation of a compliance that is known within a factor of two."""


@dataclass(frozen=True, eq=False)
class ArmData:
    """Data from the arm's description: stiffness (n,) [Nm/rad] and gear ratio (n,), None where unknown, and pairs of
    joints with coupled drives."""

    stiffness: Floats | None = None
    gear_ratio: Floats | None = None
    couplings: tuple[Coupling, ...] = ()

    @classmethod
    def of(cls, chain: Chain) -> ArmData:
        """The data of the default arm file, if its joints are those of the chain, as the commands take them."""
        arm = known_arm(chain)
        return cls() if arm is None else cls(arm.stiffness, arm.gear_ratio.astype(float))


@dataclass(eq=False)
class DiagnosisBench:
    """The nominal arm with its evidence and dictionary. repeatable : noise is known from repeated periods.
    compliance_std : (n,) of a fitted compliance by these sessions alone [rad/Nm], infinite where none was fitted.
    """

    nominal: Nominal
    evidence: Evidence
    dictionary: Dictionary
    repeatable: bool
    compliance_std: Floats | None = None


def known_drives(data: ArmData | None, reference: Reference | None) -> ArmData:
    """The arm's data with the gear ratios and couplings that it was commissioned with."""
    data = data or ArmData()
    if reference is None:
        return data
    return replace(
        data,
        gear_ratio=data.gear_ratio if reference.gear_ratio is None else reference.gear_ratio,
        couplings=reference.model.structure.couplings or data.couplings,
    )


def nominal_arm(
    chain: Chain, data: ArmData | None, reference: Reference | None, signals: SignalSettings | None = None
) -> NominalArm:
    """The nominal arm from a reference, else from the arm's description.

    signals : of the rows. Where they take the links back from the positions of the motors, their stiffness is the arm's
    and the rows are those of encoders at the links.
    """
    data = known_drives(data, reference)
    n = chain.n
    ratio = np.ones(n) if data.gear_ratio is None else np.asarray(data.gear_ratio, dtype=float)
    compliance = np.zeros(n) if data.stiffness is None else 1.0 / np.asarray(data.stiffness, dtype=float)
    if reference is not None and len(reference.compliance) == n:
        return NominalArm(
            chain,
            reference.compliance,
            ratio,
            reference.motor_delay_s,
            reference.joint_delay_s,
            reference.encoder,
            encoder_known=True,
            presliding=reference.presliding,
            far=reference.far,
            far_share=reference.far_share,
            gain_std=reference.gain_std,
            compliance_std=reference.compliance_std,
            couplings=data.couplings,
            healthy=tuple(e for e in reference.model.effects if e["cause"] != PRESLIDING.cause),
        )
    if signals is not None and signals.takes_links_back:
        compliance = 1.0 / np.array(signals.stiffness_nm_rad)
    return NominalArm(chain, compliance, ratio, couplings=data.couplings, stated=compliance)


def prepare_bench(
    arm: NominalArm,
    recordings: Sequence[SessionRecord],
    settings: DiagnosisSettings,
    reference: Reference | None,
    causes: Sequence[str] | None,
    *,
    fit_compliance: bool,
) -> DiagnosisBench:
    """Rows, noise and evidence of the nominal arm, its stiffness fitted where nothing better is known."""
    # A fitted arm is near enough, and scaled again in each round it would lose the description.
    elastic = fit_compliance and not settings.signals.takes_links_back and np.any(arm.anchor > 0.0)
    as_described = np.array_equal(arm.compliance, arm.anchor) or not arm.compliance.any()
    # One torque alone does not tell a twist from friction and inertia.
    fitted = elastic and len({side for one in recordings for side in one.sides}) == 2
    if fitted and arm.encoder == "motor" and as_described:
        arm = _roughly_stiff(arm, recordings, settings, reference)
    structure, base = structure_of(arm, recordings)
    nominal = Nominal(arm, recordings, settings, structure, base)
    prior = _drawn(nominal) if reference is None else reference.prior(base, nominal.masses)
    # Predictions of the second round include the reference; a third changes nothing.
    rounds = 3 if fitted else 2 if reference is not None else 1
    # These days alone come first, but for what only a channel left out would tell.
    whole = all(bool(np.any(rows.valid, axis=0)[nominal.moving].all()) for rows in nominal.rows.values())
    if prior is not None and not whole:
        unknown = np.diag(prior[0]) <= 0.0
        prior = prior[0] + np.diag(np.where(unknown, _ANYTHING**-2.0, 0.0)), prior[1]
    evidence, repeatable = _evidence(nominal, settings, None if reference is not None and whole else prior)
    std: Floats | None = None
    for _ in range(rounds):
        nominal.refine(evidence.full.values[: len(base)])
        evidence, repeatable = _evidence(nominal, settings, prior, reference, evidence)
        if fitted:
            change, std = _compliance_step(nominal, evidence, arm)
            if np.all(np.abs(change) < 0.03 * arm.compliance):
                break
            nominal.arm = replace(nominal.arm, compliance=nominal.arm.compliance + change)
    return DiagnosisBench(nominal, evidence, Dictionary(nominal, evidence, causes), repeatable, std)


def _drawn(nominal: Nominal) -> tuple[Floats, Floats]:
    """Precision (p, p) and values (p,) of the base parameters from the arm's drawing, where it has inertia.

    Coulomb friction and offsets are within the torque that a joint bears. A joint that never reverses shows only their
    sum.
    """
    base = nominal.base
    precision, mean = np.zeros((len(base), len(base))), np.zeros(len(base))
    if not lacking_bodies(base.structure.chain):
        prior = cad_prior(base).prior("pullback")
        precision, mean = prior.precision.copy(), prior.mean
    for k, name in enumerate(base.names):
        side = _BORNE.get(symbol_of(name))
        if side is None:
            continue
        rows, joint = nominal.rows.get(side) or next(iter(nominal.rows.values())), joint_of(name)
        torque = rows.target[rows.valid[:, joint], joint]
        if np.any(torque):
            precision[k, k] += 1.0 / float(np.mean(torque**2))
    return precision, mean


def _evidence(
    nominal: Nominal,
    settings: DiagnosisSettings,
    prior: tuple[Floats, Floats] | None,
    healthy: Reference | None = None,
    before: Evidence | None = None,
) -> tuple[Evidence, bool]:
    """Evidence with the noise of a first fit, and no more than on the `healthy` arm. Without one the prior keeps base
    parameters with weak excitation near the drawing; repeated periods make their uncertainty known, so it is left out.
    before : with other predictions of the same arm.
    """
    compared = healthy is not None
    one = {side: np.ones(nominal.arm.chain.n) for side in nominal.rows}
    rows = FittedRows(nominal, settings, None if before is None else before.fitted_rows)
    first = Evidence(nominal, settings, one, one, fitted_rows=rows)
    if compared and len(nominal.rows) == 2:
        # Gains of other days are no noise.
        first.replace(list(gain_rows(Dictionary(nominal, first, ())).values()))
    sigma, inflation, floor, repeatable = _noise(nominal, first.residuals(), compared=compared)
    if healthy is not None:
        # A strong cause is no noise.
        for side in sigma.keys() & healthy.correlated.keys():
            quiet = healthy.noise[side] ** 2 * healthy.correlated[side] < sigma[side] ** 2 * inflation[side]
            sigma[side] = np.where(quiet, healthy.noise[side], sigma[side])
            inflation[side] = np.where(quiet, healthy.correlated[side], inflation[side])
    if repeatable and not compared:
        prior = None
    found = Evidence(
        nominal, settings, sigma, inflation, prior, compared=compared, floor=floor, fitted_rows=rows
    )
    return found, repeatable


def _noise(
    nominal: Nominal, residual: Mapping[str, Floats], *, compared: bool
) -> tuple[_BySide, _BySide, _BySide, bool]:
    """By side, (n,): noise of a row [Nm], its variance inflation, and its repeatability [Nm] from periods, else from
    sessions with the same motion, else from the residual; and whether periods tell it.

    compared : with a healthy arm. Then the noise is the residual, for what its model lacks differs from motion to
    motion.
    """
    periods = {r.number: (r.start_s, r.period_s) for r in nominal.recordings}
    sigma, inflation, floor, known = {}, {}, {}, True
    for side, rows in nominal.rows.items():
        sigma[side], inflation[side], repeatable = noise_floor(rows, residual[side], periods)
        floor[side] = np.where(np.isfinite(residual[side]).any(axis=0), sigma[side], np.nan)
        if not repeatable:
            between = repeatability(nominal.recordings, rows, residual[side])
            floor[side] = np.where(np.isfinite(between), between, floor[side])
        known &= repeatable
        if compared and repeatable:
            sigma[side], inflation[side] = misfit(rows, residual[side])
    return sigma, inflation, floor, known


def _roughly_stiff(
    arm: NominalArm,
    recordings: Sequence[SessionRecord],
    settings: DiagnosisSettings,
    reference: Reference | None,
) -> NominalArm:
    """The arm with its compliance times the factor of the best fit, as a start near enough for derivatives."""
    wider = np.log(arm.within) / np.log(STATED_WITHIN)
    tried = [replace(arm, compliance=factor**wider * arm.anchor, stated=arm.anchor) for factor in _FACTORS]
    misfits = [
        prepare_bench(one, recordings, settings, reference, (), fit_compliance=False).evidence.chi_square
        for one in tried
    ]
    return tried[int(np.argmin(misfits))]


def _compliance_step(nominal: Nominal, evidence: Evidence, arm: NominalArm) -> tuple[Floats, Floats]:
    """Gauss-Newton step (n,) of the joints' compliance, and their standard deviations by these rows alone. With
    encoders at the links, the twist of a joint shows in its own motor row alone; with encoders at the motors it moves
    all links."""
    if nominal.arm.encoder == "motor":
        return _common_compliance_step(nominal, evidence, arm)
    here, step, known = nominal.arm.compliance, np.zeros(arm.chain.n), np.full(arm.chain.n, np.inf)
    most = arm.largest_compliance
    dictionary = Dictionary(nominal, evidence, [ELASTICITY.cause])
    for candidate in dictionary.candidates:
        rows = dictionary.rows(candidate, ELASTICITY.at_encoder("link"))
        score = evidence.score(rows)
        j = candidate.joint
        value, std = float(score.coefficients[0]), float(np.sqrt(score.covariance[0, 0]))
        known[j] = std
        if abs(value) > 3.0 * std:
            step[j] = np.clip(here[j] + value, 0.0, most[j]) - here[j]
    return step, known


def _common_compliance_step(nominal: Nominal, evidence: Evidence, arm: NominalArm) -> tuple[Floats, Floats]:
    """Step (n,) of all joints' compliance and their standard deviations, beside the channels' delays: at most a third
    of each, and within a factor `within` of the description's, which decides where a joint hardly bends."""
    here, step, known = nominal.arm.compliance, np.zeros(arm.chain.n), np.full(arm.chain.n, np.inf)
    dictionary = Dictionary(nominal, evidence, [e.cause for e in (ELASTICITY, *DELAYS.values())])
    bent = [c for c in dictionary.candidates if c.joint >= 0 and here[c.joint] > 0.0]
    late = [c for c in dictionary.candidates if c.joint < 0]
    delays = [dictionary.rows(c, Shape(delay=1e-3)) for c in late]
    with evidence.beside([*delays, *(dictionary.rows(c, ELASTICITY.at_encoder("motor")) for c in bent)]):
        place = evidence.base_count + len(late)
        change, covariance = evidence.full.values[place:], evidence.covariance()[place:, place:]
    joints = [c.joint for c in bent]
    stated = arm.anchor[joints]
    precision = np.diag((UNSURE * arm.within / STATED_WITHIN * stated) ** -2.0)
    information = np.linalg.inv(covariance + np.diag(1e-12 * np.diag(covariance) + 1e-30))
    pull = information @ change + precision @ (stated - here[joints])
    found = np.linalg.solve(information + precision, pull)
    found = np.clip(found, -_LARGEST_STEP * here[joints], _LARGEST_STEP * here[joints])
    known[joints] = np.sqrt(np.diag(covariance))
    largest = arm.largest_compliance[joints]
    step[joints] = np.clip(here[joints] + found, stated / arm.within, largest) - here[joints]
    return step, known


def again_with(
    bench: DiagnosisBench, selection: Selection, settings: DiagnosisSettings, causes: Sequence[str] | None
) -> DiagnosisBench | None:
    """The bench with predictions and noise floor after the claims; None without claims. Effects of the load depend on
    a torque predicted by the base parameters, wrong before the effects were in the model."""
    if not selection.claims:
        return None
    nominal, evidence = bench.nominal, bench.evidence
    evidence.replace([*(c.trial.rows for c in selection.claims), *selection.nuisance_rows])
    new_sigma, new_inflation, floor, _ = _noise(nominal, evidence.residuals(), compared=evidence.compared)
    sigma = {side: value.copy() for side, value in evidence.sigma.items()}
    inflation = {side: value.copy() for side, value in evidence.variance_inflation.items()}
    # Rows without a claim keep their noise: the null was counted in it. What claims leave of a fault is no noise.
    for side, joint in {key for c in selection.claims for key in c.trial.rows}:
        most = _LOUDER**2 * sigma[side][joint] ** 2 * inflation[side][joint]
        sigma[side][joint] = min(new_sigma[side][joint], _LOUDER * sigma[side][joint])
        inflation[side][joint] = min(new_inflation[side][joint], most / sigma[side][joint] ** 2)
    nominal.refine(evidence.full.values[: evidence.base_count])
    again = Evidence(
        nominal,
        settings,
        sigma,
        inflation,
        evidence.prior,
        compared=evidence.compared,
        floor=floor,
        fitted_rows=FittedRows(nominal, settings, evidence.fitted_rows),
    )
    return DiagnosisBench(nominal, again, Dictionary(nominal, again, causes), bench.repeatable)


def slow_delay(bench: DiagnosisBench, trial: Trial) -> tuple[float, float]:
    """Delay [s] of a trial of a late channel, and its standard deviation, from means over a tenth of a second. A late
    channel is late at every frequency; a vibration missing in the positions vanishes in the means."""
    nominal = bench.nominal
    settings = replace(nominal.settings, bin_s=_SLOW_S)
    slow = replace(nominal, settings=settings)
    evidence, _ = _evidence(slow, settings, None)
    dictionary = Dictionary(slow, evidence, [trial.candidate.cause])
    rows = dictionary.rows(trial.candidate, trial.shape)
    score = evidence.score(rows)
    delay = float(trial.shape["delay"])
    return delay * float(score.coefficients[0]), abs(delay) * float(np.sqrt(score.covariance[0, 0]))


def mean_delay(deviations: Sequence[Deviation], side: str) -> tuple[float, float]:
    """Weighted mean of the tolerated delays of a side, and its standard deviation [s]."""
    entries = [one for one in deviations if one.tolerance.channel == side]
    if not entries:
        return 0.0, 2e-4
    weights = [1.0 / max(one.std, 1e-6) ** 2 for one in entries]
    mean = sum(w * one.value for w, one in zip(weights, entries, strict=True)) / sum(weights)
    return float(mean), float(1.0 / np.sqrt(sum(weights)))
