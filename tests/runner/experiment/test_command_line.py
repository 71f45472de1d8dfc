"""What a person sees at the terminal: help, exit codes, messages."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from runner.cli import VERBS
from tests.runner.experiment.experiment_rig import experiment_file, run


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_has_help_with_an_example(verb: str) -> None:
    done = run(verb, "--help")
    assert done.code == 0
    assert f"lwr-run {verb}" in done.text.split("Options:")[0].split("\n", 2)[2]


def test_help_lists_every_verb_and_the_exit_codes_without_importing_numpy() -> None:
    code = "import sys\nfrom runner.cli import main\n"
    code += "try: main(['--help'])\nfinally: print('numpy' in sys.modules)"
    text = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert all(verb in text for verb in VERBS)
    assert "3 refused" in text
    assert text.rstrip().endswith("False")


def test_a_misspelt_key_is_named_with_the_nearest_known_one(tmp_path: Path) -> None:
    done = run("check", str(experiment_file(tmp_path, excitaton={"period_s": 5.0})))
    assert done.code == 2
    assert "unknown key `excitaton`; did you mean `excitation`?" in done.text


def test_speed_scale_beside_a_plan_is_refused(tmp_path: Path) -> None:
    file = experiment_file(tmp_path, excitation={"plan": "plans/default.plan.yaml", "speed_scale": 0.2})
    done = run("check", str(file))
    assert done.code == 2
    for word in ("speed_scale 0.2", "plans/default.plan.yaml", "lwr-run plan"):
        assert word in done.text


def test_a_folder_that_is_not_empty_is_not_written_into(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "old.txt").write_text("old")
    done = run("experiment", str(experiment_file(tmp_path)), "--out", str(tmp_path / "out"))
    assert done.code == 2
    assert "not empty" in done.text
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["old.txt"]


def test_resume_needs_a_folder_that_was_begun(tmp_path: Path) -> None:
    done = run("experiment", "--resume", str(tmp_path))
    assert done.code == 2
    assert "experiment.yaml" in done.text


def test_check_prints_value_and_limit_of_every_item(tmp_path: Path) -> None:
    done = run("check", str(experiment_file(tmp_path)), "--json")
    assert done.code == 0
    for items in json.loads(done.text).values():
        subjects = {item["subject"] for item in items}
        assert {
            "position",
            "velocity",
            "acceleration",
            "jerk",
            "clearance",
            "clearance of a stop",
            "joint torque estimate",
            "torque of a stop",
        } <= subjects
        assert all(item["value"] and item["limit"] for item in items)


def test_check_refuses_a_motion_that_comes_too_near(tmp_path: Path) -> None:
    moves = {"home": [0.0, 0.5, 0.0, -1.3, 0.0, 0.8, 0.0], "max_start_distance_rad": 0.01}
    done = run("check", str(experiment_file(tmp_path, moves=moves)))
    assert done.code == 3
    assert re.search(r"^distance to the start +FAIL ", done.text, re.MULTILINE)
    assert "preflight refuses the motion" in done.text


def test_home_outside_the_limits_is_refused(tmp_path: Path) -> None:
    moves = {"home": [0.0, 2.5, 0.0, -1.3, 0.0, 0.8, 0.0]}
    done = run("check", str(experiment_file(tmp_path, moves=moves)))
    assert done.code == 2
    assert "A2 2.5" in done.text


def test_a_file_that_is_no_log_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "notes.mcap"
    path.write_text("not a log")
    done = run("info", str(path))
    assert done.code == 7
    assert "notes.mcap" in done.text
