"""A folder of results from logs alone, as an experiment leaves one: for the report of what was recorded elsewhere."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from fri.errors import ConfigurationError
from ident.estimation.identify import Identification
from ident.model.dynamic_model import DynamicModel
from ident.model.model_file import write_model
from lwr_driver.session import Session
from runner.plain import plain
from runner.results import estimated
from runner.versions import versions

__all__ = ["new_folder", "write_log_results"]

_ANNOUNCED = ("payload", "payload_mass")


def new_folder(folder: Path) -> Path:
    """A folder for results, made now. ConfigurationError if it holds something or cannot be made."""
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ConfigurationError(f"{folder} is not an empty folder; choose another --results")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigurationError(
            f"{folder} cannot be made: {error.strerror}; choose another --results"
        ) from error
    return folder


def write_log_results(
    folder: Path,
    found: Identification,
    sessions: Sequence[Session],
    tested: Sequence[Session],
    model: DynamicModel,
    *,
    text: str,
) -> Path:
    """Write summary.json, model.yaml, report.txt and report.html into `folder`; returns the path of the page.

    sessions : what the estimate was made from. tested : sessions that it has not seen and is held against. The
    logs stay where they are; the summary names their places.
    """
    names = _names([*sessions, *tested])
    entries = [
        _entry(session, name, folder, index >= len(sessions))
        for index, (session, name) in enumerate(zip([*sessions, *tested], names, strict=True))
    ]
    summary = {
        "schema_version": 1,
        "experiment": folder.resolve().name,
        "from_logs": True,
        "exit_status": "success",
        "reason": "",
        "sessions": entries,
        "link": {},
        "versions": versions(),
        **estimated(found, tested),
    }
    write_model(model, folder / "model.yaml")
    (folder / "report.txt").write_text(text + "\n", encoding="utf-8")
    (folder / "summary.json").write_text(json.dumps(plain(summary), indent=1) + "\n", encoding="utf-8")
    from runner.report.page import write_report

    return write_report(folder)


def _entry(session: Session, name: str, folder: Path, unseen: bool) -> Mapping[str, Any]:
    return {
        "name": name,
        "file": os.path.relpath(session.path.resolve(), folder.resolve()),
        "exit_status": "success",
        "reason": "",
        "validation": unseen,
        "warnings": [],
        # As announced on the command line, which may correct what the log says.
        "metadata": {key: session.metadata[key] for key in _ANNOUNCED if key in session.metadata},
    }


def _names(sessions: Sequence[Session]) -> list[str]:
    """Names of the sessions: of their files, with the folder where files of one name come from several."""
    stems = [session.path.stem for session in sessions]
    return [
        stem if stems.count(stem) == 1 else f"{session.path.resolve().parent.name}-{stem}"
        for session, stem in zip(sessions, stems, strict=True)
    ]
