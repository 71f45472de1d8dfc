"""Exciting motions of all hidden sessions.

Each schedule is three motions: without payload, with payload, and one held out, with payload. They were
chosen among thirty random feasible Fourier motions so that the parameters found on the first two predict the
third within a third of the noise: what is then wrong in a prediction is what was hidden.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np

from ident.excitation import ExcitationPlan
from lwr_driver.arm import Arm
from lwr_driver.motion import Motion, check_motion
from tests.hidden_physics.recording import PERIOD_MS

__all__ = ["PERIODS", "PERIOD_S", "REST_S", "SCHEDULES", "exciting_motion"]

PERIOD_S = 10.0
PERIODS = 2
REST_S = 0.4
"""Rest before and after the periods [s]."""

SCHEDULES = ("A", "B", "C", "D")
"""Schedule X has the motions X1 (no payload), X2 (payload) and X3 (payload, held out)."""

_FOLDER = Path(__file__).parent / "plans"


@cache
def exciting_motion(name: str, periods: int = PERIODS) -> Motion:
    """The motion `name`: rest, whole periods of a Fourier series, rest; at rest where they join."""
    plan = ExcitationPlan.load(_FOLDER / f"{name}.yaml")
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
