"""Packets ahead of their time: rows of a motion pass as fast as time does, never faster."""

from __future__ import annotations

import re

import numpy as np
import pytest

from fri.states import Quality, State
from lwr_driver.control import Result, Text
from lwr_driver.pace import Pace, Stamps
from tests.lwr_driver.driver_rig import Clock, Rig, check_sent, in_motion

PERIOD_S = 0.005
MS = 1_000_000


def paced() -> Pace:
    pace = Pace()
    pace.reset(PERIOD_S, 20)
    for number in range(100):
        assert pace.feed(1, number * 5 * MS) == 1
    return pace


def test_regular_and_jittering_packets_each_have_their_cycle():
    pace, random = paced(), np.random.default_rng(1)
    for number in range(100, 3000):
        assert pace.feed(1, round((5 * number + random.exponential(0.5)) * MS)) == 1
    assert not pace.too_fast


@pytest.mark.parametrize("error", [-0.001, 0.001])
def test_clocks_may_differ_a_little(error):
    pace = Pace()
    pace.reset(PERIOD_S, 20)
    assert all(pace.feed(1, round(number * 5 * MS * (1.0 + error))) for number in range(3000))


def test_lost_packets_count_and_a_pause_is_caught_up():
    pace = paced()
    assert pace.feed(6, 105 * 5 * MS) == 6
    # Fifteen packets waited for a computer that stood still.
    assert [pace.feed(1, 120 * 5 * MS + k * 1000) for k in range(15)] == [1] * 15
    assert pace.feed(1, 121 * 5 * MS) == 1


def test_a_counter_that_jumps_without_time_gives_one_cycle():
    pace = paced()
    assert pace.feed(6, 100 * 5 * MS) == 1
    assert [pace.feed(1, (101 + k) * 5 * MS) for k in range(20)] == [1] * 20


def test_a_burst_without_a_pause_before_it_gives_one_cycle():
    pace = paced()
    assert sum(pace.feed(1, 100 * 5 * MS + k * 10_000) for k in range(20)) == 1
    assert [pace.feed(1, (101 + k) * 5 * MS) for k in range(20)] == [1] * 20
    assert not pace.too_fast


def test_packets_at_double_speed_give_every_second_a_cycle_and_are_told():
    pace = paced()
    given = [pace.feed(1, 99 * 5 * MS + (k + 1) * 5 * MS // 2) for k in range(400)]
    assert 200 <= sum(given) <= 206
    assert pace.too_fast
    assert str(pace) == "the header says 5 ms a cycle, packets come every 2.5 ms"


def test_the_next_packet_is_due_when_it_would_be_given_a_cycle():
    pace = paced()
    early, due = paced(), paced()
    assert early.feed(1, pace.due_ns - 1000) == 0
    assert due.feed(1, pace.due_ns) == 1
    assert pace.period_ns == 5 * MS


def test_time_stamps_tell_lost_packets_from_a_counter_that_ran_ahead():
    stamps = Stamps()
    for number in range(5):
        assert stamps.feed(1, number * PERIOD_S, PERIOD_S) == 1
    assert stamps.feed(6, 10 * PERIOD_S, PERIOD_S) == 6
    assert stamps.feed(6, 11 * PERIOD_S, PERIOD_S) == 1


@pytest.mark.parametrize("step_s", [0.0, 0.25 * PERIOD_S, 4.0 * PERIOD_S])
def test_a_clock_of_another_pace_says_nothing(step_s):
    stamps = Stamps()
    for number in range(5):
        stamps.feed(1, number * step_s, PERIOD_S)
    assert stamps.feed(6, 10 * step_s, PERIOD_S) == 6


def test_stamps_too_coarse_for_a_cycle_say_nothing():
    stamps = Stamps()
    start = 1e5
    for number in range(5):
        stamps.feed(1, start + number * PERIOD_S, PERIOD_S)
    assert stamps.feed(6, start + 5 * PERIOD_S, PERIOD_S) == 6


@pytest.fixture
def timed(monkeypatch):
    """A rig in real time whose clock is advanced by the test, and a function for a cycle of so many ms."""
    clock = Clock()
    monkeypatch.setattr("lwr_driver.loop.time", clock)
    for name in ("monotonic", "monotonic_ns"):
        monkeypatch.setattr(f"fri.remote.{name}", getattr(clock, name))
    # A controller that never minds missing answers shows what the driver does by itself.
    rig = Rig(5, lock_step=False, policy={"bridged_cycles": 10**5, "hold_quality": Quality.UNACCEPTABLE})
    rig.loop.pace = Pace()
    advance = rig.cycle

    def cycle(after_ms: float = 5.0, **faults: bool) -> None:
        clock.now_ns += round(after_ms * MS)
        advance(**faults)

    rig.cycle = cycle  # type: ignore[assignment]
    yield rig
    rig.close()


def sent(rig: Rig) -> np.ndarray:
    return np.array(rig.arrived.rows)


def test_a_burst_moves_the_arm_no_faster(timed):
    motion = in_motion(timed, 60)
    before = len(timed.arrived.rows)
    for _ in range(20):
        timed.cycle(0.05)
    assert len(timed.arrived.rows) - before <= 1
    timed.cycles(5)
    steps = np.abs(np.diff(sent(timed)[before - 1 :], axis=0)).max(axis=0)
    assert np.all(steps <= np.abs(np.diff(motion.q.astype(np.float32), axis=0)).max(axis=0) + 1e-7)
    assert "the controller's counter runs ahead of this computer's clock" in timed.control.text(Text.NOTE)
    # So many answers missed are too many for the controller.
    assert re.search(r"\d\d ahead of their time by the sender's fault", timed.control.text(Text.LEFT))


def test_packets_at_double_speed_end_the_motion_at_no_more_than_its_speed(timed):
    motion = in_motion(timed, 60)
    before = len(timed.arrived.rows)
    packets = 0
    while not timed.done:
        timed.cycle(2.5)
        packets += 1
        assert packets < 600
    assert timed.result is Result.NETWORK
    assert "run ahead of time at row" in timed.reason
    assert "the header says 5 ms a cycle, packets come every" in timed.reason
    rows = sent(timed)[before:]
    assert len(rows) <= packets / 2 + 2
    assert np.all(
        np.abs(np.diff(rows, axis=0)).max(axis=0) <= np.abs(np.diff(motion.q, axis=0)).max(axis=0) + 1e-6
    )


def test_a_counter_that_jumps_skips_no_rows(timed):
    in_motion(timed, 60)
    for _ in range(4):
        timed.session._sequence += 5
        timed.cycles(6)
    row = timed.loop._commander.index
    assert row == 60 + 4 * 6 - 1
    check_sent(timed)


def test_in_lock_step_a_counter_that_jumps_without_its_time_stamp_skips_no_rows():
    rig = Rig(5)
    motion = in_motion(rig, 60)
    rig.session._sequence += 5
    rig.cycles(3)
    assert rig.loop._commander.index == 62
    rig.until_done()
    assert rig.result is Result.DONE
    assert np.array_equal(rig.target.astype(np.float32), motion.q[-1].astype(np.float32))
    assert rig.loop.remote.ahead == 5
    check_sent(rig)
    rig.close()


def test_lost_packets_are_bridged_as_before_with_a_clock(timed):
    motion = in_motion(timed, 60)
    for _ in range(3):
        timed.cycle(lose_packet=True)
    timed.cycle()
    assert timed.loop._commander.index == 63
    assert np.array_equal(timed.target, motion.q[63].astype(np.float32).astype(float))
    assert timed.session.state is State.CMD
