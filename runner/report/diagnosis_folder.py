"""The files of a diagnosis as the report sees them."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from fri.errors import ConfigurationError, DataError
from runner.diagnosis.look_alikes import FILE as LOOK_ALIKES
from runner.diagnosis.look_alikes import LookAlikes, read_look_alikes
from runner.diagnosis.replayed import FILE as REPLAYED
from runner.diagnosis.replayed import ReplayErrors
from runner.diagnosis.residuals import FILE as RESIDUALS
from runner.diagnosis.residuals import Residuals
from runner.report.folder import ResultFolder

__all__ = ["DiagnosisFolder", "values_of"]


@dataclass(frozen=True)
class DiagnosisFolder:
    """A folder with diagnosis.json; what else there is, is shown.

    content : of diagnosis.json. joint_names : of the arm. experiment : folder of the experiment that it ends, None
    for a diagnosis of logs.
    """

    path: Path
    content: Mapping[str, Any]
    joint_names: tuple[str, ...]
    experiment: Path | None = None

    @classmethod
    def load(cls, path: str | Path) -> DiagnosisFolder:
        """Of a folder that `lwr-run diagnose` wrote. ConfigurationError if it is none, DataError if it is broken."""
        folder = Path(path)
        file = folder / "diagnosis.json"
        if not file.is_file():
            raise ConfigurationError(
                f"{folder}: holds no diagnosis.json; name the folder of `lwr-run diagnose --out`"
            )
        try:
            content = json.loads(file.read_text(encoding="utf-8"))
            found = cls(folder, content, tuple(_json(folder / "details.json").get("joints", ())))
        except (OSError, ValueError) as error:
            raise DataError(f"{file}: cannot be read: {error}; run `lwr-run diagnose` again") from error
        return found

    @classmethod
    def of(cls, results: ResultFolder) -> DiagnosisFolder | None:
        """The diagnosis in the folder of an experiment; None where there is none."""
        if results.diagnosis is None:
            return None
        experiment = None if results.summary.get("from_logs") else results.path
        return cls(results.diagnosis_folder, results.diagnosis, results.joint_names, experiment)

    @property
    def findings(self) -> Sequence[Mapping[str, Any]]:
        """What was found, the one that matters most first."""
        found: Sequence[Mapping[str, Any]] = self.content.get("findings", [])
        return found

    @property
    def unexplained(self) -> Sequence[Mapping[str, Any]]:
        """What is there but has no name."""
        found: Sequence[Mapping[str, Any]] = self.content.get("unexplained", [])
        return found

    @cached_property
    def details(self) -> Mapping[str, Any]:
        """Content of details.json."""
        return _json(self.path / "details.json")

    @cached_property
    def answers(self) -> Sequence[Mapping[str, Any]]:
        """What deciding motions said."""
        found: Sequence[Mapping[str, Any]] = _json(self.path / "decision.json").get("answers", [])
        return found

    @cached_property
    def residuals(self) -> Residuals | None:
        """Held-out residuals, None without their file."""
        file = self.path / RESIDUALS
        return Residuals.load(file) if file.is_file() else None

    @cached_property
    def replayed(self) -> ReplayErrors | None:
        """Errors of the simulation over time, None without their file."""
        file = self.path / REPLAYED
        return ReplayErrors.load(file) if file.is_file() else None

    @cached_property
    def look_alikes(self) -> tuple[LookAlikes, ...]:
        """Causes side by side."""
        entries, file = self.details.get("look_alikes") or [], self.path / LOOK_ALIKES
        return read_look_alikes(file, entries) if entries and file.is_file() else ()


def values_of(finding: Mapping[str, Any]) -> dict[str, tuple[float, float, str]]:
    """Value, standard deviation and unit by parameter of a finding's plain content."""
    return {
        name: (float(one.get("value", math.nan)), float(one.get("std") or 0.0), str(one.get("unit", "1")))
        for name, one in (finding.get("parameters") or {}).items()
    }


def _json(path: Path) -> Mapping[str, Any]:
    """Content of a file that may be missing."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}
