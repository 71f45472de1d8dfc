"""Figures of a diagnosis: held-out residuals, look-alikes side by side, errors of the replay."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from ident.diagnosis.look_alikes import LookAlikes, Trace
from ident.effects import Parameters, find_effect
from ident.effects.words import joints_text, spoken
from runner.diagnosis.records import QUANTITIES, ReplayErrors, Residuals, SideResiduals
from runner.report.figures import bin_means
from runner.report.plot import Band, Figure, Line, Mark, Panel, Points
from runner.report.thinning import thin

__all__ = ["AGAINST", "finding_figure", "look_alike_figure", "replay_figures", "residual_figures"]

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
_NEITHER = "measured minus the model without either"
_REPLAYED = {
    "position": ("position", "mrad", 1e3),
    "motor": ("motor torque", "Nm", 1.0),
    "joint": ("joint torque", "Nm", 1.0),
}


def residual_figures(residuals: Residuals, side: str) -> list[Figure]:
    """One figure a quantity, one panel a joint."""
    rows = residuals.sides[side]
    return [_figure(residuals, rows, side, against) for against in AGAINST]


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
    about a cause of the whole arm. None without residuals to show.
    """
    seen = {"motor": ("motor",), "sensor": ("joint",)}.get(side, ("motor", "joint"))
    effect = find_effect(cause)
    if effect.channel == "motor":
        seen = ("motor",)
    fall: dict[tuple[str, int], float] = {}
    for name in seen:
        rows = residuals.sides.get(name)
        for joint in range(len(residuals.joint_names)) if rows is not None else ():
            assert rows is not None
            base, extended = rows.base[:, joint], rows.extended[:, joint]
            if np.isfinite(base).any() and (not joints or joint + 1 in joints):
                fall[name, joint] = 1.0 - float(np.nanmean(extended**2) / np.nanmean(base**2))
    clear = {key: value for key, value in fall.items() if key[1] + 1 not in others}
    if not joints and clear:
        fall = clear
    panels = []
    for name, joint in sorted(fall, key=lambda key: -fall[key])[:_PLACES]:
        for against in dict.fromkeys((effect.variable(parameters), "time")):
            panels.append(_panel(residuals, residuals.sides[name], name, joint, against, with_side=True))
    where = "-".join(map(str, joints)) or "arm"
    caption = f"Where {spoken(cause)} shows"
    return Figure(f"finding-{cause}-{where}", caption, tuple(panels)) if panels else None


def _figure(residuals: Residuals, rows: SideResiduals, side: str, against: str) -> Figure:
    panels = [
        _panel(residuals, rows, side, joint, against)
        for joint in range(len(residuals.joint_names))
        if np.isfinite(rows.base[:, joint]).any()
    ]
    caption = f"Held-out residual of the {side} torque against {against}"
    return Figure(f"residual-{side}-{against.replace(' ', '-')}", caption, tuple(panels))


def _panel(
    residuals: Residuals, rows: SideResiduals, side: str, joint: int, against: str, *, with_side: bool = False
) -> Panel:
    name = residuals.joint_names[joint]
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


def _abscissa(residuals: Residuals, rows: SideResiduals, joint: int, against: str) -> Floats:
    if against == "position":
        return rows.position[:, joint]
    if against == "velocity":
        return rows.speed[:, joint]
    if against == "load":
        return rows.load[:, joint]
    turns = rows.position[:, joint] * residuals.gear_ratio[joint] / (2.0 * np.pi)
    return np.asarray(turns - np.floor(turns))


def _models(residuals: Residuals, rows: SideResiduals, joint: int) -> list[tuple[str, str, Floats]]:
    found = [("backward", "base model", rows.base[:, joint])]
    if residuals.named:
        found.append(("forward", "extended model", rows.extended[:, joint]))
    return found


def _binned_marks(residuals: Residuals, rows: SideResiduals, joint: int, against: str) -> list[Mark]:
    marks: list[Mark] = []
    x = _abscissa(residuals, rows, joint, against)
    for role, label, values in _models(residuals, rows, joint):
        good = np.isfinite(values) & np.isfinite(x)
        if np.count_nonzero(good) < 10 or np.ptp(x[good]) <= 0.0:
            continue
        centre, mean, low, high = bin_means(x[good], values[good])
        if role == "backward":
            marks.append(Band("spread", "5 to 95 % of the rows, base model", centre, low, high))
        marks.append(Line(role, f"{label}, mean", centre, mean))  # type: ignore[arg-type]
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
            centre, mean, low, high = bin_means(time - time[0] + offset, values[mine])
            if role == "backward":
                marks.append(Band("spread", "5 to 95 % of the rows, base model", centre, low, high))
            marks.append(Line(role, f"{label}, mean", centre, mean))  # type: ignore[arg-type]
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
            marks.append(
                Points(role, f"{label}, mean of a block", np.array(places), np.array(means), np.array(bars))  # type: ignore[arg-type]
            )
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


def _over_time(pair: LookAlikes, trace: Trace, labels: Sequence[str], names: Sequence[str]) -> Panel:
    """The seconds of the largest torques."""
    session, begin = _busiest(trace)
    inside = (trace.session == session) & (trace.time >= begin) & (trace.time <= begin + _WINDOW_S)
    x = trace.time[inside]
    # Noise of single rows would hide the comparison.
    rows = max(1, round(_MEAN_S / float(np.median(np.diff(x))))) if len(x) > 2 else 1
    smooth = uniform_filter1d(trace.measured[inside], rows)
    marks: tuple[Mark, ...] = (
        Line("error", _NEITHER, *thin(x, smooth, _POINTS)),
        Line("forward", labels[0], *thin(x, trace.first[inside], _POINTS)),
        Line("backward", labels[1], *thin(x, trace.second[inside], _POINTS)),
    )
    number = int(session)
    where = pair.sessions[number] if number < len(pair.sessions) else f"session {number + 1}"
    alt = f"{_shares(pair, trace, labels)} Over {_WINDOW_S:.0f} s of {where}, {_place(trace, names)}."
    return Panel(
        _place(trace, names),
        "time [s]" if rows == 1 else f"time [s], measured as means of {_MEAN_S} s",
        "left by each [Nm]",
        marks,
        alt,
        where,
    )


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
    x = {
        "position": trace.position,
        "velocity": trace.velocity,
        "load": trace.load,
        "motor angle": trace.motor_angle,
    }[variable]
    up = trace.velocity > 0.0
    everywhere = np.ones(len(x), dtype=bool)
    ways = [("", everywhere)]
    if variable != "velocity" and min(up.sum(), (~up).sum()) > _FEW and _differs(trace, x, up):
        ways = [("moving up", up), ("moving down", ~up)]
    found = []
    for way, mine in ways:
        if np.count_nonzero(mine) < _FEW or np.ptp(x[mine]) <= 0.0:
            continue
        marks: list[Mark] = []
        for role, label, values in (
            ("error", _NEITHER, trace.measured),
            ("forward", labels[0], trace.first),
            ("backward", labels[1], trace.second),
        ):
            centre, mean, _, _ = bin_means(x[mine], values[mine])
            marks.append(Line(role, label, centre, mean))  # type: ignore[arg-type]
        joints = pair.first[1] or pair.second[1]
        label = (
            _LABELS[variable].replace("position", f"position of {names[joints[0] - 1]}")
            if joints
            else _LABELS[variable]
        )
        alt = f"{_shares(pair, trace, labels)} Against {variable}, {_place(trace, names)}{', ' * bool(way)}{way}."
        note = f"against {variable}{', ' * bool(way)}{way}"
        found.append(Panel(_place(trace, names), label, "left by each [Nm]", tuple(marks), alt, note))
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
    for quantity in QUANTITIES:
        base = replayed.errors.get(("base", quantity))
        if base is None:
            continue
        label, unit, scale = _REPLAYED[quantity]
        panels = []
        for joint, name in enumerate(names):
            marks: list[Mark] = []
            rms = []
            for model, role, said in (
                ("base", "backward", "base model"),
                ("extended", "forward", "extended model"),
            ):
                error = replayed.errors.get((model, quantity))
                if error is None:
                    continue
                values = scale * error[:, joint]
                time = np.linspace(0.0, replayed.duration_s, len(values))
                marks.append(Line(role, said, *thin(time, values, _POINTS)))  # type: ignore[arg-type]
                rms.append(float(np.sqrt(np.nanmean(values**2))))
            note = f"{rms[0]:.3g} {unit} rms" + (f", extended {rms[1]:.3g}" if len(rms) > 1 else "")
            alt = f"Measured minus simulated {label} of {name} over time, {replayed.session}: {note}."
            panels.append(Panel(name, "time [s]", f"error [{unit}]", tuple(marks), alt, note))
        caption = f"Measured minus simulated {label}, {replayed.session}"
        figures.append(Figure(f"replay-{quantity}", caption, tuple(panels)))
    return figures
