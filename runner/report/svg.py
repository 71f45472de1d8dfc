"""Figures as small multiples, drawn as SVG: for papers, print and notebooks."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runner.report.interactive import plotly_figure
from runner.report.plot import STYLES, Band, Line, Mark, Panel, Points, Role, Symbol, limits

Floats = NDArray[np.float64]
Box = tuple[float, float, float, float]

_FONT = "font-family='Helvetica,Arial,sans-serif'"
_LEFT, _RIGHT, _TOP, _BOTTOM = 60.0, 10.0, 24.0, 36.0
_LEGEND_LINE = 18.0
_LOWER_SHARE = 0.3
_PANEL_HEIGHT = 190.0
_GREY = "#595959"


@dataclass(frozen=True)
class Figure:
    """Small multiples under one caption. A notebook shows it by itself.

    name : for file names and anchors.
    """

    name: str
    caption: str
    panels: tuple[Panel, ...] = field(repr=False)

    @property
    def legend(self) -> tuple[tuple[Role, str, str], ...]:
        """Role, label and kind (`Line`, `Band`, `Points`) of all marks, each once."""
        marks = (mark for panel in self.panels for mark in panel.marks if mark.label)
        return tuple(dict.fromkeys((mark.role, mark.label, type(mark).__name__) for mark in marks))

    def svg(self, *, columns: int = 2, width: float = 720.0) -> str:
        """The figure as a stand-alone SVG text, `width` px wide: legend, then panels in rows of `columns`."""
        columns = max(1, min(columns, len(self.panels)))
        legend, top = _legend(self, width)
        each = width / columns
        height = top + math.ceil(len(self.panels) / columns) * _PANEL_HEIGHT
        parts = [
            f"<svg xmlns='http://www.w3.org/2000/svg' width='{width:g}' height='{height:g}' "
            f"viewBox='0 0 {width:g} {height:g}' role='img'>",
            f"<title>{escape(self.caption)}</title>",
            f"<desc>{escape(' '.join(panel.alt for panel in self.panels))}</desc>",
            "<rect width='100%' height='100%' fill='#ffffff'/>",
            *legend,
        ]
        for index, panel in enumerate(self.panels):
            x, y = (index % columns) * each, top + (index // columns) * _PANEL_HEIGHT
            parts.append(f"<g transform='translate({x:g},{y:g})'>{_panel(panel, each, _PANEL_HEIGHT)}</g>")
        return "".join([*parts, "</svg>\n"])

    def save(self, path: str | Path, *, columns: int = 2, width: float = 720.0) -> Path:
        """Write the SVG to a file."""
        target = Path(path)
        target.write_text(self.svg(columns=columns, width=width), encoding="utf-8")
        return target

    def plotly(self, *, columns: int = 2) -> Any:
        """The figure as a plotly `Figure` with one subplot a panel; needs the extra `view`."""
        return plotly_figure(self.panels, columns=columns)

    def _repr_svg_(self) -> str:
        return self.svg()


def panel_svg(panel: Panel, *, width: float = 560.0, height: float = 200.0) -> str:
    """One panel as an SVG element, scaled by its container."""
    return (
        f"<svg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 {width:g} {height:g}' role='img' "
        f"style='width:100%;height:auto' aria-label='{escape(panel.alt, quote=True)}'>"
        f"{_panel(panel, width, height)}</svg>"
    )


def ticks(low: float, high: float, wanted: int = 5) -> list[float]:
    """Round numbers between low and high, about `wanted` of them."""
    if not high > low:
        return [low]
    raw = (high - low) / max(wanted, 1)
    power = 10.0 ** math.floor(math.log10(raw))
    step = next((f * power for f in (1.0, 2.0, 2.5, 5.0, 10.0) if f * power >= raw), 10.0 * power)
    first = math.ceil(low / step - 1e-9)
    last = math.floor(high / step + 1e-9)
    return [round(k * step, 12) + 0.0 for k in range(first, last + 1)]


def _panel(panel: Panel, width: float, height: float) -> str:
    inner_width, inner_height = width - _LEFT - _RIGHT, height - _TOP - _BOTTOM
    upper = [mark for mark in panel.marks if not mark.lower]
    lower = [mark for mark in panel.marks if mark.lower]
    span = (0.5, len(panel.x_names) + 0.5) if panel.x_names else limits([m.x for m in panel.marks], pad=0.0)
    parts = [
        f"<text x='{_LEFT:g}' y='15' {_FONT} font-size='12' font-weight='bold' fill='#1a1a1a'>"
        f"{escape(panel.title)}"
        f"<tspan dx='8' font-weight='normal' fill='{_GREY}'>{escape(panel.note)}</tspan></text>"
    ]
    gap = 10.0 if lower else 0.0
    first = inner_height * (1.0 - _LOWER_SHARE) - gap if lower else inner_height
    parts.append(_axes(upper, span, (_LEFT, _TOP, inner_width, first), panel.y_label))
    if lower:
        part = (_LEFT, _TOP + first + gap, inner_width, inner_height - first - gap)
        parts.append(_axes(lower, span, part, panel.lower_label))
    parts.append(_x_ticks(panel, span, (_LEFT, _TOP, inner_width, inner_height)))
    return "".join(parts)


def _axes(marks: Sequence[Mark], span: tuple[float, float], box: Box, label: str) -> str:
    x0, y0, width, height = box
    low, high = limits([column for mark in marks for column in _columns(mark)])

    def at(x: Floats, y: Floats) -> Floats:
        scale = (span[1] - span[0]) or 1.0
        return np.column_stack(
            [x0 + (x - span[0]) / scale * width, y0 + height - (y - low) / (high - low) * height]
        )

    parts = []
    for value in ticks(low, high, 4 if height > 70 else 3):
        heavy = 1.4 if value == 0 else 0.8
        y = y0 + height - (value - low) / (high - low) * height
        parts.append(
            f"<path d='M{x0:g} {y:.1f}h{width:g}' stroke='#e3e3e3' stroke-width='{heavy}'/>"
            f"<text x='{x0 - 5:g}' y='{y + 3.5:.1f}' {_FONT} font-size='10' fill='{_GREY}' text-anchor='end'>"
            f"{_number(value)}</text>"
        )
    parts.append(
        f"<text transform='translate(11,{y0 + height / 2:.1f}) rotate(-90)' {_FONT} font-size='10' "
        f"fill='{_GREY}' text-anchor='middle'>{escape(label)}</text>"
    )
    parts += [_mark(mark, at) for mark in marks]
    parts.append(
        f"<rect x='{x0:g}' y='{y0:g}' width='{width:g}' height='{height:g}' fill='none' stroke='#8c8c8c' "
        "stroke-width='0.8'/>"
    )
    return "".join(parts)


def _columns(mark: Mark) -> list[Floats]:
    if isinstance(mark, Band):
        return [mark.low, mark.high]
    if isinstance(mark, Points) and mark.interval is not None:
        return [mark.y, mark.interval[:, 0], mark.interval[:, 1]]
    return [mark.y]


def _mark(mark: Mark, place: Callable[[Floats, Floats], Floats]) -> str:
    style = STYLES[mark.role]
    if isinstance(mark, Band):
        outline = np.vstack([place(mark.x, mark.low), place(mark.x, mark.high)[::-1]])
        return f"<path d='{_path(outline)}Z' fill='{style.colour}' fill-opacity='0.55' stroke='none'/>"
    if isinstance(mark, Line):
        dash = f" stroke-dasharray='{style.dash}'" if style.dash else ""
        return (
            f"<path d='{_path(place(mark.x, mark.y))}' fill='none' stroke='{style.colour}' "
            f"stroke-width='{style.width:g}' stroke-linejoin='round'{dash}/>"
        )
    parts = []
    if mark.interval is not None:
        lows, highs = place(mark.x, mark.interval[:, 0]), place(mark.x, mark.interval[:, 1])
        bars = "".join(f"M{x:.1f} {y:.1f}V{end:.1f}" for (x, y), (_, end) in zip(lows, highs, strict=True))
        parts.append(f"<path d='{bars}' stroke='{style.colour}' stroke-width='{style.width:g}'/>")
    parts += [_symbol(style.symbol, x, y, style.colour) for x, y in place(mark.x, mark.y)]
    return "".join(parts)


def _symbol(symbol: Symbol, x: float, y: float, colour: str) -> str:
    stroke = f"stroke='{colour}' stroke-width='1.4' fill='none'"
    if symbol == "cross":
        return f"<path d='M{x - 4:.1f} {y - 4:.1f}l8 8m0-8l-8 8' {stroke}/>"
    if symbol == "diamond":
        return f"<path d='M{x:.1f} {y - 5:.1f}l5 5l-5 5l-5-5Z' {stroke}/>"
    return f"<circle cx='{x:.1f}' cy='{y:.1f}' r='3' fill='{colour}'/>"


def _path(points: Floats) -> str:
    return "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in points) if len(points) else ""


def _x_ticks(panel: Panel, span: tuple[float, float], box: Box) -> str:
    x0, y0, width, height = box
    if panel.x_names:
        marks = [(float(k + 1), name) for k, name in enumerate(panel.x_names)]
    else:
        marks = [(value, _number(value)) for value in ticks(*span, max(3, int(width // 70)))]
    scale = (span[1] - span[0]) or 1.0
    parts = []
    for value, text in marks:
        x = x0 + (value - span[0]) / scale * width
        parts.append(
            f"<path d='M{x:.1f} {y0 + height:g}v4' stroke='#8c8c8c' stroke-width='0.8'/>"
            f"<text x='{x:.1f}' y='{y0 + height + 14:g}' {_FONT} font-size='10' fill='{_GREY}' "
            f"text-anchor='middle'>{escape(text)}</text>"
        )
    parts.append(
        f"<text x='{x0 + width / 2:g}' y='{y0 + height + 28:g}' {_FONT} font-size='10' fill='{_GREY}' "
        f"text-anchor='middle'>{escape(panel.x_label)}</text>"
    )
    return "".join(parts)


def _number(value: float) -> str:
    return f"{value:.6g}".replace("-", "\N{MINUS SIGN}")


def _legend(figure: Figure, width: float) -> tuple[list[str], float]:
    parts, x, y = [], 10.0, 14.0
    for role, label, kind in figure.legend:
        length = 34.0 + 6.2 * len(label)
        if x + length > width and x > 10.0:
            x, y = 10.0, y + _LEGEND_LINE
        parts.append(
            f"<g transform='translate({x:g},{y:g})'>{legend_key(role, kind)}"
            f"<text x='30' y='4' {_FONT} font-size='11' fill='#1a1a1a'>{escape(label)}</text></g>"
        )
        x += length + 12.0
    return parts, y + 12.0 if parts else 0.0


def legend_key(role: Role, kind: str) -> str:
    """A sample of a mark, 24 px wide around y = 0, for legends."""
    style = STYLES[role]
    if kind == "Band":
        return f"<rect x='0' y='-5' width='24' height='10' fill='{style.colour}' fill-opacity='0.55'/>"
    if kind == "Points":
        return _symbol(style.symbol, 12.0, 0.0, style.colour)
    dash = f" stroke-dasharray='{style.dash}'" if style.dash else ""
    return f"<path d='M0 0h24' stroke='{style.colour}' stroke-width='{max(style.width, 1.2):g}'{dash}/>"
