"""Rows at the full band of a channel: means over short bins of neighbouring samples.

A mean acts on torque and regressor alike, so it adds no bias. A row depends on the samples of its bin only: a
reversal or a lost sample spoils few rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ident.dynamics.parameters import Floats
from ident.dynamics.structure import Coulomb, DriveMotion, ModelStructure, Side
from ident.rows.filters import block_means, median_step, resampled
from ident.rows.prepared import PreparedSession, TorqueChannel

_CHUNK = 500


@dataclass(frozen=True)
class BinnedRows:
    """Rows of one side of one session in the order of time.

    matrix : (n, m, C) by joint. torque, speed : (m, n) [Nm, rad/s]. known : (m, n), bins of known samples only.
    measured : (m, n), bins without a flagged sample, beside reversals too. time : (m,) [s]. samples : (N, n) speed
    of each sample; width : samples in a bin.
    """

    side: Side
    matrix: Floats
    torque: Floats
    speed: Floats
    known: NDArray[np.bool_]
    measured: NDArray[np.bool_]
    time: Floats
    samples: Floats
    width: int

    def turned(self, law: Coulomb) -> Floats:
        """Coulomb column (m, n) of a friction law."""
        return bins(law(self.samples), self.width)


def bins(values: Floats, width: int) -> Floats:
    """Means (m, k) over `width` samples of (N, k); a remainder at the end is left out."""
    return values if width == 1 else block_means(values, width)


class Motion(NamedTuple):
    """Motion (N, n) at the samples of a torque; drive : of the motors where it differs."""

    q: Floats
    qd: Floats
    qdd: Floats
    drive: DriveMotion | None = None


def binned_regressor(
    structure: ModelStructure,
    columns: NDArray[np.int64],
    motion: Motion | TorqueChannel,
    payload: str | None,
    side: Side,
    width: int,
) -> Floats:
    """Regressor (n, m, C) of a motion in bins of `width` samples."""
    n, count = structure.chain.n, len(motion.q) // width * width
    size = max(width, _CHUNK // width * width)
    found = np.zeros((n, count // width, len(columns)))
    memory = np.zeros((len(columns), 1, n, size))
    for first in range(0, count, size):
        some = slice(first, min(first + size, count))
        wide = structure.regressor(
            motion.q[some],
            motion.qd[some],
            motion.qdd[some],
            payload=payload,
            sides=(side,),
            columns=columns,
            drive=None if motion.drive is None else motion.drive.at(some),
            out=memory if some.stop - first == size else None,
        )
        _add_means(wide.T.reshape(len(columns), n, -1), width, found[:, first // width :])
    return found


# The order of a sum is free, so that the compiler may vectorise it.
@njit(cache=True, nogil=True, fastmath={"reassoc"})
def is_zero(series):  # type: ignore[no-untyped-def]
    """Whether all of (N,) values are zero, as in two thirds of a regressor: sums pass over them."""
    if len(series) and series[0] != 0.0:
        return False
    size = 0.0
    for k in range(len(series)):
        size += abs(series[k])
    return size == 0.0


@njit(cache=True, nogil=True, fastmath={"reassoc"})
def _add_means(table, width, out):  # type: ignore[no-untyped-def]
    """Add means over `width` samples of (C, n, N) to (n, >= N / width, C)."""
    columns, joints, samples = table.shape
    share = 1.0 / width
    for j in range(joints):
        for c in range(columns):
            series = table[c, j]
            if is_zero(series):
                continue
            for row in range(samples // width):
                total = 0.0
                for k in range(row * width, (row + 1) * width):
                    total += series[k]
                out[j, row, c] += share * total


def observe_bins(
    session: PreparedSession,
    payload: str | None,
    structure: ModelStructure,
    columns: Sequence[int] | NDArray[np.int64],
    bin_s: float,
) -> list[BinnedRows]:
    """Rows of all sides of one session, one entry for each passage and side with samples."""
    found = []
    chosen = np.asarray(columns, dtype=np.int64)
    for passage in session.passages:
        for side in structure.sides:
            channel = passage.joint if side == "joint" else passage.motor
            if (
                channel is None
                or (side == "joint" and not passage.joint_valid.any())
                or len(channel.times) < 2
            ):
                continue
            inside = (channel.times >= passage.rows[0]) & (channel.times <= passage.rows[-1])
            some = channel.at(inside)
            if len(some.times) < 2:
                continue
            width = max(1, round(bin_s / median_step(some.times)))
            torque = some.torque
            if side == "difference":
                torque = torque - resampled(passage.joint.times, passage.joint.torque, some.times)
            found.append(
                BinnedRows(
                    side,
                    binned_regressor(structure, chosen, some, payload, side, width),
                    bins(torque, width),
                    bins(some.qd, width),
                    bins(some.known.astype(float), width) > 1.0 - 1e-9,
                    bins((~some.flagged).astype(float), width) > 1.0 - 1e-9,
                    bins(some.times[:, None], width)[:, 0],
                    some.qd,
                    width,
                )
            )
    return found
