"""An effect hidden in the emulated arm: drawn, put in, kept out of sight, and revealed beside the findings."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fri.errors import ConfigurationError, DataError
from ident.effects import EFFECTS
from ident.import_log import find_periods
from lwr_driver.arm import Arm
from lwr_driver.arm.cell import Cell
from lwr_driver.session import read_session
from runner.experiment import Record
from runner.experiment_file import Experiment
from runner.hiding.draw import RHO, draw_effect
from runner.hiding.effect import SEALED, HiddenEffect, with_effect
from runner.hiding.reveal import Outcome, reveal
from runner.planning import Excitations
from runner.report.folder import ResultFolder
from runner.report.hidden import hidden_section
from runner.report.page import report_html
from runner.results import summarise
from sim_backend.configuration import load_configuration
from sim_backend.model_arm import Cause
from tests.runner.experiment.experiment_rig import Finished, experiment_file, records, run

GAIN = HiddenEffect(7, "sensor_gain", (2,), None, {"error": 0.05}, 1.5)


@pytest.fixture(scope="module")
def planned() -> tuple[Experiment, Arm, Excitations]:
    """The default experiment with its stored motion."""
    experiment, arm = Experiment.load(), Arm.load()
    return experiment, arm, Excitations.of(experiment, arm, Cell.load(experiment.cell))


@pytest.fixture(scope="module")
def hidden(tmp_path_factory: pytest.TempPathFactory) -> Finished:
    """A short run with a hidden effect."""
    place = tmp_path_factory.mktemp("hidden")
    motion = {"period_s": 6.0, "harmonics": 3, "periods": 2, "seed": 3}
    file = experiment_file(
        place, excitation=motion, sessions=[{"name": "unloaded"}], identification={"model": 1}
    )
    return run("experiment", str(file), "--yes", "--hide", "3", "--out", str(place / "out"))


@pytest.mark.slow
def test_every_seed_draws_an_effect_that_the_emulator_takes(
    planned: tuple[Experiment, Arm, Excitations],
) -> None:
    drawn = [draw_effect(seed, *planned) for seed in range(6)]
    for effect in drawn:
        Cause(**effect.plugin["options"])
        assert RHO[0] <= effect.rho <= RHO[1] + 1e-9
        assert all(1 <= joint <= 7 for joint in effect.joints)
        assert EFFECTS[effect.cause].whole_arm == (not effect.joints)
    assert len({effect.cause for effect in drawn}) > 4
    assert draw_effect(5, *planned) == drawn[5]


def test_a_reference_lets_causes_be_hidden_that_the_base_parameters_absorb(
    planned: tuple[Experiment, Arm, Excitations],
) -> None:
    experiment, arm, motions = planned
    known = experiment.changed(diagnosis=type(experiment.diagnosis)(reference="commissioned.yaml"))
    assert draw_effect(1, known, arm, motions) != draw_effect(1, experiment, arm, motions)


def test_the_effect_joins_those_of_the_settings(tmp_path: Path) -> None:
    own = {"type": "sim_backend.model_arm:Cause", "options": GAIN.plugin["options"]}
    settings = {"fri.period_ms": 5, "robot.effects": [own]}
    experiment = Experiment.load(experiment_file(tmp_path, emulator_settings=settings))
    changed = with_effect(experiment, GAIN)
    config = load_configuration(changed.emulator_path, changed.emulator_settings)
    assert [effect.options["cause"] for effect in config.robot.effects] == ["sensor_gain", "sensor_gain"]
    assert changed.sealed
    assert changed.changed(sessions=experiment.sessions).sealed
    assert changed.text == experiment.text


def test_nothing_of_a_run_betrays_the_effect(hidden: Finished) -> None:
    assert hidden.code == 0, hidden.text
    effect = HiddenEffect.unseal(hidden.folder)
    assert effect is not None
    assert effect.seed == 3
    metadata, attached = records(hidden.folder / "unloaded.mcap")
    told = [hidden.text, str(metadata), *(str(value) for value in attached.values())]
    told += [
        path.read_text() for path in hidden.folder.iterdir() if path.suffix in (".txt", ".json", ".yaml")
    ]
    for text in told:
        assert effect.cause not in text
        assert not any(repr(value) in text for value in effect.parameters.values())
    summary = json.loads((hidden.folder / "summary.json").read_text())
    assert summary["hidden"] == "sealed"
    assert not any("truth" in entry for entry in summary["parameters"])
    page = report_html(ResultFolder.load(hidden.folder))
    assert "An effect is hidden in the emulated arm" in page
    assert effect.cause not in page
    assert "lwr-run experiment --reveal" in hidden.text


def test_the_arm_of_the_run_has_the_effect_and_a_resumed_one_too(hidden: Finished) -> None:
    again = run("experiment", "--resume", str(hidden.folder), "--yes")
    assert again.code == 0, again.text
    assert json.loads((hidden.folder / "summary.json").read_text())["hidden"] == "sealed"
    assert run("experiment", "--resume", str(hidden.folder), "--hide", "4").code == 2


def test_reveal_shows_the_truth_in_terminal_and_report(hidden: Finished) -> None:
    effect = HiddenEffect.unseal(hidden.folder)
    assert effect is not None
    shown = run("experiment", "--reveal", str(hidden.folder))
    assert shown.code == 0, shown.text
    assert f"[{effect.cause}]" in shown.text
    assert "verdict  the diagnosis is missing" in shown.text
    assert f"[{effect.cause}]" in report_html(ResultFolder.load(hidden.folder))
    content = json.loads(run("experiment", "--reveal", str(hidden.folder), "--json").text)
    assert content["effect"]["cause"] == effect.cause
    assert run("experiment", "--reveal", str(hidden.folder), "--hide", "1").code == 2


def test_the_periods_of_an_emulated_log_are_found_without_its_marks(hidden: Finished) -> None:
    session = read_session(hidden.folder / "unloaded.mcap", status=False)
    log = session.joint.log_time
    (start, middle), (_, stop) = session.spans("period")
    for noise in (0.0, 2e-4):
        q = session.joint.position + noise * np.random.default_rng(1).normal(
            size=session.joint.position.shape
        )
        found = find_periods(1e-9 * (log - log[0]).astype(np.float64), q)
        assert found is not None
        assert found.count == 2
        assert found.period_s == pytest.approx((middle - start) * 1e-9, abs=1e-3)
        assert found.start_s == pytest.approx((start - log[0]) * 1e-9, abs=0.3)
    part = (log >= start) & (log < start + 0.75 * (stop - start))
    assert find_periods(1e-9 * (log[part] - start).astype(np.float64), session.joint.position[part]) is None


def test_a_real_arm_takes_no_hidden_effect(tmp_path: Path) -> None:
    file = experiment_file(tmp_path, backend="fri", lock_step=False, emulator_settings={})
    done = run("experiment", str(file), "--hide", "1", "--out", str(tmp_path / "out"))
    assert done.code == 2
    assert "nothing can be hidden in a real arm" in done.text
    assert not (tmp_path / "out").exists()


def test_other_physics_take_no_hidden_effect(tmp_path: Path) -> None:
    settings = {"robot.plant": {"type": "tests.sim_backend.arms:lwr"}}
    file = experiment_file(tmp_path, emulator_settings=settings)
    done = run("experiment", str(file), "--hide", "1", "--out", str(tmp_path / "out"))
    assert done.code == 2
    assert "plug-in tests.sim_backend.arms:lwr" in done.text


def test_reveal_without_a_hidden_effect_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert "no run in `experiments`" in run("experiment", "--reveal").text
    assert "nothing was hidden" in run("experiment", "--reveal", str(tmp_path)).text
    assert "nosuch: no such folder" in run("experiment", "--reveal", str(tmp_path / "nosuch")).text
    (tmp_path / SEALED).write_text("{}")
    with pytest.raises(DataError, match="run the experiment again"):
        HiddenEffect.unseal(tmp_path)


def finding(cause: str, joints: Sequence[int], **more: Any) -> dict[str, Any]:
    value = {"value": 0.052, "std": 0.004, "unit": "1"}
    return {
        "cause": cause,
        "joints": list(joints),
        "confidence": 0.9,
        "alternatives": [],
        "parameters": {"error": value},
        **more,
    }


OTHER = finding("stribeck", [4])
OPEN = finding("sensor_crosstalk", [2], alternatives=[{"cause": "sensor_gain", "joints": [2]}])


@pytest.mark.parametrize(
    ("content", "outcome", "number"),
    [
        ({"findings": [finding("sensor_gain", [2]), OTHER]}, "right", 1),
        ({"findings": [], "character": [finding("sensor_gain", [2])]}, "right", 1),
        ({"findings": [OTHER, finding("sensor_gain", [2])]}, "named, not first", 2),
        ({"findings": [OTHER, OPEN]}, "one of the alternatives", 2),
        ({"findings": [finding("sensor_gain", [3])]}, "wrong", 1),
        ({"findings": [], "unexplained": [{"side": "joint", "joint": 2}]}, "seen, not named", None),
        ({"findings": [], "nameless": [{"side": "joint", "joint": 5}]}, "not found", None),
    ],
)
def test_the_verdict_on_a_diagnosis(
    tmp_path: Path, content: dict[str, Any], outcome: Outcome, number: int | None
) -> None:
    GAIN.seal(tmp_path)
    (tmp_path / "summary.json").write_text('{"exit_status": "success", "sessions": []}')
    (tmp_path / "diagnosis").mkdir()
    (tmp_path / "diagnosis" / "diagnosis.json").write_text(json.dumps(content))
    shown = reveal(tmp_path)
    assert (shown.outcome, shown.to_dict()["finding"]) == (outcome, number)
    assert outcome.upper() in str(shown)
    if outcome in ("right", "named, not first"):
        assert shown.parameters[0].sigmas == pytest.approx(0.5)
        assert "0.052 ± 0.004" in str(shown)


@pytest.mark.parametrize(
    ("state", "text"),
    [
        ("nothing", "Nothing was hidden in the emulated arm: what is found here is"),
        ("in the settings", "settings name effects beyond the model"),
        ("sealed", "An effect is hidden in the emulated arm"),
    ],
)
def test_the_report_says_whether_anything_was_hidden(tmp_path: Path, state: str, text: str) -> None:
    content = {"exit_status": "success", "sessions": []}
    assert hidden_section(ResultFolder(tmp_path, content)) == ""
    assert text in hidden_section(ResultFolder(tmp_path, content | {"hidden": state}))


def test_a_summary_knows_effects_of_the_settings(tmp_path: Path) -> None:
    plain = Experiment.load(experiment_file(tmp_path))
    record = Record("unloaded", tmp_path / "unloaded.mcap", "abort", "")
    assert summarise(plain, [record], None)["hidden"] == "nothing"
    assert summarise(with_effect(plain, GAIN), [record], None)["hidden"] == "sealed"
    stated = plain.changed(emulator_settings={"robot.effects": [GAIN.plugin]})
    assert summarise(stated, [record], None)["hidden"] == "in the settings"


def test_a_plugin_with_wrong_parameters_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="sensor_gain"):
        Cause("sensor_gain", {"size": 1.0}, joint=2)
