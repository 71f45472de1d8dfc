"""Rows that two logs share to the last bit: a copy under another name, at other times, or a part of a log.

A row has a number, and a log is known by its smallest numbers: they are a fair sample of its rows (Broder, 1997), small
enough for a model file.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from lwr_driver.session import Session

Numbers = NDArray[np.uint64]

# Share of the rows of two logs from which they are one recording.
SAME_ROWS = 0.2
# Numbers that stand for a log; least rows in motion that stand for all.
_MARKS, _MOVING = 64, 100


def row_numbers(session: Session) -> Numbers:
    """Sorted numbers of 64 bits of the rows in motion, equal for rows with equal positions and torques."""
    sides = [session.joint.position, session.joint.effort]
    if session.motor is not None and not session.joint.effort.size:
        sides = [session.motor.effort]
    count = len(sides[0])
    found, moving = np.zeros(count, dtype=np.uint64), np.ones(count, dtype=bool)
    moving[:1] = False
    for values in sides:
        for column in values.T:
            # The finaliser of splitmix64 (Steele, Lea and Flood, 2014).
            bits = np.ascontiguousarray(column).view(np.uint64) ^ (found * np.uint64(0x9E3779B97F4A7C15))
            bits = (bits ^ (bits >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
            bits = (bits ^ (bits >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
            found = bits ^ (bits >> np.uint64(31))
            moving[1:] &= column[1:] != column[:-1]
    return np.unique(found[moving] if moving.sum() > _MOVING else found)


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
