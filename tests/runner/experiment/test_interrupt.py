"""Ctrl-C during a motion, as a person at the terminal gives it."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from lwr_driver.arm import Arm
from lwr_driver.session import Session, read_session
from runner.terminal import Interrupts
from tests.runner.experiment.experiment_rig import experiment_file


def interrupted(tmp_path: Path) -> tuple[int, str, Session]:
    """Exit code, text and log of an experiment that got SIGINT during its first period."""
    file = experiment_file(tmp_path, excitation={"period_s": 20.0, "harmonics": 3, "periods": 2, "seed": 3})
    out = tmp_path / "out"
    command = [sys.executable, "-m", "runner.cli", "experiment", str(file), "--yes", "--out", str(out)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True) as process:
        assert process.stderr is not None
        seen = []
        for line in process.stderr:
            seen.append(line)
            if line == "unloaded\n":
                process.send_signal(signal.SIGINT)
        process.wait()
    return process.returncode, "".join(seen), read_session(out / "unloaded.mcap")


def test_once_stops_within_the_limits_and_says_how_to_go_on(tmp_path: Path) -> None:
    code, text, session = interrupted(tmp_path)
    assert code == 4, text
    assert "--resume" in text
    assert session.end is not None
    assert session.end["exit_status"] == "abort"
    assert session.command is not None
    arm = Arm.load()
    q = session.command.position
    speed = np.diff(q, axis=0) / 0.005
    assert np.all(np.abs(speed) <= arm.v_max * 1.001)
    assert np.all(np.abs(np.diff(speed, axis=0)) / 0.005 <= arm.a_max * 1.01)
    # It ends at rest, well before the motion's own end.
    assert np.abs(np.diff(q[-3:], axis=0)).max() < 1e-5
    assert session.duration_s < 40.0


def test_first_and_second_interrupt_have_their_own_meaning() -> None:
    calls: list[str] = []
    before = signal.getsignal(signal.SIGINT)
    with Interrupts(lambda: calls.append("stop"), lambda: calls.append("drop")) as interrupts:
        signal.raise_signal(signal.SIGINT)
        assert calls == ["stop"]
        signal.raise_signal(signal.SIGTERM)
        assert calls == ["stop", "drop"]
        signal.raise_signal(signal.SIGINT)
        assert calls == ["stop", "drop"]
        assert interrupts.count == 3
    assert signal.getsignal(signal.SIGINT) is before


def test_nothing_is_left_running(tmp_path: Path) -> None:
    interrupted(tmp_path)
    listing = subprocess.run(["ps", "-eo", "args"], capture_output=True, text=True, check=True).stdout
    assert not [line for line in listing.splitlines() if str(tmp_path) in line]


@pytest.mark.parametrize("number", [signal.SIGTSTP, signal.SIGQUIT])
def test_ctrl_z_and_ctrl_backslash_stop_the_arm_and_suspend_or_kill_nobody(number: signal.Signals) -> None:
    calls: list[str] = []
    before = signal.getsignal(number)
    with Interrupts(lambda: calls.append("stop"), lambda: calls.append("drop")):
        assert callable(signal.getsignal(number))  # else the signal would suspend or end the tests
        signal.raise_signal(number)
    assert calls == ["stop"]
    assert signal.getsignal(number) is before
