"""Estimators that take the rows in the order of measurement, while the arm moves.

Recursive least squares keeps the information as a triangular factor, updated by orthogonal transformations
(Bierman 1977), so it stays positive definite. Forgetting acts on the information from the data, never on the
initial one; this prevents wind-up without excitation.

Dynamic regressor extension and mixing (Aranovskiy, Bobtsov, Ortega and Pyrkin 2017) is for weak excitation.
Extension: the regression y = a^T chi is accumulated with a fading memory (Kreisselmeier's filter),

    Phi <- lambda Phi + sum w a a^T,    Y <- lambda Y + sum w a y,    so that Y = Phi chi at any time.

Mixing: multiplied by a row of the adjugate it separates into p scalar regressions, z_i = d_i chi_i. The scale
of a row is free; here d_i^2 = 1 / (Phi^-1)_ii, the information on parameter i left by the others. It is zero as
long as the motion cannot distinguish i from them, and unlike the determinant does not suffer from other
unexcited directions. Each parameter is then a scalar weighted mean over the whole motion: it moves only when
excited, keeps its initial value otherwise, and its error never grows with another parameter's.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import solve_triangular

from fri.errors import ConfigurationError
from ident.dynamics.parameters import Floats
from ident.estimators.covariance import CovarianceSettings, Scores, textbook
from ident.estimators.estimate import Estimate
from ident.estimators.least_squares import consumed_parameters, estimate_from, weighted_solution
from ident.estimators.prior import Prior
from ident.estimators.problem import Problem


@dataclass(frozen=True)
class Instant:
    """All rows of one instant: matrix (k, p), target (k,), class of each row (k,), record and time."""

    record: int
    time_index: int
    matrix: Floats
    target: Floats
    classes: np.ndarray


def instants(problem: Problem) -> Iterator[Instant]:
    """Rows of each instant, record after record, in time."""
    records = sorted({group.record for group in problem.groups})
    for record in records:
        members = [
            (group, number)
            for group, number in zip(problem.groups, problem.class_of_group, strict=True)
            if group.record == record and len(group.target)
        ]
        matrix = np.concatenate([group.matrix for group, _ in members])
        target = np.concatenate([group.target for group, _ in members])
        time = np.concatenate([group.time_index for group, _ in members])
        classes = np.concatenate([np.full(len(group.target), number) for group, number in members])
        order = np.argsort(time, kind="stable")
        values, starts = np.unique(time[order], return_index=True)
        bounds = np.append(starts, len(order))
        for k, value in enumerate(values):
            rows = order[bounds[k] : bounds[k + 1]]
            yield Instant(record, int(value), matrix[rows], target[rows], classes[rows])


class RecursiveFilter:
    """Square-root information filter for p constant or slowly drifting parameters.

    initial : (p + 1, p + 1) triangular factor of the initial information [A y]. forgetting : factor per
        update on the information gathered so far, 1 keeps all.
    """

    def __init__(self, initial: Floats, forgetting: float = 1.0) -> None:
        if not 0.0 < forgetting <= 1.0:
            raise ConfigurationError(
                f"forgetting {forgetting} must lie in (0, 1]; 0.99 forgets over 100 updates"
            )
        self._initial = initial
        self._forgetting = forgetting
        self._r = initial.copy()

    @classmethod
    def start(cls, mean: Floats, std: Floats, forgetting: float = 1.0) -> RecursiveFilter:
        """Filter beginning at `mean` (p,) with standard deviations `std` (p,)."""
        information = 1.0 / np.asarray(std, dtype=np.float64)
        p = len(information)
        r = np.zeros((p + 1, p + 1))
        r[:p, :p] = np.diag(information)
        r[:p, p] = information * mean
        return cls(r, forgetting)

    def update(self, matrix: Floats, target: Floats, sigma: Floats | float) -> None:
        """Take in rows (k, p) with targets (k,) and standard deviations [Nm]."""
        rows = np.column_stack([matrix, target]) / np.broadcast_to(sigma, target.shape)[:, None]
        parts = [np.sqrt(self._forgetting) * self._r, rows]
        if self._forgetting < 1.0:
            parts.append(np.sqrt(1.0 - self._forgetting) * self._initial)
        self._r = np.asarray(np.linalg.qr(np.vstack(parts), mode="r"), dtype=np.float64)

    @property
    def values(self) -> Floats:
        """Present estimate (p,)."""
        p = self._r.shape[1] - 1
        return solve_triangular(self._r[:p, :p], self._r[:p, p])

    @property
    def root(self) -> Floats:
        """(p, p) with root root^T the covariance for uncorrelated rows."""
        p = self._r.shape[1] - 1
        return solve_triangular(self._r[:p, :p], np.eye(p))


@dataclass(frozen=True)
class Track:
    """Course of a recursive estimate: records and time indices (K,), values and standard deviations (K, p)."""

    record: np.ndarray
    time_index: np.ndarray
    values: Floats
    std: Floats


@dataclass(frozen=True)
class RecursiveLeastSquares:
    """Weighted recursive least squares with forgetting.

    memory_s : time constant of the forgetting [s], None keeps all, with the result of WLS.
    prior : initial information; None begins without any (a standard deviation of `initial_std`).
    sigma : standard deviation of the rows by class label ("A1 motor"); None takes those of a WLS.
    """

    memory_s: float | None = None
    prior: Prior | None = None
    initial_std: float = 1e4
    sigma: dict[str, float] | None = None
    covariance: CovarianceSettings = field(default_factory=CovarianceSettings)

    def start(self, problem: Problem) -> RecursiveFilter:
        """The filter before the first row."""
        forgetting, p = self._forgetting(problem), len(problem.names)
        if self.prior is None:
            return RecursiveFilter.start(np.zeros(p), np.full(p, self.initial_std), forgetting)
        weak = np.eye(p) / self.initial_std**2
        r = np.zeros((p + 1, p + 1))
        r[:p, :p] = np.linalg.cholesky(self.prior.precision + weak).T
        r[:p, p] = solve_triangular(r[:p, :p].T, self.prior.precision @ self.prior.mean, lower=True)
        return RecursiveFilter(r, forgetting)

    def track(self, problem: Problem, *, every: int = 1) -> Track:
        """The estimate after every `every`-th instant."""
        sigma, recursion = self._sigma(problem), self.start(problem)
        found: list[tuple[int, int, Floats, Floats]] = []
        for count, instant in enumerate(instants(problem), start=1):
            recursion.update(instant.matrix, instant.target, sigma[instant.classes])
            if count % every == 0:
                std = np.linalg.norm(recursion.root, axis=1)
                found.append((instant.record, instant.time_index, recursion.values, std))
        record, time_index, values, deviations = zip(*found, strict=True)
        return Track(np.array(record), np.array(time_index), np.array(values), np.array(deviations))

    def fit(self, problem: Problem) -> Estimate:
        """Estimate after the last row; with forgetting, older rows count less."""
        sigma, recursion = self._sigma(problem), self.start(problem)
        ages: dict[int, dict[int, int]] = {}
        count = 0
        for instant in instants(problem):
            recursion.update(instant.matrix, instant.target, sigma[instant.classes])
            ages.setdefault(instant.record, {})[instant.time_index] = count
            count += 1
        forgetting = self._forgetting(problem)
        values, root, weights = recursion.values, recursion.root, 1.0 / sigma**2
        coefficients, row_weights = [], []
        for group, residual, number in zip(
            problem.groups, problem.residuals(values), problem.class_of_group, strict=True
        ):
            age = count - 1 - np.array([ages[group.record][int(t)] for t in group.time_index])
            row_weights.append(weights[number] * forgetting**age)
            coefficients.append(row_weights[-1] * residual)
        consumed = consumed_parameters(problem, weights, root)
        return estimate_from(
            problem,
            method="recursive least squares",
            values=values,
            weights=weights,
            bread=root @ root.T,
            consumed=np.minimum(consumed, [0.5 * c.factor.rows for c in problem.classes]),
            settings=self.covariance,
            coefficients=coefficients,
            row_weights=row_weights,
            notes=() if self.memory_s is None else (f"forgets with a time constant of {self.memory_s:g} s",),
        )

    def _forgetting(self, problem: Problem) -> float:
        return 1.0 if self.memory_s is None else float(np.exp(-problem.sample_time_s / self.memory_s))

    def _sigma(self, problem: Problem) -> Floats:
        if self.sigma is None:
            _, weights, *_ = weighted_solution(problem)
            return 1.0 / np.sqrt(weights)
        missing = [c.label for c in problem.classes if c.label not in self.sigma]
        if missing:
            raise ConfigurationError(
                f"`sigma` lacks {missing[0]!r}; give a standard deviation for each joint and side"
            )
        return np.array([self.sigma[c.label] for c in problem.classes])


@dataclass(frozen=True)
class RegressorExtensionMixing:
    """Element-wise estimates without persistent excitation.

    memory_s : time constant of the extension over all sessions [s]. every : instants between two mixings.
    initial, initial_std : initial values (p,) and their standard deviation (a number or (p,)), kept by
        parameters never excited. sigma : standard deviation of the rows by class; None takes the root mean
        square of the torque by class as a scale, without a solution of the whole problem.
    null : largest share of an excited parameter in the unexcited directions.
    """

    memory_s: float = 30.0
    every: int = 5
    initial: Floats | None = None
    initial_std: float | Floats = 1e4
    sigma: dict[str, float] | None = None
    null: float = 1e-6
    covariance: CovarianceSettings = field(default_factory=CovarianceSettings)

    def fit(self, problem: Problem) -> Estimate:
        """Estimate (p,), with the covariance of an estimate linear in the torques."""
        p = len(problem.names)
        weights = self._weights(problem)
        start = np.zeros(p) if self.initial is None else np.asarray(self.initial, dtype=np.float64)
        steps = list(instants(problem))
        forgetting = float(np.exp(-problem.sample_time_s / self.memory_s))
        extended, moment = np.zeros((p, p)), np.zeros(p)
        information = 1.0 / np.broadcast_to(np.asarray(self.initial_std, dtype=np.float64), (p,)) ** 2
        total, moving = information.copy(), information * start
        mixings: dict[int, tuple[Floats, Floats]] = {}
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

    def _weights(self, problem: Problem) -> Floats:
        if self.sigma is not None:
            return np.array([1.0 / self.sigma[c.label] ** 2 for c in problem.classes])
        power = [c.factor.mean_square for c in problem.classes]
        return 1.0 / np.maximum(np.array(power), 1e-12 * max(power))


def _mix(extended: Floats, null: float) -> tuple[Floats, Floats]:
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
    mixings: dict[int, tuple[Floats, Floats]],
    total: Floats,
    weights: Floats,
    forgetting: float,
    values: Floats,
) -> tuple[Scores, Floats]:
    """Influence of every instant on the estimate, as scores, and the covariance for uncorrelated residuals."""
    p = len(values)
    records: dict[int, list[tuple[int, Floats]]] = {}
    white = np.zeros((p, p))
    variance = np.array([c.factor.sum_of_squares(values) / max(c.factor.rows, 1) for c in problem.classes])
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
