"""Pieces of HTML: tables of selectable numbers, figures with their texts, foldable parts."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

from runner.report.interactive import panel_chart
from runner.report.svg import Figure, legend_key


@dataclass(frozen=True)
class Number:
    """A number in a table: shown short, all its digits in the markup, named by its key in summary.json."""

    value: float | None
    form: str = ".4g"
    key: str = ""

    def html(self) -> str:
        """The number as text, or a dash."""
        if self.value is None or not math.isfinite(self.value):
            return "–" if self.value is None or math.isnan(self.value) else "∞"
        key = f" data-key='{escape(self.key, quote=True)}'" if self.key else ""
        shown = format(self.value, self.form)
        if not shown.strip("+-0."):
            shown = shown.lstrip("+-")
        shown = shown.replace("-", "\N{MINUS SIGN}")
        return f"<data value='{self.value!r}'{key}>{shown}</data>"


Cell = str | Number

_NUMBER = " class=n"


def table(
    head: Sequence[str],
    rows: Iterable[Sequence[Cell]],
    label: str,
    *,
    classes: str = "",
    strong: Sequence[int] = (),
) -> str:
    """A table; the first cell of a row is its heading, numbers stand right. label : for screen readers.

    strong : rows to stress.
    """
    rows = list(rows)
    right = [any(isinstance(row[place], Number) for row in rows) for place in range(len(head))]
    titles = zip(head, right, strict=True)
    lines = [f"<tr>{''.join(f'<th scope=col{_NUMBER * n}>{escape(name)}</th>' for name, n in titles)}</tr>"]
    for index, row in enumerate(rows):
        cells = []
        for place, cell in enumerate(row):
            number = isinstance(cell, Number)
            text = cell.html() if isinstance(cell, Number) else escape(cell)
            if place == 0:
                cells.append(f"<th scope=row>{text}</th>")
            else:
                cells.append(f"<td class=n>{text}</td>" if number else f"<td>{text}</td>")
        stress = " class=strong" if index in strong else ""
        lines.append(f"<tr{stress}>{''.join(cells)}</tr>")
    name = f" class='{classes}'" if classes else ""
    return (
        f"<div class=scroll tabindex=0 role=region aria-label='{escape(label, quote=True)}'>"
        f"<table{name}><caption class=hidden>{escape(label)}</caption><thead>{lines[0]}</thead>"
        f"<tbody>{''.join(lines[1:])}</tbody></table></div>"
    )


def conditions_table(items: Iterable[Mapping[str, Any]], label: str) -> str:
    """The conditions of a preflight, each with `subject`, `value`, `limit` and `ok`."""
    rows = [[i["subject"], i["value"], i["limit"], "held" if i["ok"] else "NOT HELD"] for i in items]
    return table(("condition", "found", "limit", ""), rows, label)


def figure_html(figure: Figure, *, tall: bool = False) -> str:
    """Small multiples: legend, then one chart a panel, drawn by the page's script when it comes into view."""
    keys = "".join(
        f"<li><svg width=24 height=12 viewBox='0 -6 24 12' aria-hidden=true>{legend_key(role, kind)}</svg>"
        f"{escape(label)}</li>"
        for role, label, kind in figure.legend
    )
    panels = []
    for panel in figure.panels:
        chart = chart_html(panel_chart(panel), panel.alt, "tall" if tall or panel.split else "")
        note = f" <span>{escape(panel.note)}</span>" if panel.note else ""
        panels.append(f"<figure><figcaption><b>{escape(panel.title)}</b>{note}</figcaption>{chart}</figure>")
    return f"<ul class=legend>{keys}</ul><div class=panels>{''.join(panels)}</div>"


def chart_html(chart: dict[str, Any], alt: str, classes: str = "") -> str:
    """A chart to be drawn by the page's script, with its data beside it."""
    data = json.dumps(chart, separators=(",", ":"), allow_nan=False).replace("</", "<\\/")
    return (
        f"<div class='chart {classes}' role=img aria-label='{escape(alt, quote=True)}'></div>"
        f"<script type='application/json'>{data}</script>"
    )


def section(anchor: str, title: str, *parts: str) -> str:
    """A part of the report under a heading of its own."""
    return f"<section id='{anchor}'><h2>{escape(title)}</h2>{''.join(parts)}</section>"


def fold(title: str, *parts: str, is_open: bool = False) -> str:
    """A foldable part."""
    state = " open" if is_open else ""
    return f"<details{state}><summary>{escape(title)}</summary>{''.join(parts)}</details>"


def paragraph(text: str, classes: str = "") -> str:
    """A paragraph of plain text, with code between backticks."""
    name = f" class='{classes}'" if classes else ""
    parts = [escape(part) for part in text.split("`")]
    marked = "".join(f"<code>{part}</code>" if index % 2 else part for index, part in enumerate(parts))
    return f"<p{name}>{marked}</p>"
