"""The first day of docs/lab.md, word for word: the emulator in one process, the lab's commands in others.

In real time, as in the lab. Changed are the PC's address and the port, and what only a person can do: questions are
answered on standard input, the pendant's part comes over its port.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import yaml

from benchmarks.trust.lab import descendants
from ident.model.model_file import read_model
from lwr_driver.realtime import assess
from lwr_driver.session import read_session
from runner.laboratory import free_port
from sim_backend.pendant import Pendant
from tests.docs.markdown import ROOT, blocks

LAB = Path("docs/lab.md")
LWR_RUN = [sys.executable, "-P", "-m", "runner.cli"]
COMMANDING = ("hold", "jog", "home", "experiment")
HEAD = "## The first day, in ten steps"


@dataclass
class Day:
    """The two terminals: a folder with the files of the document, and the emulator's pendant."""

    folder: Path
    pendant: Pendant
    steps: dict[int, list[str]]

    def do(self, line: str) -> str:
        """One command as it stands in the document; its output."""
        words = line.split()
        if words[1] in COMMANDING and not assess().ok:
            words.append("--allow-non-realtime")
        done = subprocess.run(
            [*LWR_RUN, *words[1:]],
            cwd=self.folder,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            input="y\n" * 9,
            capture_output=True,
            text=True,
            timeout=300,
        )
        assert done.returncode == 0, f"{line}\n{done.stdout}\n{done.stderr}"
        assert "Traceback" not in done.stderr
        return done.stdout


def section() -> str:
    return (ROOT / LAB).read_text(encoding="utf-8").split(HEAD)[1]


@pytest.fixture
def day(tmp_path: Path) -> Iterator[Day]:
    text = section()
    port = free_port("127.0.0.1")
    experiment = next(block.text for block in blocks(LAB, "yaml") if "backend: fri" in block.text)
    assert "link: {address: 192.168.0.100}" in experiment
    experiment = experiment.replace("address: 192.168.0.100", f"address: 127.0.0.1, port: {port}")
    (tmp_path / "my_lab.yaml").write_text(experiment)
    emulator, arm = re.findall(r"^```text\n(.*?)^```", text, re.MULTILINE | re.DOTALL)[:2]
    (tmp_path / "my_arm.yaml").write_text(arm)
    steps = {
        int(number): [line for line in block.splitlines() if line]
        for number, block in re.findall(
            r"^\*\*(\d+)\..*?^```bash slow\n(.*?)^```", text, re.MULTILINE | re.DOTALL
        )
    }
    command = [*LWR_RUN, *emulator.split()[1:], "--json", "--fri-port", str(port)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    with subprocess.Popen(
        command, cwd=tmp_path, env=environment, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        try:
            said = process.stdout.readline()
            while not said.rstrip().endswith("}"):
                line = process.stdout.readline()
                assert line, f"the emulator said {said!r} and ended"
                said += line
            in_real_time(process.pid)
            with Pendant(json.loads(said)["pendant_port"]) as pendant:
                yield Day(tmp_path, pendant, steps)
        finally:
            process.terminate()


def in_real_time(pid: int) -> None:
    """Give the emulated controller the priority that a real one has, where this is allowed."""
    for child in descendants(pid):
        with contextlib.suppress(PermissionError):
            os.sched_setscheduler(child, os.SCHED_FIFO, os.sched_param(60))


def test_there_are_ten_steps_each_with_something_to_see() -> None:
    text = section()
    assert re.findall(r"^\*\*(\d+)\.", text, re.MULTILINE) == [str(n) for n in range(1, 11)]
    assert len(re.findall(r"^\*See:\*", text, re.MULTILINE)) == 10


@pytest.mark.long
def test_the_first_day_goes_as_the_document_says(day: Day) -> None:
    folder, pendant = day.folder, day.pendant
    assert sorted(day.steps) == list(range(1, 11))

    for line in day.steps[1]:
        assert re.search(r"^Ready\.", day.do(line), re.MULTILINE)
    for line in day.steps[2]:
        said = day.do(line)
        assert re.search(r"^Ready\.", said, re.MULTILINE)
        assert "none: the empty flange" in said
        assert "round trip" in said

    said = "".join(day.do(line) for line in day.steps[3])
    assert "nothing commanded; log: listen.mcap" in said
    assert read_session(folder / "listen.mcap").joint.lost == 0

    guide = threading.Thread(target=by_hand, args=(pendant, folder / "guided.mcap"))
    guide.start()
    said = "".join(day.do(line) for line in day.steps[4])
    guide.join()
    poses = yaml.safe_load((folder / "poses.yaml").read_text())
    assert len(poses["poses"]) == 3
    assert "no home pose" not in said
    text = (folder / "my_lab.yaml").read_text()
    home = poses["moves"]["home"]
    (folder / "my_lab.yaml").write_text(re.sub(r"home: \[.*?\]", f"home: {home}", text))

    for line in day.steps[5]:
        assert re.search(r"^held the pose for 5 s in command mode, .*log: steps/hold-.*\.mcap$", day.do(line))
    for line in (*day.steps[6], *day.steps[7]):
        joint, degrees = line.split()[2:4]
        found = re.search(rf"^moved by {joint} ([-+][\d.]+)°.*log: steps/jog-.*\.mcap$", day.do(line))
        assert found is not None
        # Measured at the links, under the controller's imperfect gravity compensation.
        assert float(found[1]) == pytest.approx(float(degrees), abs=0.3)
    for line in day.steps[8]:
        assert "moved to home" in day.do(line)
    np.testing.assert_allclose(pendant.status()["setpoint"], home, atol=2e-3)

    assert "FAIL" not in "".join(day.do(line) for line in day.steps[9])
    assert (folder / "preview.html").is_file()
    for line in day.steps[10]:
        day.do(line)
    assert read_model(folder / "first" / "model.yaml").names
    assert (folder / "first" / "report.html").is_file()


def by_hand(pendant: Pendant, log: Path) -> None:
    """A person guides the arm to two more poses as soon as the log grows."""
    while not log.exists():
        time.sleep(0.1)
    time.sleep(3.0)
    for way in (0.15, -0.1):
        pendant.drives(on=False)
        pendant.displace([way, 0.0, 0.0, way, 0.0, 0.0, 0.0])
        time.sleep(4.0)
    pendant.drives(on=True)
