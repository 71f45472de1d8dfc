"""From the raw channels of a session to filtered motion and torque at their own sample times.

The positions pass the zero-phase Butterworth and are differentiated. The torques stay as measured, because the
parallel filter of the rows acts on torque and regressor alike. The motion is evaluated at the sample times of
the motor channel minus its delay, so a slow or irregular torque is never resampled.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from fri.errors import ConfigurationError, DataError
from ident.dynamics.parameters import Floats
from ident.rows.content import Recall
from ident.rows.data_quality import (
    Frozen,
    Jump,
    frozen_flags,
    frozen_positions,
    frozen_torques,
    held,
    position_jumps,
    stale,
)
from ident.rows.delay import DELAY_HZ, DISAGREEMENT, Delay, DelayData, estimate_delay
from ident.rows.filtered_motion import (
    Motion,
    excitation_hz,
    filtered_motions,
    motions_shelved,
    recalled,
    short,
)
from ident.rows.filters import (
    ParallelFilter,
    SignalSettings,
    advice,
    block_means,
    enough,
    median_step,
    moving,
    thinning,
)
from ident.rows.prepared import BoolArray, Passage, PreparedSession, TorqueChannel
from ident.rows.sample_clock import SampleClock, sample_clock
from ident.rows.timebase import (
    Stretch,
    flag_outliers,
    sample_period,
    stretches,
)
from lwr_driver.session import JointColumns, Session
from lwr_driver.session.spool import release, shelved, spans

logger = logging.getLogger(__name__)


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
    channels = (session.joint, session.motor)
    own = recall if short(len(session.joint), len(session.joint_names)) else Recall()
    joint = own.of(partial(_joint_channel, session, motor), *channels, motor)
    settings = (settings or SignalSettings()).settled(1.0 / joint.dt)
    moved = _moved(session, joint, settings, blocks, recall)
    sound = moved.sound
    warnings = list(sound.warnings)
    motor_data, delay = None, None
    if motor and session.motor is not None:
        motor_data, told = own.of(
            partial(_motor, session, joint.origin, settings, recall), *channels, settings.outlier_scale
        )
        warnings += told
        if joint.clock is not None:
            motor_data = (joint.clock.at(motor_data[0], joint.stamps), *motor_data[1:])
        springs = _stiffness(settings, session.joint_names) if joint.sensed else None
        delay = _delay(motor_data, moved.motions, session.joint_names, settings, springs, joint.sensed)
        warnings += _doubts(delay, name)
    grid = moved.grid
    passages = _motors_shelved(_passages(moved.motions, grid, moved.windows, motor_data, delay, settings))
    if not joint.sensed:
        passages = [replace(p, joint_valid=np.zeros_like(p.joint_valid)) for p in passages]
    if not passages:
        _refuse_short(name, settings)
    advised = advice(
        settings,
        excitation_hz=moved.excitation_hz,
        joint_rate_hz=1.0 / joint.dt,
        motor_rate_hz=None if motor_data is None else 1.0 / median_step(motor_data[0]),
        resonance_hz=resonance_hz,
    )
    warnings += advised if advise else ()
    counts = {
        "lost": sound.lost,
        **sound.flagged,
        "motor_torque_outliers": 0 if motor_data is None else int(motor_data[2].sum()),
        "stretches": len(sound.parts),
        "resampled": int(any(part.resampled for part in sound.parts)),
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
        period_rows=moved.period_rows,
        periods=len(moved.windows) if moved.period_rows else 0,
        delay=delay,
        excitation_hz=moved.excitation_hz,
        cutoff_hz=settings.cutoff,
        moving=sound.moving,
        counts=counts,
        warnings=tuple(warnings),
        uid=session.metadata.get("uid", ""),
        mean_torque=_mean_torque(passages) if joint.sensed else (),
        jitter_s=None if joint.clock is None else joint.clock.jitter_s,
        joint_delay=_joint_delay(settings) if joint.sensed else None,
    )


@dataclass(frozen=True, eq=False)
class _JointChannel:
    """Times of the joint channel's samples, of period dt [s].

    origin : of the stamps [ns]. stamps, times : (N,) [s], as recorded and by the clock that counts, if there is one.
    effort : (N, n) [Nm], zeros where the torques are not `sensed`.
    """

    origin: int
    stamps: Floats
    clock: SampleClock | None
    times: Floats
    dt: float
    effort: Floats
    sensed: bool


def _joint_channel(session: Session, motor: bool) -> _JointChannel:
    """The channel, checked. motor : whether a motor channel may stand for joint torques."""
    name = session.path.name
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
    dt = sample_period(times, session.joint.counts, f"{name}: /joint_states")
    return _JointChannel(origin, stamps, clock, times, dt, effort, sensed)


@dataclass(frozen=True, eq=False)
class _Sound:
    """The stretches of the joint channel without what is wrong with its samples.

    effort_flags : (N, n), torques that count as unknown. moving : names of the moving joints. lost, flagged : samples
    lost and by flag.
    """

    parts: list[Stretch]
    effort_flags: BoolArray
    moving: tuple[str, ...]
    lost: int
    flagged: dict[str, int]
    warnings: list[str]


@dataclass(frozen=True, eq=False)
class _Moved:
    """The filtered motions of a session and the times of its rows.

    excitation_hz : upper frequency of the motion. windows, grid : spans and times of the rows [s]. period_rows : rows
    in a period, if the periods are equal.
    """

    sound: _Sound
    motions: list[Motion]
    excitation_hz: float
    windows: list[tuple[float, float]]
    grid: Floats
    period_rows: int | None


def _sound(session: Session, joint: _JointChannel, settings: SignalSettings, recall: Recall) -> _Sound:
    name, names = session.path.name, session.joint_names
    position, effort = session.joint.position, joint.effort
    position_flags, crowded = outliers(position, settings.outlier_scale, recall)
    effort_flags, also = outliers(effort, settings.outlier_scale, recall)
    seen = recall.of(partial(_seen, session.joint, joint.times, joint.clock), session.joint)
    kept, stuck = seen.held, frozen_flags(seen.torques, effort.shape)
    effort_flags = effort_flags | kept[:, None] | stuck
    if not seen.moving:
        raise DataError(
            f"{name}: no joint moves by more than 0.01 rad; record an excitation motion, a pose alone does "
            "not show inertia and friction"
        )
    unseen = frozen_flags(seen.positions, position.shape).any(axis=1)
    bad: BoolArray = np.asarray(position_flags.any(axis=1)) | seen.stale | unseen
    jumps = [jump.behind for jump in seen.jumps]
    parts, lost = stretches(joint.times, (position, effort), bad, joint.dt, settings.longest_bridge_s, jumps)
    if not parts:
        raise DataError(f"{name}: no uninterrupted stretch of samples is long enough; check the recording")
    return _Sound(
        parts=parts,
        effort_flags=effort_flags,
        moving=seen.moving,
        lost=lost,
        flagged={
            "stale": int(seen.stale.sum()),
            "position_outliers": int(position_flags.sum()),
            "joint_torque_outliers": int((effort_flags & ~stuck)[~kept].sum()),
            "joint_torque_held": int(kept.sum()),
            "joint_torque_frozen": int(stuck.sum()),
            "position_frozen": int(unseen.sum()),
            "position_jumps": len(set(jumps)),
        },
        warnings=[
            *_jumping(name, "position", names, crowded),
            *_jumping(name, "joint torque", names, also),
        ],
    )


def _moved(
    session: Session, joint: _JointChannel, settings: SignalSettings, blocks: bool, recall: Recall
) -> _Moved:
    names = session.joint_names
    samples = session.joint, settings.outlier_scale, settings.longest_bridge_s
    own = recall if short(len(session.joint), len(names)) else Recall()
    sound = own.of(partial(_sound, session, joint, settings, recall), *samples)
    windows, periods = _windows(session, joint.times)
    grid, period_rows = _row_grid(windows, periods, settings)
    springs = _stiffness(settings, names) if joint.sensed else None
    same = *samples, settings.cutoff, settings.order
    wide = partial(recalled, sound.effort_flags, joint.times, settings, springs, recall, same)
    coupled = settings.coupled_places(names)
    motions = motions_shelved(filtered_motions(sound.parts, wide, settings, coupled, blocks))
    release(session.joint.position, joint.effort)
    longest = max(sound.parts, key=lambda part: part.count)
    excitation = recall.of(partial(excitation_hz, motions, longest, joint.dt, settings.cutoff), *same)
    return _Moved(sound, motions, excitation, windows, grid, period_rows)


def _doubts(delay: Delay, name: str) -> Iterator[str]:
    """Warnings about the motor channel's delay."""
    if delay.disagreement > DISAGREEMENT:
        spread = ", ".join(f"{joint} {1e3 * own:.1f}" for joint, (own, _) in delay.by_joint.items())
        yield (
            f"{name}: the joints disagree about the motor channel's delay ({spread} ms), "
            f"{delay.disagreement:.1f} times beyond their standard deviations; elastic joints do that, "
            "and the stated deviation of the delay allows for it"
        )
    if delay.early:
        yield (
            f"{name}: the motor torque looks early by {-1e3 * delay.estimate:.1f} ms, as no channel can be, and "
            "elastic joints do by one or two at most: the joint torque is late, or the stamps are wrong. It is "
            "taken as not late; correct the stamps, or state `motor_delay_s`"
        )


def _refuse_short(name: str, settings: SignalSettings) -> NoReturn:
    """DataError for a session without a stretch of a row."""
    said = f"the ends of the position filter, {2.0 * settings.edge:.2f} s"
    remedy = "raise `cutoff_hz`" if settings.edge_s is None else "lower `edge_s`"
    if settings.rate_hz is not None and 1.0 / settings.rate_hz > 2.0 * settings.edge:
        said, remedy = f"the time between two rows, {1.0 / settings.rate_hz:.2f} s", "raise `rate_hz`"
    raise DataError(f"{name}: no stretch is longer than {said}; record a longer motion or {remedy}")


@dataclass(frozen=True)
class _Seen:
    """What the joint channel shows of its samples, whatever the settings.

    stale : (N,), older than their stamps or repeated. held : (N,), with torques kept in all joints. positions,
    torques : frozen ones. jumps : of the positions. moving : names of the moving joints.
    """

    stale: BoolArray
    held: BoolArray
    positions: tuple[Frozen, ...]
    torques: tuple[Frozen, ...]
    jumps: tuple[Jump, ...]
    moving: tuple[str, ...]


def outliers(values: Floats, scale: float, recall: Recall) -> tuple[BoolArray, list[int]]:
    """`flag_outliers` of a channel (n, k), recalled."""
    return recall.of(partial(flag_outliers, values, scale), values, scale)


def _seen(joint: JointColumns, times: Floats, clock: SampleClock | None) -> _Seen:
    position, effort, sensed = joint.position, joint.effort, bool(joint.effort.shape[1])
    return _Seen(
        stale(joint) if clock is None else clock.repeated,
        held(effort, times, times, position) if sensed else np.zeros(len(times), dtype=bool),
        frozen_positions(joint),
        frozen_torques(effort, times, times, position) if sensed else (),
        position_jumps(joint),
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
    motions: Sequence[Motion],
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
    recall: Recall,
) -> tuple[tuple[Floats, Floats, BoolArray], list[str]]:
    """Times (m,) [s] on the joint channel's clock, torques (m, J) and outlier flags (m, J) of the motor channel; and
    warnings."""
    assert session.motor is not None
    name, warnings = session.path.name, list[str]()
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
    flags, crowded = outliers(effort, settings.outlier_scale, recall)
    warnings += _jumping(name, "motor torque", session.joint_names, crowded)
    path_times = np.asarray((reference - origin) * 1e-9, dtype=np.float64)
    path = session.joint.position
    flags = flags | held(effort, times, path_times, path)[:, None]
    flags |= frozen_flags(frozen_torques(effort, times, path_times, path), effort.shape)
    effort = effort.copy() if flags.any() else effort
    for joint in np.flatnonzero(flags.any(axis=0)):
        good = ~flags[:, joint]
        effort[~good, joint] = np.interp(times[~good], times[good], effort[good, joint])
    return (times, effort, flags), warnings


def _jumping(name: str, what: str, joints: tuple[str, ...], columns: list[int]) -> list[str]:
    return [
        f"{name}: {joints[column]} {what} jumps too often for outliers, nothing was removed; look at the channel"
        for column in columns
    ]


def _delay(
    motor_data: tuple[Floats, Floats, BoolArray],
    motions: list[Motion],
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
            m.times, *m.of_motors, m.present_torque(settings), m.away & ~m.flagged, times, torque,
            m.usable(settings), m.core,
        )
        for m in motions
    ]  # fmt: skip
    rate = 1.0 / median_step(times)
    return estimate_delay(
        data,
        names,
        cutoff_hz=min(DELAY_HZ, settings.cutoff, 0.2 * rate),
        search_s=settings.delay_search_s,
        compliance=None if springs is None else 1.0 / springs,
        # Joint torques ahead of the positions say that these are late.
        earliest_s=-np.inf if settings.joint_delay < 0.0 else 0.0,
    )


def _joint_delay(settings: SignalSettings) -> Delay:
    how = "the base model tells it" if settings.joint_delay_s == "estimate" else "stated"
    return Delay(settings.joint_delay, 0.0, how)


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
