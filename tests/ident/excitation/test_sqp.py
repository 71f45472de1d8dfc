from __future__ import annotations

import numpy as np
import pytest

from ident.excitation.sqp import minimise


class HockSchittkowski:
    """Problem 43 (Rosen and Suzuki): minimum -44 at (0, 1, 2, -1)."""

    def values(self, x: np.ndarray) -> tuple[float, np.ndarray]:
        self.x = a, b, c, d = x
        value = a**2 + b**2 + 2 * c**2 + d**2 - 5 * a - 5 * b - 21 * c + 7 * d
        return float(value), np.array(
            [
                8 - a**2 - b**2 - c**2 - d**2 - a + b - c + d,
                10 - a**2 - 2 * b**2 - c**2 - 2 * d**2 + a + d,
                5 - 2 * a**2 - b**2 - c**2 - 2 * a + b + d,
            ]
        )

    def derivatives(self) -> tuple[np.ndarray, np.ndarray]:
        a, b, c, d = self.x
        gradient = np.array([2 * a - 5, 2 * b - 5, 4 * c - 21, 2 * d + 7])
        jacobian = np.array(
            [
                [-2 * a - 1, -2 * b + 1, -2 * c - 1, -2 * d + 1],
                [-2 * a + 1, -4 * b, -2 * c, -4 * d + 1],
                [-4 * a - 2, -2 * b + 1, -2 * c, 1],
            ]
        )
        return gradient, jacobian


class Contradiction:
    """x >= 1 and x <= -1: no solution, the middle violates least."""

    def values(self, x: np.ndarray) -> tuple[float, np.ndarray]:
        self.x = x
        return 0.0, np.array([x[0] - 1.0, -1.0 - x[0]])

    def derivatives(self) -> tuple[np.ndarray, np.ndarray]:
        return np.zeros(1), np.array([[1.0], [-1.0]])


def test_known_optimum_with_active_constraints() -> None:
    solution = minimise(HockSchittkowski(), np.zeros(4), iterations=100, tolerance=1e-9)
    np.testing.assert_allclose(solution.x, [0.0, 1.0, 2.0, -1.0], atol=1e-4)
    assert solution.value == pytest.approx(-44.0, abs=1e-5)
    assert solution.constraints.min() > -1e-5
    np.testing.assert_allclose(solution.multipliers, [1.0, 0.0, 2.0], atol=1e-2)


def test_contradicting_constraints_end_where_least_is_violated() -> None:
    solution = minimise(Contradiction(), np.array([2.5]), iterations=50)
    assert abs(solution.x[0]) <= 1.0 + 1e-6, "anywhere between the two violates least in sum"
