"""The controller's 16-bit packet counter without wraps, and the counts of lost, late and repeated packets.

A jump of the counter has one of four causes: a gap (lost packets), a late packet (the network changed the
order), a damaged packet, or a restart of the controller. The controller's timestamp tells them apart. Over a
gap, counter and clock advance together; a clock more than a second behind is a restart. Any other jump, or one
of more than half the counter's range, is held back until the next packet confirms it. A single damaged packet
is thus never taken for a restart or a long silence.
"""

from __future__ import annotations

from enum import Enum

_WRAP = 0x10000
# Tolerance between counter and clock over a jump [packets], in addition to 2 % of the jump.
_SLACK = 16
# A packet older than this [s] is not late: the controller's clock began anew.
_LATEST_S = 1.0
# Up to this jump of the counter [packets] a wrong clock is damage, not a restart.
_SHORT_JUMP = 64
# So many old packets in a row, in order, are a restart with an earlier count.
_OLD_RUN = 40
_FLOAT32_EPS = 1.2e-7


class Arrival(Enum):
    """Classes of packets by their counter."""

    NEW = "new"
    REPEATED = "repeated"
    REORDERED = "reordered"
    SUSPECT = "suspect"
    RESTARTED = "restarted"


class SequenceTracker:
    """Unwraps `send_seq` and counts.

    sequence : number of the newest packet. It starts with the first packet's own count and always increases; after
    a restart of the controller it goes on with the next number, or later with ``skip``.
    lost : packets missing, or arrived after a newer one. repeated, reordered, suspect, restarts : repeated packets;
    packets after a newer one; packets with an implausible counter; restarts
    """

    __slots__ = (
        "_last",
        "_old",
        "_old_run",
        "_suspect",
        "_suspect_timestamp",
        "_timestamp",
        "lost",
        "reordered",
        "repeated",
        "restarts",
        "sequence",
        "suspect",
    )

    def __init__(self) -> None:
        self.sequence = -1
        self.lost = 0
        self.repeated = 0
        self.reordered = 0
        self.suspect = 0
        self.restarts = 0
        self._last = -1
        self._timestamp = 0.0
        self._old = 0
        self._old_run = 0
        self._suspect = -1
        self._suspect_timestamp = 0.0

    @property
    def expected(self) -> int | None:
        """Counter of the next packet; None before the first, and in doubt."""
        return (self._last + 1) & 0xFFFF if self._last >= 0 > self._suspect else None

    def feed(self, send_seq: int, timestamp: float, sample_time: float, new_source: bool = False) -> Arrival:
        """Take in one packet's counter (0..65535), timestamp [s] and sample time [s].

        new_source : the packet has another port than the last one, so an older count is a restart at once
        """
        last = self._last
        if last < 0:
            self.sequence = send_seq
            self._last = send_seq
            self._timestamp = timestamp
            return Arrival.NEW
        delta = ((send_seq - last + 0x8000) & 0xFFFF) - 0x8000
        if delta == 1 and self._suspect < 0:
            return self._advance(1, send_seq, timestamp)
        return self._jump(delta, send_seq, timestamp, sample_time, new_source)

    def follow(self, count: int, send_seq: int, timestamp: float) -> None:
        """Take in `count` packets, each the successor of the one before; the last has this counter and timestamp."""
        self._advance(1, send_seq, timestamp)
        self.sequence += count - 1

    def skip(self, cycles: int) -> None:
        """Leave out `cycles` numbers before the newest packet; they are not counted as lost."""
        self.sequence += cycles

    def _advance(self, step: int, send_seq: int, timestamp: float) -> Arrival:
        self.sequence += step
        self.lost += step - 1
        self._last = send_seq
        self._timestamp = timestamp
        self._old_run = 0
        self._suspect = -1
        return Arrival.NEW

    def _jump(
        self, delta: int, send_seq: int, timestamp: float, sample_time: float, new_source: bool
    ) -> Arrival:
        elapsed = timestamp - self._timestamp
        cycles = elapsed / sample_time
        # The counter fixes the step up to multiples of its wrap; the clock picks the multiple.
        step = delta + _WRAP * round((cycles - delta) / _WRAP)
        agrees = elapsed == 0.0 or abs(step - cycles) <= self._slack(cycles, timestamp, sample_time)
        if agrees and 0 < step < _WRAP // 2:
            return self._advance(step, send_seq, timestamp)
        if new_source:
            return self._restart(send_seq, timestamp)
        if agrees and step == 0:
            self.repeated += 1
            return Arrival.REPEATED
        if agrees and step < 0 and elapsed >= -_LATEST_S:
            self.reordered += 1
            return self._old_packet(send_seq, timestamp)
        if elapsed < -_LATEST_S and not 0 < delta <= _SHORT_JUMP:
            return self._restart(send_seq, timestamp)
        return self._doubt(step if agrees and step > 0 else 0, send_seq, timestamp, sample_time)

    def _slack(self, cycles: float, timestamp: float, sample_time: float) -> float:
        """Tolerance between counter and clock [packets]."""
        resolution = _FLOAT32_EPS * max(abs(timestamp), abs(self._timestamp)) / sample_time
        return _SLACK + 0.02 * abs(cycles) + 2.0 * resolution

    def _old_packet(self, send_seq: int, timestamp: float) -> Arrival:
        """Count late packets in a row: in order, they may be a restarted count."""
        follows = self._old_run > 0 and ((send_seq - self._old) & 0xFFFF) <= 1
        self._old_run = self._old_run + 1 if follows else 1
        self._old = send_seq
        if self._old_run >= _OLD_RUN:
            return self._restart(send_seq, timestamp)
        return Arrival.REORDERED

    def _doubt(self, step: int, send_seq: int, timestamp: float, sample_time: float) -> Arrival:
        """Hold back a packet after a jump of `step` (0: a restart) until the next one confirms it."""
        if self._suspect >= 0:
            since = (send_seq - self._suspect) & 0xFFFF
            cycles = (timestamp - self._suspect_timestamp) / sample_time
            if since <= _SLACK and abs(since - cycles) <= self._slack(cycles, timestamp, sample_time):
                if step > 0:
                    return self._advance(step, send_seq, timestamp)
                return self._restart(send_seq, timestamp)
        self._suspect = send_seq
        self._suspect_timestamp = timestamp
        self.suspect += 1
        return Arrival.SUSPECT

    def _restart(self, send_seq: int, timestamp: float) -> Arrival:
        self.restarts += 1
        self._advance(1, send_seq, timestamp)
        return Arrival.RESTARTED
