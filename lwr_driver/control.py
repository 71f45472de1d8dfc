"""The memory shared by the driver and its loop process: requests one way, state and results the other.

Every word is 8 bytes, aligned, and written by one side only. Data are written before the word announcing
them, and x86-64 keeps this order for the reader. The memory has no name (`memfd_create`): it is gone with
its last process.
"""

from __future__ import annotations

import mmap
import os
from collections.abc import Sequence
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fri.errors import ConfigurationError, FileError
from lwr_driver.arm import JOINTS
from lwr_driver.ring import ROW

HISTORY = 128
"""Rows kept for an exception or a snapshot, newest last."""

HISTORY_STEP = HISTORY // 4
"""Most rows written there before they are counted: readers take up to half of the history."""

BIN_NS = 2_000
"""Width of a bin of the reply latency histogram; the last bin holds all longer latencies."""

_BINS = 1001
_PHASES = 4096
_TEXT_BYTES = 1024


class Mode(IntEnum):
    """Answer of the loop: the mirror, the last position, a motion, a stop, or nothing."""

    MIRROR = 0
    HOLD = 1
    MOTION = 2
    STOP = 3
    SILENT = 4


class Job(IntEnum):
    """Request to the loop; it goes on answering during and after a job."""

    NONE = 0
    CYCLES = 1  # A: cycles to take the mean of
    QUALITY = 2  # A: cycles on end, B: least quality
    START = 3  # command mode
    LEAVE = 4  # monitor mode
    MOTION = 5  # A: rows, B: count of past stop requests
    HALT = 6  # no motion
    LOAD = 7  # load data in the first row of `plan`: kg, mm from the flange, kg m2


class Result(IntEnum):
    """How a job ended."""

    NONE = 0
    DONE = 1
    ABORTED = 2  # somebody asked for a stop
    REFUSED = 3  # a condition was not met; nothing moved
    ROBOT = 4  # ended by the arm or its controller
    NETWORK = 5  # packets were missing
    GUARD = 6  # a row would have broken a limit
    TIMEOUT = 7


class Word(IntEnum):
    """Places of the shared words."""

    # written by the driver
    REQUEST = 0  # number of the request, written last
    JOB = 1
    A = 2
    B = 3
    LIMIT = 4  # cycles after which a waiting job gives up
    PHASES = 5
    STOP = 8  # count of stop requests
    DROP = 9
    QUIT = 10
    BEAT_NS = 11  # CLOCK_MONOTONIC of the last sign of life while a motion is executed, 0 without any
    # written by the loop
    DONE = 16  # number of the last finished request, written after its result
    RESULT = 17
    CYCLES = 18  # packets received, written after the row in the history
    MODE = 19
    INDEX = 20  # row of the motion, -1 outside one
    HEARD_NS = 21  # CLOCK_MONOTONIC of the last packet
    LOST = 22
    REPEATED = 23
    REORDERED = 24
    MALFORMED = 25
    FOREIGN = 26
    RESTARTS = 27
    UNREFLECTED = 28
    ANSWERED = 29
    RECEIVED = 30
    NOTES = 31  # count of notes; the last is in the text NOTE
    SUSPECT = 32
    ROW = 33  # last row sent of a motion, -1 if none since its request
    # written by the driver
    LOAD = 40  # count of payloads put into `load`


class Text(IntEnum):
    """Places of the shared texts, all written by the loop."""

    REASON = 0  # of the last result
    LEFT = 1  # why command mode was left, or why no motion may begin in it
    NOTE = 2  # the last rare event of the link


class Control:
    """View of the shared memory, made by `create`, or from the file descriptor inherited by the loop process.

    words : (64,) int64 by `Word`
    history : (HISTORY,) of `ROW`; row number n is at n % HISTORY
    plan : (rows, 7) float64, the motion [rad]; phase_rows, phase_ids : first rows and numbers of its phases
    measured : (6, 7) float64: mean q, std q, mean tau, std tau, mean external tau, mean command
    tracking : (7,) worst tracking error since command mode began [rad]
    latency : histogram of the reply latency in bins of `BIN_NS`
    load : (7,) expected payload: mass [kg], centre of mass [m], inertia [kg m2], see `ContactWatch.carry`
    """

    def __init__(self, descriptor: int, plan_rows: int) -> None:
        self.descriptor, self.plan_rows = descriptor, plan_rows
        self._map = mmap.mmap(descriptor, _size(plan_rows))
        self._at = 0
        self.words = self._take((64,), "<i8")
        self.tracking = self._take((JOINTS,), "<f8")
        self.measured = self._take((6, JOINTS), "<f8")
        self.latency = self._take((_BINS,), "<i8")
        self.load = self._take((7,), "<f8")
        self._texts = self._take((len(Text), _TEXT_BYTES), "u1")
        self.phase_rows = self._take((_PHASES,), "<i8")
        self.phase_ids = self._take((_PHASES,), "<i8")
        self.history = self._take((HISTORY,), ROW)
        self.history_bytes = self.history.view(np.uint8).reshape(-1).data
        self.plan = self._take((plan_rows, JOINTS), "<f8")

    @classmethod
    def create(cls, plan_rows: int) -> Control:
        """New memory, all zero, for motions of up to `plan_rows` rows."""
        try:
            descriptor = os.memfd_create("lwr_driver", os.MFD_CLOEXEC)
            os.ftruncate(descriptor, _size(plan_rows))
        except OSError as error:
            raise FileError.of(error, f"no shared memory for motions of {plan_rows} rows") from error
        control = cls(descriptor, plan_rows)
        control.words[Word.INDEX] = control.words[Word.ROW] = -1
        return control

    def post(self, job: Job, a: int = 0, b: int = 0, limit: int = 0) -> None:
        """Ask the loop for a job with its arguments and its limit in cycles (0: none)."""
        words = self.words
        words[Word.JOB], words[Word.A], words[Word.B], words[Word.LIMIT] = int(job), a, b, limit
        words[Word.REQUEST] += 1

    @property
    def done(self) -> bool:
        """Whether the last request is finished."""
        return int(self.words[Word.DONE]) == int(self.words[Word.REQUEST])

    @property
    def result(self) -> Result:
        """How the last job ended."""
        return Result(int(self.words[Word.RESULT]))

    def write_text(self, place: Text, text: str) -> None:
        """Put a text, truncated to its place."""
        content = text.encode()[: _TEXT_BYTES - 1]
        line = self._texts[place]
        line[: len(content)] = np.frombuffer(content, dtype=np.uint8)
        line[len(content)] = 0

    def text(self, place: Text) -> str:
        """The text at a place."""
        return self._texts[place].tobytes().split(b"\0", 1)[0].decode(errors="replace")

    def put_motion(self, q: NDArray[np.float64], phases: Sequence[tuple[int, int]]) -> None:
        """Store the rows of a motion and its phases as (first row, number); no motion may be running."""
        if len(q) > self.plan_rows:
            raise ConfigurationError(
                f"motion of {len(q)} rows; the driver was set up for {self.plan_rows}. Raise "
                "`longest_motion_s`"
            )
        if len(phases) > _PHASES:
            raise ConfigurationError(f"motion of {len(phases)} phases; {_PHASES} is the limit")
        self.plan[: len(q)] = q
        for place, (row, number) in enumerate(phases):
            self.phase_rows[place], self.phase_ids[place] = row, number
        self.words[Word.PHASES] = len(phases)

    def last_rows(self, count: int) -> NDArray[Any]:
        """Copy of the last `count` rows of the loop, oldest first, dtype `ROW`."""
        while True:
            cycles = int(self.words[Word.CYCLES])
            wanted = min(count, cycles, HISTORY // 2)
            rows = self.history[np.arange(cycles - wanted, cycles) % HISTORY]
            # Rows are overwritten after HISTORY cycles; only a reader delayed for so long reads again.
            if int(self.words[Word.CYCLES]) - (cycles - wanted) < HISTORY:
                return rows

    def close(self) -> None:
        """Drop this process's view and its file descriptor."""
        if self.descriptor < 0:
            return
        self.history_bytes.release()
        for name, value in list(vars(self).items()):
            if isinstance(value, np.ndarray):
                delattr(self, name)
        # Another view keeps the memory mapped until it is dropped too.
        self._map = None  # type: ignore[assignment]
        os.close(self.descriptor)
        self.descriptor = -1

    def _take(self, shape: tuple[int, ...], dtype: Any) -> NDArray[Any]:
        array: NDArray[Any] = np.ndarray(shape, dtype=dtype, buffer=self._map, offset=self._at)
        self._at += _aligned(array.nbytes)
        return array


def _aligned(size: int) -> int:
    return -(-size // 64) * 64


def _size(plan_rows: int) -> int:
    fixed = (
        64 * 8,
        JOINTS * 8,
        6 * JOINTS * 8,
        _BINS * 8,
        7 * 8,
        len(Text) * _TEXT_BYTES,
        _PHASES * 8,
        _PHASES * 8,
        HISTORY * ROW.itemsize,
        plan_rows * JOINTS * 8,
    )
    return sum(_aligned(size) for size in fixed)
