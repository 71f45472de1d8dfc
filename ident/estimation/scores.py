"""The residual of a predictor in a session: the torque error and the figures beside it.

One figure leads everywhere:

torque error : rms of measured minus computed torque over rms of the measured torque, all measured samples of the
    excitation, standstill and reversals included, all joints of a side together (`torque_error`). The measured
    torque is not filtered; the computed one is that of the filtered measured motion.

The others are named for what they are: moving samples only (standstill left out joint by joint); in the band
(both torques through the parallel low-pass of the estimation); repeatability floor (scatter between the periods
in the band, beyond any model of the motion alone). Standstill is shown by its share of the samples and of the
squared error.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fri.errors import ConfigurationError, DataError
from ident.dynamics.parameters import Floats
from ident.dynamics.structure import Side
from ident.dynamics.tables import Tabular
from ident.rows.filters import ParallelFilter, SignalSettings, median_step, resampled
from ident.rows.prepared import Passage, PreparedSession, TorqueChannel
from ident.rows.sessions import payload_name
from lwr_driver.listing import Piece, in_units, text_of
from lwr_driver.notebook import subplots
from lwr_driver.session import Session
from lwr_driver.session.spool import Growing, release

_DRAWN = 3000
"""Most samples of a trace."""

BLOCK_S = 2.0
"""Length of blocks with independent errors [s]."""
Predictor = Callable[[TorqueChannel, Side], Floats]
"""The torque (N, n) [Nm] of a side at the samples of a channel, from its times and motion."""


def torque_error(measured: Floats, computed: Floats, used: NDArray[np.bool_] | None = None) -> float:
    """The torque error: rms of measured minus computed torque over rms of the measured torque.

    measured, computed : (N, n) or (N,) [Nm], unfiltered. used : samples that count, of the same shape; default
    all. NaN without samples or torque.
    """
    where = np.ones(np.shape(measured), dtype=bool) if used is None else used
    whole = float(np.linalg.norm(measured[where]))
    return float(np.linalg.norm((measured - computed)[where])) / whole if whole > 0.0 else math.nan


@dataclass(frozen=True)
class Score:
    """Residual (measured minus computed) of one joint and side in one session [`unit`].

    samples : number of measured samples. rms, bias : root mean square and mean over all of them.
    relative : the joint's torque error, rms over rms of the torque.
    worst, worst_time_s : largest residual and its time from the first sample of the log.
    moving_rms, moving_relative : the same, moving samples only.
    standstill, standstill_error : share of standstill in the samples and in the squared error.
    band_rms : rms in the band of the estimation. floor_rms : scatter between periods there, NaN without periods.
    unit : of the torque, N for the force of a prismatic joint.
    """

    joint: str
    side: str
    unit: str
    samples: int
    rms: float
    relative: float
    bias: float
    worst: float
    worst_time_s: float
    moving_rms: float
    moving_relative: float
    standstill: float
    standstill_error: float
    band_rms: float
    floor_rms: float

    def to_dict(self) -> dict[str, Any]:
        """Plain content; missing figures are null."""
        content = {key: finite(value) for key, value in self.__dict__.items()}
        return {_JSON_NAMES.get(key, key): value for key, value in content.items()}


_JSON_NAMES = {"relative": "torque_error", "moving_relative": "moving_torque_error"}


class Trace(NamedTuple):
    """Times (m,) [s], measured and computed torque (m, n) [Nm] of one side, thinned for a figure.

    computed : NaN for samples without a score.
    """

    times: Floats
    measured: Floats
    computed: Floats


@dataclass(frozen=True)
class SessionScore(Tabular):
    """Residuals of one model in one session.

    seen : whether the model was fitted to this session. relative : by side, the torque error of all joints.
    moving_relative : by side, moving samples only. standstill, standstill_error : by side, share of standstill in
        the samples and in the squared error. band_hz : upper end of the band. traces : by side, for `plot`.
    squares : by side, (B, n) sums of squares of the residual in blocks of `BLOCK_S` from the start of the session.
    """

    session: str
    uid: str
    payload: str | None
    predictor: str
    seen: bool
    scores: tuple[Score, ...]
    relative: Mapping[str, float]
    moving_relative: Mapping[str, float]
    standstill: Mapping[str, float]
    standstill_error: Mapping[str, float]
    band_hz: float
    notes: tuple[str, ...] = ()
    traces: Mapping[str, Trace] = field(default_factory=dict, repr=False, compare=False)
    squares: Mapping[str, Floats] = field(default_factory=dict, repr=False, compare=False)

    def to_dict(self) -> dict[str, Any]:
        """Plain content for JSON."""
        by_side = {
            "torque_error": self.relative,
            "moving_torque_error": self.moving_relative,
            "standstill": self.standstill,
            "standstill_error": self.standstill_error,
        }
        return {
            "session": self.session,
            "uid": self.uid,
            "payload": self.payload,
            "predictor": self.predictor,
            "seen": self.seen,
            **{key: {side: finite(v) for side, v in table.items()} for key, table in by_side.items()},
            "band_hz": self.band_hz,
            "scores": [score.to_dict() for score in self.scores],
            "notes": list(self.notes),
        }

    def records(self) -> list[dict[str, Any]]:
        """One row for each joint and side."""
        head = {"session": self.session, "predictor": self.predictor, "seen": self.seen}
        return [head | score.__dict__ for score in self.scores]

    def plot(self, side: str | None = None) -> Any:
        """Measured and computed torque of each joint over time; the matplotlib Axes, one for each joint.

        side : `joint` or `motor`; default the first of the model. Raises ConfigurationError for a side without
        scores.
        """
        side = next(iter(self.traces), "") if side is None else side
        if side not in self.traces:
            known = ", ".join(self.traces) or "none"
            raise ConfigurationError(
                f"plot of {self.session}: side {side!r} has no torque; choose of: {known}"
            )
        trace = self.traces[side]
        joints = [score.joint for score in self.scores if score.side == side]
        size = (8.0, 1.3 * len(joints))
        axes = subplots(len(joints), sharex=True, figsize=size)
        for k, (axis, joint) in enumerate(zip(axes, joints, strict=True)):
            axis.plot(trace.times, trace.measured[:, k], linewidth=0.8, label="measured")
            axis.plot(trace.times, trace.computed[:, k], linewidth=0.8, label=self.predictor)
            axis.set_ylabel(joint, fontsize="small")
        units = " or ".join(dict.fromkeys(score.unit for score in self.scores))
        head = f"{self.session}, payload {self.payload or 'none'}: {side} torque [{units}]"
        axes[0].set_title(head, fontsize="medium")
        axes[0].legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize="small")
        axes[-1].set_xlabel("time [s]")
        return axes

    def __repr__(self) -> str:
        worst = max(self.scores, key=lambda s: -1.0 if math.isnan(s.relative) else s.relative)
        return (
            f"{self.session}, payload {self.payload or 'none'}, {self.predictor}"
            f"{' (fitted to it)' if self.seen else ''}: torque error {by_side(self.relative)}; largest "
            f"{worst.joint} {worst.side} {100 * worst.relative:.1f} %"
        )

    def pieces(self) -> list[Piece]:
        """Title, table by joint and side, sentences."""
        label = "  SEEN BY THE ESTIMATE: no validation" if self.seen else ""
        rows = []
        for s in self.scores:
            figures = (s.rms, s.bias, s.worst, s.worst_time_s, s.moving_rms)
            shown = (f"{100 * s.relative:.2f}", *(f"{value:.3f}" for value in figures))
            more = (f"{100 * s.standstill_error:.1f}", f"{s.band_rms:.3f}", f"{s.floor_rms:.3f}")
            rows.append((f"{s.joint} {s.side}", *shown, *more))
        head = [
            "",
            "error %",
            "rms {unit}",
            "bias {unit}",
            "worst {unit}",
            "at s",
            "moving {unit}",
            "standstill %",
            "in band {unit}",
        ]
        if any(math.isfinite(score.floor_rms) for score in self.scores):
            head.append("floor {unit}")
        return [
            f"{self.session}, payload {self.payload or 'none'}: {self.predictor}{label}",
            in_units(head, [row[: len(head)] for row in rows], [score.unit for score in self.scores]),
            *(f"  {line}" for line in (*self.sentences, *self.notes)),
        ]

    def __str__(self) -> str:
        return text_of(self.pieces())

    @property
    def sentences(self) -> tuple[str, ...]:
        """The torque error of all joints in words, and beside it the figures with other names."""
        still = ", ".join(
            f"{side} {100 * self.standstill[side]:.1f} % of the samples and {100 * part:.1f} % of the squared error"
            for side, part in self.standstill_error.items()
        )
        return (
            f"torque error, all joints and samples: {by_side(self.relative)}",
            f"standstill: {still}",
            f"moving samples only: {by_side(self.moving_relative)}; in band: below {self.band_hz:g} Hz",
        )


def by_side(shares: Mapping[str, float]) -> str:
    """Shares by side in percent, as in "motor 3.41 %, joint 1.20 %"."""
    return ", ".join(f"{side} {100 * value:.2f} %" for side, value in shares.items())


@dataclass(frozen=True)
class _Rows:
    """Residuals of one side of one passage: at the samples (m, n), and in the band (K, n) with validity.

    used : measured samples of the excitation. moving : those of a moving joint. Samples that other blocks of the same
    stretch have, too, are left out.
    """

    times: Floats
    error: Floats
    torque: Floats
    used: NDArray[np.bool_]
    moving: NDArray[np.bool_]
    band: Floats
    valid: NDArray[np.bool_]
    index: NDArray[np.int64]

    def in_band(self) -> _Rows:
        """The same without its samples."""
        empty: dict[str, Any] = {key: getattr(self, key)[:0].copy() for key in (*_KEYS, "times")}
        return replace(self, **empty)


class _Samples(NamedTuple):
    """Residual and torque of one joint [Nm], samples used and moving ones, each (m,)."""

    error: Any
    torque: Any
    used: Any
    moving: Any

    @property
    def power(self) -> Floats:
        """Sums of squares of residual and torque over the used samples, over the moving ones, and their numbers."""
        found = [
            float(np.sum(x[on] ** 2)) for on in (self.used, self.moving) for x in (self.error, self.torque)
        ]
        return np.array([*found, np.count_nonzero(self.used), np.count_nonzero(self.moving)])


_KEYS = _Samples._fields


def score_session(
    prepared: PreparedSession,
    predict: Predictor,
    sides: Sequence[Side],
    session: Session,
    name: str,
    *,
    seen: bool = False,
    notes: tuple[str, ...] = (),
    units: Sequence[str] = (),
) -> SessionScore:
    """Residuals of any predictor in one session, per joint and side. units : of the torques by joint, default Nm.

    Raises DataError when the session has no channel for any of the sides.
    """
    scores: list[Score] = []
    names = ("relative", "moving_relative", "standstill", "standstill_error")
    figures: dict[str, dict[str, float]] = {name: {} for name in names}
    traces: dict[str, Trace] = {}
    squares: dict[str, Floats] = {}
    for side in sides:
        # A motor-only session has no joint torque; its prepared one is a placeholder.
        if side != "motor" and not session.joint.effort.shape[1]:
            continue
        rows: list[_Rows] = []
        clock = Growing()
        shelves = [_Samples(*(Growing() for _ in _KEYS)) for _ in prepared.joint_names]
        for passage in prepared.passages:
            found = _residuals(passage, predict, side, prepared.settings)
            passage.release()
            if found is None:
                continue
            clock.append(found.times)
            for k, own in enumerate(shelves):
                for key, shelf in zip(_KEYS, own, strict=True):
                    shelf.append(getattr(found, key)[:, k])
            rows.append(found.in_band())
        if not rows:
            continue
        times = clock.array()
        columns = [_Samples(*(shelf.array() for shelf in own)) for own in shelves]
        thin = slice(None, None, -(-len(times) // _DRAWN))
        traces[side] = Trace(
            times[thin].copy(),
            np.column_stack([c.torque[thin] for c in columns]),
            np.column_stack([np.where(c.used, c.torque - c.error, np.nan)[thin] for c in columns]),
        )
        block = np.maximum(times // BLOCK_S, 0.0).astype(np.int64)
        squares[side] = np.column_stack(
            [np.bincount(block, np.where(c.used, c.error, 0.0) ** 2) for c in columns]
        )
        power = np.sum([c.power for c in columns], axis=0)
        figures["relative"][side] = math.sqrt(_ratio(power[0], power[1]))
        figures["moving_relative"][side] = math.sqrt(_ratio(power[2], power[3]))
        figures["standstill"][side] = 1.0 - _ratio(power[5], power[4])
        figures["standstill_error"][side] = 1.0 - _ratio(power[2], power[0])
        for k, joint in enumerate(prepared.joint_names):
            unit = units[k] if units else "Nm"
            scores.append(_score(joint, side, unit, k, rows, times, columns[k], prepared))
            release(*columns[k])
    if not scores:
        raise DataError(
            f"{prepared.name}: no usable {' or '.join(sides)} torque; this session has no channel of the "
            "model, choose another session or a model of the other side"
        )
    return SessionScore(
        session=prepared.name,
        uid=session.metadata.get("uid", ""),
        payload=payload_name(session),
        predictor=name,
        seen=seen,
        scores=tuple(scores),
        **figures,
        band_hz=prepared.settings.decimate,
        notes=notes,
        traces=traces,
        squares=squares,
    )


def _residuals(passage: Passage, predict: Predictor, side: Side, settings: SignalSettings) -> _Rows | None:
    if not len(passage.rows):
        return None
    if side == "joint":
        channel, valid = passage.joint, passage.joint_valid
    elif passage.motor is not None and passage.motor_valid is not None:
        channel, valid = passage.motor, passage.motor_valid
    else:
        return None
    if not channel.torque.shape[1]:
        return None
    torque, flagged = channel.torque, channel.flagged
    if side == "difference":
        joint = passage.joint
        torque = torque - resampled(joint.times, joint.torque, channel.times)
    error = torque - predict(channel, side)
    parallel = ParallelFilter(channel.times, passage.rows, settings.decimate, settings.attenuation_db)
    within = inside(channel, passage)
    used = within[:, None] & ~flagged
    moving = used & (np.abs(channel.qd) >= settings.standstill_rad_s)
    band = parallel.apply(error)
    if passage.core != (-np.inf, np.inf):
        own = passage.own(channel.times)
        times = channel.times[own]
        error, torque, used, moving = error[own], torque[own], used[own], moving[own]
        return _Rows(times, error, torque, used, moving, band, valid, passage.index)
    return _Rows(channel.times, error, torque, used, moving, band, valid, passage.index)


def inside(channel: TorqueChannel, passage: Passage) -> NDArray[np.bool_]:
    """Samples in the part of the passage with rows."""
    rows = passage.stretch_rows if len(passage.stretch_rows) else passage.rows
    step = median_step(rows) if len(rows) > 1 else 1.0
    nearest = np.clip(np.searchsorted(rows, channel.times), 0, len(rows) - 1)
    before = np.maximum(nearest - 1, 0)
    distance = np.minimum(np.abs(rows[nearest] - channel.times), np.abs(rows[before] - channel.times))
    return distance <= step


def _score(
    joint: str,
    side: str,
    unit: str,
    k: int,
    rows: Sequence[_Rows],
    times: Floats,
    samples: _Samples,
    prepared: PreparedSession,
) -> Score:
    """times : (m,) of the samples."""
    error, _, used, moving = samples
    if not used.any():
        return Score(joint, side, unit, 0, *[math.nan] * 11)
    e = error[used]
    worst = int(np.argmax(np.abs(e)))
    band = np.concatenate([r.band[r.valid[:, k], k] for r in rows])
    power = samples.power
    return Score(
        joint=joint,
        side=side,
        unit=unit,
        samples=len(e),
        rms=_rms(e),
        relative=math.sqrt(_ratio(power[0], power[1])),
        bias=float(e.mean()),
        worst=float(e[worst]),
        worst_time_s=float(times[used][worst]),
        moving_rms=_rms(error[moving]),
        moving_relative=math.sqrt(_ratio(power[2], power[3])),
        standstill=1.0 - _ratio(power[5], power[4]),
        standstill_error=1.0 - _ratio(power[2], power[0]),
        band_rms=_rms(band),
        floor_rms=_floor(np.concatenate([r.index[r.valid[:, k]] for r in rows]), band, prepared),
    )


def _floor(index: NDArray[np.int64], band: Floats, prepared: PreparedSession) -> float:
    """Scatter between periods [Nm] of the residual in the band, at rows of these numbers."""
    if prepared.period_rows is None or prepared.periods < 2:
        return math.nan
    phase = index % prepared.period_rows
    counts = np.bincount(phase, minlength=prepared.period_rows)
    means = np.bincount(phase, band, prepared.period_rows) / np.maximum(counts, 1)
    repeated = counts[phase] > 1
    freedom = int(repeated.sum() - np.count_nonzero(counts > 1))
    if freedom < 1:
        return math.nan
    return float(np.sqrt(np.sum((band - means[phase])[repeated] ** 2) / freedom))


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else math.nan


def _ratio(part: Any, whole: Any) -> float:
    return float(part / whole) if whole > 0 else math.nan


def finite(value: Any) -> Any:
    """The value, or None for a float that is not finite, for JSON."""
    return None if isinstance(value, float) and not math.isfinite(value) else value
