"""Times of the channels: lost samples, equidistant grids, stretches, bridging, and the motor channel's delay.

The delay of the motor channel is estimated from the data. The difference of the two torques of a joint obeys Model 3,

    tau_m(t + d) - tau_l(t) = Ia qdd + Fvm qd + Fcm sign(qd) + offm,

with one delay d for the channel. All terms pass the same low-pass; d enters through the filtered motor torque
and its time derivative. It solves a small nonlinear least-squares problem, started from a grid. Its standard
deviation is robust to serial correlation. An unknown delay would bias Ia by -Fvm d.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline, make_interp_spline
from scipy.ndimage import maximum_filter1d

from fri.errors import DataError
from ident.dynamics.parameters import Floats
from ident.estimators.covariance import CovarianceSettings
from ident.estimators.least_squares import WeightedLeastSquares
from ident.estimators.problem import Problem, RowGroup
from ident.rows.filters import ParallelFilter, half_width, interpolate_uniform

BoolArray = NDArray[np.bool_]

logger = logging.getLogger(__name__)

_JITTER = 0.02
_TOO_MANY = 0.01
_GRAINS = 5.0
# Samples with one common noise level of a channel.
_BLOCK = 50


@dataclass(frozen=True)
class Stretch:
    """Equidistant samples without a long gap.

    start : time of the first sample [s]. dt : sample time [s]. values : (n, k). bridged : (n,) interpolated ones.
    resampled : whether all values are interpolated because of irregular times.
    """

    start: float
    dt: float
    values: Floats
    bridged: BoolArray
    resampled: bool

    @property
    def times(self) -> Floats:
        """Sample times (n,) [s]."""
        return self.start + self.dt * np.arange(len(self.values), dtype=np.float64)

    @property
    def end(self) -> float:
        """Time of the last sample [s]."""
        return self.start + self.dt * (len(self.values) - 1)


def sample_period(times: Floats, sequence: NDArray[np.int64] | None, where: str) -> float:
    """Sample time [s]: median interval per step of the sequence counter (n,)."""
    if len(times) < 16:
        raise DataError(f"{where}: {len(times)} samples are too few; record at least a few seconds of motion")
    step = np.diff(times)
    if np.any(step <= 0):
        at = times[int(np.argmax(step <= 0))]
        raise DataError(
            f"{where}: time does not increase after t = {at:.6f} s; repair the clock of the source"
        )
    if sequence is not None and len(sequence) == len(times) and np.all(np.diff(sequence) > 0):
        return float(np.median(step / np.diff(sequence)))
    return float(np.median(step))


def stretches(
    times: Floats, values: Floats, bad: BoolArray, dt: float, longest_bridge_s: float
) -> tuple[list[Stretch], int]:
    """Equidistant stretches of (n, k) values at (n,) times, and the number of samples lost.

    Samples flagged `bad` (n,) and lost ones are bridged by a cubic spline through their neighbours and
    flagged; a hole longer than `longest_bridge_s` ends the stretch.
    """
    good = np.flatnonzero(~bad)
    if len(good) < 16:
        return [], 0
    intervals = np.diff(times)
    lost = int(np.sum(np.maximum(np.rint(intervals[intervals > 1.75 * dt] / dt) - 1, 0)))
    hole = np.diff(times[good]) > longest_bridge_s + 1.75 * dt
    parts = np.split(good, np.flatnonzero(hole) + 1)
    return [_uniform(times[part], values[part], dt) for part in parts if len(part) >= 16], lost


def _uniform(times: Floats, values: Floats, dt: float) -> Stretch:
    steps = np.rint((times - times[0]) / dt).astype(np.int64)
    step = float((times[-1] - times[0]) / steps[-1]) if len(steps) > 1 and steps[-1] else dt
    error = float(np.max(np.abs(times - times[0] - steps * step)))
    if np.all(np.diff(steps) > 0) and error < max(_JITTER * dt, 2e-9):
        count = int(steps[-1]) + 1
        bridged = np.ones(count, dtype=bool)
        bridged[steps] = False
        if bridged.any():
            gaps, known = np.flatnonzero(bridged).astype(float), values
            values = np.empty((count, known.shape[1]))
            values[steps] = known
            values[bridged] = CubicSpline(steps.astype(float), known)(gaps)
        return Stretch(float(times[0]), step, values, bridged, False)
    count = int(np.floor((times[-1] - times[0]) / dt)) + 1
    grid = times[0] + dt * np.arange(count)
    after = np.searchsorted(times, grid)
    nearest, before = (np.abs(grid - times[np.clip(k, 0, len(times) - 1)]) for k in (after, after - 1))
    bridged = np.minimum(nearest, before) > 1.0 * dt
    return Stretch(float(times[0]), dt, CubicSpline(times, values)(grid), bridged, True)


def flag_outliers(values: Floats, scale: float) -> tuple[BoolArray, list[int]]:
    """Flags (n, k) of samples far from the median of five, and the columns with too many for outliers.

    Far is more than `scale` robust standard deviations and more than 1 % of the range. The standard deviation is
    that of the distance from the cubic through the four neighbours, which follows any slope: the larger of the
    values for the whole column and for the samples around, because a working drive is noisier than one at rest.
    The median keeps steps, so the reversal of Coulomb friction is no outlier. Nothing is flagged in a column with
    over 1 % of far samples: they are a property of the signal.
    """
    flags = np.zeros(values.shape, dtype=bool)
    crowded = []
    for column, series in enumerate(values.T):
        padded = np.pad(series, 2, mode="edge")
        far_left, left, middle, right, far_right = (padded[i : i + len(series)] for i in range(5))
        distance = np.abs(series - _median_of_five(far_left, left, middle, right, far_right))
        cubic = np.abs(series - (4.0 * (left + right) - far_left - far_right) / 6.0)
        low, high = np.percentile(series, [0.5, 99.5])
        steps = np.abs(np.diff(series))
        # A joint at standstill jumps by a few encoder steps.
        grain = _GRAINS * float(np.min(steps, where=steps > 0.0, initial=np.inf)) if np.any(steps) else 0.0
        grain = min(grain, 0.5 * float(np.ptp(series)))
        usual = np.maximum(_median_around(cubic), float(np.median(cubic)))
        far = distance > np.maximum(scale * 1.4826 * usual, max(0.01 * float(high - low), grain))
        if far.mean() > _TOO_MANY:
            crowded.append(column)
        else:
            flags[:, column] = far
    return flags, crowded


def _median_around(values: Floats) -> Floats:
    """The largest of the medians of a sample's block (n,) and of the neighbouring blocks."""
    whole = len(values) // _BLOCK * _BLOCK
    medians = np.append(np.median(values[:whole].reshape(-1, _BLOCK), axis=1), np.median(values[-_BLOCK:]))
    return np.repeat(maximum_filter1d(medians, 3, mode="nearest"), _BLOCK)[: len(values)]


def _median_of_five(a: Floats, b: Floats, c: Floats, d: Floats, e: Floats) -> Floats:
    low = np.maximum(np.minimum(a, b), np.minimum(c, d))
    high = np.minimum(np.maximum(a, b), np.maximum(c, d))
    return np.maximum(np.minimum(low, high), np.minimum(np.maximum(low, high), e))


_STEPS = 12
# Largest scatter of the joints, in their standard deviations, with rows at reversals used.
_TOLERATED = 2.0
_GRID = 41
_ATTENUATION_DB = 40.0
_STILL = "the delay of the motor channel cannot be estimated: no joint moves; state `motor_delay_s`"


@dataclass(frozen=True)
class Delay:
    """Delay of the motor channel [s] (positive: late), its standard deviation [s] and origin (`how`).

    by_joint : delay of each moving joint by itself, and its standard deviation [s].
    disagreement : scatter of the joints over their standard deviations; the stated standard deviation already
        includes this factor. Elastic joints and other physics of the drives shift the reversals of a joint
        like a delay of its own.
    """

    seconds: float
    std: float
    how: str
    by_joint: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    disagreement: float = 1.0

    def __str__(self) -> str:
        size = f"{'late' if self.seconds >= 0 else 'early'} by {1e3 * abs(self.seconds):.2f} ms"
        return f"{size} ± {1e3 * self.std:.2f} ms ({self.how})" if self.std > 0 else f"{size} ({self.how})"


@dataclass(frozen=True)
class DelayData:
    """One uninterrupted stretch: joint channel on (n,) times, motor channel on (m,) times [s].

    qd, qdd, joint_torque : (n, J); motor_torque : (m, J). span : first and last usable time [s].
    """

    times: Floats
    qd: Floats
    qdd: Floats
    joint_torque: Floats
    motor_times: Floats
    motor_torque: Floats
    span: tuple[float, float]


def estimate_delay(
    stretches: Sequence[DelayData],
    joint_names: Sequence[str],
    *,
    cutoff_hz: float = 5.0,
    search_s: float = 0.1,
    standstill_rad_s: float = 2e-3,
) -> Delay:
    """Delay d of the motor channel: tau_m(t + d) belongs to the joint state at t.

    Raises DataError when the best delay lies at the edge of +- `search_s`, or no joint moves.
    """
    found = [_Filtered.of(data, cutoff_hz, search_s, standstill_rad_s) for data in stretches]
    if not any(part is not None for part in found):
        need = 4.0 / cutoff_hz + 2.0 * (half_width(cutoff_hz, _ATTENUATION_DB) + search_s)
        raise DataError(
            "the delay of the motor channel cannot be estimated: no stretch without lost samples is longer "
            f"than the {need:.1f} s needed beside the filters' ends; record a longer motion"
        )
    parts = [part for part in found if part is not None and part.moving.any()]
    if not parts:
        raise DataError(_STILL)
    grid = np.linspace(-search_s, search_s, _GRID)
    cost = [_cost(parts, delay) for delay in grid]
    best = int(np.argmin(cost))
    if best in (0, len(grid) - 1):
        raise DataError(
            "the motor channel fits the joint channel best at the edge of the searched delays, "
            f"{1e3 * grid[best]:.0f} ms; check the channel's clock and sign, raise `delay_search_s`, or "
            "state `motor_delay_s`"
        )
    delay = _refined(parts, joint_names, float(grid[best]), search_s, "all rows")
    if delay.disagreement > _TOLERATED:
        quiet = [part.between_reversals() for part in parts]
        quiet = [part for part in quiet if part.moving.sum() >= 16]
        if quiet:
            delay = _refined(quiet, joint_names, delay.seconds, search_s, "rows between reversals")
    logger.info("motor channel %s", delay)
    return delay


def _refined(
    parts: Sequence[_Filtered], joint_names: Sequence[str], start: float, search_s: float, which: str
) -> Delay:
    """Gauss-Newton from `start`, then each joint by itself for their disagreement."""
    delay = start
    sampling = _sampling_error(parts) if which == "all rows" else 0.0
    for fine in (False, True):
        for _ in range(_STEPS):
            steps, stds, _ = _newton(parts, joint_names, delay, fine=fine)
            delay = float(np.clip(delay + np.clip(steps[0], -0.01, 0.01), -search_s, search_s))
            if abs(steps[0]) < 0.1 * np.hypot(stds[0], sampling) or abs(steps[0]) < 1e-9:
                break
    std = float(np.hypot(stds[0], sampling))
    steps, stds, names = _newton(parts, joint_names, delay, fine=True, separate=True)
    own = np.hypot(stds, sampling * np.sqrt(len(stds)))
    mean = float(np.sum(steps / own**2) / np.sum(1.0 / own**2))
    chi = float(np.sqrt(np.sum(((steps - mean) / own) ** 2) / max(len(steps) - 1, 1)))
    disagreement = max(1.0, chi)
    by_joint = {
        name: (delay + float(step), float(s)) for name, step, s in zip(names, steps, own, strict=True)
    }
    how = f"estimated from the torque difference, {which}"
    return Delay(delay, std * disagreement, how, by_joint, disagreement)


@dataclass(frozen=True)
class _Filtered:
    """Filtered columns of one stretch at its output times, and the filtered motor torque as a curve."""

    data: DelayData
    cutoff_hz: float
    outputs: Floats
    joint_torque: Floats
    columns: Floats
    moving: NDArray[np.bool_]
    one_way: NDArray[np.bool_]
    curve: Any
    slope: Any

    @classmethod
    def of(cls, data: DelayData, cutoff_hz: float, search_s: float, standstill: float) -> _Filtered | None:
        low_pass = ParallelFilter(data.times, np.zeros(0), cutoff_hz, _ATTENUATION_DB)
        margin = low_pass.half_width + search_s
        first = max(data.span[0], float(data.motor_times[0])) + margin
        last = min(data.span[1], float(data.motor_times[-1])) - margin
        if last - first < 4.0 / cutoff_hz:
            return None
        outputs = np.arange(first, last, 1.0 / (2.5 * cutoff_hz))
        fine = np.arange(
            first - search_s - 0.5 / cutoff_hz, last + search_s + 0.5 / cutoff_hz, 0.125 / cutoff_hz
        )
        joint = ParallelFilter(data.times, outputs, cutoff_hz)
        smooth = ParallelFilter(data.motor_times, fine, cutoff_hz).apply(data.motor_torque)
        curve = make_interp_spline(fine, smooth, k=5)
        moving = joint.share(np.abs(data.qd) < standstill) < 0.05
        forward = joint.share(data.qd > 0.0)
        one_way = np.minimum(forward, 1.0 - forward) < 0.02
        torque, columns = joint.apply(data.joint_torque), _columns(joint, data.qd, data.qdd)
        return cls(data, cutoff_hz, outputs, torque, columns, moving, one_way, curve, curve.derivative())

    def between_reversals(self) -> _Filtered:
        """The rows without a reversal of the joint within the filter."""
        return replace(self, moving=self.moving & self.one_way)

    def columns_at(self, delay: float) -> Floats:
        """The columns filtered at the motor channel's own sample times minus the delay.

        A slow channel samples the reversal of Coulomb friction coarsely; the columns must be sampled alike.
        """
        data = self.data
        dt = float(data.times[1] - data.times[0])
        if float(np.median(np.diff(data.motor_times))) < 1.5 * dt:
            return self.columns
        times = data.motor_times - delay
        inside = (times >= data.times[0]) & (times <= data.times[-1])
        state = interpolate_uniform(np.hstack([data.qd, data.qdd]), float(data.times[0]), dt, times[inside])
        qd, qdd = np.split(state, 2, axis=1)
        return _columns(ParallelFilter(times[inside], self.outputs, self.cutoff_hz), qd, qdd)


def _columns(low_pass: ParallelFilter, qd: Floats, qdd: Floats) -> Floats:
    """Filtered qdd, qd, sign(qd) and 1: (K, J, 4)."""
    filtered = [low_pass.apply(qdd), low_pass.apply(qd), low_pass.apply(np.sign(qd))]
    return np.stack([*filtered, np.ones_like(filtered[0])], axis=2)


def _cost(parts: Sequence[_Filtered], delay: float) -> float:
    """Sum over joints of the log residual power: the likelihood with one unknown variance a joint."""
    total = 0.0
    for joint in range(parts[0].joint_torque.shape[1]):
        rows = [part.moving[:, joint] for part in parts]
        if sum(int(r.sum()) for r in rows) < 16:
            continue
        matrix = np.vstack([part.columns[r, joint] for part, r in zip(parts, rows, strict=True)])
        target = np.concatenate(
            [
                (part.curve(part.outputs + delay)[:, joint] - part.joint_torque[:, joint])[r]
                for part, r in zip(parts, rows, strict=True)
            ]
        )
        residual = target - matrix @ np.linalg.lstsq(matrix, target, rcond=None)[0]
        total += len(target) * float(np.log(residual @ residual + 1e-30))
    return total


def _sampling_error(parts: Sequence[_Filtered]) -> float:
    """Standard error [s] from the sampling of a slow channel: a reversal is known to one sample, uniformly."""
    reversals, period = 0, 0.0
    for part in parts:
        period = float(np.median(np.diff(part.data.motor_times)))
        if period < 1.5 * float(part.data.times[1] - part.data.times[0]):
            return 0.0
        qd = part.data.qd[:, part.moving.any(axis=0)]
        reversals += int(np.sum(np.diff(np.sign(qd), axis=0) != 0))
    return period / float(np.sqrt(12.0 * max(reversals, 1)))


def _newton(
    parts: Sequence[_Filtered],
    joint_names: Sequence[str],
    delay: float,
    *,
    fine: bool,
    separate: bool = False,
) -> tuple[Floats, Floats, tuple[str, ...]]:
    """Gauss-Newton step of the delay (1,) or of each joint's own (J,) [s], standard deviations, joints."""
    groups, names = [], []
    active = [
        joint
        for joint in range(len(joint_names))
        if sum(int(part.moving[:, joint].sum()) for part in parts) >= 16
    ]
    if not active:
        raise DataError(_STILL)
    delays = len(active) if separate else 1
    columns = [part.columns_at(delay) if fine else part.columns for part in parts]
    for place, joint in enumerate(active):
        names += [f"{symbol} {joint_names[joint]}" for symbol in ("Ia", "Fvm", "Fcm", "offm")]
        for record, part in enumerate(parts):
            rows = np.flatnonzero(part.moving[:, joint])
            if not len(rows):
                continue
            times = part.outputs[rows] + delay
            matrix = np.zeros((len(rows), 4 * len(active) + delays))
            matrix[:, 4 * place : 4 * place + 4] = columns[record][rows, joint]
            matrix[:, 4 * len(active) + (place if separate else 0)] = -part.slope(times)[:, joint]
            target = part.curve(times)[:, joint] - part.joint_torque[rows, joint]
            groups.append(RowGroup(joint_names[joint], "difference", record, matrix, target, rows))
    step = float(parts[0].outputs[1] - parts[0].outputs[0])
    titles = (*names, *(f"delay {k}" for k in range(delays)))
    estimate = WeightedLeastSquares(CovarianceSettings("hac")).fit(Problem(titles, tuple(groups), step))
    return estimate.values[-delays:], estimate.std[-delays:], tuple(joint_names[joint] for joint in active)
