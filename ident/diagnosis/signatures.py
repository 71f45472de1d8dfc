"""Signatures: what a cause would leave in the rows after everything else was fitted again.

A cause can be found only by the part of its torque that the base parameters, and the tolerated deviations of
the nominal arm, cannot imitate: with rows weighted by their noise, the columns `X` of the cause less their
projection on the columns `W` of the rest, `X - W (W' W)^-1 W' X`. Its length, in units of the noise, says whether
the sessions can show the cause at all; the angle between the signatures of two causes says whether they can
tell one from the other. Principal angles: Bjorck and Golub, Mathematics of Computation 27 (1973).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from fri.errors import DataError
from ident.diagnosis.bench import ArmData, Bench, nominal_arm, prepare_bench
from ident.diagnosis.candidates import Candidate, Trial
from ident.diagnosis.evidence import Floats, Key, Rows
from ident.diagnosis.recording import record
from ident.diagnosis.reference import Reference
from ident.diagnosis.selection import select
from ident.diagnosis.settings import DiagnosisSettings
from ident.dynamics.kinematics import Chain
from ident.effects import Form, Shape, find_effect

if TYPE_CHECKING:
    from lwr_driver.session import Session

__all__ = ["Cause", "Signature", "overlap", "signature_bench", "signatures"]

Cause = tuple[str, Sequence[int]]
"""Name of a cause and its joints, counted from 1; none for the whole arm."""


@dataclass(frozen=True, eq=False)
class Signature:
    """What a cause does to the torques, as the sessions fit it.

    cause, joints : see `Cause`. parameters, form : of the torque, those of the shape included.
    time, session : by side, (m,) of the rows [s] and their session's number.
    torque : by side, (m, n) [Nm], the whole torque of the cause. left : the same without what the base
    parameters make of it; NaN where a row is not used.
    strength : length of `left` in units of the noise: the square is the fall of the chi-square that the cause
    would bring. share : part of the torque's power that is left, 0 to 1.
    """

    cause: str
    joints: tuple[int, ...]
    parameters: Mapping[str, float]
    form: Form | None
    time: Mapping[str, Floats]
    session: Mapping[str, Floats]
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
) -> Bench:
    """The bench of a diagnosis of sessions, with the tolerated deviations of the nominal arm beside its base.

    Raises DataError, with advice, for sessions that cannot be used.
    """
    settings = settings or DiagnosisSettings()
    if not sessions:
        raise DataError("no session given; name at least one session file")
    ordered = sorted(sessions, key=lambda s: s.start)
    recordings = [record(s, k, chain, settings) for k, s in enumerate(ordered)]
    known = nominal_arm(chain, arm, reference)
    bench = prepare_bench(known, recordings, settings, reference, (), fit_compliance=reference is None)
    select(bench.dictionary, bench.evidence, settings)
    return bench


def signatures(
    bench: Bench,
    causes: Sequence[Cause],
    *,
    parameters: Sequence[Mapping[str, float] | None] | None = None,
    forms: Sequence[str | Form | None] | None = None,
) -> tuple[Signature, ...]:
    """Signatures of causes on the rows fitted of a bench, each by itself beside the base.

    parameters : a full set of values of each cause, None for those of the best fit. forms : their forms. Raises
    ConfigurationError for an unknown cause, DataError for one without a torque in these sessions.
    """
    none = [None] * len(causes)
    given = zip(causes, parameters or none, forms or none, strict=True)
    return tuple(_signature(bench, cause, values, form) for cause, values, form in given)


def overlap(a: Signature, b: Signature) -> float:
    """Cosine, 0 to 1, of the angle between what is left of `a` and the nearest that `b` can do.

    Of `b` the shape is kept and the coefficients are free, so of causes with one column each it is the cosine of
    the angle between the two; 1 means that these sessions cannot tell `a` from `b`, 0 that neither hides the
    other. `1 - overlap^2` is the share of the power of `a` that is still left beside `b`. Raises ValueError for
    signatures of different benches.
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
    bench: Bench, cause: Cause, values: Mapping[str, float] | None, form: str | Form | None
) -> Signature:
    name, joints = cause
    effect = find_effect(name)
    candidate = Candidate(effect, -1 if effect.whole_arm else int(joints[0]) - 1)
    rows: Rows
    shape: Shape
    if values is None:
        trial = _fitted(bench, candidate)
        shape, coefficients = trial.shape, trial.score.coefficients
        rows = trial.rows
    else:
        shape, coefficients = effect.shape_of(values, form), effect.coefficients_of(values)
        rows = bench.dictionary.rows(candidate, shape)
    if not any(np.any(part) for part in rows.values()):
        raise DataError(f"{name} leaves no torque in these sessions, so it has no signature")
    # An effect of several forms has no more columns than the form has coefficients.
    coefficients = coefficients[: next(iter(rows.values())).shape[1]]
    evidence = bench.evidence
    padded = evidence.padded(rows)
    cross = evidence.products(padded).base.sum(axis=0)
    lever = evidence.full.inverse @ cross.T
    torque, left = _torques(bench, rows, lever, coefficients)
    whole = _weighted(bench, rows, None)
    columns = _weighted(bench, rows, lever)
    size = np.linalg.norm(columns @ coefficients)
    linear = {p.name: float(v) for p, v in zip(effect.linear, coefficients, strict=False)}
    return Signature(
        name,
        candidate.joints,
        {**linear, **shape},
        shape.form,
        {side: side_rows.time for side, side_rows in bench.nominal.rows.items()},
        {side: side_rows.session.astype(float) for side, side_rows in bench.nominal.rows.items()},
        torque,
        left,
        float(size),
        float(size**2 / max(float(np.sum((whole @ coefficients) ** 2)), 1e-300)),
        columns,
        coefficients,
    )


def _fitted(bench: Bench, candidate: Candidate) -> Trial:
    """The candidate with the shape that the data like best, whether its coefficients make sense or not."""
    dictionary = bench.dictionary
    best = dictionary.best(candidate)
    if best is not None:
        return best
    found = []
    for shape in candidate.effect.shapes(dictionary.setting, max(candidate.joint, 0)):
        rows = dictionary.rows(candidate, shape)
        if any(np.any(part) for part in rows.values()):
            score = bench.evidence.score(bench.evidence.padded(rows))
            found.append(Trial(candidate, shape, score, rows))
    if not found:
        raise DataError(f"{candidate.cause} leaves no torque in these sessions, so it has no signature")
    return max(found, key=lambda trial: trial.score.fitted)


def _torques(
    bench: Bench, rows: Rows, lever: Floats, coefficients: Floats
) -> tuple[dict[str, Floats], dict[str, Floats]]:
    """Torque (m, n) [Nm] by side, and what is left of it where rows are used."""
    torque, left = {}, {}
    for side, side_rows in bench.nominal.rows.items():
        torque[side] = np.zeros(side_rows.target.shape)
        for (of_side, joint), columns in rows.items():
            if of_side == side:
                torque[side][:, joint] = columns @ coefficients
        used = side_rows.valid & ~side_rows.test[:, None]
        rest = torque[side] - bench.evidence.predicted(side, lever @ coefficients)
        left[side] = np.where(used, rest, np.nan)
    return torque, left


def _weighted(bench: Bench, rows: Rows, lever: Floats | None) -> Floats:
    """Columns (all rows used, k) in units of the noise, less their image in the present columns."""
    evidence = bench.evidence
    width = next(iter(rows.values())).shape[1]
    parts = []
    for side, side_rows in bench.nominal.rows.items():
        images = None
        if lever is not None:
            images = [evidence.predicted(side, lever[:, k]) for k in range(width)]
        for joint in range(side_rows.target.shape[1]):
            key: Key = (side, joint)
            used = side_rows.valid[:, joint] & ~side_rows.test
            table = rows[key][used] if key in rows else np.zeros((int(used.sum()), width))
            if images is not None:
                table = table - np.stack([image[used, joint] for image in images], axis=1)
            noise = evidence.sigma[side][joint] * np.sqrt(evidence.variance_inflation[side][joint])
            parts.append(table / noise)
    return np.concatenate(parts)
