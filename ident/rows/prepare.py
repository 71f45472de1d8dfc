"""From the raw channels of a session to filtered motion and torque at their own sample times.

The positions pass the zero-phase Butterworth and are differentiated. The torques stay as measured, because the
parallel filter of the rows acts on torque and regressor alike. The motion is evaluated at the sample times of
the motor channel minus its delay, so a slow or irregular torque is never resampled.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fri.errors import ConfigurationError, DataError
from ident.dynamics.parameters import Floats
from ident.dynamics.structure import DriveMotion
from ident.rows.content import Recall
from ident.rows.data_quality import Frozen, frozen_flags, frozen_positions, frozen_torques, held, stale
from ident.rows.delay import DELAY_DB, DELAY_HZ, Delay, DelayData, estimate_delay
from ident.rows.filters import (
    Excitation,
    ParallelFilter,
    SignalSettings,
    advice,
    block_means,
    differentiate,
    enough,
    half_width,
    interpolate_uniform,
    low_pass,
    median_step,
    moving,
    settling,
    thinning,
)
from ident.rows.reversals import away_from_reversals, turning_reach
from ident.rows.sample_clock import SampleClock, sample_clock
from ident.rows.timebase import (
    Stretch,
    flag_outliers,
    sample_period,
    stretches,
)
from lwr_driver.session import JointColumns, Session
from lwr_driver.session.spool import LEAST_BYTES, release, shelved, spans

BoolArray = NDArray[np.bool_]

logger = logging.getLogger(__name__)

# Scatter of seven joints over their standard deviations, exceeded once in a thousand healthy sessions, for deviations
# that are a third too small.
_DISAGREEMENT = 3.0
# Longest block [s]. Bounds of the frequency and the attenuation of the rows of a delay.
_BLOCK_S = 120.0
# Latest filtered motions of stretches: two sessions at two cut-offs.
_MOST_MOTIONS = 4
_SAMPLED = ("times", "q", "qd", "qdd", "torque", "flagged", "known")


@dataclass(frozen=True)
class TorqueChannel:
    """Torque of one side as measured, and the filtered motion at its sample times.

    times : (m,) [s], delay removed. q, qd, qdd, torque : (m, J). flagged : (m, J), bridged or outliers.
    known : (m, J), neither flagged nor beside a reversal of their joint. drive : motion of the motors
    where it is known to differ from the links', else None. period_s : median time between samples [s].
    """

    side: str
    times: Floats
    q: Floats
    qd: Floats
    qdd: Floats
    torque: Floats
    flagged: BoolArray
    known: BoolArray
    drive: DriveMotion | None = None
    period_s: float = float("nan")

    @property
    def arrays(self) -> tuple[Floats | BoolArray, ...]:
        """All arrays by sample."""
        drive = () if self.drive is None else (self.drive.speed, self.drive.acceleration)
        return (*(getattr(self, name) for name in _SAMPLED), *drive)

    def on(self, arrays: Sequence[NDArray[Any]]) -> TorqueChannel:
        """The channel with other arrays."""
        drive = None if self.drive is None else DriveMotion(arrays[len(_SAMPLED)], arrays[len(_SAMPLED) + 1])
        found: dict[str, Any] = dict(zip(_SAMPLED, arrays, strict=False))
        return replace(self, **found, drive=drive)

    def at(self, samples: NDArray[np.bool_] | NDArray[np.int64]) -> TorqueChannel:
        """The channel at some of its samples."""
        drive = None if self.drive is None else self.drive.at(samples)
        return replace(self, **{name: getattr(self, name)[samples] for name in _SAMPLED}, drive=drive)


@dataclass(frozen=True)
class Passage:
    """An uninterrupted stretch with the times of its rows, or a block of it.

    rows : (K,) times of the rows [s]; index : (K,) int64, their numbers within the session.
    joint_valid, motor_valid : (K, J), usable rows. core : times of the block [s]; its samples overlap those of its
    neighbours by the reach of the filters. stretch_rows : times of all rows of the stretch.
    """

    rows: Floats
    index: NDArray[np.int64]
    joint: TorqueChannel
    joint_valid: BoolArray
    motor: TorqueChannel | None
    motor_valid: BoolArray | None
    core: tuple[float, float] = (-np.inf, np.inf)
    stretch_rows: Floats = field(default_factory=lambda: np.zeros(0))

    @property
    def continues(self) -> bool:
        """Whether it goes on where the block before ends."""
        return self.core[0] > -np.inf

    def own(self, times: Floats) -> BoolArray:
        """Samples (m,) of this block alone."""
        return np.asarray((times >= self.core[0]) & (times < self.core[1]))

    def release(self) -> None:
        """Give the memory of its samples back, as far as they are in files."""
        for channel in (self.joint, self.motor):
            release(*(() if channel is None else channel.arrays))


@dataclass(frozen=True)
class PreparedSession:
    """A session ready for any regressor.

    row_time_s : time between rows. period_rows : rows in a period of the excitation, None without periods.
    delay : of the motor channel, None without one. counts : lost samples, outliers, dropped rows.
    moving : moving joints. warnings : sentences for the report. uid : of the session, from its metadata.
    mean_torque : (J,) mean of |joint torque| from the first row to the last [Nm]; empty without the sensors.
    jitter_s : rms of the stamps about the counted times [s] (`sample_clock`), None where the stamps stand.
    """

    name: str
    joint_names: tuple[str, ...]
    settings: SignalSettings
    passages: Sequence[Passage]
    row_time_s: float
    period_rows: int | None
    periods: int
    delay: Delay | None
    excitation_hz: float
    cutoff_hz: float
    moving: tuple[str, ...]
    counts: dict[str, int]
    warnings: tuple[str, ...]
    uid: str = ""
    mean_torque: tuple[float, ...] = ()
    jitter_s: float | None = None

    def __repr__(self) -> str:
        return (
            f"Prepared session {self.name}: {self.counts['rows']} rows, cut-off {self.cutoff_hz:.3g} Hz, "
            f"excitation up to {self.excitation_hz:.3g} Hz"
        )

    def without_samples(self) -> PreparedSession:
        """The same without its passages, to save memory; enough for the report."""
        return replace(self, passages=())

    @property
    def has_motor(self) -> bool:
        """Whether the session has motor torques."""
        return any(passage.motor is not None for passage in self.passages)


def prepare(
    session: Session,
    settings: SignalSettings | None = None,
    *,
    resonance_hz: float | None = None,
    motor: bool = True,
    log: bool = True,
    advise: bool = True,
    blocks: bool = False,
    recall: Recall | None = None,
) -> PreparedSession:
    """Filter and align one session.

    motor : False leaves the motor channel aside. log : False keeps warnings to itself. advise : False gives no advice
    on cut-offs, for those that the data chose. blocks : passages of two minutes at most, with samples beyond their
    ends for the filters and kept in files, so that the memory does not grow with the session. recall : what earlier
    calls with the same session found.

    Raises DataError for too few samples, times that do not increase, non-finite values, no torque, no motion.
    """
    name, recall = session.path.name, recall or Recall()
    _check_finite(session.joint, name)
    origin = int(clock_ns(session.joint)[0])
    stamps = np.asarray((clock_ns(session.joint) - origin) * 1e-9, dtype=np.float64)
    position, effort = session.joint.position, session.joint.effort
    clock = sample_clock(stamps, position)
    times = stamps if clock is None else clock.times
    sensed = bool(effort.shape[1])
    if not sensed:
        if not motor or session.motor is None:
            raise DataError(
                f"{name}: /joint_states has no effort, so no joint torque; record it, or choose Model 2 "
                "with a session with motor torques"
            )
        effort = np.zeros_like(position)
    sequence = session.joint.sequence if session.joint.numbered else None
    dt = sample_period(times, sequence, f"{name}: /joint_states")
    settings = (settings or SignalSettings()).settled(1.0 / dt)
    warnings: list[str] = []
    position_flags, crowded = _outliers(position, settings, recall)
    effort_flags, also = _outliers(effort, settings, recall)
    seen = recall.of(partial(_seen, session.joint, times, clock), session.joint)
    kept, stuck = seen.held, frozen_flags(seen.torques, effort.shape)
    effort_flags = effort_flags | kept[:, None] | stuck
    warnings += _jumping(name, "position", session.joint_names, crowded)
    warnings += _jumping(name, "joint torque", session.joint_names, also)
    if not seen.moving:
        raise DataError(
            f"{name}: no joint moves by more than 0.01 rad; record an excitation motion, a pose alone does "
            "not show inertia and friction"
        )
    unseen = frozen_flags(seen.positions, position.shape).any(axis=1)
    bad: BoolArray = np.asarray(position_flags.any(axis=1)) | seen.stale | unseen
    parts, lost = stretches(times, (position, effort), bad, dt, settings.longest_bridge_s)
    if not parts:
        raise DataError(f"{name}: no uninterrupted stretch of samples is long enough; check the recording")
    windows, periods = _windows(session, times)
    grid, period_rows = _row_grid(windows, periods, settings)
    count, resampled = len(parts), any(part.resampled for part in parts)
    springs = _stiffness(settings, session.joint_names) if sensed else None
    same = session.joint, settings.cutoff, settings.order, settings.outlier_scale, settings.longest_bridge_s
    wide = partial(_wide, effort_flags, times, settings, springs, recall, same)
    motions = _shelved(_filtered(parts, wide, settings, blocks))
    release(position, effort)
    longest = max(parts, key=lambda part: part.count)
    excitation = recall.of(partial(_excitation_hz, motions, longest, dt), *same)
    flagged = {
        "stale": int(seen.stale.sum()),
        "position_outliers": int(position_flags.sum()),
        "joint_torque_outliers": int((effort_flags & ~stuck)[~kept].sum()),
        "joint_torque_held": int(kept.sum()),
        "joint_torque_frozen": int(stuck.sum()),
        "position_frozen": int(unseen.sum()),
    }
    # A tenth of a gigabyte for an hour.
    del parts, longest, position_flags, effort_flags, kept, stuck, unseen, bad, times
    motor_data = (
        _motor(session, origin, settings, name, warnings, recall)
        if motor and session.motor is not None
        else None
    )
    if motor_data is not None and clock is not None:
        motor_data = (clock.at(motor_data[0], stamps), *motor_data[1:])
    delay = None
    if motor_data is not None:
        delay = _delay(motor_data, motions, session.joint_names, settings, springs, sensed)
        if delay.disagreement > _DISAGREEMENT:
            spread = ", ".join(f"{joint} {1e3 * own:.1f}" for joint, (own, _) in delay.by_joint.items())
            warnings.append(
                f"{name}: the joints disagree about the motor channel's delay ({spread} ms), "
                f"{delay.disagreement:.1f} times beyond their standard deviations; elastic joints do that, "
                "and the stated deviation of the delay allows for it"
            )
        if delay.early:
            warnings.append(
                f"{name}: the motor torque looks early by {-1e3 * delay.estimate:.1f} ms, as no channel can be, and "
                "elastic joints do by one or two at most: the joint torque is late, or the stamps are wrong. It is "
                "taken as not late; correct the stamps, or state `motor_delay_s`"
            )
    passages = _motors_shelved(_passages(motions, grid, windows, motor_data, delay, settings))
    if not sensed:
        passages = [replace(p, joint_valid=np.zeros_like(p.joint_valid)) for p in passages]
    if not passages:
        raise DataError(
            f"{name}: no stretch is longer than the ends of the position filter, {2.0 * settings.edge:.2f} s; record a "
            "longer motion or raise `cutoff_hz`"
        )
    advised = advice(
        settings,
        excitation_hz=excitation,
        joint_rate_hz=1.0 / dt,
        motor_rate_hz=None if motor_data is None else 1.0 / float(np.median(np.diff(motor_data[0]))),
        resonance_hz=resonance_hz,
    )
    warnings += advised if advise else ()
    counts = {
        "lost": lost,
        **flagged,
        "motor_torque_outliers": 0 if motor_data is None else int(motor_data[2].sum()),
        "stretches": count,
        "resampled": int(resampled),
        "rows": sum(len(passage.rows) for passage in passages),
        "joint_rows_dropped": sum(int((~passage.joint_valid).sum()) for passage in passages),
        "motor_rows_dropped": sum(
            int((~passage.motor_valid).sum()) for passage in passages if passage.motor_valid is not None
        ),
    }
    for warning in warnings if log else ():
        logger.warning("%s", warning)
    return PreparedSession(
        name=name,
        joint_names=session.joint_names,
        settings=settings,
        passages=tuple(passages),
        row_time_s=float(grid[1] - grid[0]) if len(grid) > 1 else 1.0 / settings.row_rate_hz,
        period_rows=period_rows,
        periods=len(windows) if period_rows else 0,
        delay=delay,
        excitation_hz=excitation,
        cutoff_hz=settings.cutoff,
        moving=seen.moving,
        counts=counts,
        warnings=tuple(warnings),
        uid=session.metadata.get("uid", ""),
        mean_torque=_mean_torque(passages) if sensed else (),
        jitter_s=None if clock is None else clock.jitter_s,
    )


@dataclass(frozen=True)
class _Seen:
    """What the joint channel shows of its samples, whatever the settings.

    stale : (N,), older than their stamps or repeated. held : (N,), with torques kept in all joints. positions,
    torques : frozen ones. moving : names of the moving joints.
    """

    stale: BoolArray
    held: BoolArray
    positions: tuple[Frozen, ...]
    torques: tuple[Frozen, ...]
    moving: tuple[str, ...]


def _outliers(values: Floats, settings: SignalSettings, recall: Recall) -> tuple[BoolArray, list[int]]:
    """Flags (n, k) and columns with too many of them: see `flag_outliers`."""
    scale = settings.outlier_scale
    return recall.of(partial(flag_outliers, values, scale), values, scale)


def _seen(joint: JointColumns, times: Floats, clock: SampleClock | None) -> _Seen:
    position, effort, sensed = joint.position, joint.effort, bool(joint.effort.shape[1])
    return _Seen(
        stale(joint) if clock is None else clock.repeated,
        held(effort, times, times, position) if sensed else np.zeros(len(times), dtype=bool),
        frozen_positions(joint),
        frozen_torques(effort, times, times, position) if sensed else (),
        moving(position, joint.names),
    )


def _mean_torque(passages: list[Passage]) -> tuple[float, ...]:
    sums, count = np.zeros(passages[0].joint.torque.shape[1]), 0
    for passage in passages:
        times, rows = passage.joint.times, passage.stretch_rows
        inside = passage.own(times) & (times >= rows[0]) & (times <= rows[-1])
        sums += np.abs(passage.joint.torque[inside]).sum(axis=0)
        count += int(inside.sum())
        passage.release()
    return tuple((sums / max(count, 1)).tolist())


@dataclass(frozen=True)
class _Wide:
    """Filtered motion of the samples of a stretch from number `low` on, and their joint torque.

    q, qd, qdd, torque, flagged : (n, J). drive : as in `TorqueChannel`.
    """

    low: int
    q: Floats
    qd: Floats
    qdd: Floats
    torque: Floats
    flagged: BoolArray
    drive: DriveMotion | None

    @classmethod
    def of(
        cls,
        part: Stretch,
        low: int,
        high: int,
        effort_flags: BoolArray,
        times: Floats,
        settings: SignalSettings,
        stiffness: Floats | None,
    ) -> _Wide:
        """The samples from `low` to before `high`."""
        joints = effort_flags.shape[1]
        values = part.part(low, high)
        release(*part.columns)
        q = low_pass(values[:, :joints], part.dt, settings.cutoff, settings.order)
        qd, qdd = differentiate(q, part.dt)
        torque = values[:, joints:].copy()
        flagged = np.repeat(part.bridged[low:high, None], joints, axis=1)
        grid = part.start + part.dt * np.arange(low, high, dtype=np.float64)
        for joint in np.flatnonzero(effort_flags.any(axis=0)):
            hit = np.rint((times[effort_flags[:, joint]] - part.start) / part.dt).astype(np.int64) - low
            spread = np.unique(np.concatenate([hit - 1, hit, hit + 1])) if part.resampled else np.unique(hit)
            flagged[spread[(spread >= 0) & (spread < len(grid))], joint] = True
            good = ~flagged[:, joint]
            torque[~good, joint] = np.interp(grid[~good], grid[good], torque[good, joint])
        drive = None
        if stiffness is not None:
            twist = low_pass(torque / stiffness, part.dt, settings.cutoff, settings.order)
            rate, change = differentiate(twist, part.dt)
            drive = DriveMotion(qd + rate, qdd + change)
        return cls(low, q, qd, qdd, torque, flagged, drive)


def _wide(
    effort_flags: BoolArray,
    times: Floats,
    settings: SignalSettings,
    stiffness: Floats | None,
    recall: Recall,
    same: tuple[Any, ...],
    part: Stretch,
    low: int,
    high: int,
) -> _Wide:
    """`_Wide.of`, recalled for a short stretch. same : what the motion of a session depends on."""
    make = partial(_Wide.of, part, low, high, effort_flags, times, settings, stiffness)
    if high - low < part.count or 8 * effort_flags.shape[1] * part.count >= LEAST_BYTES:
        return make()
    return recall.of(make, *same, settings.stiffness_nm_rad, part.start, most=_MOST_MOTIONS)


@dataclass(frozen=True)
class _Motion:
    """Filtered motion of a block of one stretch and its joint torque.

    start, end : times of the whole stretch's first and last sample [s]. low : number of the first sample here. core :
    times of the block [s].
    """

    start: float
    end: float
    dt: float
    low: int
    core: tuple[float, float]
    q: Floats
    qd: Floats
    qdd: Floats
    torque: Floats
    flagged: BoolArray
    away: BoolArray
    drive: DriveMotion | None

    @classmethod
    def of(
        cls,
        part: Stretch,
        span: tuple[int, int],
        core: tuple[float, float],
        wide: _Wide,
        settings: SignalSettings,
    ) -> _Motion:
        """The samples from span[0] to before span[1] of `wide`."""
        beside = settings.reversal, settings.standstill_rad_s, settings.turning
        away = away_from_reversals(wide.qd, part.dt, *beside)
        away &= np.abs(wide.qd) > settings.slow
        kept = slice(span[0] - wide.low, span[1] - wide.low)
        states = wide.q[kept], wide.qd[kept], wide.qdd[kept], wide.torque[kept]
        drive = None if wide.drive is None else wide.drive.at(kept)
        return cls(
            part.start, part.end, part.dt, span[0], core, *states, wide.flagged[kept], away[kept], drive
        )

    @property
    def arrays(self) -> tuple[Floats | BoolArray, ...]:
        """All arrays by sample."""
        drive = () if self.drive is None else (self.drive.speed, self.drive.acceleration)
        return (self.q, self.qd, self.qdd, self.torque, self.flagged, self.away, *drive)

    def on(self, arrays: Sequence[NDArray[Any]]) -> _Motion:
        """The same with other arrays."""
        names = ("q", "qd", "qdd", "torque", "flagged", "away")
        drive = None if self.drive is None else DriveMotion(arrays[6], arrays[7])
        found: dict[str, Any] = dict(zip(names, arrays, strict=False))
        return replace(self, **found, drive=drive)

    @property
    def first(self) -> float:
        """Time of the first sample here [s]."""
        return self.start + self.dt * self.low

    @property
    def times(self) -> Floats:
        """Sample times (n,) [s]."""
        return self.start + self.dt * np.arange(self.low, self.low + len(self.q), dtype=np.float64)

    @property
    def of_motors(self) -> tuple[Floats, Floats]:
        """Speed and acceleration (n, J) of the motors."""
        return (self.qd, self.qdd) if self.drive is None else (self.drive.speed, self.drive.acceleration)

    def usable(self, settings: SignalSettings) -> tuple[float, float]:
        """First and last time of the stretch unaffected by the filter's start and end [s]."""
        return self.start + settings.edge, self.end - settings.edge

    def channel(self, settings: SignalSettings) -> TorqueChannel:
        """The joint torque channel, without the filter's ends."""
        cut, count = int(np.ceil(settings.edge / self.dt)), round((self.end - self.start) / self.dt) + 1
        part = slice(max(cut - self.low, 0), max(min(count - cut - self.low, len(self.q)), 0))
        flagged = self.flagged[part]
        return TorqueChannel(
            "joint", self.times[part], self.q[part], self.qd[part], self.qdd[part], self.torque[part],
            flagged, self.away[part] & ~flagged, period_s=self.dt,
        )  # fmt: skip

    def motor_channel(
        self, times: Floats, torque: Floats, flags: BoolArray, delay: float, settings: SignalSettings
    ) -> TorqueChannel | None:
        """The motor torque with the motion at its own times minus the delay.

        Lost positions are bridged, at this bandwidth as good as measured ones.
        """
        first, last = self.usable(settings)
        actual = times - delay
        low, high = int(np.searchsorted(actual, first)), int(np.searchsorted(actual, last, side="right"))
        if high - low < 16:
            return None
        period = median_step(actual[low:high])
        # Samples averaged before a low-pass are the same in all blocks.
        together = thinning(period, settings.decimate)
        if not enough(high - low, period, settings.decimate):
            return None
        if self.core[0] > -np.inf:
            since = int(np.searchsorted(actual, self.first)) - low
            low += max(-(-since // together), 0) * together
        if self.core[1] < np.inf:
            until = int(np.searchsorted(actual, self.first + self.dt * (len(self.q) - 1), side="right"))
            high = min(high, until)
        inside = slice(low, high)
        actual, flagged = actual[inside], flags[inside]
        start, dt = self.first, self.dt
        q, qd, qdd = (interpolate_uniform(state, start, dt, actual) for state in (self.q, self.qd, self.qdd))
        at = np.clip(np.rint((actual - start) / dt).astype(np.int64), 0, len(self.q) - 1)
        drive = None
        if self.drive is not None:
            moved = (self.drive.speed, self.drive.acceleration)
            drive = DriveMotion(*(interpolate_uniform(state, start, dt, actual) for state in moved))
        known = self.away[at] & ~flagged
        return TorqueChannel(
            "motor", actual, q, qd, qdd, torque[inside], flagged, known, drive, period_s=period
        )


def _filtered(
    parts: list[Stretch],
    wide: Callable[[Stretch, int, int], _Wide],
    settings: SignalSettings,
    blocks: bool,
) -> Iterator[_Motion]:
    """The motions of all stretches, block after block. wide : the samples of a stretch between two numbers."""
    seen = turning_reach(settings.reversal, settings.standstill_rad_s, settings.turning)
    for part in parts:
        around = int(np.ceil((settling(settings.cutoff, settings.order) + seen) / part.dt)) + 16
        for span, core in _cut(part, settings, blocks):
            low, high = max(span[0] - around, 0), min(span[1] + around, part.count)
            yield _Motion.of(part, span, core, wide(part, low, high), settings)


def _excitation_hz(motions: Sequence[_Motion], part: Stretch, dt: float) -> float:
    """Upper frequency of the motion of a stretch [Hz]."""
    spectrum = Excitation(part.count, dt)
    for motion in motions:
        if motion.start == part.start:
            mine = (motion.times >= motion.core[0]) & (motion.times < motion.core[1])
            spectrum.add(motion.qd[mine])
            release(*motion.arrays)
    return spectrum.frequency()


def _cut(
    part: Stretch, settings: SignalSettings, blocks: bool
) -> Iterator[tuple[tuple[int, int], tuple[float, float]]]:
    """Samples of each block of a stretch, with those in reach of its filters, and its core [s]."""
    together = thinning(part.dt, settings.decimate)
    size = max(1, round(_BLOCK_S / part.dt / together)) * together
    cut = int(np.ceil(settings.edge / part.dt))
    count = (part.count - 2 * cut) // size
    if not blocks or count < 2:
        yield (0, part.count), (-np.inf, np.inf)
        return
    delay_hz = min(DELAY_HZ, settings.cutoff)
    reach_s = max(
        half_width(settings.decimate, settings.attenuation_db) + settling(2.5 * settings.decimate),
        half_width(delay_hz, DELAY_DB) + settings.delay_search_s + settling(3.0 * delay_hz),
    )
    reach = -(-round((reach_s + 0.5) / part.dt) // together) * together
    for k in range(count):
        first, last = cut + k * size, cut + (k + 1) * size
        low = first - reach if k and first - reach > cut else 0
        high = last + reach if k < count - 1 and last + reach < part.count - cut else part.count
        # A core ends between two samples.
        ends = (part.start + part.dt * (sample - 0.5) for sample in (first, last))
        begin, end = (
            edge if inner else limit
            for edge, inner, limit in zip(ends, (k > 0, k < count - 1), (-np.inf, np.inf), strict=True)
        )
        yield (low, high), (begin, end)


def _shelved(motions: Iterable[_Motion]) -> list[_Motion]:
    """The same motions with their arrays in files where they are long."""
    bare: list[_Motion] = []

    def arrays() -> Iterator[tuple[NDArray[Any], ...]]:
        for motion in motions:
            bare.append(motion.on([array[:0].copy() for array in motion.arrays]))
            yield motion.arrays

    found = shelved(arrays())
    return [motion.on(arrays) for motion, arrays in zip(bare, found, strict=True)]


def _motors_shelved(passages: Iterable[Passage]) -> list[Passage]:
    """The same passages with the arrays of their motor channels in files where they are long."""
    bare: list[Passage] = []

    def arrays() -> Iterator[tuple[NDArray[Any], ...]]:
        for passage in passages:
            if passage.motor is None:
                bare.append(passage)
                continue
            held = passage.motor.arrays
            bare.append(replace(passage, motor=passage.motor.on([array[:0].copy() for array in held])))
            yield held

    found = iter(shelved(arrays()))
    return [
        passage if passage.motor is None else replace(passage, motor=passage.motor.on(next(found)))
        for passage in bare
    ]


def _stiffness(settings: SignalSettings, names: tuple[str, ...]) -> Floats | None:
    if settings.stiffness_nm_rad is None:
        return None
    if len(settings.stiffness_nm_rad) != len(names):
        raise ConfigurationError(
            f"`stiffness_nm_rad` has {len(settings.stiffness_nm_rad)} values for {len(names)} joints; give one a joint"
        )
    return np.array(settings.stiffness_nm_rad)


def _passages(
    motions: Sequence[_Motion],
    grid: Floats,
    windows: list[tuple[float, float]],
    motor_data: tuple[Floats, Floats, BoolArray] | None,
    delay: Delay | None,
    settings: SignalSettings,
) -> Iterator[Passage]:
    within = np.zeros(len(grid), dtype=bool)
    for low, high in windows:
        within |= (grid >= low - 1e-9) & (grid <= high + 1e-9)
    for motion in motions:
        first, last = motion.usable(settings)
        whole = within & (grid >= first) & (grid <= last)
        inside = whole & (grid >= motion.core[0]) & (grid < motion.core[1])
        if not inside.any():
            continue
        rows = grid[inside]
        joint = motion.channel(settings)
        if not enough(len(joint.times), joint.period_s, settings.decimate):
            continue
        motor = motor_valid = None
        if motor_data is not None and delay is not None:
            motor = motion.motor_channel(*motor_data, delay.seconds, settings)
            motor_valid = _valid(motor, rows, settings) if motor is not None else None
        valid = _valid(joint, rows, settings)
        release(*motion.arrays)
        yield Passage(
            rows, np.flatnonzero(inside), joint, valid, motor, motor_valid, motion.core, grid[whole]
        )


def _valid(channel: TorqueChannel, rows: Floats, settings: SignalSettings) -> BoolArray:
    """Rows (K, J) with enough known samples in their filter; a gap and an end of the stretch are unknown."""
    factor = thinning(channel.period_s, settings.decimate)
    times = block_means(channel.times, factor)
    parallel = ParallelFilter(times, rows, settings.decimate, settings.attenuation_db)
    known = parallel.share(block_means(channel.known, factor)) * parallel.coverage()[:, None]
    return np.asarray(known >= settings.known_share)


def _motor(
    session: Session,
    origin: int,
    settings: SignalSettings,
    name: str,
    warnings: list[str],
    recall: Recall,
) -> tuple[Floats, Floats, BoolArray]:
    """Times (m,) [s] on the joint channel's clock, torques (m, J) and outlier flags (m, J) of the motor channel."""
    assert session.motor is not None
    _check_finite(session.motor, name)
    if not session.motor.effort.shape[1]:
        raise DataError(f"{name}: /motor_states has no effort; record motor torques or choose Model 1")
    clock, reference = clock_ns(session.motor), clock_ns(session.joint)
    times = np.asarray((clock - origin) * 1e-9, dtype=np.float64)
    span = (reference[-1] - reference[0]) * 1e-9
    overlap = min(times[-1], span) - max(times[0], 0.0)
    if overlap < 0.5 * (times[-1] - times[0]):
        shift = np.median(session.motor.log_time - clock) - np.median(session.joint.log_time - reference)
        times = times + shift * 1e-9
        warnings.append(
            f"{name}: the motor channel's clock differs from the joint channel's by {shift * 1e-9:.3f} s; "
            "aligned by the host's times first, the rest is the estimated delay"
        )
    sample_period(times, None, f"{name}: /motor_states")
    effort = session.motor.effort
    flags, crowded = _outliers(effort, settings, recall)
    warnings += _jumping(name, "motor torque", session.joint_names, crowded)
    path_times = np.asarray((reference - origin) * 1e-9, dtype=np.float64)
    path = session.joint.position
    flags = flags | held(effort, times, path_times, path)[:, None]
    flags |= frozen_flags(frozen_torques(effort, times, path_times, path), effort.shape)
    effort = effort.copy() if flags.any() else effort
    for joint in np.flatnonzero(flags.any(axis=0)):
        good = ~flags[:, joint]
        effort[~good, joint] = np.interp(times[~good], times[good], effort[good, joint])
    return times, effort, flags


def _jumping(name: str, what: str, joints: tuple[str, ...], columns: list[int]) -> list[str]:
    return [
        f"{name}: {joints[column]} {what} jumps too often for outliers, nothing was removed; look at the channel"
        for column in columns
    ]


def _delay(
    motor_data: tuple[Floats, Floats, BoolArray],
    motions: list[_Motion],
    names: tuple[str, ...],
    settings: SignalSettings,
    springs: Floats | None,
    sensed: bool,
) -> Delay:
    if settings.motor_delay_s != "estimate":
        return Delay(float(settings.motor_delay_s), 0.0, "stated")
    if not sensed:
        return Delay(0.0, 0.0, "no joint torque to compare the motor channel with")
    times, torque, _ = motor_data
    data = [
        DelayData(
            m.times, *m.of_motors, m.torque, m.away & ~m.flagged, times, torque, m.usable(settings), m.core
        )
        for m in motions
    ]  # fmt: skip
    rate = 1.0 / float(np.median(np.diff(times)))
    return estimate_delay(
        data,
        names,
        cutoff_hz=min(DELAY_HZ, settings.cutoff, 0.2 * rate),
        search_s=settings.delay_search_s,
        compliance=None if springs is None else 1.0 / springs,
    )


def clock_ns(columns: JointColumns) -> NDArray[np.int64]:
    """The source's times [ns], or the host's without them."""
    return columns.publish_time if np.ptp(columns.publish_time) > 0 else columns.log_time


def _check_finite(columns: JointColumns, name: str) -> None:
    for what, values in (("position", columns.position), ("effort", columns.effort)):
        whole = all(np.isfinite(values[some]).all() for some in spans(len(values)))
        release(values)
        if not whole:
            row, joint = np.argwhere(~np.isfinite(values))[0]
            raise DataError(
                f"{name}: {columns.topic} {what} of {columns.names[joint]} is {values[row, joint]} at "
                f"sample {row}; remove or repair the sample"
            )


def _windows(session: Session, times: Floats) -> tuple[list[tuple[float, float]], bool]:
    """Spans [s] of the rows: the periods, else the excitation, else everything."""
    for name in ("period", "excitation"):
        spans = session.spans(name)
        if spans:
            log = session.joint.log_time
            # A period may end between two samples.
            edges = np.interp(np.array(spans, dtype=np.int64) - log[0], log - log[0], times)
            found = [(float(a), float(b)) for a, b in edges if b > a]
            if found:
                return found, name == "period"
    return [(float(times[0]), float(times[-1]))], False


def _row_grid(
    windows: list[tuple[float, float]], periods: bool, settings: SignalSettings
) -> tuple[Floats, int | None]:
    """Times of the rows [s], and the rows in a period if the periods are equal and consecutive."""
    step = 1.0 / settings.row_rate_hz
    first, last = windows[0][0], windows[-1][1]
    if periods and len(windows) > 1:
        lengths = np.array([high - low for low, high in windows])
        length = float(np.mean(lengths[:-1]))
        joined = all(abs(a[1] - b[0]) < 0.5 * step for a, b in pairwise(windows))
        # The recording may end with the last sample of the last period, a step before its end.
        late = length - lengths[-1]
        if joined and np.ptp(lengths[:-1]) < 0.1 * step and -0.1 * step < late < step:
            count = max(1, round(length / step))
            total = count * len(windows)
            return first + (length / count) * np.arange(total, dtype=np.float64), count
    return np.arange(first, last + 1e-9, step), None
