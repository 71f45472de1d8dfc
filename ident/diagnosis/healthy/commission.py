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
from ident.diagnosis.causes.usual_sizes import UsualSize, scores, usual_sizes
from ident.diagnosis.gain.held_out import held_out
from ident.diagnosis.gain.products import Floats, Rows
from ident.diagnosis.healthy.bench import (
    ArmData,
    DiagnosisBench,
    mean_delay,
    nominal_arm,
    prepare_bench,
)
from ident.diagnosis.healthy.channel_delays import CHANNELS, mean_of
from ident.diagnosis.healthy.character import character
from ident.diagnosis.healthy.day_spread import delay_std, gain_std, habit, largest_left
from ident.diagnosis.healthy.presliding import SlowTurns, slow_turns, with_far_presliding
from ident.diagnosis.healthy.reference import (
    Reference,
    shared,
)
from ident.diagnosis.healthy.tuning import TUNING_SETS, SettledArm, later, settled_arm
from ident.diagnosis.rows.broken_data import broken_channels, refuse, without_broken
from ident.diagnosis.rows.noise import misfit
from ident.diagnosis.rows.nominal_arm import NominalArm
from ident.diagnosis.rows.recording import SessionRecord, every_joint_moves, record, settled_for_all
from ident.diagnosis.settings import DiagnosisSettings
from ident.dynamics.base_set import BaseSet
from ident.dynamics.kinematics import Chain
from ident.dynamics.structure import Coupling
from ident.estimation.turning import drive_coulomb
from ident.model import DynamicModel
from ident.model.signals import SIGNALS, signals_entry
from ident.rows.content import Recall
from ident.rows.data_quality import all_losses
from ident.rows.delay import Delay
from ident.rows.filters import SignalSettings
from ident.rows.sessions import require
from lwr_driver.session import Session, Sessions, as_sessions

log = logging.getLogger(__name__)

# Rounds of settling the channels' delays.
_SETTLING = 2


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
    parts = _parts(sets)
    couplings = () if arm is None else arm.couplings
    stated = settings.signals
    settings = settled_for_all(settings, parts[:TUNING_SETS], chain, couplings)
    recorded = _recorded(parts, chain, stated, settings, couplings)
    settled = settled_arm(parts, recorded, nominal_arm(chain, arm, None), settings)
    known, days = _with_days(settled, recorded, settings)
    found = _reference(days, known, robot or parts[0][0].metadata.get("robot", ""), parts[0])
    provenance = {**found.model.provenance, SIGNALS: signals_entry(settings.signals) | known.delays}
    shown = _shown(recorded, days, known, found, settings)
    return replace(
        found,
        model=replace(found.model, provenance=provenance),
        null=shown.null,
        delay_std_s=_delay_std(found.delay_std_s, settled.delays),
        shown=shown.information,
        usual=shown.usual,
        compliance_std=known.compliance_std,
        left=shown.left,
        lost=_largest_losses(parts),
    )


def _parts(sets: Iterable[Sessions]) -> list[list[Session]]:
    """The sets that are not empty, each in the order of its sessions' beginnings."""
    if isinstance(sets, (str, os.PathLike)) or not isinstance(sets, Iterable):
        raise ConfigurationError(
            f"sets: {sets!r:.60} is no list of sets; give `[first, second, ...]`, each set a list of sessions"
        )
    parts = [sorted(part, key=lambda s: s.start) for part in map(as_sessions, sets) if part]
    if not parts:
        raise DataError("no session given; name at least one healthy session")
    return parts


def _recorded(
    parts: Sequence[Sequence[Session]],
    chain: Chain,
    stated: SignalSettings,
    settings: DiagnosisSettings,
    couplings: Sequence[Coupling],
) -> list[list[SessionRecord]]:
    """The records of each set without lost channels. stated : the signals' settings before they were settled."""
    recorded = []
    for part in parts:
        recall = Recall()
        broken = broken_channels(part, chain, stated, couplings, recall=recall)
        refuse([one for one in broken if not one.lost], chain.joint_names)
        records = [record(s, k, chain, settings, recall=recall) for k, s in enumerate(part)]
        recorded.append(list(without_broken(records, broken)))
        every_joint_moves(recorded[-1], chain)
    return recorded


class _Fits:
    """Healthy sets fitted with an arm, and anew only with one that acts differently.

    base : of the results. benches, days : of each set, with the latest arm.
    """

    def __init__(
        self, recorded: Sequence[Sequence[SessionRecord]], settings: DiagnosisSettings, base: BaseSet
    ) -> None:
        self.recorded, self.settings, self.base = recorded, settings, base
        self.arm: NominalArm | None = None
        self.benches: list[DiagnosisBench] = []
        self.days: list[_Day] = []

    def fit(self, arm: NominalArm) -> list[_Day]:
        """The results of each set with the arm."""
        if self.arm is None or not arm.acts_as(self.arm):
            self.arm, self.benches = arm, []  # the former ones go before the new ones come
            for recordings in self.recorded:
                self.benches.append(
                    prepare_bench(arm, recordings, self.settings, None, (), fit_compliance=False)
                )
            self.days = [_day(bench, self.settings, self.base) for bench in self.benches]
        return self.days


def _with_days(
    settled: SettledArm, recorded: Sequence[Sequence[SessionRecord]], settings: DiagnosisSettings
) -> tuple[NominalArm, list[_Day]]:
    """The settled arm with its slow friction, open delays and own effects, and the results of each set with it."""
    fits = _Fits(recorded, settings, settled.base)
    days = fits.fit(settled.arm)
    known = with_far_presliding(settled.arm, [day.slow_turns for day in days], [day.coulomb for day in days])
    for _ in range(_SETTLING):
        # The delay of a channel depends on the reversal of friction, so it is settled last.
        days = fits.fit(known)
        open_s = {
            side: float(np.mean([day.late[side][0] for day in days]))
            for side in CHANNELS
            if side not in settled.late
        }
        known = later(known, open_s)
    fits.fit(known)
    known = replace(known, healthy=character(fits.benches, settings))
    return known, fits.fit(known)


class _Shown(NamedTuple):
    """What each healthy set shows of the candidates against the others: mean gain (the null) and mean information by
    shape, usual sizes; and the largest error that the others leave of one."""

    null: dict[tuple[str, int], float]
    information: dict[tuple[str, int], dict[str, float]]
    usual: dict[tuple[str, int], UsualSize]
    left: dict[str, Floats]


def _shown(
    recorded: Sequence[Sequence[SessionRecord]],
    days: Sequence[_Day],
    known: NominalArm,
    found: Reference,
    settings: DiagnosisSettings,
) -> _Shown:
    null: dict[tuple[str, int], float] = {}
    shown: dict[tuple[str, int], dict[str, float]] = {}
    tables, left = [], []
    for number, recordings in enumerate(recorded):
        others = [day for k, day in enumerate(days) if k != number]
        rest = None
        if others:
            # All sets in the same noise, for their gains are compared.
            rest = replace(
                _reference(others, known, found.model.robot, (), days),
                noise=found.noise,
                correlated=found.correlated,
            )
        bench = prepare_bench(known, recordings, settings, rest, None, fit_compliance=False)
        own = gains(bench.dictionary, settings)
        for key, gain in (own | remainder_gains(bench.dictionary)).items():
            null[key] = null.get(key, 0.0) + gain / len(recorded)
        tables.append(scores(bench.dictionary))
        for candidate in bench.dictionary.candidates:
            mean = shown.setdefault(candidate.key, {})
            for shape, value in bench.dictionary.information(candidate).items():
                mean[shape] = mean.get(shape, 0.0) + value / len(recorded)
        left.append(_left(bench, settings, rest))
        log.info("healthy set %d of %d", number + 1, len(recorded))
    return _Shown(null, shown, usual_sizes(tables), largest_left(left))


def _delay_std(
    by_rows: Mapping[str, float], delays: Sequence[Mapping[str, Sequence[Delay]]]
) -> dict[str, float]:
    """Standard deviation [s] of the delays from day to day by channel: as much as either kind of rows shows.

    by_rows : by the rows of the evidence. delays : of each set, from rows away from reversals.
    """
    changes = dict(by_rows)
    for channel in CHANNELS:
        by_set = [mean_of(own[channel])[:2] for own in delays if own.get(channel)]
        changes[channel] = max(changes[channel], delay_std(by_set) if len(by_set) > 1 else 0.0)
    return changes


def _largest_losses(sets: Sequence[Sequence[Session]]) -> dict[str, float]:
    """Largest share of lost, repeated and stale samples of a session, by channel with any."""
    found: dict[str, float] = {}
    for loss in all_losses(session for part in sets for session in part):
        if loss.amiss:
            found[loss.channel] = max(round(loss.share, 6), found.get(loss.channel, 0.0))
    return found


def _day(bench: DiagnosisBench, settings: DiagnosisSettings, base: BaseSet) -> _Day:
    if bench.nominal.base.names != base.names:
        raise DataError(
            "the healthy sets differ in their channels or in the number of payloads, and so in their parameters; give "
            "sets of the same kind"
        )
    evidence = bench.evidence
    # `select` adds the tolerated deviations to the base.
    selection = select(bench.dictionary, settings, None)
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
    bench: DiagnosisBench, settings: DiagnosisSettings, reference: Reference | None
) -> dict[str, Floats]:
    """Rms (n,) [Nm] by side of the set's last session with a payload of another one, as predicted from the others
    beside what differs from day to day; without such a session, of parts of the motion predicted in turn.

    bench : of the set, against the reference.
    """
    recordings, arm = bench.nominal.recordings, bench.nominal.arm
    payloads = [one.payload for one in recordings]
    last = max((k for k, one in enumerate(payloads) if payloads.count(one) > 1), default=None)
    if last is not None:
        held = [replace(one, test=k == last) for k, one in enumerate(recordings)]
        bench = prepare_bench(arm, held, settings, reference, (), fit_compliance=False)
    nuisance = select(bench.dictionary.of(()), settings, None).nuisance_rows
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
        gear_ratio=arm.gear_ratio if np.any(arm.gear_ratio != 1.0) else None,
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
