from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import lwr_driver
from fri.errors import ConfigurationError, RefusedError
from lwr_driver.motion import Motion, check_motion, check_start, extremes, move_to
from tests.lwr_driver.driver_rig import START, arm, excesses

GOAL = START + np.array([0.5, -0.4, 0.6, 0.3, -0.7, 0.2, 1.0])


def sine(amplitude: float, frequency: float, period_s: float = 0.001) -> Motion:
    """A smooth motion of A1 from rest to rest, with an amplitude that swells and fades."""
    t = np.arange(0.0, 4.0, period_s)
    q = np.tile(START, (len(t), 1))
    q[:, 0] += amplitude * np.sin(np.pi * t / t[-1]) ** 4 * np.sin(2.0 * np.pi * frequency * t)
    return Motion(q, period_s)


def broken(motion: Motion) -> set[str]:
    return {extreme.quantity for extreme in extremes(arm(), motion) if not extreme.ok}


@pytest.mark.parametrize("period_s", [0.001, 0.002, 0.005, 0.01, 0.02])
@pytest.mark.parametrize("speed_scale", [0.1, 1.0])
def test_move_is_straight_and_keeps_every_limit(period_s, speed_scale):
    motion = move_to(arm(), START, GOAL, period_s, speed_scale=speed_scale)
    assert not broken(motion)
    assert np.array_equal(motion.q[0], START)
    assert np.array_equal(motion.q[-1], GOAL)
    share = (motion.q - START) / (GOAL - START)
    assert np.abs(share - share[:, :1]).max() < 1e-9
    times = period_s * np.arange(len(motion))
    assert excesses(motion.q.astype(np.float32).astype(float), times, arm().limits) == []


def test_faster_scale_is_faster_and_uses_the_velocity_limit():
    slow = move_to(arm(), START, GOAL, 0.001, speed_scale=0.2)
    fast = move_to(arm(), START, GOAL, 0.001, speed_scale=1.0)
    assert len(fast) < len(slow)
    speed = np.abs(np.diff(slow.q, axis=0)).max(axis=0) / 0.001
    assert np.max(speed / arm().v_max) == pytest.approx(0.2, rel=1e-3)


def test_move_to_where_the_arm_is_already():
    motion = move_to(arm(), START, START, 0.001)
    assert np.array_equal(motion.q, [START, START])
    check_motion(arm(), motion)


@pytest.mark.parametrize("which", ["start", "goal"])
def test_ends_outside_the_limits_are_refused(which):
    outside = START.copy()
    outside[1] = arm().q_high[1] + 0.001
    ends = (outside, GOAL) if which == "start" else (START, outside)
    with pytest.raises(RefusedError, match=f"{which} of move_to_start: A2"):
        move_to(arm(), *ends, 0.001)


@pytest.mark.parametrize("scale", [0.0, 1.1, np.nan])
def test_speed_scale_must_make_sense(scale):
    with pytest.raises(ConfigurationError, match="speed_scale"):
        move_to(arm(), START, GOAL, 0.001, speed_scale=scale)


def test_move_between_bad_positions_is_refused():
    with pytest.raises(ConfigurationError, match="finite"):
        move_to(arm(), START, np.full(7, np.nan), 0.001)


def test_cloud_interface_of_ruckig_is_never_used():
    # A list of `intermediate_positions` makes ruckig ask a server of its maker.
    for path in Path(lwr_driver.__file__).parent.rglob("*.py"):
        assert "intermediate_positions" not in path.read_text(), path


def test_gentle_sine_passes_and_says_how_close_it_comes():
    found = {extreme.quantity: extreme for extreme in extremes(arm(), sine(0.3, 0.5))}
    assert all(extreme.ok for extreme in found.values())
    assert found["velocity"].joint == "A1"
    assert found["velocity"].value == pytest.approx(0.3 * np.pi, rel=0.05)
    assert "A1 velocity" in str(found["velocity"])
    assert "is within" in str(found["velocity"])


@pytest.mark.parametrize(
    ("motion", "quantity"),
    [
        (sine(0.8, 0.5), "velocity"),
        (sine(0.25, 1.0), "acceleration"),
        (sine(0.02, 3.0), "jerk"),
        (sine(4.0, 0.1), "position"),
    ],
)
def test_each_limit_is_noticed(motion, quantity):
    assert quantity in broken(motion)
    with pytest.raises(RefusedError, match=quantity):
        check_motion(arm(), motion)


def test_jerk_below_the_rounding_of_float32_is_noticed_in_the_plan():
    # At 1 ms rounding hides 950 rad/s³, but the plan itself is exact.
    assert broken(sine(0.02, 3.0)) == {"jerk"}


def test_motion_must_begin_and_end_at_rest():
    moving = Motion(sine(0.3, 0.5).q[1000:], 0.001)
    assert {"acceleration", "jerk"} <= broken(moving)
    assert {"acceleration", "jerk"} <= broken(Motion(moving.q[::-1], 0.001))


def test_rows_rounded_to_float32_before_are_still_accepted():
    exact = sine(0.3, 0.5)
    assert not broken(Motion(exact.q.astype(np.float32).astype(float), 0.001))


def test_motion_that_could_not_be_stopped_before_the_limit_is_refused():
    # Towards the limit at 1 rad/s, and back in time: no row is outside, but a stop would end there.
    q = np.tile(START, (1001, 1))
    q[:, 0] = arm().q_high[0] - np.abs(np.linspace(-0.5, 0.5, 1001))
    found = broken(Motion(q, 0.001))
    assert "position" not in found
    assert "stop position" in found


def test_start_must_be_the_commanded_value_to_the_last_bit():
    motion = move_to(arm(), START, GOAL, 0.001)
    sent = START.astype(np.float32).astype(float)
    check_start(arm(), motion, sent)
    near = sent.copy()
    near[3] = np.nextafter(np.float32(near[3]), np.float32(2.0))
    with pytest.raises(RefusedError, match="A3"):
        check_start(arm(), motion, near)


@pytest.mark.parametrize(
    ("q", "period_s", "phases", "message"),
    [
        (np.zeros((0, 7)), 0.001, (), "shape"),
        (np.zeros((5, 6)), 0.001, (), "shape"),
        (np.full((5, 7), np.inf), 0.001, (), "finite"),
        (np.zeros((5, 7)), 0.0001, (), "period"),
        (np.zeros((5, 7)), 0.2, (), "period"),
        (np.zeros((5, 7)), 0.001, ((0, "a"), (5, "b")), "phases"),
        (np.zeros((5, 7)), 0.001, ((2, "a"), (1, "b")), "phases"),
    ],
)
def test_malformed_motions_are_refused(q, period_s, phases, message):
    with pytest.raises(ConfigurationError, match=message):
        Motion(q, period_s, phases)


def test_joined_motions_share_the_row_where_they_meet():
    first = move_to(arm(), START, GOAL, 0.001, phase="there")
    second = move_to(arm(), GOAL, START, 0.001, phase="back")
    both = first.join(second)
    assert len(both) == len(first) + len(second) - 1
    assert both.phases == ((0, "there"), (len(first) - 1, "back"))
    assert both.duration_s == pytest.approx(first.duration_s + second.duration_s)
    check_motion(arm(), both)


def test_joined_motions_with_the_same_phase_keep_one_entry():
    first = move_to(arm(), START, GOAL, 0.001, phase="move")
    assert first.join(move_to(arm(), GOAL, START, 0.001, phase="move")).phases == ((0, "move"),)


def test_motions_that_do_not_meet_cannot_be_joined():
    motion = move_to(arm(), START, GOAL, 0.001)
    with pytest.raises(ConfigurationError, match="apart"):
        motion.join(motion)
    with pytest.raises(ConfigurationError, match="periods"):
        motion.join(move_to(arm(), GOAL, START, 0.002))


def stepped(size: float, period_s: float) -> Motion:
    """Rest at zero, and at `size` from one row to the next; exact in float32."""
    q = np.zeros((12, 7))
    q[6:, 0] = np.float32(size)
    return Motion(q, period_s)


@pytest.mark.parametrize(
    ("period_s", "order", "quantity", "factor"),
    [(0.1, 1, "velocity", 1.0), (0.1, 2, "acceleration", 1.0), (0.001, 3, "jerk", 2.0)],
)
def test_limits_are_widened_by_the_rounding_of_a_difference_and_nothing_else(
    period_s, order, quantity, factor
):
    # A step of x makes differences of x, x and 2 x at most; one of order k has 2^k roundings.
    limits = arm().limits
    bound = (limits.v_max, limits.a_max, limits.j_max)[order - 1][0]
    edge = (bound * period_s**order + 2.0**order * 2.0**-23) / factor
    assert quantity not in broken(stepped(0.999 * edge, period_s))
    assert quantity in broken(stepped(1.001 * edge, period_s))
