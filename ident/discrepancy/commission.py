"""The healthy arm learned from sets of sessions, each as a later diagnosis will get them."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from fri.errors import DataError
from ident.base import BaseSet
from ident.discrepancy.bench import ArmData, Bench, every_joint_moves, mean_delay, nominal_arm, prepare_bench
from ident.discrepancy.candidates import Dictionary
from ident.discrepancy.evidence import Evidence, Floats
from ident.discrepancy.nominal import Arm
from ident.discrepancy.recording import Recording, record
from ident.discrepancy.reference import Reference
from ident.discrepancy.selection import select
from ident.discrepancy.settings import DiagnosisSettings
from ident.kinematics import Chain
from ident.model import DynamicModel

if TYPE_CHECKING:
    from lwr_driver.session import Session

__all__ = ["commission"]

log = logging.getLogger(__name__)

_STIFFNESS_SETS = 3
_ENOUGH = 3


@dataclass(frozen=True, eq=False)
class _Day:
    """What one set says: base parameters (p,) and covariance (p, p), tolerated deviations, noise."""

    values: Floats
    covariance: Floats
    nuisance: Mapping[str, tuple[float, float]]
    sigma: Mapping[str, Floats]
    scores: Mapping[tuple[str, int], float]


def commission(
    sets: Sequence[Sequence[Session]],
    chain: Chain,
    *,
    arm: ArmData | None = None,
    settings: DiagnosisSettings | None = None,
    robot: str = "",
) -> Reference:
    """The healthy arm from sets of sessions, each as a later diagnosis will get them.

    The side of the joints that the positions come from and the joints' stiffness come from the first sets;
    parameters and noise from all, with what changed between them; the null, the largest gain of each
    candidate, from each set against a reference made of the others. Raises DataError for sessions that cannot
    be used, and where the sets differ in their payloads or channels.
    """
    settings = settings or DiagnosisSettings()
    parts = [sorted(part, key=lambda s: s.start) for part in sets if part]
    if not parts:
        raise DataError("no session given; name at least one healthy session")
    benches = [
        _bench(_known(chain, arm), _recordings(part, chain, settings), settings)
        for part in parts[:_STIFFNESS_SETS]
    ]
    known = benches[0].nominal.arm
    votes = [bench.nominal.arm.encoder for bench in benches]
    encoder = max(sorted(set(votes)), key=votes.count)
    agreeing = [b.nominal.arm.compliance for b in benches if b.nominal.arm.encoder == encoder]
    known = replace(known, encoder=encoder, encoder_known=True, compliance=np.mean(agreeing, axis=0))
    base = benches[0].nominal.base
    del benches
    days = []
    for number, part in enumerate(parts):
        days.append(_day(known, _recordings(part, chain, settings), settings, base, None))
        log.info("healthy set %d of %d", number + 1, len(parts))
    delays = [np.mean([mean_delay(day.nuisance, side)[0] for day in days]) for side in ("motor", "joint")]
    known = replace(known, motor_delay_s=float(delays[0]), joint_delay_s=float(delays[1]))
    null: dict[tuple[str, int], float] = {}
    for number, part in enumerate(parts):
        others = [day for k, day in enumerate(days) if k != number]
        if len(others) >= _ENOUGH - 1:
            rest = _reference(others, base, known, robot, parts[0], {})
            day = _day(known, _recordings(part, chain, settings), settings, base, rest)
        else:
            day = days[number]
        for key, gain in day.scores.items():
            null[key] = max(null.get(key, 0.0), gain)
    return _reference(days, base, known, robot or parts[0][0].metadata.get("robot", ""), parts[0], null)


def _known(chain: Chain, arm: ArmData | None) -> Arm:
    return nominal_arm(chain, arm, None)


def _recordings(part: Sequence[Session], chain: Chain, settings: DiagnosisSettings) -> list[Recording]:
    recordings = [record(s, k, chain, settings) for k, s in enumerate(part)]
    every_joint_moves(recordings, chain)
    return recordings


def _bench(arm: Arm, recordings: Sequence[Recording], settings: DiagnosisSettings) -> Bench:
    """Bench with the side of the joints and the stiffness that suit the sessions best."""
    found = []
    for encoder in ("link", "motor") if np.any(arm.compliance > 0.0) else ("link",):
        bench = prepare_bench(
            replace(arm, encoder=encoder), recordings, settings, None, None, fit_compliance=True
        )
        rms = [np.log(v).sum() for v in bench.evidence.sigma.values()]
        rest = bench.evidence.chi_square / max(sum(m.sum() for m in bench.evidence.mask.values()), 1.0)
        found.append((2.0 * sum(rms) / max(len(rms), 1) + np.log(rest), bench))
    return min(found, key=lambda pair: pair[0])[1]


def _day(
    arm: Arm,
    recordings: Sequence[Recording],
    settings: DiagnosisSettings,
    base: BaseSet,
    reference: Reference | None,
) -> _Day:
    bench = prepare_bench(arm, recordings, settings, reference, None, fit_compliance=False)
    if bench.nominal.base.names != base.names:
        raise DataError(
            "the healthy sets differ in payloads or channels, so their parameters are not the same; give sets "
            "of the same kind"
        )
    found = select(bench.dictionary, bench.evidence, replace(settings, rounds=1), None)
    evidence = bench.evidence
    plain = Evidence(bench.nominal, settings, evidence.sigma, evidence.dilution)
    dictionary = Dictionary(bench.nominal, plain, ())
    nuisance = select(dictionary, plain, settings, None)
    p = plain.base_count
    return _Day(
        plain.full.values[:p].copy(),
        plain.covariance()[:p, :p],
        nuisance.nuisance,
        evidence.sigma,
        found.scores,
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
        covariance,
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
    )


def _sound(matrix: Floats) -> Floats:
    """A covariance or precision made symmetric and safely positive definite."""
    scale = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    correlation = matrix / np.outer(scale, scale)
    correlation = 0.5 * (correlation + correlation.T)
    values, vectors = np.linalg.eigh(correlation)
    solid = np.maximum(values, 1e-9 * values[-1])
    return np.asarray((vectors * solid) @ vectors.T * np.outer(scale, scale), dtype=np.float64)
