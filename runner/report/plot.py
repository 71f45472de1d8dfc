"""A figure as data: panels with marks in named roles, drawn later as interactive plot or as SVG.

The roles carry the colours (Okabe and Ito, distinguishable with every common colour vision) and the line
styles of the paper: measured solid blue, computed dotted red, error dashed black.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

__all__ = ["STYLES", "Band", "Figure", "Line", "Mark", "Panel", "Points", "Role", "Style"]

Floats = NDArray[np.float64]
Role = Literal[
    "logged", "measured", "computed", "error", "limit", "forward", "backward", "estimate", "truth",
    "published", "spread",
]  # fmt: skip
Symbol = Literal["circle", "cross", "diamond"]


@dataclass(frozen=True)
class Style:
    """How a role looks: colour, width [px], dash pattern in px ("" for solid), symbol of points."""

    colour: str
    width: float = 1.4
    dash: str = ""
    symbol: Symbol = "circle"


STYLES: dict[Role, Style] = {
    "logged": Style("#9ecae9", 0.8),
    "measured": Style("#0072b2", 1.8),
    "computed": Style("#d55e00", 1.8, "3 4"),
    "error": Style("#000000", 0.8, "5 3"),
    "limit": Style("#767676", 1.2, "4 4"),
    "forward": Style("#0072b2", 1.8),
    "backward": Style("#d55e00", 1.8, "4 3"),
    "estimate": Style("#0072b2", 1.6, symbol="circle"),
    "truth": Style("#000000", 1.6, symbol="cross"),
    "published": Style("#d55e00", 1.6, symbol="diamond"),
    "spread": Style("#9ecae9", 0.0),
}


@dataclass(frozen=True, eq=False)
class Line:
    """y over x, both (k,). lower : drawn in the lower part of the panel, on a scale of its own."""

    role: Role
    label: str
    x: Floats
    y: Floats
    lower: bool = False


@dataclass(frozen=True, eq=False)
class Band:
    """The area between low and high (k,) over x (k,)."""

    role: Role
    label: str
    x: Floats
    low: Floats
    high: Floats
    lower: bool = False


@dataclass(frozen=True, eq=False)
class Points:
    """Single points, (k,), with intervals (k, 2) or None, and a text for each."""

    role: Role
    label: str
    x: Floats
    y: Floats
    interval: Floats | None = None
    texts: tuple[str, ...] = ()
    lower: bool = False


Mark = Line | Band | Points


@dataclass(frozen=True)
class Panel:
    """One plot. alt : what it shows, in a sentence, for those who do not see it.

    title : short, above the plot; note : a number or two beside the title. lower_label : of the lower part.
    x_names : texts in place of numbers at x = 1, 2, ...
    """

    title: str
    x_label: str
    y_label: str
    marks: tuple[Mark, ...]
    alt: str
    note: str = ""
    lower_label: str = ""
    x_names: tuple[str, ...] = ()

    @property
    def split(self) -> bool:
        """Whether there is a lower part."""
        return any(mark.lower for mark in self.marks)


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
        """Role, label and kind of mark (`Line`, `Band`, `Points`) of everything that is drawn, each once."""
        seen: dict[tuple[Role, str, str], None] = {}
        for panel in self.panels:
            for mark in panel.marks:
                if mark.label:
                    seen[mark.role, mark.label, type(mark).__name__] = None
        return tuple(seen)

    def svg(self, *, columns: int = 2, width: float = 720.0) -> str:
        """The figure as a stand-alone SVG text, `width` px wide; needs no other package."""
        from runner.report.svg import figure_svg

        return figure_svg(self, columns=columns, width=width)

    def save(self, path: str | Path, *, columns: int = 2, width: float = 720.0) -> Path:
        """Write the SVG to a file."""
        target = Path(path)
        target.write_text(self.svg(columns=columns, width=width), encoding="utf-8")
        return target

    def plotly(self, *, columns: int = 2) -> Any:
        """The figure as a plotly `Figure` with one subplot a panel; needs the extra `view`."""
        from runner.report.interactive import plotly_figure

        return plotly_figure(self, columns=columns)

    def _repr_svg_(self) -> str:
        return self.svg()


def limits(values: Sequence[Floats], *, pad: float = 0.04) -> tuple[float, float]:
    """Range of an axis that shows all values, a little wider; 0 to 1 where there is none."""
    finite = [v[np.isfinite(v)] for v in values]
    finite = [v for v in finite if len(v)]
    if not finite:
        return 0.0, 1.0
    low, high = min(float(v.min()) for v in finite), max(float(v.max()) for v in finite)
    room = pad * (high - low) if high > low else 0.5 * abs(high) or 0.5
    return low - room, high + room
