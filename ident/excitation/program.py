"""The planning problem in the form that the solver takes: values and derivatives at free coefficients."""

from __future__ import annotations

import numpy as np

from ident.excitation.constraints import Bound, Constraints
from ident.excitation.evaluation import Evaluator
from ident.excitation.motion import Array
from ident.excitation.objectives import Criterion

__all__ = ["Program"]


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

    def values(self, x: Array) -> tuple[float, Array]:
        """Objective and constraints."""
        self.evaluations += 1
        evaluator = self.evaluator
        self._x = x
        self._signals = self.signals(x)
        self._view = evaluator.view(self._signals)
        c = self.constraints.values(self._signals, self._view, self.sharpness)
        if self.target is None:
            return 0.5 * float(np.sum((x - self.anchor) ** 2)), c
        value, self._pull = self.target.evaluate(self._view, self.sharpness)
        return value, c

    def derivatives(self) -> tuple[Array, Array]:
        """Gradient and Jacobian at the latest point."""
        if self.target is None:
            return self._x - self.anchor, self.constraints.jacobian(self._view)
        self._view.clear()
        self._pull(1.0)
        gradient = self.evaluator.gradient(self._view).ravel()
        return gradient, self.constraints.jacobian(self._view)

    def signals(self, x: Array) -> list[Array]:
        """Signals on the fine grid at flattened coefficients."""
        return self.evaluator.signals(x.reshape(self.evaluator.mechanism.joints, -1))

    def calibrate(self, x: Array, reserve: float = 0.0) -> None:
        """Shift the bounds by what smoothing adds to the bounded criteria at x, less a reserve.

        The smooth condition number lies a few percent above the exact one; a bound on it would cost as much.
        """
        if not self._asked:
            return
        signals = self.signals(x)
        smooth = self.evaluator.view(signals)
        values = [bound.criterion.evaluate(smooth, self.sharpness)[0] for bound in self._asked]
        exact = self.evaluator.view(signals, exact_sign=True)
        self.constraints.bounds = tuple(
            Bound(bound.criterion, bound.limit + value - bound.criterion.evaluate(exact, np.inf)[0] - reserve)
            for bound, value in zip(self._asked, values, strict=True)
        )

    def exact(self, x: Array) -> float:
        """The target itself, unsmoothed and with the true sign of the velocities."""
        if self.target is None:
            return 0.0
        evaluator = self.evaluator
        view = evaluator.view(self.signals(x), exact_sign=True)
        return self.target.evaluate(view, np.inf)[0]
