"""Faults on the wire, made by the emulator on its own side of the socket, from seeded streams.

Two directions: measurements on their way `to_pc`, commands on their way `to_krc`. Times are in FRI cycles, so
the faults are the same in lock step and in real time. Lock step waits for an answer only if the fault of the
measurement leaves it possible (`Parcel.awaited`).
"""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple

import numpy as np

from fri.quantities import check, entries, within

Kind = Literal["loss", "burst", "delay", "jitter", "duplicate", "reorder", "truncate", "corrupt", "foreign"]


@dataclass(frozen=True)
class WireFault:
    """One fault on the wire.

    loss : a datagram disappears. burst : so do the `length` - 1 after it
    delay : it arrives `length` cycles later. jitter : to_krc it ages by up to `length` cycles, evenly
    distributed; to_pc it arrives 1 to `length` cycles later. reorder : the next one overtakes it. duplicate :
    it arrives twice
    truncate : its end is missing. corrupt : `bits` random bits are flipped
    foreign : another host (`host`) sends a datagram of its own beside it, `imitate`: a changed copy of ours
    probability : per datagram. cycles : the fault ends after so many, None never
    """

    kind: Kind
    direction: Literal["to_pc", "to_krc", "both"] = "both"
    probability: Annotated[float, within(0.0, 1.0, "share")] = 1.0
    cycles: Annotated[int, within(1, 10**9)] | None = None
    length: Annotated[int, within(1, 100_000)] = 3
    bits: Annotated[int, within(1, 10_000)] = 1
    host: Annotated[str, entries(1, 253)] = "127.0.0.2"
    imitate: bool = True

    def __post_init__(self) -> None:
        check(self)


class Parcel(NamedTuple):
    """One datagram to the PC. `host` sends it, None ourselves; `sequence` is its unwrapped counter, -1 if
    foreign.

    awaited : `yes`: a measurement new to the PC, so an answer can come; `perhaps`: a damaged one, perhaps valid
    to the PC; `no`: a repeated or foreign one
    """

    host: str | None
    datagram: bytes
    sequence: int
    awaited: Literal["yes", "perhaps", "no"]


class Incoming(NamedTuple):
    """A command on arrival at the session: the datagram and its age [s]."""

    datagram: bytes
    age_s: float


class _Active:
    def __init__(self, fault: WireFault, random: np.random.Generator, since: int) -> None:
        self.fault = fault
        self.random = random
        self.until = None if fault.cycles is None else since + fault.cycles
        self.burst_left = {"to_pc": 0, "to_krc": 0}

    def strikes(self) -> bool:
        return bool(self.random.random() < self.fault.probability)


class FaultyWire:
    """The wire of one emulator. `cycle` counts FRI cycles since the start and never goes back."""

    def __init__(self, random: np.random.SeedSequence, period_s: float) -> None:
        self._random = random
        self.period_s = period_s
        self._active: dict[int, _Active] = {}
        self._numbers = itertools.count(1)
        self._order = itertools.count()
        self._to_pc: list[tuple[int, int, bytes]] = []
        self._to_krc: list[tuple[int, bool, int, bytes, float]] = []
        self._beside: list[Parcel] = []
        self._highest = -1
        self.struck = 0

    @property
    def quiet(self) -> bool:
        """Whether there is neither a fault nor anything left over from one."""
        return not (self._active or self._to_pc or self._to_krc or self._beside)

    @property
    def active(self) -> dict[int, WireFault]:
        """Faults by number."""
        return {number: active.fault for number, active in self._active.items()}

    def inject(self, fault: WireFault, cycle: int) -> int:
        """Begin `fault` at `cycle`; returns its number, also that of its random stream."""
        number = next(self._numbers)
        stream = np.random.default_rng(self._random.spawn(1)[0])
        self._active[number] = _Active(fault, stream, cycle)
        return number

    def clear(self) -> None:
        """End all faults; datagrams under way still arrive."""
        self._active.clear()

    def restart(self) -> None:
        """The controller has restarted: its counters begin anew, nothing is under way."""
        self._to_pc.clear()
        self._to_krc.clear()
        self._beside.clear()
        self._highest = -1

    def _faults(self, direction: str, cycle: int) -> Iterable[_Active]:
        for number in [n for n, a in self._active.items() if a.until is not None and cycle >= a.until]:
            del self._active[number]
        return [a for a in self._active.values() if a.fault.direction in (direction, "both")]

    def outgoing(self, datagram: bytes, sequence: int, cycle: int) -> list[Parcel]:
        """Datagrams to send in `cycle`, in order, for its measurement and the unwrapped send counter.

        Repeated, damaged and foreign datagrams wait for an answerable measurement and go ahead of it. Their
        effects at the PC are thus over when its answer comes, and lock step stays repeatable.
        """
        own, beside = self._spoil("to_pc", datagram, cycle)
        for late, copy in own:
            heapq.heappush(self._to_pc, (cycle + int(late), sequence, copy))
        for host, copy in beside:
            whole = host is None and len(copy) == len(datagram)
            number = sequence if host is None else -1
            self._beside.append(Parcel(host, copy, number, "perhaps" if whole else "no"))
        clean: list[Parcel] = []
        while self._to_pc and self._to_pc[0][0] <= cycle:
            _, number, due = heapq.heappop(self._to_pc)
            if number > self._highest:
                self._highest = number
                clean.append(Parcel(None, due, number, "yes"))
            else:
                self._beside.append(Parcel(None, due, number, "no"))
        if not clean:
            return []
        parcels = [*self._beside, *clean]
        self._beside.clear()
        return parcels

    def incoming(self, datagram: bytes, age_s: float, cycle: int) -> list[tuple[str | None, bytes]]:
        """Take in a command of `cycle` for `due`; returns the datagrams of foreign hosts to the controller."""
        own, sidelong = self._spoil("to_krc", datagram, cycle)
        for late, copy in own:
            self._store(copy, cycle, age_s + late * self.period_s)
        for host, copy in sidelong:
            if host is None:
                self._store(copy, cycle, age_s)
        return [(host, copy) for host, copy in sidelong if host is not None]

    def _store(self, datagram: bytes, cycle: int, age_s: float) -> None:
        whole = int(age_s // self.period_s)
        rest_s = age_s - whole * self.period_s
        # A late command sorts after the punctual one of its cycle and is overtaken.
        entry = (cycle + whole, whole > 0, next(self._order), datagram, rest_s)
        heapq.heappush(self._to_krc, entry)

    def due(self, cycle: int) -> list[Incoming]:
        """Commands arriving at the session in `cycle`, in order."""
        arrived = []
        while self._to_krc and self._to_krc[0][0] <= cycle:
            _, _, _, datagram, age_s = heapq.heappop(self._to_krc)
            arrived.append(Incoming(datagram, age_s))
        return arrived

    def _spoil(
        self, direction: str, datagram: bytes, cycle: int
    ) -> tuple[list[tuple[float, bytes]], list[tuple[str | None, bytes]]]:
        """(lateness in cycles, clean copy) of the datagram, and (host, datagram) of foreign and damaged ones."""
        late: float | None = 0.0
        clean = True
        repeats = [0.0]
        beside: list[tuple[str | None, bytes]] = []
        for active in self._faults(direction, cycle):
            fault, random = active.fault, active.random
            if active.burst_left[direction] > 0:
                active.burst_left[direction] -= 1
                late = None
                self.struck += 1
                continue
            if not active.strikes():
                continue
            self.struck += 1
            match fault.kind:
                case "loss":
                    late = None
                case "burst":
                    late = None
                    active.burst_left[direction] = fault.length - 1
                case "delay":
                    late = None if late is None else late + fault.length
                case "jitter" if direction == "to_pc":
                    late = None if late is None else late + int(random.integers(1, fault.length + 1))
                case "jitter":
                    late = None if late is None else late + float(random.uniform(0.0, fault.length))
                case "reorder":
                    # Own datagrams come first in their cycle: the overtaken one must be two cycles late to the PC.
                    late = None if late is None else late + (2.0 if direction == "to_pc" else 1.0)
                case "duplicate":
                    # To the PC the copy must arrive between the original and the next one.
                    repeats = [0.0, 1.0 if direction == "to_pc" else 0.0]
                case "truncate":
                    datagram, clean = datagram[: int(random.random() * len(datagram))], False
                case "corrupt":
                    datagram, clean = _flip(datagram, fault.bits, random), False
                case "foreign":
                    other = _flip(datagram, 8, random) if fault.imitate else random.bytes(len(datagram))
                    beside.append((fault.host, other))
        if late is None:
            return [], beside
        if not clean:
            beside.append((None, datagram))
            return [], beside
        return [(late + repeat, datagram) for repeat in repeats], beside


def _flip(datagram: bytes, bits: int, random: np.random.Generator) -> bytes:
    damaged = bytearray(datagram)
    if damaged:
        for place in random.integers(0, 8 * len(damaged), bits):
            damaged[place // 8] ^= 1 << (place % 8)
    return bytes(damaged)
