"""The files of a diagnosis."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from fri.errors import ConfigurationError, DataError
from ident.diagnosis.look_alikes import LookAlikes
from ident.diagnosis.statements import Statements, statements
from runner.diagnosis.records import LOOK_ALIKES, REPLAY, RESIDUALS, ReplayErrors, Residuals, read_look_alikes
from runner.report.folder import ResultFolder

__all__ = ["DiagnosisFolder"]


@dataclass(frozen=True)
class DiagnosisFolder:
    """A folder with diagnosis.json; every other file of a diagnosis may be missing.

    content : of diagnosis.json. joint_names : of the arm. experiment : folder of its experiment, None for a diagnosis
    of logs.
    """

    path: Path
    content: Mapping[str, Any]
    joint_names: tuple[str, ...]
    experiment: Path | None = None

    @classmethod
    def load(cls, path: str | Path) -> DiagnosisFolder:
        """Of a folder by `lwr-run diagnose`. Raises ConfigurationError for another one, DataError for a broken one."""
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
        """The diagnosis in the folder of an experiment, if any."""
        if results.diagnosis is None:
            return None
        experiment = None if results.summary.get("from_logs") else results.path
        return cls(results.diagnosis_folder, results.diagnosis, results.joint_names, experiment)

    @property
    def findings(self) -> Sequence[Mapping[str, Any]]:
        """The findings, the largest effect first."""
        found: Sequence[Mapping[str, Any]] = self.content.get("findings", [])
        return found

    @cached_property
    def statements(self) -> Statements:
        """The diagnosis in words."""
        answers = _json(self.path / "decision.json").get("answers", [])
        return statements(self.content, self.details, self.joint_names, answers)

    @cached_property
    def details(self) -> Mapping[str, Any]:
        """Content of details.json."""
        return _json(self.path / "details.json")

    @cached_property
    def residuals(self) -> Residuals | None:
        """Held-out residuals, None without their file."""
        file = self.path / RESIDUALS
        return Residuals.load(file) if file.is_file() else None

    @cached_property
    def replayed(self) -> ReplayErrors | None:
        """Errors of the replay over time, None without their file."""
        file = self.path / REPLAY
        return ReplayErrors.load(file) if file.is_file() else None

    @cached_property
    def look_alikes(self) -> tuple[LookAlikes, ...]:
        """Look-alikes, empty without their file."""
        entries, file = self.details.get("look_alikes") or [], self.path / LOOK_ALIKES
        return read_look_alikes(file, entries) if entries and file.is_file() else ()


def _json(path: Path) -> Mapping[str, Any]:
    """Content of a file, empty for a missing one."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}
