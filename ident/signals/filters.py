"""Zero-phase filters: Butterworth forward and back, derivatives, and the parallel low-pass that
makes rows.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.ndimage import correlate1d

from fri.errors import ConfigurationError

__all__ = [
    "ParallelFilter",
    "block_means",
    "differentiate",
    "interpolate_uniform",
    "low_pass",
    "thinning",
]

FloatArray = NDArray[np.float64]

# Central differences of sixth order: error (w dt)^6 / 140 of the velocity, (w dt)^6 / 560 of the
# acceleration.
_FIRST = np.array([-1.0, 9.0, -45.0, 0.0, 45.0, -9.0, 1.0]) / 60.0
_SECOND = np.array([2.0, -27.0, 270.0, -490.0, 270.0, -27.0, 2.0]) / 180.0
_OUTPUTS = 8


def low_pass(values: FloatArray, dt: float, cutoff_hz: float, order: int = 4) -> FloatArray:
    """Butterworth low-pass of `order` run forward and back over (n, k) values sampled every `dt` seconds.

    Zero phase. The gain is the square of the single pass: -6 dB at the cut-off, roll-off of order 2 x
    `order`.
    """
    nyquist = 0.5 / dt
    if cutoff_hz >= nyquist:
        raise ConfigurationError(
            f"cut-off {cutoff_hz:g} Hz is not below half the sampling rate, {nyquist:g} Hz; lower `cutoff_hz`"
        )
    # Takes a second to import, and most filtering here is by kernels.
    from scipy.signal import butter, sosfiltfilt

    sos = butter(order, cutoff_hz / nyquist, output="sos")
    pad = min(len(values) - 1, int(np.ceil(3.0 / (cutoff_hz * dt))))
    return sosfiltfilt(sos, values, axis=0, padlen=pad)


def differentiate(values: FloatArray, dt: float) -> tuple[FloatArray, FloatArray]:
    """First and second derivative (n, k) by central differences of sixth order; no phase shift."""
    first = correlate1d(values, _FIRST / dt, axis=0, mode="nearest")
    second = correlate1d(values, _SECOND / dt**2, axis=0, mode="nearest")
    return first, second


def interpolate_uniform(values: FloatArray, start: float, dt: float, times: FloatArray) -> FloatArray:
    """Values (n, k) sampled at start + i dt, at other times (m,):
    six-point Lagrange, for band-limited signals.
    """
    position = (times - start) / dt
    nearest = np.rint(position)
    if len(times) and float(np.max(np.abs(position - nearest))) < 1e-6:
        index = np.clip(nearest.astype(np.int64), 0, len(values) - 1)
        if np.all(np.diff(index) == 1):
            return values[index[0] : index[-1] + 1]
        return values[index]
    return _lagrange(np.ascontiguousarray(values), np.ascontiguousarray(position))


@njit(cache=True)
def _lagrange(values, position):  # type: ignore[no-untyped-def]
    rows, columns = len(position), values.shape[1]
    result = np.empty((rows, columns))
    weight = np.empty(6)
    for row in range(rows):
        base = min(max(int(np.floor(position[row])) - 2, 0), max(len(values) - 6, 0))
        offset = position[row] - base
        for node in range(6):
            product = 1.0
            for other in range(6):
                if other != node:
                    product *= (offset - other) / (node - other)
            weight[node] = product
        for column in range(columns):
            total = 0.0
            for node in range(6):
                total += weight[node] * values[base + node, column]
            result[row, column] = total
    return result


def thinning(times: FloatArray, cutoff_hz: float) -> int:
    """Neighbouring samples that may be averaged before a low-pass at `cutoff_hz`: 40 means a period stay."""
    if len(times) < 2:
        return 1
    return max(1, int(1.0 / (40.0 * cutoff_hz * float(np.median(np.diff(times))))))


def block_means(values: NDArray[np.generic], factor: int) -> FloatArray:
    """Means (m // factor, ...) of `factor` neighbours in (m, ...); a remainder at the end is left out."""
    count = len(values) // factor
    grouped = np.asarray(values[: count * factor], dtype=np.float64).reshape(count, factor, -1)
    means = np.einsum("ijk->ik", grouped) / factor
    return means.reshape(count, *values.shape[1:])


@dataclass(frozen=True)
class ParallelFilter:
    """Weighted mean around output times: a Kaiser-windowed sinc, applied alike to torque and regressor
    columns.

    times : (m,) sample times [s], need not be equidistant; outputs : (K,) times of the rows [s]. A row is
        sum_i w_i h(T_k - t_i) x_i / sum_i w_i h(T_k - t_i), with w_i the time that sample i stands for. Any
        such mean of Y = Omega chi holds for the same chi, so irregular or slow sampling does not bias the
        estimate.
    """

    times: FloatArray
    outputs: FloatArray
    cutoff_hz: float
    attenuation_db: float = 40.0

    @property
    def half_width(self) -> float:
        """Half the length of the kernel [s]; the transition band is half the cut-off wide."""
        return half_width(self.cutoff_hz, self.attenuation_db)

    @cached_property
    def sample_weights(self) -> FloatArray:
        """Time that each sample stands for (m,) [s]; capped, so that the ends of a gap do not dominate."""
        step = np.diff(self.times)
        typical = float(np.median(step)) if len(step) else 1.0
        step = np.minimum(step, 2.0 * typical)
        return 0.5 * (np.append(step, step[-1:]) + np.append(step[:1], step))

    def apply(self, values: FloatArray) -> FloatArray:
        """Filtered (K, ...) of values (m, ...)."""
        flat = values.reshape(len(values), -1)
        result = np.empty((len(self.outputs), flat.shape[1]))
        for rows, samples, weights in self.blocks():
            result[rows] = weights @ flat[samples]
        return result.reshape(len(self.outputs), *values.shape[1:])

    def share(self, flagged: NDArray[np.generic]) -> FloatArray:
        """Share (K, ...) of the kernel's absolute weight that falls on flagged samples (m, ...),
        bool or 0 to 1.
        """
        flat = flagged.reshape(len(flagged), -1)
        result = np.zeros((len(self.outputs), flat.shape[1]))
        if flat.any():
            for rows, samples, weights in self.blocks():
                size = np.abs(weights)
                result[rows] = (size @ flat[samples]) / size.sum(axis=1, keepdims=True)
        return result.reshape(len(self.outputs), *flagged.shape[1:])

    def coverage(self) -> FloatArray:
        """Share (K,) of the kernel's absolute area that the samples cover: a gap or an end leaves less."""
        whole = np.linspace(-self.half_width, self.half_width, 2001)
        area = float(np.mean(np.abs(self._kernel(np.abs(whole))))) * 2.0 * self.half_width
        result = np.empty(len(self.outputs))
        for rows, _, kernel in self._kernels():
            result[rows] = np.abs(kernel).sum(axis=1) / area
        return result

    def blocks(self, size: int = _OUTPUTS) -> Iterator[tuple[slice, slice, FloatArray]]:
        """Rows, samples and dense weights (rows, samples) of a few outputs at a time; bounds the memory."""
        for rows, samples, kernel in self._kernels(size):
            total = kernel.sum(axis=1, keepdims=True)
            yield rows, samples, kernel / np.where(total != 0.0, total, 1.0)

    def _kernels(self, size: int = _OUTPUTS) -> Iterator[tuple[slice, slice, FloatArray]]:
        """Like `blocks`, not normalised. On a regular grid equal offsets share one kernel."""
        half, weight = self.half_width, self.sample_weights
        regular = _regular(self.times) and _regular(self.outputs)
        known: dict[tuple[int, int, int], FloatArray] = {}
        for first in range(0, len(self.outputs), size):
            outputs = self.outputs[first : first + size]
            low = int(np.searchsorted(self.times, outputs[0] - half))
            high = int(np.searchsorted(self.times, outputs[-1] + half, side="right"))
            inner = regular and low > 0 and high < len(self.times)
            key = (len(outputs), high - low, round(1e9 * (outputs[0] - self.times[low]))) if inner else None
            kernel = known.get(key) if key is not None else None
            if kernel is None:
                distance = np.abs(outputs[:, None] - self.times[None, low:high])
                kernel = self._kernel(distance) * weight[low:high]
                if key is not None:
                    known[key] = kernel
            yield slice(first, first + len(outputs)), slice(low, high), kernel

    @cached_property
    def _table(self) -> tuple[FloatArray, FloatArray]:
        time = np.linspace(0.0, self.half_width, 4097)
        return time, np.sinc(2.0 * self.cutoff_hz * time) * _kaiser(
            time / self.half_width, self.attenuation_db
        )

    def _kernel(self, distance: FloatArray) -> FloatArray:
        time, value = self._table
        return np.interp(distance, time, value, right=0.0)


def _regular(times: FloatArray) -> bool:
    """Whether the times are equidistant to a nanosecond."""
    if len(times) < 3:
        return True
    step = (times[-1] - times[0]) / (len(times) - 1)
    return float(np.max(np.abs(times - times[0] - step * np.arange(len(times))))) < 1e-9


def half_width(cutoff_hz: float, attenuation_db: float) -> float:
    """Half length [s] of the Kaiser-windowed sinc whose transition band is half the cut-off wide."""
    return (attenuation_db - 7.95) / (2.285 * 2.0 * np.pi * 0.5 * cutoff_hz) / 2.0


def _kaiser(position: FloatArray, attenuation_db: float) -> FloatArray:
    # Kaiser, Proc. IEEE ISCAS (1974), for attenuations above 50 dB and from 21 dB on
    above = max(attenuation_db - 21.0, 0.0)
    beta = 0.1102 * (attenuation_db - 8.7) if attenuation_db > 50.0 else 0.5842 * above**0.4 + 0.07886 * above
    return np.i0(beta * np.sqrt(np.maximum(1.0 - position**2, 0.0))) / np.i0(beta)
