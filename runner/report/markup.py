"""Pieces of HTML: tables of selectable numbers, figures with their texts, foldable parts."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import Any

from ident.diagnosis.outcome.statements import Number
from runner.report.figure import Figure
from runner.report.interactive import chart_json, panel_chart
from runner.report.plot import STYLES, Role

MOST_PERCENT = 1000.0
"""Largest percentage worth its digits: the number is not told from zero."""

Cell = str | Number

_NUMBER = " class=n"
_DATA = ("<script type='application/json'>", "</script>")
_SIGNS = {"circle": "\N{BLACK CIRCLE}", "cross": "\N{MULTIPLICATION SIGN}", "diamond": "\N{WHITE DIAMOND}"}


def number_html(number: Number) -> str:
    """A number as text with all its digits and its key in the markup, or a dash."""
    if number.value is None or not math.isfinite(number.value):
        return "–" if number.value is None or math.isnan(number.value) else "∞"
    key = f" data-key='{escape(number.key, quote=True)}'" if number.key else ""
    if abs(number.value) > number.most:
        beyond = f"&lt; \N{MINUS SIGN}{number.most:g}" if number.value < 0.0 else f"&gt; {number.most:g}"
        return f"<data value='{number.value!r}'{key}>{beyond}</data>"
    shown = format(number.value, number.form)
    if not shown.strip("+-0."):
        shown = shown.lstrip("+-")
    shown = shown.replace("-", "\N{MINUS SIGN}")
    return f"<data value='{number.value!r}'{key}>{shown}</data>"


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
    # A heading without text is none to a screen reader.
    heads = [f"<th scope=col{_NUMBER * n}>{escape(name)}</th>" if name else "<td></td>" for name, n in titles]
    lines = [f"<tr>{''.join(heads)}</tr>"]
    for index, row in enumerate(rows):
        cells = []
        for place, cell in enumerate(row):
            number = isinstance(cell, Number)
            text = number_html(cell) if isinstance(cell, Number) else escape(cell)
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
    return table(("condition", "found", "limit", "verdict"), rows, label)


def figure_html(figure: Figure, *, tall: bool = False) -> str:
    """Small multiples: legend, then one chart a panel, drawn by the page's script."""
    keys = "".join(f"<li>{_key(role, kind)}{escape(label)}</li>" for role, label, kind in figure.legend)
    panels = []
    for panel in figure.panels:
        chart = chart_html(panel_chart(panel), panel.alt, "tall" if tall or panel.split else "")
        note = f" <span>{escape(panel.note)}</span>" if panel.note else ""
        panels.append(f"<figure><figcaption><b>{escape(panel.title)}</b>{note}</figcaption>{chart}</figure>")
    return f"<ul class=legend>{keys}</ul><div class=panels>{''.join(panels)}</div>"


def chart_html(chart: dict[str, Any], alt: str, classes: str = "") -> str:
    """A chart to be drawn by the page's script; `take_charts` moves its data to one place of the page."""
    data = chart_json(chart).replace("</", "<\\/")
    return (
        f"<div class='chart {classes}' role=figure aria-label='{escape(alt, quote=True)}'></div>"
        f"{_DATA[0]}{data}{_DATA[1]}"
    )


def take_charts(content: str) -> tuple[str, str]:
    """The content without the data of its charts, and all of them as a JSON list in the order of the charts."""
    charts: list[str] = []
    parts = content.split(_DATA[0])
    kept = [parts[0]]
    for part in parts[1:]:
        data, _, rest = part.partition(_DATA[1])
        charts.append(data)
        kept.append(rest)
    return "".join(kept), f"[{','.join(charts)}]"


def _key(role: Role, kind: str) -> str:
    """A sample of a mark, for legends."""
    style = STYLES[role]
    if kind == "Points":
        return f"<i class=key style='color:{style.colour}' aria-hidden=true>{_SIGNS[style.symbol]}</i>"
    if kind == "Band":
        look = f"height:10px;background:{style.colour};opacity:0.55"
    else:
        look = f"border-top:{max(style.width, 1.5):g}px {'dashed' if style.dash else 'solid'} {style.colour}"
    return f"<i class=key style='{look}' aria-hidden=true></i>"


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
    return f"<p{name}>{with_code(text)}</p>"


def with_code(text: str) -> str:
    """Plain text as markup, with code between backticks."""
    parts = [escape(part) for part in text.split("`")]
    return "".join(f"<code>{part}</code>" if index % 2 else part for index, part in enumerate(parts))
