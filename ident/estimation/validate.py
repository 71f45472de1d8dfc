"""Test of a model on sessions it was not fitted to.

The computed-torque test compares, sample by sample, the measured torque of each side with the torque computed
from the filtered measured motion. The measured torque is not filtered. A second set of figures is limited to the
band of the estimation: both torques pass the same parallel low-pass. Samples of a joint at standstill are left
out for that joint, because its Coulomb torque is unknown there.

With a periodic excitation the scatter between periods is the floor of the residual: no model of the motion
alone can explain it.

Cross-validation predicts each session with a model identified from all the others.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fri.errors import ConfigurationError, DataError
from ident.dynamics.kinematics import Chain
from ident.dynamics.parameters import Floats
from ident.dynamics.structure import Side
from ident.dynamics.tables import Tabular
from ident.estimation.identify import IdentificationSettings, identify
from ident.model.dynamic_model import DynamicModel
from ident.model.model_file import Model, as_model
from ident.rows.filters import ParallelFilter, SignalSettings
from ident.rows.prepare import Passage, PreparedSession, TorqueChannel, prepare
from ident.rows.sessions import payload_name
from lwr_driver.notebook import subplots
from lwr_driver.session import Session, Sessions, as_sessions

_DRAWN = 3000
"""Most samples of a trace."""

Predictor = Callable[[TorqueChannel, Side], Floats]
"""The torque (N, n) [Nm] of a side at the samples of a channel, from its times and motion."""


@dataclass(frozen=True)
class Score:
    """Residual (measured minus computed) of one joint and side in one session [Nm].

    rms, bias : root mean square and mean. relative : rms of the residual over rms of the torque.
    worst, worst_time_s : largest residual and its time from the first sample of the log.
    band_rms : rms in the band of the estimation. floor_rms : scatter between periods there, NaN without periods.
    samples : number of samples, without those at standstill.
    """

    joint: str
    side: str
    samples: int
    rms: float
    relative: float
    bias: float
    worst: float
    worst_time_s: float
    band_rms: float
    floor_rms: float

    def to_dict(self) -> dict[str, Any]:
        """Plain content; missing figures are null."""
        return {key: finite(value) for key, value in self.__dict__.items()}


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

    seen : whether the model was fitted to this session. relative : by side, residual over torque of all
        joints, both as Euclidean norms. standstill : share of samples left out. traces : by side, for `plot`.
    """

    session: str
    uid: str
    payload: str | None
    predictor: str
    seen: bool
    scores: tuple[Score, ...]
    relative: Mapping[str, float]
    standstill: float
    notes: tuple[str, ...] = ()
    traces: Mapping[str, Trace] = field(default_factory=dict, repr=False, compare=False)

    def to_dict(self) -> dict[str, Any]:
        """Plain content for JSON."""
        return {
            "session": self.session,
            "uid": self.uid,
            "payload": self.payload,
            "predictor": self.predictor,
            "seen": self.seen,
            "relative": {side: finite(value) for side, value in self.relative.items()},
            "standstill": self.standstill,
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
        scores, or without matplotlib.
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
        axes = subplots(f"{type(self).__name__}: plot()", "records()", len(joints), sharex=True, figsize=size)
        for k, (axis, joint) in enumerate(zip(axes, joints, strict=True)):
            axis.plot(trace.times, trace.measured[:, k], linewidth=0.8, label="measured")
            axis.plot(trace.times, trace.computed[:, k], linewidth=0.8, label=self.predictor)
            axis.set_ylabel(joint, fontsize="small")
        head = f"{self.session}, payload {self.payload or 'none'}: {side} torque [Nm]"
        axes[0].set_title(head, fontsize="medium")
        axes[0].legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize="small")
        axes[-1].set_xlabel("time [s]")
        return axes

    def __repr__(self) -> str:
        relative = ", ".join(f"{side} {100 * value:.2f} %" for side, value in self.relative.items())
        worst = max(self.scores, key=lambda s: -1.0 if math.isnan(s.relative) else s.relative)
        return (
            f"{self.session}, payload {self.payload or 'none'}, {self.predictor}"
            f"{' (fitted to it)' if self.seen else ''}: relative error {relative}; largest {worst.joint} "
            f"{worst.side} {100 * worst.relative:.1f} %"
        )

    def __str__(self) -> str:
        label = "  SEEN BY THE ESTIMATE: no validation" if self.seen else ""
        lines = [f"{self.session}, payload {self.payload or 'none'}: {self.predictor}{label}"]
        floor = any(math.isfinite(score.floor_rms) for score in self.scores)
        head = f"  {'':<14}{'rms':>8}{'rel':>8}{'bias':>9}{'worst':>9} at{'':>6}{'band':>9}"
        lines.append(head + (f"{'floor':>9}" if floor else ""))
        lines.append(
            f"  {'':<14}{'Nm':>8}{'%':>8}{'Nm':>9}{'Nm':>9} s{'':>7}{'Nm':>9}"
            + ("       Nm" if floor else "")
        )
        for s in self.scores:
            line = (
                f"  {s.joint + ' ' + s.side:<14}{s.rms:>8.3f}{100 * s.relative:>8.2f}{s.bias:>9.3f}"
                f"{s.worst:>9.3f} {s.worst_time_s:<8.3f}{s.band_rms:>9.3f}"
            )
            lines.append(line + (f"{s.floor_rms:>9.3f}" if floor else ""))
        whole = ", ".join(f"{side} {100 * value:.2f} %" for side, value in self.relative.items())
        lines.append(f"  relative error, all joints: {whole}")
        lines += [f"  {note}" for note in self.notes]
        return "\n".join(lines)


@dataclass(frozen=True)
class Validation(Tabular):
    """Scores of the model and of its competitors in all sessions; prints itself."""

    robot: str
    scores: tuple[SessionScore, ...]
    competitors: tuple[SessionScore, ...] = ()
    notes: tuple[str, ...] = field(default=())

    @property
    def unseen(self) -> tuple[SessionScore, ...]:
        """The scores in sessions the model was not fitted to."""
        return tuple(score for score in self.scores if not score.seen)

    def to_dict(self) -> dict[str, Any]:
        """Plain content for JSON."""
        return {
            "schema_version": 1,
            "robot": self.robot,
            "sessions": [score.to_dict() for score in self.scores],
            "competitors": [score.to_dict() for score in self.competitors],
            "notes": list(self.notes),
        }

    def records(self) -> list[dict[str, Any]]:
        """One row for each session, predictor, joint and side."""
        return [row for score in (*self.scores, *self.competitors) for row in score.records()]

    def plot(self, session: int = 0, side: str | None = None) -> Any:
        """Measured and computed torque in one session, by its number from 0: `SessionScore.plot`."""
        if not -len(self.scores) <= session < len(self.scores):
            raise ConfigurationError(
                f"plot: session {session} of {len(self.scores)}; count from 0 to {len(self.scores) - 1}"
            )
        return self.scores[session].plot(side)

    def __repr__(self) -> str:
        rivals = f", scores of competitors: {len(self.competitors)}" if self.competitors else ""
        return "\n".join(
            [
                f"Validation of the model of {self.robot}: sessions: {len(self.scores)}{rivals}",
                *_few([f"  {score!r}" for score in self.scores], 8),
            ]
        )

    def __str__(self) -> str:
        parts = [f"Computed torque, {self.robot}", *map(str, self.scores)]
        if self.competitors:
            parts.append(self._comparison())
        parts += list(self.notes)
        return "\n\n".join(parts)

    def _comparison(self) -> str:
        """RMS per joint of every predictor side by side, joint torque."""
        lines = ["RMS of the residual by predictor [Nm]"]
        for own in self.scores:
            rivals = [rival for rival in self.competitors if rival.session == own.session]
            if not rivals:
                continue
            joints = [score.joint for score in own.scores if score.side == "joint"]
            lines.append(
                f"  {own.session:<40}" + "".join(f"{joint[-8:]:>9}" for joint in joints) + "   all %"
            )
            for entry in (own, *rivals):
                values = {score.joint: score.rms for score in entry.scores if score.side == "joint"}
                if not values:
                    continue
                row = "".join(f"{values.get(joint, math.nan):>9.3f}" for joint in joints)
                lines.append(f"    {entry.predictor:<38}{row}{100 * entry.relative['joint']:>8.2f}")
        return "\n".join(lines)


def validate(
    model: Model,
    sessions: Sessions,
    *,
    settings: SignalSettings | None = None,
    allow_seen: bool = False,
) -> Validation:
    """Computed-torque test of a model on sessions.

    model : a model or the path of its file. sessions : a session, the path of a log, or several of either.
    allow_seen : score sessions the model was fitted to as well, and label them; otherwise they are refused.

    Raises ConfigurationError for arguments of a wrong type. Raises DataError for a session of another robot,
    with a payload missing in the model, without any channel of the model, or seen by the estimate.
    """
    model = as_model(model)
    sessions = as_sessions(sessions)
    if not sessions:
        raise DataError("no session given; name at least one session file the model was not fitted to")
    seen = seen_sessions(model, sessions)
    if any(seen) and not allow_seen:
        named = ", ".join(s.path.name for s, flag in zip(sessions, seen, strict=True) if flag)
        raise DataError(
            f"{named}: the model was fitted to this session, so predicting it proves nothing; give a "
            "session of another motion, or --allow-seen to see the fit anyway"
        )
    scores = []
    for session, flag in zip(sessions, seen, strict=True):
        payload = mounted(model, session)
        prepared = prepared_session(model, session, settings)
        predict = predictor(model, payload)
        scores.append(
            score_session(prepared, predict, model.structure.sides, session, "identified model", seen=flag)
        )
    notes: tuple[str, ...] = ()
    if model.effects:
        named = ", ".join(str(effect["cause"]) for effect in model.effects)
        notes = (f"The torque has the effects of the model: {named}.",)
    return Validation(model.robot, tuple(scores), notes=notes)


def predictor(model: DynamicModel, payload: str | None) -> Predictor:
    """The computed torque of a model with a payload mounted."""

    def predict(channel: TorqueChannel, side: Side) -> Floats:
        return model.torque(
            channel.q, channel.qd, channel.qdd, payload=payload, side=side, time=channel.times, measured=True
        )

    return predict


def seen_sessions(model: DynamicModel, sessions: Sequence[Session]) -> list[bool]:
    """Whether the model was fitted to each session, by the uids (or file names) in its provenance."""
    entries = model.provenance.get("sessions", ())
    uids, files = set(), set()
    for entry in entries if isinstance(entries, (list, tuple)) else ():
        if isinstance(entry, Mapping):
            uids.add(str(entry.get("uid", "")))
        else:
            uids.add(str(entry))
            files.add(str(entry))
    experiment = str(model.provenance.get("experiment", ""))
    found = []
    for session in sessions:
        uid = session.metadata.get("uid", "")
        by_file = session.path.name in files and session.metadata.get("experiment", "") == experiment
        found.append(bool(uid and uid in uids) or by_file)
    return found


def mounted(model: DynamicModel, session: Session) -> str | None:
    """The payload of a session by its name in the model. Raises DataError for one missing there."""
    name = payload_name(session)
    if name is None or model.structure.sides == ("difference",):
        return None
    if name not in model.structure.payloads:
        known = ", ".join(model.structure.payloads) or "none"
        raise DataError(
            f"{session.path.name}: payload {name!r} is not in the model (payloads: {known}); validate on a "
            "session of the bare arm, or identify the payload first with `lwr-run payload`"
        )
    return name


def prepared_session(
    model: DynamicModel, session: Session, settings: SignalSettings | None
) -> PreparedSession:
    """The session with the joints of the model, filtered as for the estimation."""
    chosen = session.select(model.structure.chain.joint_names)
    wants_motor = "motor" in model.structure.sides or "difference" in model.structure.sides
    return prepare(chosen, settings, motor=wants_motor)


@dataclass(frozen=True)
class _Rows:
    """Residuals of one side of one passage: at the samples (m, n), and in the band (K, n) with validity."""

    times: Floats
    error: Floats
    torque: Floats
    used: NDArray[np.bool_]
    band: Floats
    valid: NDArray[np.bool_]
    index: NDArray[np.int64]


def score_session(
    prepared: PreparedSession,
    predict: Predictor,
    sides: Sequence[Side],
    session: Session,
    name: str,
    *,
    seen: bool = False,
    notes: tuple[str, ...] = (),
) -> SessionScore:
    """Residuals of any predictor in one session, per joint and side.

    Raises DataError when the session has no channel for any of the sides.
    """
    scores: list[Score] = []
    relative: dict[str, float] = {}
    traces: dict[str, Trace] = {}
    still: list[float] = []
    for side in sides:
        rows = [
            r for p in prepared.passages if (r := _residuals(p, predict, side, prepared.settings)) is not None
        ]
        if not rows:
            continue
        times, error, torque, used = (
            np.concatenate([getattr(r, key) for r in rows]) for key in ("times", "error", "torque", "used")
        )
        still.append(1.0 - float(used.mean()))
        thin = slice(None, None, -(-len(times) // _DRAWN))
        traces[side] = Trace(
            times[thin].copy(), torque[thin].copy(), np.where(used, torque - error, np.nan)[thin]
        )
        relative[side] = _ratio(np.linalg.norm(error[used]), np.linalg.norm(torque[used]))
        for k, joint in enumerate(prepared.joint_names):
            scores.append(_score(joint, side, k, rows, (times, error, torque, used), prepared))
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
        relative=relative,
        standstill=float(np.mean(still)),
        notes=notes,
        traces=traces,
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
    parallel = ParallelFilter(channel.times, passage.rows, settings.decimate_hz, settings.attenuation_db)
    inside = _inside(channel, passage)
    used = inside[:, None] & ~flagged & (np.abs(channel.qd) >= settings.standstill_rad_s)
    return _Rows(channel.times, error, torque, used, parallel.apply(error), valid, passage.index)


def resampled(times: Floats, values: Floats, wanted: Floats) -> Floats:
    """Columns of `values` at the times `wanted`, by linear interpolation."""
    return np.column_stack([np.interp(wanted, times, column) for column in values.T])


def _inside(channel: TorqueChannel, passage: Passage) -> NDArray[np.bool_]:
    """Samples in the part of the passage with rows."""
    step = float(np.median(np.diff(passage.rows))) if len(passage.rows) > 1 else 1.0
    nearest = np.clip(np.searchsorted(passage.rows, channel.times), 0, len(passage.rows) - 1)
    before = np.maximum(nearest - 1, 0)
    distance = np.minimum(
        np.abs(passage.rows[nearest] - channel.times), np.abs(passage.rows[before] - channel.times)
    )
    return distance <= step


def _score(
    joint: str,
    side: str,
    k: int,
    rows: Sequence[_Rows],
    samples: tuple[Floats, Floats, Floats, NDArray[np.bool_]],
    prepared: PreparedSession,
) -> Score:
    times, error, torque, used = samples
    mine = used[:, k]
    if not mine.any():
        nan = math.nan
        return Score(joint, side, 0, nan, nan, nan, nan, nan, nan, nan)
    e, tau, t = error[mine, k], torque[mine, k], times[mine]
    worst = int(np.argmax(np.abs(e)))
    band = np.concatenate([r.band[r.valid[:, k], k] for r in rows])
    return Score(
        joint=joint,
        side=side,
        samples=len(e),
        rms=_rms(e),
        relative=_ratio(_rms(e), _rms(tau)),
        bias=float(e.mean()),
        worst=float(e[worst]),
        worst_time_s=float(t[worst]),
        band_rms=_rms(band) if len(band) else math.nan,
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
    return float(np.sqrt(np.mean(values**2)))


def _ratio(part: Any, whole: Any) -> float:
    return float(part / whole) if whole > 0 else math.nan


def finite(value: Any) -> Any:
    """The value, or None for a float that is not finite, for JSON."""
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _few(lines: Sequence[str], count: int) -> list[str]:
    """The first lines, and a line with the number of the others."""
    left = len(lines) - count
    return [*lines[:count], *([f"  and {left} more"] if left > 0 else [])]


@dataclass(frozen=True)
class CrossValidation(Tabular):
    """One score for each session left out, and the sessions never left out with the reason."""

    scores: tuple[SessionScore, ...]
    skipped: tuple[str, ...]

    @property
    def rms(self) -> dict[str, float]:
        """Root mean square over the folds of each joint and side [Nm], by `joint side`."""
        table: dict[str, list[float]] = {}
        for fold in self.scores:
            for score in fold.scores:
                table.setdefault(f"{score.joint} {score.side}", []).append(score.rms)
        return {key: float(np.sqrt(np.mean(np.square(values)))) for key, values in table.items()}

    def to_dict(self) -> dict[str, Any]:
        """Plain content for JSON."""
        return {
            "folds": [score.to_dict() for score in self.scores],
            "skipped": list(self.skipped),
            "rms": self.rms,
        }

    def records(self) -> list[dict[str, Any]]:
        """One row for each session left out, joint and side."""
        return [row for score in self.scores for row in score.records()]

    def __repr__(self) -> str:
        return "\n".join(
            [
                f"Cross-validation: sessions left out in turn: {len(self.scores)}, skipped: {len(self.skipped)}",
                *_few([f"  {score!r}" for score in self.scores], 8),
            ]
        )

    def __str__(self) -> str:
        lines = ["Cross-validation: each session by the model of the others"]
        lines += ["", *("\n".join([str(score), ""]) for score in self.scores)]
        lines.append("RMS over the folds [Nm]")
        lines += [f"  {key:<14}{value:>8.3f}" for key, value in self.rms.items()]
        return "\n".join([*lines, *self.skipped])


def cross_validate(
    sessions: Sessions, chain: Chain, settings: IdentificationSettings | None = None
) -> CrossValidation:
    """Leave out one session at a time.

    sessions : two at least, as for `identify`. A session with a payload of its own is skipped and named: the
    others cannot predict it. Raises DataError when no fold is left.
    """
    settings = settings or IdentificationSettings()
    sessions = as_sessions(sessions)
    if len(sessions) < 2:
        raise DataError(f"{len(sessions)} session cannot be cross-validated; give two at least")
    scores, skipped = [], []
    for number, session in enumerate(sessions):
        others = [other for k, other in enumerate(sessions) if k != number]
        payload = payload_name(session)
        if payload is not None and all(payload_name(other) != payload for other in others):
            skipped.append(f"{session.path.name}: payload {payload!r} is in no other session; not left out")
            continue
        try:
            found = identify(others, chain, settings)
        except DataError as error:
            skipped.append(f"{session.path.name}: the others do not identify a model: {error}")
            continue
        fold = validate(found.model, [session], settings=settings.signals)
        scores += list(fold.scores)
    if not scores:
        raise DataError("no session can be predicted by the others: " + "; ".join(skipped))
    return CrossValidation(tuple(scores), tuple(skipped))
