from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import pairwise

import numpy as np
import pytest

from fri.errors import ConfigurationError
from ident.excitation.criteria import (
    GoalAttainment,
    MeanTorque,
    d_optimality,
    log_condition,
    rsd_mean,
    rsd_worst,
    scaled,
    unscale,
)
from ident.excitation.information import View


@pytest.fixture
def information(rng: np.random.Generator) -> np.ndarray:
    a = rng.normal(size=(30, 8)) * np.logspace(0, 1.5, 8)
    return a.T @ a


def _slope(f: Callable[[np.ndarray], float], at: np.ndarray, step: np.ndarray) -> float:
    h = 1e-6 * np.linalg.norm(at) / np.linalg.norm(step)
    return (f(at + h * step) - f(at - h * step)) / (2 * h)


def test_exact_condition_number_is_that_of_the_matrix(rng: np.random.Generator) -> None:
    a = rng.normal(size=(30, 6))
    assert np.exp(log_condition(a.T @ a)[0]) == pytest.approx(np.linalg.cond(a))


def test_smooth_condition_number_bounds_the_exact_one_and_approaches_it(information: np.ndarray) -> None:
    exact = log_condition(information)[0]
    smooth = [log_condition(information, sharpness)[0] for sharpness in (4, 16, 64, 256)]
    assert all(later <= earlier + 1e-12 for earlier, later in pairwise(smooth))
    assert exact - 1e-12 <= smooth[-1] <= exact + np.log(8) / 256


@pytest.mark.parametrize(
    "criterion",
    [
        partial(log_condition, sharpness=8),
        partial(log_condition, sharpness=64),
        log_condition,
        d_optimality,
        partial(rsd_mean, values=np.linspace(0.2, 3.0, 8)),
        partial(rsd_worst, values=np.linspace(0.2, 3.0, 8), sharpness=16),
    ],
)
def test_derivatives_agree_with_differences(
    criterion, information: np.ndarray, rng: np.random.Generator
) -> None:  # type: ignore[no-untyped-def]
    step = rng.normal(size=information.shape)
    step = step + step.T
    _, bar = criterion(information)
    assert np.sum(bar * step) == pytest.approx(
        _slope(lambda at: criterion(at)[0], information, step), rel=1e-5
    )


def test_column_scaling_makes_the_criterion_blind_to_units(
    information: np.ndarray, rng: np.random.Generator
) -> None:
    units = np.exp(rng.normal(size=8))
    other = information * np.outer(units, units)
    plain, rescaled = (log_condition(scaled(matrix)[0], 16)[0] for matrix in (information, other))
    assert plain == pytest.approx(rescaled)
    normalised, scale = scaled(information)
    bar = unscale(log_condition(normalised, 16)[1], normalised, scale)
    step = rng.normal(size=(8, 8))
    step = step + step.T
    slope = _slope(lambda at: log_condition(scaled(at)[0], 16)[0], information, step)
    assert np.sum(bar * step) == pytest.approx(slope, rel=1e-5)


def test_singular_information_is_very_bad_and_not_an_exception() -> None:
    singular = np.diag([1.0, 0.0, 2.0])
    for value, bar in (log_condition(singular, 8), d_optimality(singular), rsd_mean(singular, np.ones(3))):
        assert value >= 50.0
        assert np.all(bar == 0.0)
    with pytest.raises(ConfigurationError, match="power of two"):
        log_condition(np.eye(2), 10)


def test_goal_attainment_is_the_worst_shortfall(rng: np.random.Generator) -> None:
    view = View(np.zeros((1, 1, 1)), rng.normal(size=(50, 2)))
    parts = (MeanTorque(0, 10.0, "A5"), MeanTorque(1, 20.0, "A6"))
    goal = GoalAttainment(parts, (9.0, 18.0))
    expected = [
        (10.0 - np.abs(view.torque[:, 0]).mean() - 9.0) / 9.0,
        (20.0 - np.abs(view.torque[:, 1]).mean() - 18.0) / 18.0,
    ]
    assert goal.evaluate(view, np.inf)[0] == pytest.approx(max(expected))
    value, pull = goal.evaluate(view, 8.0)
    assert max(expected) - 1e-4 <= value <= max(expected) + 0.01
    pull(1.0)
    step = rng.normal(size=(50, 2))
    slope = _slope(lambda at: goal.evaluate(View(view.gram, at), 8.0)[0], view.torque, step)
    assert np.sum(view.torque_bar * step) == pytest.approx(slope, rel=1e-5)


def test_log_ratios_of_goals_agree_with_the_attainment_and_with_differences(rng: np.random.Generator) -> None:
    view = View(np.zeros((1, 1, 1)), rng.normal(size=(50, 2)))
    goal = GoalAttainment((MeanTorque(0, 10.0, "A5"), MeanTorque(1, 20.0, "A6")), (9.0, 18.0))
    exact, _ = goal.log_ratios(view, np.inf)
    np.testing.assert_allclose(np.expm1(exact), [value for value, _ in goal._parts(view, np.inf)], rtol=1e-12)
    _, pulls = goal.log_ratios(view, 8.0)
    step = rng.normal(size=(50, 2))
    for k, pull in enumerate(pulls):
        view.clear()
        pull(1.0)

        def ratio(at: np.ndarray, k: int = k) -> float:
            return float(goal.log_ratios(View(view.gram, at), 8.0)[0][k])

        assert np.sum(view.torque_bar * step) == pytest.approx(_slope(ratio, view.torque, step), rel=1e-5)
    with pytest.raises(ConfigurationError, match="must be positive"):
        GoalAttainment((MeanTorque(0, 10.0, "A5"),), (0.0,))
