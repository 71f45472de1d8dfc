"""What the emulator tells on the terminal, and a client that left in lock step."""

from __future__ import annotations

import logging
import subprocess
import sys
import threading
import time

import pytest

from runner.laboratory import free_port
from sim_backend.configuration import load_configuration
from sim_backend.service import Service
from tests.sim_backend.pc import QUICK, Pc, emulator, gentle


def until(done: object, seconds: float = 20.0) -> None:
    """Wait for the emulator's thread."""
    end = time.monotonic() + seconds
    while not done() and time.monotonic() < end:
        time.sleep(0.02)
    assert done()


def test_modes_and_the_reason_of_a_drop_are_told(caplog: pytest.LogCaptureFixture) -> None:
    port = free_port("127.0.0.1")
    with caplog.at_level(logging.DEBUG, logger="emulator"), Pc(port, gentle) as pc, emulator(port) as pendant:
        pc.run(500)
        pendant.emergency_stop()
        pc.run(50)
    lines = [
        record.getMessage().partition(" s  ")[2] for record in caplog.records if record.name == "emulator"
    ]
    told = "\n".join(lines)
    assert "KRL program stanford started" in told
    assert "MON: opened with 2 ms" in told
    assert "CMD: command mode with limits x 1.00" in told
    assert "pendant: emergency_stop()" in told
    assert "MON: dropped: emergency stop" in told
    assert "quality PERFECT" in told
    assert "drives 0x00" in told
    assert lines.index("MON: opened with 2 ms") < lines.index("MON: dropped: emergency stop")


def test_without_v_only_what_must_be_seen_is_told(caplog: pytest.LogCaptureFixture) -> None:
    port = free_port("127.0.0.1")
    with caplog.at_level(logging.WARNING, logger="emulator"), Pc(port, gentle) as pc, emulator(port):
        pc.run(300)
    assert [record for record in caplog.records if record.name == "emulator"] == []


def test_in_lock_step_a_client_that_left_is_told_and_the_next_one_is_served(
    caplog: pytest.LogCaptureFixture,
) -> None:
    port = free_port("127.0.0.1")
    # In command mode too: the closed port ends the wait at once.
    with caplog.at_level(logging.WARNING, logger="emulator"), emulator(port) as pendant:
        with Pc(port, gentle) as pc:
            assert pc.run(600) == 600
            assert pc.states[-1] == 2
        until(lambda: "has left (its port is closed); time stands still" in caplog.text)
        until(lambda: pendant.status()["state"] == "MON")
        with Pc(port, gentle) as pc:
            assert pc.run(300) == 300
        until(lambda: "a client answers again" in caplog.text)
    assert caplog.text.count("has left") <= 2


def test_gravity_compensation_from_the_pendant_lets_a_push_move_the_arm() -> None:
    port = free_port("127.0.0.1")
    with Pc(port) as pc, emulator(port, {"fri.program": "lwr_identification"}) as pendant:
        pc.run(100)
        pendant.gravity_compensation()
        pc.run(100)
        before = pendant.status()
        assert before["control"] == "OTHER"
        pendant.push([8.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
        pc.run(400)
        pendant.push([0.0] * 7)
        pendant.gravity_compensation(False)
        pc.run(200)
        after = pendant.status()
    assert after["control"] == "POSITION"
    assert after["position"][0] - before["position"][0] > 0.05
    assert abs(after["setpoint"][0] - after["position"][0]) < 0.01


def test_with_once_the_emulator_ends_with_its_client(caplog: pytest.LogCaptureFixture) -> None:
    port = free_port("127.0.0.1")
    config = load_configuration("emulator/default.yaml", {**QUICK, "fri.period_ms": 2})
    service = Service(config, ("127.0.0.1", port), once=True)
    thread = threading.Thread(target=service.run, args=(True,))
    thread.start()
    try:
        with Pc(port, gentle) as pc:
            pc.run(100)
        thread.join(20.0)
        assert not thread.is_alive()
        assert "has left" in caplog.text
        assert "the emulator ends" in caplog.text
    finally:
        service.stop()
        thread.join()
        service.close()


@pytest.mark.slow
def test_the_command_shows_events_and_ends_with_its_client() -> None:
    port = free_port("127.0.0.1")
    command = [
        sys.executable,
        "-m",
        "runner.cli",
        "-v",
        "emulator",
        "--lock-step",
        "--once",
        "--program",
        "auto_start",
    ]
    command += ["--fri-port", str(port), "--period-ms", "5", "--set", "controller.settle_s=0.2"]
    with Pc(port) as pc:
        child = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        pc.run(300, silence_s=60.0)
    output, errors = child.communicate(timeout=60)
    assert child.returncode == 0
    assert f"sends to 127.0.0.1:{port}" in output
    assert "CMD: command mode" in errors
    assert "has left" in errors


@pytest.mark.slow
def test_a_wrong_program_is_one_message_of_the_command() -> None:
    command = [
        sys.executable,
        "-m",
        "runner.cli",
        "emulator",
        "--program",
        "nothing",
        "--fri-port",
        str(free_port("127.0.0.1")),
    ]
    found = subprocess.run(command, capture_output=True, text=True)
    assert found.returncode == 2
    assert "KRL program 'nothing' is unknown; known: auto_start" in found.stderr
    assert "Traceback" not in found.stderr
