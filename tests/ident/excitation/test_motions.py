"""B-splines and the point-to-point baseline: the same interface, the same exactness as the Fourier series."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fri.errors import ConfigurationError, RefusedError
from ident.excitation import ExcitationPlan, PointToPoint, SplineBasis, Workspace, check_motion, random_points
from ident.excitation.arm_model import Mechanism
from ident.excitation.check import Limits
from ident.excitation.motions import ParametricMotion


@pytest.fixture
def spline(rng: np.random.Generator) -> ParametricMotion:
    basis = SplineBasis(15.0, 9)
    return basis.motion(rng.normal(size=(7, basis.free)))


@pytest.fixture
def points(mechanism: Mechanism, limits: Limits) -> PointToPoint:
    return random_points(mechanism, limits, count=5, seed=2)


@pytest.mark.parametrize("kind", ["spline", "points"])
def test_derivatives_extrema_and_rest(kind: str, request: pytest.FixtureRequest) -> None:
    motion: ParametricMotion = request.getfixturevalue(kind)
    t, h = np.linspace(0.01, motion.duration - 0.01, 400), 1e-6
    before, here, after = (motion.sample(t + shift) for shift in (-h, 0.0, h))
    for order in range(3):
        slope = (after[order] - before[order]) / (2 * h)
        np.testing.assert_allclose(slope, here[order + 1], atol=2e-3 if order == 2 else 1e-6)
    dense = motion.sample(np.linspace(0.0, motion.duration, 20001))
    for order in range(4):
        extrema = motion.extrema(order)
        peak = np.abs(dense[order]).max()
        assert np.all(extrema.high >= dense[order].max(axis=0) - 1e-9 * peak)
        assert np.all(extrema.low <= dense[order].min(axis=0) + 1e-9 * peak)
        np.testing.assert_allclose(extrema.high, dense[order].max(axis=0), atol=2e-3 * peak)
    ends = motion.sample([0.0, motion.duration])
    np.testing.assert_allclose(ends.qd, 0.0, atol=1e-9)
    np.testing.assert_allclose(ends.qdd, 0.0, atol=1e-6)
    np.testing.assert_allclose(ends.q[0], ends.q[1], atol=1e-9)


def test_the_matrix_gives_the_spline(rng: np.random.Generator) -> None:
    basis = SplineBasis(15.0, 9)
    x = rng.normal(size=(7, basis.free))
    spline = basis.motion(x)
    np.testing.assert_allclose(basis.matrix([1.0, 7.3], 2) @ x.T, spline.sample([1.0, 7.3]).qdd, atol=1e-10)


def test_points_reach_a_limit_on_every_segment_and_break_none(
    mechanism: Mechanism, limits: Limits, points: PointToPoint
) -> None:
    check = check_motion(points, mechanism, limits, workspace=Workspace())
    assert check.ok, check
    speeds = [np.abs(points.extrema(order).high) for order in (1, 2)]
    assert max((speeds[0] / limits.v_max).max(), (speeds[1] / limits.a_max).max()) > 0.99
    for posture in points.postures:
        assert (
            np.abs(points.sample(np.linspace(0, points.duration, 5001)).q - posture).max(axis=1).min() < 0.02
        )
    slow = random_points(mechanism, limits, count=5, seed=2, speed_scale=0.5)
    np.testing.assert_array_equal(slow.postures, points.postures)
    assert slow.duration > points.duration


def test_points_take_the_time_asked_for(mechanism: Mechanism, limits: Limits, points: PointToPoint) -> None:
    paused = random_points(mechanism, limits, count=5, seed=2, duration_s=25.0)
    assert paused.duration == pytest.approx(25.0)
    np.testing.assert_array_equal(paused.postures, points.postures)
    plan = ExcitationPlan(paused, tuple("abcdefg"))
    assert plan.rows(0.005).shape == (5001, 7)
    with pytest.raises(ConfigurationError, match=r"5 postures take .* longer than 5\.0 s"):
        random_points(mechanism, limits, count=5, seed=2, duration_s=5.0)


def test_points_obey_the_jerk_limit(mechanism: Mechanism, limits: Limits) -> None:
    smooth = replace(limits, j_max=np.full(7, 20.0))
    motion = random_points(mechanism, smooth, count=3, seed=2)
    jerk = motion.extrema(3)
    assert max(jerk.high.max(), -jerk.low.min()) == pytest.approx(20.0, rel=1e-9)


def test_points_in_an_impossible_workspace_are_refused(mechanism: Mechanism, limits: Limits) -> None:
    with pytest.raises(RefusedError, match="no posture within the workspace"):
        random_points(mechanism, limits, workspace=Workspace(radius_m=2.0))


@pytest.mark.parametrize("kind", ["spline", "points"])
def test_plan_files_keep_every_kind_of_motion(
    kind: str, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    motion: ParametricMotion = request.getfixturevalue(kind)
    plan = ExcitationPlan(motion, tuple("abcdefg"), provenance={"seed": 1})
    plan.save(tmp_path / "plan.yaml")
    read = ExcitationPlan.load(tmp_path / "plan.yaml")
    t = np.linspace(0.0, motion.duration, 50)
    np.testing.assert_array_equal(read.motion.sample(t).qd, motion.sample(t).qd)


@pytest.mark.parametrize("way", [0.9, 1.0, 1.1, 1.7, 2.3])
def test_a_segment_that_just_fails_to_cruise_is_a_smooth_triangle(way: float) -> None:
    """Speed and acceleration limits that meet exactly leave no time at full speed, whatever the rounding."""
    acceleration = 1.3
    motion = PointToPoint(
        np.array([[0.0], [way]]), np.array([10.0]), np.array([acceleration]), np.array([1000.0])
    )
    times = np.linspace(0.0, motion.duration, 2001)
    samples = motion.sample(times)
    assert samples.q[-1, 0] == pytest.approx(way, abs=1e-9)
    assert np.abs(samples.qd).max() == pytest.approx(np.sqrt(acceleration * way), rel=1e-2)
    assert np.abs(samples.qdd).max() <= acceleration * (1.0 + 1e-9)
