"""The limits of a planning problem as a short vector c(x) >= 0 with its Jacobian.

All samples of one limit of one joint, or of one distance, are gathered into one smooth number by the
Kreisselmeier-Steinhauser function

    KS(u) = max u + log(sum exp(r (u - max u))) / r,   max u <= KS(u) <= max u + log(m) / r,

which errs to the safe side, less so as the rate r grows. Limits are scaled so that u = 1 is the limit. Rows
far from their limit need no derivative and get none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit

from ident.excitation.check import Limits
from ident.excitation.evaluation import Evaluator
from ident.excitation.motion import Array, Samples
from ident.excitation.objectives import Criterion, View
from ident.excitation.space import Space, distances, row_gradient
from ident.excitation.torque import torque_deviation

__all__ = ["Bound", "Constraints", "Row"]

_IA, _FVL, _FCL, _OFFL, _FVM, _FCM, _OFFM = range(7)
_NAMES = ("position", "velocity", "acceleration", "jerk")
_FAR = 0.6
_FAR_TORQUE = 0.2
_SPACE_SCALE = 0.1
_FLANGE_SCALE = 0.3


@dataclass(frozen=True, eq=False)
class Bound:
    """A criterion that must stay at or below a limit, in its own (logarithmic) scale, while another is
    minimised.
    """

    criterion: Criterion
    limit: float


@dataclass(frozen=True)
class Row:
    """Which limit a row of c stands for: constraint and joint index, or index of the distance."""

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
        torque_reserve: float = 0.01,
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
        self.torque_limit = limits.tau_max * (1.0 - torque_reserve)
        self.tracked = [row for row in range(space.rows) if np.isfinite(self.floor[row])]
        self.scale = np.where(np.arange(space.rows) < 2, _FLANGE_SCALE, _SPACE_SCALE)
        self.deviation = np.zeros((2, evaluator.loads.shape[0], evaluator.samples, n))
        self.rows = (
            [Row(name, joint) for name in _NAMES for joint in range(n)]
            + [Row("torque", joint) for joint in range(n)]
            + [Row("distance", row) for row in self.tracked]
            + [Row("bound", index) for index in range(len(self.bounds))]
        )
        self._weights: dict[int, Array] = {}

    def values(self, signals: Sequence[Array], view: View, sharpness: float) -> Array:
        """c, (rows,); the view must be the evaluator's latest."""
        n, rate = self.evaluator.mechanism.joints, self.rate
        self._kinematic_value = np.empty((4, n))
        self._kinematic_weight = np.zeros((4, self.evaluator.fine, n))
        for order in range(4):
            middle = self._middle if order == 0 else np.zeros(n)
            _ks_two_sided(
                signals[order],
                middle,
                self.half[order],
                rate,
                self._kinematic_value[order],
                self._kinematic_weight[order],
            )
        torque = self._torque_rows()
        self._q = np.ascontiguousarray(signals[0])
        mechanism = self.evaluator.mechanism
        distance = distances(mechanism, self.space, self._q)
        tracked = self.tracked
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
        joint = tau + qd * drives[:, _FVL] + drives[:, _OFFL]
        motor = joint + qdd * drives[:, _IA] + qd * drives[:, _FVM] + drives[:, _OFFM]
        both = np.stack([joint, motor])
        coulomb = (
            np.abs(drives[:, _FCL])
            + np.stack([np.zeros(len(drives)), np.abs(drives[:, _FCM])])[:, None, None]
        )
        share = (np.abs(both) + coulomb + self.deviation) / self.torque_limit
        n = evaluator.mechanism.joints
        flat = np.ascontiguousarray(share.reshape(-1, n))
        value, weight = np.empty(n), np.zeros_like(flat)
        _ks(flat, self.rate, value, weight)
        self._torque_weight = weight.reshape(share.shape) * np.sign(both) / self.torque_limit
        return value

    def jacobian(self, view: View) -> Array:
        """dc/dx of the latest values, (rows, n * free); rows far from their limit are zero. Clears the
        view's adjoints.
        """
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
        mechanism = evaluator.mechanism
        for index, row in enumerate(self.tracked):
            if not near[5 * n + index]:
                continue
            weight = np.ascontiguousarray(self._space_weight[:, index]) / self.scale[row]
            row_gradient(mechanism.geometry, self._q, row, weight, qbar, self.space.shapes)
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
        rate = sides.sum(axis=0) * drives[:, _FVL] + sides[1] * drives[:, _FVM]
        return evaluator.torque_gradient(weight.sum(axis=0), rate, sides[1] * drives[:, _IA])

    def refresh_deviation(self, signals: Sequence[Array]) -> None:
        """Recompute the torque uncertainty along the motion; it is held fixed within an inner
        optimisation.
        """
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
    """KS over the samples of each column of u (m, k), and its weights."""
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


@njit(cache=True, error_model="numpy")
def _ks_two_sided(signal, middle, half, rate, value, weight):  # type: ignore[no-untyped-def]
    """KS of |signal - middle| / half over the samples, both signs; weights carry the sign."""
    m, n = signal.shape
    for j in range(n):
        peak = 0.0
        for i in range(m):
            peak = max(peak, abs(signal[i, j] - middle[j]))
        peak /= half[j]
        total = 0.0
        for i in range(m):
            u = (signal[i, j] - middle[j]) / half[j]
            power = rate * (abs(u) - peak)
            if power > -25.0:
                grown = np.exp(power)
                weight[i, j] = grown if u > 0.0 else -grown
                total += grown
        value[j] = peak + np.log(total) / rate
        for i in range(m):
            weight[i, j] /= total
