"""The tables of docs/settings.md against the settings themselves."""

from __future__ import annotations

import dataclasses
import re
import runpy
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

from runner.experiment_file import Experiment

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs/settings.md").read_text(encoding="utf-8")
REQUIRED = "required"


def documented(title: str) -> dict[str, Any]:
    """Defaults by dotted key, from the table below a heading."""
    section = PAGE.split(f"## {title}\n")[1].split("\n## ")[0]
    found = {}
    for keys, default in re.findall(r"^\| (`.+?) \| (.+?) \| ", section, re.MULTILINE):
        for key in re.findall(r"`(.+?)`", keys):
            found[key] = yaml.safe_load(default)
    return found


def declared(kind: type, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Defaults by dotted key, from the fields of a settings class; settings within settings are followed."""
    hints = typing.get_type_hints(kind)
    for field in dataclasses.fields(kind):
        if not field.init:
            continue
        hint = hints[field.name]
        below = [part for part in (hint, *typing.get_args(hint)) if dataclasses.is_dataclass(part)]
        default: Any = field.default
        if field.default_factory is not dataclasses.MISSING:
            default = field.default_factory()
        key = prefix + field.name
        if below != [hint] or default is dataclasses.MISSING:
            yield key, REQUIRED if default is dataclasses.MISSING else default
        for part in below:
            yield from declared(part, f"{key}.")


def as_yaml(value: Any) -> Any:
    """A default as the table writes it: lists for tuples, settings by the keys that differ from their defaults."""
    if dataclasses.is_dataclass(value):
        fields = dataclasses.fields(value)
        shown = {f.name: getattr(value, f.name) for f in fields if getattr(value, f.name) != f.default}
        return {name: as_yaml(entry) for name, entry in shown.items()}
    return [as_yaml(entry) for entry in value] if isinstance(value, tuple) else value


def test_every_key_of_an_experiment_file_is_documented_with_its_default() -> None:
    table = documented("The experiment file")
    assert table == {key: as_yaml(value) for key, value in declared(Experiment)}


def test_the_mapping_page_describes_every_key() -> None:
    written = runpy.run_path(str(ROOT / "docs/mapping_table.py"))
    assert written["PAGE"].read_text().endswith(written["table"]()), "run python docs/mapping_table.py"
    assert set(written["KEYS"]) == {key for key, _, _ in written["declared"]()}
    for key, (_, _, example) in written["KEYS"].items():
        yaml.safe_load(f"{key}: {example}")
