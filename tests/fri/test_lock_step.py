"""Both ends over UDP on loopback, in lock step: no step waits for a clock, every loop is bounded."""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from fri.controller_end import ControllerEnd
from fri.errors import NetworkError
from fri.handshake import find_handshake
from fri.krc import EventKind, KrcPolicy, KrcSession, Sample, Setpoint
from fri.krl import Interpreter
from fri.remote import RemoteEnd
from fri.states import Control, State
from sim_backend.program import krl_program
from tests.fri.fri_rig import LIMITS, Q_START, QUICK

PATIENCE_S = 5.0


class Link:
    """Both ends, and the PC in a thread of its own where a test wants `lock_step` to wait for it."""

    def __init__(self) -> None:
        self.remote = RemoteEnd("127.0.0.1", 0)
        self.controller = ControllerEnd(self.remote.address)
        self.session = KrcSession(LIMITS, Q_START, KrcPolicy(**QUICK))
        self.sample = Sample()

    def close(self) -> None:
        self.remote.close()
        self.controller.close()

    def exchange(self, q: np.ndarray | None = None) -> Setpoint:
        """One cycle without a thread: the PC answers between sending and collecting."""
        self.controller.send(self.session.packet(self.sample))
        assert self.remote.receive(PATIENCE_S) is not None
        self.remote.answer(q)
        datagram = self.controller.receive(PATIENCE_S)
        assert datagram is not None
        assert self.session.receive(datagram)
        return self.session.close_cycle()

    def serve(self, cycles: int, decide: Callable[[int], np.ndarray | None]) -> threading.Thread:
        """Answer so many packets in a thread."""

        def run() -> None:
            for k in range(cycles):
                if self.remote.receive(PATIENCE_S) is None:
                    return
                self.remote.answer(decide(k))

        thread = threading.Thread(target=run)
        thread.start()
        return thread


@pytest.fixture
def link() -> Iterator[Link]:
    made = Link()
    yield made
    made.close()


@pytest.mark.parametrize("name", ["rcprg", "ros_control", "stanford"])
@pytest.mark.parametrize("sample_time_ms", [1, 5])
def test_experiment_over_the_wire(link, name, sample_time_ms):
    """Open, start by handshake, follow a motion, stop: what is followed is what was sent, as float32."""
    interpreter = Interpreter(link.session, krl_program(name, sample_time_ms))
    handshake = find_handshake(name)
    remote = link.remote
    period = sample_time_ms * 1e-3

    def cycle(q: np.ndarray | None = None) -> Setpoint:
        while link.session.state is State.OFF:
            interpreter.advance(sample_time_ms)
        setpoint = link.exchange(q)
        interpreter.advance(sample_time_ms)
        return setpoint

    for _ in range(400):
        cycle()
        handshake.request_start(remote.command, remote.msr, Control.POSITION)
        if handshake.started(remote.msr):
            break
    assert remote.commanding
    for k in range(1, 300):
        q = Q_START + 0.1 * (1.0 - np.cos(2.0 * np.pi * 0.5 * k * period)) * np.ones(7)
        setpoint = cycle(q)
        assert setpoint.state is State.CMD
        assert setpoint.position.tolist() == np.float32(q).astype(float).tolist()
    for _ in range(400):
        handshake.request_stop(remote.command, remote.msr)
        cycle(q)
        if handshake.stopped(remote.msr):
            break
    assert remote.state == State.MON
    assert [event.kind for event in link.session.events] == [
        EventKind.OPENED,
        EventKind.STARTED,
        EventKind.STOPPED,
    ]
    assert link.session.miss_counter == 0
    counters = remote.counters()
    assert counters["received"] == counters["answered"] == link.session.cycle
    assert sum(counters.values()) == 2 * link.session.cycle


def test_lock_step_waits_for_the_pc(link):
    link.session.fri_open(1)
    link.session.fri_start()
    thread = link.serve(200, lambda k: None)
    for _ in range(200):
        setpoint = link.controller.lock_step(link.session, link.sample)
    thread.join(PATIENCE_S)
    assert not thread.is_alive()
    assert setpoint.state is State.CMD
    assert link.remote.counters()["received"] == 200


def test_first_packet_is_repeated_until_the_pc_answers_and_answered_once(link, monkeypatch):
    monkeypatch.setattr("fri.controller_end._SLICE_S", 0.0)
    monkeypatch.setattr("fri.controller_end._RESEND_S", 0.0)
    link.session.fri_open(1)
    waits = 0
    thread = None

    def idle() -> bool:
        nonlocal waits, thread
        waits += 1
        if waits == 20:
            thread = link.serve(1, lambda k: None)
        return False

    assert link.controller.lock_step(link.session, link.sample, idle=idle) is not None
    assert thread is not None
    thread.join(PATIENCE_S)
    assert link.session.counters()["answered"] == 1
    link.remote.receive(0.1)
    assert link.remote.counters()["repeated"] >= 19
    assert link.remote.counters()["answered"] == 1


def test_waiting_can_be_given_up(link):
    link.session.fri_open(1)
    assert link.controller.lock_step(link.session, link.sample, idle=lambda: True) is None
    link.session.fri_close()
    setpoint = link.controller.lock_step(link.session, link.sample)
    assert setpoint is not None
    assert setpoint.state is State.OFF


def test_missing_answer_in_command_mode_is_a_missed_cycle(link):
    link.session.fri_open(1)
    link.session.fri_start()
    for _ in range(60):
        link.exchange()
    assert link.session.state is State.CMD
    for _ in range(4):
        setpoint = link.controller.lock_step(link.session, link.sample, patience_s=0.0)
    assert setpoint.drop.kind is EventKind.MISSES


def test_malformed_answer_ends_the_wait(link):
    link.session.fri_open(1)
    link.controller.send(link.session.packet(link.sample))
    link.session.close_cycle()
    pc = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    pc.bind(("127.0.0.1", 0))
    link.controller.remote = pc.getsockname()
    pc.sendto(b"nonsense", link.controller.address)
    assert link.controller.lock_step(link.session, link.sample) is not None
    assert link.session.counters()["malformed"] == 1
    pc.close()


def test_controller_hears_its_pc_only(link):
    stranger = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    stranger.sendto(b"x", link.controller.address)
    assert link.controller.receive(0.1) is None
    assert link.controller.foreign == 1
    stranger.close()


@pytest.mark.parametrize("uptime_s", [0.0, 4000.0])
def test_restarted_controller_is_recognised_and_served(link, monkeypatch, uptime_s):
    monkeypatch.setattr("fri.remote._PORT_GRACE_S", 0.0)
    link.session = KrcSession(LIMITS, Q_START, KrcPolicy(**QUICK), uptime_s=2000.0, first_sequence=30_000)
    link.session.fri_open(1)
    for _ in range(50):
        link.exchange()
    link.remote.krl_int[15] = 10
    link.controller.close()
    link.controller = ControllerEnd(link.remote.address)
    link.session = KrcSession(LIMITS, Q_START, KrcPolicy(**QUICK), uptime_s=uptime_s)
    link.session.fri_open(1)
    for _ in range(50):
        link.exchange()
    counters = link.remote.counters()
    assert (counters["restarts"], counters["port_changes"], counters["lost"]) == (1, 1, 0)
    assert counters["received"] == 100
    assert link.session.from_int[15] == 0


def test_real_time_cycle_collects_until_the_deadline(link):
    link.session.fri_open(1)
    setpoint = link.controller.real_time(link.session, link.sample, deadline=0.0)
    assert setpoint.state is State.MON
    assert link.session.miss_counter == 1
    link.session.fri_close()
    assert link.controller.real_time(link.session, link.sample, deadline=0.0).state is State.OFF


def test_local_port_in_use_says_so(link):
    with pytest.raises(NetworkError, match="free port"):
        ControllerEnd(link.remote.address, link.controller.address)
