"""The page of two models side by side."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from click.testing import CliRunner

from ident.model.dynamic_model import DynamicModel
from ident.model.model_file import write_model
from runner.cli import main
from tests.ident.known_arm import estimated, truth_model  # noqa: F401  fixtures


def test_a_changed_parameter_is_named_on_the_page_and_no_other(
    estimated: Callable[..., DynamicModel],  # noqa: F811
    tmp_path: Path,
) -> None:
    before = estimated(1)
    place = before.names.index("Fcm2")
    values = estimated(2).values.copy()
    values[place] = 1.3 * before.values[place]
    for name, model in (("monday", before), ("friday", replace(before, values=values))):
        (tmp_path / name).mkdir()
        write_model(model, tmp_path / name / "model.yaml")
    error = {"session": "check.mcap", "torque_error": {"motor": 0.0512, "joint": None}}
    (tmp_path / "friday" / "summary.json").write_text(json.dumps({"validation": [error]}))
    page = tmp_path / "page.html"
    done = CliRunner().invoke(
        main, ["compare", str(tmp_path / "monday"), str(tmp_path / "friday"), "--report", str(page)]
    )
    assert done.exit_code == 0, done.output
    text = page.read_text()
    assert f"1 of {len(before.names)} parameters differ: Fcm2" in text
    assert text.count("<td>differs</td>") == 1
    assert "check.mcap" in text
    assert ">5.12</data>" in text
    assert len(text) < 4_000_000
    assert np.isfinite(values).all()
