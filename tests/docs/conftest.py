"""A folder with everything that the documents speak of: an experiment file, logs, models, a broken log."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from click.testing import CliRunner

import runner.experiment
from lwr_driver.session.trace import TraceImport, import_trace
from runner.cli import main
from runner.report.figure import Figure, MatrixFigure
from runner.report.figures import every_figure
from runner.report.folder import ResultFolder

LOAD = {"name": "paper_load", "mass": 3.34, "com": [0.0, -0.066, 0.144]}
SHORT: dict[str, Any] = {
    "name": "my_lab",
    "emulator_settings": {"fri.period_ms": 10},
    "excitation": {"period_s": 6.0, "harmonics": 3, "periods": 1, "seed": 3},
    "moves": {"home": [0.0, 0.5, 0.0, -1.3, 0.0, 0.8, 0.0], "speed_scale": 0.5, "settle_s": 0.5},
    "diagnosis": {"run": False},
    "sessions": [
        {"name": "unloaded"},
        {"name": "loaded", "payload": LOAD},
        {"name": "unseen", "payload": LOAD, "validation": True},
    ],
}


def keep_and_import(session: Path, trace: Path) -> TraceImport:
    shutil.copy(session, session.with_suffix(".plain.mcap"))
    return import_trace(session, trace)


def lwr_run(*arguments: str) -> None:
    result = CliRunner().invoke(main, list(arguments), catch_exceptions=False)
    assert result.exit_code == 0, result.output


@pytest.fixture(scope="session")
def laboratory(made_once: Callable[[str, Callable[[Path], None]], Path]) -> Path:
    """Made once; tests work in copies of it (`workplace`)."""
    return made_once("laboratory", fill)


def fill(folder: Path) -> None:
    (folder / "my_lab.yaml").write_text(yaml.safe_dump(SHORT))
    lwr_run("experiment", str(folder / "my_lab.yaml"), "--yes", "--out", str(folder / "results"))
    trace = {"name": "other", "motor_torque": {"source": "trace_file"}, "sessions": SHORT["sessions"][1:2]}
    other = folder / "other"
    seed = {"excitation": {**SHORT["excitation"], "seed": 4}}
    (folder / "other.yaml").write_text(yaml.safe_dump({**SHORT, **trace, **seed}))
    with pytest.MonkeyPatch.context() as patch:
        # The log as it is before its trace is added.
        patch.setattr(runner.experiment, "import_trace", keep_and_import)
        lwr_run("experiment", str(folder / "other.yaml"), "--yes", "--out", str(other))
    for name in ("unloaded.mcap", "loaded.mcap", "model.yaml"):
        shutil.copy(folder / "results" / name, folder / name)
    shutil.copy(other / "loaded.mcap", folder / "another.mcap")
    shutil.copy(other / "model.yaml", folder / "another_model.yaml")
    content = (folder / "loaded.mcap").read_bytes()
    (folder / "broken.mcap").write_bytes(content[: len(content) * 2 // 3])


@pytest.fixture
def workplace(laboratory: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[], Path]:
    """Makes a copy of the laboratory and goes there."""

    def go() -> Path:
        place = tmp_path / "work"
        shutil.copytree(laboratory, place)
        monkeypatch.chdir(place)
        return place

    return go


@pytest.fixture
def few_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """For a paper only one figure of each kind: tests/runner/report draws them all."""

    def few(results: ResultFolder, **options: str) -> list[Figure | MatrixFigure]:
        kinds: dict[str, Figure | MatrixFigure] = {}
        for one in every_figure(results, **options):
            kind = re.match(r"residual-\w+|torque-logged|\w+", one.name)
            assert kind is not None
            kinds.setdefault(kind[0], one)
        return list(kinds.values())

    monkeypatch.setattr("runner.report.paper_folder.every_figure", few)
