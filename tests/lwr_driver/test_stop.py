from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad

from lwr_driver.guard import Retreat, Stop, stop_extent, stop_paths
from lwr_driver.motion import move_to
from tests.lwr_driver.driver_rig import START, arm

unit = st.lists(st.floats(-1.0, 1.0), min_size=7, max_size=7).map(np.array)
periods = st.sampled_from([0.001, 0.002, 0.005, 0.01, 0.05])


def history(q, v, a, j, period):
    """Rows now, one, two and three cycles ago with these backward differences."""
    limits = arm().limits
    v, a = v * limits.v_max, a * limits.a_max
    earlier = np.clip(a - j * limits.j_max * period, -limits.a_max, limits.a_max)
    q1 = q - v * period
    v1 = v - a * period
    q2 = q1 - v1 * period
    q3 = q2 - (v1 - earlier * period) * period
    return q, q1, q2, q3


def rows_of(stop: Stop, past) -> np.ndarray:
    stop.begin(*past[:3])
    rows = [*reversed(past)]
    while not stop.finished:
        rows.append(stop.advance(1))
    return np.array([*rows, rows[-1], rows[-1], rows[-1]])


@settings(max_examples=150, deadline=None, derandomize=True)
@given(v=unit, a=unit, j=unit, period=periods)
def test_every_difference_of_a_stop_is_within_its_limit(v, a, j, period):
    limits = arm().limits
    past = history(START, v, a, j, period)
    rows = rows_of(Stop(limits, period), past)
    acceleration = np.diff(rows, 2, axis=0) / period**2
    jerk = np.diff(rows, 3, axis=0) / period**3
    assert np.all(np.abs(acceleration) <= limits.a_max * (1 + 1e-6) + 1e-6)
    assert np.all(np.abs(jerk) <= limits.j_max * (1 + 1e-6) + 1e-3)


@settings(max_examples=150, deadline=None, derandomize=True)
@given(v=unit, a=unit, period=periods)
def test_extent_bounds_every_row_of_the_stop(v, a, period):
    limits = arm().limits
    past = history(START, v, a, np.zeros(7), period)
    rows = rows_of(Stop(limits, period), past)[3:]
    lowest, highest, speed = (bound[-1] for bound in stop_extent(limits, period, np.array(past[2::-1])))
    assert np.all(rows >= lowest - 1e-9)
    assert np.all(rows <= highest + 1e-9)
    assert np.all(np.abs(np.diff(rows, axis=0)) / period <= speed + 1e-9)


@settings(max_examples=150, deadline=None, derandomize=True)
@given(v=unit, a=unit)
def test_extent_is_too_wide_by_two_periods_at_the_highest_speed_at_most(v, a):
    limits, period = arm().limits, 1e-3
    past = history(START, v, a, np.zeros(7), period)
    rows = rows_of(Stop(limits, period), past)[3:]
    lowest, highest, speed = (bound[-1] for bound in stop_extent(limits, period, np.array(past[2::-1])))
    found = np.abs(np.diff(rows_of(Stop(limits, period), past)[2:], axis=0)).max(axis=0) / period
    # A peak between two rows is missed by half a period of full jerk at most.
    assert np.all(speed <= found + limits.j_max * period**2 + 1e-9)
    room = 2.0 * period * (speed + limits.a_max * period)
    assert np.all(rows.min(axis=0) - lowest <= room)
    assert np.all(highest - rows.max(axis=0) <= room)


def test_extent_of_every_row_looks_at_the_two_rows_before():
    limits, period = arm().limits, 1e-3
    motion = move_to(arm(), START, START + 0.4, period, speed_scale=0.7)
    whole = stop_extent(limits, period, motion.q)
    for row in (0, 1, 2, 57, 200, len(motion) - 1):
        past = motion.q[np.maximum([row - 2, row - 1, row], 0)]
        part = stop_extent(limits, period, past)
        for one, other in zip(whole, part, strict=True):
            np.testing.assert_allclose(one[row], other[-1], atol=1e-12)
    # At rest there is nothing to stop.
    for bound, expected in zip(whole, (START, START, np.zeros(7)), strict=True):
        np.testing.assert_allclose(bound[0], expected, atol=1e-12)


@settings(max_examples=150, deadline=None, derandomize=True)
@given(v=unit, a=unit, period=periods, every=st.integers(1, 5))
def test_stop_computed_beforehand_is_the_stop_that_is_driven(v, a, period, every):
    limits = arm().limits
    past = history(START, v, a, np.zeros(7), period)
    driven = rows_of(Stop(limits, period), past)[3:]
    (path,) = stop_paths(limits, period, np.array(past[2::-1]), np.array([2]), every)
    cycles = np.minimum(every * np.arange(len(path)), len(driven) - 1)
    assert cycles[-1] >= len(driven) - 4  # the last three rows of `driven` are at rest
    np.testing.assert_allclose(path, driven[cycles], atol=1e-9)


def test_stops_computed_at_once_are_those_of_each_row():
    limits, period = arm().limits, 5e-3
    motion = move_to(arm(), START, START + 0.4, period, speed_scale=0.7)
    rows = np.array([0, 1, 2, 30, 60, len(motion) - 1])
    for row, path in zip(rows, stop_paths(limits, period, motion.q, rows), strict=True):
        driven = rows_of(Stop(limits, period), motion.q[np.maximum(row - np.arange(4), 0)])[3:]
        np.testing.assert_allclose(path, driven[np.minimum(np.arange(len(path)), len(driven) - 1)], atol=1e-9)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(v=unit, a=unit, period=st.sampled_from([0.001, 0.01]), gaps=st.lists(st.integers(1, 7), min_size=3))
def test_stop_with_lost_packets_is_the_same_stop(v, a, period, gaps):
    limits = arm().limits
    past = history(START, v, a, np.zeros(7), period)
    rows = rows_of(Stop(limits, period), past)[3:]
    stop = Stop(limits, period)
    stop.begin(*past[:3])
    cycle = 0
    while not stop.finished:
        gap = gaps[cycle % len(gaps)]
        cycle += gap
        assert np.array_equal(stop.advance(gap), rows[min(cycle, len(rows) - 1)])


def test_stop_takes_the_time_that_theory_gives():
    # From constant speed v with a and j at their limits: v/a + a/j seconds.
    limits = arm().limits
    past = history(START, np.eye(7)[0], np.zeros(7), np.zeros(7), 0.001)
    rows = rows_of(Stop(limits, 0.001), past)[3:-3]
    theory = limits.v_max[0] / limits.a_max[0] + limits.a_max[0] / limits.j_max[0]
    assert len(rows) * 0.001 == pytest.approx(theory, abs=0.003)
    assert rows[-1, 0] - rows[0, 0] == pytest.approx(limits.v_max[0] * theory / 2, abs=0.003)


def test_extent_of_a_stop_is_the_integral_of_its_velocity():
    # v0 = 0.6 rad/s, a = 8, j = 100: jerk down for v_j = a²/2j, then constant, then jerk up; by quadrature.
    limits, v0 = arm().limits, 0.6
    a, j = limits.a_max[0], limits.j_max[0]
    peak = min(np.sqrt(j * v0), a)
    t1 = peak / j
    t2 = (v0 - peak**2 / j) / peak

    def velocity(t: float) -> float:
        if t < t1:
            return v0 - 0.5 * j * t * t
        if t < t1 + t2:
            return v0 - 0.5 * j * t1 * t1 - peak * (t - t1)
        left = 2 * t1 + t2 - t
        return 0.5 * j * left * left

    travel = quad(velocity, 0.0, 2 * t1 + t2, points=[t1, t1 + t2])[0]
    past = np.array(
        history(START, np.eye(7)[0] * v0 / limits.v_max[0], np.zeros(7), np.zeros(7), 1e-5)[2::-1]
    )
    _, highest, _ = stop_extent(limits, 1e-5, past)
    assert highest[-1, 0] - START[0] == pytest.approx(travel, abs=1e-5)


def test_stop_at_rest_is_over_at_once():
    stop = Stop(arm().limits, 0.001)
    stop.begin(START, START, START)
    assert stop.finished
    assert np.array_equal(stop.advance(3), START)


def test_stop_goes_on_holding_when_it_is_over():
    past = history(START, np.full(7, 0.1), np.zeros(7), np.zeros(7), 0.001)
    stop = Stop(arm().limits, 0.001)
    last = rows_of(stop, past)[-1]
    assert np.array_equal(stop.advance(100), last)


def test_rows_that_are_no_numbers_cannot_be_stopped_from():
    with pytest.raises(ValueError, match="not finite"):
        Stop(arm().limits, 0.001).begin(START, np.full(7, np.nan), START)


def test_motion_at_full_speed_can_be_stopped_anywhere_without_passing_the_velocity_limit():
    limits = arm().limits
    for period in (0.001, 0.01):
        motion = move_to(arm(), START, START + 0.8, period, speed_scale=1.0)
        _, _, speed = stop_extent(limits, period, motion.q)
        assert np.all(speed <= limits.v_max + 1e-9)


@pytest.mark.parametrize(
    ("v", "a", "jerk"),
    [(0.5, 3.0, -1.0), (-0.5, -3.0, 1.0), (0.5, -3.0, -1.0), (0.05, -5.0, 1.0), (-0.05, 5.0, -1.0)],
)
def test_the_jerk_of_a_stop_begins_with_its_first_row(v, a, jerk):
    # Against the motion as it would be once the acceleration is gone, v + a |a| / 2 j: the fourth case has turned by
    # then.
    limits, period = arm().limits, 0.001
    history_of = np.zeros((3, 7))
    history_of[0] = START
    history_of[1] = START - np.eye(7)[0] * v * period
    history_of[2] = history_of[1] - np.eye(7)[0] * (v - a * period) * period
    stop = Stop(limits, period)
    stop.begin(*history_of)
    first = stop.advance(1)
    second = (first - 2.0 * history_of[0] + history_of[1])[0] / period**2
    assert second == pytest.approx(a + jerk * limits.j_max[0] * period, abs=1e-6)


@settings(max_examples=40, deadline=None, derandomize=True)
@given(way=unit, period=periods)
def test_a_retreat_is_a_straight_way_within_its_limits(way, period):
    retreat, goal = Retreat(arm().limits, period), START + 0.2 * way
    retreat.begin(START, goal)
    rows = [START]
    while not retreat.arrived:
        rows.append(retreat.advance(1))
    np.testing.assert_allclose(rows[-1], goal, atol=1e-9)
    size = np.linalg.norm(goal - START)
    if size < 1e-6:
        return
    moved = np.array(rows) - START
    along = moved @ (goal - START) / size
    assert np.all(np.diff(along) >= -1e-9)
    np.testing.assert_allclose(moved, np.outer(along, (goal - START) / size), atol=1e-7)
    padded = np.vstack([rows[:1] * 3, rows, rows[-1:] * 3])
    for order, limit in enumerate((arm().limits.v_max, arm().limits.a_max, arm().limits.j_max), start=1):
        assert np.all(np.abs(np.diff(padded, order, axis=0)) <= limit * period**order + 1e-9)
