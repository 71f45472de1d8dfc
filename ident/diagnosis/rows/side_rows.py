"""Rows of one side of the arm: base regressor, torque, and which of them may be used."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d, minimum_filter1d

from ident.diagnosis.rows.recording import RecordStretch
from ident.diagnosis.rows.row_grid import RowGrid
from ident.diagnosis.settings import DiagnosisSettings
from ident.dynamics.base_set import BaseSet
from ident.dynamics.structure import DriveMotion, ModelStructure, Side
from ident.effects.motion import ArmMotion, Floats
from ident.rows.binned import Motion, binned_regressor, bins
from ident.rows.reversals import ringing
from lwr_driver.session.spool import Arena, column

# Least share of a low-passed row from samples of a moving joint.
_KNOWN = 0.8


@dataclass(frozen=True, eq=False)
class SideRows:
    """Rows of one side, all sessions, in the order of time.

    matrix : (n, m, p) base regressor by joint; target : (m, n) [Nm]; valid : (m, n).
    session : (m,) number; time : (m,) [s]; test : (m,) held-out rows.
    """

    matrix: Floats
    target: Floats
    valid: NDArray[np.bool_]
    session: NDArray[np.int64]
    time: Floats
    test: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class RowMaker:
    """Makes the rows of motions. moving : (n,) joints with rows."""

    grid: RowGrid
    settings: DiagnosisSettings
    structure: ModelStructure
    base: BaseSet
    moving: NDArray[np.bool_]

    def make(self, side: str, motions: Sequence[ArmMotion], before: SideRows | None) -> SideRows:
        """The rows of a side, in place of those `before` where only the drives move otherwise."""
        columns = np.asarray(self.base.columns)
        places = np.arange(len(columns))
        if before is not None:
            places = np.flatnonzero([self.structure.of_drive(column) for column in columns])
        grid = self.grid
        parts: list[tuple[Any, ...]] = []
        matrices: list[Callable[[], Floats]] = []
        for number, motion in enumerate(motions):
            if not grid.holds(side, number):
                continue
            recording, stretch = grid.stretches[number]
            sampling = grid.sampling(side, number)
            at, width = sampling.at, sampling.width
            if side == "motor":
                target, usable, speed = stretch.motor, stretch.motor_usable, motion.motor_speed
            else:
                target, usable, speed = stretch.effort, stretch.usable, motion.qd
            moves = self._moves(stretch, speed, at, drives=side == "motor")
            chosen = grid.chosen(side, number)
            matrices.append(partial(self._matrix, columns[places], side, number, motion))
            torque = grid.slow(side, number, bins(target, width))
            if grid.band_hz[side] is not None:
                # The columns pass through the same low-pass, so rounded reversals cancel; only longer rests are
                # unknown.
                valid = grid.slow(side, number, bins((usable & moves).astype(float), width)) > _KNOWN
            else:
                moves = _whole(moves, width)
                if side == "joint":
                    # The positions' low-pass rounds the corner made by the link's Coulomb friction.
                    span = max(at[-1] - at[0], 1e-9)
                    moves = _guarded(moves, round(self.settings.guard_s * len(moves) / span))
                valid = _whole(usable, width) & moves
            session, test = (np.full(int(chosen.sum()), v) for v in (recording.number, recording.test))
            stamps = grid.stamps(side, number)[chosen]
            parts.append((torque[chosen], (valid & self.moving)[chosen], session, stamps, test))
        others = [np.concatenate(part) for part in zip(*parts, strict=True)]
        # One stretch in memory at a time.
        shape = (self.structure.chain.n, len(others[0]), len(self.base))
        matrix = Arena().room(shape) if before is None else before.matrix
        first, own = 0, slice(None) if before is None else places
        for (torque, *_), make in zip(parts, matrices, strict=True):
            matrix[:, first : first + len(torque), own] = make()
            first += len(torque)
        return SideRows(matrix, *others)

    def _matrix(self, columns: NDArray[np.int64], side: str, number: int, motion: ArmMotion) -> Floats:
        """(n, m, k) regressor of some columns in the rows in use of one motion and side, the drives at the motors' own
        motion."""
        sampling, chosen = self.grid.sampling(side, number), self.grid.chosen(side, number)
        at, width, low_passed = sampling.at, sampling.width, self.grid.band_hz[side] is not None
        if not low_passed:
            # The rows in use alone.
            at = at[: len(at) // width * width].reshape(-1, width)[chosen].reshape(-1)
        recording, stretch = self.grid.stretches[number]
        exact = _on_grid(stretch.time, at) if len(at) else None
        signals = (
            motion.q,
            motion.qd,
            motion.qdd,
            motion.motor_speed,
            motion.motor_acceleration,
            motion.direction,
        )
        q, qd, qdd, *drive = (x[exact] if exact is not None else _at(stretch.time, x, at) for x in signals)
        of: Side = "motor" if side == "motor" else "joint"
        state = Motion(q, qd, qdd, DriveMotion(*drive) if side == "motor" else None)
        wide = binned_regressor(self.structure, columns, state, recording.payload, of, width)
        if not low_passed:
            return wide
        return np.stack([self.grid.slow(side, number, table) for table in wide])[:, chosen]

    def _moves(self, stretch: RecordStretch, speed: Floats, at: Floats, *, drives: bool) -> NDArray[np.bool_]:
        """Whether joints move in one direction for a while before and after times (m,), away from rest, (m, n).

        drives : whether it has to be a motion of the drives and not a ringing of their links.
        """
        dt = float(stretch.time[1] - stretch.time[0])
        least = self.settings.standstill_rad_s
        size = 2 * round(self.settings.reversal_s / dt) + 1
        # The low-pass of the positions spreads a start or a stop by half a period of its cut-off to either side.
        wide = 2 * round(0.5 / self.settings.signals.cutoff / dt) + 1
        found = np.empty((len(at), speed.shape[1]), dtype=bool)
        for joint in range(speed.shape[1]):
            # One joint of a long session at a time.
            own = column(speed, joint)
            steady = (minimum_filter1d(own, size) > 0.0) | (maximum_filter1d(own, size) < 0.0)
            rests = maximum_filter1d(np.abs(own), wide) <= least
            steady &= ~maximum_filter1d(rests, 2 * wide - 1)
            if drives:
                steady &= ~ringing(own, dt)
            moves = np.abs(_at(stretch.time, own[:, None], at)) > least
            found[:, joint] = (moves & (_at(stretch.time, steady[:, None].astype(float), at) > 0.999))[:, 0]
        return found


def _whole(flags: NDArray[np.bool_], width: int) -> NDArray[np.bool_]:
    """Whether all `width` samples of a bin are set, (m, n) of (N, n)."""
    count = len(flags) // width
    return np.asarray(flags[: count * width].reshape(count, width, *flags.shape[1:]).all(axis=1))


def _guarded(moves: NDArray[np.bool_], rows: int) -> NDArray[np.bool_]:
    """The same (m, n) without the neighbours of rows that are not set."""
    out = moves.copy()
    for k in range(1, rows + 1):
        out[k:] &= moves[:-k]
        out[:-k] &= moves[k:]
    return out


def _on_grid(grid: Floats, at: Floats) -> NDArray[np.int64] | None:
    """Indices of the grid at the times, if these all fall on it."""
    dt = float(grid[1] - grid[0])
    place = (at - grid[0]) / dt
    nearest = np.rint(place).astype(np.int64)
    inside = nearest.min() >= 0 and nearest.max() < len(grid)
    return nearest if inside and np.max(np.abs(place - nearest)) < 1e-4 else None


def _at(grid: Floats, values: Floats, at: Floats) -> Floats:
    """Values (N, k) of the grid at other times by linear interpolation; ends are held."""
    exact = _on_grid(grid, at) if len(at) else None
    if exact is not None:
        return values[exact]
    place = np.clip((at - grid[0]) / (grid[1] - grid[0]), 0.0, len(grid) - 1.000001)
    low = place.astype(np.int64)
    share = (place - low)[:, None]
    return (1.0 - share) * values[low] + share * values[low + 1]
