"""The figures of a run, for the report and for notebooks.

::

    from runner.report.figures import torque_figure
    torque_figure("experiments/lwr4plus-20260101-120000")                 # shows itself in a notebook
    torque_figure(folder, side="motor").save("torque.pdf", "ieee")        # one column of an IEEE paper
    axes = torque_figure(folder, joints="names").plot("ifac-wide")        # matplotlib axes, to be changed
    residual_figure(folder).plotly()                                      # interactive

Every function takes a folder of results, or a `ResultFolder` to share the work between figures.
joints : `numbers` (1 to n in kinematic order, as papers have them) or `names` of the arm.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fri.errors import ConfigurationError
from ident.dynamics.parameters import PER_LINK, printed_unit
from runner.published import TABLE_2
from runner.report.figure import Figure, MatrixFigure
from runner.report.folder import Curves, ResultFolder
from runner.report.paper import joint_labels
from runner.report.plot import Band, Line, Mark, Panel, Points, Role, thin

Floats = NDArray[np.float64]
Results = ResultFolder | str | Path

_POINTS = 700
_BINS = 36
_MOVING = 0.01
STRONG = 0.7
"""Correlation of pairs worth a mention."""

_BESIDE = 0.16
"""Distance of points of one place that belong to different sources."""


def velocity_figure(results: Results, session: str | None = None, *, joints: str = "numbers") -> Figure:
    """Figure 2a of the paper: joint velocities as logged and filtered, by joint."""
    one = _choose(results, session, "joint")

    def panel(k: int, joint: str) -> Panel:
        fastest = float(np.max(np.abs(one.qd[:, k])))
        marks = (
            _line("logged", "differences of the logged positions", one.time, one.raw_velocity[:, k]),
            _line("measured", "filtered", one.time, one.qd[:, k]),
        )
        alt = f"Velocity of {joint} over time, session {one.session}: at most {fastest:.2f} rad/s."
        return Panel(joint, "time [s]", "velocity [rad/s]", marks, alt, f"at most {fastest:.2f} rad/s")

    return _by_joint(
        one, joints, f"velocity-{one.session}", f"Joint velocities, session {one.session}", panel
    )


def motion_figure(
    results: Results, session: str | None = None, side: str = "joint", *, joints: str = "numbers"
) -> Figure:
    """Figure 2b of the paper: torque as logged and filtered, by joint."""
    one = _choose(results, session, side)
    title = side.capitalize()

    def panel(k: int, joint: str) -> Panel:
        mean, unit = float(np.mean(np.abs(one.torque[:, k]))), one.scores[k].unit
        marks = (
            _line("logged", "as logged", one.time, one.torque[:, k]),
            _line("measured", f"low-pass {one.cutoff_hz:g} Hz", one.grid, one.measured[:, k]),
        )
        alt = f"{title} torque of {joint} over time, session {one.session}: mean magnitude {mean:.2f} {unit}."
        return Panel(joint, "time [s]", f"torque [{unit}]", marks, alt, f"mean |τ| {mean:.2f} {unit}")

    name = f"torque-logged-{one.session}-{side}"
    return _by_joint(one, joints, name, f"{title} torques, session {one.session}", panel)


def torque_figure(
    results: Results, session: str | None = None, side: str | None = None, *, joints: str = "numbers"
) -> Figure:
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
            f"{100 * score.relative:.2f} %, {score.rms:.3g} {score.unit} rms."
        )
        note = f"torque error {100 * score.relative:.2f} %, {score.rms:.2g} {score.unit}"
        torque, left = f"torque [{score.unit}]", f"residual [{score.unit}]"
        return Panel(joint, "time [s]", torque, marks, alt, note, lower_label=left)

    kind = "held-out session" if one.unseen else "session"
    caption = f"Measured and computed {one.side} torque, {kind} {one.session}"
    return _by_joint(one, joints, f"torque-{one.session}-{one.side}", caption, panel)


def residual_figure(
    results: Results,
    session: str | None = None,
    side: str | None = None,
    against: str = "time",
    *,
    joints: str = "numbers",
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
        unit = one.scores[k].unit
        note = f"{one.scores[k].rms:.3g} {unit} rms, all samples"
        alt = f"Residual {one.side} torque of {joint} against {against}, session {one.session}: {note}."
        return Panel(joint, labels[against], f"residual [{unit}]", marks, alt, note)

    caption = f"Residual {one.side} torque against {against}, session {one.session}"
    return _by_joint(one, joints, f"residual-{against}-{one.session}-{one.side}", caption, panel)


def _line(role: Role, label: str, x: Floats, y: Floats, *, lower: bool = False) -> Line:
    return Line(role, label, *thin(x, y, _POINTS), lower=lower)


def _by_joint(
    one: Curves, joints: str, name: str, caption: str, panel: Callable[[int, str], Panel]
) -> Figure:
    labels = joint_labels(one.joint_names, joints)
    return Figure(name, caption, tuple(panel(k, joint) for k, joint in enumerate(labels)))


def parameter_figure(results: Results) -> Figure:
    """Base parameters by kind and link, with the published values and any truth.

    The lower part of each panel has the 95 % intervals around the estimates, too small to be seen beside them.
    """
    folder = _folder(results)
    entries = folder.summary.get("parameters", [])
    published = {entry.name: entry.estimate for entry in TABLE_2 if folder.published_arm}
    links = tuple(dict.fromkeys(_link(entry["name"]) for entry in entries))
    links = tuple(sorted((link for link in links if link.isdigit()), key=int))
    panels = []
    for symbol in PER_LINK:
        mine = [e for e in entries if _symbol(e["name"]) == symbol and _link(e["name"]) in links]
        if not mine:
            continue
        place = np.array([1.0 + links.index(_link(e["name"])) for e in mine])
        value = np.array([e["estimate"] for e in mine])
        interval = np.array([interval_95(e) for e in mine])
        texts = tuple(f"{e['name']} {e['estimate']:.4g} ± {e['std']:.2g} {e['unit']}" for e in mine)
        label = "estimate with 95 % interval"
        marks: list[Mark] = [
            Points("estimate", label, place, value, interval, texts),
            Points("estimate", label, place, 0.0 * value, interval - value[:, None], texts, lower=True),
        ]
        others: tuple[tuple[Role, str, list[float | None], float], ...] = (
            ("truth", "true value of the emulated arm", [e.get("truth") for e in mine], _BESIDE),
            ("published", "published (Table 2)", [published.get(e["name"]) for e in mine], -_BESIDE),
        )
        for role, label, values, beside in others:
            known = np.array([k for k, one in enumerate(values) if one is not None], dtype=np.int64)
            if not len(known):
                continue
            x = place[known] + beside
            y = np.array([values[k] for k in known], dtype=np.float64)
            words = tuple(f"{mine[k]['name']} {values[k]:.4g} {mine[k]['unit']}" for k in known)
            marks.append(Points(role, label, x, y, None, words))
            if role == "truth":
                marks.append(Points(role, label, x, y - value[known], None, words, lower=True))
        unit = pretty_unit(mine[0]["unit"])
        listed = ", ".join(f"{e['name']} {e['estimate']:.3g}" for e in mine)
        alt = f"Estimates of {symbol} by link with their 95 % intervals: {listed} {unit}."
        panels.append(
            Panel(
                symbol,
                "link",
                f"[{unit}]",
                tuple(marks),
                alt,
                lower_label=f"interval [{unit}]",
                x_names=links,
                lower_log=True,
            )
        )
    return Figure("parameters", "Base parameters with their 95 % intervals", tuple(panels))


def every_figure(results: Results, *, joints: str = "numbers") -> list[Figure | MatrixFigure]:
    """All figures of a folder of results; those of a diagnosis are in `runner.report.diagnosis_figures`."""
    folder = _folder(results)
    figures: list[Figure | MatrixFigure] = []
    for one in folder.curves:
        if one.side == "joint":
            figures.append(velocity_figure(folder, one.session, joints=joints))
        figures.append(motion_figure(folder, one.session, one.side, joints=joints))
        figures.append(torque_figure(folder, one.session, one.side, joints=joints))
        figures += [
            residual_figure(folder, one.session, one.side, against, joints=joints)
            for against in ("time", "position", "velocity")
        ]
    if folder.summary.get("parameters"):
        figures.append(parameter_figure(folder))
    if folder.model is not None and folder.model.covariance is not None:
        figures.append(correlation_figure(folder))
    return figures


def pretty_unit(unit: str) -> str:
    """A unit as it is printed, in one line: kg m², Nm s/rad."""
    return printed_unit(unit).replace(" ", "\N{NO-BREAK SPACE}")


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
