"""Rows of joints and sides at full band, for the choice of signal settings: fits and errors of sets of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ident.dynamics.parameters import Floats
from ident.rows.binned import BinnedRows
from ident.rows.filters import SignalSettings
from ident.rows.reversals import away_from_reversals

BIN_S = 0.02
"""Time of a row [s]."""
LEAST = 8
"""Rows of a joint for an error of its own."""
_RIDGE = 1e-10
_ROUNDS = 3


@dataclass(frozen=True)
class ClassRows:
    """Rows of one joint and side of all sessions.

    matrix : (m, a), the columns `acting` (a,) of the `width` p of the model, those that are not zero: the joint's own
    and those of the links behind it. torque, speed : (m,). shared : (m, k), speeds of the drives shared with others.
    measured : (m,), neither bridged nor outliers. block : (m,), number of its block. parts, stretches : the rows of all
    joints of each stretch, and their places here.
    """

    matrix: Floats
    torque: Floats
    speed: Floats
    shared: Floats
    measured: NDArray[np.bool_]
    block: NDArray[np.int64]
    parts: tuple[BinnedRows, ...]
    stretches: tuple[slice, ...]
    acting: NDArray[np.int64]
    width: int

    def fitted(self, values: Floats) -> Floats:
        """Torque (m,) of the rows by the parameters (p,)."""
        return self.matrix @ values[self.acting]

    @property
    def drives(self) -> Floats:
        """Speeds (m, 1 + k) of the joint and of the drives that it shares."""
        return np.column_stack([self.speed, self.shared])

    @property
    def even(self) -> NDArray[np.bool_]:
        """Rows (m,) of the fitted blocks."""
        return np.asarray(self.block % 2 == 0)

    def known(self, bins: int, standstill_rad_s: float, turning_rad: float) -> NDArray[np.bool_]:
        """Measured rows (m,) more than `bins` rows and the path `turning_rad` from a reversal of the joint or of a
        drive that it shares."""
        found, speed = self.measured.copy(), self.drives
        for some in self.stretches:
            away = away_from_reversals(speed[some], BIN_S, bins * BIN_S, standstill_rad_s, turning_rad)
            found[some] &= away.all(axis=1)
        return found

    def faster(self, speed_rad_s: float) -> NDArray[np.bool_]:
        """Rows (m,) in which the joint and each drive that it shares are faster than this."""
        return np.asarray((np.abs(self.drives) > speed_rad_s).all(axis=1))


ByClass = dict[tuple[str, int], ClassRows]
Masks = Mapping[tuple[str, int], NDArray[np.bool_]]


def away(rows: ByClass, settings: SignalSettings) -> Masks:
    """The rows away from reversals and slow motion."""
    bins = round(settings.reversal / BIN_S)
    beside = settings.standstill_rad_s, settings.turning
    known = {key: own.known(bins, *beside) for key, own in rows.items()}
    return {key: mask & rows[key].faster(settings.slow) for key, mask in known.items()}


def blocks(times: Sequence[Floats], block_s: float) -> NDArray[np.int64]:
    """Number of each row's block, of rows at the times [s] of several stretches; even blocks are even in all."""
    first, found = 0, []
    for time in times:
        found.append(np.floor(time / block_s).astype(np.int64) + first)
        first = (int(found[-1].max(initial=first)) // 2 + 1) * 2
    return np.concatenate(found)


@dataclass(frozen=True)
class Moments:
    """Sums over rows of the C classes: gram (C, p, p) and target (C, p) of the matrix, square (C,) of the torque, and
    their number (C,)."""

    gram: Floats
    target: Floats
    square: Floats
    count: Floats

    @classmethod
    def of(cls, rows: ByClass, masks: Masks) -> Moments:
        """Sums over the masked rows."""
        width = next(iter(rows.values())).width
        gram, target = np.zeros((len(rows), width, width)), np.zeros((len(rows), width))
        square, count = np.zeros(len(rows)), np.zeros(len(rows))
        for c, (key, own) in enumerate(rows.items()):
            matrix, torque = own.matrix[masks[key]], own.torque[masks[key]]
            gram[c][np.ix_(own.acting, own.acting)] = matrix.T @ matrix
            target[c, own.acting] = matrix.T @ torque
            square[c], count[c] = torque @ torque, len(torque)
        return cls(gram, target, square, count)

    def __add__(self, other: Moments) -> Moments:
        return Moments(
            self.gram + other.gram,
            self.target + other.target,
            self.square + other.square,
            self.count + other.count,
        )

    def solved(self) -> tuple[Floats, Floats]:
        """Weighted least squares (p,), and the weights (C,): one over the mean square of a class's residual."""
        weights = np.ones(len(self.square))
        values = np.zeros(self.target.shape[1])
        for _ in range(_ROUNDS):
            values = self.divided(weights, weights @ self.target)
            fitted = np.einsum("p,cpq,q->c", values, self.gram, values)
            error = np.maximum(self.square - 2.0 * self.target @ values + fitted, 0.0)
            weights = np.maximum(self.count, 1.0) / np.maximum(error, 1e-12 * self.square + 1e-300)
        return values, weights

    def divided(self, weights: Floats, right: Floats) -> Floats:
        """The inverse of the weighted sum of `gram` times `right` (p,) or (p, k)."""
        normal = np.tensordot(weights, self.gram, axes=1)
        scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
        scaled = normal / np.outer(scale, scale) + _RIDGE * np.eye(len(scale))
        return np.asarray((np.linalg.solve(scaled, (right.T / scale).T).T / scale).T)


def nested(rows: ByClass, masks: Sequence[Masks]) -> list[Moments]:
    """Moments of ever smaller masks, each inside the one before."""
    found = [Moments.of(rows, masks[-1])]
    for wide, narrow in reversed(list(pairwise(masks))):
        shell = {key: mask & ~narrow[key] for key, mask in wide.items()}
        found.append(found[-1] + Moments.of(rows, shell))
    return found[::-1]


def even(rows: ByClass, masks: Masks) -> Masks:
    """The masked rows of even blocks."""
    return {key: masks[key] & own.even for key, own in rows.items()}


def fit(rows: ByClass, masks: Masks) -> Floats:
    """Weighted least squares of the masked rows in the even blocks."""
    return Moments.of(rows, even(rows, masks)).solved()[0]


def error(rows: ByClass, values: Floats, masks: Masks) -> float:
    """Mean over joints and sides of the log residual [log Nm] of the masked rows in the odd blocks."""
    logs = []
    for key, own in rows.items():
        used = masks[key] & ~own.even
        if used.sum() >= LEAST:
            residual = (own.torque - own.fitted(values))[used]
            logs.append(0.5 * float(np.log(np.mean(residual**2) + 1e-300)))
    return float(np.mean(logs)) if logs else 0.0
