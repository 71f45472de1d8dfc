"""The same session over UDP and inside one process: not a bit of difference, and defined ends."""

from __future__ import annotations

import hashlib
import json
import socket
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader

from fri.errors import ConfigurationError, NetworkError
from lwr_driver.driver import Driver, LinkSettings
from lwr_driver.hosted_loop import LoopHost
from lwr_driver.motion import move_to
from lwr_driver.session import session_metadata
from lwr_driver.session.motor_torque import KrlMotorTorque
from runner.laboratory import free_port
from sim_backend.process import EmulatorProcess
from tests.lwr_driver.driver_rig import arm

AWAY = np.array([0.3, -0.2, 0.2, 0.2, 0.1, -0.1, 0.3])
FAULTS: dict[str, dict[str, Any]] = {
    "clean": {},
    "loss": {"kind": "loss", "probability": 0.1, "cycles": 200},
    "duplicate": {"kind": "duplicate", "probability": 0.5, "cycles": 200},
    "foreign": {"kind": "foreign", "probability": 0.5, "cycles": 200},
}


def _drive(path: Path, fault: dict[str, Any], *, hosting: bool) -> str:
    """Drive away and back with another payload; a hash of all messages and times of the log."""
    port = free_port("127.0.0.1")
    link = LinkSettings("127.0.0.1", port, lock_step=True, handshake="lwr_identification")
    settings = {"fri.program": "lwr_identification", "fri.period_ms": 2}
    with (
        EmulatorProcess(fri_port=port, settings=settings, hosting=hosting) as emulator,
        Driver(arm(), link, motor_torque=KrlMotorTorque(), host=emulator.host) as driver,
    ):
        driver.connect()
        driver.wait_quality()
        driver.enter_command()
        driver.record(path, session_metadata(robot="LWR4+", uid="1", utc_start="2020-01-01T00:00:00+00:00"))
        if fault:
            emulator.pendant.schedule("inject", when="moving", after_cycles=30, **fault)
        for way in (AWAY, -AWAY):
            start = driver.state().q_command
            motion = move_to(arm(), start, start + way, driver.state().period_s, speed_scale=0.5)
            outcome = driver.execute(motion)
            emulator.pendant.mount("paper_load")
            if outcome.status != "success":
                break
        driver.end_record(outcome.status, outcome.reason)
    digest = hashlib.sha256(f"{outcome.status} {outcome.row}".encode())
    with path.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages():
            times = f"{channel.topic} {message.log_time} {message.publish_time} {message.sequence}"
            digest.update(times.encode() + message.data)
    return digest.hexdigest()


@pytest.mark.slow
@pytest.mark.parametrize("fault", FAULTS)
def test_both_transports_give_the_same_messages_and_times(tmp_path: Path, fault: str) -> None:
    ways = {
        hosting: _drive(tmp_path / f"{hosting}.mcap", FAULTS[fault], hosting=hosting)
        for hosting in (True, False)
    }
    assert ways[True] == ways[False]


@pytest.mark.slow
def test_drivers_may_follow_each_other_and_notice_the_end_of_the_emulator() -> None:
    with EmulatorProcess(hosting=True, period_ms=5) as emulator:
        link = LinkSettings("127.0.0.1", emulator.fri_port, lock_step=True, lock_step_patience_s=5.0)
        for _ in range(2):
            with Driver(arm(), link, host=emulator.host) as driver:
                driver.connect()
                assert driver.monitor(10).cycles == 10
        with Driver(arm(), replace(link, lock_step_patience_s=1.0), host=emulator.host) as driver:
            driver.connect()
            emulator.pendant.shutdown()
            with pytest.raises(NetworkError, match=r"the loop in process \d+ ended"):
                driver.wait_quality(cycles=10**6)


def test_one_process_needs_lock_step() -> None:
    with pytest.raises(ConfigurationError, match="hosting needs lock step"):
        EmulatorProcess(hosting=True, lock_step=False)
    with EmulatorProcess(hosting=True) as emulator:
        driver = Driver(arm(), LinkSettings("127.0.0.1", emulator.fri_port), host=emulator.host)
        with pytest.raises(ConfigurationError, match="needs lock step"):
            driver.connect()


def test_a_late_word_of_the_loop_before_is_no_answer_to_the_next() -> None:
    with EmulatorProcess(hosting=True, period_ms=5) as emulator:
        assert emulator.host is not None
        # As of a loop whose driver had stopped waiting for its end.
        mine, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with mine, theirs:
            theirs.send(json.dumps({"ended": "late"}).encode())
            seat, emulator.host.connection = emulator.host.connection, Relay(mine, emulator.host.connection)
            link = LinkSettings("127.0.0.1", emulator.fri_port, lock_step=True, lock_step_patience_s=5.0)
            with Driver(arm(), link, host=emulator.host) as driver:
                driver.connect()
                assert driver.monitor(10).cycles == 10
            emulator.host.connection = seat


class Relay:
    """The connection of a host with one message waiting in front of it."""

    def __init__(self, waiting: socket.socket, behind: socket.socket) -> None:
        self.waiting: socket.socket | None = waiting
        self.behind = behind

    def fileno(self) -> int:
        return (self.waiting or self.behind).fileno()

    def recv(self, size: int) -> bytes:
        now, self.waiting = self.waiting or self.behind, None
        return now.recv(size)

    def sendmsg(self, *arguments: Any) -> int:
        return self.behind.sendmsg(*arguments)


def test_an_emulator_that_cannot_be_started_leaves_no_socket(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[Any] = []
    monkeypatch.setattr("sim_backend.process.LoopHost", lambda: made.append(LoopHost()) or made[-1])
    monkeypatch.setattr("sim_backend.process.subprocess.Popen", refuse)
    with pytest.raises(OSError, match="no more processes"):
        EmulatorProcess(hosting=True).start()
    assert made[0].connection.fileno() == -1


def refuse(*arguments: Any, **named: Any) -> None:
    raise OSError("no more processes")
