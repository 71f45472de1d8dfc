"""The layout of a diagnosis in HTML, as a part of the report of a run or as the parts of a page of its own."""

from __future__ import annotations

from html import escape

from ident.diagnosis.statements import Comparison, FindingStatement, Part, Table, run_advice
from ident.diagnosis.statements import Number as Quantity
from runner.report.diagnosis_figures import (
    finding_figure,
    look_alike_figure,
    replay_figures,
    residual_figures,
)
from runner.report.diagnosis_folder import DiagnosisFolder
from runner.report.figures import pretty_unit
from runner.report.folder import ResultFolder
from runner.report.markup import Cell, Number, figure_html, fold, paragraph, section, table

__all__ = ["diagnosis_parts", "diagnosis_section"]


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
    asked = "".join(_beside(diagnosis, one) for one in said.comparisons if not one.finding)
    parts = [("findings", "Findings", answers + found), ("side-by-side", "Side by side", asked)]
    parts += [(part.anchor, part.title, _part(diagnosis, part)) for part in said.parts]
    parts.append(("residuals-held-out", "Held-out residuals", _residuals(diagnosis)))
    return [part for part in parts if part[2]]


def _finding(diagnosis: DiagnosisFolder, said: FindingStatement) -> str:
    finding = diagnosis.findings[said.number - 1]
    side, joints, title = str(finding.get("side", "")), finding.get("joints", []), _capital(said.title)
    text = f"{said.text} {_capital(said.confidence)}.".strip()
    facts = table(("", ""), said.facts, f"Evidence: {title}", classes="facts")
    parts = [f"<h3>{escape(title)}</h3>", paragraph(text), facts]
    if diagnosis.residuals is not None and side != "timing":
        numbers = {name: float(one["value"]) for name, one in (finding.get("parameters") or {}).items()}
        others = [j for one in diagnosis.findings if one is not finding for j in one.get("joints", [])]
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
        f"{paragraph(f'{_capital(said.overlap)}.')}"
        f"{paragraph(f'To decide: {said.decides}.') if said.decides else ''}"
        f"{'' if figure is None else figure_html(figure)}"
    )


def _part(diagnosis: DiagnosisFolder, said: Part) -> str:
    if said.anchor == "limits":
        return f"<ul>{''.join(f'<li>{escape(_capital(note))}.</li>' for note in said.sentences)}</ul>"
    html = "".join(map(paragraph, said.sentences)) + ("" if said.table is None else _table(said.table))
    if said.anchor == "deciding":
        html += paragraph(run_advice(None if diagnosis.experiment is None else diagnosis.experiment.name))
    if said.anchor == "replay" and diagnosis.replayed is not None:
        figures = replay_figures(diagnosis.replayed, diagnosis.joint_names)
        html += "".join(fold(figure.caption, figure_html(figure)) for figure in figures)
    return html


def _table(said: Table) -> str:
    units = said.head.index("unit") if "unit" in said.head else -1
    rows: list[list[Cell]] = [
        [
            Number(cell.value, cell.form, cell.key)
            if isinstance(cell, Quantity)
            else pretty_unit(cell)
            if place == units
            else cell
            for place, cell in enumerate(row)
        ]
        for row in said.rows
    ]
    return table(said.head, rows, said.title)


def _residuals(diagnosis: DiagnosisFolder) -> str:
    """Residuals against everything, folded."""
    residuals = diagnosis.residuals
    if residuals is None:
        return ""
    figures = (figure for side in residuals.sides for figure in residual_figures(residuals, side))
    return "".join(fold(figure.caption, figure_html(figure)) for figure in figures)


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]
