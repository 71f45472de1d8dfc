"""Parts of a motion that fit into the processor's cache, and their shares of the rows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.sparse import csr_array

from ident.effects.motion import ArmMotion, Floats


@dataclass(frozen=True, eq=False)
class Gather:
    """A part of an operator: rows from `first` on, made from samples of a part of a motion (CSR)."""

    first: int
    starts: NDArray[np.int32]
    samples: NDArray[np.int32]
    weights: Floats

    def add(self, values: Floats, rows: Floats) -> None:
        """Add what samples (N,) or (N, k) contribute to rows (m,) or (m, k)."""
        here = rows[self.first : self.first + len(self.starts) - 1]
        if values.ndim == 1:
            _add_one(self.starts, self.samples, self.weights, values, here)
        else:
            _add_many(self.starts, self.samples, self.weights, values, here)

    def add_hats(self, place: Floats, factor: Floats, rows: Floats) -> None:
        """Add what hat functions times a factor (N,) contribute to rows (m, knots), at the places (N,) between knots;
        two of them are not zero."""
        here = rows[self.first : self.first + len(self.starts) - 1]
        _add_hats(self.starts, self.samples, self.weights, place, factor, here)


@dataclass(frozen=True, eq=False)
class Piece:
    """A part of a motion and its share of the rows of each side."""

    motion: ArmMotion
    gathers: dict[str, Gather]


def gather(operator: Any) -> Gather:
    """The rows that are not empty of an operator (m, N), which are neighbours."""
    matrix = csr_array(operator)
    full = np.flatnonzero(np.diff(matrix.indptr))
    first, last = (int(full[0]), int(full[-1]) + 1) if len(full) else (0, 0)
    starts = matrix.indptr[first : last + 1].astype(np.int32)
    return Gather(first, starts, matrix.indices.astype(np.int32), matrix.data)


@njit(cache=True, nogil=True)
def _add_one(starts, samples, weights, values, rows):  # type: ignore[no-untyped-def]
    for row in range(len(starts) - 1):
        total = 0.0
        for k in range(starts[row], starts[row + 1]):
            total += weights[k] * values[samples[k]]
        rows[row] += total


@njit(cache=True, nogil=True)
def _add_many(starts, samples, weights, values, rows):  # type: ignore[no-untyped-def]
    for row in range(len(starts) - 1):
        for k in range(starts[row], starts[row + 1]):
            for own in range(values.shape[1]):
                rows[row, own] += weights[k] * values[samples[k], own]


@njit(cache=True, nogil=True)
def _add_hats(starts, samples, weights, place, factor, rows):  # type: ignore[no-untyped-def]
    last = rows.shape[1] - 2
    for row in range(len(starts) - 1):
        for k in range(starts[row], starts[row + 1]):
            at = samples[k]
            knot = min(int(place[at]), last)
            share = place[at] - knot
            rows[row, knot] += weights[k] * ((1.0 - share) * factor[at])
            rows[row, knot + 1] += weights[k] * (share * factor[at])
