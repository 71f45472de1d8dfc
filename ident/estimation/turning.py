"""Friction that turns over a path after a reversal, in the model that `identify` gives.

The rows of the estimation leave reversals out, so that presliding bends no parameter. The computed torque is wanted
there, too: where the drives need a path to turn their friction, a sign is wrong by up to twice the Coulomb friction.
So the residual over all samples of each motor torque is held against Dahl's state less the model's sign,

    e = a (z(L) - s),   dz = (1 - z sign(dx)) dx / L,

for lengths L of a grid. All of the Coulomb friction turns (a), or the share of least squares where that is better by 2
% of the squared error of blocks held back and by two of its standard errors; a joint gets the effect if that falls by
as much. Friction at rest is any up to the Coulomb torque, and no length is taken that follows it at the cost of motion.
The standard deviations are from the estimates without a tenth of the blocks in turn.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ident.dynamics.parameters import Floats, joint_unit
from ident.effects import PRESLIDING, entry_of
from ident.effects.motion import STILL_RAD_S, turned_friction
from ident.estimation.scores import inside
from ident.estimation.validate import predictor
from ident.model.dynamic_model import DynamicModel
from ident.model.signals import signal_settings
from ident.rows.content import Recall
from ident.rows.prepare import prepare
from ident.rows.prepared import TorqueChannel
from ident.rows.reversals import TURNING_RAD, away_from_reversals
from ident.rows.sessions import payload_name
from lwr_driver.session import Session

# Lengths to try [rad].
_LENGTHS = np.geomspace(1e-5, 0.1, 27)
_BLOCK_S, _LEAST_BLOCKS, _FOLDS = 1.0, 16, 10
# Longest part of all sessions together [s].
_MOST_S = 240.0
# Least fall of the held-back square of the error, as a share of it, and in its standard errors.
_FELT, _SURE = 0.02, 2.0


@dataclass(frozen=True)
class Turning:
    """Entries of the drives whose friction turns over a path; before, after : torque error [%] of the motor side over
    all samples looked at, without and with them; names : of the joints; sliding : names of the prismatic ones."""

    entries: tuple[Mapping[str, Any], ...]
    before: float
    after: float
    names: tuple[str, ...]
    sliding: tuple[str, ...] = ()

    @property
    def lengths(self) -> dict[str, float]:
        """Paths by joint [rad, m of a prismatic one]."""
        values = (entry["parameters"]["length"]["value"] for entry in self.entries)
        return dict(zip(self.names, values, strict=True))

    def to_dict(self) -> dict[str, Any]:
        """Plain content for files."""
        return {
            "torque_error_percent": {"without": self.before, "with": self.after},
            "length_rad": {name: one for name, one in self.lengths.items() if name not in self.sliding},
            "length_m": {name: one for name, one in self.lengths.items() if name in self.sliding},
        }

    def __str__(self) -> str:
        listed = ", ".join(
            f"{name} {1e3 * one:.2g} {joint_unit('mrad', prismatic=name in self.sliding)}"
            for name, one in self.lengths.items()
        )
        return (
            f"friction turns over a path after a reversal: {listed}; the model has it as an effect, motor "
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
    if whole is None or len(whole.torque) < _LEAST_BLOCKS:
        return None
    coulomb = drive_coulomb(model, sensed=any(bool(s.joint.effort.shape[1]) for s in sessions))
    chain = model.structure.chain
    sliding = {name for name, slides in zip(chain.joint_names, chain.prismatic, strict=True) if slides}
    entries, names = [], []
    left = whole.error[0].sum(axis=0)
    for joint, name in enumerate(chain.joint_names):
        most = float(coulomb[joint])
        if most <= 0.0 or (share := whole.pays(joint, most)) is None:
            continue
        place, amplitude = whole.best(joint, most, share=share)
        stds = whole.scatter(joint, most)
        values = {"amplitude": (amplitude, stds[0]), "length": (float(_LENGTHS[place]), stds[1])}
        entries.append(entry_of(PRESLIDING, [joint + 1], values, prismatic=name in sliding))
        names.append(name)
        left[joint] -= float(whole.fall(joint, place, amplitude).sum())
    if not entries:
        return None
    before, after = (
        100.0 * float(np.sqrt(power.sum() / whole.torque.sum()))
        for power in (whole.error[0].sum(axis=0), left)
    )
    return Turning(
        tuple(entries), before, after, tuple(names), tuple(name for name in names if name in sliding)
    )


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
    """Sums over the samples of blocks: products of error and columns (2, b, n, L) and squares of the columns
    (2, b, n, L) and of the error (2, b, n), of all samples and of those in motion away from reversals; squares of the
    torque (b, n)."""

    cross: Floats
    square: Floats
    error: Floats
    torque: Floats

    @classmethod
    def joined(cls, parts: Sequence[_Sums]) -> _Sums:
        """The blocks of all parts."""
        cross, square, error = (
            np.concatenate([getattr(one, name) for one in parts], axis=1)
            for name in ("cross", "square", "error")
        )
        return cls(cross, square, error, np.concatenate([one.torque for one in parts]))

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
        cross, square = np.zeros((2, 2, len(starts), n, len(_LENGTHS)))
        squared = np.zeros((2, len(starts), n))
        speeds = channel.qd if channel.drive is None else channel.drive.speed
        law = model.structure.coulomb(speeds)
        away = away_from_reversals(channel.qd, channel.period_s, 0.0, STILL_RAD_S, TURNING_RAD)
        for joint in range(n):
            speed = speeds[:, joint]
            path = channel.q[:, joint] if channel.drive is None else np.cumsum(speed) * channel.period_s
            counted = np.array([used[:, joint], used[:, joint] & away[:, joint]])
            own = error[:, joint] * counted
            squared[:, :, joint] = np.add.reduceat(own**2, starts, axis=1)
            for k, length in enumerate(_LENGTHS):
                column = (turned_friction(path, speed, float(length)) - law[:, joint]) * counted
                cross[:, :, joint, k] = np.add.reduceat(column * own, starts, axis=1)
                square[:, :, joint, k] = np.add.reduceat(column**2, starts, axis=1)
        torque = np.where(used, channel.torque, 0.0)
        return cls(cross, square, squared, np.add.reduceat(torque**2, starts))

    def best(self, joint: int, most: float, blocks: Any = slice(None), *, share: bool) -> tuple[int, float]:
        """Place of the length and amplitude [Nm] with the least squared error in some blocks, no larger away from
        reversals; amplitude 0 without one.

        share : whether the amplitude is that of least squares, from 0 to `most`, or `most`.
        """
        cross, square = (values[:, blocks, joint].sum(axis=1) for values in (self.cross, self.square))
        amplitude = np.full(len(_LENGTHS), most)
        if share:
            amplitude = np.clip(cross[0] / np.maximum(square[0], 1e-300), 0.0, most)
        fall, away = 2.0 * amplitude * cross - amplitude**2 * square
        fall = np.where(away >= -_FELT * self.error[1, blocks, joint].sum(), fall, 0.0)
        place = int(np.argmax(fall))
        return place, float(amplitude[place]) if fall[place] > 0.0 else 0.0

    def fall(self, joint: int, place: int, amplitude: float) -> Floats:
        """Fall (b,) of the squares of the error in each block."""
        cross, square = self.cross[0, :, joint, place], self.square[0, :, joint, place]
        return np.asarray(2.0 * amplitude * cross - amplitude**2 * square)

    def pays(self, joint: int, most: float) -> bool | None:
        """Whether a share of the friction turns, or all of it; None for neither."""
        whole, some = (self._held_back(joint, most, share) for share in (False, True))
        if self._clear(joint, whole) and not self._clear(joint, some - whole):
            return False
        return True if self._clear(joint, some) else None

    def _held_back(self, joint: int, most: float, share: bool) -> Floats:
        """Fall (b,) in each half of the blocks by the other; drawn, for a motion may go on and off in turn."""
        half = np.random.default_rng(0).permutation(len(self.torque)) % 2 == 0
        by_other, by_half = (
            self.fall(joint, *self.best(joint, most, blocks, share=share)) for blocks in (~half, half)
        )
        return np.where(half, by_other, by_half)

    def _clear(self, joint: int, fall: Floats) -> bool:
        """Whether a fall (b,) is felt, and sure."""
        spread = float(np.std(fall, ddof=1) / np.sqrt(len(fall)))
        return bool(fall.sum() > _FELT * self.error[0, :, joint].sum() and fall.mean() > _SURE * spread)

    def scatter(self, joint: int, most: float) -> tuple[float, float]:
        """Jackknife standard deviations of amplitude [Nm] and length [rad], the latter with the step of the grid."""
        group = np.arange(len(self.torque)) % _FOLDS
        found = [self.best(joint, most, group != k, share=True) for k in range(min(_FOLDS, len(self.torque)))]
        table = np.array([(amplitude, _LENGTHS[place]) for place, amplitude in found])
        step = float(np.log(_LENGTHS[1] / _LENGTHS[0])) / np.sqrt(12.0)
        amplitude, length = np.sqrt(len(table) - 1.0) * np.std(table, axis=0)
        # At its limit the amplitude is the same in all of them.
        return round(float(amplitude), 12), float(np.hypot(length, step * np.mean(table[:, 1])))
