"""Panels as plotly charts: as plain dictionaries for the page, as one `plotly` figure for notebooks."""

from __future__ import annotations

import base64
import gzip
import json
import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fri.errors import ConfigurationError
from runner.report.plot import STYLES, Band, Line, Mark, Panel, limits, thin

Floats = NDArray[np.float64]

INSTALL = "the extra `view` is not installed; run `pip install 'lwr-identification[view]'`"
_FAMILY = "system-ui, -apple-system, 'Segoe UI', Helvetica, Arial, sans-serif"
FONT = {"family": _FAMILY, "size": 11, "color": "#1a1a1a"}
_SYMBOLS = {"circle": "circle", "cross": "x-thin-open", "diamond": "diamond-open"}
_BACKGROUND = {"paper_bgcolor": "rgba(0,0,0,0)", "plot_bgcolor": "#ffffff"}
_GRID = "#e3e3e3"
_SPLIT = 0.32
_SHORT = 60
"""Columns below this length keep their numbers."""
_FULL, _FEWEST = 700, 60
"""Points of a line, and the fewest of a page with very many."""
_LEVELS = 20_000
"""Places of the grid between the least and the largest value of a column."""
DIVERGING: tuple[tuple[float, str], ...] = (
    (0.0, "#d55e00"), (0.25, "#f2b98c"), (0.5, "#ffffff"), (0.75, "#8cbfdd"), (1.0, "#0072b2"),
)  # fmt: skip
"""Colours of values from -1 (place 0) over 0 to 1, distinguishable with every common colour vision."""


def plotly_script() -> str:
    """The plotly library as script text. ConfigurationError without the extra `view`."""
    try:
        from plotly.offline import get_plotlyjs
    except ImportError as error:
        raise ConfigurationError(f"report.html: {INSTALL}") from error
    return str(get_plotlyjs())


@lru_cache(maxsize=2)  # plotly and the charts of a page
def zipped(text: str) -> str:
    """A text as base64 of gzip; the page's script opens it. The same bytes for the same text."""
    # The highest level takes half as long again for half a per cent.
    return base64.b64encode(gzip.compress(text.encode("utf-8"), 6, mtime=0)).decode("ascii")


def chart_json(chart: dict[str, Any]) -> str:
    """A chart as JSON; long columns as steps of a fine grid, which compress to two bytes a value."""
    return json.dumps(chart, separators=(",", ":"), default=_plain)


def lighter_charts(charts: str, budget: int) -> str:
    """Charts (a JSON list) with fewer points of their lines, until they zip to `budget` bytes at most."""
    points = _FULL
    while len(zipped(charts)) > budget and points > _FEWEST:
        points = int(0.7 * points)
        plain = json.loads(charts)
        for trace in (trace for chart in plain for trace in chart["data"]):
            if trace.get("mode") == "lines" and isinstance(trace.get("y"), dict):
                x, y = (np.asarray(_unpacked(trace[key]), dtype=np.float64) for key in "xy")
                trace["x"], trace["y"] = thin(x, y, points)
        charts = json.dumps(plain, separators=(",", ":"), default=_plain)
    return charts


def _unpacked(column: Any) -> Any:
    if isinstance(column, dict):
        return column["low"] + column["step"] * np.cumsum(column["moves"])
    return column


def _plain(values: Any) -> Any:
    column = np.asarray(values, dtype=np.float64)
    finite = np.isfinite(column)
    if column.ndim > 1:
        return [_plain(row) for row in np.round(column, 4)]
    if len(column) < _SHORT or not finite.all():
        return [float(f"{value:.6g}") if good else None for value, good in zip(column, finite, strict=True)]
    low, span = float(column.min()), float(np.ptp(column))
    step = float(f"{(span or 1.0) / _LEVELS:.6g}")
    places = np.rint((column - low) / step).astype(np.int64)
    return {"low": low, "step": step, "moves": np.diff(places, prepend=0).tolist()}


def panel_chart(panel: Panel) -> dict[str, Any]:
    """A panel as plotly `data` and `layout`, columns as arrays."""
    data = [trace for mark in panel.marks for trace in _traces(mark)]
    span = (0.5, len(panel.x_names) + 0.5) if panel.x_names else limits([m.x for m in panel.marks], pad=0.0)
    layout: dict[str, Any] = {
        "margin": {"l": 52, "r": 10, "t": 6, "b": 36},
        "font": FONT,
        "showlegend": False,
        "hovermode": "x unified" if not panel.x_names else "closest",
        "hoverlabel": {"font": {"size": 11}, "namelength": -1},
        **_BACKGROUND,
        "xaxis": {
            **_axis(panel.x_label),
            "range": list(span),
            "anchor": "y2" if panel.split else "y",
            **({"showspikes": False} if panel.x_names else {}),
        },
        # Five digits are wider than the margin, and the label would lie over them.
        "yaxis": {
            **_axis(panel.y_label),
            "automargin": True,
            "domain": [_SPLIT + 0.05, 1.0] if panel.split else [0.0, 1.0],
        },
    }
    if panel.x_names:
        places = list(range(1, len(panel.x_names) + 1))
        layout["xaxis"] |= {"tickvals": places, "ticktext": list(panel.x_names)}
        layout["xaxis"] |= {"automargin": True, "autotickangles": [0, -90]}
    if panel.split:
        # The x axis belongs to the lower part, so the frame of the upper one is drawn.
        box = {"x0": 0, "x1": 1, "y0": _SPLIT + 0.05, "y1": 1}
        frame = {"type": "rect", "xref": "paper", "yref": "paper", **box}
        layout["shapes"] = [{**frame, "line": {"color": "#8c8c8c", "width": 1}}]
        label = panel.lower_label.replace(" [", "<br>[")
        layout["yaxis2"] = {**_axis(label), "domain": [0.0, _SPLIT - 0.03], "nticks": 5, "automargin": True}
    return {"data": data, "layout": layout}


def heatmap_chart(names: tuple[str, ...], matrix: Floats) -> dict[str, Any]:
    """A square matrix of values from -1 to 1 as plotly `data` and `layout`."""
    values = np.asarray(matrix, dtype=np.float64)
    trace = {
        "type": "heatmap",
        "x": list(names),
        "y": list(names),
        "z": values,
        "zmin": -1,
        "zmax": 1,
        "colorscale": [list(stop) for stop in DIVERGING],
        "colorbar": {"thickness": 10, "len": 0.8, "outlinewidth": 0, "tickvals": [-1, -0.5, 0, 0.5, 1]},
        "hovertemplate": "%{y}, %{x}: %{z:.2f}<extra></extra>",
    }
    layout = {
        "margin": {"l": 52, "r": 10, "t": 6, "b": 52},
        "font": {**FONT, "size": 9},
        **_BACKGROUND,
        "xaxis": {"tickangle": -90, "showgrid": False, "constrain": "domain"},
        "yaxis": {"autorange": "reversed", "showgrid": False, "scaleanchor": "x", "constrain": "domain"},
    }
    return {"data": [trace], "layout": layout}


def heatmap_figure(chart: dict[str, Any], caption: str) -> Any:
    """The chart of a matrix as a `plotly.graph_objects.Figure`."""
    try:
        import plotly.graph_objects as go
    except ImportError as error:
        raise ConfigurationError(f"plotly figure: {INSTALL}") from error
    whole = go.Figure(chart["data"][0], chart["layout"])
    whole.update_layout(title={"text": caption}, margin={"t": 40}, height=900)
    return whole


def plotly_figure(panels: Sequence[Panel], *, columns: int = 2) -> Any:
    """The panels as subplots of one `plotly.graph_objects.Figure`."""
    try:
        import plotly.graph_objects as go
        from plotly.subplots import make_subplots
    except ImportError as error:
        raise ConfigurationError(f"plotly figure: {INSTALL}") from error
    rows = math.ceil(len(panels) / columns)
    split = any(panel.split for panel in panels)
    heights = ([0.7, 0.3] if split else [1.0]) * rows
    titles: list[str] = []
    for row in range(rows):
        names = [panel.title for panel in panels[row * columns : (row + 1) * columns]]
        titles += names + [""] * (columns - len(names))
        titles += [""] * columns if split else []
    whole = make_subplots(
        rows=len(heights),
        cols=columns,
        row_heights=heights,
        subplot_titles=titles,
        vertical_spacing=0.25 / len(heights),
    )
    known: set[str] = set()
    for index, panel in enumerate(panels):
        row, column = (index // columns) * (2 if split else 1) + 1, index % columns + 1
        for mark in panel.marks:
            for trace in _traces(mark):
                plain = {k: value for k, value in trace.items() if k not in ("type", "yaxis")}
                name = str(plain["name"])
                shown = bool(name) and name not in known
                known.add(name)
                drawn = go.Scatter(**plain, showlegend=shown, legendgroup=name)
                whole.add_trace(drawn, row=row + (1 if mark.lower else 0), col=column)
        whole.update_yaxes(title_text=panel.y_label, row=row, col=column)
        if panel.split:
            whole.update_yaxes(title_text=panel.lower_label, row=row + 1, col=column)
    legend = {"orientation": "h", "y": 1.06}
    whole.update_layout(template="plotly_white", font=FONT, height=170 * len(heights) + 120, legend=legend)
    return whole


def _traces(mark: Mark) -> list[dict[str, Any]]:
    style = STYLES[mark.role]
    axis = {"yaxis": "y2"} if mark.lower else {}
    if isinstance(mark, Line):
        dash = ", ".join(f"{part}px" for part in style.dash.split()) if style.dash else "solid"
        return [
            {
                "type": "scatter",
                "mode": "lines",
                "name": mark.label,
                "x": mark.x,
                "y": mark.y,
                "line": {"color": style.colour, "width": style.width, "dash": dash},
                "hovertemplate": "%{y:.4g}",
                **axis,
            }
        ]
    if isinstance(mark, Band):
        line = {"type": "scatter", "mode": "lines", "line": {"width": 0}, "hoverinfo": "skip"}
        plain = {**line, "x": mark.x}
        fill = {"fill": "tonexty", "fillcolor": _transparent(style.colour), "name": mark.label}
        return [
            {**plain, "y": mark.low, "name": "", **axis},
            {**plain, "y": mark.high, **fill, **axis},
        ]
    outline = {"width": 1.4, "color": style.colour}
    trace: dict[str, Any] = {
        "type": "scatter",
        "mode": "markers",
        "name": mark.label,
        "x": mark.x,
        "y": mark.y,
        "text": list(mark.texts),
        "marker": {"color": style.colour, "size": 7, "symbol": _SYMBOLS[style.symbol], "line": outline},
        "hovertemplate": "%{text}<extra>" + mark.label + "</extra>" if mark.texts else "%{y:.4g}",
        **axis,
    }
    if mark.interval is not None:
        trace["error_y"] = {
            "type": "data",
            "symmetric": False,
            "array": mark.interval[:, 1] - mark.y,
            "arrayminus": mark.y - mark.interval[:, 0],
            "color": style.colour,
            "thickness": 1.4,
            "width": 3,
        }
    return [trace]


def _axis(label: str) -> dict[str, Any]:
    return {
        "title": {"text": label, "standoff": 4},
        "gridcolor": _GRID,
        "zerolinecolor": "#c4c4c4",
        "linecolor": "#8c8c8c",
        "mirror": True,
        "ticks": "outside",
        "ticklen": 3,
        "nticks": 6,
        "exponentformat": "none",
    }


def _transparent(colour: str) -> str:
    red, green, blue = (int(colour[k : k + 2], 16) for k in (1, 3, 5))
    return f"rgba({red},{green},{blue},0.55)"
