"""Test of a model on sessions it was not fitted to, by the torque error (`ident.estimation.scores`).

A session is filtered and put in time as those of the model's estimate. Cross-validation predicts each session with
a model identified from all the others. Wrong channels are named before (`ident.screening`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from fri.errors import ConfigurationError, DataError, LwrError
from ident.dynamics.kinematics import Chain
from ident.dynamics.parameters import Floats
from ident.dynamics.structure import Side
from ident.dynamics.tables import Tabular
from ident.estimation.identification import IdentificationSettings, Known
from ident.estimation.identify import identify
from ident.estimation.scores import Predictor, SessionScore, score_session
from ident.model.dynamic_model import DynamicModel
from ident.model.model_file import Model, as_model
from ident.model.signals import signal_settings, softened, taken_back
from ident.rows.content import Recall
from ident.rows.filters import SignalSettings
from ident.rows.prepare import prepare
from ident.rows.prepared import PreparedSession, TorqueChannel
from ident.rows.sessions import payload_name
from ident.rows.shared_rows import from_marks, seen_before
from ident.screening.doubts import Doubt, settle
from ident.screening.screen import require_sound, screen
from lwr_driver.listing import Listing, Piece, in_units, text_of
from lwr_driver.session import Session, Sessions, as_sessions

# Torque error on held-out data from which a model is of no use there.
_POOR = 0.2
# Sessions in a `repr`: what a screen holds beside the rest.
_SHOWN = 8


@dataclass(frozen=True)
class Unscored:
    """A session without a score, and the reason."""

    session: str
    error: LwrError

    def __str__(self) -> str:
        text = str(self.error)
        return text if text.startswith(self.session) else f"{self.session}: {text}"

    def to_dict(self) -> dict[str, Any]:
        """Plain content for JSON."""
        return {"session": self.session, "reason": str(self.error)}


@dataclass(frozen=True)
class Validation(Tabular):
    """Scores of the model and of its competitors in all sessions; prints itself.

    unscored : sessions without a score, where `validate` was to go on past them. warnings : doubts about channels.
    """

    robot: str
    scores: tuple[SessionScore, ...]
    competitors: tuple[SessionScore, ...] = ()
    notes: tuple[str, ...] = field(default=())
    unscored: tuple[Unscored, ...] = ()
    warnings: tuple[str, ...] = ()

    def require_all(self) -> None:
        """Raise the error of the sessions without a score, of the type of the first; nothing without any."""
        if self.unscored:
            text = "; ".join(map(str, self.unscored))
            raise type(self.unscored[0].error)(f"not validated: {text}")

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
            "unscored": [one.to_dict() for one in self.unscored],
            "warnings": list(self.warnings),
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
                *_few([f"  {score!r}" for score in self.scores]),
            ]
        )

    def pieces(self) -> list[Piece]:
        """The scores of each session, the predictors side by side, warnings and notes."""
        found: list[Piece] = [f"Computed torque, {self.robot}"]
        for score in self.scores:
            found += ["", *score.pieces()]
        found += self.comparison()
        for text in (
            *(f"not validated: {one}" for one in self.unscored),
            *(f"warning: {warning}" for warning in self.warnings),
            *self.notes,
        ):
            found += ["", text]
        return found

    def __str__(self) -> str:
        return text_of(self.pieces())

    def comparison(self) -> list[Piece]:
        """RMS per joint of every predictor side by side, all samples; nothing without competitors."""
        found: list[Piece] = []
        for own in self.scores:
            rivals = [rival for rival in self.competitors if rival.session == own.session]
            for side in own.relative:
                entries = [entry for entry in (own, *rivals) if side in entry.relative]
                if len(entries) < 2:
                    continue
                units = {score.joint: score.unit for score in own.scores if score.side == side}
                joints = list(units)
                rows = []
                for entry in entries:
                    values = {score.joint: score.rms for score in entry.scores if score.side == side}
                    row = [f"{values.get(joint, math.nan):.3f}" for joint in joints]
                    rows.append([entry.predictor, f"{100 * entry.relative[side]:.2f}", *row])
                mixed = len(set(units.values())) > 1
                title = f"{own.session}, {side} side: torque error of all joints, rms by joint"
                title += "" if mixed else f" [{units[joints[0]]}]"
                names = [f"{name} [{units[name]}]" if mixed else name for name in joints]
                found += ["", title, Listing(["predictor", "error %", *names], rows)]
        return found


def validate(
    model: Model,
    sessions: Sessions,
    *,
    settings: SignalSettings | None = None,
    allow_seen: bool = False,
    estimate_delay: bool = False,
    keep_going: bool = False,
    known: Known | None = None,
    recall: Recall | None = None,
) -> Validation:
    """Computed-torque test of a model on sessions.

    model : a model or the path of its file. sessions : a session, the path of a log, or several of either.
    settings : of the signals; default those of the model, with its delay of the motor channel.
    allow_seen : score sessions the model was fitted to as well, and label them; otherwise they are refused.
    estimate_delay : estimate the delay of the motor channel in each session instead.
    keep_going : list sessions without a score in `unscored` instead of raising.
    known : of the sessions, from an earlier step; they are not screened again. recall : as for `prepare`.

    Raises ConfigurationError for arguments of a wrong type. Raises DataError for a session of another robot,
    with a payload missing in the model, without any channel of the model, with a channel that is certainly wrong,
    or seen by the estimate.
    """
    model = as_model(model)
    sessions = as_sessions(sessions)
    if not sessions:
        raise DataError("no session given; name at least one session file the model was not fitted to")
    settings = signals_for(model, settings, estimate_delay=estimate_delay)
    seen = seen_sessions(model, sessions)
    new = [session for session, flag in zip(sessions, seen, strict=True) if allow_seen or not flag]
    doubts = () if known else _screened(model, new, settings)
    scores, unscored = [], []
    for session, flag in zip(sessions, seen, strict=True):
        try:
            if flag and not allow_seen:
                raise DataError(
                    f"{session.path.name}: the model was fitted to this session or a copy of it, so predicting it "
                    "proves nothing; give a session of another motion (`lwr-run validate --allow-seen` shows the fit)"
                )
            predict = predictor(model, mounted(model, session))
            settle([doubt for doubt in doubts if doubt.certain and doubt.session in ("", session.path.name)])
            prepared = prepared_session(model, session, settings, blocks=not model.remembers, recall=recall)
            sides = model.structure.sides
            units = model.structure.chain.torque_units
            scores.append(
                score_session(prepared, predict, sides, session, "identified model", seen=flag, units=units)
            )
        except LwrError as error:
            if not keep_going:
                raise
            unscored.append(Unscored(session.path.name, error))
    notes: tuple[str, ...] = ()
    if model.effects:
        named = ", ".join(dict.fromkeys(str(effect["cause"]) for effect in model.effects))
        notes = (f"The torque has the effects of the model: {named}.",)
    warnings = settle([doubt for doubt in doubts if not doubt.certain])
    warnings += [text for score in scores if not score.seen and (text := _poor(score))]
    return Validation(
        model.robot, tuple(scores), notes=notes, unscored=tuple(unscored), warnings=tuple(warnings)
    )


def _poor(score: SessionScore) -> str:
    """What to say of a session whose torque the model does not predict; empty where it does."""
    side, error = max(score.relative.items(), key=lambda item: item[1])
    if error < _POOR:
        return ""
    worst = max((one for one in score.scores if one.side == side), key=lambda one: one.rms)
    return (
        f"{score.session}: the {side} torque is off by {100.0 * error:.0f} %, most at {worst.joint} "
        f"({worst.rms:.3g} {worst.unit} rms): the model does not hold there; another payload, a wrong channel, or a "
        "motion beyond that of the estimate"
    )


def _screened(model: DynamicModel, sessions: Sequence[Session], signals: SignalSettings) -> tuple[Doubt, ...]:
    """Doubts about the channels of the model in those sessions with its joints."""
    chain = model.structure.chain
    whole = [session for session in sessions if set(chain.joint_names) <= set(session.joint_names)]
    structure = model.structure
    found = screen(whole, chain, signals, structure.couplings, motor=_has_motor(model))
    # A log given twice is scored twice, without harm to the scores.
    return tuple(replace(doubt, certain=doubt.certain and doubt.channel != "log") for doubt in found)


def _has_motor(model: DynamicModel) -> bool:
    return bool({"motor", "difference"} & set(model.structure.sides))


def signals_for(
    model: DynamicModel, settings: SignalSettings | None = None, *, estimate_delay: bool = False
) -> SignalSettings:
    """The given signal settings, else those of the model with the links where its effects have them, else the defaults.

    estimate_delay : without the model's delay of the motor channel.
    """
    chosen = settings or softened(signal_settings(model) or SignalSettings(), model)
    return replace(chosen, motor_delay_s="estimate") if estimate_delay else chosen


def predictor(model: DynamicModel, payload: str | None) -> Predictor:
    """The computed torque of a model with a payload mounted."""
    twisted = taken_back(model)
    behind = replace(model, effects=tuple(e for e in model.effects if e not in twisted)) if twisted else model

    def predict(channel: TorqueChannel, side: Side) -> Floats:
        return (behind if channel.taken_back else model).torque(
            channel.q,
            channel.qd,
            channel.qdd,
            payload=payload,
            side=side,
            time=channel.times,
            measured=True,
            drive=channel.drive,
        )

    return predict


def seen_sessions(model: DynamicModel, sessions: Sequence[Session]) -> list[bool]:
    """Whether the model was fitted to each session, by the uids (or file names) and the rows in its provenance."""
    entries = model.provenance.get("sessions", ())
    uids, files, rows = set(), set(), []
    for entry in entries if isinstance(entries, (list, tuple)) else ():
        if isinstance(entry, Mapping):
            uids.add(str(entry.get("uid", "")))
            rows.append(from_marks(str(entry.get("rows", ""))))
        else:
            uids.add(str(entry))
            files.add(str(entry))
    experiment = str(model.provenance.get("experiment", ""))
    joints = model.structure.chain.joint_names
    found = []
    for session in sessions:
        uid = session.metadata.get("uid", "")
        by_file = session.path.name in files and session.metadata.get("experiment", "") == experiment
        alike = set(joints) <= set(session.joint_names) and seen_before(session.select(joints), rows)
        found.append(bool(uid and uid in uids) or by_file or alike)
    return found


def mounted(model: DynamicModel, session: Session) -> str | None:
    """The payload of a session by its name in the model. Raises DataError for one missing there."""
    name = payload_name(session)
    if name is None or model.structure.sides == ("difference",):
        return None
    if name not in model.structure.payloads:
        known = model.structure.payloads
        same = (
            f"if it is the same under another name, say so (`--payload {session.path}={known[0]}`); else "
            if known
            else ""
        )
        raise DataError(
            f"{session.path.name}: payload {name!r} is not in the model (payloads: {', '.join(known) or 'none'}); "
            f"{same}validate on a session of the bare arm, or identify the payload first with `lwr-run payload`"
        )
    return name


def prepared_session(
    model: DynamicModel,
    session: Session,
    settings: SignalSettings | None,
    *,
    blocks: bool = False,
    recall: Recall | None = None,
) -> PreparedSession:
    """The session with the joints of the model, filtered as for the estimation (settings: `signals_for`).

    blocks, recall : as for `prepare`.
    """
    chosen = session.select(model.structure.chain.joint_names)
    signals, own = signals_for(model, settings), signals_for(model)
    # Cut-offs of the model are no choice of the session's.
    advise = (signals.cutoff_hz, signals.decimate_hz) != (own.cutoff_hz, own.decimate_hz)
    return prepare(chosen, signals, motor=_has_motor(model), advise=advise, blocks=blocks, recall=recall)


def _few(lines: Sequence[str]) -> list[str]:
    """The first lines, and a line with the number of the others."""
    left = len(lines) - _SHOWN
    return [*lines[:_SHOWN], *([f"  and {left} more"] if left > 0 else [])]


@dataclass(frozen=True)
class CrossValidation(Tabular):
    """One score for each session left out, the sessions never left out with the reason, and doubts about channels."""

    scores: tuple[SessionScore, ...]
    skipped: tuple[str, ...]
    warnings: tuple[str, ...] = ()

    @property
    def rms(self) -> dict[str, float]:
        """Root mean square over the folds of each joint and side [Nm or N], by `joint side`."""
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
            "warnings": list(self.warnings),
            "rms": self.rms,
        }

    def records(self) -> list[dict[str, Any]]:
        """One row for each session left out, joint and side."""
        return [row for score in self.scores for row in score.records()]

    def __repr__(self) -> str:
        return "\n".join(
            [
                f"Cross-validation: sessions left out in turn: {len(self.scores)}, skipped: {len(self.skipped)}",
                *_few([f"  {score!r}" for score in self.scores]),
            ]
        )

    def pieces(self) -> list[Piece]:
        """The scores of each fold, the rms over all."""
        found: list[Piece] = ["Cross-validation: each session by the model of the others"]
        for score in self.scores:
            found += ["", *score.pieces()]
        rows = [(key, f"{value:.3f}") for key, value in self.rms.items()]
        units = {f"{score.joint} {score.side}": score.unit for fold in self.scores for score in fold.scores}
        found += ["", in_units(("over the folds", "rms {unit}"), rows, [units[key] for key, _ in rows])]
        return [*found, *self.skipped, *(f"warning: {warning}" for warning in self.warnings)]

    def __str__(self) -> str:
        return text_of(self.pieces())


def cross_validate(
    sessions: Sessions, chain: Chain, settings: IdentificationSettings | None = None
) -> CrossValidation:
    """Leave out one session at a time.

    sessions : two at least, as for `identify`. A session with a payload of its own is skipped and named: the
    others cannot predict it. Raises DataError when no fold is left, or for a channel that is certainly wrong.
    """
    settings = settings or IdentificationSettings()
    sessions = as_sessions(sessions)
    if len(sessions) < 2:
        raise DataError(f"{len(sessions)} session cannot be cross-validated; give two at least")
    motor = settings.model != 1
    doubts = require_sound(sessions, chain, settings.signals, settings.couplings, motor=motor)
    scores, skipped = [], []
    for number, session in enumerate(sessions):
        others = [other for k, other in enumerate(sessions) if k != number]
        payload = payload_name(session)
        if payload is not None and all(payload_name(other) != payload for other in others):
            skipped.append(f"{session.path.name}: payload {payload!r} is in no other session; not left out")
            continue
        try:
            found = identify(others, chain, settings, known=Known(doubts))
        except DataError as error:
            skipped.append(f"{session.path.name}: the others do not identify a model: {error}")
            continue
        fold = validate(found.model, [session], keep_going=True, known=found.known)
        scores += list(fold.scores)
        skipped += [f"{one}; not scored" for one in fold.unscored]
    if not scores:
        raise DataError("no session can be predicted by the others: " + "; ".join(skipped))
    return CrossValidation(tuple(scores), tuple(skipped), tuple(settle(doubts)))
