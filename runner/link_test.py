"""The link under test: what arrives, whether it is FRI 1.0, and how well this computer answers it.

First the port is listened to without answering, so that anything that arrives can be told, FRI or not. Then
the driver's own loop answers for some seconds, in monitor mode: nothing moves.
"""

from __future__ import annotations

import socket
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fri.errors import LwrError
from fri.packets import MSR_ID, MSR_SIZE
from lwr_driver.driver import Driver, LinkState

__all__ = ["Heard", "LinkTest", "exercise", "listen"]

_HEADER = np.dtype([("send_seq", "<u2"), ("refl_seq", "<u2"), ("packet_size", "<u2"), ("datagram_id", "<u2")])
_LARGEST = 65535
_SLICE_S = 0.2
_REPORT_S = 0.5


@dataclass(frozen=True)
class Heard:
    """What came while the port was only listened to.

    kinds : (source address, bytes, datagram id) with how often; the id is -1 where there is no room for one
    """

    waited_s: float
    kinds: Counter[tuple[str, int, int]] = field(default_factory=Counter)

    @property
    def fri(self) -> tuple[str, ...]:
        """Sources that send FRI 1.0."""
        return tuple(sorted({k[0] for k in self.kinds if k[1:] == (MSR_SIZE, MSR_ID)}))

    def __str__(self) -> str:
        if not self.kinds:
            return "nothing"
        parts = []
        for (source, size, number), count in self.kinds.most_common(4):
            name = f"id 0x{number:04x}" if number >= 0 else "no id"
            parts.append(f"{count} datagrams of {size} bytes with {name} from {source}")
        return ", ".join(parts)


def listen(
    address: str,
    port: int,
    controller: str | None,
    wait_s: float,
    report: Callable[[float, Heard], None] | None = None,
) -> Heard:
    """Listen until an FRI packet of the controller comes, at most `wait_s`; answers nothing.

    report : called about twice a second with the time waited and what was heard
    """
    kinds: Counter[tuple[str, int, int]] = Counter()
    began = time.monotonic()
    told = began
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as end:
        end.bind((address, port))
        while True:
            waited = time.monotonic() - began
            heard = Heard(waited, kinds)
            if waited >= wait_s or (heard.fri and (controller is None or controller in heard.fri)):
                return heard
            if report is not None and time.monotonic() - told >= _REPORT_S:
                told = time.monotonic()
                report(waited, heard)
            end.settimeout(max(1e-3, min(_SLICE_S, wait_s - waited)))
            try:
                datagram, source = end.recvfrom(_LARGEST)
            except TimeoutError:
                continue
            number = -1
            if len(datagram) >= _HEADER.itemsize:
                number = int(np.frombuffer(datagram, _HEADER, 1)[0]["datagram_id"])
            kinds[(source[0], len(datagram), number)] += 1


@dataclass(frozen=True, eq=False)
class LinkTest:
    """The link over `seconds` in which the loop answered every packet with the mirror.

    start, end : states before and after. worst_quality : lowest seen. edges, counts : histogram of the reply
    latency, upper edges [s]. msr : the last packet, dtype `fri.packets.MSR`, shape (). fresh : how often the
    counter of the motor torques moved on, None where none is configured. trouble : what ended the test early
    """

    seconds: float
    start: LinkState
    end: LinkState
    worst_quality: str
    edges: NDArray[np.float64]
    counts: NDArray[np.int64]
    msr: Any
    fresh: int | None = None
    trouble: LwrError | None = None

    @property
    def packets(self) -> int:
        """Packets received in the time."""
        return self.end.received - self.start.received

    @property
    def rate_hz(self) -> float:
        """Packets a second."""
        return self.packets / self.seconds if self.seconds > 0.0 else 0.0

    def between(self, name: str) -> int:
        """Growth of a counter of the link, such as `lost`."""
        return int(getattr(self.end, name) - getattr(self.start, name))

    @property
    def in_time(self) -> float:
        """Share of the cycles whose answer the controller had before it sent its next packet."""
        cycles = self.packets + self.between("lost")
        return 1.0 - min(1.0, (self.between("late") + self.between("lost")) / cycles) if cycles else 0.0


def exercise(
    driver: Driver,
    seconds: float,
    *,
    counter_int: int | None = None,
    report: Callable[[float, LinkState], None] | None = None,
) -> LinkTest:
    """Let a connected driver answer for `seconds` and see how it goes. Nothing is commanded."""
    ranks = ("UNACCEPTABLE", "BAD", "OK", "PERFECT")
    first = driver.state()
    # The controller rates the last hundred packets, so its verdict on the beginning is left out.
    settle = max(100, round(0.5 / first.period_s))
    trouble: LwrError | None = None
    worst, count_before = len(ranks) - 1, 0
    start = first
    _, counts_before = driver.latency_histogram()
    began = time.monotonic()
    try:
        driver.monitor(settle)
        start = driver.state()
        _, counts_before = driver.latency_histogram()
        count_before = _count(driver, counter_int)
        began = time.monotonic()
        while time.monotonic() - began < seconds:
            driver.monitor(max(1, round(_REPORT_S / start.period_s)))
            state = driver.state()
            worst = min(worst, ranks.index(state.quality))
            if report is not None:
                report(time.monotonic() - began, state)
    except LwrError as error:
        trouble = error
    elapsed = time.monotonic() - began
    end = driver.state()
    edges, counts = driver.latency_histogram()
    fresh = None if counter_int is None else _count(driver, counter_int) - count_before
    rows = driver.last_rows(1)
    return LinkTest(
        elapsed, start, end, ranks[worst], edges, counts - counts_before, rows[0]["msr"], fresh, trouble
    )


def _count(driver: Driver, counter_int: int | None) -> int:
    rows = driver.last_rows(1)
    return 0 if counter_int is None or not len(rows) else int(rows[0]["msr"]["krl_int"][counter_int - 1])
