"""Least-squares data of long records in constant memory: one small matrix for each joint and session.

All columns of the rows of joint j, motor and joint side alike, are made of few distinct signals (*atoms*):
the rigid columns of the links j..n, qdd, qd, sign(qd), 1, and the measured torques. One Gram matrix (or
triangular factor) of the atoms of a joint therefore holds W'W, W'y and y'y of each of its sides at once,
whatever columns are selected and however the sides are weighted afterwards. A stream of blocks passes once;
weights may change without another pass.

**Gram or triangle.** "gram" adds D'D in float64. It squares the condition number, so solutions lose cond^2 x
1e-16 of relative accuracy, and a residual variance is not seen below 1e-16 of the mean square torque. The
column-scaled condition numbers of usable experiments are below 1e3 (10 for an optimised one, 2000 for the
worst recordings known of this arm), so 1e-10 at worst, while torque noise is at 1e-3. "qr" updates the
triangular factor of each joint's atoms by Householder reflections (tall-skinny QR: Golub and Van Loan,
section 5.2), backward stable, at 2.5 times the cost: use it for noise-free data or near-singular motions. For
Model 2 of seven joints on 102 columns a sample (14 rows) costs 0.8 and 2 us on one core, of which 0.4 us are
the atoms.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import lapack

from fri.errors import ConfigurationError, DataError
from ident.parameters import INERTIAL
from ident.regressor import Floats, check_states, fill_rigid
from ident.structure import ModelStructure, Samples, Side

__all__ = ["Accumulation", "Normal", "solve_normal"]

_BLOCK = 4096
_TORQUES = ("motor", "joint")


@dataclass(frozen=True, eq=False)
class Normal:
    """Least-squares data of the rows of one joint and side (or any sum of such).

    gram : (b, b) W'W. moment : (b,) W'y. square : y'y. rows : number of rows.
    """

    gram: Floats
    moment: Floats
    square: float
    rows: int

    def __add__(self, other: Normal) -> Normal:
        return Normal(
            self.gram + other.gram,
            self.moment + other.moment,
            self.square + other.square,
            self.rows + other.rows,
        )

    def scaled(self, weight: float) -> Normal:
        """The same with rows weighted by sqrt(weight) (the row count stays)."""
        return Normal(weight * self.gram, weight * self.moment, weight * self.square, self.rows)

    def sum_of_squares(self, values: ArrayLike) -> float:
        """||y - W x||^2 for parameter values x (b,)."""
        x = np.asarray(values, dtype=np.float64)
        return float(self.square - 2.0 * self.moment @ x + x @ self.gram @ x)


class Accumulation:
    """Least-squares data of a model's columns over a stream of samples.

    structure : the model. columns : (b,) columns wanted, usually those of a base set.
    factor : "gram" or "qr" (see the module).

    `add` takes samples of one session in pieces of any size; sessions are told apart by a number, so that
    their residuals can be looked at one by one. A result is asked by side, joint and session.
    """

    def __init__(
        self, structure: ModelStructure, columns: ArrayLike, *, factor: Literal["gram", "qr"] = "gram"
    ) -> None:
        if factor not in ("gram", "qr"):
            raise ConfigurationError(f"factor {factor!r} is neither `gram` nor `qr`")
        self.structure = structure
        self.columns = np.asarray(columns, dtype=np.int64)
        self.factor = factor
        n = structure.chain.n
        needed = np.zeros((n, len(INERTIAL)), dtype=bool)
        for payload in (None, *structure.payloads):
            for column in self.columns:
                source = structure.rigid_of(int(column), payload)
                if source is not None:
                    needed[source] = True
        self._rigid = np.where(needed, np.cumsum(needed).reshape(needed.shape) - 1, -1).astype(np.int64)
        self._n_rigid = int(needed.sum())
        # Atoms of joint j start with the first rigid one of link j: earlier links do not act on it.
        self._first = [int(needed[:j].sum()) for j in range(n)]
        self._n_atoms = self._n_rigid + structure.n_signals
        self._data: dict[tuple[int, int], Floats] = {}
        self._payload: dict[int, str | None] = {}
        self._measured: dict[int, tuple[bool, bool]] = {}
        self._count: dict[int, int] = {}
        self._buffer = np.zeros((0, 0, 0))

    @property
    def n_atoms(self) -> int:
        """Number of atoms: rigid columns, then qdd, qd, sign(qd), 1, then three for each coupling."""
        return self._n_atoms

    @property
    def sessions(self) -> tuple[int, ...]:
        """Numbers of the sessions added so far, in order."""
        return tuple(sorted(self._count))

    def atoms(self, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike) -> Floats:
        """The atoms (n_atoms, n, N) of samples (N, n), for filtering and decimation before `add_atoms`."""
        states = check_states(self.structure.chain, q, qd, qdd)
        out = np.zeros((self._n_atoms, self.structure.chain.n, len(states[0])))
        self._write_atoms(*states, out)
        return out

    def add(self, samples: Samples, *, session: int = 0) -> None:
        """Add samples of a session; they may come in pieces.

        Raises DataError for arrays that do not fit, for torques that are not finite, and when a session
        changes its payload or its channels.
        """
        states = check_states(self.structure.chain, samples.q, samples.qd, samples.qdd)
        count = len(states[0])
        torques = self._torques(samples, count)
        self._open(session, samples)
        n, extra = self.structure.chain.n, sum(t is not None for t in torques)
        for start in range(0, count, _BLOCK):
            part = slice(start, min(start + _BLOCK, count))
            size = part.stop - part.start
            shape = (self._n_atoms + extra, n, size)
            if self._buffer.shape != shape:
                self._buffer = np.zeros(shape)
            block = self._buffer
            q, qd, qdd = (state[part] for state in states)
            self._write_atoms(q, qd, qdd, block[: self._n_atoms])
            row = self._n_atoms
            for torque in torques:
                if torque is not None:
                    block[row] = torque[part].T
                    row += 1
            self._absorb(session, block)
        self._count[session] += count

    def add_atoms(self, atoms: Floats, samples: Samples, *, session: int = 0) -> None:
        """Add rows from atoms (n_atoms, n, N) that were filtered like the torques of `samples` (N, n).

        Only the torques and the payload of `samples` are used. A buffer of `atoms` is not kept.
        """
        count = atoms.shape[-1]
        if atoms.shape != (self._n_atoms, self.structure.chain.n, count):
            expected = (self._n_atoms, self.structure.chain.n)
            raise DataError(f"atoms have shape {atoms.shape}; expected {expected} and the samples")
        torques = [t.T[None] for t in self._torques(samples, count) if t is not None]
        self._open(session, samples)
        self._absorb(session, np.concatenate([atoms, *torques]))
        self._count[session] += count

    def normal(self, side: Side, joint: int, session: int | None = None) -> Normal:
        """Least-squares data of the rows of a side and joint (from 0), of one session or of all that have the
        side.

        Rows and columns are those of `columns`. A side that was not measured gives zero rows.
        """
        size = len(self.columns)
        total = Normal(np.zeros((size, size)), np.zeros(size), 0.0, 0)
        for number in self.sessions if session is None else (session,):
            selected = self._selection(side, joint, number)
            if selected is None:
                continue
            columns, weights, target = selected
            data = self._data[number, joint]
            if self.factor == "qr":
                matrix, y = data @ weights, data @ target
                gram, moment, square = matrix.T @ matrix, matrix.T @ y, y @ y
            else:
                gram = weights.T @ data @ weights
                moment, square = weights.T @ data @ target, target @ data @ target
            full, vector = np.zeros((size, size)), np.zeros(size)
            full[np.ix_(columns, columns)] = gram
            vector[columns] = moment
            total = total + Normal(full, vector, float(square), self._count[number])
        return total

    def triangle(self, side: Side, joint: int, session: int | None = None) -> tuple[Floats, int]:
        """Upper triangular R (b + 1, b + 1) with R'R = [W y]'[W y] of a side and joint, and the number of
        rows.

        With factor "qr" it is accurate to rounding; with "gram" to its square root.
        """
        size, parts, rows = len(self.columns), [], 0
        for number in self.sessions if session is None else (session,):
            selected = self._selection(side, joint, number)
            if selected is None:
                continue
            columns, weights, target = selected
            root = self._root(self._data[number, joint])
            part = np.zeros((len(root), size + 1))
            part[:, columns] = root @ weights
            part[:, size] = root @ target
            parts.append(part)
            rows += self._count[number]
        stack = np.concatenate([*parts, np.zeros((size + 1, size + 1))])
        return np.asarray(np.linalg.qr(stack, mode="r")), rows

    # ---- inside ----

    def _write_atoms(self, q: Floats, qd: Floats, qdd: Floats, out: NDArray[np.float64]) -> None:
        if self._n_rigid:
            fill_rigid(self.structure.chain, q, qd, qdd, self._rigid, out[:, None])
        self.structure.signals(qd, qdd, out[self._n_rigid :])

    def _torques(self, samples: Samples, count: int) -> tuple[Floats | None, Floats | None]:
        self.structure.measured(samples)
        checked: list[Floats | None] = []
        for name in _TORQUES:
            torque = getattr(samples, name)
            if torque is not None:
                torque = np.asarray(torque, dtype=np.float64)
                if torque.shape != (count, self.structure.chain.n):
                    raise DataError(
                        f"{name} torque has shape {torque.shape}; expected {(count, self.structure.chain.n)}"
                    )
                if not np.all(np.isfinite(torque)):
                    row, joint = np.argwhere(~np.isfinite(torque))[0]
                    raise DataError(
                        f"{name} torque of joint {self.structure.chain.joint_names[joint]} is not finite at "
                        f"sample {row}; remove or interpolate such samples first"
                    )
            checked.append(torque)
        return checked[0], checked[1]

    def _open(self, session: int, samples: Samples) -> None:
        measured = (samples.motor is not None, samples.joint is not None)
        self.structure.payload_link(samples.payload)
        if session not in self._count:
            self._count[session] = 0
            self._payload[session], self._measured[session] = samples.payload, measured
        if (self._payload[session], self._measured[session]) != (samples.payload, measured):
            raise DataError(f"session {session} changes its payload or its channels; give it another number")

    def _absorb(self, session: int, block: Floats) -> None:
        for joint in range(self.structure.chain.n):
            data = block[self._first[joint] :, joint]
            key = (session, joint)
            if self.factor == "gram":
                gram = data @ data.T
                self._data[key] = self._data[key] + gram if key in self._data else gram
                continue
            before = self._data.get(key)
            rows = data.T if before is None else np.concatenate([before.T, data], axis=1).T
            self._data[key] = _triangle(rows)

    def _root(self, data: Floats) -> Floats:
        """A matrix whose Gram matrix is that of the atoms."""
        if self.factor == "qr":
            return data
        scale = np.sqrt(np.diag(data))
        scale[scale == 0.0] = 1.0
        values, vectors = np.linalg.eigh(data / np.outer(scale, scale))
        return (np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T) * scale

    def _selection(
        self, side: Side, joint: int, session: int
    ) -> tuple[NDArray[np.int64], Floats, Floats] | None:
        """The `columns` that act, their weights on the joint's atoms (m, k) and the torque's (m,)."""
        if session not in self._count:
            raise ConfigurationError(f"no session {session} was added; sessions: {self.sessions}")
        motor, sensor = self._measured[session]
        if not {"motor": motor, "joint": sensor, "difference": motor and sensor}[side]:
            return None
        first, atoms = self._first[joint], self._n_atoms
        size = atoms - first + motor + sensor
        columns, places = [], []
        for k, column in enumerate(self.columns):
            place = None
            rigid = self.structure.rigid_of(int(column), self._payload[session])
            if rigid is not None:
                place = int(self._rigid[rigid]) if side != "difference" and rigid[0] >= joint else None
            else:
                signal = self.structure.signal_of(int(column), side, joint)
                place = None if signal is None else self._n_rigid + signal
            if place is not None:
                columns.append(k)
                places.append(place - first)
        weights = np.zeros((size, len(columns)))
        weights[places, np.arange(len(columns))] = 1.0
        target = np.zeros(size)
        if side != "joint":
            target[atoms - first] = 1.0
        if side != "motor":
            target[atoms - first + motor] = 1.0 if side == "joint" else -1.0
        return np.array(columns, dtype=np.int64), weights, target


def _triangle(rows: Floats) -> Floats:
    """R of the QR factorisation of (m, k) rows: (min(m, k), k), by LAPACK without forming Q."""
    factored, _, _, status = lapack.dgeqrf(np.asfortranarray(rows), overwrite_a=True)
    assert status == 0
    return np.triu(factored[: min(rows.shape)])


def solve_normal(parts: Sequence[Normal], weights: Sequence[float]) -> tuple[Floats, Floats]:
    """Weighted least squares (14) from parts: parameters (b,) and the inverse of the weighted Gram matrix.

    Columns are scaled to unit norm before the Cholesky factorisation. Raises DataError when the matrix is
    singular.
    """
    gram = sum((w * part.gram for w, part in zip(weights, parts, strict=True)), np.zeros_like(parts[0].gram))
    moment = sum((w * part.moment for w, part in zip(weights, parts, strict=True)), np.zeros(len(gram)))
    scale = np.sqrt(np.diag(gram))
    scale = np.where(scale > 0.0, scale, 1.0)
    factor, status = lapack.dpotrf(gram / np.outer(scale, scale), lower=True)
    if status != 0:
        raise DataError(
            f"the normal equations are singular at column {status}; excite more, or use the base columns"
        )
    inverse, _ = lapack.dpotri(factor, lower=True)
    covariance = (np.tril(inverse) + np.tril(inverse, -1).T) / np.outer(scale, scale)
    return covariance @ moment, covariance
