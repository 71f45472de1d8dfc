"""Motions as functions of time, for the tests of alignment: approach, periods of a Fourier series, return."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def excitation(
    time: NDArray[np.float64], *, period: float = 5.0, periods: int = 3, seed: int = 5
) -> NDArray[np.float64]:
    """Positions (n, 7) [rad]; begins at 0 s with a rise of 4 s and ends with a fall of 4 s."""
    rng = np.random.default_rng(seed)
    sines, cosines = rng.normal(scale=0.2, size=(2, 7, 5))
    ramp = 4.0
    angle = np.clip(time - ramp, 0.0, period * periods)[:, None, None] * 2 * np.pi / period * np.arange(1, 6)
    wave = (sines * np.sin(angle) + cosines * np.cos(angle)).sum(axis=2)
    rise, fall = (np.clip((time - start) / ramp, 0.0, 1.0) for start in (0.0, ramp + period * periods))
    smooth = [x**3 * (10 - 15 * x + 6 * x * x) for x in (rise, fall)]
    return wave * (smooth[0] * (1.0 - smooth[1]))[:, None]


def loads(position: NDArray[np.float64]) -> NDArray[np.float64]:
    """Torques [Nm] that belong to positions: something smooth, another function for each joint."""
    shift = np.arange(position.shape[1])
    return 30.0 * np.sin(position + shift) + 5.0 * np.cos(3.0 * position - 0.7 * shift)
