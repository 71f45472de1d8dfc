"""Measured less simulated over time, with the base model and with the extended one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from runner.diagnosis.replayed import QUANTITIES, ReplayErrors
from runner.report.plot import Figure, Line, Mark, Panel
from runner.report.thinning import thin

__all__ = ["replay_figures"]

_POINTS = 500
_LABELS = {
    "position": ("position", "mrad", 1e3),
    "motor": ("motor torque", "Nm", 1.0),
    "joint": ("joint torque", "Nm", 1.0),
}


def replay_figures(replayed: ReplayErrors, names: Sequence[str]) -> list[Figure]:
    """One figure for position, motor and joint torque, one panel a joint."""
    figures = []
    for quantity in QUANTITIES:
        base = replayed.errors.get(("base", quantity))
        if base is None:
            continue
        label, unit, scale = _LABELS[quantity]
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
            alt = f"Measured less simulated {label} of {name} over time, {replayed.session}: {note}."
            panels.append(Panel(name, "time [s]", f"error [{unit}]", tuple(marks), alt, note))
        caption = f"Measured less simulated {label}, {replayed.session}"
        figures.append(Figure(f"replay-{quantity}", caption, tuple(panels)))
    return figures
