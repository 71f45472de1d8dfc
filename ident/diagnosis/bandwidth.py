"""The band that a channel still holds: data that were low-passed before they were published."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["passed_band"]

Floats = NDArray[np.float64]

# Share of the power above a quarter of the sampling rate below which no sensor's noise is left: the step of
# a 17-bit converter makes more.
_SILENT = 1e-10
# Share of the power that lies above the band's edge.
_BEYOND = 1e-6
_LEAST = 64


def passed_band(values: Floats, dt: float) -> float | None:
    """Upper edge [Hz] of what a low-pass left of the signals (N, k), None where they were not filtered.

    A measured torque holds the noise of its sensor at every frequency. Where the upper half of the band is
    silent, somebody took it out, and with it whatever happened faster than the edge.
    """
    if len(values) < _LEAST:
        return None
    moving = np.ptp(values, axis=0) > 0.0
    if not moving.any():
        return None
    signal = values[:, moving] - values[:, moving].mean(axis=0)
    power = np.abs(np.fft.rfft(signal * np.hanning(len(signal))[:, None], axis=0)) ** 2
    above = np.cumsum(power[::-1], axis=0)[::-1] / power.sum(axis=0)
    frequency = np.fft.rfftfreq(len(signal), dt)
    if np.any(above[np.searchsorted(frequency, 0.25 / dt)] > _SILENT):
        return None
    return float(np.max(frequency[np.argmax(above < _BEYOND, axis=0)]))
