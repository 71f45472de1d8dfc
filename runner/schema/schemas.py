"""JSON Schemas (draft 7) of the YAML files, for editors: completion, and a check as one types.

A schema has keys, types, ranges, words, defaults and meanings, from the dataclasses that read the files. Rules
between keys are the readers' alone.
"""

from __future__ import annotations

import json
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
from runner.editor import FOLDER
from runner.estimation import IdentifySettings
from runner.experiment_file import Experiment
from runner.schema.shapes import shape, title
from sim_backend.configuration import EmulatorConfig
from sim_backend.faults import WireFault
from sim_backend.operator import ScheduleEntry
from sim_backend.robot import RobotFile


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
