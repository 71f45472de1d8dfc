"""The zero-phase Butterworth low-pass, and the power spectrum by Welch's method.

`scipy.signal` has both; its import alone takes longer than an identification. The same sums in the same order: results
equal those of `butter` with `sosfiltfilt` to the last bit, tested against them.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numba import njit
from numpy.typing import NDArray

Floats = NDArray[np.float64]

# Blackman-Harris window of four terms (Harris, Proc. IEEE 66, 1978).
_WINDOW = (0.35875, 0.48829, 0.14128, 0.01168)


def sections(order: int, cutoff: float) -> Floats:
    """Second-order sections (m, 6) of the digital Butterworth low-pass: b0 b1 b2 1 a1 a2 in each row.

    cutoff : -3 dB frequency as a share of half the sampling rate, in (0, 1)

    Analog poles at the unit circle, pre-warped, by the bilinear transform; the pole nearest the unit circle last.
    """
    warped = 4.0 * np.tan(np.pi * cutoff / 2.0)
    analog = warped * -np.exp(1j * np.pi * np.arange(1.0 - order, order, 2.0) / (2 * order))
    gain = warped**order * np.real(1.0 / np.prod(4.0 - analog))
    poles = (4.0 + analog) / (4.0 - analog)
    upper = poles[(order + 1) // 2 :]
    upper = np.where(upper.imag > 0.0, upper, upper.conj())
    found = [[1.0, 2.0, 1.0, *np.convolve([1.0, -pole], [1.0, -pole.conj()]).real] for pole in upper]
    distance = np.abs(1.0 - np.abs(upper)).tolist()
    if order % 2:
        real = poles[order // 2].real
        found.append([1.0, 1.0, 0.0, 1.0, -real, 0.0])
        distance.append(abs(1.0 - abs(real)))
    sos = np.array(found)[np.argsort(-np.array(distance), kind="stable")]
    sos[0, :3] *= gain
    return sos


def steady(sos: Floats) -> Floats:
    """State (sections, 2) of the filter after a long time at the input 1."""
    states, scale = np.empty((len(sos), 2)), 1.0
    for row, section in enumerate(sos):
        b, a = section[:3], section[3:]
        companion = np.array([[-a[1], 1.0], [-a[2], 0.0]])
        states[row] = scale * np.linalg.solve(np.eye(2) - companion, b[1:] - a[1:] * b[0])
        scale *= np.sum(b) / np.sum(a)
    return states


@njit(cache=True, nogil=True)
def _run(sos, states, values):  # type: ignore[no-untyped-def]
    """Filter the columns of `values` (n, k) in place, from `states` (sections, 2, k) on."""
    for i in range(values.shape[0]):
        for j in range(values.shape[1]):
            value = values[i, j]
            for s in range(sos.shape[0]):
                new = sos[s, 0] * value + states[s, 0, j]
                states[s, 0, j] = sos[s, 1] * value - sos[s, 4] * new + states[s, 1, j]
                states[s, 1, j] = sos[s, 2] * value - sos[s, 5] * new
                value = new
            values[i, j] = value


def forward_and_back(sos: Floats, values: Floats, pad: int) -> Floats:
    """Columns of `values` (n, k) filtered in both directions, with odd extensions of `pad` < n rows at the ends."""
    head = 2.0 * values[:1] - values[pad:0:-1]
    tail = 2.0 * values[-1:] - values[-2 : -pad - 2 : -1]
    row = np.concatenate([head, values, tail]) if pad else values.copy()
    state = steady(sos)[:, :, np.newaxis]
    for _ in range(2):
        row = np.ascontiguousarray(row)
        _run(sos, state * row[0], row)
        row = row[::-1]
    return np.ascontiguousarray(row[pad : len(row) - pad])


def spectrum(signal: Floats, dt: float, segment: int) -> tuple[Floats, Floats]:
    """Frequencies [Hz] and power, up to a factor, of a signal (n,) sampled every `dt` seconds, by Welch's method.

    segment : samples of a segment; they overlap by half, without their straight lines, under a Blackman-Harris window
    """
    parts = np.lib.stride_tricks.sliding_window_view(signal, segment)[:: segment - segment // 2]
    time = np.arange(segment) - 0.5 * (segment - 1)
    mean = parts.mean(axis=1, keepdims=True)
    slope = (parts @ time)[:, np.newaxis] / (time @ time)
    power: Floats = (np.abs(np.fft.rfft((parts - mean - slope * time) * _window(segment))) ** 2).mean(axis=0)
    power[1 : len(power) - (segment % 2 == 0)] *= 2.0
    return np.asarray(np.fft.rfftfreq(segment, dt), dtype=np.float64), power


@lru_cache(maxsize=4)
def _window(segment: int) -> Floats:
    """The window (segment,), the same for all joints."""
    angle = 2.0 * np.pi * np.arange(segment) / segment
    window = np.array(_WINDOW) * (1.0, -1.0, 1.0, -1.0) @ np.cos(np.arange(4)[:, np.newaxis] * angle)
    return np.asarray(window, dtype=np.float64)
