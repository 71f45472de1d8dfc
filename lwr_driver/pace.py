"""The pace of the controller's packets against a clock: rows of a motion never pass faster than time does.

A row belongs to a cycle of the controller, and cycles are counted by its packets. Two faults of a sender would make
the arm faster than planned: a counter running ahead of its own time stamp, and packets faster than their header says.
Packets after a pause of the network or of this computer are neither: they come late, not early.
"""

from __future__ import annotations

from math import ceil, floor

# Clocks may differ by this share; the reference follows the packets so fast [cycles per cycle].
_SLEW = 0.002
# A packet may come so early: share of a cycle, and time [s].
_EARLY_SHARE, _EARLY_S = 0.75, 0.5e-3
# Held-back packets weigh 1, others take off so much; beyond the limit the sender is too fast.
_FORGET, _TOO_MANY = 0.05, 20.0
_SEVERAL = 5.0
_MEAN = 0.02
# A clock that differs by more from the packets' period says nothing about their number.
_CREDIBLE = 0.25
_FLOAT32_EPS = 1.2e-7


class Pace:
    """Cycles that have passed on this computer's clock, by the arrival of packets.

    mean : time between packets, a moving average [cycles]
    """

    def __init__(self) -> None:
        self._period_ns = self._most = self._slack = 0.0
        self.reset(1e-3, 100)

    def reset(self, period_s: float, most: int) -> None:
        """Begin anew with the period of the header [s]. most : packets that may wait after a pause."""
        self._period_ns, self._most = period_s * 1e9, float(most)
        self._slack = _EARLY_SHARE + _EARLY_S / period_s
        self._last_ns = -1
        self._lead = self._reference = 0.0  # cycles given out less cycles passed, and its usual value
        self._score = 0.0
        self.mean = 1.0

    def feed(self, cycles: int, now_ns: int, *, answered: bool = False) -> int:
        """How many of the `cycles` counted by a packet at `now_ns` have passed, 0 for a packet ahead of its time.

        answered : the packet was in time for its answer, so at least one
        """
        if self._last_ns < 0:
            self._last_ns = now_ns
            return cycles
        passed = (now_ns - self._last_ns) / self._period_ns
        self._last_ns = now_ns
        self.mean += _MEAN * (passed / cycles - self.mean)
        lead = self._lead - passed
        given = min(cycles, max(floor(self._reference + self._slack - lead), int(answered)))
        self._lead = lead = lead + given
        step = _SLEW * max(passed, 0.0)
        self._reference += min(max(lead - self._reference, -step), step)
        self._reference = min(self._reference, lead + self._most)
        self._score = max(self._score + (1.0 if given == 0 else -_FORGET), 0.0)
        return given

    @property
    def due_ns(self) -> int:
        """Earliest time of the next packet; later ones are due a period after each other."""
        if self._last_ns < 0:
            return 0
        return self._last_ns + ceil((1.0 - self._slack - self._reference + self._lead) * self._period_ns)

    @property
    def period_ns(self) -> int:
        """Period of the header [ns]."""
        return round(self._period_ns)

    @property
    def too_fast(self) -> bool:
        """Whether far too many of the last packets came ahead of their time."""
        return self._score > _TOO_MANY

    @property
    def hasty(self) -> bool:
        """Whether several of the last packets came ahead of their time."""
        return self._score > _SEVERAL

    def __str__(self) -> str:
        ms = self._period_ns * 1e-6
        return f"the header says {ms:g} ms a cycle, packets come every {self.mean * ms:.2g} ms"


class Stamps:
    """Cycles that have passed on the controller's own clock, by the time stamps of packets."""

    def __init__(self) -> None:
        self._stamp, self._credible = 0.0, False

    def feed(self, cycles: int, stamp_s: float, period_s: float) -> int:
        """How many of the `cycles` between two packets have passed, at least 1; all where the stamps cannot tell."""
        elapsed = (stamp_s - self._stamp) / period_s
        fine = _FLOAT32_EPS * abs(stamp_s) < 0.25 * period_s
        credible = self._credible and fine
        self._stamp = stamp_s
        if cycles == 1:
            self._credible = fine and abs(elapsed - 1.0) < _CREDIBLE
        if cycles == 1 or not credible or elapsed < 0.0:
            return cycles
        return min(cycles, max(1, ceil(elapsed / (1.0 - 0.5 * _CREDIBLE) - 0.25)))
