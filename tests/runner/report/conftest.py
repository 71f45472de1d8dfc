"""One short experiment for all tests of what people look at."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import CliRunner

from runner.cli import main

EXPERIMENT = """
name: short
emulator_settings: {fri.period_ms: 5}
excitation: {period_s: 6.0, harmonics: 3, periods: 2, seed: 3}
moves: {home: [0.0, 0.5, 0.0, -1.3, 0.0, 0.8, 0.0], speed_scale: 0.5, settle_s: 0.5}
diagnosis: {run: false}
sessions:
  - name: unloaded
  - name: loaded
    payload: &load {name: paper_load, mass: 3.34, com: [0.0, -0.066, 0.144]}
  - name: check
    validation: true
    payload: *load
"""


@pytest.fixture(scope="session")
def finished(made_once: Callable[[str, Callable[[Path], None]], Path]) -> Path:
    """Folder of a finished experiment; for reading."""

    def experiment(place: Path) -> None:
        (place / "short.yaml").write_text(EXPERIMENT)
        done = CliRunner().invoke(
            main, ["experiment", str(place / "short.yaml"), "--out", str(place / "run")]
        )
        assert done.exit_code == 0, done.output

    return made_once("finished", experiment) / "run"
