from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lwr_driver.guard import Guard
from lwr_driver.motion import move_to
from tests.lwr_driver.driver_rig import START, arm

T = 0.001
NAMES = ("A1", "A2", "E1", "A3", "A4", "A5", "A6")


def guard(period_s: float = T, q: np.ndarray = START) -> Guard:
    watch = Guard(arm().limits, period_s)
    watch.reset(q.astype(np.float32))
    return watch


def moved(**joints: float) -> np.ndarray:
    q = START.copy()
    for name, distance in joints.items():
        q[NAMES.index(name)] += distance
    return q.astype(np.float32)


def test_rest_is_allowed_for_ever():
    watch = guard()
    assert all(watch.check(START.astype(np.float32), 1) is None for _ in range(100))


def test_rest_where_the_controller_has_the_arm_is_allowed_but_nothing_further_out():
    # The controller may have the arm within our margin.
    q = START.copy()
    q[0] = arm().q_high[0] + 0.01
    watch = guard(q=q)
    for _ in range(5):
        assert watch.check(q.astype(np.float32), 1) is None
    q[0] += 1e-6
    violation = watch.check(q.astype(np.float32), 1)
    assert violation is not None
    assert violation.describe(NAMES).startswith("A1 position 2.9596 rad exceeds 2.9496")


def test_way_back_into_the_limits_is_one_way():
    outside = START.copy()
    outside[0] = arm().q_high[0] + 0.01
    t = np.linspace(0.0, 1.0, 2001)
    back = np.tile(START, (2001, 1))
    back[:, 0] = outside[0] - 0.2 * (10 * t**3 - 15 * t**4 + 6 * t**5)
    watch = guard(q=outside)
    for q in back:
        assert watch.check(q.astype(np.float32), 1) is None
    accepted = [q[0] for q in back[::-1] if watch.check(q.astype(np.float32), 1) is None]
    assert max(accepted) <= arm().q_high[0] + 2e-7


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_values_that_are_no_numbers_are_refused(value):
    q = START.astype(np.float32)
    q[4] = value
    violation = guard().check(q, 1)
    assert violation is not None
    assert violation.joint == 4


def test_jump_breaks_velocity_and_the_message_has_joint_value_and_limit():
    violation = guard().check(moved(A3=0.01), 1)
    assert violation is not None
    assert violation.quantity == "velocity"
    assert violation.describe(NAMES) == "A3 velocity 10 rad/s exceeds 1.9635 rad/s"


def test_sudden_speed_breaks_acceleration():
    violation = guard().check(moved(A1=0.001), 1)
    assert violation is not None
    assert violation.quantity == "acceleration"
    assert violation.value == pytest.approx(1000.0, rel=1e-3)


def test_sudden_acceleration_breaks_jerk():
    period = 0.01
    violation = guard(period).check(moved(A1=0.5 * 8.0 * period**2), 1)
    assert violation is not None
    assert violation.quantity == "jerk"


def test_refused_value_is_forgotten():
    watch = guard()
    watch.check(moved(A3=0.01), 1)
    assert watch.check(START.astype(np.float32), 2) is None


def test_controller_can_shrink_the_velocity_limit():
    motion = move_to(arm(), START, START + 0.5, T, speed_scale=0.4)
    watch = guard()
    watch.scale_velocity(0.3)
    found = [violation for q in motion.q if (violation := watch.check(q.astype(np.float32), 1))]
    assert found
    assert found[0].quantity == "velocity"
    assert found[0].limit == pytest.approx(0.3 * arm().v_max[found[0].joint])


@pytest.mark.parametrize("factor", [0.0, 1.0, 1.5, np.nan])
def test_factor_that_shrinks_nothing_changes_nothing(factor):
    watch = guard()
    watch.scale_velocity(0.1)
    watch.scale_velocity(factor)
    motion = move_to(arm(), START, START + 0.5, T, speed_scale=1.0)
    assert all(watch.check(q.astype(np.float32), 1) is None for q in motion.q)


@settings(max_examples=40, deadline=None, derandomize=True)
@given(
    goal=st.lists(st.floats(-1.0, 1.0), min_size=7, max_size=7),
    period_ms=st.sampled_from([1, 2, 5, 10]),
    gaps=st.lists(st.integers(1, 9), min_size=1, max_size=40),
)
def test_motion_within_limits_passes_whatever_packets_are_lost(goal, period_ms, gaps):
    period = period_ms * 1e-3
    motion = move_to(arm(), START, START + np.array(goal) * 0.7, period, speed_scale=1.0)
    watch = guard(period)
    row = 0
    while row < len(motion) - 1:
        step = min(gaps[row % len(gaps)], len(motion) - 1 - row)
        row += step
        assert watch.check(motion.q[row].astype(np.float32), step) is None
    for _ in range(5):
        assert watch.check(motion.q[-1].astype(np.float32), 1) is None


@settings(max_examples=40, deadline=None, derandomize=True)
@given(
    row=st.integers(50, 400),
    joint=st.integers(0, 6),
    error=st.floats(3e-3, 0.5),
    sign=st.sampled_from([-1, 1]),
)
def test_row_that_does_not_belong_is_refused(row, joint, error, sign):
    motion = move_to(arm(), START, START + 0.6, T, speed_scale=0.5)
    watch = guard()
    for good in motion.q[1:row]:
        assert watch.check(good.astype(np.float32), 1) is None
    wrong = motion.q[row].astype(np.float32)
    wrong[joint] += np.float32(sign * error)
    assert watch.check(wrong, 1) is not None
    assert watch.check(motion.q[row + 1].astype(np.float32), 2) is None


def test_a_check_that_is_not_remembered_finds_the_same_and_leaves_no_trace():
    guard = Guard(arm().limits, 1e-3)
    q = START.astype(np.float32)
    guard.reset(q)
    far = q + np.float32(0.01)
    assert guard.check(far, 1, remember=False) is not None
    assert guard.check(q, 1, remember=False) is None
    assert guard.check(q, 1) is None
