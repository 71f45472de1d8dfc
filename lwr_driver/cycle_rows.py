"""Every cycle as a row: for the recorder in its ring, and for the driver in the shared memory."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fri.packets import raw
from fri.remote import LinkEvent, RemoteEnd
from lwr_driver.commander import Commander
from lwr_driver.control import BIN_NS, HISTORY, HISTORY_STEP, Control, Text, Word
from lwr_driver.ring import ROW, Ring

_COUNTED = ("lost", "repeated", "reordered", "suspect", "malformed", "foreign", "restarts", "unreflected")
_COUNTERS = tuple((Word[name.upper()], name) for name in (*_COUNTED, "answered", "received"))


class CycleRows:
    """Writes the rows of a link, with the latency, the counters and the last note of the link.

    ring : for the recorder, None keeps none. lock_step : rows have the controller's clock, so that the same run gives
    the same log. period_s : the controller's sample time [s]
    """

    def __init__(
        self, remote: RemoteEnd, commander: Commander, control: Control, ring: Ring | None, *, lock_step: bool
    ) -> None:
        self._remote, self._commander, self._control, self._ring = remote, commander, control, ring
        self._words, self._lock_step = control.words, lock_step
        self.period_s = 0.0
        self._last_event: LinkEvent | None = None
        self._row: NDArray[Any] = np.zeros(1, dtype=ROW) if ring is None else ring.row
        self._row_bytes = _bytes(self._row)
        self._fields = {name: self._row[name] for name in ROW.names or () if name not in ("msr", "cmd")}
        self._msr_bytes, self._cmd_bytes = _bytes(remote.msr), _bytes(remote.command)
        self._msr_place, self._cmd_place = _place("msr"), _place("cmd")

    @property
    def command_bytes(self) -> memoryview:
        """The answer of the present cycle, as sent."""
        return self._cmd_bytes

    def count_latency(self, latency_ns: int, count: int = 1) -> None:
        """Count `count` answers sent so long after their packets."""
        latency = self._control.latency
        latency[min(latency_ns // BIN_NS, len(latency) - 1)] += count

    def write(self, answered: bool, sent_ns: int | None) -> None:
        """The row of this cycle; sent_ns : when the answer was sent, None for just now [ns]."""
        remote, words, fields, control = self._remote, self._words, self._fields, self._control
        received_ns = remote.received_ns
        sent_ns = time.monotonic_ns() if sent_ns is None else sent_ns
        words[Word.HEARD_NS] = received_ns
        if answered:
            self.count_latency(sent_ns - received_ns)
        if self._lock_step:
            received_ns = sent_ns = remote.sequence * round(self.period_s * 1e9)
        fields["t_recv"][0] = received_ns
        fields["t_send"][0] = sent_ns if answered else 0
        fields["sequence"][0] = remote.sequence
        fields["plan_index"][0] = self._commander.index
        fields["phase"][0] = self._commander.phase
        fields["answered"][0] = answered
        self._row_bytes[self._msr_place] = self._msr_bytes
        self._row_bytes[self._cmd_place] = self._cmd_bytes
        if self._ring is not None:
            self._ring.publish()
            self._ring.beat(time.monotonic_ns())
        cycles = int(words[Word.CYCLES])
        start = cycles % HISTORY * ROW.itemsize
        control.history_bytes[start : start + ROW.itemsize] = self._row_bytes
        words[Word.CYCLES] = cycles + 1
        index = self._commander.index
        words[Word.MODE], words[Word.INDEX] = int(self._commander.mode), index
        if index >= 0:
            words[Word.ROW] = index
        self.publish_counters()

    def write_many(self, sequence: int, index: int, packets: NDArray[Any], commands: NDArray[Any]) -> None:
        """The rows of plain packets from number `sequence` on, answered with the rows of the motion from `index` on."""
        words, count = self._words, np.arange(len(packets))
        rows = np.zeros(len(packets), dtype=ROW)
        rows["sequence"] = sequence + count
        rows["t_recv"] = rows["t_send"] = rows["sequence"] * round(self.period_s * 1e9)
        rows["plan_index"], rows["phase"] = index + count, self._commander.phase
        rows["answered"] = 1
        content = raw(rows)
        content[:, self._msr_place], content[:, self._cmd_place] = raw(packets), raw(commands)
        if self._ring is not None:
            self._ring.publish_rows(rows)
            self._ring.beat(time.monotonic_ns())
        history = raw(self._control.history)
        for start in range(0, len(rows), HISTORY_STEP):
            some = content[start : start + HISTORY_STEP]
            cycles = int(words[Word.CYCLES])
            history[(cycles + np.arange(len(some))) % HISTORY] = some
            words[Word.CYCLES] = cycles + len(some)
        words[Word.MODE] = int(self._commander.mode)
        words[Word.INDEX] = words[Word.ROW] = self._commander.index
        self.publish_counters()

    def publish_counters(self) -> None:
        """Write counters and the last note of the link into the shared memory."""
        remote, words = self._remote, self._words
        for word, name in _COUNTERS:
            words[word] = getattr(remote, name)
        if remote.events and remote.events[-1] is not self._last_event:
            self._last_event = remote.events[-1]
            self._control.write_text(Text.NOTE, f"{self._last_event.kind.value}: {self._last_event.text}")
            words[Word.NOTES] += 1


def _bytes(array: NDArray[Any]) -> memoryview:
    return array.reshape(1).view(np.uint8).data


def _place(name: str) -> slice:
    fields = ROW.fields
    assert fields is not None
    dtype, offset = fields[name][:2]
    return slice(offset, offset + dtype.itemsize)
