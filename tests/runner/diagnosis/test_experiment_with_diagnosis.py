"""An experiment on an emulator with something hidden in it: what it ends with."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from click.testing import CliRunner

from fri.errors import DataError
from ident.model.model_file import read_model
from lwr_driver.arm import Arm
from lwr_driver.arm.cell import Cell
from runner.cli import main
from runner.commands.commission import record_sets
from runner.diagnosis import Study, after_run
from runner.diagnosis.after_run import conclude_run
from runner.diagnosis.records import QUANTITIES, ReplayErrors, Residuals
from runner.experiment_file import Experiment
from runner.planning import Excitations
from runner.report.diagnosis import DiagnosisFolder, diagnosis_paper_figures
from runner.report.diagnosis_figures import AGAINST
from runner.report.folder import ResultFolder
from runner.report.page import report_html

pytestmark = pytest.mark.slow

SHORT: dict[str, Any] = {
    "name": "short",
    "emulator_settings": {"fri.period_ms": 10},
    "excitation": {"period_s": 6.0, "harmonics": 3, "periods": 2, "seed": 3},
    "moves": {"home": [0.0, 0.5, 0.0, -1.3, 0.0, 0.8, 0.0], "speed_scale": 0.5, "settle_s": 0.5},
    "sessions": [{"name": "unloaded"}],
}
LOADED = {"name": "loaded", "payload": {"name": "paper_load", "mass": 3.34, "com": [0.0, -0.066, 0.144]}}
BRISTLES = {
    "type": "tests.runner.diagnosis.hidden_effects:Bristles",
    "options": {"joint": 2, "amplitude": 2.5, "length": 0.005},
}
WRONG_GAIN = {
    "type": "tests.runner.diagnosis.hidden_effects:WrongGain",
    "options": {"joint": 2, "sensor": 0.015},
}


@dataclass(frozen=True)
class Done:
    """Text and folder of a command."""

    text: str
    folder: Path


def lwr_run(*arguments: str) -> str:
    result = CliRunner().invoke(main, list(arguments), catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.stdout


def experiment_file(folder: Path, hidden: Sequence[dict[str, Any]], **changes: Any) -> Path:
    settings = {**SHORT["emulator_settings"], "robot.effects": list(hidden)}
    path = folder / "short.yaml"
    path.write_text(yaml.safe_dump({**SHORT, "emulator_settings": settings, **changes}), encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> Done:
    place = tmp_path_factory.mktemp("diagnosed")
    file = experiment_file(place, [BRISTLES])
    text = lwr_run("experiment", str(file), "--yes", "--out", str(place / "out"))
    return Done(text, place / "out")


def content(done: Done, name: str) -> Any:
    return json.loads((done.folder / "diagnosis" / name).read_text())


def test_the_experiment_ends_with_the_hidden_cause(done: Done) -> None:
    found = content(done, "diagnosis.json")
    assert not found["findings"]
    # Without a reference it is what every such drive has.
    finding = found["character"][0]
    assert (finding["cause"], finding["joints"]) == ("presliding_hysteresis", [2])
    report = (done.folder / "report.txt").read_text()
    assert (done.folder / "diagnosis" / "diagnosis.txt").read_text() in report
    assert "Presliding hysteresis, joint A2 [presliding_hysteresis]" in report
    assert "no reference of the healthy arm" in report
    assert "No cause found beyond the character of such an arm" in done.text.splitlines()[0]
    assert done.text.strip().splitlines()[-1] == f"open {done.folder / 'report.html'}"


def test_diagnosis_json_keeps_the_contract(done: Done) -> None:
    found = content(done, "diagnosis.json")
    assert set(found) == {
        "schema_version",
        "sessions",
        "baseline",
        "findings",
        "character",
        "healthy",
        "nameless",
        "unexplained",
        "data",
        "extension",
        "gain",
        "model",
    }
    assert set(found["baseline"]) == {"model", "test_rms", "noise_floor", "simulation_error"}
    assert set(found["gain"]) == {
        "test_rms_base",
        "test_rms_extended",
        "rows_base",
        "rows_extended",
        "simulation_error_base",
        "simulation_error_extended",
        "simulation",
    }
    for error in (found["baseline"]["simulation_error"], found["gain"]["simulation_error_extended"]):
        assert {key: len(values) for key, values in error.items()} == {"motor": 7, "joint": 7, "position": 7}
        assert all(0.0 < value < 0.01 for value in error["position"])


def test_the_extended_model_simulates_the_hidden_arm_better(done: Done) -> None:
    gain = content(done, "diagnosis.json")["gain"]
    base, extended = gain["simulation_error_base"], gain["simulation_error_extended"]
    assert extended["motor"][1] < 0.95 * base["motor"][1]


def test_errors_of_the_replay_are_kept_over_time_and_drawn(done: Done) -> None:
    folder = done.folder / "diagnosis"
    replayed = ReplayErrors.load(folder / "replay.npz")
    assert replayed.session == "unloaded.mcap"
    assert replayed.duration_s == pytest.approx(11.5, abs=0.5)
    error = content(done, "diagnosis.json")["gain"]["simulation_error_extended"]
    for quantity in QUANTITIES:
        # One session was replayed, so what is drawn has the error that is told.
        rms = np.sqrt(np.nanmean(replayed.errors["extended", quantity] ** 2, axis=0))
        np.testing.assert_allclose(rms, error[quantity], rtol=1e-3)
    figures = {one.name: one for one in diagnosis_paper_figures(DiagnosisFolder.load(folder))}
    text = figures["replay-position"].alt
    assert text.count("Measured minus simulated position of") == 7
    assert "mrad rms, extended" in text
    broken = done.folder / "broken_replay.npz"
    broken.write_bytes(b"PK")
    with pytest.raises(DataError, match="run the diagnosis again"):
        ReplayErrors.load(broken)


def test_gains_have_intervals_beside_the_noise_floor(done: Done) -> None:
    rows = {(row["side"], row["joint"]): row for row in content(done, "details.json")["rows"]}
    assert len(rows) == 14
    row = rows["motor", 2]
    assert row["gain_interval_95"][0] > 0.0
    assert row["gain"] == pytest.approx(row["test_rms_base"] - row["test_rms_extended"])
    assert row["gain_interval_95"][0] < row["gain"] < row["gain_interval_95"][1]
    assert row["avoidable"] ** 2 == pytest.approx(row["test_rms_base"] ** 2 - row["noise_floor"] ** 2)
    low, high = rows["motor", 6]["gain_interval_95"]
    assert low < 0.01
    assert high - low < 0.02


def test_base_parameters_that_absorbed_it_are_told(done: Done) -> None:
    moved = {entry["name"]: entry for entry in content(done, "details.json")["base_parameters"]}
    assert set(moved) & {"Fcm2", "Fvm2", "Ia2"}
    assert all(abs(entry["change_in_std"]) > 2.0 for entry in moved.values())


def test_residuals_are_drawn_against_everything(done: Done) -> None:
    residuals = Residuals.load(done.folder / "diagnosis" / "residuals.npz")
    assert set(residuals.sides) == {"motor", "joint"}
    diagnosis = DiagnosisFolder.load(done.folder / "diagnosis")
    figures = {one.name: one for one in diagnosis_paper_figures(diagnosis)}
    for side in residuals.sides:
        for against in AGAINST:
            one = figures[f"residual-{side}-{against.replace(' ', '-')}"]
            assert any("extended model, mean" in label for _, label, _ in one.legend)
            assert one.alt.count("Held-out residual of the") >= 7
    broken = done.folder / "broken.npz"
    broken.write_bytes(b"PK")
    with pytest.raises(DataError, match="run the diagnosis again"):
        Residuals.load(broken)


def test_the_report_shows_finding_gain_replay_and_plots(done: Done) -> None:
    text = report_html(ResultFolder.load(done.folder))
    part = text[text.index("<section id='diagnosis'") :]
    part = part[: part.index("</section>")]
    for words in (
        "Presliding hysteresis, joint A2",
        "Replay in simulation",
        "had absorbed",
        "against run order",
    ):
        assert words in part, words


def test_validate_and_export_take_the_extended_model(done: Done) -> None:
    extended = str(done.folder / "diagnosis" / "model_extended.yaml")
    told = lwr_run("validate", extended, str(done.folder / "unloaded.mcap"), "--allow-seen")
    assert "presliding_hysteresis" in told
    told = lwr_run("export", extended, str(done.folder / "extended.py"))
    assert "Effects of the model missing in extended.py: presliding_hysteresis" in told
    model = read_model(extended)
    assert model.effects[0]["parameters"]["amplitude"]["std"] > 0.0
    assert model.std is not None
    assert np.all(model.std > 0.0)


def test_commission_learns_from_the_logs_and_tells_json(done: Done, tmp_path: Path) -> None:
    logs = [str(done.folder / "unloaded.mcap")]
    told = json.loads(lwr_run("commission", *logs, "--out", str(tmp_path / "c.yaml"), "--json"))
    assert told["sets"] == [logs]
    assert set(told["noise"]) == {"motor", "joint"}
    assert len(told["compliance"]) == 7
    assert told["file"] == str(tmp_path / "c.yaml")
    assert read_model(tmp_path / "c.yaml").provenance["commissioning"]["sets"] == 1


def test_a_failure_of_the_diagnosis_leaves_the_experiment_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    experiment = Experiment.load(experiment_file(tmp_path, []))
    arm, cell = Arm.load(), Cell.load(experiment.cell)

    def fail(*arguments: Any, **named: Any) -> None:
        raise np.linalg.LinAlgError("singular matrix")

    monkeypatch.setattr(after_run, "_diagnosed", fail)
    motions: Any = None
    ended = conclude_run(experiment, arm, cell, motions, tmp_path, [], laboratory=fail)
    assert ended.study is None
    said = ["No diagnosis: LinAlgError: singular matrix. The results of the experiment stand."]
    assert ended.pieces(tmp_path) == ended.advice(tmp_path) == said
    assert ended.to_dict()["diagnosis"] is None


@pytest.mark.long
def test_decide_runs_the_motions_and_names_the_hidden_cause(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    diagnosed = after_run.study
    asked: list[Study] = []

    def doubtful(*arguments: Any, **named: Any) -> Study:
        """The diagnosis, the first time in doubt between two causes, the wrong one ahead."""
        found = diagnosed(*arguments, **named)
        asked.append(found)
        if len(asked) > 1:
            return found
        mine = found.diagnosis.findings[0]
        other = ((mine.cause, mine.joints, -30.0),)
        doubted = dataclasses.replace(mine, cause="sensor_crosstalk", confidence=0.6, alternatives=other)
        return dataclasses.replace(found, diagnosis=dataclasses.replace(found.diagnosis, findings=(doubted,)))

    monkeypatch.setattr(after_run, "study", doubtful)
    out = tmp_path / "out"
    settings = {"fri.period_ms": 10, "robot.effects": [WRONG_GAIN]}
    changes = {"sessions": [*SHORT["sessions"], LOADED], "emulator_settings": settings}
    file = experiment_file(tmp_path, [], **changes)
    text = lwr_run("experiment", str(file), "--yes", "--decide", "--out", str(out))
    (answer,) = json.loads((out / "diagnosis" / "decision.json").read_text())["answers"]
    assert answer["outcome"] == "decided"
    assert answer["named"] == {"cause": "sensor_gain", "joints": [2]}
    assert "Decided: sensor gain (joint A2)" in text
    before = json.loads((out / "diagnosis" / "before_deciding.json").read_text())["findings"][0]
    assert (before["cause"], before["confidence"]) == ("sensor_crosstalk", 0.6)
    after = json.loads((out / "diagnosis" / "diagnosis.json").read_text())
    assert {"static_poses-paper_load.mcap", "static_poses-bare.mcap"} < set(after["sessions"]["train"])
    assert after["findings"][0]["confidence"] >= 0.8


@pytest.mark.long
def test_with_a_healthy_arm_its_character_becomes_a_finding(tmp_path: Path) -> None:
    parameters = {"amplitude": 1.6, "velocity": 0.08, "exponent": 1.0}
    options = {"cause": "stribeck", "joint": 4, "parameters": parameters}
    hidden = {"type": "sim_backend.model_arm:Cause", "options": options}
    sets = record_sets(Experiment.load(experiment_file(tmp_path, [])), tmp_path / "sets", 3, assume_yes=True)
    healthy = tmp_path / "healthy.yaml"
    lwr_run(
        "commission", *(str(path) for part in sets for path in part), "--sets", "3", "--out", str(healthy)
    )

    def told(name: str, diagnosis: dict[str, Any]) -> dict[str, list[tuple[str, list[int]]]]:
        out = tmp_path / name
        file = experiment_file(tmp_path, [hidden], diagnosis=diagnosis)
        lwr_run("experiment", str(file), "--yes", "--decide", "--out", str(out))
        found = json.loads((out / "diagnosis" / "diagnosis.json").read_text())
        assert not (out / "diagnosis" / "decision.json").exists()
        return {
            kind: [(one["cause"], one["joints"]) for one in found[kind]] for kind in ("findings", "character")
        }

    assert told("alone", {}) == {"findings": [], "character": [("stribeck", [4])]}
    assert told("compared", {"reference": str(healthy)}) == {"findings": [("stribeck", [4])], "character": []}


@pytest.mark.long
def test_commission_records_sets_with_their_own_noise_and_goes_on_where_it_was(tmp_path: Path) -> None:
    experiment = Experiment.load(experiment_file(tmp_path, [], sessions=[*SHORT["sessions"], LOADED]))
    logs = record_sets(experiment, tmp_path / "sets", 2, assume_yes=True)
    assert [[path.name for path in part] for part in logs] == [["unloaded.mcap", "loaded.mcap"]] * 2
    assert logs[0][0].read_bytes() != logs[1][0].read_bytes()
    written = [path.stat().st_mtime_ns for part in logs for path in part]
    again = record_sets(experiment, tmp_path / "sets", 2, assume_yes=True)
    assert [path.stat().st_mtime_ns for part in again for path in part] == written
    assert Excitations.of(experiment, Arm.load(), Cell.load(experiment.cell)).unseen is None
