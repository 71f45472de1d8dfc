"""Schemas, key tables and templates against the readers of the files."""

from __future__ import annotations

import json
import re
import shutil
import typing
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from click.testing import CliRunner
from jsonschema import Draft7Validator

from fri.errors import ConfigurationError
from ident.excitation.plan import ExcitationPlan
from ident.excitation.problem import PlanProblem
from ident.import_log import LogMapping
from lwr_driver.arm import Arm
from lwr_driver.arm.cell import Cell
from lwr_driver.configuration import CONFIGS, parse, read_yaml
from runner.cli import main
from runner.editor import FOLDER, hand_out, kind_of, refer, reference
from runner.estimation import IdentifySettings
from runner.experiment_file import Experiment
from runner.schema import FILES, schema, schema_text
from runner.schema.shapes import hints, meanings, title
from runner.schema.tables import TEMPLATE, renewed, settings_template
from sim_backend.configuration import load_configuration
from sim_backend.rehearsal import rehearse
from sim_backend.robot import RobotFile

ROOT = Path(__file__).resolve().parents[3]
FIXED = "run python docs/key_tables.py"
SHIPPED = sorted(path for path in CONFIGS.rglob("*.yaml"))


READERS: dict[str, Callable[[Path], Any]] = {
    "experiment": Experiment.load,
    "cell": Cell.load,
    "arm": Arm.load,
    "plan": PlanProblem.load,
    "motion": ExcitationPlan.load,
    "emulator": load_configuration,
    "parameters": lambda path: parse(RobotFile, read_yaml(path), path),
    "mapping": LogMapping.load,
    "settings": IdentifySettings.load,
}
MAPPING = """\
robot: bench
joints: [a]
time: {rate_hz: 100}
position: {unit: rad}
joint_torque:
  unit: Nm
"""
# By kind: a good file, and changes that spoil it: text, replacement, line of the fault.
GOOD = {
    "experiment": (CONFIGS / "experiments/default.yaml").read_text(),
    "cell": (CONFIGS / "cell.yaml").read_text(),
    "arm": (CONFIGS / "lwr4plus.yaml").read_text(),
    "plan": (CONFIGS / "plans/default.yaml").read_text(),
    "motion": (CONFIGS / "plans/default.plan.yaml").read_text(),
    "emulator": (CONFIGS / "emulator/default.yaml").read_text(),
    "parameters": (CONFIGS / "emulator/table2.yaml").read_text(),
    "mapping": MAPPING,
    "settings": TEMPLATE.read_text(),
}
SPOILED = [
    ("experiment", "backend: emulator", "backend: simulator"),
    ("experiment", "  speed_scale: 0.2", "  speed_scale: 20"),
    ("experiment", "      mass: 3.34", "      masss: 3.34"),
    ("experiment", "com: [0.0, -0.066, 0.144]", "com: [0.0, -66, 144]"),
    ("experiment", "  model: 2", "  model: 4"),
    ("cell", "margin_m: 0.02", "margin_m: 20"),
    ("cell", "name: default", "name: [default]"),
    ("arm", "position_margin_deg: 1.0", "position_margin_deg: -1.0"),
    ("arm", "jerk_rad_s3: 100.0, torque_nm: 176", "torque_nm: 176"),
    ("plan", "  harmonics: 5", "  harmonics: five"),
    ("plan", "  criterion: mean_rsd", "  criterion: mean"),
    ("motion", "periods: 2", "periods: 0"),
    ("motion", "  type: fourier", "  type: sine"),
    ("motion", "  harmonics: 5", "  harmonicas: 5"),
    ("emulator", "  tick_ms: 12", "  tick_ms: 12.5"),
    ("emulator", "  autostart: true", "  autostart: yesterday"),
    ("parameters", "  XX1: 0.01438", "  XX1: small"),
    ("mapping", "  unit: Nm", "  unit: Newton"),
    ("mapping", "time: {rate_hz: 100}", "time: {rate_hz: -100}"),
    ("settings", "  order: 4", "  order: four"),
    ("settings", "  draws: 400", "  draw: 400"),
]


def kind(path: Path) -> str:
    text = path.read_text()
    return kind_of(text) or ("motion" if "kind: excitation plan" in text else "none")


def faults(name: str, text: str) -> list[str]:
    return [error.message for error in Draft7Validator(schema(name)).iter_errors(yaml.safe_load(text))]


@pytest.mark.parametrize("name", FILES)
def test_the_shipped_schema_is_that_of_the_reader(name: str) -> None:
    Draft7Validator.check_schema(schema(name))
    assert (FOLDER / f"{name}.json").read_text() == schema_text(name), FIXED


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: str(path.relative_to(CONFIGS)))
def test_every_shipped_file_keeps_its_schema_and_refers_to_it(path: Path) -> None:
    assert faults(kind(path), path.read_text()) == []
    if kind(path) != "motion":
        target = reference(path.read_text())
        assert target is not None
        assert (path.parent / target).resolve() == FOLDER / f"{kind(path)}.json"


@pytest.mark.parametrize("name", GOOD)
def test_a_good_file_passes_reader_and_schema(name: str, tmp_path: Path) -> None:
    path = tmp_path / f"{name}.yaml"
    path.write_text(GOOD[name])
    READERS[name](path)
    assert faults(name, GOOD[name]) == []


@pytest.mark.parametrize(("name", "good", "bad"), SPOILED)
def test_a_wrong_file_is_refused_by_schema_and_reader_with_its_line(
    name: str, good: str, bad: str, tmp_path: Path
) -> None:
    path = tmp_path / f"{name}.yaml"
    assert good in GOOD[name]
    text = GOOD[name].replace(good, bad, 1)
    path.write_text(text)
    assert faults(name, text)
    with pytest.raises(ConfigurationError) as caught:
        READERS[name](path)
    line = text[: text.index(bad)].count("\n") + 1
    assert str(caught.value).startswith(f"{path}:{line}: "), str(caught.value)


def test_faults_and_schedule_of_the_emulator_are_named_with_their_line(tmp_path: Path) -> None:
    path = tmp_path / "poor.yaml"
    for wrong in ("{kind: lost}", "{kind: loss, probability: 20}"):
        path.write_text(f"base: emulator/default.yaml\nfaults:\n  - {{kind: loss}}\n  - {wrong}\n")
        assert faults("emulator", path.read_text())
        config = load_configuration(path)
        with pytest.raises(ConfigurationError) as caught:
            rehearse(config)
        assert f"{path}:4: `faults`[1]: " in str(caught.value)


def test_a_wrong_key_of_a_base_is_named_in_the_base(tmp_path: Path) -> None:
    base, path = tmp_path / "base.yaml", tmp_path / "mine.yaml"
    base.write_text("base: emulator/default.yaml\nkrl:\n  halt_s: long\n")
    path.write_text("base: base.yaml\nseed: 2\n")
    with pytest.raises(ConfigurationError, match=rf"^{re.escape(str(base))}:3: `krl`: `halt_s`"):
        load_configuration(path)
    base.write_text("base: emulator/default.yaml\n")
    with pytest.raises(ConfigurationError, match=rf"^{re.escape(str(path))}: `krl`: `halt_s`"):
        load_configuration(path, {"krl.halt_s": "long"})


def test_a_limit_beyond_the_ceiling_is_named_with_its_line(tmp_path: Path) -> None:
    path = tmp_path / "arm.yaml"
    text = GOOD["arm"].replace("torque_nm: 38", "torque_nm: 300", 1)
    path.write_text(text)
    number = text[: text.index("- {name: A5")].count("\n") + 1
    with pytest.raises(ConfigurationError, match=rf"^{re.escape(str(path))}:{number}: joint A5: torque_nm"):
        Arm.load(path)


def classes(hint: Any, changed: Any, found: dict[str, set[str]]) -> None:
    if hasattr(hint, "__dataclass_fields__") and isinstance(hint, type):
        types = hints(hint, changed)
        new = not set(types) <= found.get(title(hint), set())
        found.setdefault(title(hint), set()).update(types)
        for inner in types.values() if new else ():
            classes(inner, changed, found)
    for part in typing.get_args(hint):
        classes(part, changed, found)


def test_every_key_has_a_meaning_and_no_meaning_is_of_a_key_gone() -> None:
    found: dict[str, set[str]] = {}
    for file in FILES.values():
        classes(file.cls, file.changed, found)
    assert {name: set(keys) for name, keys in meanings().items()} == found


def documents() -> Iterator[Path]:
    yield from (ROOT / "docs").rglob("*.md")


def test_the_tables_of_the_documents_and_the_settings_template_are_those_of_the_readers() -> None:
    written = ""
    for page in documents():
        text = page.read_text()
        assert renewed(text) == text, f"{page}: {FIXED}"
        written += text
    for name in FILES:
        assert f"<!-- keys of the {name} file" in written
    assert TEMPLATE.read_text() == settings_template(), FIXED
    assert IdentifySettings.load(TEMPLATE) == IdentifySettings()


def test_a_copy_of_a_template_finds_its_schema_again(tmp_path: Path) -> None:
    copy = tmp_path / "my_lab.yaml"
    shutil.copy(CONFIGS / "experiments/default.yaml", copy)
    done = CliRunner().invoke(main, ["schema", "--refer", str(copy)])
    assert done.exit_code == 0, done.output
    assert reference(copy.read_text()) == str(FOLDER / "experiment.json")
    assert copy.read_text().count("$schema=") == 1
    assert repr(Experiment.load(copy).sessions) == repr(
        Experiment.load(CONFIGS / "experiments/default.yaml").sessions
    )
    own = tmp_path / "own.yaml"
    own.write_text("margin_m: 0.1\n")
    with pytest.raises(ConfigurationError, match="refers to no schema"):
        refer(own)
    assert refer(own, "cell") == FOLDER / "cell.json"


def test_a_folder_of_copies_keeps_its_schemas_wherever_it_goes(tmp_path: Path) -> None:
    folder = tmp_path / "lab"
    folder.mkdir()
    for name, source in (("experiment", "experiments/default"), ("cell", "cell"), ("arm", "lwr4plus")):
        shutil.copy(CONFIGS / f"{source}.yaml", folder / f"{name}.yaml")
    (folder / "notes.yaml").write_text("a: 1\n")
    assert [path.stem for path in hand_out(folder)] == ["arm", "cell", "experiment"]
    moved = folder.rename(tmp_path / "elsewhere")
    for name in ("experiment", "cell", "arm"):
        text = (moved / f"{name}.yaml").read_text()
        found = json.loads((moved / str(reference(text))).read_text())
        assert found == schema(name)
        READERS[name](moved / f"{name}.yaml")
    assert (moved / "notes.yaml").read_text() == "a: 1\n"


def test_the_command_prints_lists_and_writes(tmp_path: Path) -> None:
    assert json.loads(CliRunner().invoke(main, ["schema", "cell"]).output) == schema("cell")
    listed = CliRunner().invoke(main, ["schema"]).output
    assert [line.split()[0] for line in listed.splitlines()] == ["file", *FILES]
    out = tmp_path / "cell.json"
    assert CliRunner().invoke(main, ["schema", "cell", "--out", str(out)]).exit_code == 0
    assert out.read_text() == schema_text("cell")
    unknown = CliRunner().invoke(main, ["schema", "cel"])
    assert (unknown.exit_code, "known: experiment" in unknown.output) == (2, True)
