"""`report.html`: one self-contained file."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from importlib import resources
from pathlib import Path

from fri.errors import naming
from runner.computer import versions
from runner.report import sections
from runner.report.diagnosis import DiagnosisFolder, diagnosis_parts, diagnosis_section
from runner.report.folder import ResultFolder
from runner.report.hidden import hidden_section
from runner.report.interactive import lighter_charts, plotly_script, zipped
from runner.report.markup import section, take_charts
from runner.report.verdicts import Level, Verdict, headline, verdicts

REPORT = "report.html"
_LARGEST = 3_900_000
"""Bytes of a page; the lines of its charts lose points to stay below."""

_MARKS = {"good": "\N{CHECK MARK} good", "look": "! look", "bad": "\N{MULTIPLICATION X} bad"}
_SECTIONS = (
    sections.session_section,
    sections.table_1_section,
    sections.table_2_section,
    sections.motion_section,
    sections.torque_section,
    sections.residual_section,
    sections.assumption_section,
    hidden_section,
    diagnosis_section,
    sections.parameter_section,
    sections.provenance_section,
)
_PARTS = (
    ("sessions", "Sessions"),
    ("table-1", "Table 1"),
    ("table-2", "Table 2"),
    ("motion", "Figure 2"),
    ("torque", "Figure 3"),
    ("residuals", "Residuals"),
    ("assumptions", "Assumptions"),
    ("hidden", "Hidden"),
    ("diagnosis", "Diagnosis"),
    ("parameters", "Parameters"),
    ("correlation", "Correlation"),
    ("provenance", "Provenance"),
)


def write_report(folder: str | Path) -> Path:
    """Write `report.html` into a folder of results; returns its path.

    ConfigurationError without results in the folder, or without the extra `view`.
    """
    results = ResultFolder.load(folder)
    return write_page(report_html(results), results.path / REPORT)


def write_diagnosis_report(folder: str | Path) -> Path:
    """Write `report.html` into a folder of `lwr-run diagnose`; returns its path.

    ConfigurationError where the folder holds no diagnosis or the extra `view` is not installed.
    """
    diagnosis = DiagnosisFolder.load(folder)
    return write_page(diagnosis_html(diagnosis), diagnosis.path / REPORT)


def diagnosis_html(diagnosis: DiagnosisFolder) -> str:
    """The text of the page of a diagnosis."""
    parts, said = diagnosis_parts(diagnosis), diagnosis.statements
    return page_html(
        "Diagnosis",
        escape(f"{said.about} · {diagnosis.path.resolve().name}"),
        (said.level, said.headline),
        [Verdict(line.subject, line.found, line.wanted, line.level, line.anchor) for line in said.lines],
        "".join(section(anchor, title, html) for anchor, title, html in parts),
        [(anchor, title) for anchor, title, _ in parts],
        str(versions()["software"]),
    )


def write_page(text: str, target: Path) -> Path:
    """Write a page, whole or not at all; returns its path."""
    draft = target.with_suffix(".html.part")
    with naming(draft):
        draft.write_text(text, encoding="utf-8")
    draft.replace(target)
    return target


def report_html(results: ResultFolder) -> str:
    """The text of the report."""
    lines = verdicts(results)
    return page_html(
        str(results.summary["experiment"]),
        _subtitle(results),
        headline(lines),
        lines,
        "".join(part(results) for part in _SECTIONS),
        _PARTS,
        str(results.summary.get("versions", {}).get("software", "")),
    )


def page_html(
    name: str,
    subtitle: str,
    verdict: tuple[Level, str],
    lines: Sequence[Verdict],
    content: str,
    parts: Sequence[tuple[str, str]],
    software: str,
) -> str:
    """A whole page: title, verdict with its table, links to the parts, and the parts.

    subtitle, content : HTML. parts : anchors and titles of possible sections of the content.
    """
    script = zipped(plotly_script())
    content, charts = take_charts(content)
    budget = _LARGEST - len(script) - len(content.encode("utf-8"))
    links = "".join(
        f"<a href='#{anchor}'>{title}</a>" for anchor, title in parts if f"<section id='{anchor}'" in content
    )
    level, sentence = verdict
    return (
        "<!doctype html><html lang=en><head><meta charset=utf-8>"
        "<meta name=viewport content='width=device-width, initial-scale=1'>"
        f"<title>{escape(name)}: {escape(sentence)}</title><link rel=icon href='data:,'>"
        f"<style>{_asset('page.css')}</style></head>"
        f"<body><header><h1>{subtitle}</h1><p class=verdict>{_badge(level)}"
        f"<span>{escape(sentence)}</span></p>"
        f"{_verdict_table(lines, content)}<nav aria-label='Parts of the report'>{links}</nav></header>"
        f"<main>{content}</main>"
        f"<footer>Written by {escape(software)}. This file needs no network; print it or keep it beside the logs."
        "</footer>"
        f"<script type='application/gzip' id=charts>{zipped(lighter_charts(charts, budget))}</script>"
        f"<script type='application/gzip' id=plotly>{script}</script>"
        f"<script>{_asset('page.js')}</script></body></html>\n"
    )


def _subtitle(results: ResultFolder) -> str:
    summary = results.summary
    meta = next((log.metadata for log in results.sessions.values()), {})
    robot = f"{meta.get('robot', '')} {meta.get('serial', '')}".strip()
    emulated = " (emulated)" if results.emulated else ""
    started = "" if emulated else meta.get("utc_start", "")[:10]
    # A recording without date starts at the epoch.
    started = "" if started.startswith("1970") else started
    parts = [
        "Identification from logs" if summary.get("from_logs") else f"Experiment {summary['experiment']}",
        f"{robot}{emulated}" if robot else "",
        started,
        results.path.resolve().name,
    ]
    return " · ".join(escape(part) for part in parts if part)


def _verdict_table(lines: Sequence[Verdict], content: str) -> str:
    rows = []
    for line in lines:
        subject = escape(line.subject)
        there = line.section and f"<section id='{line.section}'" in content
        linked = f"<a href='#{line.section}'>{subject}</a>" if there else subject
        rows.append(
            f"<tr><th scope=row>{linked}</th><td>{escape(line.found)}</td>"
            f"<td class=wanted>{escape(line.wanted)}</td><td class=mark>{_badge(line.level)}</td></tr>"
        )
    return (
        "<table class=verdicts><caption class=hidden>Was the run good?</caption><thead><tr>"
        "<th scope=col>question</th><th scope=col>found</th><th scope=col>wanted</th><th "
        "scope=col>verdict</th></tr></thead>"
        f"<tbody>{''.join(rows)}</tbody></table>"
    )


def _badge(level: Level) -> str:
    return f"<span class='badge {level}'>{_MARKS[level]}</span>"


def _asset(name: str) -> str:
    return resources.files("runner.report").joinpath(name).read_text(encoding="utf-8")
