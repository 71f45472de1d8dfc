from __future__ import annotations

import numpy as np
import pytest

from ident.excitation.arm_model import ArmEstimate, Mechanism, tip_path, torque_bounds
from ident.excitation.check import prove, speed_bound, swept_radius, torque_rate
from ident.excitation.motions import FourierBasis, FourierSeries


@pytest.fixture
def series(rng: np.random.Generator) -> FourierSeries:
    basis = FourierBasis(8.0, 5)
    return basis.motion(0.3 * rng.normal(size=(7, basis.free)))


def _constant(bound: float):  # type: ignore[no-untyped-def]
    return lambda times, half: np.full(times.shape, bound)


def test_a_dip_between_samples_is_found(series: FourierSeries) -> None:
    # a V of slope 5 that is negative for 2 ms only, between the first samples taken
    dip = lambda t: 5.0 * np.abs(t - 3.2345) - 0.005  # noqa: E731
    outcome = prove(series, dip, _constant(5.0), step_s=0.02)
    assert not outcome.proven
    assert outcome.least < 0.0
    assert outcome.time_s == pytest.approx(3.2345, abs=0.002)


def test_positive_functions_are_proven_with_work_only_where_it_is_tight(series: FourierSeries) -> None:
    tight = lambda t: 5.0 * np.abs(t - 3.2345) + 2e-4  # noqa: E731
    outcome = prove(series, tight, _constant(5.0), step_s=0.02)
    assert outcome.proven
    assert 0.0 < outcome.least < 5e-3
    assert outcome.samples < 1000


def test_what_touches_zero_is_not_proven(series: FourierSeries) -> None:
    outcome = prove(series, lambda t: np.abs(t - 3.2345), _constant(1.0))
    assert not outcome.proven


def test_speed_bound_holds(mechanism: Mechanism, series: FourierSeries) -> None:
    extents = np.zeros(7)
    extents[-1] = 0.078
    rate = speed_bound(series, swept_radius(mechanism, extents))
    times = np.linspace(0.1, 7.9, 400)
    for half in (1e-3, 2e-2):
        moved = [tip_path(mechanism, series.sample(times + side * half).q) for side in (-1, 1)]
        speed = np.linalg.norm(moved[1] - moved[0], axis=1) / (2 * half)
        assert np.all(speed <= rate(times, half))
        assert np.median(rate(times, half) / speed) < 8.0, "the bound is of use"


def test_torque_rate_bound_holds(mechanism: Mechanism, series: FourierSeries, estimate: ArmEstimate) -> None:
    uncertain = estimate.with_relative_uncertainty(0.1)
    rate = torque_rate(series, mechanism, uncertain, 3.0)
    times, half = np.linspace(0.1, 7.9, 500), 1e-3
    bounds = [torque_bounds(mechanism, series.sample(times + side * half), uncertain) for side in (-1, 1)]
    for before, after in zip(bounds[0], bounds[1], strict=True):
        assert np.all(np.abs(after - before) / (2 * half) <= rate(times, half))
