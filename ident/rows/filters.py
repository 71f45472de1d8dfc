"""Signal settings, zero-phase filters and cut-off frequencies, from raw channels to rows of the regression.

The filters are Butterworth forward and back, central differences, and the parallel low-pass to the row rate.
The spectrum of the motion gives the excitation, and with it the band of the rows.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from math import prod
from typing import Annotated, Literal

import numpy as np
from numba import njit
from numpy.typing import NDArray

from fri.errors import ConfigurationError
from fri.quantities import Name, within
from ident.dynamics.parameters import Floats
from ident.dynamics.structure import Coupling, EncoderSide
from ident.rows.butterworth import forward_and_back, sections, spectrum
from ident.rows.reversals import TURNING_RAD

# The paper's filters, section 5, and a time beside reversals that covers the turning of a strain-wave drive.
CUTOFF_HZ, DECIMATE_HZ, REVERSAL_S = 10.0, 2.0, 0.05
# Highest cut-off over the sampling rate: differences lose accuracy beyond.
NYQUIST_SHARE = 0.2


Frequency = Annotated[float, within(0.0, 1e5, "Hz", above=True)]
_Span = Annotated[float, within(0.0, 1e5, "s")]
DelaySetting = Annotated[float, within(-10.0, 10.0, "s")] | Literal["estimate"]


@dataclass(frozen=True)
class SignalSettings:
    """Settings from raw channels to rows. None is chosen from the data: see `ident.rows.signal_choice`.

    cutoff_hz, order : Butterworth low-pass on the positions, run forward and back. Phase is zero, the gain
        is the square of the filter's: -6 dB at `cutoff_hz`, and the roll-off of order 2 x `order`.
    decimate_hz : -6 dB frequency of the parallel low-pass. Torque and every regressor column, Coulomb columns
        included, pass this same filter, so that it cannot bias the estimate.
    rate_hz : rate of the rows, None takes 2.5 x `decimate_hz` (80 % of the band is kept).
    attenuation_db : stop band of the parallel low-pass.
    average_periods : average the rows of all periods; their scatter gives the noise variance.
    edge_s : time lost at each end of an uninterrupted stretch to the transients of the Butterworth filter,
        None takes 2 / `cutoff_hz`.
    longest_bridge_s : longest gap bridged by interpolation; a longer one splits the record.
    reversal_s : samples of a joint this close to its reversal have no part in its rows, because friction turns
        there in a way that no sign function follows (presliding, stiction, a motor that reverses later).
    turning_rad : nor have samples of a joint that has not gone this far since its reversal or rest: presliding turns
        over a path.
    slow_rad_s : samples of a joint not faster than this have no part in its rows, because friction of many drives
        falls with the speed (Stribeck).
    standstill_rad_s : a joint below this speed rests, and its Coulomb torque is unknown.
    known_share : least share of a row's filter on samples measured and away from reversals.
    outlier_scale : distance of an outlier from the running median, in robust standard deviations.
    motor_delay_s : delay of the motor torques against the positions [s], or "estimate" to estimate it from the data.
    joint_delay_s : that of the joint torques; below zero the positions are late.
    delay_search_s : largest delay of the motor torques searched, in both directions.
    stiffness_nm_rad : of the joints, for the motors' motion against the links: the joint torque twists a joint, and
        the drive's friction and inertia act on the motor. Without it an elastic joint makes the motor channel look
        early by Fvm / stiffness. None: rigid joints.
    encoder : `link` or `motor`, the side of the elastic joints that the positions come from. Those of the motors are
        the links' plus the twist, joint torque / stiffness. None: told by the data where the stiffness is known.
    coupled : pairs of joints whose drives are coupled, see `Coupling`. Samples beside a reversal of the drive that they
        share have no part in the rows of both.
    """

    cutoff_hz: Frequency | None = None
    order: Annotated[int, within(1, 20)] = 4
    decimate_hz: Frequency | None = None
    rate_hz: Frequency | None = None
    attenuation_db: Annotated[float, within(0.0, 300.0, "dB", above=True)] = 40.0
    average_periods: bool = False
    edge_s: _Span | None = None
    longest_bridge_s: _Span = 0.02
    reversal_s: _Span | None = None
    turning_rad: Annotated[float, within(0.0, 1.0, "rad")] | None = None
    slow_rad_s: Annotated[float, within(0.0, 100.0, "rad/s")] | None = None
    standstill_rad_s: Annotated[float, within(0.0, 100.0, "rad/s")] = 2e-3
    known_share: Annotated[float, within(0.0, 1.0, "share")] = 0.4
    outlier_scale: Annotated[float, within(0.0, 1e6, above=True)] = 8.0
    motor_delay_s: DelaySetting = "estimate"
    joint_delay_s: DelaySetting = "estimate"
    delay_search_s: Annotated[float, within(0.0, 10.0, "s", above=True)] = 0.1
    stiffness_nm_rad: tuple[Annotated[float, within(0.0, 1e12, "Nm/rad", above=True)], ...] | None = None
    encoder: EncoderSide | None = None
    coupled: tuple[tuple[Name, Name], ...] = ()

    def __post_init__(self) -> None:
        positive = (
            "cutoff_hz",
            "order",
            "decimate_hz",
            "rate_hz",
            "attenuation_db",
            "outlier_scale",
            "delay_search_s",
        )
        for name in positive:
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise ConfigurationError(f"`{name}` is {value}, it must be positive")
        if self.stiffness_nm_rad is not None and min(self.stiffness_nm_rad, default=0.0) <= 0.0:
            raise ConfigurationError(
                f"`stiffness_nm_rad` is {self.stiffness_nm_rad}, every value must be positive"
            )
        if self.reversal_s is not None and not self.reversal_s >= 0.0:
            raise ConfigurationError(f"`reversal_s` is {self.reversal_s}, it must be zero or positive")
        if None not in (self.decimate_hz, self.cutoff_hz) and self.decimate > self.cutoff:
            raise ConfigurationError(
                f"`decimate_hz` {self.decimate_hz} exceeds `cutoff_hz` {self.cutoff_hz}; the parallel "
                "filter must be the narrower one, lower `decimate_hz` or raise `cutoff_hz`"
            )

    def settled(self, rate_hz: float) -> SignalSettings:
        """With the figures of the paper where none is stated, as far as a channel of `rate_hz` carries them."""
        cutoff = min(CUTOFF_HZ, NYQUIST_SHARE * rate_hz) if self.cutoff_hz is None else self.cutoff_hz
        decimate = min(DECIMATE_HZ, cutoff / 1.5) if self.decimate_hz is None else self.decimate_hz
        cutoff = max(cutoff, decimate)
        return replace(
            self,
            cutoff_hz=cutoff,
            decimate_hz=decimate,
            reversal_s=self.reversal,
            turning_rad=self.turning,
            slow_rad_s=self.slow,
        )

    @property
    def cutoff(self) -> float:
        """Cut-off of the positions [Hz]."""
        return CUTOFF_HZ if self.cutoff_hz is None else self.cutoff_hz

    @property
    def decimate(self) -> float:
        """Cut-off of the parallel low-pass [Hz]."""
        return DECIMATE_HZ if self.decimate_hz is None else self.decimate_hz

    @property
    def reversal(self) -> float:
        """Time left out on either side of a reversal [s]."""
        return REVERSAL_S if self.reversal_s is None else self.reversal_s

    @property
    def turning(self) -> float:
        """Path left out after a reversal [rad]; none beside a reversal that stays."""
        if self.turning_rad is None:
            return TURNING_RAD if self.reversal > 0.0 else 0.0
        return self.turning_rad

    @property
    def slow(self) -> float:
        """Speed from which on a joint's samples are in its rows [rad/s]."""
        return 0.0 if self.slow_rad_s is None else self.slow_rad_s

    @property
    def row_rate_hz(self) -> float:
        """Rate of the rows [Hz]."""
        return self.rate_hz if self.rate_hz is not None else 2.5 * self.decimate

    @property
    def joint_delay(self) -> float:
        """Delay of the joint torques in use [s], zero until it is estimated."""
        return 0.0 if self.joint_delay_s == "estimate" else float(self.joint_delay_s)

    def of_coupled(self, couplings: Iterable[Coupling]) -> SignalSettings:
        """The same for an arm with these couplings, where none are stated."""
        return replace(self, coupled=self.coupled or tuple(pair.joints for pair in couplings))

    def coupled_places(self, joint_names: Sequence[str]) -> tuple[tuple[int, int], ...]:
        """Numbers (from 0) of the pairs of coupled joints that are among these."""
        return tuple(
            (joint_names.index(a), joint_names.index(b))
            for a, b in self.coupled
            if a in joint_names and b in joint_names
        )

    @property
    def takes_links_back(self) -> bool:
        """Whether rows have the links' motion, taken back from positions of the motors by the stiffness."""
        return self.encoder == "motor" and self.stiffness_nm_rad is not None

    @property
    def punctual(self) -> SignalSettings:
        """The same with no channel late."""
        return replace(self, motor_delay_s=0.0, joint_delay_s=0.0)

    @property
    def edge(self) -> float:
        """Time lost at each end to the Butterworth filter [s]."""
        return self.edge_s if self.edge_s is not None else 2.0 / self.cutoff


# Central differences of sixth order: error (w dt)^6 / 140 of the velocity, (w dt)^6 / 560 of the
# acceleration.
_FIRST = np.array([-1.0, 9.0, -45.0, 0.0]) / 60.0
_SECOND = np.array([2.0, -27.0, 270.0, -490.0]) / 180.0
_OUTPUTS = 8
# Weights that a filter keeps, at most: 8 MB.
_MOST_KEPT = 2**20


def low_pass(values: Floats, dt: float, cutoff_hz: float, order: int = 4) -> Floats:
    """Butterworth low-pass of `order` run forward and back over (n, k) values sampled every `dt` seconds.

    Zero phase. The gain is that of the single pass squared: -6 dB at the cut-off, roll-off of order 2 x `order`.
    """
    nyquist = 0.5 / dt
    if cutoff_hz >= nyquist:
        raise ConfigurationError(
            f"cut-off {cutoff_hz:g} Hz is not below half the sampling rate, {nyquist:g} Hz; lower `cutoff_hz`"
        )
    pad = min(len(values) - 1, int(np.ceil(3.0 / (cutoff_hz * dt))))
    return forward_and_back(sections(order, cutoff_hz / nyquist), values, pad)


def settling(cutoff_hz: float, order: int = 4) -> float:
    """Time [s] in which the slowest pole of a Butterworth low-pass decays to 1e-17, its overlap between blocks."""
    return 40.0 / (2.0 * np.pi * cutoff_hz * np.sin(0.5 * np.pi / order))


def differentiate(values: Floats, dt: float) -> tuple[Floats, Floats]:
    """First and second derivative (n, k) by central differences of sixth order; no phase shift."""
    return _differences(np.ascontiguousarray(values, dtype=np.float64), _FIRST / dt, _SECOND / dt**2)


@njit(cache=True, nogil=True)
def _differences(values, first, second):  # type: ignore[no-untyped-def]
    """Sums (n, k) of neighbours of (n, k) values; beyond the ends stand the first and the last one.

    first, second : weights of the neighbours from `reach` samples before up to the sample itself; those behind it have
    the opposite and the same ones.
    """
    rows, columns, reach = len(values), values.shape[1], len(first) - 1
    speed, change = np.empty((rows, columns)), np.empty((rows, columns))
    for row in range(rows):
        for column in range(columns):
            one, other = 0.0, second[reach] * values[row, column]
            for node in range(reach):
                before = values[max(row + node - reach, 0), column]
                later = values[min(row + reach - node, rows - 1), column]
                one += first[node] * (before - later)
                other += second[node] * (before + later)
            speed[row, column], change[row, column] = one, other
    return speed, change


def interpolate_uniform(values: Floats, start: float, dt: float, times: Floats) -> Floats:
    """Values (n, k), sampled at start + i dt, at other times (m,): six-point Lagrange for band-limited signals."""
    position = (times - start) / dt
    nearest = np.rint(position)
    if len(times) and float(np.max(np.abs(position - nearest))) < 1e-6:
        index = np.clip(nearest.astype(np.int64), 0, len(values) - 1)
        if np.all(np.diff(index) == 1):
            return values[index[0] : index[-1] + 1]
        return values[index]
    return _lagrange(np.ascontiguousarray(values), np.ascontiguousarray(position))


def ahead(values: Floats, dt: float, by_s: float) -> Floats:
    """Values (n, k) of a channel at times `by_s` after its own, the first and last value beyond its ends."""
    if by_s == 0.0:
        return values
    place = np.clip(np.arange(len(values)) + by_s / dt, 0.0, len(values) - 1.0)
    return interpolate_uniform(values, 0.0, 1.0, place)


@njit(cache=True, nogil=True)
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


def thinning(period_s: float, cutoff_hz: float) -> int:
    """Number of neighbouring samples to average before a low-pass at `cutoff_hz`: 40 means a period stay.

    period_s : median time between samples [s]; NaN for a single one.
    """
    return max(1, int(1.0 / (40.0 * cutoff_hz * period_s))) if period_s > 0.0 else 1


def enough(count: int, period_s: float, cutoff_hz: float) -> bool:
    """Whether samples make two means of `thinning`, the fewest with a time between them; fewer fill no row's filter."""
    return count >= 2 * thinning(period_s, cutoff_hz)


def median_step(times: Floats) -> float:
    """Median time between samples [s], NaN for less than two."""
    return float(np.median(np.diff(times))) if len(times) > 1 else float("nan")


def resampled(times: Floats, values: Floats, wanted: Floats) -> Floats:
    """Columns of `values` at the times `wanted`, by linear interpolation."""
    return np.column_stack([np.interp(wanted, times, column) for column in values.T])


def block_means(values: NDArray[np.generic], factor: int) -> Floats:
    """Means (m // factor, ...) of `factor` neighbours in (m, ...); a remainder at the end is left out."""
    count = len(values) // factor
    used = np.asarray(values[: count * factor], dtype=np.float64)
    grouped = used.reshape(count, factor, prod(values.shape[1:]))
    means = np.einsum("ijk->ik", grouped) / factor
    return means.reshape(count, *values.shape[1:])


@dataclass(frozen=True)
class ParallelFilter:
    """Weighted mean around output times: a Kaiser-windowed sinc, the same for torque and regressor columns.

    times : (m,) sample times [s], need not be equidistant; outputs : (K,) times of the rows [s]. A row is
        sum_i w_i h(T_k - t_i) x_i / sum_i w_i h(T_k - t_i), with w_i the time represented by sample i. Any
        such mean of Y = Omega chi holds for the same chi, so irregular or slow sampling adds no bias.
    """

    times: Floats
    outputs: Floats
    cutoff_hz: float
    attenuation_db: float = 40.0

    @property
    def half_width(self) -> float:
        """Half the length of the kernel [s]; the transition band is half the cut-off wide."""
        return half_width(self.cutoff_hz, self.attenuation_db)

    @cached_property
    def sample_weights(self) -> Floats:
        """Time represented by each sample (m,) [s], capped so that the ends of a gap do not dominate.

        A single sample tells no time between samples, and represents none.
        """
        step = np.diff(self.times)
        if not len(step):
            return np.zeros(len(self.times))
        step = np.minimum(step, 2.0 * float(np.median(step)))
        return 0.5 * (np.append(step, step[-1:]) + np.append(step[:1], step))

    def apply(self, values: Floats) -> Floats:
        """Filtered (K, ...) of values (m, ...)."""
        flat = values.reshape(len(values), -1)
        result = np.empty((len(self.outputs), flat.shape[1]))
        for rows, samples, weights in self._kept or self.blocks():
            result[rows] = weights @ flat[samples]
        return result.reshape(len(self.outputs), *values.shape[1:])

    def share(self, flagged: NDArray[np.generic]) -> Floats:
        """Share (K, ...) of the kernel's absolute weight on flagged samples (m, ...), bool or 0 to 1."""
        flat = flagged.reshape(len(flagged), -1)
        result = np.zeros((len(self.outputs), flat.shape[1]))
        if flat.any():
            for rows, samples, weights in self.blocks():
                size = np.abs(weights)
                total = size.sum(axis=1, keepdims=True)
                result[rows] = (size @ flat[samples]) / np.where(total > 0.0, total, 1.0)
        return result.reshape(len(self.outputs), *flagged.shape[1:])

    def coverage(self) -> Floats:
        """Share (K,) of the kernel's absolute area covered by samples, less than 1 at a gap or an end."""
        whole = np.linspace(-self.half_width, self.half_width, 2001)
        ones = np.ones(len(whole))
        area = float(np.mean(np.abs(_kernel(np.zeros(1), whole, ones, *self._table)))) * 2.0 * self.half_width
        result = np.empty(len(self.outputs))
        for rows, _, kernel in self._kernels():
            result[rows] = np.abs(kernel).sum(axis=1) / area
        return result

    def blocks(self, size: int = _OUTPUTS) -> Iterator[tuple[slice, slice, Floats]]:
        """Rows, samples and dense weights (rows, samples) of a few outputs at a time; bounds the memory."""
        for rows, samples, kernel in self._kernels(size):
            total = kernel.sum(axis=1, keepdims=True)
            yield rows, samples, kernel / np.where(total != 0.0, total, 1.0)

    @cached_property
    def _kept(self) -> list[tuple[slice, slice, Floats]]:
        """The blocks for every use, where they share kernels; none where they would take much memory."""
        kernels: dict[int, tuple[Floats, Floats]] = {}
        found, size = [], 0
        for rows, samples, kernel in self._kernels():
            if id(kernel) not in kernels:
                size += kernel.size
                if size > _MOST_KEPT:
                    return []
                total = kernel.sum(axis=1, keepdims=True)
                kernels[id(kernel)] = kernel, kernel / np.where(total != 0.0, total, 1.0)
            found.append((rows, samples, kernels[id(kernel)][1]))
        return found

    def _kernels(self, size: int = _OUTPUTS) -> Iterator[tuple[slice, slice, Floats]]:
        """Like `blocks`, not normalised. On a regular grid equal offsets share one kernel."""
        half, weight = self.half_width, self.sample_weights
        regular = _regular(self.times) and _regular(self.outputs)
        known: dict[tuple[int, int, int], Floats] = {}
        for first in range(0, len(self.outputs), size):
            outputs = self.outputs[first : first + size]
            low = int(np.searchsorted(self.times, outputs[0] - half))
            high = int(np.searchsorted(self.times, outputs[-1] + half, side="right"))
            inner = regular and low > 0 and high < len(self.times)
            key = (len(outputs), high - low, round(1e9 * (outputs[0] - self.times[low]))) if inner else None
            kernel = known.get(key) if key is not None else None
            if kernel is None:
                kernel = _kernel(outputs, self.times[low:high], weight[low:high], *self._table)
                if key is not None:
                    known[key] = kernel
            yield slice(first, first + len(outputs)), slice(low, high), kernel

    @property
    def _table(self) -> tuple[Floats, Floats]:
        return _sinc(self.cutoff_hz, self.attenuation_db)


@lru_cache(maxsize=64)
def _sinc(cutoff_hz: float, attenuation_db: float) -> tuple[Floats, Floats]:
    """Distances (4097,) [s] from the middle of a kernel, evenly up to its half width, and its values there."""
    half = half_width(cutoff_hz, attenuation_db)
    time = np.linspace(0.0, half, 4097)
    return time, np.sinc(2.0 * cutoff_hz * time) * _kaiser(time / half, attenuation_db)


@njit(cache=True, nogil=True)
def _kernel(outputs, times, weights, distance, value):  # type: ignore[no-untyped-def]
    """Weighted values (K, m) of a kernel at the distances of samples from outputs; zero beyond its table."""
    found = np.zeros((len(outputs), len(times)))
    last = len(distance) - 1
    if distance[last] <= 0.0:
        return found
    each = last / distance[last]
    for row in range(len(outputs)):
        for k in range(len(times)):
            here = abs(outputs[row] - times[k])
            if not here <= distance[last]:
                continue
            # The table is even but for rounding.
            at = min(int(here * each), last - 1)
            while distance[at] > here:
                at -= 1
            while at < last and distance[at + 1] <= here:
                at += 1
            one = value[at]
            if at < last:
                slope = (value[at + 1] - one) / (distance[at + 1] - distance[at])
                one = slope * (here - distance[at]) + one
            found[row, k] = one * weights[k]
    return found


def _regular(times: Floats) -> bool:
    """Whether the times are equidistant to a nanosecond."""
    if len(times) < 3:
        return True
    step = (times[-1] - times[0]) / (len(times) - 1)
    return float(np.max(np.abs(times - times[0] - step * np.arange(len(times))))) < 1e-9


def half_width(cutoff_hz: float, attenuation_db: float) -> float:
    """Half length [s] of the Kaiser-windowed sinc with a transition band of half the cut-off."""
    return (attenuation_db - 7.95) / (2.285 * 2.0 * np.pi * 0.5 * cutoff_hz) / 2.0


def _kaiser(position: Floats, attenuation_db: float) -> Floats:
    # Kaiser, Proc. IEEE ISCAS (1974), for attenuations above 50 dB and from 21 dB on
    above = max(attenuation_db - 21.0, 0.0)
    beta = 0.1102 * (attenuation_db - 8.7) if attenuation_db > 50.0 else 0.5842 * above**0.4 + 0.07886 * above
    return np.i0(beta * np.sqrt(np.maximum(1.0 - position**2, 0.0))) / np.i0(beta)


# Power of a motion over that of noise, of which a tenth of the frequencies are louder: a repeated motion repeats the
# steps of its encoder, whose spectrum has lines. Frequencies that tell it: some of a recording of eight seconds.
_NOISE, _LOUD, _LINES = 5.0, 0.9, 30


class Excitation:
    """Upper frequency of a motion from its blocks: Welch's spectrum, segment after segment."""

    def __init__(self, count: int, dt: float) -> None:
        self._dt, self._segment = dt, min(count, max(256, round(30.0 / dt)))
        self._rest: Floats | None = None
        self._frequency: Floats = np.zeros(0)
        self._power: Floats | float = 0.0
        self._moments: list[tuple[int, Floats, Floats]] = []

    def add(self, velocity: Floats) -> None:
        """The next samples (m, J) of the low-passed joint velocities."""
        mean = velocity.mean(axis=0)
        self._moments.append((len(velocity), mean, np.sum((velocity - mean) ** 2, axis=0)))
        rest = velocity if self._rest is None else np.concatenate([self._rest, velocity])
        step = self._segment - self._segment // 2
        whole = (len(rest) - self._segment) // step + 1 if len(rest) >= self._segment else 0
        if whole:
            used = rest[: (whole - 1) * step + self._segment]
            found = [spectrum(column, self._dt, self._segment) for column in used.T]
            self._frequency, power = found[0][0], np.stack([each for _, each in found], axis=1)
            self._power = self._power + whole * power
        self._rest = np.array(rest[whole * step :])

    def frequency(self, share: float = 0.999, cutoff_hz: float = np.inf) -> float:
        """Upper frequency [Hz] of `share` of the power of the fastest-changing joint velocity.

        About the highest harmonic n_f w0 of a Fourier excitation. cutoff_hz : of the low-pass on the velocities. Noise
        of the positions, such as the steps of a coarse encoder, has a power that grows with the square of the
        frequency; what does not rise above it is left out.
        """
        count = sum(n for n, _, _ in self._moments)
        mean = sum(n * m for n, m, _ in self._moments) / count
        variance = sum(square + n * (m - mean) ** 2 for n, m, square in self._moments) / count
        highest = 0.0
        for joint in np.flatnonzero(variance > 1e-4 * np.max(variance, initial=0.0)):
            power = np.asarray(self._power)[:, joint]
            noise = self._frequency >= 0.4 * cutoff_hz
            noise &= self._frequency <= 0.8 * cutoff_hz
            if np.count_nonzero(noise) >= _LINES:
                level = _NOISE * float(np.quantile(power[noise] / self._frequency[noise] ** 2, _LOUD))
                power = np.where(power > level * self._frequency**2, power, 0.0)
            cumulative = np.cumsum(power)
            if cumulative[-1] > 0:
                place = np.searchsorted(cumulative, share * cumulative[-1])
                highest = max(highest, float(self._frequency[place]))
        return highest


def excitation_frequency(velocity: Floats, dt: float) -> float:
    """Upper frequency [Hz] of the motion of velocities (n, J), low-passed and equidistant: see `Excitation`."""
    found = Excitation(len(velocity), dt)
    found.add(velocity)
    return found.frequency()


def advice(
    settings: SignalSettings,
    *,
    excitation_hz: float,
    joint_rate_hz: float,
    motor_rate_hz: float | None = None,
    resonance_hz: float | None = None,
) -> tuple[str, ...]:
    """Warnings about the cut-offs against the excitation n_f w0, the sampling rates and the resonance."""
    found: list[str] = []
    if settings.decimate < 2.0 * excitation_hz:
        found.append(
            f"the parallel filter's cut-off {settings.decimate:g} Hz is below twice the highest "
            f"excitation frequency {excitation_hz:.2f} Hz; Coriolis and gravity terms extend that far, raise "
            "`decimate_hz`"
        )
    if settings.cutoff < 5.0 * excitation_hz:
        found.append(
            f"the position cut-off {settings.cutoff:g} Hz is below 5 x the highest excitation frequency "
            f"{excitation_hz:.2f} Hz; accelerations lose amplitude, raise `cutoff_hz`"
        )
    rates = [("joint", joint_rate_hz)] + ([("motor", motor_rate_hz)] if motor_rate_hz else [])
    for name, rate in rates:
        if settings.row_rate_hz > rate:
            found.append(
                f"rows at {settings.row_rate_hz:g} Hz exceed the {name} channel's {rate:.1f} Hz; lower "
                "`decimate_hz`"
            )
    # A rate taken from stamps is a little off, and the default cut-off is that share of it.
    if settings.cutoff > 1.01 * NYQUIST_SHARE * joint_rate_hz:
        found.append(
            f"the position cut-off {settings.cutoff:g} Hz is above a fifth of the sampling rate "
            f"{joint_rate_hz:.0f} Hz; differences lose accuracy there, lower `cutoff_hz`"
        )
    if resonance_hz is not None:
        if excitation_hz > 0.5 * resonance_hz:
            found.append(
                f"the motion has {excitation_hz:.2f} Hz, over half the lowest resonance "
                f"{resonance_hz:g} Hz; the joints' elasticity is excited and the rigid model is biased, "
                "plan a slower motion"
            )
        if settings.decimate > 0.5 * resonance_hz:
            found.append(
                f"the parallel filter's cut-off {settings.decimate:g} Hz lets the lowest resonance "
                f"{resonance_hz:g} Hz through; lower `decimate_hz`"
            )
    return tuple(found)


def moving(position: Floats, names: Sequence[str], threshold: float = 1e-2) -> tuple[str, ...]:
    """Names of the joints with a position (n, J) range above `threshold` [rad]."""
    return tuple(name for name, span in zip(names, np.ptp(position, axis=0), strict=True) if span > threshold)
