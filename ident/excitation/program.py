"""The planning problem in the form that the solver takes: values and derivatives at its variables.

The variables are the free coefficients, flattened. Goal attainment adds one more, s: equation (10) is solved as

    minimise s  subject to  log(F_i / goal_i) <= s  for every criterion i,

which has the same solution (gamma = exp(s) - 1) and stays smooth where two criteria are equally far from their
goals, which is where the solution lies.
"""

from __future__ import annotations

import numpy as np

from ident.excitation.constraints import Bound, Constraints
from ident.excitation.evaluation import Evaluator
from ident.excitation.motion import Array
from ident.excitation.objectives import Criterion, GoalAttainment, Pullback

__all__ = ["Program"]

_RATIO_SLOPE = 0.03  # typical change of a wrist torque's log ratio per radian of a coefficient


class Program:
    """Objective and constraints of one evaluator. `sharpness` and `constraints.rate` set how smooth both are.

    Without a target the objective is a weak pull to the start, for finding a feasible motion near it.
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
        """A first guess of the Hessian for the solver; None where the gradient tells its size."""
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
        """Shift bounds and goals by what smoothing adds to their criteria at x, less a reserve (bounds only).

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
