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


@pytest.mark.parametrize("factor", [1.0, 1.5])
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


# Of one value, in the distances of the docstring: cycles before the row, widened limits of velocity (times T),
# acceleration (times T²) and jerk (times T³), in roundings of float32.
WIDENED = [((), 2.0, 2.0, 2.0), ((1,), 2.0, 4.0, 6.0), ((1, 1), 2.0, 4.0, 8.0), ((1, 1, 1), 2.0, 4.0, 8.0)]


def zeroed(period_s: float, before: tuple[int, ...]) -> Guard:
    """After rows of zeros, where float32 has no rounding to speak of."""
    watch = guard(period_s, np.zeros(7))
    for cycles in before:
        assert watch.check(np.zeros(7, dtype=np.float32), cycles) is None
    return watch


def first(distance: float) -> np.ndarray:
    q = np.zeros(7, dtype=np.float32)
    q[0] = distance
    return q


@pytest.mark.parametrize(("before", "velocity", "acceleration", "jerk"), WIDENED)
def test_each_limit_is_widened_by_the_rounding_and_nothing_else(before, velocity, acceleration, jerk):
    limits = arm().limits
    # The jerk limits short steps, the acceleration steps of 20 ms, the velocity those of 1 s.
    for period, order, bound, roundings in (
        (1.0, 1, limits.v_max[0], velocity),
        (0.02 * 8.0, 2, limits.a_max[0], acceleration),
        (T, 3, limits.j_max[0], jerk),
    ):
        edge = bound * period**order + roundings * 2.0**-23
        assert zeroed(period, before).check(first(0.999 * edge), 1) is None
        violation = zeroed(period, before).check(first(1.001 * edge), 1)
        assert violation is not None
        assert violation.quantity == ("velocity", "acceleration", "jerk")[order - 1]
        assert violation.value == pytest.approx(1.001 * edge / period**order, rel=1e-5)
        assert violation.limit == pytest.approx(bound)


@pytest.mark.parametrize("h", [(1, 1, 1), (2, 1, 3), (4, 5, 1), (1, 1, 4)])
def test_derivatives_over_lost_packets_are_divided_differences(h):
    period = 0.01
    h1, h2, h3 = (cycles * period for cycles in h)
    x1, x2 = 2e-6, 5e-6

    def jerk(x3: float) -> float:
        v1, v2, v3 = x1 / h1, (x2 - x1) / h2, (x3 - x2) / h3
        a2, a3 = 2.0 * (v2 - v1) / (h2 + h1), 2.0 * (v3 - v2) / (h3 + h2)
        return 3.0 * (a3 - a2) / (h3 + h2 + h1)

    # Linear in x3, so the two points give the distance at the limit.
    slope = (jerk(1e-3) - jerk(0.0)) / 1e-3
    r = 2.0**-23
    error = (
        (4 * r / (h3 + h2) * (1 / h3 + 1 / h2) + 4 * r / (h2 + h1) * (1 / h2 + 1 / h1)) * 3 / (h1 + h2 + h3)
    )
    edge = (arm().limits.j_max[0] + error - jerk(0.0)) / slope
    for factor, allowed in ((0.999, True), (1.001, False)):
        watch = guard(period, np.zeros(7))
        # A long rest, and the rows x0 = 0, x1, x2 at distances of h1 and h2.
        for distance, cycles in ((0.0, 1), (0.0, 1), (x1, h[0]), (x2, h[1])):
            assert watch.check(first(distance), cycles) is None
        found = watch.check(first(factor * edge), h[2])
        assert (found is None) == allowed
        if found is not None:
            assert found.quantity == "jerk"
            assert found.value == pytest.approx(jerk(factor * edge), rel=1e-4)


def test_the_guard_can_begin_at_a_velocity():
    v = np.zeros(7)
    v[0] = 0.5
    watch = guard(T, np.zeros(7))
    watch.reset(np.zeros(7, dtype=np.float32), v)
    for k in range(1, 5):
        assert watch.check(first(0.5 * T * k), 1) is None
    watch.reset(np.zeros(7, dtype=np.float32), v)
    violation = watch.check(np.zeros(7, dtype=np.float32), 1)
    assert violation is not None
    assert violation.quantity == "acceleration"
    assert violation.value == pytest.approx(0.5 / T, rel=1e-6)


def test_rounding_of_the_row_before_counts_where_the_guard_begins_at_a_velocity():
    # v' from rounded rows, so its error is 2 r / T, and that of the acceleration before 2 (2 r / T) / T.
    r, v = 2.0**-23, np.zeros(7)
    edge = arm().limits.j_max[0] * T**3 + (4.0 + 4.0) * r
    for factor, allowed in ((0.999, True), (1.001, False)):
        watch = guard(T, np.zeros(7))
        watch.reset(np.zeros(7, dtype=np.float32), v)
        assert (watch.check(first(factor * edge), 1) is None) == allowed


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_positions_are_limited_on_both_sides(side):
    limits = arm().limits
    edge = limits.q_high[1] if side > 0 else limits.q_low[1]
    q = START.copy()
    for step, allowed in ((0.0, True), (side * 1e-6, False)):
        q[1] = edge + step
        watch = guard(1.0, START + np.eye(7)[1] * (edge - START[1] - side * 0.01))
        violation = watch.check(q.astype(np.float32), 1)
        assert (violation is None) == allowed
        if violation is not None:
            assert (violation.quantity, violation.joint) == ("position", 1)
            assert violation.limit == pytest.approx(edge)
            assert violation.value == pytest.approx(q[1], rel=1e-6)


def test_a_copy_goes_its_own_way():
    watch = guard()
    watch.scale_velocity(0.5)
    twin = watch.copy()
    twin.scale_velocity(1.0)
    twin.reset(np.zeros(7, dtype=np.float32))
    slow = guard(1.0)
    slow.scale_velocity(0.5)
    other = slow.copy()
    far = moved(A1=0.7 * arm().v_max[0])
    slow.scale_velocity(1.0)
    assert slow.check(far, 1) is None
    violation = other.check(far, 1)
    assert violation is not None
    assert violation.quantity == "velocity"
    assert watch.check(START.astype(np.float32), 1) is None


@settings(deadline=None, max_examples=40)
@given(
    start=st.integers(0, 300),
    count=st.integers(1, 60),
    place=st.integers(0, 59),
    joint=st.integers(0, 6),
    jump=st.sampled_from([0.0, 1e-7, 1e-6, -2e-5, 0.01, np.nan, np.inf]),
)
def test_many_rows_pass_as_far_as_single_rows_do(start, count, place, joint, jump):
    motion = move_to(arm(), START, moved(A1=0.3, A3=-0.2, A6=0.5).astype(float), T, speed_scale=1.0)
    rows = motion.q.astype(np.float32)
    start = min(start, len(rows) - 1)
    single, many = guard(), guard()
    for row in rows[:start]:
        assert single.check(row, 1) is None
        assert many.check(row, 1) is None
    ahead = rows[start : start + count].copy()
    if place < len(ahead):
        ahead[place, joint] += np.float32(jump)
    passed = many.check_rows(ahead)
    verdicts = []
    for row in ahead:
        verdicts.append(single.check(row, 1))
        if verdicts[-1] is not None:
            break
    good = sum(verdict is None for verdict in verdicts)
    # Right after the beginning the roundings still change, and single checks are asked for.
    assert passed == (good if start >= 2 else 0)
    if passed:
        many.remember_rows(ahead[:passed])
        twin = guard()
        for row in [*rows[:start], *ahead[:passed]]:
            assert twin.check(row, 1) is None
        for name in ("_q", "_v", "_a"):
            assert getattr(many, name).tobytes() == getattr(twin, name).tobytes()


def test_rows_after_a_gap_are_left_to_single_checks():
    watch, rest = guard(), np.tile(START.astype(np.float32), (5, 1))
    for _ in range(5):
        assert watch.check(rest[0], 1) is None
    assert watch.check_rows(rest) == 5
    assert watch.check(rest[0], 2) is None
    assert watch.check_rows(rest) == 0


@pytest.mark.parametrize("factor", [0.0, -0.5, np.nan, np.inf])
def test_nothing_moves_with_a_factor_that_no_controller_gives(factor):
    watch = guard()
    watch.scale_velocity(factor)
    rest = START.astype(np.float32)
    assert watch.check(rest, 1) is None
    motion = move_to(arm(), START, START + 0.5, T, speed_scale=0.05)
    found = [violation for q in motion.q if (violation := watch.check(q.astype(np.float32), 1))]
    assert (found[0].quantity, found[0].limit) == ("velocity", 0.0)
