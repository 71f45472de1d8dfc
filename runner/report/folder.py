"""The folder of an experiment as the report sees it: read once, and honest about what is not there."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import yaml

from fri.errors import ConfigurationError, DataError, LwrError
from ident.model.dynamic_model import DynamicModel
from ident.model.model_file import read_model
from lwr_driver.session import Session, read_session
from runner.report.curves import Curves, curves

__all__ = ["ResultFolder"]


@dataclass(frozen=True)
class ResultFolder:
    """Results of one experiment. What the run did not come to (no model, no diagnosis) is None or empty.

    path : the folder; summary : content of summary.json.
    """

    path: Path
    summary: Mapping[str, Any]

    @classmethod
    def load(cls, path: str | Path) -> ResultFolder:
        """Read `summary.json` of a folder. ConfigurationError if there is none, DataError if it is broken."""
        folder = Path(path)
        file = folder / "summary.json"
        if not file.is_file():
            raise ConfigurationError(
                f"{folder}: holds no summary.json; name the folder of an experiment, the last line that "
                "`lwr-run experiment` prints"
            )
        try:
            content = json.loads(file.read_text(encoding="utf-8"))
            if not isinstance(content, dict) or "exit_status" not in content:
                raise ValueError("no `exit_status`")
        except (OSError, ValueError) as error:
            raise DataError(
                f"{file}: is no summary of an experiment: {error}; run the experiment again"
            ) from error
        return cls(folder, content)

    @cached_property
    def model(self) -> DynamicModel | None:
        """The identified model, None where the run did not come to one."""
        file = self.path / "model.yaml"
        return read_model(file) if file.is_file() else None

    @cached_property
    def sessions(self) -> dict[str, Session]:
        """The session logs that can be read, by name of the session."""
        found: dict[str, Session] = {}
        for entry in self.summary.get("sessions", []):
            file = self.path / entry["file"]
            try:
                session = read_session(file)
            except (LwrError, OSError):
                continue
            announced = {**session.metadata, **entry.get("metadata", {})}
            found[entry["name"]] = replace(session, metadata=announced)
        return found

    @property
    def unread(self) -> tuple[str, ...]:
        """Names of the sessions whose log is missing or broken."""
        return tuple(e["name"] for e in self.summary.get("sessions", []) if e["name"] not in self.sessions)

    @property
    def diagnosis_folder(self) -> Path:
        """Where the files of a diagnosis are: `diagnosis`, or the folder itself."""
        own = self.path / "diagnosis"
        return own if (own / "diagnosis.json").is_file() else self.path

    @cached_property
    def diagnosis(self) -> Mapping[str, Any] | None:
        """Content of diagnosis.json, None where there is none. DataError if it is broken."""
        file = self.diagnosis_folder / "diagnosis.json"
        if not file.is_file():
            return None
        try:
            content: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise DataError(f"{file}: cannot be read: {error}; run `lwr-run diagnose` again") from error
        return content

    @cached_property
    def preflights(self) -> dict[str, list[dict[str, Any]]]:
        """Conditions checked before the motion, by session."""
        found = {}
        for name, session in self.sessions.items():
            text = session.attachments.get("preflight.json")
            if text is not None:
                found[name] = json.loads(text)
        return found

    @cached_property
    def curves(self) -> tuple[Curves, ...]:
        """Measured and computed torque by session and side: what the estimate has seen first, loaded first."""
        if self.model is None:
            return ()
        cutoffs = {entry["name"]: entry["cutoff_hz"] for entry in self.summary.get("signals", [])}
        found = []
        for entry in self.summary["sessions"]:
            session = self.sessions.get(entry["name"])
            if session is not None and entry["exit_status"] == "success":
                cutoff, unseen = cutoffs.get(session.path.name), bool(entry.get("validation"))
                found += curves(self.model, session, entry["name"], cutoff_hz=cutoff, unseen=unseen)
        return tuple(sorted(found, key=lambda one: (one.unseen, one.payload is None, one.session, one.side)))

    @cached_property
    def _experiment(self) -> Mapping[str, Any] | None:
        text = self.text("experiment.yaml")
        content = yaml.safe_load(text) if text is not None else None
        return content if isinstance(content, dict) else None

    @property
    def emulated(self) -> bool:
        """Whether the arm was the built-in emulator's."""
        return self._experiment is not None and self._experiment.get("backend", "emulator") == "emulator"

    @property
    def lock_step(self) -> bool:
        """Whether the emulator waited for each answer, so that reply times say nothing of the link."""
        return self.emulated and bool((self._experiment or {}).get("lock_step", True))

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Joints of the arm in kinematic order."""
        for session in self.sessions.values():
            return session.joint_names
        return tuple(next(iter(self.summary.get("torque_rms", {}).values()), ()))

    def text(self, name: str) -> str | None:
        """Text of a file of the folder, None where there is none."""
        file = self.path / name
        return file.read_text(encoding="utf-8", errors="replace") if file.is_file() else None
