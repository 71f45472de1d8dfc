"""The live view: what it reads from the ring, and its page."""

from __future__ import annotations

import json
import os
import re
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Browser

from fri.errors import ConfigurationError
from fri.states import Quality, State
from lwr_driver.motion import Motion
from lwr_driver.ring import Ring
from runner.experiment_file import Experiment, Payload
from runner.live import LiveView, Sample, phase_at
from tests.runner.report.view_rig import CLIPPED, NARROW, WIDE, flaws, opened

ROOT = Path(__file__).parents[3]


@pytest.fixture
def ring() -> Iterator[Ring]:
    with Ring.create(16) as made:
        yield made


def publish(ring: Ring, sequence: int, *, error: float = 0.0, row: int = -1) -> None:
    """One cycle in command mode whose measured positions are `error` beside the commanded ones [rad]."""
    cycle = ring.row
    cycle["sequence"], cycle["plan_index"], cycle["answered"] = sequence, row, 1
    msr = cycle["msr"]
    msr["state"], msr["quality"], msr["msr_sample_time"] = State.CMD, Quality.PERFECT, 0.005
    msr["msr_jnt_pos"], cycle["cmd"]["jnt_pos"] = 0.25 + error, 0.25
    msr["msr_jnt_trq"], msr["miss_counter"] = 3.0, 2
    assert ring.publish()


def test_onlookers_take_nothing_out_of_the_ring(ring: Ring) -> None:
    for sequence in range(5):
        publish(ring, sequence)
    assert ring.peek(3)["sequence"].tolist() == [2, 3, 4]
    assert ring.peek(100)["sequence"].tolist() == [0, 1, 2, 3, 4]
    assert ring.take()["sequence"].tolist() == [0, 1, 2, 3, 4]


def test_onlookers_see_the_newest_rows_after_the_ring_went_round(ring: Ring) -> None:
    for sequence in range(40):
        publish(ring, sequence)
        ring.release(1)
    assert ring.peek(4)["sequence"].tolist() == [36, 37, 38, 39]


def test_a_peek_is_a_copy(ring: Ring) -> None:
    publish(ring, 1)
    rows = ring.peek(1)
    for sequence in range(2, 20):
        publish(ring, sequence)
        ring.release(1)
    assert rows["sequence"].tolist() == [1]


def test_a_spike_between_two_looks_is_shown(ring: Ring) -> None:
    for sequence, error in enumerate((0.001, -0.02, 0.003)):
        publish(ring, sequence, error=error, row=sequence)
    sample = Sample(ring.peek(3))
    np.testing.assert_allclose(sample.error, -0.02, atol=1e-6)
    assert (sample.state, sample.quality, sample.row, sample.missed) == ("CMD", "PERFECT", 2, 2)
    assert sample.time_s == pytest.approx(0.01)


def test_lost_packets_are_counted(ring: Ring) -> None:
    for sequence in (3, 4, 7, 8):
        publish(ring, sequence)
    assert Sample(ring.peek(4)).lost == 2


def test_before_command_mode_the_controllers_set_point_is_shown(ring: Ring) -> None:
    publish(ring, 1)
    rows = ring.peek(1)
    rows["answered"], rows["cmd"]["jnt_pos"] = 0, 9.0
    rows["msr"]["cmd_jnt_pos"], rows["msr"]["cmd_jnt_pos_fri_offset"] = 0.5, 0.125
    np.testing.assert_allclose(Sample(rows).commanded, 0.625)


@pytest.mark.parametrize(("row", "phase"), [(0, "move to start"), (9, "move to start"), (10, "period 1")])
def test_the_phase_is_the_last_one_that_began(row: int, phase: str) -> None:
    assert phase_at([[0, "move_to_start"], [10, "period 1"]], row) == phase


@pytest.mark.slow
def test_the_page_shows_arm_progress_and_link(ring: Ring, chrome: Browser) -> None:
    motion = Motion(np.zeros((101, 7)), 0.005, ((0, "move_to_start"), (20, "period 1")))
    with LiveView(Experiment.load(), ring.name, port=0) as view:
        view.begin("loaded", Payload("weight", 2.0, (0.0, 0.0, 0.1)), motion)
        # A low window: without a graphics card each pixel of the scene costs time.
        with opened(chrome, view.url, (WIDE[0], 500)) as seen:
            deadline = time.monotonic() + 120.0
            title = seen.page.get_by_role("heading", name="loaded: period 1")
            sequence = 0
            while not title.count() and time.monotonic() < deadline:
                publish(ring, sequence, error=0.002, row=40)
                ring.release(1)
                sequence += 1
                seen.page.wait_for_timeout(20)
            for width in (WIDE[0], NARROW[0]):
                seen.page.set_viewport_size({"width": width, "height": 500})
                seen.page.wait_for_timeout(300)
                text = seen.page.inner_text("body")
                assert flaws(seen) == []
                assert seen.page.evaluate(CLIPPED) == []
                assert seen.page.get_by_role("progressbar", name="progress").count() == 1
                assert seen.page.get_by_role("img", name="tracking error").count() == 1
                assert "0.2 of 0.5 s, 0.3 s left" in text
                assert "CMD, quality PERFECT" in text
                assert "2 missed, 0 lost" in text
                assert "+2.0" in text
    assert view._process.returncode is not None


EXPERIMENT = """
name: watched
emulator_settings: {fri.period_ms: 2}
excitation: {period_s: 20.0, harmonics: 3, periods: 2, seed: 3}
diagnosis: {run: false}
sessions:
  - name: loaded
    payload: {name: paper_load, mass: 3.34, com: [0.0, -0.066, 0.144]}
"""


@pytest.mark.long
def test_an_experiment_in_lock_step_is_watched_while_it_runs(tmp_path: Path, chrome: Browser) -> None:
    (tmp_path / "watched.yaml").write_text(EXPERIMENT)
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = [sys.executable, "-m", "runner.cli", "experiment", str(tmp_path / "watched.yaml"), "--yes"]
    command += ["--live", "--live-port", str(port), "--out", str(tmp_path / "out")]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        said = next(line for line in process.stderr if "live view" in line)
        assert said.strip() == f"live view: http://127.0.0.1:{port}"
        with opened(chrome, f"http://127.0.0.1:{port}", (700, 420)) as seen:
            title = seen.page.get_by_role("heading", name=re.compile("loaded: period"))
            title.wait_for(timeout=120_000)
            seen.page.get_by_text(" s left").wait_for(timeout=120_000)
            text = seen.page.inner_text("body")
            assert seen.errors == []
            assert seen.external == []
        process.stderr.read()
        assert process.wait(600) == 0
    assert "quality PERFECT" in text
    assert "0 missed, 0 lost" in text


def test_the_process_ends_with_the_one_that_started_it(ring: Ring) -> None:
    code = (
        "import os, sys\nfrom runner.experiment_file import Experiment\nfrom runner.live import LiveView\n"
        "view = LiveView(Experiment.load(), sys.argv[1], port=0)\n"
        "print(view._process.pid, flush=True)\nos._exit(0)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, ring.name], capture_output=True, text=True, check=True, cwd=ROOT
    )
    pid = int(done.stdout)
    deadline = time.monotonic() + 60.0
    while alive(pid) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not alive(pid)


def alive(pid: int) -> bool:
    try:
        return "State:\tZ" not in Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return False


def test_without_the_extra_nothing_is_started(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ConfigurationError, match=r"lwr-identification\[view\]"):
        LiveView(Experiment.load(), "none")


def test_driver_and_commands_are_there_without_the_extra() -> None:
    code = (
        "import sys, json\nsys.modules['plotly'] = sys.modules['viser'] = None\n"
        "import lwr_driver.driver, runner.experiment, runner.commands.experiment, runner.commands.logs\n"
        "import runner.report.figures, runner.commands.motions, runner.preview\n"
        "print(json.dumps('fine'))"
    )
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, env=environment
    )
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == "fine"


def test_a_port_in_use_is_told(ring: Ring) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        with pytest.raises(
            ConfigurationError, match=f"--live: port {port} of 127.0.0.1 is in use.*--live-port"
        ):
            LiveView(Experiment.load(), ring.name, port=port)
