"""Long arrays in unnamed files of the temporary folder, so that memory holds a part of them at a time.

The positions of an hour at 1 kHz have 200 MB. Their pages come into memory where they are read; `release` gives them
back, and so does a thread beyond 64 MB in all. Files have no name, so the system removes them with the last array, or
with the process. Shorter arrays stay in memory while they are few: a hundred short sessions are as long as one hour.
The thread also lets the C library return what freed arrays leave between others: without it, twice the memory in use.
"""

from __future__ import annotations

import contextlib
import ctypes
import math
import mmap
import os
import resource
import tempfile
import threading
import time
import weakref
from collections.abc import Iterable, Iterator, Sequence
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

LEAST_BYTES = 4 * 2**20
"""Smaller arrays stay in memory, up to `_MOST_BYTES` of them."""
_SMALL_BYTES = 2**16
_ARENA_BYTES = 2**22, 2**28
"""First and largest file of an arena; each has twice the size of the one before."""
_MOST_BYTES = 64 * 2**20
_EVERY_S = 0.01
# Growth of the memory outside of files from which the free memory is returned, and least time between two returns.
_GROWN_BYTES, _RETURN_EVERY_S = 64 * 2**20, 2.0
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3
_KEPT_BYTES = 32 * 2**20
_page = mmap.PAGESIZE
_open: weakref.WeakSet[Any] = weakref.WeakSet()
_watch: threading.Thread | None = None
_starting = threading.Lock()


class Growing:
    """Rows appended part by part: in memory while they are few, then in a file."""

    def __init__(self) -> None:
        self._parts: list[NDArray[Any]] = []
        self._bytes = 0
        self._file: Any = None
        self._rows = 0

    def append(self, part: NDArray[Any]) -> None:
        """Further rows, of the shape and type of the first."""
        if not len(part) and self._parts:
            return
        if self._parts and part.dtype != self._parts[-1].dtype:
            raise TypeError(f"rows of type {part.dtype} behind rows of type {self._parts[-1].dtype}")
        self._parts.append(part)
        self._bytes += part.nbytes
        self._rows += len(part)
        if self._bytes >= LEAST_BYTES:
            self._flush()

    def array(self) -> NDArray[Any]:
        """All rows; none may follow."""
        if self._file is None:
            return _in_memory(self._parts[0] if len(self._parts) == 1 else np.concatenate(self._parts))
        self._flush()
        self._file.flush()
        last = self._parts[-1]
        found = np.memmap(self._file, last.dtype, "r", shape=(self._rows, *last.shape[1:]))
        self._file.close()
        array = np.asarray(found)
        _watched(mapping(array))
        return array

    def __len__(self) -> int:
        return self._rows

    def _flush(self) -> None:
        if self._file is None:
            self._file = tempfile.TemporaryFile(prefix="lwr-")  # noqa: SIM115
        for part in self._parts:
            self._file.write(np.ascontiguousarray(part).data)
        self._parts, self._bytes = [self._parts[-1][:0].copy()], 0


class Arena:
    """Arrays of any shape kept in files, one after the other; they go with the last of them."""

    def __init__(self) -> None:
        self._held: mmap.mmap | None = None
        self._used, self._next = 0, _ARENA_BYTES[0]
        self._lock = threading.Lock()

    def keep(self, array: NDArray[Any]) -> NDArray[Any]:
        """The same array in a file; a small one as it is."""
        if array.nbytes < _SMALL_BYTES:
            return array
        kept = self.room(array.shape, array.dtype)
        kept[...] = array
        return kept

    def room(self, shape: tuple[int, ...], dtype: DTypeLike = np.float64) -> NDArray[Any]:
        """An array without content, in a file unless it is small."""
        size = math.prod(shape) * np.dtype(dtype).itemsize
        if size < _SMALL_BYTES:
            return np.empty(shape, dtype)
        with self._lock:
            if self._held is None or self._used + size > len(self._held):
                whole = max(self._next, size)
                try:
                    with tempfile.TemporaryFile(prefix="lwr-") as file:
                        os.posix_fallocate(file.fileno(), 0, whole)
                        self._held, self._used = mmap.mmap(file.fileno(), whole), 0
                except OSError:
                    # No room in the temporary folder: memory has to do.
                    return np.empty(shape, dtype)
                self._next = min(2 * whole, _ARENA_BYTES[1])
                _watched(self._held)
            found = np.ndarray(shape, dtype, self._held, self._used)
            self._used += -(-size // 64) * 64
        return found


class _Few:
    """Arrays in memory while they are few, and an arena for the others."""

    def __init__(self) -> None:
        self._arena, self._held = Arena(), dict[int, int]()

    def keep(self, array: NDArray[Any]) -> NDArray[Any]:
        """The same array, in a file if those in memory are many; what is in a file already stays there."""
        if array.nbytes < _SMALL_BYTES or mapping(array) is not None:
            return array
        if sum(list(self._held.values())) + array.nbytes > _MOST_BYTES:
            return self._arena.keep(array)
        # By one operation each, for an array may end anywhere: no lock could be taken there.
        self._held[id(array)] = array.nbytes
        weakref.finalize(array, self._held.pop, id(array), None).atexit = False
        return array


_in_memory = _Few().keep


def shelved(groups: Iterable[Sequence[NDArray[Any]]]) -> list[list[NDArray[Any]]]:
    """The same groups of arrays, the first arrays of all groups in one file, the second in another, and so on."""
    shelves: list[Growing] = []
    counts = []
    for group in groups:
        shelves = shelves or [Growing() for _ in group]
        for shelf, array in zip(shelves, group, strict=True):
            shelf.append(array)
        counts.append(len(group[0]))
    whole = [shelf.array() for shelf in shelves]
    ends = [0, *accumulate(counts)]
    return [[array[a:b] for array in whole] for a, b in pairwise(ends)]


def release(*arrays: NDArray[Any] | None) -> None:
    """Give the memory of arrays in files back; their content stays. Arrays in memory are left alone."""
    for array in arrays:
        held = mapping(array)
        if held is not None:
            held.madvise(mmap.MADV_DONTNEED)


def column(array: NDArray[Any], number: int) -> NDArray[Any]:
    """A copy (n,) of one column of (n, k), with little of the rest in memory."""
    found = np.empty(len(array), array.dtype)
    for some in spans(len(array)):
        found[some] = array[some, number]
        release(array)
    return found


def mapping(array: Any) -> mmap.mmap | None:
    """The file behind an array or a view of it, None for one in memory."""
    while array is not None and not isinstance(array, mmap.mmap):
        array = getattr(array, "base", None)
    return array


def stored(parts: Iterable[NDArray[Any]]) -> NDArray[Any]:
    """The rows of all parts as one array: in memory if it is small, else in a file, read-only."""
    rows = Growing()
    for part in parts:
        rows.append(part)
    return rows.array()


def stored_together(groups: Iterable[Sequence[NDArray[Any]]]) -> list[NDArray[Any]]:
    """`stored` for several arrays whose parts are made together: the first parts, the second ones, and so on."""
    rows: list[Growing] = []
    for group in groups:
        rows = rows or [Growing() for _ in group]
        for growing, part in zip(rows, group, strict=True):
            growing.append(part)
    return [growing.array() for growing in rows]


def _watched(held: mmap.mmap | None) -> None:
    """Bound the memory of all open files: a thread gives pages back, whoever reads them comes by them again."""
    global _watch
    if held is None or not Path("/proc/self/statm").exists():
        return
    with _starting:
        _open.add(held)
        if _watch is None:
            _prepare_process()
            _watch = threading.Thread(target=_bound, name="long arrays", daemon=True)
            _watch.start()


def _prepare_process() -> None:
    """Let the C library give every array of a few MB back when it is freed, as it does by default for 32 MB, and allow
    as many open files as the system does: each array in a file has one.
    """
    with contextlib.suppress(OSError, ValueError):
        _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
        resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
    with contextlib.suppress(OSError, AttributeError):
        library = ctypes.CDLL(None)
        library.mallopt(_M_MMAP_THRESHOLD, 4 * 2**20)
        # A part of the heap stays: to return and fetch it again with every array costs more than it is worth.
        library.mallopt(_M_TRIM_THRESHOLD, _KEPT_BYTES)
    return_freed()


def return_freed() -> None:
    """Let the C library return the memory of freed arrays that lies between others."""
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)


def _bound() -> None:
    global _watch
    start, least = _resident()
    returned = time.monotonic()
    while True:
        time.sleep(_EVERY_S)
        with _starting:
            held = list(_open)
            if not held:
                _watch = None
                return
        files, others = _resident()
        if files > start + _MOST_BYTES:
            for one in held:
                one.madvise(mmap.MADV_DONTNEED)
            start = _resident()[0]
        if others > least + _GROWN_BYTES and time.monotonic() > returned + _RETURN_EVERY_S:
            return_freed()
            least, returned = _resident()[1], time.monotonic()
        least = min(least, others)
        del held


def _resident() -> tuple[int, int]:
    """Bytes of this process in files, programs and libraries included, and others."""
    _, whole, files = Path("/proc/self/statm").read_text().split()[:3]
    return int(files) * _page, (int(whole) - int(files)) * _page


def spans(count: int, size: int = 2**16) -> Iterator[slice]:
    """Slices of `size` rows, the last one shorter."""
    return (slice(first, min(first + size, count)) for first in range(0, count, size))
