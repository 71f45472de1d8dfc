"""Parameters of a finding with their standard deviations, jointly estimated, from phases of the motion.

The torque of a finding is nonlinear in the parameters of its shape. Columns of the derivatives at the chosen shape
stand beside the cause's own, and everything is fitted jointly: base parameters, tolerated deviations, all other
findings. The derivatives' coefficients are the last step of a Gauss-Newton fit, so the values are the least-squares
solution in all parameters.

Model errors repeat with the motion, so the same phases of all periods of a session are one observation. Their scores
`s_k = X_k' r_k` give the covariance, each corrected for the leverage of its phase. With noise alone it equals the
covariance of least squares (Bell and McCaffrey, Survey Methodology 28 (2002)):

    V = sum_k g_k g_k' + G^-1 P G^-1,  g_k = G^-1/2 (1 - A_k)^-1/2 G^-1/2 s_k,  A_k = G^-1/2 X_k' X_k G^-1/2

with `G = sum_k X_k' X_k + P`, P the precision of the reference.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ident.diagnosis.causes.candidates import Dictionary, Trial
from ident.diagnosis.gain.evidence import Evidence
from ident.diagnosis.gain.products import Floats, Key, Rows
from ident.diagnosis.gain.score import widened

# Largest last step of a shape parameter over its value, for the linearisation to hold.
_NEAR = 0.3
# Least share of the information on a direction from the other phases.
_LEAST_REST = 0.05

Estimate = tuple[dict[str, float], dict[str, float]]
"""Values and standard deviations by the names of a cause's parameters."""


def estimated(dictionary: Dictionary, evidence: Evidence, trial: Trial) -> Estimate:
    """Values and standard deviations of a trial's parameters beside the present columns of the evidence.

    The evidence is restored. Shape parameters chosen from a grid have no standard deviation.
    """
    effect, shape = trial.candidate.effect, trial.shape
    moved, rows = _with_derivatives(dictionary, trial)
    linear = [p.name for p in effect.linear][: len(trial.score.coefficients)]
    with evidence.beside([*evidence.extra, rows]):
        place = evidence.full.values.size - len(linear) - len(moved)
        found = evidence.full.values[place:].copy()
        covariance = _clustered(evidence)[place:, place:]
    deviation = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    values = dict(zip(linear, (float(v) for v in trial.score.coefficients), strict=True))
    steps = {name: float(found[len(linear) + k]) for k, name in enumerate(moved)}
    if all(abs(step) < _NEAR * abs(shape[name]) for name, step in steps.items()):
        values = dict(zip(linear, (float(v) for v in found), strict=False))
        for name, step in steps.items():
            limits = next(p for p in effect.shape_parameters if p.name == name)
            shape = shape.at(**{name: float(np.clip(shape[name] + step, limits.low, limits.high))})
    deviations = dict(zip([*linear, *moved], (float(v) for v in deviation), strict=True))
    values.update({name: float(value) for name, value in shape.items()})
    for name, law in effect.law_std(values, shape.form).items():
        deviations[name] = float(np.hypot(deviations.get(name, 0.0), law))
    return values, {name: deviations.get(name, 0.0) for name in values}


def phases_of(evidence: Evidence) -> NDArray[np.int64]:
    """Number (blocks,) of each block's phase of the motion, the same in all periods of a session."""
    numbers: dict[tuple[int, int], int] = {}
    found = np.zeros(evidence.blocks, dtype=np.int64)
    recordings = {r.number: r for r in evidence.nominal.recordings}
    for block, (session, begin) in enumerate(zip(evidence.block_session, evidence.block_start, strict=True)):
        recording = recordings[int(session)]
        phase = round(1e3 * ((begin - recording.start_s) % recording.period_s))
        found[block] = numbers.setdefault((int(session), phase), len(numbers))
    return found


def _with_derivatives(dictionary: Dictionary, trial: Trial) -> tuple[Sequence[str], Rows]:
    """Names of the shape parameters with an influence on the torque, and the trial's columns with the derivatives."""
    shape = trial.shape
    parts: dict[Key, list[Floats]] = {key: [columns] for key, columns in trial.rows.items()}
    moved = []
    for name in trial.candidate.effect.continuous(shape):
        step = 0.02 * abs(shape[name]) or 0.02
        upper = dictionary.rows(trial.candidate, shape.at(**{name: shape[name] + step}))
        lower = dictionary.rows(trial.candidate, shape.at(**{name: shape[name] - step}))
        slopes = {key: (upper.get(key, 0.0) - lower.get(key, 0.0)) / (2.0 * step) for key in trial.rows}
        derivative = {key: (slope @ trial.score.coefficients)[:, None] for key, slope in slopes.items()}
        if any(np.any(column) for column in derivative.values()):
            moved.append(name)
            for key, column in derivative.items():
                parts[key].append(column)
    return moved, {key: np.concatenate(columns, axis=1) for key, columns in parts.items()}


def _clustered(evidence: Evidence) -> Floats:
    """Covariance (P, P) of all present columns from phases, at least that of independent rows."""
    gram, target = evidence.products.sums(phases_of(evidence))
    scores = target - gram @ evidence.full.values
    inverse = evidence.full.inverse
    size = np.sqrt(np.maximum(np.diag(inverse), 1e-300))
    # Any root R of the inverse, R R' = G^-1, for A_k turns with it.
    values, vectors = np.linalg.eigh(inverse / np.outer(size, size))
    root = size[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
    covariance = np.zeros_like(inverse)
    for part, score in zip(gram, scores, strict=True):
        share, axes = np.linalg.eigh(root.T @ part @ root)
        own = axes.T @ (root.T @ score) / np.sqrt(np.maximum(1.0 - share, _LEAST_REST))
        step = root @ (axes @ own)
        covariance += np.outer(step, step)
    if evidence.prior is not None:
        p = evidence.base_count
        covariance += inverse[:, :p] @ evidence.prior[0] @ inverse[:p]
    return widened(covariance, inverse)
