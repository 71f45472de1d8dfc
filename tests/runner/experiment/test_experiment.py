"""The whole chain, from the command line to the estimate, on the emulator in lock step."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from ident.model.model_file import read_model
from lwr_driver.session import read_session
from tests.runner.experiment.experiment_rig import Finished, experiment_file, messages, records, run

LOAD = {"name": "paper_load", "mass": 3.34, "com": [0.0, -0.066, 0.144]}


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Finished:
    folder = tmp_path_factory.mktemp("experiment")
    done = run("experiment", str(experiment_file(folder)), "--yes", "--out", str(folder / "first"))
    assert done.code == 0, done.text
    return done


def test_the_folder_holds_everything(finished: Finished) -> None:
    names = {path.name for path in finished.folder.iterdir()}
    assert names >= {
        "experiment.yaml",
        "plan.yaml",
        "unloaded.mcap",
        "loaded.mcap",
        "model.yaml",
        "report.txt",
        "summary.json",
    }
    assert re.search(r"^parameter +estimate", (finished.folder / "report.txt").read_text(), re.MULTILINE)
    assert not re.search(r"^parameter +estimate", finished.text, re.MULTILINE)
    assert finished.text.rstrip().endswith(f"open {finished.folder / 'report.html'}")


def test_summary_has_counts_parameters_truth_link_and_versions(finished: Finished) -> None:
    summary = json.loads((finished.folder / "summary.json").read_text())
    assert summary["exit_status"] == "success"
    assert summary["counts"] == {"standard": 136, "not_identifiable": 18, "regrouped": 16, "base": 102}
    assert len(summary["parameters"]) == 102
    for entry in summary["parameters"]:
        assert set(entry) == {"name", "unit", "estimate", "std", "rsd_percent", "interval_95", "truth"}
        assert np.isfinite([entry["estimate"], entry["std"], entry["truth"]]).all()
    truth = {entry["name"]: entry["truth"] for entry in summary["parameters"]}
    # Table 2 of the paper
    assert truth["XX2R"] == pytest.approx(1.36, abs=1e-6)
    assert truth["MY4R"] == pytest.approx(-1.37, abs=1e-6)
    assert truth["M8"] == pytest.approx(3.34)
    assert set(summary["torque_rms"]) == {"motor", "joint"}
    assert summary["link"]["loaded"]["missed"] == 0
    assert {"numpy", "pin", "python", "git_commit"} <= set(summary["versions"])


def test_even_a_short_motion_finds_mass_and_heavy_moments(finished: Finished) -> None:
    parameters = json.loads((finished.folder / "summary.json").read_text())["parameters"]
    by_name = {entry["name"]: entry for entry in parameters}
    for name, tolerance in (("M8", 0.02), ("MY2R", 0.05), ("MY4R", 0.05), ("Fcm1", 0.05), ("Fcm4", 0.05)):
        entry = by_name[name]
        error = abs(entry["estimate"] - entry["truth"])
        assert error <= tolerance * abs(entry["truth"]), entry
        assert error <= 3.5 * entry["std"], entry


def test_model_file_gives_the_estimate_back(finished: Finished) -> None:
    model = read_model(finished.folder / "model.yaml")
    parameters = json.loads((finished.folder / "summary.json").read_text())["parameters"]
    assert model.value("M8") == pytest.approx(next(p["estimate"] for p in parameters if p["name"] == "M8"))


def test_log_keeps_the_contract(finished: Finished) -> None:
    session = read_session(finished.folder / "loaded.mcap")
    assert session.metadata["payload"] == "paper_load"
    assert float(session.metadata["payload_mass"]) == 3.34
    assert session.metadata["motor_torque_source"] == "krl_reals"
    assert session.end is not None
    assert session.end["exit_status"] == "success"
    assert not session.missing
    names = [phase.name for phase in session.phases]
    order = ["move_to_start", "settle", "period 1", "brake", "return"]
    assert [name for name in names if name in order] == order
    assert set(session.attachments) == {
        "experiment.yaml",
        "arm.yaml",
        "cell.yaml",
        "files.json",
        "robot.urdf",
        "plan.npz",
        "preflight.json",
    }
    assert session.motor is not None
    spans = session.spans("period")
    assert len(spans) == 1
    assert (spans[0][1] - spans[0][0]) * 1e-9 == pytest.approx(6.0, abs=0.011)


@pytest.mark.slow
def test_a_finished_experiment_is_estimated_again_and_reported_as_json(finished: Finished) -> None:
    again = run("experiment", "--resume", str(finished.folder), "--yes", "--json")
    assert again.code == 0, again.text
    content = json.loads(again.text[again.text.index("{") :])
    assert content["exit_status"] == "success"
    assert content["folder"] == str(finished.folder)
    assert len(content["parameters"]) == 102


@pytest.mark.slow
def test_repeating_the_experiment_gives_identical_logs(finished: Finished, tmp_path: Path) -> None:
    again = run("experiment", str(experiment_file(tmp_path)), "--yes", "--out", str(tmp_path / "second"))
    assert again.code == 0, again.text
    for name in ("unloaded.mcap", "loaded.mcap"):
        first, second = finished.folder / name, again.folder / name
        assert messages(first) == messages(second)
        (metadata, attached), (others, also) = records(first), records(second)
        # The manifest of the files holds their places.
        assert attached.pop("files.json") != also.pop("files.json")
        assert (metadata, attached) == (others, also)


def test_a_payload_that_is_not_there_is_noticed_before_anything_moves(tmp_path: Path) -> None:
    sessions = [
        {"name": "unloaded"},
        {"name": "loaded", "payload": {"name": "paper_load", "mass": 1.0, "com": [0.0, -0.066, 0.144]}},
    ]
    file = experiment_file(tmp_path, sessions=sessions)
    done = run("experiment", str(file), "--yes", "--out", str(tmp_path / "out"))
    assert done.code == 3
    assert "payload 'paper_load' announced" in done.text
    assert "corresponds to 3." in done.text
    assert not (tmp_path / "out" / "loaded.mcap").exists()
    assert (tmp_path / "out" / "unloaded.mcap").exists()


@pytest.mark.slow
def test_an_aborted_experiment_goes_on_at_the_unfinished_motion(tmp_path: Path) -> None:
    stop = [{"command": "emergency_stop", "when": "moving", "occurrence": 5, "after_cycles": 200}]
    settings = {"fri.period_ms": 5, "schedule": stop}
    file = experiment_file(tmp_path, emulator_settings=settings, identification={"model": 1})
    broken = run("experiment", str(file), "--yes", "--out", str(tmp_path / "out"))
    assert broken.code == 5, broken.text
    assert "drives" in broken.text
    assert "--resume" in broken.text
    folder = tmp_path / "out"
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["exit_status"] == "fail"
    before = (folder / "unloaded.mcap").read_bytes()
    resumed = run("experiment", "--resume", str(folder), "--yes")
    assert resumed.code == 0, resumed.text
    assert (folder / "unloaded.mcap").read_bytes() == before
    assert (folder / "loaded.attempt-1.mcap").exists()
    loaded = read_session(folder / "loaded.mcap")
    aborted = read_session(folder / "loaded.attempt-1.mcap")
    assert aborted.end is not None
    assert aborted.end["exit_status"] == "fail"
    assert loaded.metadata["uid"] != aborted.metadata["uid"]
    assert loaded.metadata["parent_uid"] == aborted.metadata["uid"]
    whole = json.loads((folder / "summary.json").read_text())
    assert whole["exit_status"] == "success"
    assert whole["link"]["unloaded"] == summary["link"]["unloaded"]
    assert whole["link"]["loaded"]["cycles"] > summary["link"]["loaded"]["cycles"]


@pytest.mark.parametrize(
    ("sessions", "message"),
    [
        ([{"name": "check", "validation": True}], "every session is for validation"),
        (
            [{"name": "unloaded"}, {"name": "check", "validation": True, "payload": LOAD}],
            "'paper_load', not identified by another session",
        ),
    ],
)
def test_a_validation_needs_an_estimate(tmp_path: Path, sessions: list[object], message: str) -> None:
    file = experiment_file(tmp_path, sessions=sessions)
    done = run("check", str(file))
    assert done.code == 2
    assert message in done.text


@pytest.mark.slow
def test_motor_torques_from_the_controllers_trace(tmp_path: Path) -> None:
    sessions = [{"name": "loaded", "payload": LOAD}]
    file = experiment_file(tmp_path, motor_torque={"source": "trace_file"}, sessions=sessions)
    done = run("experiment", str(file), "--yes", "--out", str(tmp_path / "out"))
    assert done.code == 0, done.text
    session = read_session(tmp_path / "out" / "loaded.mcap")
    assert session.metadata["motor_torque_source"] == "trace_file"
    assert float(session.metadata["trace_delay_std_s"]) < 0.5e-3
    assert session.motor is not None
    assert len(session.motor) > 1000


def test_without_motor_torques_the_session_is_valid_and_model_2_says_so(tmp_path: Path) -> None:
    file = experiment_file(
        tmp_path,
        motor_torque={"source": "none"},
        identification={"model": 1},
        sessions=[{"name": "unloaded"}],
    )
    done = run("experiment", str(file), "--yes", "--out", str(tmp_path / "out"))
    assert done.code == 0, done.text
    refused = run("identify", str(tmp_path / "out" / "unloaded.mcap"), "--model", "2")
    assert refused.code == 7
    assert "/motor_states" in refused.text
    assert "--model 1" in refused.text
