"""`lwr-run init`: a folder that runs as it is."""

from __future__ import annotations

from pathlib import Path

import pytest
from click.testing import CliRunner

from runner.cli import main
from runner.experiment_file import Experiment
from runner.files import examine


def lwr_run(*arguments: str) -> tuple[int, str]:
    done = CliRunner().invoke(main, list(arguments))
    return done.exit_code, done.output


def test_a_laboratory_is_complete_and_its_files_are_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lab = tmp_path / "lab"
    code, text = lwr_run("init", str(lab))
    assert code == 0, text
    assert text.splitlines()[-1] == f"cd {lab} && lwr-run experiment"
    assert len((lab / "README.md").read_text().splitlines()) == 10
    assert (lab / "krl" / "lwr_identification.src").is_file()
    used = {file.path for file in examine(Experiment.load(lab / "experiment.yaml"))}
    assert {lab / "experiment.yaml", lab / "lwr4plus.yaml", lab / "cell.yaml"} <= used
    assert Experiment.load(lab).source == lab / "experiment.yaml"
    monkeypatch.chdir(lab)
    code, text = lwr_run("check", "-v")
    assert code == 0, text
    assert str(lab / "cell.yaml") in text


def test_the_experiment_of_a_laboratory_is_taken_in_its_folder_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    context = main.get_command(main.make_context("lwr-run", ["check"]), "check")
    assert context is not None
    assert Path(context.make_context("check", []).params["file"]).is_absolute()
    (tmp_path / "experiment.yaml").write_text("name: mine")
    assert context.make_context("check", []).params["file"] == "experiment.yaml"
    (tmp_path / "progress.json").write_text("{}")  # a folder of results
    assert Path(context.make_context("check", []).params["file"]).is_absolute()


def test_a_folder_in_use_is_left_alone_but_with_force(tmp_path: Path) -> None:
    (tmp_path / "cell.yaml").write_text("mine")
    code, text = lwr_run("init", str(tmp_path))
    assert code == 2
    assert "not empty" in text
    assert (tmp_path / "cell.yaml").read_text() == "mine"
    assert lwr_run("init", str(tmp_path), "--force")[0] == 0
    assert (tmp_path / "cell.yaml").read_text() != "mine"
