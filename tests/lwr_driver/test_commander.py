"""The commander alone against the worst that a link can do: what is sent keeps every limit."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lwr_driver.commander import BRAKE, HOLD, Commander
from lwr_driver.control import Control, Mode, Result
from lwr_driver.motion import Motion, move_to
from lwr_driver.ring import NO_PHASE
from tests.lwr_driver.driver_rig import START, arm, excesses

HOP = np.array([0.9, -0.6, 0.5, 0.7, -0.8, 0.4, 1.1])
HELD = START.astype(np.float32)


@cache
def shared() -> Control:
    return Control.create(20_000)


class Link:
    """Calls the commander as the loop does, and keeps what it sends."""

    def __init__(self, period_s: float = 0.001, tracking_limit: float = 0.2) -> None:
        self.control = shared()
        self.control.words[:] = 0
        self.commander = Commander(arm().limits, self.control, arm().joint_names, tracking_limit)
        self.period_s = period_s
        self.commander.set_period(period_s)
        self.sequence = 0
        self.sent: list[np.ndarray] = [self.commander.enter(HELD, 1.0)]
        self.times = [0.0]

    def packet(self, gap: int = 1, before=None) -> np.ndarray | None:
        """The next packet that arrives, `gap` numbers after the last one; the arm is where it was sent."""
        self.sequence += gap
        target = self.commander.target
        self.commander.watch(gap, target, target)
        if before is not None:
            before()
        value = self.commander.command(self.sequence)
        if value is not None:
            self.sent.append(value.copy())
            self.times.append(self.sequence * self.period_s)
        return value

    def begin(self, motion: Motion) -> None:
        self.control.put_motion(motion.q, [(row, 2 + n) for n, (row, _) in enumerate(motion.phases)])
        self.packet(before=lambda: self.commander.begin(len(motion), self.sequence))

    def excesses(self) -> list[str]:
        return excesses(np.array(self.sent, dtype=float), np.array(self.times), arm().limits)


def motion(period_s: float = 0.001, speed_scale: float = 1.0) -> Motion:
    there = move_to(arm(), START, START + HOP, period_s, speed_scale=speed_scale)
    return there.join(move_to(arm(), there.q[-1], START, period_s, speed_scale=speed_scale, phase="return"))


def test_motion_is_sent_row_by_row_and_then_held():
    link, plan = Link(), motion()
    link.begin(plan)
    for _ in range(len(plan) + 10):
        link.packet()
    rows = np.array(link.sent[1 : len(plan) + 1])
    assert np.array_equal(rows, plan.q.astype(np.float32))
    assert np.array_equal(link.sent[-1], plan.q[-1].astype(np.float32))
    assert link.commander.ended == (Result.DONE, "")
    assert link.commander.mode is Mode.HOLD


def test_rows_and_phases_follow_the_packet_number():
    link, plan = Link(), motion()
    link.begin(plan)
    assert (link.commander.index, link.commander.phase) == (0, 2)
    link.packet(gap=4)
    assert link.commander.index == 4
    turn = plan.phases[1][0]
    while link.commander.index < turn:
        assert link.commander.phase == 2
        link.packet()
    assert link.commander.phase == 3
    link.commander.stop(Result.ABORTED, "test")
    link.packet()
    assert (link.commander.index, link.commander.phase) == (-1, BRAKE)
    while link.commander.moving:
        link.packet()
    link.packet()
    assert link.commander.phase == HOLD


@settings(max_examples=120, deadline=None, derandomize=True)
@given(
    period_ms=st.sampled_from([1, 2, 5, 10]),
    gaps=st.lists(st.sampled_from([1, 1, 1, 1, 2, 3, 7, 10]), min_size=1, max_size=60),
    stop_after=st.integers(0, 1500),
)
def test_stop_at_any_moment_with_any_losses_keeps_every_limit(period_ms, gaps, stop_after):
    link, plan = Link(period_ms * 1e-3), motion(period_ms * 1e-3)
    link.begin(plan)
    count = 0
    while link.commander.mode is not Mode.HOLD:
        stopping = count == stop_after
        link.packet(
            gaps[count % len(gaps)],
            (lambda: link.commander.stop(Result.ABORTED, "asked")) if stopping else None,
        )
        count += 1
        assert link.commander.mode is not Mode.SILENT
    for _ in range(4):
        link.packet()
    assert link.excesses() == []
    assert link.commander.ended[0] in (Result.DONE, Result.ABORTED)


@settings(max_examples=80, deadline=None, derandomize=True)
@given(
    row=st.integers(1, 1200),
    joint=st.integers(0, 6),
    error=st.one_of(st.floats(1e-3, 3.0), st.just(np.nan), st.just(np.inf)),
    gap=st.sampled_from([1, 2, 5]),
)
def test_bad_row_in_the_shared_memory_is_never_sent(row, joint, error, gap):
    # The check before the motion would refuse it; here it gets past that check.
    link, plan = Link(), motion()
    link.begin(plan)
    link.control.plan[row : row + 5, joint] += error
    while link.commander.mode is not Mode.HOLD:
        link.packet(gap)
    assert link.excesses() == []
    assert np.all(np.isfinite(link.sent))
    result, reason = link.commander.ended
    if result is not Result.DONE:
        assert result is Result.GUARD
        assert "guard" in reason


def test_guard_reason_names_joint_value_limit_and_place():
    link, plan = Link(), motion()
    link.begin(plan)
    link.control.plan[300:, 3] += 0.1
    while link.commander.mode is not Mode.HOLD:
        link.packet()
    result, reason = link.commander.ended
    assert result is Result.GUARD
    assert "A3 velocity" in reason
    assert "exceeds 1.9635 rad/s at row 300" in reason


def test_motion_that_begins_elsewhere_is_refused_and_the_arm_holds():
    link, plan = Link(), motion()
    link.begin(Motion(plan.q + 1e-6, 0.001))
    assert link.commander.ended[0] is Result.REFUSED
    assert np.array_equal(link.sent[-1], HELD)


def test_motion_does_not_begin_in_the_mirror():
    link = Link()
    link.commander.lose(Result.ROBOT, "gone")
    link.commander.begin(10, 5)
    assert link.commander.ended[0] is Result.REFUSED
    assert link.commander.mode is Mode.MIRROR


@pytest.mark.parametrize("stopping", [False, True])
def test_leaving_command_mode_ends_the_motion_for_good(stopping):
    link, plan = Link(), motion()
    link.begin(plan)
    for _ in range(200):
        link.packet()
    if stopping:
        link.commander.stop(Result.ABORTED, "asked to")
        link.packet()
    link.commander.lose(Result.NETWORK, "cable out")
    result, reason = link.commander.ended
    assert result is (Result.ABORTED if stopping else Result.NETWORK)
    assert "cable out" in reason
    assert (link.commander.index, link.commander.phase) == (-1, NO_PHASE)
    # The controller comes back to command mode: the arm holds where the controller has it, for ever.
    where = plan.q[200].astype(np.float32)
    link.commander.enter(where, 1.0)
    for _ in range(50):
        value = link.packet()
        assert value is not None
        assert np.array_equal(value, where)
    assert link.commander.mode is Mode.HOLD


@pytest.mark.parametrize("period_s", [0.001, 0.02])
@pytest.mark.parametrize("stopping", [False, True])
def test_a_stop_goes_on_from_the_rows_of_a_motion_that_was_lost_by_the_clock_alone(
    stopping: bool, period_s: float
) -> None:
    link, plan = Link(period_s), motion(period_s)
    link.begin(plan)
    for _ in range(len(plan) // 10):
        link.packet()
    if stopping:
        link.commander.stop(Result.ABORTED, "asked to")
        link.packet()
        link.packet()
    link.commander.lose(Result.NETWORK, "no packet for 0.2 s")
    ended = link.commander.ended
    # The next packet shows that the controller has missed nothing.
    step = np.subtract(link.sent[-1], link.sent[-2], dtype=float)
    assert np.abs(step).max() > 1e-5
    link.sequence += 1
    link.sent.append(link.commander.enter(link.sent[-1], 1.0, step).copy())
    link.times.append(link.sequence * period_s)
    assert link.commander.mode is Mode.STOP
    while link.commander.moving:
        link.packet()
    assert link.excesses() == []
    assert link.commander.ended == ended


@pytest.mark.parametrize("which", ["measured position", "set point of the controller"])
def test_arm_that_does_not_follow_is_stopped(which):
    link, plan = Link(tracking_limit=0.05), motion()
    link.begin(plan)
    for _ in range(300):
        link.packet()
    commander, far = link.commander, link.commander.target.copy()
    far[2] += np.float32(0.06)
    link.sequence += 1
    near = commander.target
    commander.watch(1, far if "set" in which else near, near if "set" in which else far)
    assert commander.mode is Mode.STOP
    commander.command(link.sequence)
    while commander.moving:
        link.packet()
    result, reason = commander.ended
    assert result is Result.ROBOT
    assert f"E1 {which} is 0.060 rad" in reason


def test_tracking_error_is_kept_from_entering_command_mode_on():
    link = Link()
    off = HELD.copy()
    off[5] += np.float32(0.004)
    link.commander.watch(1, HELD, off)
    link.packet()
    assert link.control.tracking[5] == pytest.approx(0.004, rel=1e-3)
    link.commander.enter(HELD, 1.0)
    assert not link.control.tracking.any()


def test_silence_is_final():
    link, plan = Link(), motion()
    link.begin(plan)
    link.packet()
    link.commander.fall_silent(Result.ABORTED, "pulled")
    assert link.commander.ended == (Result.ABORTED, "pulled; no more answers are sent")
    link.commander.lose(Result.NETWORK, "gone")
    link.commander.stop(Result.ABORTED, "late")
    assert link.commander.mode is Mode.SILENT


def test_second_motion_begins_where_the_first_was_stopped():
    link, plan = Link(), motion()
    link.begin(plan)
    for _ in range(400):
        link.packet()
    link.commander.stop(Result.ABORTED, "asked")
    while link.commander.moving:
        link.packet()
    here = link.commander.target.astype(np.float64)
    link.begin(move_to(arm(), here, START, 0.001, speed_scale=1.0))
    while link.commander.mode is Mode.MOTION:
        link.packet()
    assert np.array_equal(link.sent[-1], HELD)
    assert link.excesses() == []
