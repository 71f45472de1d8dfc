"""Information matrices of any set of named parameters, assembled from one small Gram matrix per joint.

The observation matrix itself is never built. Joint j sees the same signals z_j (the regressor entries of the
bodies it carries, then qdd_j, qd_j, sign(qd_j), 1) in its joint row and in its motor row, without and with
payload; every entry of Omega^T W Omega is therefore a weighted sum of entries of the Gram matrices z_j^T z_j,
and so is its derivative.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit

from fri.errors import ConfigurationError
from ident.excitation.estimate import BODY, split_name
from ident.excitation.motion import Array

__all__ = ["Assembly", "Columns", "Rows"]

_DRIVE_SIGNAL = {"Ia": 0, "Fvl": 1, "Fvm": 1, "Fcl": 2, "Fcm": 2, "offl": 3, "offm": 3}
_JOINT_SIDE = ("Fvl", "Fcl", "offl")


@dataclass(frozen=True, eq=False)
class Columns:
    """Distinct regressor columns that some set of parameters needs, sorted by body.

    parameter (c,): 0 to 9 within the body; first (n + 1,): the columns of body b are first[b] to first[b +
    1]. A payload shares the frame, and so the columns, of the last body.
    """

    joints: int
    parameter: np.ndarray
    first: np.ndarray
    place: dict[tuple[int, int], int]

    @classmethod
    def of(cls, joints: int, names: Iterable[str]) -> Columns:
        """Columns that the named parameters need; names of links 1 .. n and of the payload n + 1."""
        wanted = set()
        for name in names:
            kind, link = split_name(name)
            if link > joints + 1 or (link == joints + 1 and kind not in BODY):
                raise ConfigurationError(
                    f"parameter {name}: an arm of {joints} joints and its payload have no such one"
                )
            if kind in BODY:
                wanted.add((min(link, joints) - 1, BODY.index(kind)))
        ordered = sorted(wanted)
        first = np.array([sum(body < b for body, _ in ordered) for b in range(joints + 1)], dtype=np.int64)
        parameter = np.array([index for _, index in ordered], dtype=np.int64)
        return cls(joints, parameter, first, {key: position for position, key in enumerate(ordered)})

    @property
    def tables(self) -> tuple[np.ndarray, np.ndarray]:
        """First column of each body and parameter of each column, as the sweeps take them."""
        return self.first, self.parameter

    @property
    def width(self) -> int:
        """Columns of z: the rigid ones and four drive signals."""
        return int(self.parameter.size) + 4


@dataclass(frozen=True, eq=False)
class Rows:
    """Which rows are stacked, and their weights.

    model : 1 joint rows, 2 motor and joint rows, 3 their difference
    sessions : for each session of the planned motion, whether the payload is mounted
    joint, motor (n,): weight of each row, 1/sigma² or 1; the difference rows of model 3 use `motor`
    """

    model: int
    sessions: tuple[bool, ...]
    joint: Array
    motor: Array

    def __post_init__(self) -> None:
        if self.model not in (1, 2, 3):
            raise ConfigurationError(f"model {self.model} is unknown; models 1, 2 and 3 exist")
        if not self.sessions:
            raise ConfigurationError("no session is planned; at least one is needed")

    @classmethod
    def unweighted(cls, joints: int, model: int = 2, sessions: Sequence[bool] = (False, True)) -> Rows:
        """All weights one, the paper's stacked matrix."""
        return cls(model, tuple(sessions), np.ones(joints), np.ones(joints))


class Assembly:
    """Omega^T W Omega of the named parameters as a linear function of the Gram matrices."""

    def __init__(self, columns: Columns, names: Sequence[str], rows: Rows) -> None:
        self.names = tuple(names)
        self.rows = rows
        split = [split_name(name) for name in names]
        joints = columns.joints
        rigid = columns.width - 4
        parameter: list[int] = []
        signal: list[int] = []
        weight: list[Array] = []
        offset, block = [0], [0]
        for joint in range(joints):
            active, place = [], []
            for index, (kind, link) in enumerate(split):
                if kind in BODY:
                    if min(link, joints) > joint and rows.model != 3:
                        active.append(index)
                        place.append(columns.place[min(link, joints) - 1, BODY.index(kind)])
                elif link == joint + 1:
                    active.append(index)
                    place.append(rigid + _DRIVE_SIGNAL[kind])
            table = np.zeros((len(active), len(active)))
            for loaded in rows.sessions:
                for side, value in self._sides(joint):
                    seen = np.array(
                        [self._seen(*split[index], joints, side, loaded) for index in active], dtype=float
                    )
                    table += value * np.outer(seen, seen)
            parameter += active
            signal += place
            weight.append(table.ravel())
            offset.append(offset[-1] + len(active))
            block.append(block[-1] + table.size)
        self._tables = (
            np.array(parameter, dtype=np.int64),
            np.array(signal, dtype=np.int64),
            np.concatenate(weight),
            np.array(offset, dtype=np.int64),
            np.array(block, dtype=np.int64),
        )

    def _sides(self, joint: int) -> list[tuple[str, float]]:
        joint_row, motor_row = (
            ("joint", float(self.rows.joint[joint])),
            ("motor", float(self.rows.motor[joint])),
        )
        return {1: [joint_row], 2: [joint_row, motor_row], 3: [("difference", motor_row[1])]}[self.rows.model]

    @staticmethod
    def _seen(kind: str, link: int, joints: int, side: str, loaded: bool) -> bool:
        if kind in BODY:
            return side != "difference" and (link <= joints or loaded)
        if kind in _JOINT_SIDE:
            return side != "difference"
        return side != "joint"

    def information(self, gram: Array) -> Array:
        """The matrix (p, p) from the Gram matrices (n, c, c)."""
        out = np.zeros((len(self.names), len(self.names)))
        _gather(gram, *self._tables, out)
        return out

    def adjoint(self, bar: Array, gram_bar: Array) -> None:
        """Add the derivative with respect to the Gram matrices of a function with derivative `bar` (p, p)."""
        _scatter(bar, *self._tables, gram_bar)


@njit(cache=True, error_model="numpy")
def _gather(gram, parameter, signal, weight, offset, block, out):  # type: ignore[no-untyped-def]
    for joint in range(offset.shape[0] - 1):
        start, stop = offset[joint], offset[joint + 1]
        k = block[joint]
        for a in range(start, stop):
            for b in range(start, stop):
                out[parameter[a], parameter[b]] += weight[k] * gram[joint, signal[a], signal[b]]
                k += 1


@njit(cache=True, error_model="numpy")
def _scatter(bar, parameter, signal, weight, offset, block, gram_bar):  # type: ignore[no-untyped-def]
    for joint in range(offset.shape[0] - 1):
        start, stop = offset[joint], offset[joint + 1]
        k = block[joint]
        for a in range(start, stop):
            for b in range(start, stop):
                gram_bar[joint, signal[a], signal[b]] += weight[k] * bar[parameter[a], parameter[b]]
                k += 1
