"""Other predictors of the joint torque, to hold an identified model against.

* the controller's own mass matrix and gravity torque, as the channel `/fri/controller_model` has them:
  tau = M(q) qdd + g(q), without centrifugal terms and friction, at the times of that channel;
* the CAD model: the inertials of the URDF, without friction;
* another identified model.

All of them describe the joint side.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fri.errors import ConfigurationError, DataError
from ident import regressor
from ident.model import DynamicModel
from ident.signals.prepare import PreparedSession, TorqueChannel
from ident.structure import Side
from ident.validation import SessionScore, mounted, predictor, prepared_session, score_session

if TYPE_CHECKING:
    from ident.signals.settings import SignalSettings
    from lwr_driver.session import Session

__all__ = ["competitor_scores", "score_cad", "score_controller_model"]

Floats = NDArray[np.float64]


def competitor_scores(
    model: DynamicModel,
    sessions: Sequence[Session],
    *,
    settings: SignalSettings | None = None,
    others: Sequence[DynamicModel] = (),
) -> tuple[SessionScore, ...]:
    """Every competitor that exists for each session; the model itself lends its joints and its URDF."""
    found = []
    for session in sessions:
        prepared = prepared_session(model, session, settings)
        if not any(passage.joint.torque.shape[1] for passage in prepared.passages):
            continue
        controller = score_controller_model(prepared, session)
        if controller is not None:
            found.append(controller)
        if model.structure.chain.urdf is not None:
            found.append(score_cad(model, prepared, session))
        for other in others:
            found.append(_score_other(other, session, settings))
    return tuple(found)


def score_cad(model: DynamicModel, prepared: PreparedSession, session: Session) -> SessionScore:
    """The inertials of the URDF, bare arm: rigid joint torque."""
    chain = model.structure.chain
    bodies = chain.urdf_inertials()

    def predict(channel: TorqueChannel, side: Side) -> Floats:
        return regressor.torque(chain, channel.q, channel.qd, channel.qdd, bodies)

    carried = session.metadata.get("payload", "none").strip() not in ("", "none")
    notes = ("CAD: the payload is not in the URDF.",) if carried else ()
    return score_session(prepared, predict, ("joint",), session, "CAD (URDF), no friction", notes=notes)


def score_controller_model(prepared: PreparedSession, session: Session) -> SessionScore | None:
    """The controller's mass matrix and gravity; None where the session has no such channel.

    Only the joint samples that a message of the channel belongs to (nearest, within 2 ms) are scored.
    """
    channel = session.controller_model
    if channel is None or not len(channel):
        return None
    if channel.gravity.shape[1] != len(prepared.joint_names):
        raise DataError(
            f"{prepared.name}: /fri/controller_model is of {channel.gravity.shape[1]} joints, the model of "
            f"{len(prepared.joint_names)}; it belongs to another arm"
        )
    reference = session.joint
    own = bool(np.ptp(reference.publish_time) > 0)
    origin = int((reference.publish_time if own else reference.log_time)[0])
    clock = channel.publish_time if own else channel.log_time
    times = np.asarray((clock - origin) * 1e-9, dtype=np.float64)
    passages = []
    for passage in prepared.passages:
        picked, _ = _matched(passage.joint.times, times)
        if len(picked) > 1:
            passages.append(replace(passage, joint=_picked(passage.joint, picked)))
    if not passages:
        return None

    def predict(samples: TorqueChannel, side: Side) -> Floats:
        _, message = _matched(samples.times, times)
        inertial = np.einsum("nij,nj->ni", channel.mass_matrix[message], samples.qdd)
        return np.asarray(inertial + channel.gravity[message], dtype=np.float64)

    return score_session(
        replace(prepared, passages=tuple(passages)),
        predict,
        ("joint",),
        session,
        "controller's M(q), g(q)",
    )


def _matched(samples: Floats, times: Floats) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Samples that messages belong to, and these messages."""
    nearest = np.clip(np.searchsorted(samples, times), 1, len(samples) - 1)
    nearest -= samples[nearest] - times > times - samples[nearest - 1]
    close = np.abs(samples[nearest] - times) <= 2e-3
    picked, first = np.unique(nearest[close], return_index=True)
    return picked, np.flatnonzero(close)[first]


def _picked(channel: TorqueChannel, rows: NDArray[np.int64]) -> TorqueChannel:
    return replace(
        channel,
        times=channel.times[rows],
        q=channel.q[rows],
        qd=channel.qd[rows],
        qdd=channel.qdd[rows],
        torque=channel.torque[rows],
        flagged=channel.flagged[rows],
    )


def _score_other(other: DynamicModel, session: Session, settings: SignalSettings | None) -> SessionScore:
    if "joint" not in other.structure.sides:
        raise ConfigurationError(
            f"the model of {other.robot} has no joint torque and cannot compete; use Model 1 or 2"
        )
    prepared = prepared_session(other, session, settings)
    predict = predictor(other, mounted(other, session))
    return score_session(prepared, predict, ("joint",), session, f"model of {other.robot}")
