"""Lost, repeated, held and clipped samples, detected in the channels themselves."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from ident.rows.content import Kept
from ident.rows.filters import median_step
from lwr_driver.session import JointColumns, Session
from lwr_driver.session.spool import column, spans

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

# Least number and share of bad samples in a session for a finding.
_LEAST_AMISS, _SHARE = 3, 0.0005
# Least third difference of a jolt over the usual one, itself at least this many steps of the encoder.
_JOLT, _STEPS = 16.0, 4.0
# Least age of a stale sample in sample times, and largest share of its displacement across the motion.
_AGE, _ACROSS = 0.15, 0.5
# Least share of steps of one period in an even clock, and largest error of a step there, in periods.
_EVEN, _OFF_CLOCK = 0.9, 0.2
# Shortest pause of a recording.
_PAUSE_S = 1.0
# Distance in samples of a jolt from a repeated sample or a gap.
_NEAR = 4
# Count of one value beyond chance in a noisy channel, also over the counts of the next values; a coarse channel
# stays at its largest value about twice as long as at the next.
_FLAT, _OVER_NEXT = 10, 10
# Least speed of a working motor.
_MOVING_RAD_S = 0.01
# Least duration of held torques over the usual time between two values.
_HELD = 5.0
# A frozen channel: least samples, least time [s], least length over the usual time between two values.
_FEWEST, _FROZEN_S = 5, 0.05
# Least speed of the jump behind a frozen position over the speed afterwards, and over the largest usual change of speed
# (its quantile). Least speed before a halt over that change: a brake needs several samples for it, a frozen position
# none.
_JUMP, _NEARLY_ALL, _HALT = 2.0, 0.999, 10.0
STEP_RAD = 2.0 * np.pi / 4096.0
"""Step of an encoder of 12 bits [rad], no jump."""
# Least speed of a jump over the speeds of so many steps on either side, and over nearly all others of the recording.
_BESIDE, _AROUND, _BEYOND_ALL = 10.0, 5, 3.0
# A frozen torque: least length over nearly all (the quantile) of its other runs of one value, and least share of the
# samples at that value in one run. A dead zone or a coarse sensor comes back to its values again and again.
_LONGER, _NEARLY, _ONE_RUN = 20.0, 0.99, 0.8
# Factor on a usual share of lost samples from day to day, and standard deviations of their number beyond it.
_TWICE, _BY_CHANCE = 2.0, 3.0
# Latest recordings whose frozen positions and jumps are known: an estimator prepares a session several times.
_MOST_KNOWN = 64
# Least way of a joint in two seconds, or speed for a shorter time, to be in motion [rad or m].
_WAY, _WAY_S = 0.05, 2.0
# Share of the power above a quarter of the sampling rate without any sensor's noise: a 17-bit converter makes more.
_SILENT = 1e-10
# Halvings of an interval of shares, for a millionth.
_BISECTIONS = 20
# Share of the power above the band's edge, and least number of samples.
_BEYOND, _LEAST = 1e-6, 64


@dataclass(frozen=True)
class SampleLoss:
    """Samples of a session's channel: missing, repeated from the one before, or older than their stamp."""

    session: str
    channel: str
    lost: int
    repeated: int
    stale: int
    samples: int

    @property
    def amiss(self) -> int:
        """Lost, repeated and stale samples."""
        return self.lost + self.repeated + self.stale

    @property
    def share(self) -> float:
        """Share of the published samples."""
        return self.amiss / max(self.samples + self.lost, 1)

    @property
    def matters(self) -> bool:
        """Whether number and share are beyond chance."""
        return self.amiss >= _LEAST_AMISS and self.share > _SHARE

    def beyond(self, usual: float) -> bool:
        """Whether the share is more than twice a usual one, and that beyond chance."""
        expected = _TWICE * usual * (self.samples + self.lost)
        return self.amiss > expected + _BY_CHANCE * float(np.sqrt(expected))


@dataclass(frozen=True)
class Stuck:
    """A torque [Nm] repeated by a channel for a joint (from 0), with its count of the samples in motion."""

    joint: int
    value: float
    count: int
    samples: int


@dataclass(frozen=True)
class Frozen:
    """A joint (from 0) with one value from the sample `first` to the sample `last` while it moves."""

    joint: int
    first: int
    last: int


@dataclass(frozen=True)
class Jump:
    """A joint (from 0) that is elsewhere by `size` [rad or m] in the sample `behind`, without a motion there."""

    joint: int
    behind: int
    size: float


def all_losses(sessions: Iterable[Session]) -> list[SampleLoss]:
    """The losses of all channels, none included."""
    return [
        _channel(session.path.name, name, columns)
        for session in sessions
        for name, columns in (("joint", session.joint), ("motor", session.motor))
        if columns is not None
    ]


def sample_loss(sessions: Iterable[Session]) -> tuple[SampleLoss, ...]:
    """The channels with relevant losses, worst first."""
    found = [loss for loss in all_losses(sessions) if loss.matters]
    return tuple(sorted(found, key=lambda loss: -loss.share))


def stale(columns: JointColumns) -> Flags:
    """Samples (N,) older than their stamp.

    Either all joints repeat their last torques and positions, or most moving joints jolt at once, like positions a
    part of a sample old. A few such samples are no finding, but derivatives of the positions are wrong there.
    """
    old = _jolts(columns.position) & ~_beside_gaps(columns)
    if _repeated(columns.effort):
        old |= _same(columns.effort) & _same(columns.position)
    return old


def _periods(columns: JointColumns) -> Floats:
    """Times between samples (N - 1,) over their median, by the clock of the source, else of the host."""
    stamps = columns.publish_time if np.ptp(columns.publish_time) > 0 else columns.log_time
    steps = np.diff(stamps).astype(np.float64)
    return steps / max(float(np.median(steps)), 1.0) if len(steps) else steps


def _beside_gaps(columns: JointColumns) -> Flags:
    """Samples (N,) near a lost one, where positions jolt, too."""
    gap = np.zeros(len(columns), dtype=bool)
    gap[1:] = np.abs(_periods(columns) - 1.0) > 0.5
    return np.asarray(binary_dilation(gap, iterations=_NEAR)) if len(gap) > 2 else np.zeros(len(gap), bool)


def _lost(columns: JointColumns) -> int:
    """Number of lost samples by the counter of the source, else by the gaps of an otherwise even clock: a counter may
    be the number of the row.

    A gap of lost samples is a whole number of periods; a longer one is a pause of the recording, and after a late
    sample the next one comes early.
    """
    if columns.lost:
        return columns.lost
    steps = _periods(columns)
    whole = np.rint(steps)
    on_clock = np.abs(steps - whole) < _OFF_CLOCK
    if not len(steps) or np.mean(on_clock & (whole == 1.0)) < _EVEN:
        return 0
    early = np.append(steps[1:] < 1.0 - _OFF_CLOCK, False)
    missing = on_clock & (whole > 1.0) & ~early & (steps * columns.period_s < _PAUSE_S)
    return int(np.sum(whole[missing] - 1.0))


def held(effort: Floats, times: Floats, path_times: Floats, path: Floats) -> Flags:
    """Torques (N, J) kept in all joints for long while the arm moves: True (N,) for the repeated ones.

    times : (N,) [s]. path : (P, J) positions [rad] at path_times (P,). A channel slower than its stamps repeats each
    value equally long; an arm at rest may show equal torques.
    """
    same = _same(effort)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], same, [False]]).astype(np.int8)))
    first, after = edges[::2], edges[1::2]
    fresh = np.flatnonzero(~same)
    usual = float(np.median(np.diff(fresh))) if len(fresh) > 1 else np.inf
    long = after - first >= _HELD * usual
    first, after = first[long], after[long]
    begin, end = times[first - 1], times[after - 1]
    speed = np.zeros(len(first))
    for joint in range(path.shape[1] if len(first) else 0):
        q = column(path, joint)
        way = np.interp(end, path_times, q) - np.interp(begin, path_times, q)
        speed = np.maximum(speed, np.abs(way) / np.maximum(end - begin, 1e-6))
    found = np.zeros(len(same), dtype=bool)
    for a, b in zip(first[speed > _MOVING_RAD_S], after[speed > _MOVING_RAD_S], strict=True):
        found[a:b] = True
    return found


def frozen_positions(columns: JointColumns) -> tuple[Frozen, ...]:
    """Positions at one value for long that end by a jump, or begin by a halt in one sample while other joints move.

    A joint that leaves a rest gains speed from one sample to the next. After a jump it is slower than in the jump.
    """
    clock = columns.publish_time if np.ptp(columns.publish_time) > 0 else columns.log_time
    return _frozen.of(_frozen_positions, (clock - clock[:1]) * 1e-9, columns.position)


_frozen = Kept[tuple[Frozen, ...]](_MOST_KNOWN)


def _frozen_positions(times: Floats, position: Floats) -> tuple[Frozen, ...]:
    """`frozen_positions` of positions (N, J) [rad] at times (N,) [s]."""
    step = np.diff(times)
    step = np.maximum(step, max(float(np.median(step)), 1e-9)) if len(step) else step
    found = []
    for joint in range(position.shape[1]):
        values = column(position, joint)
        bounds = run_bounds(values)
        first, last = bounds[:-1], bounds[1:] - 1
        if len(first) < 3:
            continue
        count = last - first + 1
        long = (count >= max(_FEWEST, _HELD * float(np.median(count)))) & (
            times[last] - times[first] >= _FROZEN_S
        )
        way = np.diff(values)
        speed = way / step
        coarse = max(STEP_RAD, _STEPS * float(np.abs(way[last[:-1]]).min()))
        jumps = long[:-1] & (np.abs(way[last[:-1]]) > coarse)
        # The change of speed at a halt, and those before and behind a jump, are not usual ones.
        usual = np.ones(len(speed) - 1, dtype=bool)
        places = (first[long] - 1, last[:-1][jumps] - 1, last[:-1][jumps])
        usual[np.clip(np.concatenate(places), 0, len(usual) - 1)] = False
        change = np.abs(np.diff(speed))
        limit = float(np.quantile(change[usual], _NEARLY_ALL)) if usual.any() else np.inf
        for k in np.flatnonzero(long):
            start, end = int(first[k]), int(last[k])
            jumped = halted = False
            if k < len(jumps) and jumps[k]:
                after = float(np.max(np.abs(speed[end + 1 : end + 1 + _FEWEST]), initial=0.0))
                jumped = abs(speed[end]) > _JUMP * max(limit, after)
            if start > 0 and abs(speed[start - 1]) > _HALT * limit:
                span = times[end] - times[start]
                others = np.ptp(np.delete(position[start : end + 1], joint, axis=1), axis=0)
                halted = bool(np.any(others > _WAY * min(span / _WAY_S, 1.0)))
            if jumped or halted:
                found.append(Frozen(joint, start, end))
    return tuple(found)


def position_jumps(columns: JointColumns) -> tuple[Jump, ...]:
    """Steps of single positions far beyond the speeds before and after and beyond all others of the recording.

    An angle that wraps, a joint zeroed anew, and samples missing without a gap in the stamps do that. A joint with mass
    passes all speeds in between, and a single wrong sample jumps back. Ordered by sample.
    """
    clock = columns.publish_time if np.ptp(columns.publish_time) > 0 else columns.log_time
    return _jumps.of(jumps, (clock - clock[:1]) * 1e-9, columns.position)


_jumps = Kept[tuple[Jump, ...]](_MOST_KNOWN)


def jumps(times: Floats, position: Floats) -> tuple[Jump, ...]:
    """`position_jumps` of positions (N, J) [rad or m] at times (N,) [s]."""
    if len(times) < 2 * _AROUND + 2:
        return ()
    period = max(median_step(times), 1e-9)
    found = []
    for joint in range(position.shape[1]):
        values = column(position, joint)
        # A value held for some samples, by an encoder's steps or a slower source, is left at the speed since it came.
        fresh = run_bounds(values)[:-1]
        way = np.diff(values[fresh])
        if len(way) < 2 * _AROUND + 1:
            continue
        speed = np.abs(way) / np.maximum(np.diff(times[fresh]), period)
        beside = np.zeros(len(speed))
        for k in range(1, _AROUND + 1):
            np.maximum(beside[k:], speed[:-k], out=beside[k:])
            np.maximum(beside[:-k], speed[k:], out=beside[:-k])
        alone = (speed > _BESIDE * beside) & (np.abs(way) > max(STEP_RAD, _STEPS * float(np.abs(way).min())))
        if not alone.any():
            continue
        usual = float(np.quantile(speed[~alone], _NEARLY_ALL))
        found += [
            Jump(joint, int(fresh[k + 1]), float(way[k]))
            for k in np.flatnonzero(alone & (speed > _BEYOND_ALL * usual))
        ]
    return tuple(sorted(found, key=lambda jump: (jump.behind, jump.joint)))


def frozen_torques(effort: Floats, times: Floats, path_times: Floats, path: Floats) -> tuple[Frozen, ...]:
    """Torques (N, J) of single joints at one value for far longer than usual while the joint moves.

    times : (N,) [s]. path : (P, J) positions [rad] at path_times (P,). All joints at once: `held`.
    """
    found = []
    for joint in range(effort.shape[1]):
        values = column(effort, joint)
        bounds = run_bounds(values)
        count = np.diff(bounds)
        if len(count) < 3:
            continue
        least = max(float(_FEWEST), _LONGER * float(np.quantile(count, _NEARLY)))
        for k in np.flatnonzero(count > least):
            first, last = int(bounds[k]), int(bounds[k + 1]) - 1
            duration = times[last] - times[first]
            inside = values.min() < values[first] < values.max()
            if duration < _FROZEN_S or not inside or count[k] <= _ONE_RUN * np.sum(values == values[first]):
                continue
            others = np.delete(effort[first : last + 1], joint, axis=1)
            if others.shape[1] and not np.any(np.ptp(others, axis=0) > 0.0):
                continue
            low, high = np.searchsorted(path_times, [times[first], times[last]])
            way = np.ptp(path[low : high + 1, joint]) if high > low else 0.0
            if way > _WAY * min(duration / _WAY_S, 1.0):
                found.append(Frozen(joint, first, last))
    return tuple(found)


def frozen_flags(frozen: Iterable[Frozen], shape: tuple[int, ...]) -> Flags:
    """The samples (N, J) of frozen channels but the first of each, the last one measured."""
    flags = np.zeros(shape, dtype=bool)
    for one in frozen:
        flags[one.first + 1 : one.last + 1, one.joint] = True
    return flags


def run_bounds(values: Floats) -> NDArray[np.int64]:
    """First samples of the runs of one value in (N,) values, and N."""
    edges = np.flatnonzero(values[1:] != values[:-1]) + 1
    return np.concatenate([[0], edges, [len(values)]]).astype(np.int64)


def clipped_at(columns: JointColumns) -> Floats:
    """Torque (n,) [Nm] at the limit of each joint's sensor, NaN where the samples show no limit.

    A noisy sensor in motion does not repeat its largest torque by chance. At standstill it may, and so may all joints
    at once in held samples.
    """
    effort, n = columns.effort, columns.effort.shape[1]
    found = np.full(n, np.nan)
    if len(effort) < 2:
        return found
    fresh = np.concatenate([[False], np.any(columns.position[1:] != columns.position[:-1], axis=1)])
    fresh &= ~_same(effort)
    for joint in range(n):
        values = effort[fresh, joint]
        extremes = (values.min(), values.max()) if len(values) else ()
        if not any(np.count_nonzero(values == extreme) >= _FLAT for extreme in extremes):
            continue
        ends = [abs(v) for v, _ in _flat(values) if v in extremes]
        if ends:
            found[joint] = max(ends)
    return found


def stuck_at(motor: JointColumns, joint: JointColumns) -> tuple[Stuck, ...]:
    """Values repeated by the motor torques of moving joints, as by a dead zone or a limit. A working motor is as
    noisy at one torque as at another."""
    if len(motor) < 2 or len(joint) < 2:
        return ()
    found = []
    seconds, clock = ((channel.log_time - joint.log_time[0]) * 1e-9 for channel in (motor, joint))
    steps, held = np.maximum(np.diff(seconds, prepend=seconds[0]), 1e-6), _same(motor.effort)
    for k in range(motor.effort.shape[1]):
        angle = np.interp(seconds, clock, joint.position[:, k])
        speed = np.abs(np.diff(angle, prepend=angle[0])) / steps
        moving = (speed > _MOVING_RAD_S) & ~held
        values = motor.effort[moving, k]
        found += [Stuck(k, value, count, int(moving.sum())) for value, count in _flat(values)]
    return tuple(found)


def _flat(values: Floats) -> list[tuple[float, int]]:
    """Values and counts far more frequent than the two values next to them on either side."""
    values, counts = np.unique(values, return_counts=True)
    often = np.flatnonzero(counts >= _FLAT) if len(values) > 2 else ()
    beside = {k: max(*counts[max(0, k - 2) : k], *counts[k + 1 : k + 3]) for k in often}
    return [(float(values[k]), int(counts[k])) for k in often if counts[k] > _OVER_NEXT * beside[k]]


def _jolts(position: Floats) -> Flags:
    """Samples (N,) with an unusual third difference of the positions in most of the moving joints."""
    found = np.zeros(len(position), dtype=bool)
    moves = np.ptp(position, axis=0) > 0.0 if len(position) else np.zeros(0, dtype=bool)
    if len(position) < 4 or moves.sum() < 2:
        return found
    jolting = np.zeros(len(position) - 3)
    # Column by column: a long session has room for one.
    for joint in np.flatnonzero(moves):
        q = column(position, int(joint))
        third = np.abs(np.diff(q, 3))
        steps = np.abs(np.diff(q))
        step = np.min(steps, where=steps > 0.0, initial=np.inf)
        jolting += third > _JOLT * max(float(np.median(third)), float(_STEPS * step))
    found[2:-1] = jolting > 0.5 * moves.sum()
    if not found.any():
        return found
    return found & _behind(position, moves)


def _behind(position: Floats, moves: Flags) -> Flags:
    """Samples (N,) beside one with all moving joints behind their path by one share of their progress.

    A sample is displaced from the cubic through its four neighbours. One of an older moment lies back along the motion,
    by its age in all joints alike; a jerk of the motion itself does not.
    """
    found = np.zeros(len(position), dtype=bool)
    if len(position) < 5:
        return found
    for some in spans(len(position) - 4):
        q = position[some.start : some.stop + 4, moves]
        away = q[2:-2] - (4.0 * (q[1:-3] + q[3:-1]) - q[:-4] - q[4:]) / 6.0
        progress = (q[4:] - q[:-4]) / 4.0
        power = np.maximum(np.einsum("ij,ij->i", progress, progress), 1e-300)
        age = -np.einsum("ij,ij->i", away, progress) / power
        across = np.linalg.norm(away + age[:, None] * progress, axis=1)
        found[some.start + 2 : some.stop + 2] = (age > _AGE) & (
            across < _ACROSS * np.linalg.norm(away, axis=1)
        )
    return np.asarray(binary_dilation(found, iterations=1))


def _channel(session: str, channel: str, columns: JointColumns) -> SampleLoss:
    repeated, jolts = _repeated(columns.effort), _jolts(columns.position) & ~_beside_gaps(columns)
    if repeated:
        # A repeated sample and the one after it jolt, too.
        jolts &= ~binary_dilation(_same(columns.effort), iterations=_NEAR)
    stale = int(np.count_nonzero(jolts[1:] & ~jolts[:-1])) if len(jolts) else 0
    return SampleLoss(session, channel, _lost(columns), repeated, stale, len(columns))


def _same(effort: Floats) -> Flags:
    """Samples (N,) with the last sample's torques in all joints; a single joint proves nothing."""
    if effort.shape[1] < 2:
        return np.zeros(len(effort), dtype=bool)
    return np.concatenate([[False], np.all(effort[1:] == effort[:-1], axis=1)])


def _repeated(effort: Floats) -> int:
    """Number of repeated samples beyond chance; in smooth or coarse channels equality of all joints proves nothing."""
    if effort.shape[1] < 2 or len(effort) < 3:
        return 0
    same = _same(effort)[1:]
    each = np.mean(effort[1:] == effort[:-1], axis=0)
    # With a share r repeated and a chance e_j of each joint: each_j = r + (1 - r) e_j, same = r + (1 - r) prod e_j.
    share, low, high = float(same.mean()), 0.0, float(same.mean())
    for _ in range(_BISECTIONS):
        r = 0.5 * (low + high)
        chance = float(np.prod((each - r) / (1.0 - r)))
        low, high = (r, high) if r + (1.0 - r) * chance < share else (low, r)
    expected = (share - low) * len(same)
    return max(0, int(same.sum()) - round(expected + 3.0 * np.sqrt(expected)))


def passed_band(values: Floats, dt: float) -> float | None:
    """Upper edge [Hz] of an earlier low-pass on the signals (N, k), None without one.

    A measured torque holds the noise of its sensor at every frequency. A silent upper half of the band is the work of
    a filter, and every event faster than its edge is lost.
    """
    moving = np.ptp(values, axis=0) > 0.0 if len(values) >= _LEAST else np.zeros(1, dtype=bool)
    if not moving.any():
        return None
    signal = values[:, moving] - values[:, moving].mean(axis=0)
    power = np.abs(np.fft.rfft(signal * np.hanning(len(signal))[:, None], axis=0)) ** 2
    above = np.cumsum(power[::-1], axis=0)[::-1] / power.sum(axis=0)
    frequency = np.fft.rfftfreq(len(signal), dt)
    if np.any(above[np.searchsorted(frequency, 0.25 / dt)] > _SILENT):
        return None
    return float(np.max(frequency[np.argmax(above < _BEYOND, axis=0)]))
