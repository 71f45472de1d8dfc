"""Samples beside the reversals of a joint."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d, minimum_filter1d

from ident.dynamics.parameters import Floats


def away_from_reversals(
    speed: Floats, dt: float, window_s: float, standstill_rad_s: float
) -> NDArray[np.bool_]:
    """Samples (n, J) whose joint keeps its direction, faster than standstill, for `window_s` before and after.

    speed : (n, J) every `dt` seconds [rad/s].
    """
    size = 2 * round(window_s / dt) + 1
    lowest, highest = minimum_filter1d(speed, size, axis=0), maximum_filter1d(speed, size, axis=0)
    return np.asarray((lowest > standstill_rad_s) | (highest < -standstill_rad_s))
