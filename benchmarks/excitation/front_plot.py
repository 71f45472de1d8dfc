"""The front of two objectives as a figure."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from runner.report.paper import new_figure, paper_style, write_figure


def front_figure(
    path: Path, points: Sequence[tuple[float, float]], x_label: str, y_label: str, title: str
) -> None:
    """Write points joined by a line; the suffix of the path chooses the format. title : in the file's metadata."""
    values = np.array(sorted(points))
    with paper_style():
        figure = new_figure(88.9, 58.0, shown=False)
        figure.set_layout_engine("constrained")
        axes = figure.add_subplot()
        axes.plot(*values.T, color="#0072b2", linewidth=0.9, marker="o", markersize=3.0)
        axes.set(xlabel=x_label, ylabel=y_label)
        axes.margins(0.06)
        listed = ", ".join(f"({x:.1f}; {y:.2f})" for x, y in values)
        write_figure(figure, path, title, f"{y_label} over {x_label}: {listed}.")
