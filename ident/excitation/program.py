"""The planning problem as a nonlinear program: variables, objective, limits c(x) >= 0, and their derivatives.

All samples of one limit of one joint, or of one distance, are gathered into one smooth number by the
Kreisselmeier-Steinhauser function

    KS(u) = max u + log(sum exp(r (u - max u))) / r,   max u <= KS(u) <= max u + log(m) / r,

with errors to the safe side that shrink as the rate r grows. Limits are scaled to u = 1 at the limit. Rows far from
their limit need no derivative and get none.

The variables are the free coefficients, flattened. Goal attainment adds one more, s: equation (10) is solved as

    minimise s  subject to  log(F_i / goal_i) <= s  for every criterion i,

with the same solution (gamma = exp(s) - 1). This form stays smooth at the solution, with two criteria equally far
from their goals.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit

from ident.excitation.arm_model import (
    FCL,
    FCM,
    FVL,
    FVM,
    IA,
    OFFL,
    OFFM,
    ArmEstimate,
    Mechanism,
    torque_deviation,
)
from ident.excitation.check import KINEMATIC, Limits
from ident.excitation.clearance import Space, distances, row_gradient
from ident.excitation.criteria import Criterion, GoalAttainment, Pullback
from ident.excitation.information import Columns, Evaluator, View
from ident.excitation.motions import Array, Basis, Samples

_FAR = 0.6
_FAR_TORQUE = 0.2
_SPACE_SCALE = 0.1
_FLANGE_SCALE = 0.3
# Share of the torque limits kept for the moments between the samples, where the torque has no known peak.
_TORQUE_RESERVE = 0.01
_RATIO_SLOPE = 0.03  # typical change of a wrist torque's log ratio per radian of a coefficient


@dataclass(frozen=True, eq=False)
class Bound:
    """Upper limit of a criterion, in its own (logarithmic) scale, while another one is minimised."""

    criterion: Criterion
    limit: float


@dataclass(frozen=True)
class Row:
    """Limit behind a row of c: constraint and joint index, or index of the distance."""

    constraint: str
    index: int


class Constraints:
    """c(x) and its Jacobian for one evaluator; rows in the order of `rows`."""

    def __init__(
        self,
        evaluator: Evaluator,
        limits: Limits,
        space: Space,
        floor: Array,
        bounds: Sequence[Bound] = (),
        *,
        coverage: float = 3.0,
    ) -> None:
        self.evaluator, self.limits, self.space = evaluator, limits, space
        self.floor = np.array(floor, dtype=np.float64)
        self.bounds, self.coverage = tuple(bounds), coverage
        n = evaluator.mechanism.joints
        self.rate = 100.0
        self._middle = 0.5 * (limits.q_low + limits.q_high)
        halves = np.array([0.5 * (limits.q_high - limits.q_low), limits.v_max, limits.a_max, limits.j_max])
        factor = [evaluator.basis.grid_factor(evaluator.fine, order) for order in range(4)]
        self.half = halves / np.array(factor)[:, None]
        self.torque_limit = limits.tau_max * (1.0 - _TORQUE_RESERVE)
        self.tracked = [row for row in range(space.rows) if np.isfinite(self.floor[row])]
        self.scale = np.where(np.arange(space.rows) < 2, _FLANGE_SCALE, _SPACE_SCALE)
        self.deviation = np.zeros((2, evaluator.loads.shape[0], evaluator.samples, n))
        self.rows = (
            [Row(name, joint) for name, _ in KINEMATIC for joint in range(n)]
            + [Row("torque", joint) for joint in range(n)]
            + [Row("distance", row) for row in self.tracked]
            + [Row("bound", index) for index in range(len(self.bounds))]
        )

    def values(self, signals: Sequence[Array], view: View, sharpness: float) -> Array:
        """c, (rows,); the view must be the evaluator's latest."""
        n, rate = self.evaluator.mechanism.joints, self.rate
        self._kinematic_value = np.empty((4, n))
        self._kinematic_weight = np.zeros((4, self.evaluator.fine, n))
        for order in range(4):
            middle = self._middle if order == 0 else np.zeros(n)
            share = (signals[order] - middle) / self.half[order]
            _ks(np.abs(share), rate, self._kinematic_value[order], self._kinematic_weight[order])
            self._kinematic_weight[order][share <= 0.0] *= -1.0
        torque = self._torque_rows()
        self._q = np.ascontiguousarray(signals[0])
        distance, tracked = distances(self.evaluator.mechanism, self.space, self._q), self.tracked
        scaled = (self.floor[tracked] - distance[:, tracked]) / self.scale[tracked]
        space, self._space_weight = np.empty(len(tracked)), np.zeros_like(scaled)
        _ks(scaled, rate, space, self._space_weight)
        self._bound_pulls = [bound.criterion.evaluate(view, sharpness) for bound in self.bounds]
        bounds = np.array(
            [bound.limit - pull[0] for bound, pull in zip(self.bounds, self._bound_pulls, strict=True)]
        )
        self.latest = np.concatenate([1.0 - self._kinematic_value.ravel(), 1.0 - torque, -space, bounds])
        return self.latest

    def _torque_rows(self) -> Array:
        """KS of |torque| over samples, load cases and sides, as a share of the limit; (n,)."""
        evaluator = self.evaluator
        drives, tau = evaluator.estimate.drives, evaluator.tau
        qd, qdd = evaluator.z[:, :, -3].T, evaluator.z[:, :, -4].T
        joint = tau + qd * drives[:, FVL] + drives[:, OFFL]
        motor = joint + qdd * drives[:, IA] + qd * drives[:, FVM] + drives[:, OFFM]
        both = np.stack([joint, motor])
        own = np.stack([np.zeros(len(drives)), np.abs(drives[:, FCM])])
        coulomb = np.abs(drives[:, FCL]) + own[:, None, None]
        share = (np.abs(both) + coulomb + self.deviation) / self.torque_limit
        n = evaluator.mechanism.joints
        flat = np.ascontiguousarray(share.reshape(-1, n))
        value, weight = np.empty(n), np.zeros_like(flat)
        _ks(flat, self.rate, value, weight)
        self._torque_weight = weight.reshape(share.shape) * np.sign(both) / self.torque_limit
        return value

    def jacobian(self, view: View) -> Array:
        """dc/dx of the latest values, (rows, n * free); zero for rows far from their limit. Clears the adjoints."""
        evaluator = self.evaluator
        n, free = evaluator.mechanism.joints, evaluator.basis.free
        out = np.zeros((len(self.rows), n, free))
        near = self.latest < _FAR
        for order in range(4):
            rows = np.arange(order * n, (order + 1) * n)
            block = -(self._kinematic_weight[order] / self.half[order]).T @ evaluator.matrices[order]
            out[rows, np.arange(n)] = block
        for joint in range(n):
            if self.latest[4 * n + joint] < _FAR_TORQUE:
                out[4 * n + joint] = -self._torque_gradient(joint)
        qbar = np.empty_like(self._q)
        for index, row in enumerate(self.tracked):
            if not near[5 * n + index]:
                continue
            weight = np.ascontiguousarray(self._space_weight[:, index]) / self.scale[row]
            row_gradient(evaluator.mechanism.geometry, self._q, row, weight, qbar, self.space.shapes)
            out[5 * n + index] = qbar.T @ evaluator.matrices[0]
        for index, (_, pull) in enumerate(self._bound_pulls):
            view.clear()
            pull(-1.0)
            out[5 * n + len(self.tracked) + index] = evaluator.gradient(view)
        return out.reshape(len(self.rows), -1)

    def _torque_gradient(self, joint: int) -> Array:
        evaluator = self.evaluator
        drives = evaluator.estimate.drives
        weight = np.zeros_like(self._torque_weight)
        weight[..., joint] = self._torque_weight[..., joint]
        sides = weight.sum(axis=1)
        rate = sides.sum(axis=0) * drives[:, FVL] + sides[1] * drives[:, FVM]
        return evaluator.torque_gradient(weight.sum(axis=0), rate, sides[1] * drives[:, IA])

    def refresh_deviation(self, signals: Sequence[Array]) -> None:
        """Recompute the torque uncertainty along the motion, fixed within an inner optimisation."""
        evaluator = self.evaluator
        if evaluator.estimate.covariance is None or self.coverage <= 0.0:
            return
        samples = Samples(*(np.ascontiguousarray(signal[:: evaluator.refine]) for signal in signals))
        for load in range(evaluator.loads.shape[0]):
            found = torque_deviation(evaluator.mechanism, samples, evaluator.estimate, loaded=load == 1)
            self.deviation[0, load] = self.coverage * found.joint
            self.deviation[1, load] = self.coverage * found.motor


@njit(cache=True, error_model="numpy")
def _ks(u, rate, value, weight):  # type: ignore[no-untyped-def]
    """Fill value (k,) with KS over the samples of each column of u (m, k), weight (m, k) with its weights."""
    m, k = u.shape
    for j in range(k):
        peak = -np.inf
        for i in range(m):
            peak = max(peak, u[i, j])
        total = 0.0
        for i in range(m):
            power = rate * (u[i, j] - peak)
            if power > -25.0:
                weight[i, j] = np.exp(power)
                total += weight[i, j]
        value[j] = peak + np.log(total) / rate
        for i in range(m):
            weight[i, j] /= total


class Program:
    """Objective and constraints of one evaluator; `sharpness` and `constraints.rate` set their smoothness.

    Without a target the objective is the squared distance to `anchor`, for a feasible motion near it.
    """

    def __init__(self, evaluator: Evaluator, constraints: Constraints, target: Criterion | None) -> None:
        self.evaluator, self.constraints, self.target = evaluator, constraints, target
        self.sharpness = 8.0
        self.anchor = np.zeros(0)
        self.evaluations = 0
        self._asked = constraints.bounds
        self._goals = target if isinstance(target, GoalAttainment) else None
        self._shift = np.zeros(0 if self._goals is None else len(self._goals.goals))

    def variables(self, x: Array) -> Array:
        """The solver's variables at the flattened coefficients x."""
        if self._goals is None:
            return x
        view = self.evaluator.view(self.signals(x), exact_sign=True)
        return np.append(x, np.max(self._goals.log_ratios(view, np.inf)[0]))

    def curvature(self) -> Array | None:
        """A first guess of the Hessian for the solver; None to take its size from the gradient."""
        if self._goals is None:
            return None
        count = self.evaluator.mechanism.joints * self.evaluator.basis.free + 1
        return _RATIO_SLOPE * np.eye(count)

    def coefficients(self, variables: Array) -> Array:
        """The flattened coefficients among the solver's variables."""
        return variables if self._goals is None else variables[:-1]

    def values(self, variables: Array) -> tuple[float, Array]:
        """Objective and constraints."""
        self.evaluations += 1
        evaluator = self.evaluator
        x = self._x = self.coefficients(variables)
        self._signals = self.signals(x)
        self._view = evaluator.view(self._signals)
        c = self.constraints.values(self._signals, self._view, self.sharpness)
        if self.target is None:
            return 0.5 * float(np.sum((x - self.anchor) ** 2)), c
        if self._goals is not None:
            ratios, self._pulls = self._goals.log_ratios(self._view, self.sharpness)
            return float(variables[-1]), np.append(c, variables[-1] + self._shift - ratios)
        value, self._pull = self.target.evaluate(self._view, self.sharpness)
        return value, c

    def derivatives(self) -> tuple[Array, Array]:
        """Gradient and Jacobian at the latest point."""
        jacobian = self.constraints.jacobian(self._view)
        if self.target is None:
            return self._x - self.anchor, jacobian
        if self._goals is not None:
            slopes = np.array([self._slope(pull) for pull in self._pulls])
            below = np.column_stack([-slopes, np.ones(len(slopes))])
            above = np.column_stack([jacobian, np.zeros(len(jacobian))])
            return np.append(np.zeros(self._x.size), 1.0), np.vstack([above, below])
        return self._slope(self._pull), jacobian

    def _slope(self, pull: Pullback) -> Array:
        self._view.clear()
        pull(1.0)
        return self.evaluator.gradient(self._view).ravel()

    def signals(self, x: Array) -> list[Array]:
        """Signals on the fine grid at flattened coefficients."""
        return self.evaluator.signals(x.reshape(self.evaluator.mechanism.joints, -1))

    def calibrate(self, x: Array, reserve: float = 0.0) -> None:
        """Shift bounds and goals by the smoothing error of their criteria at x, less a reserve (bounds only).

        The smooth condition number lies a few percent above the exact one; a bound on it would cost as much.
        """
        if not self._asked and self._goals is None:
            return
        signals = self.signals(x)
        smooth = self.evaluator.view(signals)
        values = [bound.criterion.evaluate(smooth, self.sharpness)[0] for bound in self._asked]
        ratios = self._shift if self._goals is None else self._goals.log_ratios(smooth, self.sharpness)[0]
        exact = self.evaluator.view(signals, exact_sign=True)
        self.constraints.bounds = tuple(
            Bound(bound.criterion, bound.limit + value - bound.criterion.evaluate(exact, np.inf)[0] - reserve)
            for bound, value in zip(self._asked, values, strict=True)
        )
        if self._goals is not None:
            self._shift = ratios - self._goals.log_ratios(exact, np.inf)[0]

    def exact(self, x: Array) -> float:
        """The target itself, unsmoothed and with the true sign of the velocities."""
        if self.target is None:
            return 0.0
        evaluator = self.evaluator
        view = evaluator.view(self.signals(x), exact_sign=True)
        return self.target.evaluate(view, np.inf)[0]


@dataclass(frozen=True, eq=False)
class Setup:
    """The complete optimisation problem; can be sent to another process."""

    mechanism: Mechanism
    basis: Basis
    limits: Limits
    space: Space
    floor: Array
    estimate: ArmEstimate
    columns: Columns
    target: Criterion | None
    bounds: tuple[Bound, ...] = ()
    coverage: float = 3.0
    samples: int = 64
    refine: int = 5

    def program(self, *, feasibility: bool = False) -> Program:
        """A fresh optimisation program; `feasibility`: without target and bounds."""
        evaluator = Evaluator(
            self.mechanism, self.basis, self.estimate, self.columns, samples=self.samples, refine=self.refine
        )
        target = None if feasibility else self.target
        bounds = () if target is None else self.bounds
        constraints = Constraints(
            evaluator, self.limits, self.space, self.floor, bounds, coverage=self.coverage
        )
        return Program(evaluator, constraints, target)
