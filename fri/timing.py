"""The controller's rating of the answers: statistics over the last packets and the quality made of them.

KUKA fixes the window of 100 packets and the meaning of the figures; formulas and thresholds are ours.
"""

from __future__ import annotations

from math import sqrt

from fri.policy import KrcPolicy
from fri.states import Quality

_ABSENT = -1


def classify(
    packets: int, answer_rate: float, latency_s: float, sample_time_s: float, policy: KrcPolicy
) -> Quality:
    """Quality of a link with `packets` in the window, an answer rate of 0..1 and a mean latency [s]."""
    if packets < policy.minimum_packets or answer_rate < policy.bad_rate:
        return Quality.UNACCEPTABLE
    if answer_rate < policy.ok_rate:
        return Quality.BAD
    if answer_rate < policy.perfect_rate or latency_s >= policy.perfect_latency * sample_time_s:
        return Quality.OK
    return Quality.PERFECT


class AnswerStatistics:
    """Sliding window over the last packets, updated in constant time with exact integer sums.

    packets : packets in the window, at most `window`. answer_rate, miss_rate : shares of the window. latency, jitter :
    mean and standard deviation of the round trip [s] over the answers of the window, late ones included.
    miss_counter : missing answers since the start
    """

    def __init__(self, window: int) -> None:
        self._window = window
        self._latencies = [_ABSENT] * window
        self._in_time = [False] * window
        self._slot = 0
        self._answered = 0
        self._timed = 0
        self._sum = 0
        self._squares = 0
        self.packets = 0
        self.miss_counter = 0
        self.answer_rate = 0.0
        self.miss_rate = 0.0
        self.latency = 0.0
        self.jitter = 0.0

    def close(self, latency_ns: int | None) -> None:
        """Close a packet: `latency_ns` of its answer, or None if it was not answered in time."""
        slot = self._slot
        if self.packets == self._window:
            self._answered -= self._in_time[slot]
            self._forget(slot)
        else:
            self.packets += 1
        answered = latency_ns is not None
        self._in_time[slot] = answered
        self._answered += answered
        if latency_ns is not None:
            self._remember(slot, latency_ns)
        else:
            self.miss_counter += 1
        self._slot = (slot + 1) % self._window
        self.answer_rate = self._answered / self.packets
        self.miss_rate = 1.0 - self.answer_rate
        self._rate_latency()

    def late(self, age: int, latency_ns: int) -> None:
        """Take in the late answer to the packet closed `age` (1 for the last) packets ago."""
        if not 1 <= age <= self.packets:
            return
        slot = (self._slot - age) % self._window
        if self._latencies[slot] == _ABSENT:
            self._remember(slot, latency_ns)
            self._rate_latency()

    def steady(self, latency_ns: int) -> bool:
        """Whether the window holds nothing but answers in time of this latency: one more changes no figure."""
        window = self._window
        return (
            self.packets == self._answered == self._timed == window
            and self._sum == window * latency_ns
            and self._squares == window * latency_ns * latency_ns
        )

    def repeat(self, count: int) -> None:
        """Close `count` packets more in a `steady` window, each with the answer that the window is full of."""
        self._slot = (self._slot + count) % self._window

    def _remember(self, slot: int, latency_ns: int) -> None:
        self._latencies[slot] = latency_ns
        self._timed += 1
        self._sum += latency_ns
        self._squares += latency_ns * latency_ns

    def _forget(self, slot: int) -> None:
        latency_ns = self._latencies[slot]
        if latency_ns == _ABSENT:
            return
        self._latencies[slot] = _ABSENT
        self._timed -= 1
        self._sum -= latency_ns
        self._squares -= latency_ns * latency_ns

    def _rate_latency(self) -> None:
        count = self._timed
        if count == 0:
            self.latency = self.jitter = 0.0
            return
        self.latency = self._sum / count * 1e-9
        self.jitter = sqrt(max(0, self._squares * count - self._sum * self._sum)) / count * 1e-9
