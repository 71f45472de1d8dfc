"""The figures of a run, for the report and for notebooks.

::

    from runner.report.figures import torque_figure
    torque_figure("experiments/lwr4plus-20260101-120000")                 # shows itself in a notebook
    torque_figure(folder, session="loaded", side="motor").save("torque.svg")
    residual_figure(folder).plotly()                                      # interactive

Every function takes a folder of results, or a `ResultFolder` to share the work between figures.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from html import escape
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fri.errors import ConfigurationError
from ident.dynamics.parameters import PER_LINK
from runner.published import TABLE_2
from runner.report.folder import Curves, ResultFolder
from runner.report.interactive import DIVERGING, heatmap_chart, heatmap_figure
from runner.report.plot import Band, Line, Mark, Panel, Points, Role, thin
from runner.report.svg import Figure

Floats = NDArray[np.float64]
Results = ResultFolder | str | Path

_POINTS = 700
_BINS = 36
_MOVING = 0.01
STRONG = 0.7
"""Correlation of pairs worth a mention."""

_LEVELS = 20
_FONT = "font-family='Helvetica,Arial,sans-serif'"
_INK = "#1a1a1a"
_SCALE_WIDTH = 56.0


def velocity_figure(results: Results, session: str | None = None) -> Figure:
    """Figure 2a of the paper: joint velocities as logged and filtered, by joint."""
    one = _choose(results, session, "joint")

    def panel(k: int, joint: str) -> Panel:
        fastest = float(np.max(np.abs(one.qd[:, k])))
        marks = (
            _line("logged", "differences of the logged positions", one.time, one.raw_velocity[:, k]),
            _line("measured", "filtered", one.time, one.qd[:, k]),
        )
        alt = f"Velocity of joint {joint} over time, session {one.session}: at most {fastest:.2f} rad/s."
        return Panel(joint, "time [s]", "velocity [rad/s]", marks, alt, f"at most {fastest:.2f} rad/s")

    return _by_joint(one, f"velocity-{one.session}", f"Joint velocities, session {one.session}", panel)


def motion_figure(results: Results, session: str | None = None, side: str = "joint") -> Figure:
    """Figure 2b of the paper: torque as logged and filtered, by joint."""
    one = _choose(results, session, side)
    title = side.capitalize()

    def panel(k: int, joint: str) -> Panel:
        mean = float(np.mean(np.abs(one.torque[:, k])))
        marks = (
            _line("logged", "as logged", one.time, one.torque[:, k]),
            _line("measured", f"low-pass {one.cutoff_hz:g} Hz", one.grid, one.measured[:, k]),
        )
        alt = f"{title} torque of {joint} over time, session {one.session}: mean magnitude {mean:.2f} Nm."
        return Panel(joint, "time [s]", "torque [Nm]", marks, alt, f"mean |τ| {mean:.2f} Nm")

    return _by_joint(
        one, f"torque-logged-{one.session}-{side}", f"{title} torques, session {one.session}", panel
    )


def torque_figure(results: Results, session: str | None = None, side: str | None = None) -> Figure:
    """Figure 3 of the paper: measured and computed torque with their difference, by joint.

    session : name; by default a held-out one, else the loaded one. side : "joint" (default if present) or
    "motor".
    Measured and computed torque passed the same low-pass; the samples as logged stand behind them. The torque
    error of the text is that of all samples as logged.
    """
    one = _choose(results, session, side, unseen_first=True)

    def panel(k: int, joint: str) -> Panel:
        score = one.scores[k]
        error = one.measured[:, k] - one.computed[:, k]
        marks = (
            _line("logged", "as logged", one.time, one.torque[:, k]),
            _line("measured", "measured", one.grid, one.measured[:, k]),
            _line("computed", "computed", one.grid, one.computed[:, k]),
            _line("error", "residual", one.grid, error, lower=True),
        )
        alt = (
            f"Measured and computed {one.side} torque of {joint}, session {one.session}: torque error "
            f"{100 * score.relative:.2f} %, {score.rms:.3g} Nm rms."
        )
        note = f"torque error {100 * score.relative:.2f} %, {score.rms:.2g} Nm"
        return Panel(joint, "time [s]", "torque [Nm]", marks, alt, note, lower_label="residual [Nm]")

    kind = "held-out session" if one.unseen else "session"
    caption = f"Measured and computed {one.side} torque, {kind} {one.session}"
    return _by_joint(one, f"torque-{one.session}-{one.side}", caption, panel)


def residual_figure(
    results: Results, session: str | None = None, side: str | None = None, against: str = "time"
) -> Figure:
    """Residual torque against `time`, `position` or `velocity`, by joint.

    Over time: every extreme as logged, and the residual in the pass band. Against position and velocity: mean
    and spread (5 to 95 %) of the latter in bins, against position for each direction of motion on its own.
    """
    labels = {"time": "time [s]", "position": "position [rad]", "velocity": "velocity [rad/s]"}
    if against not in labels:
        raise ConfigurationError(f"residuals against {against!r}: choose time, position or velocity")
    one = _choose(results, session, side)
    residual = one.measured - one.computed

    def panel(k: int, joint: str) -> Panel:
        marks: tuple[Mark, ...] = (
            _line("logged", "as logged", one.time, one.error[:, k]),
            _line("measured", f"low-pass {one.cutoff_hz:g} Hz", one.grid, residual[:, k]),
        )
        if against != "time":
            marks = _binned(one, residual[:, k], k, against)
        note = f"{one.scores[k].rms:.3g} Nm rms, all samples"
        alt = f"Residual {one.side} torque of {joint} against {against}, session {one.session}: {note}."
        return Panel(joint, labels[against], "residual [Nm]", marks, alt, note)

    caption = f"Residual {one.side} torque against {against}, session {one.session}"
    return _by_joint(one, f"residual-{against}-{one.session}-{one.side}", caption, panel)


def _line(role: Role, label: str, x: Floats, y: Floats, *, lower: bool = False) -> Line:
    return Line(role, label, *thin(x, y, _POINTS), lower=lower)


def _by_joint(one: Curves, name: str, caption: str, panel: Callable[[int, str], Panel]) -> Figure:
    return Figure(name, caption, tuple(panel(k, joint) for k, joint in enumerate(one.joint_names)))


def parameter_figure(results: Results) -> Figure:
    """Base parameters with their 95 % intervals by kind and link, with the published values and any truth."""
    folder = _folder(results)
    entries = folder.summary.get("parameters", [])
    published = {entry.name: entry.estimate for entry in TABLE_2}
    links = tuple(dict.fromkeys(_link(entry["name"]) for entry in entries))
    links = tuple(sorted((link for link in links if link.isdigit()), key=int))
    panels = []
    for symbol in PER_LINK:
        mine = [e for e in entries if _symbol(e["name"]) == symbol and _link(e["name"]) in links]
        if not mine:
            continue
        x = np.array([1.0 + links.index(_link(e["name"])) for e in mine])
        estimates = np.array([e["estimate"] for e in mine])
        intervals = np.array([interval_95(e) for e in mine])
        said = tuple(f"{e['name']} {e['estimate']:.4g} ± {e['std']:.2g} {e['unit']}" for e in mine)
        marks: list[Mark] = [
            Points("estimate", "estimate with 95 % interval", x, estimates, intervals, said),
        ]
        placed = list(zip(x, mine, strict=True))
        known = [
            (p, e["truth"], f"{e['name']} {e['truth']:.4g} {e['unit']}") for p, e in placed if "truth" in e
        ]
        printed = [
            (p, published[e["name"]], f"{e['name']} {published[e['name']]:g}")
            for p, e in placed
            if e["name"] in published
        ]
        others: tuple[tuple[Role, str, list[Any]], ...] = (
            ("truth", "true value of the emulated arm", known),
            ("published", "published (Table 2)", printed),
        )
        for role, label, points in others:
            if points:
                places, values, texts = zip(*points, strict=True)
                marks.append(Points(role, label, np.array(places), np.array(values), None, texts))
        unit = pretty_unit(mine[0]["unit"])
        listed = ", ".join(f"{e['name']} {e['estimate']:.3g}" for e in mine)
        alt = f"Estimates of {symbol} by link with their 95 % intervals: {listed} {unit}."
        panels.append(Panel(symbol, "link", unit, tuple(marks), alt, x_names=links))
    return Figure("parameters", "Base parameters with their 95 % intervals", tuple(panels))


def every_figure(results: Results) -> list[Figure | MatrixFigure]:
    """All figures of a folder."""
    folder = _folder(results)
    figures: list[Figure | MatrixFigure] = []
    for one in folder.curves:
        if one.side == "joint":
            figures.append(velocity_figure(folder, one.session))
        figures.append(motion_figure(folder, one.session, one.side))
        figures.append(torque_figure(folder, one.session, one.side))
        figures += [
            residual_figure(folder, one.session, one.side, against)
            for against in ("time", "position", "velocity")
        ]
    if folder.summary.get("parameters"):
        figures.append(parameter_figure(folder))
    if folder.model is not None and folder.model.covariance is not None:
        figures.append(correlation_figure(folder))
    return figures


def pretty_unit(unit: str) -> str:
    """A unit as it is printed: kg m², Nm s/rad."""
    return unit.replace("^2", "²").replace(" ", "\N{NO-BREAK SPACE}")


def interval_95(entry: dict[str, float]) -> tuple[float, float]:
    """95 % interval of a parameter of summary.json, if necessary from its standard deviation."""
    stated = entry.get("interval_95")
    if isinstance(stated, list):
        return float(stated[0]), float(stated[1])
    return entry["estimate"] - 1.96 * entry["std"], entry["estimate"] + 1.96 * entry["std"]


def _binned(one: Curves, residual: Floats, joint: int, against: str) -> tuple[Mark, ...]:
    moving = np.isfinite(residual)
    q, qd = (np.interp(one.grid[moving], one.time, column[:, joint]) for column in (one.q, one.qd))
    residual = residual[moving]
    x, mean, low, high = bin_means(qd if against == "velocity" else q, residual)
    spread = Band("spread", "5 to 95 % of the samples", x, low, high)
    if against == "velocity":
        return spread, Line("measured", "mean", x, mean)
    ways: tuple[tuple[Role, str, NDArray[np.bool_]], ...] = (
        ("forward", "mean, joint moving up", qd > _MOVING),
        ("backward", "mean, joint moving down", qd < -_MOVING),
    )
    return spread, *(
        Line(role, label, *bin_means(q[chosen], residual[chosen])[:2])
        for role, label, chosen in ways
        if np.count_nonzero(chosen) > _BINS
    )


def bin_means(x: Floats, y: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Centres, means, 5 % and 95 % quantiles of y in bins of x with three samples or more."""
    edges = np.linspace(x.min(), x.max(), _BINS + 1)
    place = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, _BINS - 1)
    rows = []
    for k in range(_BINS):
        mine = y[place == k]
        if len(mine) >= 3:
            rows.append((0.5 * (edges[k] + edges[k + 1]), mine.mean(), *np.quantile(mine, [0.05, 0.95])))
    centre, mean, low, high = np.array(rows).reshape(-1, 4).T
    return centre, mean, low, high


def _folder(results: Results) -> ResultFolder:
    return results if isinstance(results, ResultFolder) else ResultFolder.load(results)


def _choose(results: Results, session: str | None, side: str | None, *, unseen_first: bool = False) -> Curves:
    folder = _folder(results)
    known = sorted(folder.curves, key=lambda one: one.unseen != unseen_first)
    found = [
        one
        for one in known
        if (session is None or one.session == session) and (side is None or one.side == side)
    ]
    if not found:
        labels = ", ".join(one.label for one in folder.curves) or "none"
        wanted = ", ".join(word for word in (session, side) if word) or "any session"
        raise ConfigurationError(f"{folder.path}: no torque of {wanted} to show; there is: {labels}")
    return found[0]


def _symbol(name: str) -> str:
    return name.removesuffix("R").rstrip("0123456789")


def _link(name: str) -> str:
    return name.removesuffix("R")[len(_symbol(name)) :]


@dataclass(frozen=True, eq=False)
class MatrixFigure:
    """A symmetric matrix (n, n) of values from -1 to 1 with its n names. A notebook shows it by itself.

    name : for file names. alt : description in a sentence, for screen readers.
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
        """The matrix as a stand-alone SVG text, `width` px wide; `columns` has no effect."""
        count = max(len(self.names), 1)
        size = min(9.0, max(2.0, 0.85 * width / (count + 8)))
        margin = 0.62 * size * max((len(name) for name in self.names), default=1) + 8.0
        side = max((width - margin - _SCALE_WIDTH) / count, 0.1)
        span = side * count
        height = margin + span + 8.0
        level = np.rint(_LEVELS * np.clip(self.values, -1.0, 1.0)).astype(np.int64)
        cells: dict[int, list[str]] = {}
        for row, values in enumerate(level):
            for start, end, value in _runs(values):
                if value:
                    box = f"M{margin + start * side:.2f} {margin + row * side:.2f}h{(end - start) * side:.2f}"
                    cells.setdefault(value, []).append(f"{box}v{side:.2f}h{-(end - start) * side:.2f}z")
        parts = [
            f"<svg xmlns='http://www.w3.org/2000/svg' width='{width:g}' height='{height:.1f}' "
            f"viewBox='0 0 {width:g} {height:.1f}' role='img'>",
            f"<title>{escape(self.caption)}</title><desc>{escape(self.alt)}</desc>",
            "<rect width='100%' height='100%' fill='#ffffff'/>",
            *(f"<path fill='{_colour(v / _LEVELS)}' d='{''.join(b)}'/>" for v, b in sorted(cells.items())),
            f"<rect x='{margin:.2f}' y='{margin:.2f}' width='{span:.2f}' height='{span:.2f}' fill='none' "
            "stroke='#8c8c8c' stroke-width='0.8'/>",
        ]
        text = f"{_FONT} font-size='{size:.2f}' fill='{_INK}'"
        for place, name in enumerate(self.names):
            at, label = margin + (place + 0.5) * side, escape(name)
            parts.append(
                f"<text x='{margin - 4:.2f}' y='{at + 0.35 * size:.2f}' {text} text-anchor='end'>{label}</text>"
                f"<text transform='translate({at + 0.35 * size:.2f},{margin - 4:.2f}) rotate(-90)' {text}>"
                f"{label}</text>"
            )
        return "".join([*parts, *_scale(margin + span + 14.0, margin, min(span, 240.0)), "</svg>\n"])

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


def correlation_figure(results: Results) -> MatrixFigure:
    """Correlation of the base parameters of a folder of results, from the covariance of its model.

    ConfigurationError without a model with covariance.
    """
    folder = _folder(results)
    model = folder.model
    if model is None or model.covariance is None or model.std is None:
        raise ConfigurationError(f"{folder.path}: holds no model with a covariance; nothing is correlated")
    std = np.where(model.std > 0, model.std, 1.0)
    matrix = np.clip(model.covariance / np.outer(std, std), -1.0, 1.0)
    strong = int(np.sum(np.abs(np.triu(matrix, 1)) > STRONG))
    alt = f"Correlation matrix of {len(matrix)} parameters. {strong} pairs are correlated by more than {STRONG}."
    caption = "Correlation of the base parameters"
    return MatrixFigure("correlation", caption, tuple(model.names), np.asarray(matrix), alt)


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
        for value, text in zip((1, 0.5, 0, -0.5, -1), ("1", "0.5", "0", "−0.5", "−1"), strict=True)
    ]
    return [*boxes, *ticks]


def _runs(row: NDArray[np.int64]) -> list[tuple[int, int, int]]:
    """Stretches of equal values: begin, end (exclusive), value."""
    edges = [0, *(np.flatnonzero(np.diff(row)) + 1).tolist(), len(row)]
    return [(begin, end, int(row[begin])) for begin, end in pairwise(edges)]


def _colour(value: float) -> str:
    """Colour of a value from -1 to 1, between the stops of the interactive figure."""
    place = 0.5 * (value + 1.0)
    stops = np.array([stop for stop, _ in DIVERGING])
    shades = np.array([[int(text[k : k + 2], 16) for k in (1, 3, 5)] for _, text in DIVERGING])
    red, green, blue = (round(float(np.interp(place, stops, shade))) for shade in shades.T)
    return f"#{red:02x}{green:02x}{blue:02x}"
