"""Answers that are ready before their packet: the same bytes as without, and only where nothing is new.

Each test drives two loops through the same cycles, one that answers ahead and one that does not, and holds
what arrived at their controllers against each other, byte for byte.
"""

from __future__ import annotations

import os
import socket
import struct
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from driver_rig import Rig, arm
from numpy.typing import NDArray

from fri.packets import MSR_OFFSETS, MSR_SIZE
from fri.states import ALL_DRIVES
from lwr_driver import loop_process, realtime
from lwr_driver.control import Job, Mode, Result, Text, Word
from lwr_driver.loop_process import Scheduling
from lwr_driver.motion import Motion, move_to
from lwr_driver.realtime import Rights
from lwr_driver.ring import Ring
from lwr_driver.turnaround import Turnaround

HOP = np.array([0.3, -0.2, 0.3, 0.4, -0.5, 0.2, 0.6])


class Watched(Turnaround):
    """Counts what it answers, and can be made to see something happen before or after it waits."""

    def __init__(self, rig: Rig) -> None:
        remote = rig.loop.remote
        super().__init__(remote.descriptor, remote.buffer, rig.control.words)
        self.answered = 0
        self.batches: list[int] = []
        # The packets of the rig are sent before the loop looks; they are to come while it looks out.
        self.meanwhile = False
        self.before: Callable[[], None] | None = None
        self.after: Callable[[], None] | None = None

    def next(self, *, more: bool) -> bool:
        return super().next(more=more and self.meanwhile)

    def wait(self, awake_ns: int, asleep_ns: int, patience_ns: int) -> bool:
        if self.before is not None:
            hook, self.before = self.before, None
            hook()
        asked = super().wait(awake_ns, asleep_ns, patience_ns)
        self.batches.append(int(np.count_nonzero(self._found[: self._taken, 2])))
        self.answered += self.sent
        if self.after is not None:
            hook, self.after = self.after, None
            hook()
        return asked


class Twins:
    """Two rigs in step, the first of which answers ahead."""

    def __init__(self, period_ms: int = 5, **options: Any) -> None:
        self.rings = Ring.create(2000), Ring.create(2000)
        self.rigs = [Rig(period_ms, lock_step=False, ring=ring, **options) for ring in self.rings]
        self.ahead = Watched(self.rigs[0])
        self.rigs[0].loop.turnaround = self.ahead
        self.alter: Callable[[bytes], bytes] | None = None
        self.heard: tuple[list[bytes], list[bytes]] = ([], [])
        for rig, heard in zip(self.rigs, self.heard, strict=True):
            rig.timeout_s = 0.0
            self._tap(rig, heard)

    def _tap(self, rig: Rig, heard: list[bytes]) -> None:
        send, receive = rig.end.send, rig.end.receive

        def altered(packet: bytes) -> None:
            send(packet if self.alter is None else self.alter(packet))

        def received(timeout_s: float) -> bytes | None:
            datagram = receive(timeout_s)
            if datagram is not None:
                heard.append(datagram)
            return datagram

        rig.end.send, rig.end.receive = altered, received  # type: ignore[method-assign]

    def close(self) -> None:
        for rig, ring in zip(self.rigs, self.rings, strict=True):
            rig.close()
            ring.unlink()

    def __getattr__(self, name: str) -> Any:
        """What is asked of the twins is asked of the first."""
        return getattr(self.rigs[0], name)

    def both(self, act: Callable[[Rig], object]) -> None:
        for rig in self.rigs:
            act(rig)

    def cycle(self, **faults: Any) -> int:
        """One cycle of both; how many answers left ahead."""
        before = self.ahead.answered
        self.both(lambda rig: rig.cycle(**faults))
        assert self.heard[0] == self.heard[1]
        assert self.rigs[0].mode is self.rigs[1].mode
        return self.ahead.answered - before

    def cycles(self, count: int) -> int:
        return sum(self.cycle() for _ in range(count))

    def until_done(self, most: int = 2000) -> int:
        """Cycles until what was asked for is done; how many answers left ahead."""
        ahead = 0
        for _ in range(most):
            if self.rigs[0].done:
                assert self.rigs[1].done
                assert self.rigs[0].result is self.rigs[1].result
                assert self.rigs[0].reason == self.rigs[1].reason
                return ahead
            ahead += self.cycle()
        raise AssertionError(f"not done after {most} cycles, mode {self.rigs[0].mode.name}")

    def enter(self) -> None:
        self.both(lambda rig: rig.post(Job.START, limit=2000))
        self.until_done()
        assert self.rigs[0].mode is Mode.HOLD

    def start(self, motion: Motion) -> None:
        self.both(lambda rig: rig.start(motion))

    def hop(self, way: NDArray[np.float64] = HOP) -> Motion:
        rig = self.rigs[0]
        return move_to(arm(), rig.target, rig.target + way, rig.period_s, speed_scale=0.6)

    def in_motion(self, rows: int = 20) -> Motion:
        self.enter()
        motion = self.hop()
        self.start(motion)
        assert self.cycles(rows) == rows
        assert self.rigs[0].mode is Mode.MOTION
        return motion

    def check_same(self) -> None:
        """Logs, counters, tracking errors and reasons are the same, too; times apart."""
        rows = [ring.take() for ring in self.rings]
        for name in ("sequence", "plan_index", "phase", "answered", "msr", "cmd"):
            assert rows[0][name].tobytes() == rows[1][name].tobytes(), name
        sent = rows[0]["answered"] == 1
        assert np.all(rows[0]["t_send"][sent] >= rows[0]["t_recv"][sent])
        assert np.all(np.diff(rows[0]["t_recv"]) > 0)
        words = [rig.control.words.copy() for rig in self.rigs]
        for each in words:
            each[Word.HEARD_NS] = 0
        np.testing.assert_array_equal(*words)
        np.testing.assert_array_equal(*(rig.control.tracking for rig in self.rigs))
        assert len({int(rig.control.latency.sum()) for rig in self.rigs}) == 1
        assert len({rig.control.text(Text.LEFT) for rig in self.rigs}) == 1
        assert len({tuple(rig.loop.remote.counters().items()) for rig in self.rigs}) == 1


@pytest.fixture
def twins():
    made: list[Twins] = []

    def make(*arguments: Any, **options: Any) -> Twins:
        made.append(Twins(*arguments, **options))
        return made[-1]

    yield make
    for each in made:
        each.close()


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


# -- packets that wait, because the computer stood still --------------------------------------------------------


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


# -- packets that are not regular ------------------------------------------------------------------------------


def put(name: str, layout: str, *values: float) -> Callable[[bytes], bytes]:
    def alter(packet: bytes) -> bytes:
        changed = bytearray(packet)
        struct.pack_into(layout, changed, MSR_OFFSETS[name], *values)
        return bytes(changed)

    return alter


SPOILT = {
    "state": put("state", "<H", 1),
    "state unknown": put("state", "<H", 7),
    "quality unknown": put("quality", "<H", 4),
    "drives off": put("power", "<H", 0),
    "a drive off": put("power", "<H", ALL_DRIVES & ~4),
    "drive error": put("error", "<H", 4),
    "control": put("control", "<H", 3),
    "sample time": put("cmd_sample_time", "<f", 0.007),
    "measuring time": put("msr_sample_time", "<f", -0.005),
    "timestamp": put("timestamp", "<f", float("nan")),
    "position no number": put("msr_jnt_pos", "<f", float("nan")),
    "position impossible": put("msr_jnt_pos", "<f", -1e3),
    "set point impossible": put("cmd_jnt_pos", "<f", 1e3),
    "offset impossible": put("cmd_jnt_pos_fri_offset", "<f", 1e3),
    "set point no number": put("cmd_jnt_pos", "<f", float("nan")),
    "offset infinite": put("cmd_jnt_pos_fri_offset", "<f", float("inf")),
    "torque no number": put("msr_jnt_trq", "<f", float("nan")),
    "torque impossible": put("msr_jnt_trq", "<f", 3e3),
    "id": put("datagram_id", "<H", 0x2007),
    "size field": put("packet_size", "<H", 915),
    "counter far on": put("send_seq", "<H", 40_000),
    "short": lambda packet: packet[:-1],
    "long": lambda packet: packet + b"x",
    "empty": lambda packet: b"",
}


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


def ask(rig: Rig, what: str) -> None:
    words = rig.control.words
    if what == "request":
        rig.post(Job.HALT)
    else:
        words[Word[what.upper()]] += 1


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
        monkeypatch.setattr(realtime, "set_up", lambda priority, cpu: Rights(processor=1))


class TestRights(Granted):
    def test_loop_with_rights_looks_out(self):
        rig = Rig(lock_step=False)
        rights = loop_process._become_real_time(rig.loop, rig.control, Scheduling(True, True))
        assert rig.loop.turnaround is not None
        assert rights == Rights(processor=1)
        rig.enter()
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
