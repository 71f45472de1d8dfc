"""Held-out residuals against all that they may depend on, without and with the findings of a diagnosis."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from runner.diagnosis.residuals import Residuals, SideResiduals
from runner.report.figures import bin_means
from runner.report.plot import Band, Figure, Line, Mark, Panel, Points

__all__ = ["AGAINST", "residual_figures"]

Floats = NDArray[np.float64]

AGAINST = ("time", "position", "velocity", "load", "motor angle", "run order")

_LABELS = {
    "time": "time, the sessions one after the other [s]",
    "position": "position [rad]",
    "velocity": "velocity [rad/s]",
    "load": "predicted joint torque [Nm]",
    "motor angle": "motor angle [turns]",
    "run order": "block of the run",
}
_GAP_S = 2.0


def residual_figures(residuals: Residuals, side: str) -> list[Figure]:
    """One figure a quantity, one panel a joint."""
    rows = residuals.sides[side]
    return [_figure(residuals, rows, side, against) for against in AGAINST]


def _figure(residuals: Residuals, rows: SideResiduals, side: str, against: str) -> Figure:
    panels = []
    marks_of = _MARKS.get(against, _binned_marks)
    for joint, name in enumerate(residuals.joint_names):
        used = np.isfinite(rows.base[:, joint])
        if not used.any():
            continue
        rms = [float(np.sqrt(np.nanmean(part[used, joint] ** 2))) for part in (rows.base, rows.extended)]
        note = f"{rms[0]:.3g} Nm rms" + (f", extended {rms[1]:.3g}" if residuals.named else "")
        panels.append(
            Panel(
                name,
                _LABELS[against],
                "residual [Nm]",
                tuple(marks_of(residuals, rows, joint, against)),
                f"Held-out residual of the {side} torque of {name} against {against}: {note}.",
                note,
            )
        )
    caption = f"Held-out residual of the {side} torque against {against}"
    return Figure(f"residual-{side}-{against.replace(' ', '-')}", caption, tuple(panels))


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
