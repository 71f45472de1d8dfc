"""The layout of a diagnosis in HTML: a section of the report of a run, or the parts of a page of its own."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from html import escape
from pathlib import Path
from typing import Any

from fri.errors import ConfigurationError, DataError
from ident.diagnosis.outcome.claims_in_words import Comparison, FindingStatement, capital
from ident.diagnosis.outcome.look_alikes import LookAlikes
from ident.diagnosis.outcome.statements import Part, Statements, run_advice, statements
from runner.diagnosis.records import (
    LOOK_ALIKES,
    REPLAY,
    RESIDUALS,
    ReplayErrors,
    Residuals,
    read_look_alikes,
)
from runner.file_names import DECISION, DETAILS, DIAGNOSIS
from runner.report.diagnosis_figures import (
    finding_figure,
    look_alike_figure,
    replay_figures,
    residual_figures,
)
from runner.report.figure import Figure
from runner.report.figures import pretty_unit
from runner.report.folder import ResultFolder
from runner.report.markup import Cell, figure_html, fold, paragraph, section, table, with_code
from runner.report.paper import joint_labels


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
        file = folder / DIAGNOSIS
        if not file.is_file():
            raise ConfigurationError(
                f"{folder}: holds no diagnosis.json; name the folder of `lwr-run diagnose --out`"
            )
        try:
            content = json.loads(file.read_text(encoding="utf-8"))
            found = cls(folder, content, tuple(_json(folder / DETAILS).get("joints", ())))
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
    def claims(self) -> Sequence[Mapping[str, Any]]:
        """Findings and character of the arm, the largest effect first."""
        return [*self.content.get("findings", []), *self.content.get("character", [])]

    @cached_property
    def statements(self) -> Statements:
        """The diagnosis in words."""
        answers = _json(self.path / DECISION).get("answers", [])
        return statements(self.content, self.details, self.joint_names, answers)

    @cached_property
    def details(self) -> Mapping[str, Any]:
        """Content of details.json."""
        return _json(self.path / DETAILS)

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


def diagnosis_paper_figures(diagnosis: DiagnosisFolder, *, joints: str = "numbers") -> list[Figure]:
    """Figures of a diagnosis for a paper: held-out residuals, look-alikes, errors of the replay."""
    names = joint_labels(diagnosis.joint_names, joints)
    found = [look_alike_figure(pair, names) for pair in diagnosis.look_alikes]
    if diagnosis.residuals is not None:
        for side in diagnosis.residuals.sides:
            found += residual_figures(diagnosis.residuals, side, joints=joints)
    if diagnosis.replayed is not None:
        found += replay_figures(diagnosis.replayed, names)
    return found


def diagnosis_section(results: ResultFolder) -> str:
    """The diagnosis as a part of the report of a run."""
    diagnosis = DiagnosisFolder.of(results)
    if diagnosis is None:
        return section(
            "diagnosis",
            "Diagnosis",
            "<p>This folder holds no diagnosis. <code>lwr-run diagnose SESSION... --out "
            f"{escape(results.path.name)}/diagnosis</code> looks for errors of the model, and the next "
            "<code>lwr-run report</code> shows them here.</p>",
        )
    parts = (
        html if anchor == "findings" else f"<h3>{title}</h3>{html}"
        for anchor, title, html in diagnosis_parts(diagnosis)
    )
    return section("diagnosis", "Diagnosis", *parts)


def diagnosis_parts(diagnosis: DiagnosisFolder) -> list[tuple[str, str, str]]:
    """Anchor, title and HTML of each part with content, from the findings to the residuals."""
    said = diagnosis.statements
    answers = "".join(paragraph(f"{answer}.") for answer in said.answers)
    found = "".join(_finding(diagnosis, one) for one in said.findings) or paragraph(f"{said.headline}.")
    if said.character:
        found += paragraph("Character of the arm, as drives of its kind have it:")
        found += "".join(_finding(diagnosis, one) for one in said.character)
    asked = "".join(_beside(diagnosis, one) for one in said.comparisons if not one.finding)
    parts = [("findings", "Findings", answers + found), ("side-by-side", "Side by side", asked)]
    parts += [(part.anchor, part.title, _part(diagnosis, part)) for part in said.parts]
    parts.append(("residuals-held-out", "Held-out residuals", _residuals(diagnosis)))
    return [part for part in parts if part[2]]


def _finding(diagnosis: DiagnosisFolder, said: FindingStatement) -> str:
    finding = diagnosis.claims[said.number - 1]
    side, joints, title = str(finding.get("side", "")), finding.get("joints", []), capital(said.title)
    text = f"{said.text} {capital(said.confidence)}.".strip()
    facts = table(("", ""), said.facts, f"Evidence: {title}", classes="facts")
    parts = [f"<h3>{escape(title)}</h3>", paragraph(text), facts]
    if diagnosis.residuals is not None and side != "timing":
        numbers = {name: float(one["value"]) for name, one in (finding.get("parameters") or {}).items()}
        others = [j for one in diagnosis.claims if one is not finding for j in one.get("joints", [])]
        figure = finding_figure(diagnosis.residuals, said.cause, side, joints, numbers, others)
        parts += [figure_html(figure)] if figure is not None else []
    parts += [
        _beside(diagnosis, one) for one in diagnosis.statements.comparisons if one.finding == said.number
    ]
    statistics = table(("", ""), said.statistics, f"Statistics: {title}", classes="facts")
    return "".join([*parts, fold("Parameters and statistics", statistics)])


def _beside(diagnosis: DiagnosisFolder, said: Comparison) -> str:
    """Two causes side by side, with their signatures where the file has them."""
    pairs = diagnosis.look_alikes
    figure = look_alike_figure(pairs[said.place], diagnosis.joint_names) if pairs else None
    return (
        f"<h4>Side by side: {escape(said.title)}</h4>"
        f"{paragraph(f'{capital(said.overlap)}.')}"
        f"{paragraph(f'To decide: {said.decides}.') if said.decides else ''}"
        f"{'' if figure is None else figure_html(figure)}"
    )


def _part(diagnosis: DiagnosisFolder, said: Part) -> str:
    if said.anchor == "limits":
        return f"<ul>{''.join(f'<li>{with_code(capital(note))}.</li>' for note in said.sentences)}</ul>"
    html = "".join(map(paragraph, said.sentences)) + (_table(said) if said.rows else "")
    if said.anchor == "deciding":
        html += paragraph(run_advice(None if diagnosis.experiment is None else diagnosis.experiment.name))
    if said.anchor == "replay" and diagnosis.replayed is not None:
        figures = replay_figures(diagnosis.replayed, diagnosis.joint_names)
        html += "".join(fold(figure.caption, figure_html(figure)) for figure in figures)
        if diagnosis.experiment is not None:
            html += paragraph(
                f"In 3D with a time slider, or as a video: `lwr-run replay {diagnosis.experiment.name}`."
            )
    return html


def _table(said: Part) -> str:
    units = said.head.index("unit") if "unit" in said.head else -1

    def shown(place: int, cell: Cell) -> Cell:
        return pretty_unit(cell) if place == units and isinstance(cell, str) else cell

    return table(said.head, [[shown(*one) for one in enumerate(row)] for row in said.rows], said.title)


def _residuals(diagnosis: DiagnosisFolder) -> str:
    residuals = diagnosis.residuals
    if residuals is None:
        return ""
    figures = (
        figure for side in residuals.sides for figure in residual_figures(residuals, side, joints="names")
    )
    return "".join(fold(figure.caption, figure_html(figure)) for figure in figures)


def _json(path: Path) -> Mapping[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}
