"""The faults on the wire: how each is drawn and begins, and what a reason must say to name it."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.trust.stand import Stand

__all__ = ["FAULTS", "NAMED", "PERIODS_MS", "SEEN", "Fault"]

PERIODS_MS = (1, 2, 4, 5, 10, 20)

Random = np.random.Generator


@dataclass
class Fault:
    """A fault as it strikes: how to begin it, what it does to the expected end.

    begin : called in the cycle in which it strikes. harmless : the motion must succeed nevertheless
    untrue : packets may be taken for good that the controller did not send
    """

    name: str
    begin: Callable[[Stand], None]
    harmless: bool = False
    untrue: bool = False
    recounts: bool = False


def _wire(name: str, **settings: Any) -> Callable[[Random], Fault]:
    """A fault of the emulator's wire; a pair stands for the range from which a value is drawn."""

    def draw(random: Random) -> Fault:
        chosen: dict[str, Any] = {"kind": name, "cycles": int(random.integers(1, 80))}
        for key, value in settings.items():
            if isinstance(value, tuple) and isinstance(value[0], float):
                chosen[key] = float(random.uniform(*value))
            elif isinstance(value, tuple) and type(value[0]) is int:
                chosen[key] = int(random.integers(value[0], value[1] + 1))
            elif isinstance(value, tuple):
                chosen[key] = value[int(random.integers(len(value)))]
            else:
                chosen[key] = value
        to_pc = chosen["direction"] != "to_krc"
        untrue = to_pc and (name == "corrupt" or (name == "foreign" and chosen["host"] == "127.0.0.1"))
        harmless = name == "duplicate" or (name == "foreign" and not untrue)
        return Fault(name, lambda stand: stand.inject(**chosen), harmless, untrue)

    return draw


def _wrap(random: Random) -> Fault:
    """The counter wraps; where is set as the stand is built."""
    return Fault("wrap", lambda stand: None, harmless=True)


def _restart(random: Random) -> Fault:
    """The controller starts again, after some silence or none, with other counters, clock and port."""
    silent, new_port = int(random.integers(0, 60)), bool(random.random() < 0.5)
    # A cabinet counts from zero, after a mere friClose its clock goes on.
    first = int(random.choice([0, 0, int(random.integers(0, 65536))]))
    cold = bool(random.random() < 0.7)

    def begin(stand: Stand) -> None:
        uptime = 0.0 if cold else stand.session.timestamp_s + silent * stand.period_ms * 1e-3
        stand.clock.now_ns += max(silent * stand.period_ms, 200) * 1_000_000
        stand.restart(first, uptime, new_port=new_port)

    return Fault("restart", begin, recounts=True)


def _silent(random: Random) -> Fault:
    """The controller sends nothing for a while, or never again."""
    cycles = 10**6 if random.random() < 0.3 else int(random.integers(1, 150))
    return Fault("silent", lambda stand: setattr(stand, "silent", cycles))


def _fast(random: Random) -> Fault:
    """Packets come in heaps, faster than they can be answered."""
    cycles = int(random.integers(2, 40))
    return Fault("too fast", lambda stand: setattr(stand, "hurry", cycles))


def _slow(random: Random) -> Fault:
    """Cycles take longer than the sample time says, by less than what counts as silence."""
    cycles, extra = int(random.integers(2, 80)), float(random.uniform(0.5, 7.0))
    return Fault("too slow", lambda stand: stand.slow_down(cycles, extra), harmless=True)


def _pace(random: Random) -> Fault:
    """The controller's clock runs faster or slower than its sample time says."""
    factor = float(random.choice([0.25, 0.5, 0.9, 1.1, 2.0, 4.0]))

    def begin(stand: Stand) -> None:
        begun: list[float] = []

        def alter(packet: bytes, number: int) -> bytes:
            (timestamp,) = struct.unpack_from("<f", packet, 140)
            begun.append(timestamp) if not begun else None
            changed = bytearray(packet)
            struct.pack_into("<f", changed, 140, begun[0] + (timestamp - begun[0]) * factor)
            return bytes(changed)

        stand.alter = alter

    return Fault("clock pace", begin, harmless=True)


def _reopen(random: Random) -> Fault:
    """The program is selected anew with another cycle time."""
    period = int(random.choice(PERIODS_MS))
    return Fault("other cycle", lambda stand: stand.reopen(period), recounts=True)


def _version(random: Random) -> Fault:
    """Packets of another version of the protocol: another id, another size, or both."""
    cycles = 10**6 if random.random() < 0.3 else int(random.integers(1, 120))
    kind = int(random.integers(3))
    identifier = int(random.choice([0x2005, 0x2007, 0x1005, 0x3001]))
    size = int(random.choice([888, 908, 924, 1040]))

    def begin(stand: Stand) -> None:
        last = stand.packets + cycles

        def alter(packet: bytes, number: int) -> bytes:
            if number > last:
                stand.alter = None
                return packet
            changed = bytearray(packet)
            if kind != 1:
                struct.pack_into("<H", changed, 6, identifier)
            if kind != 0:
                struct.pack_into("<H", changed, 4, size)
                changed = changed[:size] + bytes(max(0, size - len(changed)))
            return bytes(changed)

        stand.alter = alter

    return Fault("other version", begin)


def _second_client(random: Random) -> Fault:
    """Another PC answers the controller too, and another controller sends to us."""
    cycles = int(random.integers(5, 120))
    host = str(random.choice(["127.0.0.1", "127.0.0.3"]))
    controller = bool(random.random() < 0.5)

    def begin(stand: Stand) -> None:
        last = stand.packets + cycles

        def beside(packet: bytes, number: int) -> None:
            if number > last:
                stand.beside = None
                return
            if controller:
                other = bytearray(packet)
                struct.pack_into("<HH", other, 0, (number * 7) & 0xFFFF, 5)
                stand.other(host).sendto(bytes(other), stand.end.remote)
            else:
                command = bytearray(376)
                struct.pack_into(
                    "<4H", command, 0, number & 0xFFFF, *struct.unpack_from("<H", packet), 376, 0x1005
                )
                struct.pack_into("<I7f", command, 140, 1, *np.linspace(-0.5, 0.5, 7))
                stand.other(host).sendto(bytes(command), stand.end.address)

        stand.beside = beside

    return Fault("second client", begin, harmless=True, untrue=controller and host == "127.0.0.1")


_BOTH = ("to_pc", "to_krc", "both")
FAULTS: dict[str, Callable[[Random], Fault]] = {
    "loss": _wire("loss", direction=_BOTH, probability=(0.02, 1.0)),
    "burst": _wire("burst", direction=_BOTH, probability=(0.02, 0.3), length=(2, 40)),
    "delay": _wire("delay", direction=_BOTH, probability=(0.05, 1.0), length=(1, 12)),
    "jitter": _wire("jitter", direction=_BOTH, probability=(0.05, 1.0), length=(1, 6)),
    "duplicate": _wire("duplicate", direction=_BOTH, probability=(0.1, 1.0)),
    "reorder": _wire("reorder", direction=_BOTH, probability=(0.05, 1.0)),
    "truncate": _wire("truncate", direction=_BOTH, probability=(0.05, 1.0)),
    "corrupt": _wire("corrupt", direction=_BOTH, probability=(0.05, 1.0), bits=(1, 12)),
    "foreign": _wire(
        "foreign",
        direction=_BOTH,
        probability=(0.1, 1.0),
        imitate=(True, False),
        host=("127.0.0.2", "127.0.0.1"),
    ),
    "wrap": _wrap,
    "restart": _restart,
    "silent": _silent,
    "too fast": _fast,
    "too slow": _slow,
    "clock pace": _pace,
    "other cycle": _reopen,
    "other version": _version,
    "second client": _second_client,
}

# What a reason must say to name the cause: what the PC can know of each fault.
_ANSWERS = r"[1-9]\d* answers missed"
_PACKETS = r"lost|no packet for|late|out of order"
_DAMAGED = r"malformed"
_AGAIN = r"started again|sample time"
NAMED: dict[str, str] = {
    "loss": f"{_ANSWERS}|{_PACKETS}",
    "burst": f"{_ANSWERS}|{_PACKETS}",
    "delay": f"{_ANSWERS}|{_PACKETS}",
    "jitter": f"{_ANSWERS}|{_PACKETS}",
    "reorder": f"{_ANSWERS}|{_PACKETS}",
    "truncate": f"{_ANSWERS}|{_DAMAGED}|{_PACKETS}",
    "corrupt": f"{_ANSWERS}|{_DAMAGED}|{_PACKETS}|{_AGAIN}|left|set point|measured position|drives",
    "restart": f"{_AGAIN}|{_PACKETS}",
    "silent": _PACKETS,
    "too fast": f"{_ANSWERS}|{_PACKETS}",
    "other cycle": f"{_AGAIN}|{_PACKETS}|left command mode",
    "other version": f"{_DAMAGED}",
    "clock pace": _AGAIN,
    "second client": _AGAIN,
    "foreign": "foreign|left command mode",
}

# The same while command mode is waited for: what is seen, and the advice.
_UNHEARD = r"unanswered in time|Answers come too late|answer rate 0|quality (UNACCEPTABLE|BAD)"
SEEN: dict[str, str] = {
    **dict.fromkeys(("loss", "burst", "delay", "jitter", "reorder", "truncate", "too fast"), _UNHEARD),
    "corrupt": f"{_UNHEARD}|not in position control",
    "other version": "not FRI 1.0",
    "restart": _UNHEARD,
    "second client": f"another address|{_UNHEARD}",
    "foreign": "another address",
}
