"""From prepared sessions to the stacked regression: one filter for the torque and for every regressor column.

The regressor is evaluated at the sample times of its torque, and both pass the same parallel low-pass down to
the row rate, Coulomb columns included (parallel decimation). The full-rate matrix exists only for a stretch of
rows at a time, so the memory does not grow with the sampling rate.

The same rows on the commanded motion are instruments for the estimation: it is known exactly, correlates with
the true motion and is independent of the sensors. `InstrumentalVariables` and the test of exogeneity use them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any, Protocol

import numpy as np
from numba import njit
from numpy.typing import NDArray

from fri.errors import DataError
from ident.dynamics.kinematics import Chain
from ident.dynamics.parameters import Floats
from ident.dynamics.structure import Side
from ident.estimators.problem import Nuisance, Problem, RowGroup
from ident.rows.binned import is_zero
from ident.rows.data_quality import jumps
from ident.rows.filters import (
    ParallelFilter,
    block_means,
    differentiate,
    enough,
    interpolate_uniform,
    low_pass,
    settling,
    thinning,
)
from ident.rows.prepare import clock_ns
from ident.rows.prepared import Passage, PreparedSession, TorqueChannel
from ident.rows.timebase import Stretch, sample_period, stretches
from lwr_driver.session import Session
from lwr_driver.session.spool import Growing, release


class Columns(Protocol):
    """What `observe` needs of a structure."""

    @property
    def chain(self) -> Chain:
        """The arm."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all columns."""

    @property
    def active(self) -> NDArray[np.bool_]:
        """Columns in use."""

    @property
    def sides(self) -> tuple[Side, ...]:
        """Sides of the rows."""

    @property
    def regressor(self) -> Callable[..., Floats]:
        """Observation matrix, as `ModelStructure.regressor`."""


# Blocks of rows filtered at a time, and samples with their regressor in memory.
_BLOCKS, _CHUNK = 4, 500


def observe(
    sessions: Sequence[PreparedSession],
    payloads: Sequence[str | None],
    structure: Columns,
    *,
    columns: Sequence[int] | NDArray[np.int64] | None = None,
    names: Sequence[str] | None = None,
    units: Sequence[str] = (),
) -> Problem:
    """Stacked problem of the sessions, each with the payload mounted in it.

    columns : indices of the structure's columns (default all active ones). names : their names in the result.

    Sessions without a motor channel contribute joint rows only. Rows of a joint at standstill or with missing
    samples are left out. Raises DataError when no row is left.
    """
    chosen = np.flatnonzero(structure.active) if columns is None else np.asarray(columns, dtype=np.int64)
    titles = [structure.names[c] for c in chosen] if names is None else list(names)
    groups: list[RowGroup] = []
    nuisances: list[Nuisance] = []
    for number, (session, payload) in enumerate(zip(sessions, payloads, strict=True)):
        slopes: dict[str, dict[int, Floats]] = {"motor": {}, "joint": {}}
        by_side = {side: _Collected(session, structure.chain.torque_units) for side in structure.sides}
        for passage in session.passages:
            for side, rows in by_side.items():
                part = _side(passage, side, structure, payload, chosen, session)
                if part is not None:
                    rows.add(part)
        for side, rows in by_side.items():
            for group, slope in rows.groups(number, side):
                slopes["joint" if side == "joint" else "motor"][len(groups)] = slope
                groups.append(group)
        for name, delay in (("motor", session.delay), ("joint", session.joint_delay)):
            if delay is not None and slopes[name]:
                nuisances.append(Nuisance(f"{name} delay of {session.name}", delay.std, slopes[name]))
    if not groups:
        raise DataError(
            f"no usable row for {' and '.join(structure.sides)} torque: every row was dropped because a "
            "joint stood still, samples were missing or the channel was absent; check the phases and "
            "channels of the sessions"
        )
    return Problem(
        tuple(titles),
        tuple(groups),
        sessions[0].row_time_s,
        tuple(units),
        tuple(session.name for session in sessions),
        tuple(nuisances),
        tuple(session.period_rows if session.periods > 1 else None for session in sessions),
    )


def stack(problems: Sequence[Problem]) -> Problem:
    """One problem of the rows of several with the same parameters, record after record."""
    if not problems:
        raise DataError("no rows to stack; give at least one session")
    groups: list[RowGroup] = []
    nuisances: list[Nuisance] = []
    names: list[str] = []
    periods: list[int | None] = []
    for problem in problems:
        if problem.names != problems[0].names:
            raise DataError("problems of different parameters cannot be stacked; observe the same columns")
        first = len(groups)
        groups += [replace(group, record=group.record + len(names)) for group in problem.groups]
        nuisances += [
            replace(nuisance, columns={first + k: column for k, column in nuisance.columns.items()})
            for nuisance in problem.nuisances
        ]
        names += problem.record_names
        periods += problem.periods
    return replace(
        problems[0],
        groups=tuple(groups),
        record_names=tuple(names),
        nuisances=tuple(nuisances),
        periods=tuple(periods),
    )


@dataclass(frozen=True)
class _Part:
    """Rows of one passage and side.

    matrix (n, K, C), target (K, n), its time derivative (K, n), valid (K, n), row numbers (K,).
    """

    matrix: Floats
    target: Floats
    slope: Floats
    valid: NDArray[np.bool_]
    index: NDArray[np.int64]


def _side(
    passage: Passage,
    side: Side,
    structure: Columns,
    payload: str | None,
    columns: NDArray[np.int64],
    session: PreparedSession,
) -> _Part | None:
    if side == "joint":
        channel, valid = passage.joint, passage.joint_valid
    elif passage.motor is not None and passage.motor_valid is not None:
        channel, valid = passage.motor, passage.motor_valid
        if side == "difference":
            channel, valid = _difference(passage.joint, channel), valid & passage.joint_valid
            if not enough(len(channel.times), channel.period_s, session.settings.decimate):
                return None
    else:
        return None
    matrix, target = _filtered(channel, passage.rows, side, structure, payload, columns, session)
    slope = _slope(channel, passage.rows, session)
    passage.release()
    return _Part(matrix, target, slope, valid, passage.index)


def _difference(joint: TorqueChannel, motor: TorqueChannel) -> TorqueChannel:
    """The motor channel less the joint torque at its own times."""
    start, dt = float(joint.times[0]), float(joint.times[1] - joint.times[0])
    kept = motor.at((motor.times >= start) & (motor.times <= joint.times[-1]))
    return replace(kept, torque=kept.torque - interpolate_uniform(joint.torque, start, dt, kept.times))


def _slope(channel: TorqueChannel, rows: Floats, session: PreparedSession) -> Floats:
    """Time derivative (K, n) of the torque in the rows, the error per second of a wrong delay."""
    settings = session.settings
    dt = channel.period_s
    smooth = low_pass(channel.torque, dt, min(2.5 * settings.decimate, 0.4 / dt))
    known = channel.known.astype(np.float64)
    factor = thinning(channel.period_s, settings.decimate)
    times, share = block_means(channel.times, factor), block_means(known, factor)
    rate = block_means(np.gradient(smooth, dt, axis=0) * known, factor)
    parallel = ParallelFilter(times, rows, settings.decimate, settings.attenuation_db)
    return parallel.apply(rate) / _total(parallel.apply(share))


def _total(share: Floats) -> Floats:
    """Share of a row's filter on known samples, 1 where it is next to none."""
    return np.where(np.abs(share) > 0.05, share, 1.0)


def _filtered(
    channel: TorqueChannel,
    rows: Floats,
    side: Side,
    structure: Columns,
    payload: str | None,
    columns: NDArray[np.int64],
    session: PreparedSession,
) -> tuple[Floats, Floats]:
    """Filtered regressor (n, K, C) and torque (K, n) of one channel at the times of the rows (K,)."""
    settings = session.settings
    joints = structure.chain.n
    matrix = np.empty((joints, len(rows), len(columns)))
    target = np.empty((len(rows), joints))
    # Averaging neighbouring samples first saves nine tenths of the work and is the same for both sides.
    factor = thinning(channel.period_s, settings.decimate)
    known = channel.known.astype(np.float64)
    times, torque = block_means(channel.times, factor), block_means(channel.torque * known, factor)
    share = block_means(known, factor)
    blocks = ParallelFilter(times, rows, settings.decimate, settings.attenuation_db).blocks()
    step = max(1, _CHUNK // factor)
    memory = np.zeros((len(columns), 1, joints, step * factor))

    def means(first: int, last: int) -> Floats:
        """Means of the regressor's columns (C n, last - first)."""
        part = slice(first * factor, last * factor)
        wide = structure.regressor(
            channel.q[part],
            channel.qd[part],
            channel.qdd[part],
            payload=payload,
            sides=(side,),
            columns=columns,
            drive=None if channel.drive is None else channel.drive.at(part),
            out=memory if last - first == step else None,
        )
        # The regressor's memory runs (column, joint, sample): one product filters all columns.
        table = wide.T.reshape(len(columns), joints, -1)
        found: Floats = _known_means(table, np.ascontiguousarray(known[part].T), factor)
        return found

    flat, low, done = np.zeros((len(columns) * joints, 0)), 0, 0
    while batch := list(islice(blocks, _BLOCKS)):
        # What the batch before needed of these means stays.
        high, start = batch[-1][1].stop, batch[0][1].start
        flat, low, done = flat[:, start - low :], start, max(start, done)
        new = [means(first, min(first + step, high)) for first in range(done, high, step)]
        flat, done = np.hstack([flat, *new]), max(high, done)
        for outputs, samples, weights in batch:
            inside = slice(samples.start - low, samples.stop - low)
            filtered = (flat[:, inside] @ weights.T).reshape(len(columns), joints, -1)
            total = _total(weights @ share[samples])
            matrix[:, outputs] = filtered.transpose(1, 2, 0) / total.T[:, :, None]
            target[outputs] = (weights @ torque[samples]) / total
    return matrix, target


@njit(cache=True, nogil=True)
def _known_means(table, known, factor):  # type: ignore[no-untyped-def]
    """Means (C n, m // factor) over neighbouring samples of (C, n, m) columns times the known share (n, m)."""
    columns, joints, samples = table.shape
    count = samples // factor
    result = np.zeros((columns * joints, count))
    for column in range(columns):
        for joint in range(joints):
            if is_zero(table[column, joint]):
                continue
            row = column * joints + joint
            for k in range(count):
                total = 0.0
                for i in range(k * factor, (k + 1) * factor):
                    total += table[column, joint, i] * known[joint, i]
                result[row, k] = total / factor
    return result


class _Collected:
    """Rows of one side by joint, part after part; long matrices in files."""

    def __init__(self, session: PreparedSession, units: Sequence[str]) -> None:
        self._session, self._units = session, units
        self._rows = [tuple(Growing() for _ in range(4)) for _ in session.joint_names]

    def add(self, part: _Part) -> None:
        """The valid rows of the next part."""
        for joint, shelves in enumerate(self._rows):
            kept = part.valid[:, joint]
            arrays = (part.matrix[joint], part.target[:, joint], part.slope[:, joint], part.index)
            for shelf, array in zip(shelves, arrays, strict=True):
                shelf.append(array[kept])

    def groups(self, number: int, side: Side) -> Iterator[tuple[RowGroup, Floats]]:
        """Row group and slope of each joint with rows."""
        session = self._session
        average = session.settings.average_periods and session.period_rows is not None and session.periods > 1
        for name, unit, shelves in zip(session.joint_names, self._units, self._rows, strict=True):
            if not len(shelves[1]):
                continue
            matrix, target, slope, index = (shelf.array() for shelf in shelves)
            if average and session.period_rows is not None:
                matrix, target, slope, index = _averaged(
                    matrix, target, slope, index, session.period_rows, session.periods
                )
            if len(target):
                yield RowGroup(name, side, number, matrix, target, index, unit), slope


def _averaged(
    matrix: Floats, target: Floats, slope: Floats, index: NDArray[np.int64], period_rows: int, periods: int
) -> tuple[Floats, Floats, Floats, NDArray[np.int64]]:
    """Mean of the rows of equal phase over all periods; phases missing in a period are left out."""
    phase = index % period_rows
    order = np.argsort(phase, kind="stable")
    values, starts, counts = np.unique(phase[order], return_index=True, return_counts=True)
    full = counts == periods
    if not full.any():
        return matrix[:0], target[:0], slope[:0], index[:0]
    stacked = np.column_stack([matrix, target, slope])[order]
    means = np.add.reduceat(stacked, starts, axis=0)[full] / periods
    return means[:, :-2], means[:, -2], means[:, -1], values[full]


def commanded(session: Session, prepared: PreparedSession) -> PreparedSession | None:
    """`prepared` with the commanded instead of the measured motion; None without a complete command channel."""
    if session.command is None or not session.command.position.shape[1]:
        return None
    joint, command = session.joint, session.command.select(prepared.joint_names)
    times = np.asarray((clock_ns(command) - int(clock_ns(joint)[0])) * 1e-9, dtype=np.float64)
    where = f"{prepared.name}: /joint_command"
    dt = sample_period(times, command.counts, where)
    bad: NDArray[np.bool_] = np.asarray(~np.isfinite(command.position).all(axis=1))
    wraps = [jump.behind for jump in jumps(times, command.position)]
    parts, _ = stretches(times, command.position, bad, dt, prepared.settings.longest_bridge_s, wraps)
    passages = []
    for passage in prepared.passages:
        channels = [channel for channel in (passage.joint, passage.motor) if channel is not None]
        home = next((part for part in parts if all(_covers(part, channel) for channel in channels)), None)
        if home is None:
            return None
        passages.append((passage, home))
    return replace(prepared, passages=_Commanded(passages, prepared))


def _covers(part: Stretch, channel: TorqueChannel) -> bool:
    """Whether the channel's times lie within the stretch."""
    slack = 0.5 * part.dt
    return bool(part.start - slack <= channel.times[0] and channel.times[-1] <= part.end + slack)


class _Commanded(Sequence[Passage]):
    """Passages with the commanded motion, filtered like the measured one when they are asked for."""

    def __init__(self, parts: Sequence[tuple[Passage, Stretch]], prepared: PreparedSession) -> None:
        self._parts, self._prepared = parts, prepared

    def __len__(self) -> int:
        return len(self._parts)

    def __getitem__(self, number: Any) -> Any:
        passage, part = self._parts[number]
        order = self._prepared.settings.order
        around = settling(self._prepared.cutoff_hz, order) + 16.0 * part.dt
        channels = [channel for channel in (passage.joint, passage.motor) if channel is not None]
        first = min(float(channel.times[0]) for channel in channels) - around - part.start
        last = max(float(channel.times[-1]) for channel in channels) + around - part.start
        low = max(int(first / part.dt), 0) if passage.core[0] > -np.inf else 0
        high = min(int(last / part.dt) + 1, part.count) if passage.core[1] < np.inf else part.count
        values = part.part(low, high)
        release(*part.columns)
        position = low_pass(values, part.dt, self._prepared.cutoff_hz, order)
        states = (position, *differentiate(position, part.dt))
        start = part.start + part.dt * low

        def at(channel: TorqueChannel) -> TorqueChannel:
            q, qd, qdd = (interpolate_uniform(state, start, part.dt, channel.times) for state in states)
            return replace(channel, q=q, qd=qd, qdd=qdd, drive=None)

        motor = None if passage.motor is None else at(passage.motor)
        return replace(passage, joint=at(passage.joint), motor=motor)
