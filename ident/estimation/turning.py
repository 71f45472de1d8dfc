"""Friction that turns over a path after a reversal, in the model that `identify` gives.

The rows of the estimation leave reversals out, so that presliding bends no parameter. The computed torque is wanted
there, too: where the drives need a path to turn their friction, a sign is wrong by up to twice the Coulomb friction.
So the residual over all samples of each motor torque is held against Dahl's state less the model's sign,

    e = a (z(L) - s),   dz = (1 - z sign(dx)) dx / L,

for lengths L of a grid. Length and amplitude a are those of least squares, their standard deviations from the
estimates without a tenth of the blocks in turn. A joint gets the effect if the squared error of blocks held back falls
by 2 % and by two of its standard errors.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ident.dynamics.parameters import Floats
from ident.effects import PRESLIDING, entry_of
from ident.effects.motion import turned_friction
from ident.estimation.scores import inside
from ident.estimation.validate import predictor
from ident.model.dynamic_model import DynamicModel
from ident.model.signals import signal_settings
from ident.rows.content import Recall
from ident.rows.prepare import prepare
from ident.rows.prepared import TorqueChannel
from ident.rows.sessions import payload_name
from lwr_driver.session import Session

# Lengths to try [rad].
_LENGTHS = np.geomspace(5e-5, 0.1, 23)
_BLOCK_S, _LEAST_BLOCKS, _FOLDS = 1.0, 16, 10
# Longest part of all sessions together [s].
_MOST_S = 240.0
# Least fall of the held-back square of the error, as a share of it, and in its standard errors.
_FELT, _SURE = 0.02, 2.0


@dataclass(frozen=True)
class Turning:
    """Entries of the drives whose friction turns over a path; before, after : torque error [%] of the motor side over
    all samples looked at, without and with them; names : of the joints."""

    entries: tuple[Mapping[str, Any], ...]
    before: float
    after: float
    names: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """Plain content for files."""
        return {
            "torque_error_percent": {"without": self.before, "with": self.after},
            "length_rad": {
                name: entry["parameters"]["length"]["value"]
                for name, entry in zip(self.names, self.entries, strict=True)
            },
        }

    def __str__(self) -> str:
        lengths = (1e3 * entry["parameters"]["length"]["value"] for entry in self.entries)
        listed = ", ".join(f"{name} {length:.2g}" for name, length in zip(self.names, lengths, strict=True))
        return (
            f"friction turns over a path after a reversal [mrad]: {listed}; the model has it as an effect, motor "
            f"torque error over all samples {self.before:.1f} -> {self.after:.1f} %"
        )


def friction_turning(
    model: DynamicModel, sessions: Sequence[Session], *, recall: Recall | None = None
) -> Turning | None:
    """The drives of a model whose friction turns over a path in these sessions, no more of it than its Coulomb
    friction; None without one.

    sessions : with the joints of the model. recall : see `prepare`.
    """
    if "motor" not in model.structure.sides or not any(s.motor is not None for s in sessions):
        return None
    sums = [_Sums.of(model, *one) for one in _channels(model, sessions, recall)]
    whole = _Sums.joined(sums) if sums else None
    if whole is None or len(whole.error) < _LEAST_BLOCKS:
        return None
    coulomb = drive_coulomb(model, sensed=any(bool(s.joint.effort.shape[1]) for s in sessions))
    entries, names = [], []
    left = whole.error.sum(axis=0)
    for joint, name in enumerate(model.structure.chain.joint_names):
        most = float(coulomb[joint])
        if most <= 0.0 or not whole.pays(joint, most):
            continue
        place, amplitude = whole.best(joint, most)
        stds = whole.scatter(joint, most)
        values = {"amplitude": (amplitude, stds[0]), "length": (float(_LENGTHS[place]), stds[1])}
        entries.append(entry_of(PRESLIDING, [joint + 1], values))
        names.append(name)
        left[joint] -= float(whole.fall(joint, place, amplitude).sum())
    if not entries:
        return None
    before, after = (
        100.0 * float(np.sqrt(power.sum() / whole.torque.sum())) for power in (whole.error.sum(axis=0), left)
    )
    return Turning(tuple(entries), before, after, tuple(names))


def drive_coulomb(model: DynamicModel, *, sensed: bool) -> Floats:
    """Coulomb friction (n,) [Nm] of the drives. Without joint torques, friction of link and drive is one."""
    drive = model.drive()
    return drive["Fcm"] if sensed else drive["Fcm"] + drive["Fcl"]


def _channels(
    model: DynamicModel, sessions: Sequence[Session], recall: Recall | None
) -> Iterator[tuple[TorqueChannel, NDArray[np.bool_], str | None]]:
    """Motor channels of the sessions, the samples that count, and the payload."""
    settings = signal_settings(model)
    share = _MOST_S / max(len(sessions), 1)
    for session in sessions:
        if session.motor is None:
            continue
        prepared = prepare(session, settings, log=False, advise=False, blocks=True, recall=recall)
        seen = 0.0
        for passage in prepared.passages:
            if seen >= share:
                break
            if passage.motor is not None and len(passage.rows):
                channel = passage.motor
                yield channel, inside(channel, passage)[:, None] & ~channel.flagged, payload_name(session)
                seen += float(np.ptp(channel.times))
            passage.release()


@dataclass(frozen=True)
class _Sums:
    """Sums over the samples of blocks: products of error and columns (b, n, L), squares of the columns (b, n, L),
    squares of error and torque (b, n)."""

    cross: Floats
    square: Floats
    error: Floats
    torque: Floats

    @classmethod
    def joined(cls, parts: Sequence[_Sums]) -> _Sums:
        """The blocks of all parts."""
        table = zip(*((one.cross, one.square, one.error, one.torque) for one in parts), strict=True)
        return cls(*(np.concatenate(column) for column in table))

    @classmethod
    def of(
        cls, model: DynamicModel, channel: TorqueChannel, used: NDArray[np.bool_], payload: str | None
    ) -> _Sums:
        """Of one channel."""
        error = np.where(used, channel.torque - predictor(model, payload)(channel, "motor"), 0.0)
        starts = np.unique(
            np.searchsorted(channel.times, np.arange(channel.times[0], channel.times[-1], _BLOCK_S))
        )
        n = error.shape[1]
        cross, square = np.zeros((len(starts), n, len(_LENGTHS))), np.zeros((len(starts), n, len(_LENGTHS)))
        law = model.structure.coulomb(channel.qd)
        for joint in range(n):
            # As the model computes it: behind elastic joints the path of the link stands for that of the drive.
            path, begins = channel.q[:, joint], float(channel.qd[0, joint])
            for k, length in enumerate(_LENGTHS):
                column = turned_friction(path, float(length), begins) - law[:, joint]
                column *= used[:, joint]
                cross[:, joint, k] = np.add.reduceat(column * error[:, joint], starts)
                square[:, joint, k] = np.add.reduceat(column**2, starts)
        torque = np.where(used, channel.torque, 0.0)
        return cls(cross, square, np.add.reduceat(error**2, starts), np.add.reduceat(torque**2, starts))

    def best(self, joint: int, most: float, blocks: Any = slice(None)) -> tuple[int, float]:
        """Place of the length and amplitude [Nm] of least squares in some blocks, from 0 to `most`."""
        cross, square = self.cross[blocks, joint].sum(axis=0), self.square[blocks, joint].sum(axis=0)
        amplitude = np.clip(cross / np.maximum(square, 1e-300), 0.0, most)
        place = int(np.argmax(2.0 * amplitude * cross - amplitude**2 * square))
        return place, float(amplitude[place])

    def fall(self, joint: int, place: int, amplitude: float) -> Floats:
        """Fall (b,) of the squares of the error in each block."""
        return np.asarray(
            2.0 * amplitude * self.cross[:, joint, place] - amplitude**2 * self.square[:, joint, place]
        )

    def pays(self, joint: int, most: float) -> bool:
        """Whether the error of the even blocks falls by what the odd ones say, and the other way round."""
        even = np.arange(len(self.error)) % 2 == 0
        fall = np.where(
            even,
            self.fall(joint, *self.best(joint, most, ~even)),
            self.fall(joint, *self.best(joint, most, even)),
        )
        spread = float(np.std(fall, ddof=1) / np.sqrt(len(fall)))
        return bool(fall.sum() > _FELT * self.error[:, joint].sum() and fall.mean() > _SURE * spread)

    def scatter(self, joint: int, most: float) -> tuple[float, float]:
        """Jackknife standard deviations of amplitude [Nm] and length [rad], the latter with the step of the grid."""
        group = np.arange(len(self.error)) % _FOLDS
        found = [self.best(joint, most, group != k) for k in range(min(_FOLDS, len(self.error)))]
        table = np.array([(amplitude, _LENGTHS[place]) for place, amplitude in found])
        step = float(np.log(_LENGTHS[1] / _LENGTHS[0])) / np.sqrt(12.0)
        amplitude, length = np.sqrt(len(table) - 1.0) * np.std(table, axis=0)
        # At its limit the amplitude is the same in all of them.
        return round(float(amplitude), 12), float(np.hypot(length, step * np.mean(table[:, 1])))
