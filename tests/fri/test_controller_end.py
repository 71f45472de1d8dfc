"""The controller's socket on a clock of its own: what is waited for, how long, and what is counted."""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator
from types import SimpleNamespace

import numpy as np
import pytest

from fri.controller_end import ControllerEnd
from fri.krc import EventKind
from fri.packets import MSR
from fri.states import State
from tests.fri.fri_rig import Rig


class Clock:
    """Time that passes in `select` alone; `at` does something at a time, before a wait that ends later."""

    def __init__(self) -> None:
        self.now = 1000.0
        self.start = self.now
        self.waits: list[float] = []
        self.plan: list[tuple[float, Callable[[], object]]] = []

    def at(self, after_s: float, action: Callable[[], object]) -> None:
        self.plan.append((self.start + after_s, action))
        self.plan.sort(key=lambda item: item[0])

    def monotonic(self) -> float:
        return self.now

    def select(self, *arguments: object) -> None:
        assert arguments[0]
        assert not any(arguments[1:3])
        timeout = float(arguments[3])  # type: ignore[arg-type]
        self.waits.append(timeout)
        assert len(self.waits) < 1000
        if self.plan and self.plan[0][0] <= self.now + timeout:
            self.now, action = self.plan.pop(0)
            action()
        else:
            self.now += timeout

    @property
    def passed(self) -> float:
        return self.now - self.start


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    made = Clock()
    monkeypatch.setattr("fri.controller_end.monotonic", made.monotonic)
    monkeypatch.setattr("fri.controller_end.select", SimpleNamespace(select=made.select))
    return made


class Link:
    """A controller's end, a PC that is a bare socket, and a session with a client."""

    def __init__(self) -> None:
        self.pc = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.pc.bind(("127.0.0.1", 0))
        self.pc.setblocking(False)
        self.end = ControllerEnd(self.pc.getsockname())
        self.rig = Rig(sample_time_ms=2)
        self.session = self.rig.session

    def say(self, datagram: bytes) -> None:
        self.pc.sendto(datagram, self.end.address)

    def heard(self) -> list[bytes]:
        found = []
        while True:
            try:
                found.append(self.pc.recv(2048))
            except BlockingIOError:
                return found

    def reply(self) -> None:
        """Answer the newest packet."""
        self.rig.msr = np.frombuffer(self.heard()[-1], MSR).reshape(())
        self.say(self.rig.answer())


@pytest.fixture
def link() -> Iterator[Link]:
    made = Link()
    yield made
    made.end.close()
    made.pc.close()


def test_an_answer_is_waited_for_until_the_timeout(link: Link, clock: Clock) -> None:
    assert link.end.receive(0.3) is None
    assert clock.passed == pytest.approx(0.3)
    clock.at(0.5, lambda: link.say(b"late"))
    assert link.end.receive(0.3) == b"late"
    assert clock.passed == pytest.approx(0.5)
    assert clock.waits == pytest.approx([0.3, 0.3])


def test_without_a_timeout_nothing_is_waited_for(link: Link, clock: Clock) -> None:
    assert link.end.receive(0.0) is None
    assert clock.waits == []
    link.say(b"here")
    assert link.end.receive(0.0) == b"here"


def test_foreign_datagrams_do_not_prolong_the_wait(link: Link, clock: Clock) -> None:
    stranger = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    for k in range(20):
        clock.at(0.01 + 0.02 * k, lambda: stranger.sendto(b"x", link.end.address))
    assert link.end.receive(0.1) is None
    assert clock.passed == pytest.approx(0.1)
    assert link.end.foreign == 5
    stranger.close()


def test_some_foreign_datagrams_are_passed_over_even_without_a_timeout(
    link: Link, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    stranger = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    for _ in range(3):
        stranger.sendto(b"x", link.end.address)
    link.say(b"mine")
    assert link.end.receive(0.0) == b"mine"
    assert link.end.foreign == 3
    # A flood of them must not hold the controller.
    for delay, found in ((0.004, b"mine"), (0.006, None)):
        stranger.sendto(b"x", link.end.address)
        link.say(b"mine")
        times = iter([0.0, delay, delay])
        monkeypatch.setattr("fri.controller_end.monotonic", lambda times=times: next(times))
        assert link.end.receive(0.0) == found
    stranger.close()


def test_a_refusing_network_is_counted(link: Link) -> None:
    assert link.end.send_errors == 0
    link.end.remote = ("255.255.255.255", 9)
    for count in (1, 2):
        link.end.send(b"x")
        assert link.end.send_errors == count


def test_a_real_time_cycle_rates_the_answer_by_its_delay(link: Link, clock: Clock) -> None:
    link.session.fri_open(2)
    clock.at(0.0005, link.reply)
    setpoint = link.end.real_time(link.session, link.rig.sample, clock.start + 0.002)
    assert setpoint.state is State.MON
    # The end of the cycle is the deadline, not the answer.
    assert clock.passed == pytest.approx(0.002)
    assert link.session.counters()["answered"] == 1
    assert link.session.miss_counter == 0
    record = np.frombuffer(link.session.packet(link.rig.sample), MSR)[0]
    assert record["latency"] == pytest.approx(0.0005)


def test_an_answer_at_the_deadline_ends_a_real_time_cycle(link: Link, clock: Clock) -> None:
    link.session.fri_open(2)
    clock.at(0.002, link.reply)
    clock.at(0.002, lambda: link.say(b"next"))
    setpoint = link.end.real_time(link.session, link.rig.sample, clock.start + 0.002)
    assert setpoint.state is State.MON
    assert link.session.counters()["answered"] == 1
    # What comes later is for the next cycle.
    clock.select((link.end,), (), (), 0.0)
    assert link.end.receive(0.0) == b"next"


def test_a_closed_session_in_real_time_drops_what_comes(link: Link, clock: Clock) -> None:
    link.say(b"x" * 376)
    assert link.end.real_time(link.session, link.rig.sample, clock.start + 0.002).state is State.OFF
    assert clock.passed == pytest.approx(0.002)
    assert link.end.receive(0.0) is None
    assert link.heard() == []


def test_lock_step_waits_for_the_answer_without_an_end_in_monitor_mode(link: Link, clock: Clock) -> None:
    link.session.fri_open(2)
    clock.at(30.0, link.reply)
    assert link.end.lock_step(link.session, link.rig.sample, patience_s=1.0) is not None
    assert clock.passed == pytest.approx(30.0)
    assert link.session.counters()["answered"] == 1


def test_the_first_packet_is_sent_every_fifth_of_a_second_and_later_ones_once(
    link: Link, clock: Clock
) -> None:
    link.session.fri_open(2)
    sent: list[bytes] = []

    def reply() -> None:
        sent.extend(link.heard())
        link.rig.msr = np.frombuffer(sent[-1], MSR).reshape(())
        link.say(link.rig.answer())

    clock.at(1.1, reply)
    link.end.lock_step(link.session, link.rig.sample)
    # Every 0.2 s, to the next twentieth of a second.
    assert len(sent) in (5, 6)
    assert len(set(sent)) == 1
    sent.clear()
    clock.at(3.0, reply)
    link.end.lock_step(link.session, link.rig.sample)
    assert len(sent) == 1


def test_patience_ends_in_command_mode(link: Link, clock: Clock) -> None:
    link.rig.command_mode()
    clock.at(0.9, link.reply)
    link.end.lock_step(link.session, link.rig.sample, patience_s=1.0)
    missed = link.session.miss_counter
    began = clock.now
    setpoint = link.end.lock_step(link.session, link.rig.sample, patience_s=1.0)
    assert clock.now - began == pytest.approx(1.0, abs=0.06)
    assert setpoint is not None
    assert setpoint.drop is None
    assert link.session.miss_counter == missed + 1
    for _ in range(3):
        setpoint = link.end.lock_step(link.session, link.rig.sample, patience_s=1.0)
    assert setpoint is not None
    assert setpoint.drop is not None
    assert setpoint.drop.kind is EventKind.MISSES


def test_giving_up_is_asked_for_twenty_times_a_second(link: Link, clock: Clock) -> None:
    link.session.fri_open(2)
    asked = []

    def idle() -> bool:
        asked.append(clock.passed)
        return len(asked) == 40

    assert link.end.lock_step(link.session, link.rig.sample, idle=idle) is None
    assert asked == pytest.approx(np.arange(1, 41) * 0.05)
