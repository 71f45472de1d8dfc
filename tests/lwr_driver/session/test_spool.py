"""Arrays in files instead of memory."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from lwr_driver.session import spool
from lwr_driver.session.spool import LEAST_BYTES, mapping, stored


def test_short_arrays_stay_in_memory_while_they_are_few(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(spool, "_MOST_BYTES", 2**20)
    monkeypatch.setattr(spool, "_in_memory", spool._Few().keep)
    rows = np.arange(2**15, dtype=np.float64)  # a quarter of it
    made = [stored([rows + number]) for number in range(6)]
    assert [mapping(one) is None for one in made] == [True] * 4 + [False] * 2
    for number, one in enumerate(made):
        assert np.array_equal(one, rows + number)
    # An array that is gone makes room for the next.
    del made[0], one
    assert mapping(stored([rows])) is None
    # What is nearly nothing stays in any case.
    assert mapping(stored([rows[:100]])) is None


def test_a_long_array_is_in_a_file() -> None:
    long = np.arange(LEAST_BYTES // 8, dtype=np.float64)
    found = stored([long[:1000], long[1000:]])
    assert mapping(found) is not None
    assert np.array_equal(found, long)


def test_freed_memory_is_returned_as_it_grows(monkeypatch: pytest.MonkeyPatch) -> None:
    returned = threading.Event()
    monkeypatch.setattr(spool, "return_freed", returned.set)
    long = stored([np.zeros(LEAST_BYTES // 8)])
    # Twice the growth.
    grown = np.ones(2**24)
    assert returned.wait(60.0)
    assert len(long) < len(grown)
