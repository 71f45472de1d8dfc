"""What a session's own data tell about the payload and about the motor torques."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from tests.runner.experiment.experiment_rig import experiment_file, run


def test_payload_that_is_lost_in_motion_fails_the_session(tmp_path: Path) -> None:
    lost = [{"command": "unmount", "when": "moving", "occurrence": 1, "after_cycles": 100}]
    payload = {"name": "paper_load", "mass": 3.34, "com": [0.0, -0.066, 0.144]}
    file = experiment_file(
        tmp_path,
        emulator_settings={"fri.period_ms": 5, "schedule": lost},
        sessions=[{"name": "loaded", "payload": payload}],
    )
    done = run("experiment", str(file), "--yes", "--out", str(tmp_path / "out"))
    assert done.code == 5, done.text
    assert re.search(r"contact: A\d external torque .* exceeds .* check its payload", done.text)
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["exit_status"] == "fail"


@pytest.mark.slow
def test_motor_torques_of_swapped_joints_and_wrong_scale_are_said(tmp_path: Path) -> None:
    krl = {"reals": [1, 4, 3, 2, 5, 6, 7], "scale": [1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0]}
    file = experiment_file(
        tmp_path,
        motor_torque={"source": "krl_reals", "krl": krl},
        sessions=[{"name": "unloaded"}],
    )
    done = run("experiment", str(file), "--yes", "--out", str(tmp_path / "out"))
    assert "motor torque of A2 follows the torque sensor of A3" in done.text
    assert "check `reals`, `scale` and `sign` of motor_torque.krl" in done.text
    # Nothing is estimated from them; the log stays.
    assert done.code != 0
    assert "A2, A3 motor torque: contradicts the other channels" in done.text
    assert "the two joints interchanged" in done.text
    assert list((tmp_path / "out").rglob("unloaded.mcap"))
