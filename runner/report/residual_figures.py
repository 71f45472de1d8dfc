"""Held-out residuals and replay errors over their variables, without and with the findings of a diagnosis."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from ident.effects import Parameters, find_effect
from runner.diagnosis.replayed import ReplayErrors
from runner.diagnosis.residuals import Residuals, SideResiduals
from runner.report.figures import bin_means
from runner.report.plot import Band, Line, Mark, Panel, Points, thin
from runner.report.svg import Figure
from sim_backend.monitor import QUANTITIES

__all__ = ["AGAINST", "LABELS", "finding_figure", "replay_figures", "residual_figures"]

Floats = NDArray[np.float64]

AGAINST = ("time", "position", "velocity", "load", "motor angle", "run order")

LABELS = {
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
_QUANTITIES = {
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
    """Held-out residual at the place of a finding, without and with it, over time and over its variable.

    joints : from 1, none for the whole arm. parameters : of the finding. others : joints of other
    findings, which show a cause of the whole arm less clearly. None where there is nothing to show.
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
    caption = f"Where {cause.replace('_', ' ')} shows"
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
        LABELS[against],
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


def replay_figures(replayed: ReplayErrors, names: Sequence[str]) -> list[Figure]:
    """One figure for position, motor and joint torque, one panel a joint."""
    figures = []
    for quantity in QUANTITIES:
        base = replayed.errors.get(("base", quantity))
        if base is None:
            continue
        label, unit, scale = _QUANTITIES[quantity]
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
