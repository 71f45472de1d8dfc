"""Figures of a diagnosis: held-out residuals, look-alikes side by side, errors of the replay."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from ident.diagnosis.outcome.look_alikes import LookAlikes, Trace
from ident.diagnosis.outcome.statements import REPLAYED
from ident.effects import WEAR, Parameters, find_effect
from ident.effects.words import joints_text, spoken
from runner.diagnosis.records import ReplayErrors, Residuals, SideResiduals
from runner.report.figure import Figure
from runner.report.figures import bin_means
from runner.report.paper import joint_labels
from runner.report.plot import Band, Line, Mark, Panel, Points, Role, thin

Floats = NDArray[np.float64]

AGAINST = ("time", "position", "velocity", "load", "motor angle", "run order")

_LABELS = {
    "time": "time, sessions in turn [s]",
    "position": "position [rad]",
    "velocity": "velocity [rad/s]",
    "load": "predicted joint torque [Nm]",
    "motor angle": "motor angle [turns]",
    "run order": "block of the run",
}
_GAP_S = 2.0
_PLACES = 2
_POINTS = 500
_WINDOW_S = 8.0
_MEAN_S = 0.25
_FEW = 60
_BOTH_WAYS = 0.15
_MODELS: tuple[tuple[Role, str], ...] = (("backward", "base model"), ("forward", "extended model"))


def residual_figures(residuals: Residuals, side: str, *, joints: str = "numbers") -> list[Figure]:
    """One figure a quantity, one panel a joint; joints as in `runner.report.figures`."""
    residuals = replace(residuals, joint_names=joint_labels(residuals.joint_names, joints))
    used = np.flatnonzero(np.isfinite(residuals.sides[side].base).any(axis=0)).tolist()
    return [
        Figure(
            f"residual-{side}-{against.replace(' ', '-')}",
            f"Held-out residual of the {side} torque against {against}",
            tuple(_panel(residuals, side, joint, against) for joint in used),
        )
        for against in AGAINST
    ]


def finding_figure(
    residuals: Residuals,
    cause: str,
    side: str,
    joints: Sequence[int],
    parameters: Parameters,
    others: Sequence[int] = (),
) -> Figure | None:
    """Held-out residual of a finding without and with the extension, over time and against its variable.

    joints : from 1, none for the whole arm. parameters : of the finding. others : joints of other findings, unclear
    about a cause of the whole arm. None without residuals to show, as of wear.
    """
    if cause == WEAR:
        return None
    effect = find_effect(cause)
    seen = {"motor": ("motor",), "sensor": ("joint",)}.get(side, ("motor", "joint"))
    if effect.channel == "motor":
        seen = ("motor",)
    fall: dict[tuple[str, int], float] = {}
    for name in (name for name in seen if name in residuals.sides):
        rows = residuals.sides[name]
        for joint in np.flatnonzero(np.isfinite(rows.base).any(axis=0)).tolist():
            if not joints or joint + 1 in joints:
                power = [np.nanmean(part[:, joint] ** 2) for part in (rows.extended, rows.base)]
                fall[name, joint] = 1.0 - float(power[0] / power[1])
    clear = {key: value for key, value in fall.items() if key[1] + 1 not in others}
    if not joints and clear:
        fall = clear
    panels = [
        _panel(residuals, name, joint, against, with_side=True)
        for name, joint in sorted(fall, key=lambda key: -fall[key])[:_PLACES]
        for against in dict.fromkeys((effect.variable(parameters), "time"))
    ]
    where = "-".join(map(str, joints)) or "arm"
    caption = f"Where {spoken(cause)} shows"
    return Figure(f"finding-{cause}-{where}", caption, tuple(panels)) if panels else None


def _panel(residuals: Residuals, side: str, joint: int, against: str, *, with_side: bool = False) -> Panel:
    name, rows = residuals.joint_names[joint], residuals.sides[side]
    used = np.isfinite(rows.base[:, joint])
    rms = [float(np.sqrt(np.nanmean(part[used, joint] ** 2))) for part in (rows.base, rows.extended)]
    note = f"{rms[0]:.3g} Nm rms" + (f", extended {rms[1]:.3g}" if residuals.named else "")
    marks = _MARKS.get(against, _binned_marks)(residuals, rows, joint, against)
    return Panel(
        f"{name}, {side} torque" if with_side else name,
        _LABELS[against],
        "residual [Nm]",
        tuple(marks),
        f"Held-out residual of the {side} torque of {name} against {against}: {note}.",
        note,
    )


def _models(residuals: Residuals, rows: SideResiduals, joint: int) -> list[tuple[Role, str, Floats]]:
    shown = zip(_MODELS, (rows.base, rows.extended)[: 1 + residuals.named], strict=False)
    return [(role, label, part[:, joint]) for (role, label), part in shown]


def _means(role: Role, label: str, x: Floats, values: Floats) -> list[Mark]:
    """Means in bins of x, with the spread of the base model."""
    centre, mean, low, high = bin_means(x, values)
    line = Line(role, f"{label}, mean", centre, mean)
    spread = Band("spread", "5 to 95 % of the rows, base model", centre, low, high)
    return [spread, line] if role == "backward" else [line]


def _binned_marks(residuals: Residuals, rows: SideResiduals, joint: int, against: str) -> list[Mark]:
    marks: list[Mark] = []
    columns = {"position": rows.position, "velocity": rows.speed, "load": rows.load}
    if against in columns:
        x = columns[against][:, joint]
    else:
        turns = rows.position[:, joint] * residuals.gear_ratio[joint] / (2.0 * np.pi)
        x = np.asarray(turns - np.floor(turns))
    for role, label, values in _models(residuals, rows, joint):
        good = np.isfinite(values) & np.isfinite(x)
        if np.count_nonzero(good) >= 10 and np.ptp(x[good]) > 0.0:
            marks += _means(role, label, x[good], values[good])
    return marks


def _time_marks(residuals: Residuals, rows: SideResiduals, joint: int, against: str) -> list[Mark]:
    """The sessions one after the other, with a pause between them."""
    marks: list[Mark] = []
    for role, label, values in _models(residuals, rows, joint):
        offset = 0.0
        for session in np.unique(rows.session):
            mine = (rows.session == session) & np.isfinite(values)
            if np.count_nonzero(mine) < 10:
                continue
            time = rows.time[mine]
            marks += _means(role, label, time - time[0] + offset, values[mine])
            offset += float(time[-1] - time[0]) + _GAP_S
    return marks


def _order_marks(residuals: Residuals, rows: SideResiduals, joint: int, against: str) -> list[Mark]:
    """Mean of each block in the order of the run, with twice its standard deviation from rows."""
    marks: list[Mark] = []
    for role, label, values in _models(residuals, rows, joint):
        places, means, bars = [], [], []
        for place, block in enumerate(np.unique(rows.block)):
            mine = values[(rows.block == block) & np.isfinite(values)]
            if len(mine) < 5:
                continue
            spread = 2.0 * float(np.std(mine)) / np.sqrt(len(mine))
            places.append(place + 1.0)
            means.append(float(np.mean(mine)))
            bars.append((means[-1] - spread, means[-1] + spread))
        if places:
            x, y = np.array(places), np.array(means)
            marks.append(Points(role, f"{label}, mean of a block", x, y, np.array(bars)))
    return marks


_MARKS: dict[str, Callable[[Residuals, SideResiduals, int, str], list[Mark]]] = {
    "time": _time_marks,
    "run order": _order_marks,
}


def look_alike_figure(pair: LookAlikes, names: Sequence[str]) -> Figure:
    """Panels over time and against the variables of the causes, for the rows of their largest torques."""
    labels = [f"{spoken(cause)}, {joints_text(joints, names)}" for cause, joints in (pair.first, pair.second)]
    panels = []
    for trace in pair.traces:
        panels.append(_over_time(pair, trace, labels, names))
        for variable in dict.fromkeys(pair.variables):
            if variable != "time":
                panels += _against(pair, trace, variable, labels, names)
    places = (
        f"{cause}-{'-'.join(map(str, joints))}".strip("-") for cause, joints in (pair.first, pair.second)
    )
    name = "-".join(["look-alike", *places])
    caption = f"What {labels[0]} and {labels[1]} would leave in these sessions, overlap {pair.alike:.2f}"
    return Figure(name, caption, tuple(panels))


def _place(trace: Trace, names: Sequence[str]) -> str:
    return f"{names[trace.joint - 1]}, {trace.side} torque"


def _lines(trace: Trace, labels: Sequence[str]) -> list[tuple[Role, str, Floats]]:
    return [
        ("error", "measured minus the model without either", trace.measured),
        ("forward", labels[0], trace.first),
        ("backward", labels[1], trace.second),
    ]


def _over_time(pair: LookAlikes, trace: Trace, labels: Sequence[str], names: Sequence[str]) -> Panel:
    session, begin = _busiest(trace)
    inside = (trace.session == session) & (trace.time >= begin) & (trace.time <= begin + _WINDOW_S)
    x = trace.time[inside]
    # Noise of single rows would hide the comparison.
    rows = max(1, round(_MEAN_S / float(np.median(np.diff(x))))) if len(x) > 2 else 1
    marks = []
    for role, label, values in _lines(trace, labels):
        shown = uniform_filter1d(values[inside], rows) if role == "error" else values[inside]
        marks.append(Line(role, label, *thin(x, shown, _POINTS)))
    number = int(session)
    where = pair.sessions[number] if number < len(pair.sessions) else f"session {number + 1}"
    alt = f"{_shares(pair, trace, labels)} Over {_WINDOW_S:.0f} s of {where}, {_place(trace, names)}."
    axis = "time [s]" if rows == 1 else f"time [s], measured as means of {_MEAN_S} s"
    return Panel(_place(trace, names), axis, "left by each [Nm]", tuple(marks), alt, where)


def _busiest(trace: Trace) -> tuple[float, float]:
    """Session and begin [s] of the strongest window."""
    best = (-1.0, 0.0, 0.0)
    power = trace.first**2 + trace.second**2
    for session in np.unique(trace.session):
        mine = trace.session == session
        time, total = trace.time[mine], np.concatenate([[0.0], np.cumsum(power[mine])])
        for begin in np.arange(time[0], max(time[0] + 1e-9, time[-1] - _WINDOW_S), 0.5 * _WINDOW_S):
            first, last = np.searchsorted(time, [begin, begin + _WINDOW_S])
            best = max(best, (float(total[last] - total[first]), float(session), float(begin)))
    return best[1], best[2]


def _against(
    pair: LookAlikes, trace: Trace, variable: str, labels: Sequence[str], names: Sequence[str]
) -> list[Panel]:
    """Means in bins of the variable, by direction of motion if the causes depend on it."""
    x = getattr(trace, variable.replace(" ", "_"))
    up = trace.velocity > 0.0
    ways = [("", np.ones(len(x), dtype=bool))]
    if variable != "velocity" and min(up.sum(), (~up).sum()) > _FEW and _differs(trace, x, up):
        ways = [(", moving up", up), (", moving down", ~up)]
    axis, joints = _LABELS[variable], pair.first[1] or pair.second[1]
    if joints:
        axis = axis.replace("position", f"position of {names[joints[0] - 1]}")
    found = []
    for way, mine in ways:
        if np.count_nonzero(mine) < _FEW or np.ptp(x[mine]) <= 0.0:
            continue
        marks = [
            Line(role, label, *bin_means(x[mine], values[mine])[:2])
            for role, label, values in _lines(trace, labels)
        ]
        alt = f"{_shares(pair, trace, labels)} Against {variable}, {_place(trace, names)}{way}."
        note = f"against {variable}"
        found.append(
            Panel(f"{_place(trace, names)}{way}", axis, "left by each [Nm]", tuple(marks), alt, note)
        )
    return found


def _differs(trace: Trace, x: Floats, up: NDArray[np.bool_]) -> bool:
    """Whether either cause depends on the direction of motion."""
    low, high = np.quantile(x, [0.02, 0.98])
    edges = np.linspace(low, high, 13)
    gap = size = 0.0
    for values in (trace.first, trace.second):
        means = []
        for mine in (up, ~up):
            place = np.clip(np.searchsorted(edges, x[mine]) - 1, 0, 11)
            count = np.maximum(np.bincount(place, minlength=12), 1)
            means.append(np.bincount(place, values[mine], minlength=12) / count)
        gap += float(np.mean((means[0] - means[1]) ** 2))
        size += float(np.mean(values**2))
    return gap > _BOTH_WAYS**2 * size


def _shares(pair: LookAlikes, trace: Trace, labels: Sequence[str]) -> str:
    rms = [float(np.sqrt(np.mean(values**2))) for values in (trace.first, trace.second)]
    return (
        f"{labels[0]} would leave {rms[0]:.2g} Nm rms, {labels[1]} {rms[1]:.2g} Nm; overlap {pair.alike:.2f}."
    )


def replay_figures(replayed: ReplayErrors, names: Sequence[str]) -> list[Figure]:
    """One figure for position, motor and joint torque, one panel a joint."""
    figures = []
    for quantity, label, unit, scale in REPLAYED:
        errors = [
            (role, said, scale * replayed.errors[model, quantity])
            for model, (role, said) in zip(("base", "extended"), _MODELS, strict=True)
            if (model, quantity) in replayed.errors
        ]
        if ("base", quantity) not in replayed.errors:
            continue
        panels = []
        for joint, name in enumerate(names):
            lines, rms = [], []
            for role, said, error in errors:
                time = np.linspace(0.0, replayed.duration_s, len(error))
                lines.append(Line(role, said, *thin(time, error[:, joint], _POINTS)))
                rms.append(float(np.sqrt(np.nanmean(error[:, joint] ** 2))))
            note = f"{rms[0]:.3g} {unit} rms" + (f", extended {rms[1]:.3g}" if len(rms) > 1 else "")
            alt = f"Measured minus simulated {label} of {name} over time, {replayed.session}: {note}."
            panels.append(Panel(name, "time [s]", f"error [{unit}]", tuple(lines), alt, note))
        caption = f"Measured minus simulated {label}, {replayed.session}"
        figures.append(Figure(f"replay-{quantity}", caption, tuple(panels)))
    return figures
