"""The fitted rows of a nominal arm in blocks of time, and the products of their base columns, before any noise."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from fri.errors import DataError
from ident.diagnosis.gain.products import Floats, Key
from ident.diagnosis.rows.nominal import Nominal
from ident.diagnosis.rows.side_rows import SideRows
from ident.diagnosis.settings import DiagnosisSettings
from lwr_driver.session.spool import Arena


@dataclass(frozen=True, eq=False)
class JointRows:
    """Rows of one joint and side in the order of the blocks, zero where they are not used.

    columns : (r, k) of the base, the `acting` (k,) ones. target : (r, 1). mask : (r,) the used rows, `count` of them.
    gram, moment, energy : products (blocks, k, k), (blocks, k) and (blocks,) of columns and target in each block.
    """

    columns: Floats
    acting: NDArray[np.int64]
    target: Floats
    mask: NDArray[np.bool_]
    count: float
    gram: Floats
    moment: Floats
    energy: Floats


class FittedRows:
    """Rows of all sides in blocks of time, the same on all sides, and the part of the motion of each.

    before : those of the same arm with other predictions; what these leave as it was is taken from there.
    """

    def __init__(
        self, nominal: Nominal, settings: DiagnosisSettings, before: FittedRows | None = None
    ) -> None:
        self._layout(nominal, settings)
        self._arena = Arena()
        self.sides = dict(nominal.rows)
        self.keys: dict[Key, JointRows] = {}
        for side, rows in self.sides.items():
            kept = before.keys if before is not None and before.sides[side] is rows else {}
            for key in ((side, joint) for joint in range(nominal.arm.chain.n)):
                self.keys[key] = kept[key] if kept else self._joint_rows(rows, key)

    def _layout(self, nominal: Nominal, settings: DiagnosisSettings) -> None:
        numbers: dict[tuple[int, int], int] = {}
        folds: list[int] = []
        start = {r.number: r.start_s for r in nominal.recordings}
        period = {r.number: r.period_s for r in nominal.recordings}
        # A motion without repetition gives half as long a block, for enough of them.
        parts = {r.number: (2.0 if r.repeats else 4.0) * settings.folds for r in nominal.recordings}
        length = {r.number: min(settings.block_s, r.period_s / parts[r.number]) for r in nominal.recordings}
        ids: dict[str, NDArray[np.int64]] = {}
        for side, rows in nominal.rows.items():
            found = np.full(len(rows.time), -1)
            for session in np.unique(rows.session[~rows.test]).tolist():
                mine = np.flatnonzero(~rows.test & (rows.session == session))
                since = rows.time[mine] - start[session]
                within = (since / length[session]).astype(np.int64)
                blocks, first, place = np.unique(within, return_index=True, return_inverse=True)
                known = np.empty(len(blocks), dtype=np.int64)
                # In the order of time, as they are met.
                for k in np.argsort(first, kind="stable"):
                    block = (session, int(blocks[k]))
                    if block not in numbers:
                        numbers[block] = len(numbers)
                        phase = since[first[k]] % period[session]
                        folds.append(int(phase / length[session]) % settings.folds)
                    known[k] = numbers[block]
                found[mine] = known[place]
            ids[side] = found
        self.blocks = len(numbers)
        self.block_session = np.array([session for session, _ in numbers], dtype=np.int64)
        self.block_start = np.array([start[k] + b * length[k] for k, b in numbers])
        self.fold = np.array(folds, dtype=np.int64)
        self.parts = (np.unique(self.fold)[:, None] == self.fold).astype(float)
        if len(set(folds)) < 2:
            raise DataError("the sessions are too short to hold a part of them back; record at least 5 s")
        self.block = ids
        self.order: dict[str, slice | NDArray[np.int64]] = {}
        self.starts: dict[str, NDArray[np.int64]] = {}
        for side, found in ids.items():
            fitted = np.flatnonzero(found >= 0)
            order = fitted[np.argsort(found[fitted], kind="stable")]
            even = len(order) > 0 and bool(np.all(np.diff(order) == 1))
            self.order[side] = slice(int(order[0]), int(order[-1]) + 1) if even else order
            counts = np.bincount(found[fitted], minlength=self.blocks)
            self.starts[side] = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)

    def _joint_rows(self, rows: SideRows, key: Key) -> JointRows:
        side, j = key
        keep, order = rows.valid[:, j] & ~rows.test, self.order[side]
        wide = np.where(keep[:, None], rows.matrix[j], 0.0)
        # Most base columns do not act on most joints.
        acting = np.flatnonzero(np.any(wide != 0.0, axis=0))
        columns = self._arena.keep(wide[order][:, acting])
        target = np.where(keep, rows.target[:, j], 0.0)[order, None]
        gram, moment = np.empty((self.blocks, len(acting), len(acting))), np.empty((self.blocks, len(acting)))
        energy = np.empty(self.blocks)
        for block, (first, last) in enumerate(pairwise(self.starts[side].tolist())):
            own, torque = columns[first:last], target[first:last, 0]
            gram[block], moment[block], energy[block] = own.T @ own, own.T @ torque, torque @ torque
        mask, count = np.ascontiguousarray(keep[order]), float(keep.sum())
        return JointRows(columns, acting, target, mask, count, self._arena.keep(gram), moment, energy)
