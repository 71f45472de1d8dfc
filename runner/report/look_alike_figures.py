"""Two causes that look alike, side by side: what each would leave in the same rows, and what was measured there."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from ident.effects.words import joints_text
from runner.diagnosis.look_alikes import LookAlikes, Trace
from runner.report.figures import bin_means
from runner.report.plot import Line, Mark, Panel, thin
from runner.report.residual_figures import LABELS
from runner.report.svg import Figure

__all__ = ["look_alike_figure"]

Floats = NDArray[np.float64]

_WINDOW_S = 8.0
_POINTS = 500
_MEAN_S = 0.25
_FEW = 60
_BOTH_WAYS = 0.15


def look_alike_figure(pair: LookAlikes, names: Sequence[str]) -> Figure:
    """Panels over time and against what each cause depends on, for the rows in which the two are strongest."""
    labels = [
        f"{cause.replace('_', ' ')}, {joints_text(joints, names)}"
        for cause, joints in (pair.first, pair.second)
    ]
    panels = []
    for trace in pair.traces:
        panels.append(_over_time(pair, trace, labels, names))
        for variable in dict.fromkeys(pair.variables):
            if variable != "time":
                panels += _against(pair, trace, variable, labels, names)
    name = "-".join(
        [
            "look-alike",
            *(
                f"{cause}-{'-'.join(map(str, joints))}".strip("-")
                for cause, joints in (pair.first, pair.second)
            ),
        ]
    )
    caption = f"What {labels[0]} and {labels[1]} would leave in these sessions, overlap {pair.alike:.2f}"
    return Figure(name, caption, tuple(panels))


def _place(trace: Trace, names: Sequence[str]) -> str:
    return f"{names[trace.joint - 1]}, {trace.side} torque"


def _over_time(pair: LookAlikes, trace: Trace, labels: Sequence[str], names: Sequence[str]) -> Panel:
    """The seconds in which there is most to see."""
    session, begin = _busiest(trace)
    inside = (trace.session == session) & (trace.time >= begin) & (trace.time <= begin + _WINDOW_S)
    x = trace.time[inside]
    # Noise of single rows would hide what is to be compared.
    rows = max(1, round(_MEAN_S / float(np.median(np.diff(x))))) if len(x) > 2 else 1
    smooth = uniform_filter1d(trace.measured[inside], rows)
    marks: tuple[Mark, ...] = (
        Line("error", "measured, less the model without either", *thin(x, smooth, _POINTS)),
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
    """Session and time [s] at which the strongest window begins."""
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
    """Means in bins of the variable; for each way of the motion apart where that matters."""
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
            ("error", "measured, less the model without either", trace.measured),
            ("forward", labels[0], trace.first),
            ("backward", labels[1], trace.second),
        ):
            centre, mean, _, _ = bin_means(x[mine], values[mine])
            marks.append(Line(role, label, centre, mean))  # type: ignore[arg-type]
        joints = pair.first[1] or pair.second[1]
        label = (
            LABELS[variable].replace("position", f"position of {names[joints[0] - 1]}")
            if joints
            else LABELS[variable]
        )
        alt = f"{_shares(pair, trace, labels)} Against {variable}, {_place(trace, names)}{', ' * bool(way)}{way}."
        note = f"against {variable}{', ' * bool(way)}{way}"
        found.append(Panel(_place(trace, names), label, "left by each [Nm]", tuple(marks), alt, note))
    return found


def _differs(trace: Trace, x: Floats, up: NDArray[np.bool_]) -> bool:
    """Whether either cause is another one the other way."""
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
