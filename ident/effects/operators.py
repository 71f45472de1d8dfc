"""Operators with memory, sample by sample: Dahl's hysteresis and play."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = ["dahl", "first_order", "play"]

Floats = NDArray[np.float64]


@njit(cache=True)
def dahl(path, length, start):  # type: ignore[no-untyped-def]
    """State z (N,) in [-1, 1] of Dahl's friction along `path` (N,): dz = (1 - z sign(dx)) dx / length.

    Integrated exactly over each step, so any step is stable. Dahl, Solid friction damping of mechanical
    vibrations, AIAA Journal 14 (1976).
    """
    out = np.empty(path.shape[0])
    z = start
    out[0] = z
    for k in range(1, path.shape[0]):
        step = path[k] - path[k - 1]
        if step > 0.0:
            z = 1.0 - (1.0 - z) * np.exp(-step / length)
        elif step < 0.0:
            z = -1.0 + (1.0 + z) * np.exp(step / length)
        out[k] = z
    return out


@njit(cache=True)
def play(signal, half_width):  # type: ignore[no-untyped-def]
    """Output (N,) of the play operator of `half_width` driven by `signal` (N,)."""
    out = np.empty(signal.shape[0])
    value = signal[0]
    for k in range(signal.shape[0]):
        if signal[k] - value > half_width:
            value = signal[k] - half_width
        elif value - signal[k] > half_width:
            value = signal[k] + half_width
        out[k] = value
    return out


@njit(cache=True)
def first_order(signal, keep, start):  # type: ignore[no-untyped-def]
    """Low-pass of first order (N,) of `signal` (N,) that keeps the share `keep` of its value each sample."""
    out = np.empty(signal.shape[0])
    value = start
    for k in range(signal.shape[0]):
        value = keep * value + (1.0 - keep) * signal[k]
        out[k] = value
    return out
