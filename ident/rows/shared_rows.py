"""Rows that two logs share, to the last bit or to four digits: a copy under another name or at other times, or a part.

A row has a number, and a log is known by its smallest numbers: they are a fair sample of its rows (Broder, 1997), small
enough for a model file.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ident.dynamics.parameters import Floats
from lwr_driver.session import Session

Numbers = NDArray[np.uint64]

# Share of the rows of two logs from which they are one recording.
SAME_ROWS = 0.2
ROUNDED = 1e-4
"""Largest change of a value by rounding, as a share of its column's range: four digits."""
# Width of the cells in which equal rows are sought, over that change.
_CELL = 10.0
# Numbers that stand for a log; least rows in motion that stand for all.
_MARKS, _MOVING = 64, 100


def row_numbers(session: Session) -> Numbers:
    """Sorted numbers of 64 bits of the rows in motion, equal for rows with equal positions and torques."""
    columns = _columns(session)
    found, moving = _numbers(columns), np.ones(len(columns[0]), dtype=bool)
    moving[:1] = False
    for column in columns:
        moving[1:] &= column[1:] != column[:-1]
    return np.unique(found[moving] if moving.sum() > _MOVING else found)


def _columns(session: Session) -> list[Floats]:
    """Positions and torques (n,) of the joints; the motors' torques where there are no others."""
    sides = [session.joint.position, session.joint.effort]
    if session.motor is not None and not session.joint.effort.size:
        sides = [session.motor.effort]
    return [column for values in sides for column in values.T]


def _numbers(columns: Sequence[Floats]) -> Numbers:
    """Numbers (n,) of rows of columns (n,), by the finaliser of splitmix64 (Steele, Lea and Flood, 2014)."""
    found = np.zeros(len(columns[0]), dtype=np.uint64)
    for column in columns:
        bits = np.ascontiguousarray(column).view(np.uint64) ^ (found * np.uint64(0x9E3779B97F4A7C15))
        bits = (bits ^ (bits >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        bits = (bits ^ (bits >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        found = bits ^ (bits >> np.uint64(31))
    return found


class Cells:
    """The rows of logs in cells of the first one's ranges, made once a log: pairs of them are compared."""

    def __init__(self, first: Session) -> None:
        self._first = first
        self._known: dict[int, tuple[Numbers, NDArray[np.intp]]] = {}

    @cached_property
    def _scales(self) -> list[float]:
        return [ROUNDED * float(np.ptp(column)) for column in _columns(self._first)]

    def shared(self, a: Session, b: Session) -> float:
        """Share of the rows of the shorter log that are in the other to four digits of each column's range.

        Two measurements of one motion differ by the noise of all sensors, which is more.
        """
        sides = _columns(a), _columns(b)
        moving = [k for k, scale in enumerate(self._scales) if scale > 0.0]
        if not moving or {len(self._scales)} != {len(columns) for columns in sides}:
            return 0.0
        (one, places), (other, others) = (
            self._of(session, columns, moving) for session, columns in zip((a, b), sides, strict=True)
        )
        _, first, second = np.intersect1d(one, other, assume_unique=True, return_indices=True)
        alike = np.ones(len(first), dtype=bool)
        for k in moving:
            alike &= np.abs(sides[0][k][places[first]] - sides[1][k][others[second]]) <= self._scales[k]
        return float(np.count_nonzero(alike)) / min(len(one), len(other))

    def _of(
        self, session: Session, columns: Sequence[Floats], moving: Sequence[int]
    ) -> tuple[Numbers, NDArray[np.intp]]:
        """Sorted numbers of the cells of a log, and a row in each. Wide cells, so that few rows are rounded into the
        next one."""
        if id(session) not in self._known:
            cells = _numbers([np.floor(columns[k] / (_CELL * self._scales[k])) + 0.0 for k in moving])
            self._known[id(session)] = np.unique(cells, return_index=True)
        return self._known[id(session)]


def shared(a: Numbers, b: Numbers) -> float:
    """Share of the rows of the shorter log found in the other, from the numbers of both or the smallest of them."""
    if not len(a) or not len(b):
        return 0.0
    # Beyond the end of a sample nothing is known.
    end = min(a[-1], b[-1])
    a, b = a[a <= end], b[b <= end]
    fewer = min(len(a), len(b))
    return len(np.intersect1d(a, b, assume_unique=True)) / fewer if fewer else 0.0


def marks(session: Session) -> str:
    """The smallest numbers of a log in hexadecimal digits, for a file."""
    return " ".join(f"{number:016x}" for number in row_numbers(session)[:_MARKS].tolist())


def from_marks(text: str) -> Numbers:
    """The numbers of `marks`; none for any other text."""
    try:
        return np.unique(np.array([int(word, 16) for word in text.split()], dtype=np.uint64))
    except (ValueError, OverflowError):
        return np.zeros(0, dtype=np.uint64)


def seen_before(session: Session, known: Iterable[Numbers]) -> bool:
    """Whether one of some logs, each given by its numbers, is of the same recording."""
    known = [numbers for numbers in known if len(numbers)]
    if not known:
        return False
    own = row_numbers(session)
    return any(shared(numbers, own) > SAME_ROWS for numbers in known)
