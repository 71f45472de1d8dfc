"""What the figures show of a session: torque and velocity, logged and filtered, computed torque, residual."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ident.dynamics.structure import Side
from ident.estimation.validate import Score, mounted, predictor, prepared_session, score_session
from ident.model.dynamic_model import DynamicModel
from ident.rows.filters import ParallelFilter, SignalSettings
from ident.rows.prepare import Passage, PreparedSession
from lwr_driver.session import Session

__all__ = ["Curves", "curves"]

Floats = NDArray[np.float64]

_ATTENUATION_DB = 40.0
_RATE_PER_CUTOFF = 2.5


@dataclass(frozen=True, eq=False)
class Curves:
    """One session and side (`joint`, `motor`, `difference`), the part that the estimate was made from.

    joint_names : n joints. payload : name, None for the bare arm.
    time (m,) [s], torque, error, q, qd (m, n) : every sample as logged [Nm]; error is measured less computed.
    raw_velocity : (m, n) differences of the logged positions [rad/s]; empty (m, 0) on the motor side.
    grid (k,) [s], measured, computed (k, n) : torque and its prediction, both through the same low-pass [Nm].
    error and computed are NaN where a joint stands still.
    cutoff_hz : of that low-pass. scores : numbers of the computed-torque test by joint.
    unseen : whether the estimate was made without this session.
    relative : residual over torque of all joints.
    """

    session: str
    file: str
    side: Side
    payload: str | None
    joint_names: tuple[str, ...]
    cutoff_hz: float
    time: Floats
    torque: Floats
    error: Floats
    q: Floats
    qd: Floats
    raw_velocity: Floats
    grid: Floats
    measured: Floats
    computed: Floats
    scores: tuple[Score, ...]
    relative: float
    unseen: bool = False

    @property
    def label(self) -> str:
        """Session and side in words."""
        return f"{self.session}, {self.side} torque{', unseen by the estimate' if self.unseen else ''}"

    def relative_error(self, joint: int) -> Floats:
        """(k,) error in percent of the largest measured torque of the joint in this session."""
        largest = float(np.max(np.abs(self.measured[:, joint]))) or 1.0
        return 100.0 * (self.measured[:, joint] - self.computed[:, joint]) / largest


def curves(
    model: DynamicModel,
    session: Session,
    name: str,
    *,
    cutoff_hz: float | None = None,
    unseen: bool = False,
) -> list[Curves]:
    """Curves of a session for each side that the model describes and the session has.

    cutoff_hz : cut-off of the position filter, as in the estimation; None takes the default.
    unseen : whether the estimate was made without this session.
    """
    payload = mounted(model, session)
    settings = None if cutoff_hz is None else SignalSettings(cutoff_hz=cutoff_hz)
    prepared = prepared_session(model, session, settings)
    predict = predictor(model, payload)
    scored = score_session(prepared, predict, model.structure.sides, session, "identified model")
    chosen = session.select(model.structure.chain.joint_names)
    found = []
    for side in model.structure.sides:
        if side not in scored.relative or side == "difference":
            continue
        parts = [
            part for passage in prepared.passages if (part := _part(passage, side, model, payload, prepared))
        ]
        if not parts:
            continue
        stacked = [np.concatenate(column) for column in zip(*parts, strict=True)]
        time = stacked[0]
        found.append(
            Curves(
                session=name,
                file=session.path.name,
                side=side,
                payload=payload,
                joint_names=prepared.joint_names,
                cutoff_hz=prepared.cutoff_hz,
                time=time,
                torque=stacked[1],
                error=stacked[2],
                q=stacked[3],
                qd=stacked[4],
                raw_velocity=_velocity(chosen, time) if side == "joint" else np.empty((len(time), 0)),
                grid=stacked[5],
                measured=stacked[6],
                computed=stacked[7],
                scores=tuple(score for score in scored.scores if score.side == side),
                relative=float(scored.relative[side]),
                unseen=unseen,
            )
        )
    return found


def _part(
    passage: Passage, side: Side, model: DynamicModel, payload: str | None, prepared: PreparedSession
) -> Sequence[Floats]:
    channel = passage.joint if side == "joint" else passage.motor
    if channel is None or not len(passage.rows) or not channel.torque.shape[1]:
        return ()
    computed = predictor(model, payload)(channel, side)
    # At rest the Coulomb torque is unknown: what would be computed there says nothing of the model.
    settings = prepared.settings
    resting = np.abs(channel.qd) < settings.standstill_rad_s
    first, last = passage.rows[0], passage.rows[-1]
    inside = (channel.times >= first) & (channel.times <= last)
    step = float(np.median(np.diff(channel.times)))
    cutoff = min(prepared.cutoff_hz, 0.2 / step)
    grid = np.arange(first, last, 1.0 / (_RATE_PER_CUTOFF * cutoff))
    low_pass = ParallelFilter(channel.times, grid, cutoff, _ATTENUATION_DB)
    filtered = low_pass.apply(computed)
    filtered[low_pass.share(resting) > settings.standstill_share] = np.nan
    return (
        channel.times[inside],
        channel.torque[inside],
        np.where(resting, np.nan, channel.torque - computed)[inside],
        channel.q[inside],
        channel.qd[inside],
        grid,
        low_pass.apply(channel.torque),
        filtered,
    )


def _velocity(session: Session, time: Floats) -> Floats:
    """(m, n) differences of the logged positions [rad/s] at the times of the channel."""
    joint = session.joint
    clock = joint.publish_time if np.ptp(joint.publish_time) > 0 else joint.log_time
    seconds = (clock - clock[0]) * 1e-9
    speed = np.diff(joint.position, axis=0) / np.diff(seconds)[:, None]
    middle = 0.5 * (seconds[1:] + seconds[:-1])
    nearest = np.clip(np.searchsorted(middle, time), 0, len(middle) - 1)
    return np.asarray(speed[nearest], dtype=np.float64)
