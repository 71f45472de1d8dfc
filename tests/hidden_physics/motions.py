"""Exciting motions from seeds, for sessions of the same length."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
from hidden_physics.recording import PERIOD_MS

from fri.errors import RefusedError
from ident.excitation import ExcitationPlan, feasible_fourier
from lwr_driver.arm import Arm
from lwr_driver.cell import Cell
from lwr_driver.collision import CollisionChecker
from lwr_driver.motion import Motion, check_motion

__all__ = ["PERIODS", "PERIOD_S", "REST_S", "exciting_motion"]

PERIOD_S = 10.0
PERIODS = 2
REST_S = 0.4
"""Rest before and after the periods [s]."""

_HARMONICS = 5
_SPEED_SCALE = 0.8


def exciting_motion(seed: int, store: Path | None = None, periods: int = PERIODS) -> Motion:
    """Motion number `seed`: rest, whole periods of a Fourier series, rest; at rest where they join.

    store : folder in which plans are kept, so that the same seed need not be planned twice
    """
    plan = _plan(seed, store)
    period = PERIOD_MS * 1e-3
    q = plan.rows(period, periods)
    length, rest = (len(q) - 1) // periods, round(REST_S / period)
    rows = np.vstack([np.tile(q[:1], (rest, 1)), q, np.tile(q[-1:], (rest, 1))])
    phases = (
        (0, "settle"),
        *((rest + index * length, f"period {index + 1}") for index in range(periods)),
        (rest + periods * length, "brake"),
    )
    motion = Motion(rows, period, phases)
    check_motion(Arm.load(), motion)
    return motion


@cache
def _plan(seed: int, store: Path | None) -> ExcitationPlan:
    path = None if store is None else store / f"motion_{seed}.yaml"
    if path is not None and path.is_file():
        return ExcitationPlan.load(path)
    arm = Arm.load()
    checker = CollisionChecker(arm, Cell.load("cell.yaml"))
    for trial in range(20):
        try:
            plan = feasible_fourier(
                arm,
                checker,
                period_s=PERIOD_S,
                harmonics=_HARMONICS,
                periods=PERIODS,
                seed=1000 * seed + trial,
                speed_scale=_SPEED_SCALE,
            )
        except RefusedError:
            continue
        break
    else:
        raise RuntimeError(f"no motion for seed {seed}")
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        plan.save(path)
    return plan
