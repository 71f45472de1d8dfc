"""The healthy arm learned from sets of sessions, each as a later diagnosis will get them."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from fri.errors import ConfigurationError, DataError
from ident.diagnosis.bench import ArmData, every_joint_moves, mean_delay, nominal_arm, prepare_bench
from ident.diagnosis.evidence import Floats
from ident.diagnosis.nominal import Arm
from ident.diagnosis.presliding import SlowTurns, presliding_reach, slow_turns, with_far_presliding
from ident.diagnosis.recording import Recording, record
from ident.diagnosis.reference import DELAY_STD_S, Reference
from ident.diagnosis.selection import gains, select
from ident.diagnosis.settings import DiagnosisSettings
from ident.dynamics.base_set import BaseSet
from ident.dynamics.kinematics import Chain
from ident.model import DynamicModel
from ident.rows.sessions import Sessions, as_sessions, require

if TYPE_CHECKING:
    from lwr_driver.session import Session

__all__ = ["commission", "delay_std"]

Side = Literal["link", "motor"]

log = logging.getLogger(__name__)

# Rounds in which the channels' delays are settled.
_SETTLING = 2
_TUNING_SETS = 3
_ROUNDS = 3
_ENOUGH = 3
_LATEST_S = 0.02
_CHANNELS = ("motor", "joint")
_USUAL_DAYS = 4


@dataclass(frozen=True, eq=False)
class _Day:
    """What one set says: base parameters (p,) and covariance (p, p), noise of a row by side, Coulomb friction of
    the drives (n,) [Nm] and what of it turns slowly, see `presliding.slow_turns`; by how much the channels are later
    than the arm says, with standard deviation, by side [s].
    """

    values: Floats
    covariance: Floats
    sigma: Mapping[str, Floats]
    coulomb: Floats
    slow_turns: SlowTurns
    late: Mapping[str, tuple[float, float]]


def commission(
    sets: Iterable[Sessions],
    chain: Chain,
    *,
    arm: ArmData | None = None,
    settings: DiagnosisSettings | None = None,
    robot: str = "",
) -> Reference:
    """The healthy arm from sets of sessions, each as a later diagnosis will get them.

    sets : each a session, the path of a log, or several of either.

    The side of the joints that the positions come from, stiffness and presliding come from the first sets;
    parameters and noise from all, with what changed between them; the null, the mean gain of each candidate,
    from each set against a reference made of the others. Raises DataError for sessions that cannot
    be used, and where the sets differ in their payloads or channels.
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
    sides: tuple[Side, ...] = ("link", "motor") if np.any(_known(chain, arm).compliance > 0.0) else ("link",)
    recorded = [_recordings(part, chain, settings) for part in parts]
    first = recorded[0]
    start = replace(_known(chain, arm), encoder_known=True)
    # Both sides in bins in which the links' ringing is not seen, or the one that rings would be at a loss.
    slow = replace(settings, bin_s=max(settings.bin_s, settings.ringing_s))
    _, tuned, _ = min(
        (_tuned(replace(start, encoder=side), first, slow, 2) for side in sides), key=lambda t: t[0]
    )
    log.info("positions of the %s", tuned.encoder)
    _, tuned, base = _tuned(tuned, first, settings, _ROUNDS)
    several = [tuned]
    for recordings in recorded[1:_TUNING_SETS]:
        several.append(_tuned(tuned, recordings, settings, 1)[1])
    known = _middle(several)
    days = [_day(known, recordings, settings, base) for recordings in recorded]
    known = with_far_presliding(known, [day.slow_turns for day in days], [day.coulomb for day in days])
    for _ in range(_SETTLING):
        # How late a channel seems depends on how friction turns at reversals, so its delay is settled last.
        days = [_day(known, recordings, settings, base) for recordings in recorded]
        late = {side: float(np.mean([day.late[side][0] for day in days])) for side in _CHANNELS}
        known = replace(
            known,
            motor_delay_s=known.motor_delay_s + late["motor"],
            joint_delay_s=known.joint_delay_s + late["joint"],
        )
    days = [_day(known, recordings, settings, base) for recordings in recorded]
    null: dict[tuple[str, int], float] = {}
    for number, recordings in enumerate(recorded):
        others = [day for k, day in enumerate(days) if k != number]
        rest = _reference(others, base, known, robot, parts[0], {}) if len(others) >= _ENOUGH - 1 else None
        bench = prepare_bench(known, recordings, settings, rest, None, fit_compliance=False)
        for key, gain in gains(bench.dictionary, bench.evidence, settings).items():
            null[key] = null.get(key, 0.0) + gain / len(parts)
        log.info("healthy set %d of %d", number + 1, len(parts))
    return _reference(days, base, known, robot or parts[0][0].metadata.get("robot", ""), parts[0], null)


def _tuned(
    arm: Arm, recordings: Sequence[Recording], settings: DiagnosisSettings, rounds: int
) -> tuple[float, Arm, BaseSet]:
    """Chi-square of a row, and the arm with stiffness, presliding and delays that suit a set, in turns.

    Each of them is a little like the others near a reversal, so they need a few rounds.
    """
    # Whatever the channels' delays are, they are those of the healthy arm.
    wide = replace(settings, delay_tolerance_s=_LATEST_S)
    misfit = np.inf
    for _ in range(rounds):
        bench = prepare_bench(arm, recordings, settings, None, (), fit_compliance=True)
        evidence, base = bench.evidence, bench.nominal.base
        nuisance = select(bench.dictionary, evidence, wide, None).nuisance
        count = max(sum(float(m.sum()) for m in evidence.mask.values()), 1.0)
        rms = [float(np.log(v).mean()) for v in evidence.sigma.values()]
        misfit = float(np.log(evidence.chi_square / count) + 2.0 * np.mean(rms))
        arm = replace(
            bench.nominal.arm,
            reach=presliding_reach(bench.nominal, evidence.full.values[: len(base)]),
            motor_delay_s=arm.motor_delay_s + mean_delay(nuisance, "motor")[0],
            joint_delay_s=arm.joint_delay_s + mean_delay(nuisance, "joint")[0],
        )
    return misfit, arm, base


def _middle(arms: Sequence[Arm]) -> Arm:
    """The mean of tuned arms; of the reaches the geometric one, 0 where most of them see none."""
    found = np.array([arm.reach for arm in arms])
    seen = found > 0.0
    reach = np.exp(np.sum(np.log(np.where(seen, found, 1.0)), axis=0) / np.maximum(seen.sum(axis=0), 1))
    return replace(
        arms[0],
        compliance=np.mean([arm.compliance for arm in arms], axis=0),
        motor_delay_s=float(np.mean([arm.motor_delay_s for arm in arms])),
        joint_delay_s=float(np.mean([arm.joint_delay_s for arm in arms])),
        reach=np.where(2 * seen.sum(axis=0) > len(arms), reach, 0.0),
    )


def _known(chain: Chain, arm: ArmData | None) -> Arm:
    return nominal_arm(chain, arm, None)


def _recordings(part: Sequence[Session], chain: Chain, settings: DiagnosisSettings) -> list[Recording]:
    recordings = [record(s, k, chain, settings) for k, s in enumerate(part)]
    every_joint_moves(recordings, chain)
    return recordings


def _day(arm: Arm, recordings: Sequence[Recording], settings: DiagnosisSettings, base: BaseSet) -> _Day:
    bench = prepare_bench(arm, recordings, settings, None, (), fit_compliance=False)
    if bench.nominal.base.names != base.names:
        raise DataError(
            "the healthy sets differ in payloads or channels, so their parameters are not the same; give sets "
            "of the same kind"
        )
    evidence = bench.evidence
    # Leaves the tolerated deviations beside the base.
    nuisance = select(bench.dictionary, evidence, settings, None).nuisance
    p = evidence.base_count
    return _Day(
        evidence.full.values[:p].copy(),
        evidence.covariance()[:p, :p],
        evidence.sigma,
        bench.nominal.motions[0].motor_coulomb,
        slow_turns(bench.nominal, bench.evidence),
        {side: mean_delay(nuisance, side) for side in _CHANNELS},
    )


def _reference(
    days: Sequence[_Day],
    base: BaseSet,
    arm: Arm,
    robot: str,
    sessions: Sequence[Session],
    null: Mapping[tuple[str, int], float],
) -> Reference:
    """Mean of the days, with the covariance that a further day has around it."""
    precisions = [np.asarray(np.linalg.inv(_sound(day.covariance)), dtype=np.float64) for day in days]
    within = np.linalg.inv(_sound(np.sum(precisions, axis=0)))
    pulls = [p @ day.values for p, day in zip(precisions, days, strict=True)]
    values: Floats = within @ np.sum(pulls, axis=0)
    covariance: Floats = np.asarray(within, dtype=np.float64)
    if len(days) >= _ENOUGH:
        scatter = np.var([day.values for day in days], axis=0, ddof=1)
        expected = np.mean([np.diag(day.covariance) for day in days], axis=0)
        # Scatter beyond what each day's own uncertainty explains is the arm's own change.
        covariance = covariance + np.diag(np.maximum(scatter - 0.7 * expected, 0.0))
    model = DynamicModel(
        robot or "arm",
        base.structure,
        base.names,
        values,
        _sound(covariance),
        base,
        {"sessions": [s.path.name for s in sessions]},
    )
    noise = {side: np.mean([day.sigma[side] for day in days], axis=0) for side in days[0].sigma}
    return Reference(
        model,
        arm.compliance,
        arm.motor_delay_s,
        arm.joint_delay_s,
        noise,
        null,
        len(days),
        arm.encoder,
        arm.reach,
        arm.far,
        arm.far_share,
        {side: delay_std([day.late[side] for day in days]) for side in _CHANNELS},
    )


def delay_std(late: Sequence[tuple[float, float]]) -> float:
    """Standard deviation [s] of a healthy channel's delay on a further day around the mean of these, from values with
    standard deviations.

    A few days know their scatter badly, so what is usual counts as further days.
    """
    values, deviations = np.array(late).T
    own = float(np.sum((values - values.mean()) ** 2 - (1.0 - 1.0 / len(values)) * deviations**2))
    days = len(values) - 1
    variance = (_USUAL_DAYS * DELAY_STD_S**2 + max(own, 0.0)) / (_USUAL_DAYS + days)
    return float(np.sqrt(variance * (1.0 + 1.0 / len(values))))


def _sound(matrix: Floats) -> Floats:
    """A covariance or precision made symmetric and safely positive definite."""
    scale = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    correlation = matrix / np.outer(scale, scale)
    correlation = 0.5 * (correlation + correlation.T)
    values, vectors = np.linalg.eigh(correlation)
    solid = np.maximum(values, 1e-9 * values[-1])
    return np.asarray((vectors * solid) @ vectors.T * np.outer(scale, scale), dtype=np.float64)
