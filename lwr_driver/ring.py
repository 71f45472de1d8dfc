"""The shared-memory ring between the FRI loop and the recorder: one writer, one reader, rows of fixed size.

The loop fills `Ring.row` and calls `publish`: it copies the row into its slot, then advances the head; it
never waits, allocates or calls the system. If the ring is full, the new row is dropped and counted, so a
reader never sees a half overwritten row. The reader takes rows with `take` and frees them with `release`.

The memory has no name of its own (`memfd_create`): it is gone with its last process, also after `kill -9`.

Each counter is an aligned 8-byte word in a cache line of its own, written by one side only. The order "row
first, head second" is kept by the total store order of x86-64, the architecture of the controller PCs.
"""

from __future__ import annotations

import mmap
import os
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fri.errors import ConfigurationError, FileError
from fri.packets import CMD, MSR, raw

CAPACITY = 8192
"""Default number of rows: 8 s at 1 kHz, 11 MB."""

NO_PHASE = -1
"""Value of `phase` in rows without a phase."""

ROW = np.dtype(
    [
        ("t_recv", "<i8"),  # CLOCK_MONOTONIC when the packet was received [ns]
        ("t_send", "<i8"),  # CLOCK_MONOTONIC after the answer was sent [ns], 0 without an answer
        ("sequence", "<i8"),  # packet count of the controller, unwrapped
        ("plan_index", "<i8"),  # row of the motion, -1 outside one
        ("phase", "<i4"),  # index into the recorder's phase names, NO_PHASE for none
        ("answered", "u1"),  # 1 if `cmd` was sent
        ("flags", "u1"),  # free for the loop, not recorded
        ("spare", "u1", (6,)),
        ("msr", MSR),
        ("cmd", CMD),
    ]
)
"""One FRI cycle: packet, answer, and their times. No gaps: a copy holds all bytes."""

_MAGIC = 0x4C57525F52494E47
_LINE = 8  # words of a cache line
_MAGIC_AT, _CAPACITY_AT, _ITEM_AT = 0, 1, 2
_LINES = 6  # the head line, then one for each counter
_HEADER_BYTES = _LINES * _LINE * 8


class Ring:
    """A ring of `ROW`s in shared memory, made by `create` and opened in another process by `attach`.

    name : place of the memory for `attach`, valid as long as the creating process holds it
    descriptor : file descriptor, for child processes; they attach to `inherited`

    The creating process calls `unlink` when it is done; `close` only drops this process's view.
    """

    def __init__(self, descriptor: int, size: int, name: str, *, owner: bool) -> None:
        self.descriptor, self.name = descriptor, name
        self._owner = owner
        memory: Any = mmap.mmap(descriptor, size)
        words = np.ndarray((_LINES * _LINE,), dtype=np.int64, buffer=memory)
        if int(words[_MAGIC_AT]) != _MAGIC or int(words[_ITEM_AT]) != ROW.itemsize:
            raise ConfigurationError(
                f"shared memory {name!r} is not a ring of {ROW.itemsize}-byte rows; "
                "both processes must run the same version"
            )
        self.capacity = int(words[_CAPACITY_AT])
        self._words = words
        self._head, self._tail, self._beat, self._overruns, self._writer = (
            words[line * _LINE : line * _LINE + 1] for line in range(1, _LINES)
        )
        self._rows = np.ndarray((self.capacity,), dtype=ROW, buffer=memory, offset=_HEADER_BYTES)
        self._bytes = memoryview(memory)[_HEADER_BYTES : _HEADER_BYTES + self.capacity * ROW.itemsize]
        self._published = int(self._head[0])
        self.row: NDArray[Any] = np.zeros(1, dtype=ROW)
        self.row["phase"] = NO_PHASE
        self.row["plan_index"] = -1
        self._row_bytes = self.row.data.cast("B")

    @classmethod
    def create(cls, capacity: int = CAPACITY) -> Ring:
        """A new ring with every page touched, against page faults of the loop. Needs `unlink` at the end."""
        if capacity < 2:
            raise ConfigurationError(f"ring of {capacity} rows; it needs 2 at least")
        size = _HEADER_BYTES + capacity * ROW.itemsize
        descriptor = -1
        try:
            descriptor = os.memfd_create("lwr_ring", os.MFD_CLOEXEC)
            # Unlike a mere length this has every page, or fails here and not later in the loop.
            os.posix_fallocate(descriptor, 0, size)
            words = np.zeros(_LINES * _LINE, np.int64)
            words[_MAGIC_AT], words[_CAPACITY_AT], words[_ITEM_AT] = _MAGIC, capacity, ROW.itemsize
            os.pwrite(descriptor, words.tobytes(), 0)
            return cls(descriptor, size, f"/proc/{os.getpid()}/fd/{descriptor}", owner=True)
        except OSError as error:
            if descriptor >= 0:
                os.close(descriptor)
            raise FileError.of(error, f"shared memory of {size / 1e6:.1f} MB cannot be had") from error

    @classmethod
    def attach(cls, name: str) -> Ring:
        """The ring of another process, by its `name` there or by `inherited` in a child process."""
        descriptor = -1
        try:
            descriptor = os.open(name, os.O_RDWR | os.O_CLOEXEC)
            size = os.fstat(descriptor).st_size
            if size < _HEADER_BYTES:
                raise ConfigurationError(f"shared memory {name!r} of {size} bytes is no ring")
            return cls(descriptor, size, name, owner=False)
        except (OSError, ValueError) as error:
            if descriptor >= 0:
                os.close(descriptor)
            if isinstance(error, ConfigurationError):
                raise
            raise ConfigurationError(
                f"shared memory {name!r} cannot be opened: {error}; its creator must still run"
            ) from error

    @property
    def inherited(self) -> str:
        """Name for a child process that inherits `descriptor`; needs no rights to look into this process."""
        return f"/proc/self/fd/{self.descriptor}"

    # -- the side of the loop --------------------------------------------------------------------------------

    def start_writing(self) -> None:
        """Declare this process the writer; the recorder watches it from now on."""
        self._published = int(self._head[0])
        self._beat[0] = time.monotonic_ns()
        self._writer[0] = os.getpid()

    def stop_writing(self) -> None:
        """Declare an intended end: silence of the writer is no fault any more."""
        self._writer[0] = 0

    def publish(self) -> bool:
        """Copy `row` into the ring and make it visible. False, counted in `overruns`, if the ring is full."""
        published = self._published
        if published - self._tail[0] >= self.capacity:
            self._overruns[0] += 1
            return False
        start = published % self.capacity * ROW.itemsize
        self._bytes[start : start + ROW.itemsize] = self._row_bytes
        self._published = published + 1
        self._head[0] = published + 1
        return True

    def publish_rows(self, rows: NDArray[Any]) -> None:
        """As `publish` for each of the `rows`, (n,) of `ROW`, at most `free`."""
        published, content = self._published, rows.view(np.uint8).data
        first = min(len(rows), self.capacity - published % self.capacity)
        at, size = published % self.capacity * ROW.itemsize, ROW.itemsize
        self._bytes[at : at + first * size] = content[: first * size]
        self._bytes[: (len(rows) - first) * size] = content[first * size :]
        self._published = published + len(rows)
        self._head[0] = self._published

    def beat(self, now_ns: int) -> None:
        """Sign of life of the writer, for each pass of the loop, also while no packet comes."""
        self._beat[0] = now_ns

    # -- the side of the recorder ----------------------------------------------------------------------------

    def take(self, upto: int | None = None) -> NDArray[Any]:
        """Copy of the rows not yet released, oldest first, (n,) of `ROW`; `upto` limits by row number."""
        tail = int(self._tail[0])
        head = int(self._head[0])
        if upto is not None:
            head = min(head, upto)
        if head <= tail:
            return np.zeros(0, dtype=ROW)
        first, last = tail % self.capacity, (head - 1) % self.capacity
        rows = raw(self._rows)
        parts = [rows[first : last + 1]] if first <= last else [rows[first:], rows[: last + 1]]
        return np.concatenate(parts).view(ROW).reshape(-1)

    def release(self, count: int) -> None:
        """Free the `count` oldest rows for the writer."""
        self._tail[0] += count

    def peek(self, count: int) -> NDArray[Any]:
        """Copy of the newest rows, oldest first, at most `count`, for onlookers: nothing is freed.

        Rows overwritten meanwhile are left out.
        """
        head = int(self._head[0])
        first = max(head - min(count, self.capacity // 2), 0)
        rows = self._rows[np.arange(first, head) % self.capacity]
        overtaken = int(self._head[0]) - self.capacity - first
        return rows[max(overtaken, 0) :]

    # -- both sides ------------------------------------------------------------------------------------------

    @property
    def head(self) -> int:
        """Number of rows ever published."""
        return int(self._head[0])

    @property
    def tail(self) -> int:
        """Number of rows ever released by the recorder."""
        return int(self._tail[0])

    @property
    def free(self) -> int:
        """Rows left before the ring is full; a loop in lock step waits for some."""
        return self.capacity - int(self._head[0] - self._tail[0])

    @property
    def overruns(self) -> int:
        """Rows dropped because the ring was full."""
        return int(self._overruns[0])

    @property
    def heartbeat_ns(self) -> int:
        """CLOCK_MONOTONIC of the writer's last sign of life [ns]."""
        return int(self._beat[0])

    @property
    def writer_pid(self) -> int:
        """Process id of the writer, 0 if there is none."""
        return int(self._writer[0])

    def close(self) -> None:
        """Drop this process's view of the ring; of the creator the memory stays until `unlink`."""
        if self._words.size == 0:
            return
        none = np.zeros(0, dtype=np.int64)
        self._words = self._head = self._tail = self._beat = self._overruns = self._writer = none
        self._rows = np.zeros(0, dtype=ROW)
        self._bytes.release()
        if not self._owner:
            self._give_back()

    def unlink(self) -> None:
        """Close, and give the memory back to the system once the other processes close too."""
        self.close()
        self._give_back()

    def _give_back(self) -> None:
        if self.descriptor >= 0:
            os.close(self.descriptor)
            self.descriptor = -1

    def __del__(self) -> None:
        if hasattr(self, "_bytes"):
            self.unlink()

    def __enter__(self) -> Ring:
        return self

    def __exit__(self, *_: object) -> None:
        self.unlink()
