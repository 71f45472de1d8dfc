"""How the estimates of the parameters depend on each other: their correlation matrix as a figure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fri.errors import ConfigurationError
from runner.report.folder import ResultFolder
from runner.report.interactive import DIVERGING, heatmap_chart, heatmap_figure

__all__ = ["STRONG", "MatrixFigure", "correlation_figure"]

Floats = NDArray[np.float64]

STRONG = 0.7
"""Correlation from which a pair is worth naming."""

_LEVELS = 20
_FONT = "font-family='Helvetica,Arial,sans-serif'"
_INK = "#1a1a1a"
_SCALE_WIDTH = 56.0


@dataclass(frozen=True, eq=False)
class MatrixFigure:
    """A symmetric matrix (n, n) of values from -1 to 1 with its n names. A notebook shows it by itself.

    name : for file names. alt : what it shows, in a sentence, for those who do not see it.
    """

    name: str
    caption: str
    names: tuple[str, ...]
    values: Floats
    alt: str

    def strongest(self, count: int) -> list[tuple[str, str, float]]:
        """The `count` pairs of different parameters with the largest magnitude, largest first."""
        first, second = np.triu_indices(len(self.names), 1)
        value = self.values[first, second]
        order = np.argsort(-np.abs(value), kind="stable")[:count]
        return [(self.names[first[k]], self.names[second[k]], float(value[k])) for k in order]

    def chart(self) -> dict[str, Any]:
        """As plotly `data` and `layout`."""
        return heatmap_chart(self.names, self.values)

    def svg(self, *, columns: int = 1, width: float = 720.0) -> str:
        """The matrix as a stand-alone SVG text, `width` px wide; there is but one panel for the `columns`."""
        return _svg(self, width)

    def save(self, path: str | Path, *, columns: int = 1, width: float = 720.0) -> Path:
        """Write the SVG to a file."""
        target = Path(path)
        target.write_text(self.svg(columns=columns, width=width), encoding="utf-8")
        return target

    def plotly(self, *, columns: int = 1) -> Any:
        """The matrix as a plotly `Figure`; needs the extra `view`."""
        return heatmap_figure(self.chart(), self.caption)

    def _repr_svg_(self) -> str:
        return self.svg()


def correlation_figure(results: ResultFolder | str | Path) -> MatrixFigure:
    """Correlation of the base parameters of a folder of results, from the covariance of its model.

    Raises ConfigurationError where the folder has no model with a covariance.
    """
    folder = results if isinstance(results, ResultFolder) else ResultFolder.load(results)
    model = folder.model
    if model is None or model.covariance is None or model.std is None:
        raise ConfigurationError(f"{folder.path}: holds no model with a covariance; nothing is correlated")
    std = np.where(model.std > 0, model.std, 1.0)
    matrix = np.clip(model.covariance / np.outer(std, std), -1.0, 1.0)
    strong = int(np.sum(np.abs(np.triu(matrix, 1)) > STRONG))
    alt = f"Correlation matrix of {len(matrix)} parameters. {strong} pairs are correlated by more than {STRONG}."
    caption = "Correlation of the base parameters"
    return MatrixFigure("correlation", caption, tuple(model.names), np.asarray(matrix), alt)


def _svg(figure: MatrixFigure, width: float) -> str:
    count = max(len(figure.names), 1)
    size = min(9.0, max(2.0, 0.85 * width / (count + 8)))
    margin = 0.62 * size * max((len(name) for name in figure.names), default=1) + 8.0
    side = max((width - margin - _SCALE_WIDTH) / count, 0.1)
    span = side * count
    height = margin + span + 8.0
    level = np.rint(_LEVELS * np.clip(figure.values, -1.0, 1.0)).astype(np.int64)
    cells: dict[int, list[str]] = {}
    for row, values in enumerate(level):
        for start, end, value in _runs(values):
            if value:
                box = f"M{margin + start * side:.2f} {margin + row * side:.2f}h{(end - start) * side:.2f}"
                cells.setdefault(value, []).append(f"{box}v{side:.2f}h{-(end - start) * side:.2f}z")
    parts = [
        f"<svg xmlns='http://www.w3.org/2000/svg' width='{width:g}' height='{height:.1f}' "
        f"viewBox='0 0 {width:g} {height:.1f}' role='img'>",
        f"<title>{escape(figure.caption)}</title><desc>{escape(figure.alt)}</desc>",
        "<rect width='100%' height='100%' fill='#ffffff'/>",
        *(
            f"<path fill='{_colour(v / _LEVELS)}' d='{''.join(boxes)}'/>"
            for v, boxes in sorted(cells.items())
        ),
        f"<rect x='{margin:.2f}' y='{margin:.2f}' width='{span:.2f}' height='{span:.2f}' fill='none' "
        "stroke='#8c8c8c' stroke-width='0.8'/>",
    ]
    for place, name in enumerate(figure.names):
        at = margin + (place + 0.5) * side
        text = f"{_FONT} font-size='{size:.2f}' fill='{_INK}'"
        label = escape(name)
        parts.append(
            f"<text x='{margin - 4:.2f}' y='{at + 0.35 * size:.2f}' {text} text-anchor='end'>{label}</text>"
            f"<text transform='translate({at + 0.35 * size:.2f},{margin - 4:.2f}) rotate(-90)' {text}>"
            f"{label}</text>"
        )
    return "".join([*parts, *_scale(margin + span + 14.0, margin, min(span, 240.0)), "</svg>\n"])


def _scale(x: float, y: float, length: float) -> list[str]:
    """The colours with their values, from 1 at the top to -1."""
    each = length / (2 * _LEVELS + 1)
    boxes = [
        f"<rect x='{x:.2f}' y='{y + k * each:.2f}' width='10' height='{each + 0.3:.2f}' "
        f"fill='{_colour(1 - k / _LEVELS)}'/>"
        for k in range(2 * _LEVELS + 1)
    ]
    ticks = [
        f"<text x='{x + 14:.2f}' y='{y + (1 - value) / 2 * length + 3.5:.2f}' {_FONT} font-size='10' "
        f"fill='{_INK}'>{text}</text>"
        for value, text in (
            (1, "1"),
            (0.5, "0.5"),
            (0, "0"),
            (-0.5, "\N{MINUS SIGN}0.5"),
            (-1, "\N{MINUS SIGN}1"),
        )
    ]
    return [*boxes, *ticks]


def _runs(values: Sequence[int] | NDArray[np.int64]) -> list[tuple[int, int, int]]:
    """Stretches of equal values: begin, end (exclusive), value."""
    row = np.asarray(values)
    edges = np.flatnonzero(np.diff(row)) + 1
    begins = np.concatenate([[0], edges])
    ends = np.concatenate([edges, [len(row)]])
    return [(int(a), int(b), int(row[a])) for a, b in zip(begins, ends, strict=True)]


def _colour(value: float) -> str:
    """Colour of a value from -1 to 1, between the stops of the interactive figure."""
    place = 0.5 * (value + 1.0)
    stops = np.array([stop for stop, _ in DIVERGING])
    shades = np.array([[int(text[k : k + 2], 16) for k in (1, 3, 5)] for _, text in DIVERGING])
    red, green, blue = (round(float(np.interp(place, stops, shade))) for shade in shades.T)
    return f"#{red:02x}{green:02x}{blue:02x}"
