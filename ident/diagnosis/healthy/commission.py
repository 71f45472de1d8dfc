"""A healthy-arm baseline from sets of sessions, each with the sessions of a later diagnosis."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from fri.errors import ConfigurationError, DataError
from ident.diagnosis.causes.probes import remainder_gains
from ident.diagnosis.causes.selection import gains, select
from ident.diagnosis.causes.tolerances import gain_rows
from ident.diagnosis.causes.usual_sizes import scores, usual_sizes
from ident.diagnosis.gain.held_out import held_out
from ident.diagnosis.gain.products import Floats, Rows
from ident.diagnosis.healthy.bench import (
    UNSURE,
    ArmData,
    DiagnosisBench,
    mean_delay,
    nominal_arm,
    prepare_bench,
)
from ident.diagnosis.healthy.channel_delays import CHANNELS, channel_delays, common_delays, mean_of
from ident.diagnosis.healthy.character import character
from ident.diagnosis.healthy.day_spread import compliance_std, delay_std, gain_std, habit, largest_left
from ident.diagnosis.healthy.presliding import SlowTurns, presliding_length, slow_turns, with_far_presliding
from ident.diagnosis.healthy.reference import (
    Reference,
    shared,
    unsure,
)
from ident.diagnosis.rows.broken_data import broken_channels, refuse, without_broken
from ident.diagnosis.rows.noise import misfit
from ident.diagnosis.rows.nominal_arm import STATED_WITHIN, NominalArm
from ident.diagnosis.rows.recording import SessionRecord, every_joint_moves, record, settled_for_all
from ident.diagnosis.settings import DiagnosisSettings
from ident.dynamics.base_set import BaseSet
from ident.dynamics.kinematics import Chain
from ident.effects import EncoderSide
from ident.estimation.turning import drive_coulomb
from ident.model import DynamicModel
from ident.model.signals import SIGNALS, signals_entry
from ident.rows.content import Recall
from ident.rows.data_quality import all_losses
from ident.rows.sessions import require
from lwr_driver.session import Session, Sessions, as_sessions

log = logging.getLogger(__name__)

# Rounds of settling the channels' delays.
_SETTLING = 2
_TUNING_SETS = 3
_ROUNDS = 3
_LATEST_S = 0.02
# Share of the factor of a stated stiffness within which a fit is at its end.
_END = 1.05
# Least compliance of a joint of unknown stiffness, in its standard errors.
_TOLD = 2.0
# Least fall of the logarithm of the chi-square by encoders at the motors of such an arm.
_CLEARLY = 0.1


@dataclass(frozen=True, eq=False)
class _Day:
    """Results of one set: base parameters (p,) and covariance (p, p), what the model leaves of a row by side and the
    rows that count as one for it, Coulomb friction of the drives (n,) [Nm] and its slow part, see `slow_turns`; delays
    of the channels beyond the arm's, with standard deviation, by side [s]. torque_rms : of the rows by side, (n,) [Nm].
    masses : announced, of its payloads [kg]. whole : the parameters (p,) with the friction of each drive as a whole.
    gains : (2, n) errors of the torque sensors' gains with standard deviations, NaN where unknown.
    """

    base: BaseSet
    masses: Mapping[str, float | None]
    values: Floats
    covariance: Floats
    sigma: Mapping[str, Floats]
    correlated: Mapping[str, Floats]
    torque_rms: Mapping[str, Floats]
    coulomb: Floats
    slow_turns: SlowTurns
    late: Mapping[str, tuple[float, float]]
    gains: Floats
    whole: Floats


def commission(
    sets: Iterable[Sessions],
    chain: Chain,
    *,
    arm: ArmData | None = None,
    settings: DiagnosisSettings | None = None,
    robot: str = "",
) -> Reference:
    """A healthy-arm baseline from sets of sessions, each with the sessions of a later diagnosis.

    sets : each a session, the path of a log, or several of either.

    The side of the joints that the positions come from, stiffness and presliding come from the first sets;
    parameters and noise from all, with what changed between them; the null, the mean gain of each candidate,
    from each set against a reference made of the others. Raises DataError for sessions that cannot
    be used, for channels that cannot be what they say, see `ident.screening`, and where the sets differ in their
    channels or in the number of payloads. Dead and frozen torques are left out.
    """
    settings = settings or DiagnosisSettings()
    require(chain, Chain, "chain", "read one with `Chain.from_urdf`")
    require(settings, DiagnosisSettings, "settings", "make one with `DiagnosisSettings()`")
    if isinstance(sets, (str, os.PathLike)) or not isinstance(sets, Iterable):
        raise ConfigurationError(
            f"sets: {sets!r:.60} is no list of sets; give `[first, second, ...]`, each set a list of sessions"
        )
    parts = [sorted(part, key=lambda s: s.start) for part in map(as_sessions, sets) if part]
    if not parts:
        raise DataError("no session given; name at least one healthy session")
    couplings = () if arm is None else arm.couplings
    stated = settings.signals
    settings = settled_for_all(settings, parts[:_TUNING_SETS], chain, couplings)
    recorded: list[list[SessionRecord]] = []
    for part in parts:
        recall = Recall()
        broken = broken_channels(part, chain, stated, couplings, recall=recall)
        refuse([one for one in broken if not one.lost], chain.joint_names)
        records = [record(s, k, chain, settings, recall=recall) for k, s in enumerate(part)]
        recorded.append(list(without_broken(records, broken)))
        every_joint_moves(recorded[-1], chain)
    start = replace(nominal_arm(chain, arm, None), encoder_known=True)
    if all(one.has_effort and one.has_motor for records in recorded for one in records):
        # One torque alone does not tell a twist from friction and inertia.
        start = start.of_unknown_stiffness()
    sides: tuple[EncoderSide, ...] = ("link", "motor") if np.any(start.anchor > 0.0) else ("link",)
    first = recorded[0]
    # Both sides in bins long enough to average the links' ringing, for a fair comparison.
    slow = replace(settings, bin_s=max(settings.bin_s, settings.ringing_s))
    # Of rigid joints the delays do not depend on the side.
    rigid = None if start.compliance.any() else channel_delays(parts[0], start, settings)
    told, tuned = {}, {}
    for side in sides:
        arm_of_side = replace(start, encoder=side)
        told[side] = channel_delays(parts[0], arm_of_side, settings) if rigid is None else rigid
        tuned[side] = _tuned(arm_of_side, first, slow, 2, common_delays([told[side]]))
    side = _encoder(start, {one: tuned[one].misfit for one in sides})
    log.info("positions of the %s", side)
    delays = [
        told[side],
        *(channel_delays(part, tuned[side].arm, settings) for part in parts[1:_TUNING_SETS]),
    ]
    late = common_delays(delays)
    one = _tuned(tuned[side].arm, first, settings, _ROUNDS, late)
    base = one.base
    several = [
        one,
        *(_tuned(one.arm, recordings, settings, 1, late) for recordings in recorded[1:_TUNING_SETS]),
    ]
    known = with_compliance_std(
        _middle([tuned.arm for tuned in several]),
        [tuned.arm.compliance for tuned in several],
        [tuned.compliance_std for tuned in several if tuned.compliance_std is not None],
    )
    days = [_day(known, recordings, settings, base) for recordings in recorded]
    known = with_far_presliding(known, [day.slow_turns for day in days], [day.coulomb for day in days])
    for _ in range(_SETTLING):
        # The delay of a channel depends on the reversal of friction, so it is settled last.
        days = [_day(known, recordings, settings, base) for recordings in recorded]
        open_s = {
            side: float(np.mean([day.late[side][0] for day in days])) for side in CHANNELS if side not in late
        }
        known = _later(known, open_s)
    known = replace(known, healthy=character(known, recorded, settings))
    days = [_day(known, recordings, settings, base) for recordings in recorded]
    found = _reference(days, known, robot or parts[0][0].metadata.get("robot", ""), parts[0])
    null: dict[tuple[str, int], float] = {}
    shown: dict[tuple[str, int], dict[str, float]] = {}
    tables, left = [], []
    for number, recordings in enumerate(recorded):
        others = [day for k, day in enumerate(days) if k != number]
        rest = None
        if others:
            # All sets in the same noise, for their gains are compared.
            rest = replace(
                _reference(others, known, robot, parts[0], days),
                noise=found.noise,
                correlated=found.correlated,
            )
        bench = prepare_bench(known, recordings, settings, rest, None, fit_compliance=False)
        own = gains(bench.dictionary, bench.evidence, settings)
        for key, gain in (own | remainder_gains(bench.dictionary, bench.evidence)).items():
            null[key] = null.get(key, 0.0) + gain / len(parts)
        tables.append(scores(bench.dictionary))
        for candidate in bench.dictionary.candidates:
            mean = shown.setdefault(candidate.key, {})
            for shape, value in bench.dictionary.information(candidate).items():
                mean[shape] = mean.get(shape, 0.0) + value / len(parts)
        left.append(_left(known, recordings, settings, rest))
        log.info("healthy set %d of %d", number + 1, len(parts))
    provenance = {**found.model.provenance, SIGNALS: signals_entry(settings.signals) | known.delays}
    # From day to day a delay differs by as much as either kind of rows shows.
    changes = dict(found.delay_std_s)
    for channel in CHANNELS:
        by_set = [mean_of(own[channel])[:2] for own in delays if own.get(channel)]
        changes[channel] = max(changes[channel], delay_std(by_set) if len(by_set) > 1 else 0.0)
    return replace(
        found,
        model=replace(found.model, provenance=provenance),
        null=null,
        delay_std_s=changes,
        shown=shown,
        usual=usual_sizes(tables),
        compliance_std=known.compliance_std,
        left=largest_left(left),
        lost=_largest_losses(parts),
    )


def _largest_losses(sets: Sequence[Sequence[Session]]) -> dict[str, float]:
    """Largest share of lost, repeated and stale samples of a session, by channel with any."""
    found: dict[str, float] = {}
    for loss in all_losses(session for part in sets for session in part):
        if loss.amiss:
            found[loss.channel] = max(round(loss.share, 6), found.get(loss.channel, 0.0))
    return found


class _Tuned(NamedTuple):
    """Chi-square of a row, the arm, the standard deviation of its compliance by the set's rows, and the base set of its
    bench."""

    misfit: float
    arm: NominalArm
    compliance_std: Floats | None
    base: BaseSet


def _tuned(
    arm: NominalArm,
    recordings: Sequence[SessionRecord],
    settings: DiagnosisSettings,
    rounds: int,
    late: Mapping[str, float],
) -> _Tuned:
    """The arm with stiffness and presliding fitted to a set in turns, and the delays that `late` does not have.

    They are similar near a reversal, so they need a few rounds.
    """
    arm = replace(
        arm,
        motor_delay_s=late.get("motor", arm.motor_delay_s),
        joint_delay_s=late.get("joint", arm.joint_delay_s),
    )
    misfit = np.inf
    for _ in range(rounds):
        bench = prepare_bench(arm, recordings, settings, None, (), fit_compliance=True)
        evidence, base = bench.evidence, bench.nominal.base
        # An unknown delay of the channels belongs to the healthy arm, whatever it is.
        wide = (
            settings
            if bench.nominal.rows.keys() <= late.keys()
            else replace(settings, delay_tolerance_s=_LATEST_S)
        )
        deviations = select(bench.dictionary, evidence, wide, None).deviations
        count = max(sum(float(m.sum()) for m in evidence.mask.values()), 1.0)
        rms = [float(np.log(v).mean()) for v in evidence.sigma.values()]
        misfit = float(np.log(evidence.chi_square / count) + 2.0 * np.mean(rms))
        arm = replace(
            bench.nominal.arm,
            presliding=presliding_length(bench.nominal, evidence.full.values[: len(base)]),
        )
        arm = _later(arm, {side: mean_delay(deviations, side)[0] for side in CHANNELS if side not in late})
    return _Tuned(misfit, arm, bench.compliance_std, base)


def _encoder(arm: NominalArm, misfits: Mapping[EncoderSide, float]) -> EncoderSide:
    """The side of the joints that the positions come from: that of the least misfit. Of an arm whose description states
    no stiffness, that of the motors has to be clearly less: a twist of any size takes something off."""
    motor = misfits.get("motor", np.inf) + (_CLEARLY if arm.within > STATED_WITHIN else 0.0)
    return "motor" if motor < misfits["link"] else "link"


def _later(arm: NominalArm, by: Mapping[str, float]) -> NominalArm:
    """The arm with channels later by so much [s]."""
    return replace(
        arm,
        motor_delay_s=arm.motor_delay_s + by.get("motor", 0.0),
        joint_delay_s=arm.joint_delay_s + by.get("joint", 0.0),
    )


def _middle(arms: Sequence[NominalArm]) -> NominalArm:
    """The mean of tuned arms; of the presliding lengths the geometric one, 0 if most of them have none."""
    found = np.array([arm.presliding for arm in arms])
    seen = found > 0.0
    lengths = np.exp(np.sum(np.log(np.where(seen, found, 1.0)), axis=0) / np.maximum(seen.sum(axis=0), 1))
    return replace(
        arms[0],
        compliance=np.mean([arm.compliance for arm in arms], axis=0),
        motor_delay_s=float(np.mean([arm.motor_delay_s for arm in arms])),
        joint_delay_s=float(np.mean([arm.joint_delay_s for arm in arms])),
        presliding=np.where(2 * seen.sum(axis=0) > len(arms), lengths, 0.0),
    )


def with_compliance_std(arm: NominalArm, sets: Sequence[Floats], own: Sequence[Floats] = ()) -> NominalArm:
    """The arm with the standard error of its compliance from those of the sets (n,) [rad/Nm] and by each one's rows,
    and with the stated one, known to a factor, where encoders at the motors do not tell it: the sets do not agree on
    one, or end at that factor. Behind encoders at the links a stated one that no set shows is unknown. Without a stated
    one a joint is rigid where the sets do not clearly tell that it twists.
    """
    std = compliance_std(sets, own)
    if arm.stated is None:
        return replace(arm, compliance_std=std)
    low, high = _END / arm.within * arm.stated, arm.largest_compliance / _END
    ends = np.any([(one < low) | (one > high) for one in sets], axis=0)
    if arm.within > STATED_WITHIN:
        told = ~ends & (arm.compliance > (0.0 if std is None else _TOLD * std))
        return replace(
            arm,
            compliance=np.where(told, arm.compliance, 0.0),
            compliance_std=None if std is None else np.where(told, std, 0.0),
        )
    if std is not None:
        # A joint that hardly moves tells nothing of its own.
        std = np.where(np.isfinite(std), std, UNSURE * arm.stated)
    if arm.encoder == "link":
        # A fit that ends at a rigid joint, or at the softest one, in every set does not differ from set to set.
        ended = (arm.compliance <= 0.0) | (arm.compliance >= high)
        ended &= arm.stated > 0.0
        return replace(arm, compliance_std=None if std is None else np.where(ended, UNSURE * arm.stated, std))
    # The fit of each set is held to the stated one as far as its rows do not tell.
    unknown = (arm.stated > 0.0) & (ends | unsure(arm.compliance, compliance_std(sets)))
    known = np.zeros(len(arm.stated)) if std is None else std
    if std is None and not unknown.any():
        return arm
    return replace(
        arm,
        compliance=np.where(unknown, arm.stated, arm.compliance),
        compliance_std=np.where(unknown, UNSURE * arm.stated, known),
    )


def _day(
    arm: NominalArm, recordings: Sequence[SessionRecord], settings: DiagnosisSettings, base: BaseSet
) -> _Day:
    bench = prepare_bench(arm, recordings, settings, None, (), fit_compliance=False)
    if bench.nominal.base.names != base.names:
        raise DataError(
            "the healthy sets differ in their channels or in the number of payloads, and so in their parameters; give "
            "sets of the same kind"
        )
    evidence = bench.evidence
    # `select` adds the tolerated deviations to the base.
    selection = select(bench.dictionary, evidence, settings, None)
    p = evidence.base_count
    values = evidence.full.values[:p].copy()
    residual = evidence.residuals()
    noise = {side: misfit(rows, residual[side]) for side, rows in bench.nominal.rows.items()}
    return _Day(
        base=bench.nominal.base,
        masses=bench.nominal.masses,
        values=values,
        covariance=evidence.covariance()[:p, :p],
        sigma={side: sigma for side, (sigma, _) in noise.items()},
        correlated={side: inflation for side, (_, inflation) in noise.items()},
        torque_rms={
            side: np.sqrt(np.mean(rows.target**2, axis=0)) for side, rows in bench.nominal.rows.items()
        },
        coulomb=bench.nominal.motions[0].motor_coulomb,
        slow_turns=slow_turns(bench.nominal, bench.evidence),
        late={side: mean_delay(selection.deviations, side) for side in CHANNELS},
        gains=_gains(bench, selection.nuisance_rows),
        whole=bench.nominal.whole_friction(values),
    )


def _left(
    arm: NominalArm,
    recordings: Sequence[SessionRecord],
    settings: DiagnosisSettings,
    reference: Reference | None,
) -> dict[str, Floats]:
    """Rms (n,) [Nm] by side of the set's last session with a payload of another one, as predicted from the others
    beside what differs from day to day; without such a session, of parts of the motion predicted in turn.
    """
    payloads = [one.payload for one in recordings]
    last = max((k for k, one in enumerate(payloads) if payloads.count(one) > 1), default=-1)
    held = [replace(one, test=k == last) for k, one in enumerate(recordings)]
    bench = prepare_bench(arm, held, settings, reference, (), fit_compliance=False)
    nuisance = select(bench.dictionary, bench.evidence, settings, None).nuisance_rows
    return held_out(bench.evidence, nuisance).rms()


def _gains(bench: DiagnosisBench, nuisance: Sequence[Rows]) -> Floats:
    """Errors (2, n) of the torque sensors' gains with standard deviations, beside tolerated deviations; NaN without
    both torques.
    """
    found = np.full((2, bench.nominal.arm.chain.n), np.nan)
    if len(bench.nominal.rows) < 2:
        return found
    columns = gain_rows(bench.dictionary)
    bench.evidence.replace([*columns.values(), *nuisance])
    std = np.sqrt(np.maximum(np.diag(bench.evidence.covariance()), 0.0))[bench.evidence.base_count :]
    for k, (joint, value) in enumerate(zip(columns, bench.evidence.coefficients(), strict=False)):
        found[:, joint] = value[0], std[k]
    return found


def _reference(
    days: Sequence[_Day],
    arm: NominalArm,
    robot: str,
    sessions: Sequence[Session],
    habits: Sequence[_Day] = (),
) -> Reference:
    """The mean of days, without the null, with the changes from day to day of the `habits`, default of these days."""
    kinds = [sorted(day.masses.items()) for day in days]
    usual = days[max(range(len(days)), key=lambda k: kinds.count(kinds[k]))]
    base, known = usual.base, [_known(day, usual) for day in days]
    rms = {side: np.mean([day.torque_rms[side] for day in days], axis=0) for side in usual.torque_rms}
    changing = [_known(day, usual) for day in habits] or known
    efforts = base.structure.chain.efforts()
    of_friction = [_known(replace(day, values=day.whole), usual)[0] for day in habits or days]
    variance = habit(
        base.names,
        [values for values, _ in changing],
        [c for _, c in changing],
        rms,
        efforts,
        np.nanmean(of_friction, axis=0),
    )
    precision, pull = np.zeros((len(base), len(base))), np.zeros(len(base))
    for values, covariance in known:
        # A mean weighted by each day's own uncertainty alone would turn their changes into errors of all parameters.
        here = np.flatnonzero(np.isfinite(values))
        own = np.linalg.inv(_sound(covariance[np.ix_(here, here)] + np.diag(variance[here])))
        precision[np.ix_(here, here)] += own
        pull[here] += own @ values[here]
    mean = np.linalg.inv(_sound(precision))
    # A further day differs from the mean of these.
    covariance = np.asarray(mean + np.diag(variance), dtype=np.float64)
    model = DynamicModel(
        robot or "arm",
        base.structure,
        base.names,
        mean @ pull,
        _sound(covariance),
        base,
        {"sessions": [s.path.name for s in sessions]},
    )
    turning = (
        arm.turning(drive_coulomb(model, sensed="joint" in usual.sigma)) if "motor" in usual.sigma else []
    )
    model = replace(model, effects=(*arm.healthy, *turning))
    noise = {side: np.mean([day.sigma[side] for day in days], axis=0) for side in usual.sigma}
    return Reference(
        model,
        compliance=arm.compliance,
        motor_delay_s=arm.motor_delay_s,
        joint_delay_s=arm.joint_delay_s,
        noise=noise,
        null={},
        sets=len(days),
        encoder=arm.encoder,
        presliding=arm.presliding,
        far=arm.far,
        far_share=arm.far_share,
        delay_std_s={side: delay_std([day.late[side] for day in days]) for side in CHANNELS},
        habits=True,
        masses=usual.masses,
        # Of a further day against the mean of these.
        gain_std=gain_std([day.gains for day in days]) * float(np.sqrt(1.0 + 1.0 / len(days))),
        correlated={
            side: np.mean([day.correlated[side] * day.sigma[side] ** 2 for day in days], axis=0)
            / noise[side] ** 2
            for side in noise
        },
    )


def _known(day: _Day, usual: _Day) -> tuple[Floats, Floats]:
    """Values (p,) and covariance (p, p) of the base parameters of the usual day, NaN for those of another payload."""
    pairs = np.array(shared(day.base, usual.base, day.masses, usual.masses))
    values, covariance = np.full(len(usual.base), np.nan), np.full((len(usual.base),) * 2, np.nan)
    values[pairs[:, 1]] = day.values[pairs[:, 0]]
    covariance[np.ix_(pairs[:, 1], pairs[:, 1])] = day.covariance[np.ix_(pairs[:, 0], pairs[:, 0])]
    return values, covariance


def _sound(matrix: Floats) -> Floats:
    """The nearest symmetric, safely positive definite covariance or precision."""
    scale = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    correlation = matrix / np.outer(scale, scale)
    correlation = 0.5 * (correlation + correlation.T)
    values, vectors = np.linalg.eigh(correlation)
    solid = np.maximum(values, 1e-9 * values[-1])
    return np.asarray((vectors * solid) @ vectors.T * np.outer(scale, scale), dtype=np.float64)
