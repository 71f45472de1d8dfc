from __future__ import annotations

import os
import resource
import socket

import pytest

from fri.errors import NetworkError
from lwr_driver import realtime
from lwr_driver.driver import Driver, LinkSettings
from lwr_driver.realtime import Rights, Shortage, assess
from sim_backend.process import EmulatorProcess
from tests.lwr_driver.driver_rig import arm


@pytest.fixture
def user(monkeypatch):
    """Pretends limits and capabilities of a user."""

    def pretend(priority: int, memory: int, capabilities: int = 0, kernel: str = "#1 SMP PREEMPT_RT") -> None:
        limits = {resource.RLIMIT_RTPRIO: priority, resource.RLIMIT_MEMLOCK: memory}
        monkeypatch.setattr(realtime.resource, "getrlimit", lambda which: (limits[which], limits[which]))
        monkeypatch.setattr(realtime, "_capabilities", lambda: capabilities)
        monkeypatch.setattr(realtime.platform, "version", lambda: kernel)
        monkeypatch.setattr(realtime, "_processors", lambda: 4)

    return pretend


def test_plain_user_is_told_every_line_to_write(user):
    user(priority=0, memory=8 * 2**20)
    rights = assess(80)
    assert not rights.ok
    text = " ".join(str(shortage) for shortage in rights.missing)
    assert "SCHED_FIFO priority 80 is not granted (limit 0)" in text
    assert "`@realtime - rtprio 95`" in text
    assert "`@realtime - memlock unlimited`" in text
    assert "setcap cap_sys_nice,cap_ipc_lock+ep" in text
    assert "limit 8192 KiB" in text
    with pytest.raises(NetworkError, match="rtprio 95"):
        rights.enforce()


@pytest.mark.parametrize(
    ("priority", "memory", "capabilities"),
    [(95, resource.RLIM_INFINITY, 0), (resource.RLIM_INFINITY, 2**40, 0), (0, 0, 1 << 14 | 1 << 23)],
)
def test_limits_or_capabilities_are_enough(user, priority, memory, capabilities):
    user(priority, memory, capabilities)
    assert assess(80).ok
    assess(80).enforce()


def test_priority_limit_below_what_is_asked_for_is_missing(user):
    user(priority=50, memory=resource.RLIM_INFINITY)
    assert [shortage.what for shortage in assess(80).missing] == [
        "SCHED_FIFO priority 80 is not granted (limit 50)"
    ]
    assert assess(50).ok


def test_ordinary_kernel_is_advice_not_an_obstacle(user, monkeypatch):
    user(95, resource.RLIM_INFINITY, kernel="#1 SMP PREEMPT_DYNAMIC")
    rights = assess(80)
    assert rights.ok
    if os.path.exists("/sys/kernel/realtime"):
        return
    assert "not PREEMPT_RT" in rights.advice[0].what
    assert "linux-image-rt-amd64" in rights.advice[0].remedy


def test_missing_rights_end_the_loop_when_they_are_required(monkeypatch):
    # The processor does not exist, so the real set-up in the real process reports a shortage.
    settings = LinkSettings(address="127.0.0.1", port=0, realtime="require", cpu=4095)
    with pytest.raises(NetworkError, match="no operation on processor 4095"):
        Driver(arm(), settings).connect(timeout_s=1.0)


def test_loop_answers_in_real_time_with_the_rights_there_are():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    settings = LinkSettings(address="127.0.0.1", port=port, realtime="allow", link_timeout_s=5.0)
    with EmulatorProcess(lock_step=False, fri_port=port, period_ms=10), Driver(arm(), settings) as driver:
        assert driver.connect().period_s == 0.01
        driver.monitor(20)
        state = driver.state()
        assert state.received >= 20
        assert state.answered == state.received
        assert set(state.latency_s) == {0.5, 0.99, 0.999, 1.0}
        assert driver.rights is not None
        assert driver._loop is not None
        policy = os.sched_getscheduler(driver._loop.pid)
        granted = not any("SCHED_FIFO" in shortage.what for shortage in driver.rights.missing)
        assert (policy == os.SCHED_FIFO) == granted


def test_rights_read_well():
    rights = Rights((Shortage("no a", "do b"),), (), None)
    with pytest.raises(NetworkError, match="no a: do b"):
        rights.enforce()


@pytest.fixture
def alone(monkeypatch):
    """A computer of four processors without other drivers; what is claimed is given back."""
    monkeypatch.setattr(realtime, "_CLAIM", f"\0test.{os.getpid()}.{{}}")
    monkeypatch.setattr(realtime, "_isolated", list)
    monkeypatch.setattr(realtime.os, "sched_getaffinity", lambda pid: {0, 1, 2, 3})
    yield
    while realtime._claims:
        realtime._claims.pop().close()


def test_drivers_on_one_computer_share_out_the_processors(alone):
    assert [realtime.reserve()[0] for _ in range(3)] == [3, 2, 1]
    processor, advice = realtime.reserve()
    assert processor is None
    assert "of 4 processors each has a driver but the first" in str(advice)


def test_isolated_processors_are_taken_first_and_one_given_back_is_taken_again(alone, monkeypatch):
    monkeypatch.setattr(realtime, "_isolated", lambda: [1, 2])
    assert [realtime.reserve()[0] for _ in range(3)] == [1, 2, 3]
    realtime._claims.pop(0).close()
    assert realtime.reserve()[0] == 1


def test_a_named_processor_is_taken_and_a_driver_already_there_is_told(alone):
    assert realtime.reserve(2) == (2, None)
    processor, advice = realtime.reserve(2)
    assert processor == 2
    assert "processor 2 has a driver already" in str(advice)
    assert realtime.reserve()[0] == 3


def test_nothing_long_happens_at_real_time_priority(alone, monkeypatch):
    order = []
    for name in ("collect", "freeze", "disable"):
        monkeypatch.setattr(realtime.gc, name, lambda name=name: order.append(name))
    monkeypatch.setattr(realtime, "_prefault", lambda: order.append("prefault"))
    monkeypatch.setattr(realtime.ctypes, "CDLL", lambda *_, **__: Library(order))
    monkeypatch.setattr(realtime.os, "sched_setaffinity", lambda *_: None)
    monkeypatch.setattr(realtime.os, "sched_setscheduler", lambda pid, kind, _: order.append(kind))
    monkeypatch.setattr(realtime.os, "open", lambda *_: os.dup(0))
    monkeypatch.setattr(realtime.os, "write", lambda *_: 4)
    assert realtime.set_up(80, realtime.reserve()[0]).processor == 3
    assert order == ["collect", "freeze", "disable", "prefault", "lock", os.SCHED_FIFO]
    realtime.give_back()
    assert order[-2:] == [os.SCHED_OTHER, "unlock"]
    assert not realtime._claims


class Library:
    def __init__(self, order):
        self.order = order

    def mlockall(self, flags):
        self.order.append("lock")
        return 0

    def munlockall(self):
        self.order.append("unlock")
