"""Answers that are ready before their packet: the same bytes as without, and only where nothing is new.

Each test drives two loops through the same cycles, one that answers ahead and one that does not, and holds
what arrived at their controllers against each other, byte for byte.
"""

from __future__ import annotations

import socket
import subprocess
import sys

import numpy as np
import pytest

from fri.packets import MSR_SIZE
from fri.states import ALL_DRIVES
from lwr_driver import loop_process, realtime
from lwr_driver.control import Job, Mode, Result, Text
from lwr_driver.loop_process import Scheduling
from lwr_driver.motion import Motion, move_to
from lwr_driver.realtime import Rights
from tests.lwr_driver.driver_rig import Rig, arm
from tests.lwr_driver.driver_twins import HOP, SPOILT, ask, put

# -- a session ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("program", ["lwr_identification", "stanford", "ros_control"])
@pytest.mark.parametrize("period_ms", [5, 10])
def test_session_is_the_same_to_the_last_bit(twins, program, period_ms):
    t = twins(period_ms, program=program)
    t.enter()
    assert t.cycles(10) == 10
    first = t.hop(0.5 * HOP)
    motion = first.join(move_to(arm(), first.q[-1], first.q[-1] - HOP, t.period_s, phase="return"))
    t.start(motion)
    # Begin, change of the phase and end included.
    assert t.until_done() == len(motion)
    assert t.result is Result.DONE
    assert t.cycles(5) == 5
    t.start(t.hop())
    assert t.cycles(12) == 12
    t.both(Rig.stop)
    t.until_done()
    assert t.result is Result.ABORTED
    t.both(lambda rig: rig.post(Job.CYCLES, a=7))
    assert t.until_done() == 7
    np.testing.assert_array_equal(*(rig.control.measured for rig in t.rigs))
    t.both(lambda rig: rig.post(Job.LEAVE, limit=200))
    t.until_done()
    t.cycles(5)
    assert t.mode is Mode.MIRROR
    t.check_same()


def test_motion_that_does_not_begin_where_the_arm_is_leaves_it_where_it_is(twins):
    t = twins()
    t.enter()
    here = t.target
    away = move_to(arm(), here + 0.01, here + 0.1, t.period_s)
    t.start(away)
    assert t.cycles(3) == 3
    assert t.result is Result.REFUSED
    t.check_same()


def test_zero_below_nought_is_the_motions_and_not_the_holds(twins):
    t = twins(q=np.array([0.1, 0.5, 0.0, -1.3, 0.3, 0.8, -0.1]))
    t.enter()
    motion = t.hop()
    q = motion.q.copy()
    q[0, 2] = -0.0
    t.start(Motion(q, motion.period_s, motion.phases))
    assert t.until_done() == len(motion)
    t.check_same()


def test_counters_wrap(twins):
    t = twins()
    # Their first packet has not been sent.
    t.both(lambda rig: setattr(rig.session, "_sequence", 65480))
    t.both(lambda rig: setattr(rig.loop.remote, "send_seq", 65470))
    t.in_motion()
    assert t.cycles(60) == 60
    assert t.session.send_seq < 100
    assert t.loop.remote.send_seq < 100
    t.check_same()


# -- packets that are not regular ------------------------------------------------------------------------------


@pytest.mark.parametrize("what", SPOILT)
@pytest.mark.parametrize("moving", [True, False], ids=["motion", "hold"])
def test_spoilt_packet_is_left_to_the_loop(twins, what, moving):
    t = twins()
    if moving:
        t.in_motion()
    else:
        t.enter()
        t.cycles(3)
    t.alter = SPOILT[what]
    assert t.cycle() == 0
    t.alter = None
    t.cycles(60)
    t.check_same()


@pytest.mark.parametrize("name", ["msr_jnt_pos", "cmd_jnt_pos_fri_offset"])
def test_arm_or_set_point_that_does_not_follow_stops_a_motion(twins, name):
    t = twins()
    t.in_motion()
    t.alter = put(name, "<f", 1.0)
    assert t.cycle() == 0
    t.alter = None
    assert t.mode is Mode.STOP
    t.until_done()
    assert t.result is Result.ROBOT
    t.check_same()


def test_limit_of_following_is_the_loops_to_the_last_bit(twins):
    t = twins()
    t.in_motion()
    while t.rigs[0].mode is Mode.MOTION:
        last = t.rigs[0].loop._commander.target[0]
        edge = np.float32(last + np.float32(0.2))
        t.alter = put(
            "msr_jnt_pos", "<f", float(edge if t.cycle_number % 2 else np.nextafter(edge, np.float32(9)))
        )
        t.cycle()
    t.check_same()


@pytest.mark.parametrize("faults", [{"lose_packet": True}, {"lose_answer": True}, {"copies": 3}])
def test_lost_and_repeated_packets(twins, faults):
    t = twins()
    t.in_motion()
    for _ in range(4):
        t.cycle(**faults)
        t.cycles(3)
    t.check_same()


def test_late_packet_is_not_answered(twins):
    t = twins()
    t.in_motion()
    kept: list[bytes] = []
    t.alter = lambda packet: kept.append(packet) or packet  # type: ignore[func-returns-value]
    t.cycles(2)
    packets = iter(kept[:2])
    t.alter = lambda packet: next(packets)
    assert t.cycle() == 0
    t.alter = None
    t.cycles(10)
    t.check_same()


def test_stranger_is_not_answered(twins):
    t = twins()
    t.in_motion()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.3", 0))
        other.setblocking(False)

        def beside(packet: bytes) -> bytes:
            for rig in t.rigs:
                other.sendto(packet, rig.loop.remote.address)
            return packet

        for host_too in range(3):
            t.alter = beside
            t.cycle()
            t.alter = None
            t.cycles(1 + host_too)
        with pytest.raises(BlockingIOError):
            other.recv(MSR_SIZE)
    assert t.rigs[0].loop.remote.foreign == t.rigs[1].loop.remote.foreign > 0


def test_controller_that_restarts(twins):
    t = twins()
    t.in_motion()

    def restart(rig: Rig) -> None:
        rig.session._sequence, rig.session._uptime_ms = 3, 0

    t.both(lambda rig: setattr(rig.session, "_uptime_ms", 10**7))
    t.cycles(3)
    t.both(restart)
    assert t.cycle() == 0
    t.cycles(30)
    t.check_same()


def test_safe_reactions_of_the_controller(twins):
    t = twins()
    for cause in (lambda rig: rig.session.set_drives(0), lambda rig: rig.session.fri_stop()):
        t.enter()
        t.start(t.hop())
        t.cycles(10)
        t.both(cause)
        t.cycles(4)
        assert t.mode is Mode.MIRROR
        t.both(lambda rig: rig.session.set_drives(ALL_DRIVES))
        t.cycles(60)
    t.check_same()


# -- the guard -------------------------------------------------------------------------------------------------


def test_what_the_guard_refuses_is_never_sent(twins):
    t = twins()
    t.enter()
    motion = t.hop()
    q = motion.q.copy()
    q[25:, 1] += 0.02
    t.start(Motion(q, motion.period_s, motion.phases))
    assert t.cycles(25) == 25
    assert t.cycle() == 0
    assert t.mode is Mode.STOP
    t.until_done()
    assert t.result is Result.GUARD
    assert t.arrived.excesses(arm().limits, t.period_s) == []
    t.check_same()


def test_preparing_has_no_effect(twins):
    t = twins()
    motion = t.in_motion()
    for _ in range(20):
        t.loop._make_ready(t.ahead)
    assert t.until_done() == len(motion) - 20
    t.check_same()


# -- requests --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("what", ["stop", "drop", "request", "quit"])
def test_request_before_the_packet_holds_for_its_answer(twins, what):
    t = twins()
    t.in_motion()
    t.ahead.before = lambda: ask(t.rigs[0], what)
    ask(t.rigs[1], what)
    assert t.cycle() == 0
    assert t.mode is {"drop": Mode.SILENT, "quit": Mode.MOTION}.get(what, Mode.STOP)
    t.cycles(60)
    t.check_same()


@pytest.mark.parametrize("what", ["stop", "drop", "request"])
def test_request_after_the_answer_left_holds_for_the_next(twins, what):
    t = twins()
    t.in_motion()
    t.ahead.after = lambda: ask(t.rigs[0], what)
    assert t.cycle() == 1
    assert t.mode is Mode.MOTION
    ask(t.rigs[1], what)
    assert t.cycle() == 0
    assert t.mode is (Mode.SILENT if what == "drop" else Mode.STOP)
    t.cycles(60)
    t.check_same()


def test_motion_asked_for_while_it_waits_begins_with_the_next_packet(twins):
    t = twins()
    t.enter()
    motion = t.hop()
    packets: list[bytes] = []
    send = t.end.send
    # The first wait finds the request and no packet, the second one the packet.
    t.end.send = packets.append

    def second() -> None:
        send(packets.pop())

    def first() -> None:
        t.rigs[0].start(motion)
        t.ahead.before = second

    t.ahead.before = first
    t.rigs[1].start(motion)
    assert t.cycle() == 1
    t.end.send = send
    assert t.until_done() == len(motion) - 1
    t.check_same()


def test_motion_replaced_after_its_first_row_left_is_still_the_one_that_was_asked_for(twins):
    t = twins()
    t.enter()
    motion = t.hop()
    t.start(motion)
    t.ahead.after = lambda: t.rigs[0].post(Job.HALT)
    assert t.cycle() == 1
    t.rigs[1].post(Job.HALT)
    t.until_done()
    assert t.mode is Mode.HOLD
    assert t.loop.mode is not Mode.SILENT


# -- what must not happen, and does no harm if it does ------------------------------------------------------------


def test_answer_that_is_not_the_loops_own_is_the_last_one(twins):
    t = twins()
    t.in_motion()
    rig = t.rigs[0]

    def spoil() -> None:
        t.ahead._answers[:, 150] ^= 1

    t.ahead.before = spoil
    rig.cycle()
    assert rig.mode is Mode.SILENT
    heard = len(t.heard[0])
    rig.cycles(5)
    assert len(t.heard[0]) == heard
    assert rig.result is Result.GUARD
    assert "would not have given" in rig.control.text(Text.LEFT)


def test_answer_that_cannot_leave_is_left_to_the_loop(twins):
    t = twins()
    t.in_motion()
    t.ahead.before = lambda: t.ahead._controller.__setitem__(0, t.ahead._controller[0] + 1)
    assert t.cycle() == 0
    assert t.cycles(3) == 3
    t.check_same()


def test_waiting_ends_without_a_packet(twins):
    t = twins()
    t.enter()
    assert not t.loop.cycle(0.002)
    assert not t.ahead.wait(0, 1_000_000, 1_000_000)
    assert not t.ahead.arrived
    assert t.mode is Mode.HOLD


# -- where it runs ---------------------------------------------------------------------------------------------


def test_loop_without_rights_does_not_load_the_compiler():
    program = "import lwr_driver.loop_process, sys; sys.exit('numba' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program]).returncode == 0


class Granted:
    """Rights as `realtime` would grant them, without taking any."""

    @pytest.fixture(autouse=True)
    def granted(self, monkeypatch):
        monkeypatch.setattr(realtime, "assess", lambda priority: Rights())
        monkeypatch.setattr(realtime, "reserve", lambda cpu: (1, None))
        monkeypatch.setattr(realtime, "set_up", lambda priority, cpu: Rights(processor=1))


class TestRights(Granted):
    def test_loop_with_rights_looks_out(self):
        rig = Rig(lock_step=False)
        rights = loop_process._become_real_time(rig.loop, rig.control, Scheduling(True, True))
        assert rig.loop.turnaround is not None
        assert rights == Rights(processor=1)
        rig.enter()
        rig.close()

    def test_without_a_processor_of_its_own_the_loop_sleeps_until_a_packet_comes(self, monkeypatch):
        taken = realtime.Shortage("each processor has a driver already", "use one for each")
        monkeypatch.setattr(realtime, "reserve", lambda cpu: (None, taken))
        monkeypatch.setattr(realtime, "set_up", lambda priority, cpu: Rights(processor=cpu))
        rig = Rig(lock_step=False)
        rights = loop_process._become_real_time(rig.loop, rig.control, Scheduling(True, True))
        assert rig.loop.turnaround is None
        assert rights.advice == (taken,)
        rig.close()

    def test_without_a_compiler_the_loop_says_so_and_goes_on(self, monkeypatch):
        monkeypatch.setitem(sys.modules, "lwr_driver.turnaround", None)
        rig = Rig(lock_step=False)
        rights = loop_process._become_real_time(rig.loop, rig.control, Scheduling(True, True))
        assert rig.loop.turnaround is None
        assert "cannot be compiled" in str(rights.advice[0])
        assert rights.ok
        rig.enter()
        rig.close()
