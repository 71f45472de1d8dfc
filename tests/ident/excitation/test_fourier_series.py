from __future__ import annotations

import numpy as np
import pytest

from fri.errors import ConfigurationError
from ident.excitation.motions import FourierBasis, FourierSeries


def test_every_choice_of_free_coefficients_is_at_rest_at_both_ends(rng: np.random.Generator) -> None:
    basis = FourierBasis(20.0, 5)
    series = basis.motion(rng.normal(size=(7, basis.free)))
    ends = series.sample([0.0, 20.0, 40.0])
    assert series.at_rest
    np.testing.assert_allclose(ends.qd, 0.0, atol=1e-13)
    np.testing.assert_allclose(ends.qdd, 0.0, atol=1e-13)
    np.testing.assert_allclose(ends.q[0], ends.q[1], atol=1e-12)


def test_series_is_equation_9() -> None:
    series = FourierSeries(10.0, np.array([0.5]), np.array([[0.1, 0.2]]), np.array([[-0.3, 0.4]]))
    t, w = 1.7, 2 * np.pi / 10.0
    expected = (
        0.5 + 0.1 * np.sin(w * t) - 0.3 * np.cos(w * t) + 0.2 * np.sin(2 * w * t) + 0.4 * np.cos(2 * w * t)
    )
    assert series.sample(t).q[0, 0] == pytest.approx(expected, abs=1e-15)


def test_derivatives_agree_with_differences(rng: np.random.Generator) -> None:
    series = FourierBasis(12.0, 4).motion(rng.normal(size=(3, 7)))
    t, h = np.linspace(0.3, 11.0, 9), 1e-5
    for order in range(4):
        difference = (series.derivative(t + h, order) - series.derivative(t - h, order)) / (2 * h)
        np.testing.assert_allclose(series.derivative(t, order + 1), difference, atol=1e-8, rtol=1e-7)


@pytest.mark.parametrize("harmonics", [2, 5, 9])
def test_extrema_are_exact_and_the_grid_bound_encloses_them(harmonics: int, rng: np.random.Generator) -> None:
    basis = FourierBasis(20.0, harmonics)
    series = basis.motion(rng.normal(size=(4, basis.free)))
    dense = np.linspace(0.0, 20.0, 40001)
    for order in range(4):
        values = series.derivative(dense, order)
        extrema = series.extrema(order)
        peak = np.max(np.abs(values))
        assert np.all(extrema.high >= values.max(axis=0) - 1e-12 * peak)
        assert np.all(extrema.low <= values.min(axis=0) + 1e-12 * peak)
        np.testing.assert_allclose(extrema.high, values.max(axis=0), atol=1e-5 * peak)
        np.testing.assert_allclose(extrema.low, values.min(axis=0), atol=1e-5 * peak)
        at = np.diag(series.derivative(extrema.t_high, order))
        np.testing.assert_allclose(at, extrema.high, atol=1e-12 * peak)
        bias = series.bias if order == 0 else 0.0
        true = np.maximum(np.abs(extrema.high - bias), np.abs(extrema.low - bias))
        samples = series.derivative(np.arange(6 * harmonics) * (series.period_s / (6 * harmonics)), order)
        centred = samples - series.bias if order == 0 else samples
        bound = np.max(np.abs(centred), axis=0) * basis.grid_factor(6 * harmonics, order)
        assert np.all(bound >= true * (1 - 1e-12))


def test_constant_joint_has_equal_extrema() -> None:
    series = FourierSeries(5.0, np.array([0.3]), np.zeros((1, 3)), np.zeros((1, 3)))
    extrema = series.extrema(0)
    assert extrema.low[0] == extrema.high[0] == 0.3
    assert series.extrema(1).high[0] == 0.0


def test_the_matrix_gives_the_motion(rng: np.random.Generator) -> None:
    basis = FourierBasis(25.0, 5)
    x = rng.normal(size=(7, basis.free))
    t = np.linspace(0, 25, 11)
    for order, values in enumerate(basis.motion(x).sample(t)):
        np.testing.assert_allclose(basis.matrix(t, order) @ x.T, values, atol=1e-12)


def test_bad_series_are_refused() -> None:
    with pytest.raises(ConfigurationError, match="harmonics 1 is below 2"):
        FourierBasis(20.0, 1)
    with pytest.raises(ConfigurationError, match="base period"):
        FourierBasis(0.0, 5)
    with pytest.raises(ConfigurationError, match="not finite"):
        FourierSeries(1.0, np.array([np.nan]), np.zeros((1, 2)), np.zeros((1, 2)))
    moving = FourierSeries(20.0, np.zeros(1), np.ones((1, 5)), np.zeros((1, 5)))
    assert not moving.at_rest
