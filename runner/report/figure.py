"""Figures as data with two faces: matplotlib for papers and notebooks, plotly for the page."""

from __future__ import annotations

import io
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runner.report.interactive import DIVERGING, heatmap_chart, heatmap_figure, plotly_figure
from runner.report.paper import checked_target, draw_matrix, draw_panels, paper_style, write_figure
from runner.report.plot import Panel, Role

Floats = NDArray[np.float64]
_SCREEN_FONT = "DejaVu Sans"  # comes with matplotlib
# Width of a drawing for a page, which stretches it to its place: it sets the size of the texts beside the lines.
_DRAWN_MM = 105.0


@dataclass(frozen=True)
class Drawing(ABC):
    """A figure with its caption. A notebook shows it by itself.

    name : for file names and anchors.
    """

    name: str
    caption: str

    @property
    @abstractmethod
    def alt(self) -> str:
        """Description in sentences, for screen readers."""

    @abstractmethod
    def _draw(self, width: str | float, columns: int | None, statistics: bool, shown: bool) -> NDArray[Any]:
        """The matplotlib axes; shown : known to pyplot."""

    def plot(
        self, width: str | float = "ieee-wide", *, columns: int | None = None, statistics: bool = False
    ) -> NDArray[Any]:
        """The matplotlib axes of the n panels, (n,); (n, 2) if panels have a lower part. Change them as you like.

        width : `ieee`, `ieee-wide`, `ifac`, `ifac-wide` or [mm]. columns : panels side by side; default: as many as
        stay legible. statistics : numbers such as the rms beside the title of each panel. A matrix is one panel
        without statistics. `plot()[0].figure.savefig(...)` writes a changed figure.
        """
        return self._draw(width, columns, statistics, True)

    def save(
        self,
        path: str | Path,
        width: str | float = "ieee-wide",
        *,
        columns: int | None = None,
        statistics: bool = False,
    ) -> Path:
        """Write the figure as PDF, PGF, SVG or PNG, by the suffix of the path; arguments as of `plot`.

        ConfigurationError for another suffix, a missing folder or an unknown width.
        """
        target = checked_target(path)
        axes = self._draw(width, columns, statistics, False)
        return write_figure(axes.flat[0].figure, target, self.caption, self.alt)

    def _repr_png_(self) -> bytes:
        figure = self._draw("ieee-wide", None, False, False).flat[0].figure
        stream = io.BytesIO()
        with paper_style():
            figure.savefig(stream, format="png", dpi=160)
        return stream.getvalue()


@dataclass(frozen=True)
class Figure(Drawing):
    """Small multiples under one caption."""

    panels: tuple[Panel, ...] = field(repr=False)

    @property
    def alt(self) -> str:
        """Description in sentences, for screen readers."""
        return " ".join(panel.alt for panel in self.panels)

    @property
    def legend(self) -> tuple[tuple[Role, str, str], ...]:
        """Role, label and kind (`Line`, `Band`, `Points`) of all marks, each once."""
        marks = (mark for panel in self.panels for mark in panel.marks if mark.label)
        return tuple(dict.fromkeys((mark.role, mark.label, type(mark).__name__) for mark in marks))

    def plotly(self, *, columns: int = 2) -> Any:
        """The figure as a plotly `Figure` with one subplot a panel; needs the extra `view`."""
        return plotly_figure(self.panels, columns=columns)

    def _draw(self, width: str | float, columns: int | None, statistics: bool, shown: bool) -> NDArray[Any]:
        return draw_panels(self.panels, width, columns=columns, statistics=statistics, shown=shown)


@dataclass(frozen=True, eq=False)
class MatrixFigure(Drawing):
    """A symmetric matrix (n, n) of values from -1 to 1 with its n names. alt : description in a sentence."""

    names: tuple[str, ...]
    values: Floats = field(repr=False)
    alt: str = ""

    def strongest(self, count: int) -> list[tuple[str, str, float]]:
        """The `count` pairs of different parameters with the largest magnitude, largest first."""
        first, second = np.triu_indices(len(self.names), 1)
        value = self.values[first, second]
        order = np.argsort(-np.abs(value), kind="stable")[:count]
        return [(self.names[first[k]], self.names[second[k]], float(value[k])) for k in order]

    def chart(self) -> dict[str, Any]:
        """As plotly `data` and `layout`."""
        return heatmap_chart(self.names, self.values)

    def plotly(self, *, columns: int = 1) -> Any:
        """The matrix as a plotly `Figure`; needs the extra `view`."""
        return heatmap_figure(self.chart(), self.caption)

    def _draw(self, width: str | float, columns: int | None, statistics: bool, shown: bool) -> NDArray[Any]:
        return np.array([draw_matrix(self.names, self.values, DIVERGING, width, shown=shown)], dtype=object)


def inline_svg(panel: Panel) -> str:
    """One panel as an SVG element for a page, as wide as its place."""
    axes = draw_panels([panel], _DRAWN_MM, font=_SCREEN_FONT)
    stream = io.StringIO()
    with paper_style(_SCREEN_FONT):
        axes.flat[0].figure.savefig(stream, format="svg", metadata={"Date": None})
    text = stream.getvalue()
    head = f"<svg role='img' style='width:100%;height:auto' aria-label='{escape(panel.alt, quote=True)}' "
    return text[text.index("<svg") :].replace("<svg ", head, 1)
