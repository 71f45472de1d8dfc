"""Delay of the motor channel behind the joint channel, estimated from the data with its uncertainty.

The difference of the two torques of a joint obeys Model 3,

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
from scipy.interpolate import make_interp_spline

from fri.errors import DataError
from ident.estimators.covariance import CovarianceSettings
from ident.estimators.least_squares import WeightedLeastSquares
from ident.estimators.problem import Problem, RowGroup
from ident.rows.filters import ParallelFilter, half_width, interpolate_uniform

__all__ = ["Delay", "DelayData", "estimate_delay"]

FloatArray = NDArray[np.float64]

logger = logging.getLogger(__name__)

_STEPS = 12
# Largest scatter of the joints, in their standard deviations, with rows at reversals used.
_TOLERATED = 2.0
_GRID = 41
_ATTENUATION_DB = 40.0


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

    times: FloatArray
    qd: FloatArray
    qdd: FloatArray
    joint_torque: FloatArray
    motor_times: FloatArray
    motor_torque: FloatArray
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
        raise DataError(
            "the delay of the motor channel cannot be estimated: no joint moves; state `motor_delay_s`"
        )
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
    for stage in ("coarse", "fine"):
        for _ in range(_STEPS):
            steps, stds, _ = _newton(parts, joint_names, delay, fine=stage == "fine")
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
    outputs: FloatArray
    joint_torque: FloatArray
    columns: FloatArray
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

    def columns_at(self, delay: float) -> FloatArray:
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


def _columns(low_pass: ParallelFilter, qd: FloatArray, qdd: FloatArray) -> FloatArray:
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
) -> tuple[FloatArray, FloatArray, tuple[str, ...]]:
    """Gauss-Newton step of the delay (1,) or of each joint's own (J,) [s], standard deviations, joints."""
    groups, names = [], []
    active = [
        joint
        for joint in range(len(joint_names))
        if sum(int(part.moving[:, joint].sum()) for part in parts) >= 16
    ]
    if not active:
        raise DataError(
            "the delay of the motor channel cannot be estimated: no joint moves; state `motor_delay_s`"
        )
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
