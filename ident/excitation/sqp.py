"""Sequential quadratic programming for a smooth objective under c(x) >= 0, dense and small.

Quasi-Newton SQP with Powell's damped BFGS update and an l1 merit function (Nocedal and Wright, chapter 18).
The quadratic subproblem is elastic: constraint violation has a quadratic price, so a solution always exists. Its dual
is a non-negative least-squares problem with one unknown per constraint, solved by scipy.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.linalg import LinAlgError, cholesky, solve_triangular
from scipy.optimize import nnls

from ident.excitation.motions import Array

_ELASTIC = 1e6
_ARMIJO = 1e-4
_LONGEST_STEP = 0.3
_BACKTRACKS = 8


class SmoothProblem(Protocol):
    """Objective and constraints; derivatives refer to the point of the latest `values`."""

    def values(self, x: Array) -> tuple[float, Array]:
        """f(x), c(x)."""

    def derivatives(self) -> tuple[Array, Array]:
        """Gradient (n,) and Jacobian (m, n)."""


@dataclass(eq=False)
class Solution:
    """Final state of the iteration. `hessian` can start the next one nearby."""

    x: Array
    value: float
    constraints: Array
    multipliers: Array
    hessian: Array


def minimise(
    problem: SmoothProblem,
    x: Array,
    *,
    iterations: int = 60,
    tolerance: float = 1e-4,
    hessian: Array | None = None,
) -> Solution:
    """Minimise from x until a step promises less than `tolerance`, for at most `iterations`."""
    n = x.size
    x = x.copy()
    value, c = problem.values(x)
    gradient, jacobian = problem.derivatives()
    b = np.eye(n) * max(float(np.linalg.norm(gradient)), 1e-3) if hessian is None else hessian.copy()
    multipliers = np.zeros(c.size)
    price = 0.0
    for _ in range(iterations):
        step, multipliers = _subproblem(b, gradient, jacobian, c)
        longest = float(np.max(np.abs(step)))
        if longest > _LONGEST_STEP:
            step *= _LONGEST_STEP / longest
        violation = float(np.sum(np.maximum(0.0, -c)))
        price = max(1.5 * float(multipliers.max(initial=0.0)), 0.9 * price)
        promised = float(gradient @ step) - price * violation
        if promised > -tolerance * 1e-3 and violation < 1e-9:
            break
        merit = value + price * violation
        share = 1.0
        for _ in range(_BACKTRACKS):
            trial = x + share * step
            trial_value, trial_c = problem.values(trial)
            trial_merit = trial_value + price * float(np.sum(np.maximum(0.0, -trial_c)))
            if trial_merit <= merit + _ARMIJO * share * promised:
                break
            curvature = trial_merit - merit - share * promised
            ideal = -0.5 * promised * share**2 / curvature if curvature > 0.0 else 0.5 * share
            share = float(np.clip(ideal, 0.1 * share, 0.5 * share))
        new_gradient, new_jacobian = problem.derivatives()
        moved = trial - x
        change = (new_gradient - new_jacobian.T @ multipliers) - (gradient - jacobian.T @ multipliers)
        b = _damped_bfgs(b, moved, change)
        gained = merit - trial_merit
        x, value, c, gradient, jacobian = trial, trial_value, trial_c, new_gradient, new_jacobian
        if abs(gained) < tolerance * 0.1 and violation < 1e-4:
            break
    return Solution(x, value, c, multipliers, b)


def _subproblem(b: Array, gradient: Array, jacobian: Array, c: Array) -> tuple[Array, Array]:
    """Step and multipliers of min g d + d B d / 2 + (elastic/2) |violation of c + J d >= 0|²."""
    try:
        factor = cholesky(b, lower=True, check_finite=False)
    except LinAlgError:
        b = b + 1e-6 * np.trace(b) * np.eye(b.shape[0])
        factor = cholesky(b, lower=True, check_finite=False)
    active = np.flatnonzero(np.any(jacobian != 0.0, axis=1))
    y = solve_triangular(
        factor, np.column_stack([gradient, jacobian[active].T]), lower=True, check_finite=False
    )
    multipliers = np.zeros(c.size)
    if active.size:
        inner = y[:, 1:].T @ y[:, 1:]
        inner[np.diag_indices_from(inner)] += 1.0 / _ELASTIC + 1e-12 * np.trace(inner)
        root = cholesky(inner, check_finite=False)
        target = solve_triangular(root, y[:, 1:].T @ y[:, 0] - c[active], trans="T", check_finite=False)
        try:
            multipliers[active] = nnls(root, target, maxiter=10 * active.size)[0]
        except RuntimeError:
            multipliers[active] = np.maximum(0.0, solve_triangular(root, target, check_finite=False))
    step = -solve_triangular(
        factor, y[:, 0] - y[:, 1:] @ multipliers[active], lower=True, trans="T", check_finite=False
    )
    return step, multipliers


def _damped_bfgs(b: Array, moved: Array, change: Array) -> Array:
    """Powell's update; B stays positive definite for any curvature along the step."""
    bs = b @ moved
    sbs = float(moved @ bs)
    if sbs < 1e-18:
        return b
    sy = float(moved @ change)
    if sy < 0.2 * sbs:
        theta = 0.8 * sbs / (sbs - sy)
        change = theta * change + (1.0 - theta) * bs
        sy = float(moved @ change)
    return b - np.outer(bs, bs) / sbs + np.outer(change, change) / sy
