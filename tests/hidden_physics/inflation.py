"""How visible a case is: rho, the held-out error of the base model over that of the healthy twin."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ident.dynamics.kinematics import Chain
from ident.dynamics.structure import Side
from ident.estimation.identification import IdentificationSettings
from ident.estimation.identify import identify
from ident.model.dynamic_model import DynamicModel
from ident.rows.filters import SignalSettings
from ident.rows.prepare import prepare
from lwr_driver.arm import Arm
from lwr_driver.session import Session, read_session

__all__ = ["base_error", "inflation"]

_BIN_S = 0.024
_REVERSAL_S = 0.08
_SLOW_RAD_S = 0.02
_SIGNALS = SignalSettings(motor_delay_s=1.5e-3)


@cache
def _chain() -> Chain:
    return Chain.from_urdf(Arm.load().urdf)


def base_error(train: Sequence[Path], test: Sequence[Path]) -> NDArray[np.float64]:
    """Held-out RMS error of the base model [Nm], (14,): motor rows 1 to 7, joint rows 1 to 7.

    The base model is identified on `train` with the healthy channels' delay. Its computed torque on `test` is
    compared in means over 24 ms, what both channels resolve; what is nearer than 80 ms to a reversal of the
    joint or slower than 0.02 rad/s is left out, since there the base model's sign of the velocity decides and
    nothing else.
    """
    chain = _chain()
    found = identify(
        [read_session(path) for path in train],
        chain,
        IdentificationSettings(essential=None, signals=_SIGNALS),
    )
    squares, counts = np.zeros(14), np.zeros(14)
    for session in (read_session(path) for path in test):
        payload = session.metadata["payload"]
        _add_session(session, None if payload == "none" else payload, found.model, squares, counts)
    return np.sqrt(squares / counts)


def _add_session(
    session: Session,
    payload: str | None,
    model: DynamicModel,
    squares: NDArray[np.float64],
    counts: NDArray[np.float64],
) -> None:
    prepared = prepare(session.select(_chain().joint_names), _SIGNALS)
    for passage in prepared.passages:
        for offset, channel in ((0, passage.motor), (7, passage.joint)):
            if channel is None:
                continue
            side: Side = "motor" if offset == 0 else "joint"
            error = channel.torque - model.torque(
                channel.q, channel.qd, channel.qdd, payload=payload, side=side
            )
            inside = (channel.times >= passage.rows[0]) & (channel.times <= passage.rows[-1])
            bins = (channel.times / _BIN_S).astype(np.int64)
            bins -= bins.min()
            size = np.maximum(np.bincount(bins), 1)
            for joint in range(7):
                used = inside & ~_near_reversal(channel.times, channel.qd[:, joint])
                used &= ~channel.flagged[:, joint] & (np.abs(channel.qd[:, joint]) > _SLOW_RAD_S)
                whole = np.bincount(bins, used) >= size
                means = np.bincount(bins, error[:, joint]) / size
                squares[offset + joint] += float(np.sum(means[whole] ** 2))
                counts[offset + joint] += int(whole.sum())


def _near_reversal(times: NDArray[np.float64], speed: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Samples nearer than `_REVERSAL_S` to a change of sign."""
    turns = times[1:][np.diff(np.sign(speed)) != 0.0]
    if not len(turns):
        return np.zeros(len(times), dtype=bool)
    after = np.searchsorted(turns, times)
    distance = np.minimum(
        np.abs(times - turns[np.minimum(after, len(turns) - 1)]),
        np.abs(times - turns[np.maximum(after - 1, 0)]),
    )
    return distance < _REVERSAL_S


def inflation(error: NDArray[np.float64], twin: NDArray[np.float64]) -> float:
    """rho: the largest ratio of the rows' errors, (14,) each."""
    return float(np.max(error / twin))
