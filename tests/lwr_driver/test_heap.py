"""Packets that wait because the computer stood still, or that come while the loop is busy: each gets the answer
that it would have got by itself, byte for byte.
"""

from __future__ import annotations

import os
from collections.abc import Callable

import pytest

from lwr_driver.control import Job, Mode, Result, Text, Word
from tests.lwr_driver.driver_twins import SPOILT, Twins, ask, put


def heap(t: Twins, count: int, alter: Callable[[int, bytes], bytes] = lambda n, packet: packet) -> int:
    """So many packets come before either loop looks; how many answers left ahead. The controller bridges what it
    missed, as if the answers came in time.
    """
    ahead = 0
    for rig, heard in zip(t.rigs, t.heard, strict=True):
        setpoints = []
        for number in range(count):
            rig.end.send(alter(number, rig.session.packet(rig.sample)))
            setpoints.append(rig.session.close_cycle())
            rig.interpreter.advance(rig.period_ms)
            rig.cycle_number += 1
        for _ in range(count):
            rig.loop.cycle(0.0)
            ahead += rig is t.rigs[0] and t.ahead.sent
        while rig.end.receive(0.0) is not None:
            pass
        rig.sample.msr_jnt_pos[:] = setpoints[-1].position
        assert len(heard) == len(t.heard[0])
    assert t.heard[0] == t.heard[1]
    return ahead


BRIDGED = {
    "policy": {"bridged_cycles": 100, "hold_quality": 0, "perfect_rate": 0.0, "ok_rate": 0.0, "bad_rate": 0.0}
}


@pytest.mark.parametrize("moving", [True, False], ids=["motion", "hold"])
@pytest.mark.parametrize("count", [2, 7, 16, 21])
def test_packets_that_wait_are_answered_at_once_as_one_by_one(twins, moving, count):
    t = twins(1, **BRIDGED)
    motion = t.in_motion()
    if not moving:
        t.until_done()
        t.cycles(12)
    t.ahead.batches.clear()
    assert heap(t, count) == count
    assert t.ahead.batches[0] == min(count, 16)
    assert t.cycles(5) == 5
    if moving:
        assert t.until_done() == len(motion) - 20 - count - 5
        assert t.result is Result.DONE
    t.check_same()


@pytest.mark.parametrize("moving", [True, False], ids=["motion", "hold"])
def test_packets_that_come_while_the_loop_is_busy_get_the_answers_that_are_left(twins, moving):
    t = twins(1)
    motion = t.in_motion()
    if not moving:
        t.until_done()
        t.cycles(12)
    t.ahead.meanwhile = True
    # Few were waited for: those that no answer was left for.
    assert 3 <= t.cycles(40) <= 14
    t.ahead.meanwhile = False
    assert t.cycles(5) == 5
    if moving:
        assert t.until_done() == len(motion) - 20 - 40 - 5
        assert t.result is Result.DONE
    t.check_same()


@pytest.mark.parametrize("what", ["stop", "drop", "request"])
def test_request_is_obeyed_before_a_packet_that_comes_while_the_loop_is_busy(twins, what):
    t = twins(1)
    t.in_motion()
    t.ahead.meanwhile = True
    t.both(lambda rig: ask(rig, what))
    t.cycle()
    assert t.mode is (Mode.SILENT if what == "drop" else Mode.STOP)
    t.cycles(60)
    t.check_same()


@pytest.mark.parametrize("what", ["drives off", "position impossible", "short", "id", "timestamp"])
def test_spoilt_packet_that_comes_while_the_loop_is_busy(twins, what):
    t = twins(1)
    t.in_motion()
    t.ahead.meanwhile = True
    t.cycles(2)
    t.alter = SPOILT[what]
    t.cycle()
    t.alter = None
    t.cycles(60)
    t.check_same()


def test_answers_that_are_left_are_not_sent_once_the_motion_is_stopped(twins):
    t = twins(1)
    t.in_motion()
    t.ahead.meanwhile = True
    t.cycle()
    t.both(lambda rig: rig.loop._commander.stop(Result.ABORTED, "the driver ended"))
    t.cycles(3)
    assert t.mode is Mode.STOP
    t.ahead.meanwhile = False
    t.cycles(60)
    assert t.mode is Mode.HOLD
    t.check_same()


def test_end_of_a_motion_among_packets_that_wait(twins):
    t = twins(**BRIDGED)
    motion = t.in_motion()
    t.cycles(len(motion) - 20 - 4)
    t.ahead.batches.clear()
    assert heap(t, 9) == 9
    # What comes after the end is asked for anew.
    assert t.ahead.batches[0] == 4
    assert t.result is Result.DONE
    assert t.mode is Mode.HOLD
    t.check_same()


@pytest.mark.parametrize("place", [1, 4])
@pytest.mark.parametrize(
    "what", ["drives off", "position impossible", "short", "counter far on", "timestamp"]
)
def test_spoilt_packet_among_those_that_wait(twins, what, place):
    t = twins(**BRIDGED)
    t.in_motion()
    t.ahead.batches.clear()
    heap(t, 8, lambda number, packet: SPOILT[what](packet) if number == place else packet)
    assert t.ahead.batches[0] == place
    t.cycles(60)
    t.check_same()


@pytest.mark.parametrize("name", ["msr_jnt_pos", "cmd_jnt_pos_fri_offset"])
def test_arm_that_does_not_follow_among_packets_that_wait(twins, name):
    t = twins(**BRIDGED)
    t.in_motion()
    spoil = put(name, "<f", 1.0)
    assert heap(t, 8, lambda number, packet: spoil(packet) if number == 3 else packet) == 3
    assert t.mode is Mode.STOP
    t.until_done()
    assert t.result is Result.ROBOT
    t.check_same()


@pytest.mark.parametrize("job", [Job.LEAVE, Job.HALT])
def test_request_that_changes_the_answers_is_obeyed_between_packets_that_wait(twins, job):
    t = twins(program="lwr_identification", **BRIDGED)
    t.enter()
    t.cycles(10)
    t.both(lambda rig: rig.post(job, limit=200))
    heap(t, 8)
    assert t.loop.mode is not Mode.SILENT
    t.until_done()
    t.check_same()


def test_stop_that_is_asked_for_while_packets_wait(twins):
    t = twins(**BRIDGED)
    t.in_motion()
    t.ahead.before = lambda: ask(t.rigs[0], "stop")
    ask(t.rigs[1], "stop")
    assert heap(t, 6) == 0
    assert t.mode is Mode.STOP
    t.until_done()
    t.check_same()


def test_end_of_the_loop_leaves_no_packet_out_that_was_answered(twins):
    t = twins(1, **BRIDGED)
    t.in_motion()
    rig = t.rigs[0]
    rows = len(t.rings[0].take())
    for _ in range(6):
        rig.end.send(rig.session.packet(rig.sample))
        rig.session.close_cycle()
    rig.loop.cycle(0.0)
    assert t.ahead.waiting == 5
    rig.control.words[Word.QUIT] = 1
    rig.loop.run(os.getppid())
    assert len(t.rings[0].take()) == rows + 6
    assert "would not have given" not in rig.control.text(Text.LEFT)
    assert "the driver ended" in rig.control.text(Text.LEFT) + rig.reason
