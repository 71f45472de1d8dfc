"""Signatures: the remainder of a cause in the rows after a fit of everything else.

A cause is found by the part of its torque outside the span of the base parameters and the tolerated deviations of
the nominal arm: with rows weighted by their noise, the columns `X` of the cause minus their projection on the columns
`W` of the rest, `X - W (W' W)^-1 W' X`. Its length, in units of the noise, measures the visibility of the cause in
the sessions. The angle between the signatures of two causes measures their distinguishability. Principal angles:
Bjorck and Golub, Mathematics of Computation 27 (1973).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from fri.errors import DataError
from ident.diagnosis.causes.candidates import Candidate, Trial
from ident.diagnosis.causes.selection import select
from ident.diagnosis.gain.products import Floats, Key, Rows
from ident.diagnosis.healthy.bench import (
    ArmData,
    DiagnosisBench,
    known_drives,
    nominal_arm,
    prepare_bench,
)
from ident.diagnosis.healthy.preparation import preparation
from ident.diagnosis.healthy.reference import Reference
from ident.diagnosis.rows.broken_data import BrokenChannel
from ident.diagnosis.settings import DiagnosisSettings
from ident.dynamics.kinematics import Chain
from ident.effects import Form, find_effect
from lwr_driver.session import Session

Cause = tuple[str, Sequence[int]]
"""Name of a cause and its joints, counted from 1; none for the whole arm."""


@dataclass(frozen=True, eq=False)
class Signature:
    """The torque of a cause in the rows of sessions.

    cause, joints : see `Cause`. parameters, form : of the torque, including the shape.
    time, session : by side, (m,) of the rows [s] and their session's number.
    torque : by side, (m, n) [Nm], the whole torque of the cause. left : the same without the part absorbed by the
        base parameters; NaN in unused rows.
    strength : length of `left` in units of the noise; its square is the fall of the chi-square by the cause.
    share : remaining part of the torque's power, 0 to 1.
    """

    cause: str
    joints: tuple[int, ...]
    parameters: Mapping[str, float]
    form: Form | None
    time: Mapping[str, Floats]
    session: Mapping[str, NDArray[np.int64]]
    torque: Mapping[str, Floats]
    left: Mapping[str, Floats]
    strength: float
    share: float
    _columns: Floats = field(repr=False)
    _coefficients: Floats = field(repr=False)


def signature_bench(
    sessions: Sequence[Session],
    chain: Chain,
    *,
    arm: ArmData | None = None,
    reference: Reference | None = None,
    settings: DiagnosisSettings | None = None,
    broken: Sequence[BrokenChannel] = (),
) -> DiagnosisBench:
    """The bench of a diagnosis of sessions, with the tolerated deviations of the nominal arm beside its base.

    broken : channels to leave out, `Diagnosis.data`. A late channel is as it was recorded. Raises DataError, with
    advice, for unusable sessions.
    """
    settings = settings or DiagnosisSettings()
    if not sessions:
        raise DataError("no session given; name at least one session file")
    arm = known_drives(arm, reference)
    ready = preparation(sessions, (), chain, settings, arm.couplings, reference, broken)
    known = nominal_arm(chain, arm, reference, ready.settings.signals)
    bench = prepare_bench(
        known, ready.recordings, ready.settings, reference, (), fit_compliance=reference is None
    )
    select(bench.dictionary, ready.settings)
    return bench


def signatures(
    bench: DiagnosisBench,
    causes: Sequence[Cause],
    *,
    parameters: Sequence[Mapping[str, float] | None] | None = None,
    forms: Sequence[str | Form | None] | None = None,
) -> tuple[Signature, ...]:
    """Signatures of causes on the rows fitted of a bench, each by itself beside the base.

    parameters : a full set of values of each cause, None for the best fit. forms : their forms. Raises
    ConfigurationError for an unknown cause, DataError for one without a torque in these sessions.
    """
    none = [None] * len(causes)
    given = zip(causes, parameters or none, forms or none, strict=True)
    return tuple(_signature(bench, cause, values, form) for cause, values, form in given)


def overlap(a: Signature, b: Signature) -> float:
    """Cosine, 0 to 1, of the angle between the signature of `a` and the span of the columns of `b`.

    The shape of `b` is fixed and its coefficients are free. 1: indistinguishable in these sessions; 0: neither hides
    the other. `1 - overlap^2` is the remaining share of the power of `a` beside `b`. Raises ValueError for signatures
    of different benches.
    """
    if len(a._columns) != len(b._columns):
        raise ValueError("the signatures come from different benches; make both from one")
    seen = a._columns @ a._coefficients
    size = float(np.linalg.norm(seen))
    if size <= 0.0 or not np.any(b._columns):
        return 0.0
    near = b._columns @ np.linalg.lstsq(b._columns, seen, rcond=1e-9)[0]
    return min(1.0, float(np.linalg.norm(near)) / size)


def _signature(
    bench: DiagnosisBench, cause: Cause, values: Mapping[str, float] | None, form: str | Form | None
) -> Signature:
    name, joints = cause
    effect = find_effect(name)
    candidate = Candidate(effect, -1 if effect.whole_arm else int(joints[0]) - 1)
    if values is None:
        trial = _fitted(bench, candidate)
        shape, coefficients, rows = trial.shape, trial.score.coefficients, trial.rows
    else:
        shape, coefficients = effect.shape_of(values, form), effect.coefficients_of(values)
        rows = bench.dictionary.rows(candidate, shape)
    if not any(np.any(part) for part in rows.values()):
        raise DataError(f"{name} leaves no torque in these sessions, so it has no signature")
    # A form may use fewer coefficients than its effect.
    coefficients = coefficients[: next(iter(rows.values())).shape[1]]
    evidence = bench.evidence
    cross = evidence.products.beside(rows).sums[0].sum(axis=0)
    projection = evidence.full.inverse @ cross.T
    torque, left = _torques(bench, rows, projection, coefficients)
    whole = _weighted(bench, rows, None)
    columns = _weighted(bench, rows, projection)
    size = np.linalg.norm(columns @ coefficients)
    linear = {p.name: float(v) for p, v in zip(effect.linear, coefficients, strict=False)}
    return Signature(
        name,
        candidate.joints,
        {**linear, **shape},
        shape.form,
        {side: side_rows.time for side, side_rows in bench.nominal.rows.items()},
        {side: side_rows.session for side, side_rows in bench.nominal.rows.items()},
        torque,
        left,
        float(size),
        float(size**2 / max(float(np.sum((whole @ coefficients) ** 2)), 1e-300)),
        columns,
        coefficients,
    )


def _fitted(bench: DiagnosisBench, candidate: Candidate) -> Trial:
    """The candidate with its best shape, even with implausible coefficients."""
    dictionary = bench.dictionary
    best = dictionary.best(candidate)
    if best is not None:
        return best
    found = []
    for shape in candidate.effect.shapes(dictionary.setting, max(candidate.joint, 0)):
        rows = dictionary.rows(candidate, shape)
        if any(np.any(part) for part in rows.values()):
            score = bench.evidence.score(rows)
            found.append(Trial(candidate, shape, score, rows))
    if not found:
        raise DataError(f"{candidate.cause} leaves no torque in these sessions, so it has no signature")
    return max(found, key=lambda trial: trial.score.fitted)


def _torques(
    bench: DiagnosisBench, rows: Rows, projection: Floats, coefficients: Floats
) -> tuple[dict[str, Floats], dict[str, Floats]]:
    """Torque (m, n) [Nm] by side, and its remainder in the rows in use."""
    torque, left = {}, {}
    for side, side_rows in bench.nominal.rows.items():
        torque[side] = np.zeros(side_rows.target.shape)
        for (of_side, joint), columns in rows.items():
            if of_side == side:
                torque[side][:, joint] = columns @ coefficients
        used = side_rows.valid & ~side_rows.test[:, None]
        rest = torque[side] - bench.evidence.predicted(side, projection @ coefficients)
        left[side] = np.where(used, rest, np.nan)
    return torque, left


def _weighted(bench: DiagnosisBench, rows: Rows, projection: Floats | None) -> Floats:
    """Columns (all rows used, k) in units of the noise, minus their projection on the present columns."""
    evidence = bench.evidence
    width = next(iter(rows.values())).shape[1]
    parts = []
    for side, side_rows in bench.nominal.rows.items():
        images = None
        if projection is not None:
            images = [evidence.predicted(side, projection[:, k]) for k in range(width)]
        for joint in range(side_rows.target.shape[1]):
            key: Key = (side, joint)
            used = side_rows.valid[:, joint] & ~side_rows.test
            table = rows[key][used] if key in rows else np.zeros((int(used.sum()), width))
            if images is not None:
                table = table - np.stack([image[used, joint] for image in images], axis=1)
            noise = evidence.sigma[side][joint] * np.sqrt(evidence.variance_inflation[side][joint])
            parts.append(table / noise)
    return np.concatenate(parts)
