"""The page of two models side by side."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from playwright.sync_api import Browser

from ident.model.dynamic_model import DynamicModel
from ident.model.model_file import write_model
from runner.cli import main
from runner.report.comparison import ComparedModel, short_names
from tests.ident.known_arm import estimated, truth_model  # noqa: F401  fixtures
from tests.runner.report.view_rig import NARROW, WIDE, flaws, opened


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
    (tmp_path / "friday" / "summary.json").write_text(
        json.dumps({"exit_status": "ok", "validation": [error]})
    )
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


@pytest.mark.parametrize(
    ("first", "second", "names"),
    [
        ("runs/monday/model.yaml", "runs/friday/model.yaml", ("monday/model.yaml", "friday/model.yaml")),
        ("lab/model.yaml", "lab/friday", ("lab/model.yaml", "friday")),
        ("runs/monday", "runs/friday", ("monday", "friday")),
        ("old/arm.yaml", "new/arm.yaml", ("old/arm.yaml", "new/arm.yaml")),
        ("a/day/run", "b/day/run", ("a/day/run", "b/day/run")),
        ("run/model.yaml", "run/diagnosis/model_extended.yaml", ("run/model.yaml", "model_extended.yaml")),
        ("here/../arm.yaml", "arm.yaml", ("arm.yaml", "arm.yaml again")),
        ("/model.yaml", "/arm.yaml", ("model.yaml", "arm.yaml")),
    ],
)
def test_the_ends_of_two_paths_tell_them_apart(first: str, second: str, names: tuple[str, str]) -> None:
    assert short_names(Path(first), Path(second)) == names


def test_two_arms_have_their_own_names(estimated: Callable[..., DynamicModel]) -> None:  # noqa: F811
    models = (replace(estimated(1), robot="LWR4+ 812"), replace(estimated(1), robot="LWR4+ 817"))
    pair = ComparedModel.both((Path("a.yaml"), Path("b.yaml")), models)
    assert [one.name for one in pair] == ["LWR4+ 812", "LWR4+ 817"]


@pytest.mark.slow
def test_models_of_one_name_in_long_paths_are_told_apart_and_nothing_is_cut_off(
    estimated: Callable[..., DynamicModel],  # noqa: F811
    tmp_path: Path,
    chrome: Browser,
) -> None:
    deep = tmp_path / "/".join(["a_folder_with_quite_a_long_name_in_a_laboratory"] * 3)
    places = [deep / day / "models" / "lwr4plus_after_the_recalibration.yaml" for day in ("monday", "friday")]
    for seed, place in enumerate(places):
        place.parent.mkdir(parents=True)
        write_model(estimated(seed), place)
    page = tmp_path / "page.html"
    done = CliRunner().invoke(main, ["compare", *map(str, places), "--report", str(page)])
    assert done.exit_code == 0, done.output
    for size in (WIDE, NARROW):
        with opened(chrome, page, size) as seen:
            seen.wait_drawn()
            ends = [place.relative_to(deep).as_posix() for place in places]
            assert seen.page.inner_text("h1") == " and ".join(ends)
            assert seen.page.locator("#differences thead th").all_text_contents()[1:4:2] == ends
            text = seen.page.text_content("body") or ""
            assert [text.count(f"{deep}/{end}") for end in ends] == [1, 1]
            assert flaws(seen) == []
            boxes = "[...document.querySelectorAll('.scroll')].map((b) => b.scrollWidth - b.clientWidth)"
            assert max(seen.page.evaluate(boxes)) <= 1
