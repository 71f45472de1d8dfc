"""JSON Schemas (draft 7) of the YAML files, for editors: completion, and a check as one types.

A schema has keys, types, ranges, words, defaults and meanings, from the dataclasses that read the files. Rules
between keys are the readers' alone. An editor finds a schema by the first line of a file,
`# yaml-language-server: $schema=FILE`.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec

from fri.errors import ConfigurationError
from fri.quantities import FileName
from ident.excitation.plan import MOTIONS, PlanFile
from ident.excitation.problem import PlanProblem
from ident.import_log import LogMapping
from lwr_driver.arm.cell import Cell
from lwr_driver.arm.description import ArmFile
from lwr_driver.configuration import CONFIGS, read_text
from runner.estimation import IdentifySettings
from runner.experiment_file import Experiment
from runner.schema.shapes import shape, title
from sim_backend.configuration import EmulatorConfig
from sim_backend.faults import WireFault
from sim_backend.operator import ScheduleEntry
from sim_backend.robot import RobotFile

FOLDER = CONFIGS / "schemas"
_MARK = "# yaml-language-server: $schema="
_REFERENCE = re.compile(rf"^{re.escape(_MARK)}(\S+)[^\n]*\n", re.MULTILINE)


@dataclass(frozen=True)
class File:
    """A kind of file: its dataclass, and what it is.

    changed : types by `CLASS.key` in place of those of the dataclass; None for a key that no file has.
    """

    cls: type
    meaning: str
    changed: Mapping[str, Any] = field(default_factory=dict)


FILES = {
    "experiment": File(Experiment, "an experiment of `lwr-run experiment`"),
    "cell": File(Cell, "the surroundings of the arm"),
    "arm": File(ArmFile, "names, limits and gears of the arm"),
    "plan": File(PlanProblem, "a planning problem of `lwr-run plan`", {"PlanProblem.source": None}),
    "motion": File(
        PlanFile,
        "an exciting motion, written by `lwr-run plan`",
        {
            "PlanFile.motion": MOTIONS,
            "PlanFile.objectives": dict[str, float],
            "PlanFile.rsd_percent": dict[str, float],
            "PlanFile.margins": tuple[dict[str, Any], ...],
            "PlanFile.provenance": dict[str, Any],
        },
    ),
    "emulator": File(
        EmulatorConfig,
        "the emulated controller and arm",
        {
            "EmulatorConfig.base": FileName,
            "EmulatorConfig.faults": tuple[WireFault, ...],
            "EmulatorConfig.schedule": tuple[ScheduleEntry, ...],
            # Enumerations of the code, not of files.
            "KrcPolicy.start_quality": None,
            "KrcPolicy.hold_quality": None,
        },
    ),
    "parameters": File(RobotFile, "true parameters and payloads of the emulated arm"),
    "mapping": File(LogMapping, "the columns of a foreign recording, for `lwr-run import`"),
    "settings": File(IdentifySettings, "filters, covariance and more, for `lwr-run identify --settings`"),
}
"""The kinds of YAML files, by name."""
SCHEMAS = tuple(FILES)


def schema(name: str) -> dict[str, Any]:
    """JSON Schema of a kind of file, see `FILES`. ConfigurationError for another name."""
    if name not in FILES:
        raise ConfigurationError(f"schema {name!r} is unknown; known: {', '.join(SCHEMAS)}")
    kind = FILES[name]
    made = msgspec.json.schema(shape(kind.cls, kind.changed, {}))
    top = made["$defs"].pop(title(kind.cls))
    head = {"$schema": "http://json-schema.org/draft-07/schema#", "title": name, "description": kind.meaning}
    return _draft_7({**top, **head, "definitions": made["$defs"]})


def _draft_7(part: Any) -> Any:
    """The same schema in the words of draft 7, which editors know."""
    if isinstance(part, (list, tuple)):
        return [_draft_7(entry) for entry in part]
    if not isinstance(part, dict):
        return part
    # The discriminator is a word of OpenAPI.
    part = {key: _draft_7(value) for key, value in part.items() if key != "discriminator"}
    if "$ref" in part:
        part["$ref"] = part["$ref"].replace("#/$defs/", "#/definitions/")
        # Draft 7 ignores what stands beside a reference.
        return {"allOf": [{"$ref": part.pop("$ref")}], **part} if len(part) > 1 else part
    if "prefixItems" in part:
        entries = part.pop("prefixItems")
        same = all(entry == entries[0] for entry in entries)
        part["items"] = entries[0] if same else entries
    if part.get("description") == "":
        part.pop("description")
    return part


def schema_text(name: str) -> str:
    """A schema as the text of its file."""
    return json.dumps(schema(name), indent=1, ensure_ascii=False) + "\n"


def write_schemas(folder: Path = FOLDER) -> list[Path]:
    """Write all schemas into a folder; returns their files."""
    folder.mkdir(parents=True, exist_ok=True)
    files = []
    for name in SCHEMAS:
        files.append(folder / f"{name}.json")
        files[-1].write_text(schema_text(name), encoding="utf-8")
    return files


def referring(text: str, schema_file: str | Path) -> str:
    """The text of a YAML file with a reference to its schema in the first line, in place of an older one."""
    return f"{_MARK}{schema_file}\n{_REFERENCE.sub('', text)}"


def reference(text: str) -> str | None:
    """The schema file that a YAML file refers to, None without one."""
    found = _REFERENCE.search(text)
    return None if found is None else found[1]


def kind_of(text: str) -> str | None:
    """The kind of a YAML file by its reference to a schema, None without one."""
    name = Path(reference(text) or "").stem
    return name if name in FILES else None


def refer(path: Path, name: str | None = None) -> Path:
    """Let a copy of a template refer to the schema of this installation; returns the schema's file.

    name : kind of the file, by default that of the reference it came with. ConfigurationError without either.
    """
    text = read_text(path)
    kind = name or kind_of(text)
    if kind is None:
        raise ConfigurationError(
            f"{path}: the file refers to no schema; name its kind, one of {', '.join(SCHEMAS)}"
        )
    target = FOLDER / f"{kind}.json"
    path.write_text(referring(text, target), encoding="utf-8")
    return target
