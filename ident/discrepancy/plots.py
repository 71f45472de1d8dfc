"""Plots of a diagnosis, where matplotlib is installed."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

import numpy as np

from ident.discrepancy.result import Diagnosis

__all__ = ["write_plots"]


def write_plots(diagnosis: Diagnosis, folder: Path) -> tuple[Path, ...]:
    """Write `residual_SIDE.png`, residual of base and extended model by joint; nothing without matplotlib."""
    try:
        figure: Any = importlib.import_module("matplotlib.figure")
    except ImportError:
        return ()
    written = []
    for side, base in diagnosis.residuals.get("base", {}).items():
        extended = diagnosis.residuals["extended"][side]
        joints = base.shape[1]
        canvas = figure.Figure(figsize=(10.0, 1.6 * joints), layout="constrained")
        axes = canvas.subplots(joints, 1, sharex=True, squeeze=False)[:, 0]
        for joint, axis in enumerate(axes):
            axis.plot(base[:, joint], ".", markersize=1.5, color="tab:orange", label="base")
            if extended.shape == base.shape:
                axis.plot(extended[:, joint], ".", markersize=1.5, color="tab:blue", label="extended")
            limit = (
                float(np.nanquantile(np.abs(base[:, joint]), 0.999))
                if np.isfinite(base[:, joint]).any()
                else 1
            )
            axis.set_ylim(-1.2 * limit, 1.2 * limit)
            axis.set_ylabel(f"joint {joint + 1} [Nm]")
        axes[0].legend(loc="upper right")
        axes[0].set_title(f"Held-out residual of the {side} torque")
        axes[-1].set_xlabel("row")
        path = folder / f"residual_{side}.png"
        canvas.savefig(path, dpi=110)
        written.append(path)
    return tuple(written)
