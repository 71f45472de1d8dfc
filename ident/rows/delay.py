"""Delays of the torques: of the motor channel from the difference of the torques, of others from the base model.

The difference obeys Model 3 of the paper at the motor channel's own times t,

    tau_m(t) - tau_l(t - d) = Ia qdd(t - d) + Fvm qd(t - d) + Fcm sign(qd(t - d)) + offm,

with one delay d for the channel and four parameters a joint. Samples near a reversal of the joint are left out,
since friction turns there in an unknown way: with them a healthy channel looks early or late by milliseconds. All
terms pass the same low-pass. d solves a small nonlinear least-squares problem (Gauss-Newton from a grid); its
standard deviation is robust to serial correlation and inflated by the scatter of the joints. An unknown delay biases
Ia by -Fvm d, so its uncertainty enters the covariance of every estimate.

The joint torques may be late themselves, or early, where the positions are late; and motor torques may have no joint
torques beside them. Their delay follows from the base model (`delays_from_model`): to first order

    tau(t) = Y(t) chi - d dtau/dt(t).

The motors turn ahead of their links by tau_l / k. An error of the stated compliance makes a joint look late by about
Fvm times that error, another one for each joint, so the joints count with this uncertainty beside their own.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby, pairwise

import numpy as np
from numba import njit
from numpy.typing import NDArray

from fri.errors import DataError
from ident.dynamics.base_set import independent_columns
from ident.dynamics.parameters import Floats
from ident.estimators.covariance import CovarianceSettings
from ident.estimators.least_squares import WeightedLeastSquares, weighted_solution
from ident.estimators.problem import Problem, RowGroup
from ident.rows.content import Kept
from ident.rows.filters import ParallelFilter, half_width, interpolate_uniform, low_pass, median_step
from lwr_driver.session.spool import Growing, release

logger = logging.getLogger(__name__)

# Highest cut-off of the rows of a delay [Hz], and attenuation beyond.
DELAY_HZ, DELAY_DB = 5.0, 40.0
_SYMBOLS = ("Ia", "Fvm", "Fcm", "offm")
_STEPS = 12
# Rows of a joint in use for a delay, so that memory does not grow with the session: seven minutes of the paper's rows.
_MOST_ROWS = 2000
# Least share of a column that no column before has, for it to count.
_SHOWN = 1e-6
_GRID = 41
# Least share of a row's filter on known samples.
_KNOWN = 0.4
# Rows of a joint needed for a delay of its own.
_LEAST_ROWS = 16
# Change of a delay for the derivative by it [s].
_SHIFT_S = 1e-3
# Largest Fvm / stiffness of strain-wave joints, 17 Nm s/rad over 8 kNm/rad: so early an elastic joint looks [s].
_ELASTIC_S = 2e-3
# Standard deviation of a stated compliance, as a share of it: within a class of arms stiffness differs by 1.5 times.
_COMPLIANCE_SHARE = 0.3
# Likelihood ratio (twice the log) of a delay at the edge of the search against none that is no chance.
_DECISIVE = 25.0
DISAGREEMENT = 3.0
"""Scatter of seven joints over their standard deviations, exceeded once in a thousand healthy sessions, for deviations
that are a third too small."""
# Least delay of joint torques, or of joints that disagree, over the scatter of the joints: each shows it by itself.
_ALIKE = 3.0
# Standard deviations within which a joint agrees with the weighted median, and beyond which, and by how much [s], it
# is late by itself.
_AGREES = 3.0
_APART, _APART_S = 20.0, 5e-3
# Distance of the earliest from the latest joint that is told [s], in standard deviations, and the largest of these [s]:
# on a real LWR4+ delays that differ by 130 ms are known to 4 ms at best.
_TORN_S, _TORN, _CLEAR_S = 8e-3, 5.0, 2e-3
# A delay within this many standard deviations of zero is not told apart from zero.
_DISTINCT = 1.96
# Delays of two sessions that differ, in standard deviations, and at least [s].
_OTHER, _OTHER_S = 5.0, 3e-3
# Latest estimates: an estimator prepares a session several times.
_MOST_ESTIMATES = 64


@dataclass(frozen=True)
class Delay:
    """Delay of a torque channel against the motion.

    seconds : the delay in use [s], zero where the data cannot tell it from zero. std : its standard deviation [s],
        with the uncertainty of a delay that is set to zero. how : origin. estimate : the unrestricted estimate [s].
    by_joint : delay of each moving joint by itself, and its standard deviation, with that of its compliance [s].
    disagreement : scatter of the joints over their standard deviations; `std` already includes this factor.
    earliest : least delay [s]: zero, or -inf where the positions are late. apart : joints clearly late by themselves,
        or early, against those that agree. sure : whether the estimate is beyond the scatter of its joints, and rows
        fit better with it.
    """

    seconds: float
    std: float
    how: str
    estimate: float = 0.0
    by_joint: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    disagreement: float = 1.0
    earliest: float = 0.0
    apart: tuple[str, ...] = ()
    sure: bool = True

    @classmethod
    def of(
        cls,
        estimate: float,
        std: float,
        how: str,
        by_joint: Mapping[str, tuple[float, float]],
        disagreement: float,
        earliest: float = 0.0,
    ) -> Delay:
        """The delay of an estimate: zero within its interval, and never before the earliest."""
        possible = max(estimate, earliest)
        if abs(possible) <= _DISTINCT * std:
            std, possible = float(np.hypot(std, possible)), 0.0
        return cls(possible, std, how, estimate, by_joint, disagreement, earliest)

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval [s], from the earliest on."""
        reach = 1.96 * self.std
        return max(self.seconds - reach, min(self.earliest, self.seconds)), self.seconds + reach

    @property
    def early(self) -> bool:
        """Whether the estimate is sure and before the earliest, beyond its interval and the elasticity of joints."""
        return self.sure and self.estimate < self.earliest - 3.0 * self.std - _ELASTIC_S

    @property
    def torn(self) -> tuple[str, str] | None:
        """The joints with the least and the greatest delay of those that are clear, where these contradict."""
        clear = sorted((late, std, name) for name, (late, std) in self.by_joint.items() if std < _CLEAR_S)
        if len(clear) < 2:
            return None
        (early, one, first), (late, other, last) = clear[0], clear[-1]
        return (first, last) if late - early > max(_TORN_S, _TORN * float(np.hypot(one, other))) else None

    def __str__(self) -> str:
        late = -1.0 if self.seconds < 0.0 else 1.0
        low, high = sorted(1e3 * late * bound for bound in self.interval)
        origin = f"{low:.2f} to {high:.2f} ms, {self.how}" if self.std else self.how
        if self.seconds == 0.0:
            return f"not late ({origin})"
        where = "late by" if late > 0.0 else "ahead of the positions by"
        return f"{where} {1e3 * abs(self.seconds):.2f} ms ({origin})"


_estimates = Kept[Delay](_MOST_ESTIMATES)


@dataclass(frozen=True)
class DelayData:
    """One uninterrupted stretch or a block of it: joint channel on (n,) even times, motor channel on (m,) times [s].

    qd, qdd, joint_torque : (n, J); motor_torque : (m, J). known : (n, J), samples away from the reversals of their
    joint. span : first and last usable time of the stretch [s]. core : times of the rows of this block [s]; blocks of
    one stretch follow each other.
    """

    times: Floats
    qd: Floats
    qdd: Floats
    joint_torque: Floats
    known: NDArray[np.bool_]
    motor_times: Floats
    motor_torque: Floats
    span: tuple[float, float]
    core: tuple[float, float] = (-np.inf, np.inf)


def shared_delay(delays: Sequence[Delay]) -> tuple[float, tuple[int, ...]]:
    """Delay [s] of the sessions that agree (mean with the weight of the inverse variances), and the numbers of others.

    Sessions differ by how they were recorded, not by the arm. Of two the less late one has the usual delay. One without
    a deviation is stated, or not told by its session.
    """
    told = [k for k, one in enumerate(delays) if one.std > 0.0] or list(range(len(delays)))
    middle = sorted((delays[k] for k in told), key=lambda one: one.seconds)[(len(told) - 1) // 2]
    apart = tuple(
        k
        for k in told
        if abs(delays[k].seconds - middle.seconds)
        > max(_OTHER_S, _OTHER * float(np.hypot(delays[k].std, middle.std)))
    )
    alike = [delays[k] for k in told if k not in apart]
    weights = [one.std**-2 for one in alike if one.std > 0.0] or None
    return float(np.average([one.seconds for one in alike], weights=weights)), apart


def estimate_delay(
    stretches: Sequence[DelayData],
    joint_names: Sequence[str],
    *,
    cutoff_hz: float = 5.0,
    search_s: float = 0.1,
    compliance: Floats | None = None,
    earliest_s: float = 0.0,
) -> Delay:
    """Delay d of the motor channel: tau_m(t + d) belongs to the joint state at t; of equal data estimated once.

    compliance : (J,) stated for the motion of the motors [rad/Nm], None where motors and links move alike.
    earliest_s : least delay, -inf where the positions are late.

    A motion too short or too weak for an estimate gives zero, with the sample time of the motor channel as its
    standard deviation. Raises DataError when the data clearly prefer a delay at the edge of +- `search_s`.
    """
    found = _estimates.of(
        _estimated, stretches, tuple(joint_names), cutoff_hz, search_s, compliance, earliest_s
    )
    logger.info("motor channel %s", found)
    return found


def _estimated(
    stretches: Sequence[DelayData],
    joint_names: Sequence[str],
    cutoff_hz: float,
    search_s: float,
    compliance: Floats | None,
    earliest_s: float,
) -> Delay:
    by_stretch = [list(blocks) for _, blocks in groupby(stretches, key=lambda data: data.span)]
    parts = [part for blocks in by_stretch if (part := _Rows.of(blocks, cutoff_hz, search_s)) is not None]
    joints = [
        j
        for j in range(len(joint_names))
        if sum(int(part.known_rows[:, j].sum()) for part in parts) >= _LEAST_ROWS
    ]
    if not joints:
        return _unknown(stretches, "the motion is too short or too slow to tell")
    grid = np.linspace(-search_s, search_s, _GRID)
    coarse = [part.thinned(cutoff_hz) for part in parts]
    cost = [_misfit(coarse, joints, delay) for delay in grid]
    best = int(np.argmin(cost))
    if best in (0, len(grid) - 1):
        if cost[_GRID // 2] - cost[best] < _DECISIVE:
            return _unknown(stretches, "the motion is too weak to tell")
        raise DataError(
            "the motor channel fits the joint channel best at the edge of the searched delays, "
            f"{1e3 * grid[best]:.0f} ms; check the channel's clock and sign, raise `delay_search_s`, or "
            "state `motor_delay_s`"
        )
    delay = float(grid[best])
    for _ in range(_STEPS):
        steps, stds, _ = _newton(parts, joints, delay, separate=False)
        delay = float(np.clip(delay + np.clip(steps[0], -0.01, 0.01), -search_s, search_s))
        if abs(steps[0]) < max(0.03 * float(stds[0]), 1e-9):
            break
    steps, stds, viscous = _newton(parts, joints, delay, separate=True)
    elastic = 0.0 if compliance is None else _COMPLIANCE_SHARE * np.abs(viscous) * compliance[joints]
    names = [joint_names[j] for j in joints]
    return _together(names, delay + steps, np.hypot(stds, elastic), "from the torque difference", earliest_s)


def _together(names: Sequence[str], values: Floats, stds: Floats, how: str, earliest_s: float) -> Delay:
    """The delay of a channel from those of its joints with standard deviations (J,)."""
    mean, std, disagreement = weighted_mean(values, stds)
    by_joint = {name: (float(v), float(s)) for name, v, s in zip(names, values, stds, strict=True)}
    return Delay.of(mean, std * disagreement, how, by_joint, disagreement, earliest_s)


def weighted_mean(values: Floats, stds: Floats) -> tuple[float, float, float]:
    """Mean of estimates (n,) with standard deviations (n,), its own, and their scatter over theirs, one at least."""
    weights = stds**-2.0
    mean = float(np.average(values, weights=weights))
    chi = float(np.sqrt(np.sum(weights * (values - mean) ** 2) / max(len(values) - 1, 1)))
    return mean, float(weights.sum()) ** -0.5, max(chi, 1.0)


def delays_from_model(
    problem: Problem, sides: Mapping[int, str], before: Mapping[int, float]
) -> dict[int, Delay]:
    """Delay of the torques of one side of each of these records, against the base model.

    One Gauss-Newton step with all base parameters free and a delay of each joint of each record. Other rows of these
    records have no part in it, because their delay follows from these.

    problem : stacked rows of all records, with the slopes of the torques as nuisances. sides : "joint" or "motor" by
    number of the record. before : delay of the rows of each [s].

    Raises DataError for rows that determine no delay.
    """
    slopes = {number: slope for one in problem.nuisances for number, slope in one.columns.items()}
    used = _used(problem, sides)
    places = [
        (record, joint)
        for record, side in sides.items()
        for joint in dict.fromkeys(
            group.joint
            for k, group in used.items()
            if group.record == record and group.side == side and np.any(slopes[k])
        )
    ]
    groups = []
    for k, group in used.items():
        late = np.zeros((len(group.target), len(places)))
        if (group.record, group.joint) in places:
            late[:, places.index((group.record, group.joint))] = -slopes[k][: len(late)]
        groups.append(replace(group, matrix=np.hstack([group.matrix, late])))
    base = len(problem.names)
    names = (*problem.names, *(f"delay {record} {joint}" for record, joint in places))
    wide = replace(problem, names=names, groups=tuple(groups), units=(), nuisances=())
    # What the motion does not show of the base parameters has no part in the delays.
    shown = _shown(wide)
    fit = WeightedLeastSquares().fit(wide.select(shown))
    rows = {places[column - base]: row for row, column in enumerate(shown) if column >= base}
    found = {}
    for record, side in sides.items():
        mine = {joint: row for (owner, joint), row in rows.items() if owner == record}
        if not mine:
            raise DataError(f"no {side} torque of {problem.record_names[record]} changes with its delay")
        own = list(mine.values())
        found[record] = _agreed(list(mine), before[record] + fit.values[own], fit.std[own], side)
    return found


def _agreed(names: Sequence[str], values: Floats, stds: Floats, side: str) -> Delay:
    """The delay of the joints that agree. What the base model lacks looks late, too, in each joint by another time."""
    order = np.argsort(values)
    weights = np.cumsum(stds[order] ** -2.0)
    middle = values[order[np.searchsorted(weights, 0.5 * weights[-1])]]
    agree = np.abs(values - middle) <= _AGREES * stds
    several = 2 * np.count_nonzero(agree) >= len(names)
    chosen = np.flatnonzero(agree | (not several)).tolist()
    earliest = -np.inf if side == "joint" else 0.0
    delay = _together(
        [names[j] for j in chosen], values[chosen], stds[chosen], "from the base model", earliest
    )
    by_joint = {name: (float(v), float(s)) for name, v, s in zip(names, values, stds, strict=True)}
    beyond = np.abs(values - delay.estimate)
    apart = several & (beyond > _APART * np.hypot(stds, delay.std)) & (beyond > _APART_S)
    delay = replace(delay, by_joint=by_joint, apart=tuple(names[j] for j in np.flatnonzero(apart).tolist()))
    disagree = not agree.all() or delay.disagreement > DISAGREEMENT
    if (disagree or side == "joint") and abs(delay.estimate) < _ALIKE * delay.std * len(chosen) ** 0.5:
        # A scatter that is not one of a delay is no uncertainty of it: on a real arm it is ten times too large.
        std = 0.0 if disagree else float(np.hypot(delay.std, delay.seconds))
        how = "the joints disagree" if disagree else delay.how
        delay = replace(delay, seconds=0.0, std=std, how=how, sure=False)
    return delay


def fits_better(after: Problem, before: Problem, sides: Mapping[int, str]) -> bool:
    """Whether the base model fits the rows of these sides better at other delays, by the likelihood of all joints."""
    squares = []
    for problem in (after, before):
        own = replace(problem, groups=tuple(_used(problem, sides).values()), nuisances=())
        own = own.select(_shown(own))
        rest = own.residuals(weighted_solution(own)[0])
        squares.append(
            [float(np.mean(np.concatenate([rest[k] for k in c.groups]) ** 2)) for c in own.classes]
        )
        rows = [c.factor.rows for c in own.classes]
    return float(np.log(squares[0]) @ rows) < float(np.log(squares[1]) @ rows)


def _used(problem: Problem, sides: Mapping[int, str]) -> dict[int, RowGroup]:
    """Row groups of these sides of these records, and all of other records, by their number, no more than the first
    rows of each."""
    found = {}
    for k, group in enumerate(problem.groups):
        if group.side == sides.get(group.record, group.side):
            part = slice(_MOST_ROWS)
            found[k] = replace(
                group,
                matrix=group.matrix[part],
                target=group.target[part],
                time_index=group.time_index[part],
            )
    return found


def _shown(problem: Problem) -> list[int]:
    """Columns that the rows tell from those before them."""
    factor = problem.weighted(np.ones(len(problem.classes))).r[:, :-1]
    scale = np.linalg.norm(factor, axis=0)
    return independent_columns(factor / np.where(scale, scale, 1.0), range(len(scale)), _SHOWN)


def _unknown(stretches: Sequence[DelayData], why: str) -> Delay:
    period = max((median_step(data.motor_times) for data in stretches), default=0.0)
    return Delay(0.0, period, why)


@dataclass(frozen=True)
class _Block:
    """The rows of a block: samples `inside` of the motor channel, and their low-pass. state : (n, 3 J)."""

    data: DelayData
    state: Floats
    parallel: ParallelFilter
    inside: slice

    def known(self, delay: float) -> Floats:
        """Known samples (m, J) for a delay, as 0 and 1."""
        data = self.data
        step = float(data.times[1] - data.times[0])
        times = np.ascontiguousarray(data.motor_times[self.inside])
        found = _known_at(times, delay, float(data.times[0]), step, data.known)
        release(data.known)
        return found

    def at(self, delay: float, known: Floats) -> Floats:
        """Filtered qdd, qd, its sign and the difference of the torques (K, J, 4) over the known samples."""
        data = self.data
        times = data.motor_times[self.inside] - delay
        dt = float(data.times[1] - data.times[0])
        moved = interpolate_uniform(self.state, float(data.times[0]), dt, times)
        release(self.state)
        signals = _signals(moved, np.ascontiguousarray(data.motor_torque[self.inside]), known)
        return self.parallel.apply(signals)


@njit(cache=True, nogil=True)
def _known_at(times, delay, start, step, known):  # type: ignore[no-untyped-def]
    """Known samples (m, J), as 0 and 1, of (n, J) evenly from `start` at times (m,) less a delay [s]."""
    found = np.zeros((len(times), known.shape[1]))
    for k in range(len(times)):
        place = min(max(int(np.rint((times[k] - delay - start) / step)), 0), len(known) - 1)
        for j in range(known.shape[1]):
            if known[place, j]:
                found[k, j] = 1.0
    return found


@njit(cache=True, nogil=True)
def _signals(moved, motor_torque, known):  # type: ignore[no-untyped-def]
    """qdd, qd, its sign and the difference of the torques (m, J, 4) over the known samples (m, J), from qdd, qd and
    joint torque (m, 3 J)."""
    samples, joints = motor_torque.shape
    found = np.empty((samples, joints, 4))
    for k in range(samples):
        for j in range(joints):
            speed, share = moved[k, joints + j], known[k, j]
            found[k, j, 0] = moved[k, j] * share
            found[k, j, 1] = speed * share
            found[k, j, 2] = np.sign(speed) * share
            found[k, j, 3] = (motor_torque[k, j] - moved[k, 2 * joints + j]) * share
    return found


@dataclass(frozen=True)
class _Rows:
    """The rows of one stretch, block after block.

    known : by block (m, J), the known samples as 0 and 1; share : (K, J) of a row's filter on them; known_rows :
    (K, J). search_s : delays searched. step_s : between samples of the motor channel. row_s : between rows.
    """

    blocks: tuple[_Block, ...]
    search_s: float
    step_s: float
    row_s: float
    known: tuple[Floats, ...] = ()
    share: Floats = field(default_factory=lambda: np.zeros((0, 0)))

    @classmethod
    def of(
        cls, blocks: Sequence[DelayData], cutoff_hz: float, search_s: float, every: int = 1
    ) -> _Rows | None:
        data = blocks[0]
        width = half_width(cutoff_hz, DELAY_DB)
        first = max(data.span[0], float(data.motor_times[0])) + search_s
        last = min(data.span[1], float(data.motor_times[-1])) - search_s
        if last - first < 2.0 * width:
            return None
        low, high = np.searchsorted(data.motor_times, [first, last]).tolist()
        outputs = np.arange(first + 0.5 * width, last - 0.5 * width, 1.0 / (2.5 * cutoff_hz))
        step = median_step(data.motor_times[low:high:every])
        found, states = [], Growing()
        for block in blocks:
            rows = outputs[(outputs >= block.core[0]) & (outputs < block.core[1])]
            if not len(rows):
                continue
            near = np.searchsorted(data.motor_times, [rows[0] - width, rows[-1] + width])
            begin = max(low, low + (int(near[0]) - low) // every * every - every)
            inside = slice(begin, min(high, int(near[1]) + 1 + every), every)
            parallel = ParallelFilter(data.motor_times[inside], rows, cutoff_hz, DELAY_DB)
            dt = float(block.times[1] - block.times[0])
            # Interpolation smooths noise, and more so between two samples: without a low-pass the noise chooses the
            # delay.
            torque = low_pass(block.joint_torque, dt, min(3.0 * cutoff_hz, 0.4 / dt))
            states.append(np.hstack([block.qdd, block.qd, torque]))
            release(block.qdd, block.qd, block.joint_torque)
            found.append(_Block(block, np.zeros((0, 0)), parallel, inside))
        if not found:
            return None
        ends = np.cumsum([0, *(len(block.data.times) for block in found)]).tolist()
        whole = states.array()
        kept = (replace(block, state=whole[a:b]) for block, (a, b) in zip(found, pairwise(ends), strict=True))
        return cls(tuple(kept), search_s, step, 1.0 / (2.5 * cutoff_hz)).masked(0.0)

    @property
    def known_rows(self) -> NDArray[np.bool_]:
        """Rows (K, J) with enough known samples."""
        return self.share > _KNOWN

    def masked(self, delay: float) -> _Rows:
        """With the samples that are known for a delay."""
        known = tuple(block.known(delay) for block in self.blocks)
        share = [block.parallel.apply(own) for block, own in zip(self.blocks, known, strict=True)]
        return replace(self, known=known, share=np.concatenate(share))

    def thinned(self, cutoff_hz: float) -> _Rows:
        """With no more samples than the coarse search needs, 40 a period of the cut-off."""
        every = max(1, int(1.0 / (40.0 * cutoff_hz * self.step_s)))
        if every == 1:
            return self
        return _Rows.of([block.data for block in self.blocks], cutoff_hz, self.search_s, every) or self

    def at(self, delay: float) -> tuple[Floats, Floats]:
        """Columns (K, J, 4) and difference of the torques (K, J) for a delay."""
        total = np.where(self.known_rows, self.share, 1.0)
        found = [block.at(delay, known) for block, known in zip(self.blocks, self.known, strict=True)]
        columns = np.concatenate(found) / total[:, :, None]
        rest = columns[:, :, 3].copy()
        columns[:, :, 3] = self.share / total
        return columns, rest


def _misfit(parts: Sequence[_Rows], joints: Sequence[int], delay: float) -> float:
    """Sum over joints of the log residual power: the likelihood with one unknown variance a joint."""
    parts = [part.masked(delay) for part in parts]
    rows = [part.at(delay) for part in parts]
    total = 0.0
    for j in joints:
        keep = [part.known_rows[:, j] for part in parts]
        matrix = np.vstack([columns[k, j] for (columns, _), k in zip(rows, keep, strict=True)])
        target = np.concatenate([values[k, j] for (_, values), k in zip(rows, keep, strict=True)])
        residual = target - matrix @ np.linalg.lstsq(matrix, target, rcond=None)[0]
        total += len(target) * float(np.log(residual @ residual / max(len(target), 1) + 1e-30))
    return total


def _newton(
    parts: Sequence[_Rows], joints: Sequence[int], delay: float, *, separate: bool
) -> tuple[Floats, Floats, Floats]:
    """Gauss-Newton step of the delay (1,), or of each joint's own (J,), standard deviations [s], and Fvm (J,)."""
    parts = [part.masked(delay) for part in parts]
    here, later, earlier = (
        [part.at(delay + shift) for part in parts] for shift in (0.0, _SHIFT_S, -_SHIFT_S)
    )
    count = len(joints) if separate else 1
    groups = []
    # A joint moving one way only cannot tell Coulomb friction from an offset.
    used, first = {}, 0
    for j in joints:
        signs = np.concatenate(
            [columns[part.known_rows[:, j], j, 2] for part, (columns, _) in zip(parts, here, strict=True)]
        )
        used[j] = [0, 1, 2, 3] if float(np.ptp(signs)) > 1.0 else [0, 1, 3]
    width = sum(map(len, used.values()))
    for place, j in enumerate(joints):
        keep = [part.known_rows[:, j] for part in parts]
        own = np.vstack([columns[k, j][:, used[j]] for (columns, _), k in zip(here, keep, strict=True)])
        values = np.concatenate([target[k, j] for (_, target), k in zip(here, keep, strict=True)])
        model = np.linalg.lstsq(own, values, rcond=None)[0]
        for record, k in enumerate(keep):
            rows = np.flatnonzero(k)
            if not len(rows):
                continue
            (ahead, target_ahead), (behind, target_behind) = later[record], earlier[record]
            # The direction of a known sample does not depend on the delay.
            ahead[rows, j, 2] = behind[rows, j, 2]
            slope = (target_ahead[rows, j] - ahead[rows, j][:, used[j]] @ model) - (
                target_behind[rows, j] - behind[rows, j][:, used[j]] @ model
            )
            matrix = np.zeros((len(rows), width + count))
            matrix[:, first : first + len(used[j])] = here[record][0][rows, j][:, used[j]]
            matrix[:, width + (place if separate else 0)] = -slope / (2.0 * _SHIFT_S)
            groups.append(RowGroup(str(j), "difference", record, matrix, here[record][1][rows, j], rows))
        first += len(used[j])
    titles = [f"{_SYMBOLS[k]} {j}" for j in joints for k in used[j]]
    titles += [f"delay {k}" for k in range(count)]
    step = parts[0].row_s
    fit = WeightedLeastSquares(CovarianceSettings("hac")).fit(Problem(tuple(titles), tuple(groups), step))
    viscous = fit.values[[titles.index(f"Fvm {j}") for j in joints]]
    return fit.values[-count:], fit.std[-count:], viscous
