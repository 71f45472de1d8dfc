"""Dynamic regressor extension and mixing (Aranovskiy, Bobtsov, Ortega and Pyrkin 2017) for weak excitation.

Extension: the regression y = a^T chi is accumulated with a fading memory (Kreisselmeier's filter),

    Phi <- lambda Phi + sum w a a^T,    Y <- lambda Y + sum w a y,    so that Y = Phi chi at any time.

Mixing: multiplied by a row of the adjugate it falls apart into p scalar regressions, z_i = d_i chi_i. Any
scale of a row may be chosen; here d_i^2 = 1 / (Phi^-1)_ii, the information on parameter i that the others
leave, which is zero as long as the motion cannot tell i from them and does not suffer when other directions
are not excited (the determinant would). Each parameter is then a scalar weighted mean over the whole motion:
it moves only when it is excited and keeps its initial value otherwise, and its error never grows because of
another parameter's.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ident.estimators.covariance import CovarianceSettings, Scores, textbook
from ident.estimators.estimate import Estimate
from ident.estimators.problem import FloatArray, Problem
from ident.estimators.solution import estimate_from
from ident.estimators.timeline import Instant, instants

__all__ = ["RegressorExtensionMixing"]


@dataclass(frozen=True)
class RegressorExtensionMixing:
    """Element-wise estimates that need no persistent excitation.

    memory_s : time constant of the extension [s]; it runs on from one session to the next. every : instants
        between two mixings.
    initial, initial_std : values (p,) to begin with and their standard deviation (a number or (p,)); what is
        never excited stays there. sigma : standard deviation of the rows by class, None takes the root mean
        square of the torque by class as a scale, which needs no solution of the whole problem.
    null : share of a parameter in the unexcited directions above which it counts as not excited.
    """

    memory_s: float = 30.0
    every: int = 5
    initial: FloatArray | None = None
    initial_std: float | FloatArray = 1e4
    sigma: dict[str, float] | None = None
    null: float = 1e-6
    covariance: CovarianceSettings = field(default_factory=CovarianceSettings)

    def fit(self, problem: Problem) -> Estimate:
        """Estimate (p,); its covariance follows from the estimate being linear in the torques."""
        p = len(problem.names)
        weights = self._weights(problem)
        start = np.zeros(p) if self.initial is None else np.asarray(self.initial, dtype=np.float64)
        steps = list(instants(problem))
        forgetting = float(np.exp(-problem.sample_time_s / self.memory_s))
        extended, moment = np.zeros((p, p)), np.zeros(p)
        information = 1.0 / np.broadcast_to(np.asarray(self.initial_std, dtype=np.float64), (p,)) ** 2
        total, moving = information.copy(), information * start
        mixings: dict[int, tuple[FloatArray, FloatArray]] = {}
        for number, step in enumerate(steps):
            w = weights[step.classes]
            extended = forgetting * extended + (step.matrix.T * w) @ step.matrix
            moment = forgetting * moment + step.matrix.T @ (w * step.target)
            last = number + 1 == len(steps) or steps[number + 1].record != step.record
            if (number + 1) % self.every == 0 or last:
                inverse, gain = _mix(extended, self.null)
                total = total + gain
                moving = moving + gain * (inverse @ moment)
                mixings[number] = (inverse, gain)
        values = moving / total
        scores, white = _influence(problem, steps, mixings, total, weights, forgetting, values)
        asleep = [problem.names[k] for k in np.flatnonzero(total <= 2.0 * information)]
        notes = (f"never excited, kept at their initial values: {', '.join(asleep)}",) if asleep else ()
        covariance = white + np.diag((information / total) ** 2 / information)
        return estimate_from(
            problem,
            method="regressor extension and mixing",
            values=values,
            weights=weights,
            bread=np.eye(p),
            consumed=np.full(len(problem.classes), p / len(problem.classes)),
            settings=self.covariance,
            scores=scores,
            offset=np.diag((information / total) ** 2 / information),
            plain=textbook(covariance),
            notes=notes,
        )

    def _weights(self, problem: Problem) -> FloatArray:
        if self.sigma is not None:
            return np.array([1.0 / self.sigma[c.label] ** 2 for c in problem.classes])
        power = [
            float(c.factor.r[:, -1] @ c.factor.r[:, -1]) / max(c.factor.rows, 1) for c in problem.classes
        ]
        return 1.0 / np.maximum(np.array(power), 1e-12 * max(power))


def _mix(extended: FloatArray, null: float) -> tuple[FloatArray, FloatArray]:
    """Pseudo-inverse (p, p) of the extended regressor and the gain d_i^2 (p,) of each scalar regression."""
    scale = np.sqrt(np.diag(extended))
    used = scale > 0
    safe = np.where(used, scale, 1.0)
    values, vectors = np.linalg.eigh(extended / np.outer(safe, safe))
    alive = values > 1e-10 * values[-1]
    inverse = (vectors[:, alive] / values[alive]) @ vectors[:, alive].T
    hidden = np.sum(vectors[:, ~alive] ** 2, axis=1)
    spread = np.diag(inverse)
    excited = used & (hidden < null) & (spread > 0)
    gain = np.where(excited, safe**2 / np.where(spread > 0, spread, 1.0), 0.0)
    return inverse / np.outer(safe, safe), gain


def _influence(
    problem: Problem,
    steps: list[Instant],
    mixings: dict[int, tuple[FloatArray, FloatArray]],
    total: FloatArray,
    weights: FloatArray,
    forgetting: float,
    values: FloatArray,
) -> tuple[Scores, FloatArray]:
    """Influence of every instant on the estimate, as scores, and
    the covariance for uncorrelated residuals.
    """
    p = len(values)
    records: dict[int, list[tuple[int, FloatArray]]] = {}
    white = np.zeros((p, p))
    variance = _class_variance(problem, values)
    back = np.zeros((p, p))
    for number in range(len(steps) - 1, -1, -1):
        step = steps[number]
        back = forgetting * back
        if number in mixings:
            inverse, gain = mixings[number]
            back = back + (gain / total)[:, None] * inverse
        rows = step.matrix * weights[step.classes][:, None]
        carried = back @ rows.T
        records.setdefault(step.record, []).append(
            (step.time_index, carried @ (step.target - step.matrix @ values))
        )
        white += (carried * variance[step.classes]) @ carried.T
    arrays = []
    for record in sorted(records):
        times = np.array([time for time, _ in records[record]])
        array = np.zeros((int(times.max() - times.min()) + 1, p))
        array[times - times.min()] = [influence for _, influence in records[record]]
        arrays.append(array)
    return Scores(tuple(arrays)), white


def _class_variance(problem: Problem, values: FloatArray) -> FloatArray:
    return np.array([c.factor.sum_of_squares(values) / max(c.factor.rows, 1) for c in problem.classes])
