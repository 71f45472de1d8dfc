"""Bound addresses, the one answered controller, and reports of other senders."""

from __future__ import annotations

import contextlib
import logging
import socket
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from benchmarks.trust.lab import Lab, descendants
from benchmarks.trust.table import Ledger
from fri.errors import NetworkError
from fri.packets import new_msr
from fri.remote import RemoteEnd
from lwr_driver.control import Text

__all__ = ["campaign"]

_LISTEN = "0A"


def sockets(pids: list[int]) -> list[tuple[str, str, int]]:
    """Internet sockets of processes: protocol, local address, local port; TCP only where it listens.

    The kernel hands its tables out page by page, so that a socket opened or closed meanwhile by anybody
    shifts the rows: two readings must agree.
    """
    last, found = None, _sockets_once(pids)
    while found != last:
        last, found = found, _sockets_once(pids)
    return found


def _sockets_once(pids: list[int]) -> list[tuple[str, str, int]]:
    inodes = set()
    for pid in pids:
        try:
            for link in Path(f"/proc/{pid}/fd").iterdir():
                target = link.readlink().name
                if target.startswith("socket:["):
                    inodes.add(target[8:-1])
        except OSError:
            continue
    found = []
    for protocol in ("udp", "tcp", "udp6", "tcp6"):
        table = Path(f"/proc/net/{protocol}")
        for line in table.read_text().splitlines()[1:] if table.exists() else ():
            fields = line.split()
            if fields[9] not in inodes or (protocol.startswith("tcp") and fields[3] != _LISTEN):
                continue
            address, port = fields[1].split(":")
            ip = socket.inet_ntoa(struct.pack("<I", int(address, 16))) if len(address) == 8 else address
            found.append((protocol, ip, int(port, 16)))
    return found


@contextlib.contextmanager
def _said(name: str) -> Iterator[list[str]]:
    """What is told to the logger `name` meanwhile."""
    messages: list[str] = []

    class Ear(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            messages.append(record.getMessage())

    logger, ear = logging.getLogger(name), Ear()
    logger.addHandler(ear)
    try:
        yield messages
    finally:
        logger.removeHandler(ear)


def campaign(ledger: Ledger, options: Any) -> None:
    """All of it on the running processes."""
    with _said("lwr_driver.driver") as said, Lab() as lab:
        driver = lab.driver
        loop = driver._need(driver._loop).pid
        recorder = driver._need(driver._recorder).pid
        line = ledger.line("network", "bound by loop and recorder")
        bound = sockets([loop, recorder, *descendants(loop), *descendants(recorder)])
        line.figures = {"sockets": [f"{protocol} {ip}" for protocol, ip, _ in bound]}
        expected = [("udp", "127.0.0.1", driver.port)]
        line.count([] if bound == expected else [f"bound are {bound}, expected {expected}"])

        line = ledger.line("network", "strangers are not answered, and named")
        driver.wait_quality(cycles=50)
        before = driver.state()
        packet = new_msr()
        packet["state"], packet["power"], packet["control"] = 1, 0x7F, 1
        packet["msr_sample_time"] = packet["cmd_sample_time"] = 0.005
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
            stranger.bind(("127.0.0.9", 0))
            stranger.settimeout(0.3)
            for _ in range(20):
                stranger.sendto(packet.tobytes(), ("127.0.0.1", driver.port))
            driver.monitor(50)
            try:
                stranger.recv(2048)
                bad = ["a stranger got an answer"]
            except TimeoutError:
                bad = []
        driver.monitor(10)
        after = driver.state()
        if after.foreign - before.foreign != 20:
            bad.append(f"{after.foreign - before.foreign} of 20 foreign datagrams counted")
        note = driver._need(driver._control).text(Text.NOTE)
        if "127.0.0.9" not in note:
            bad.append(f"the stranger is not named: {note!r}")
        if not any("127.0.0.9" in message for message in said):
            bad.append(f"the driver has said nothing of the stranger, but {said}")
        line.count(bad)

        line = ledger.line("network", "a second client on the port is refused")
        try:
            RemoteEnd("127.0.0.1", driver.port).close()
            line.count(["two clients could bind the same port"])
        except NetworkError as error:
            line.count([] if "no other FRI client" in str(error) else [str(error)])
    line = ledger.line("network", "another controller than the configured")
    with (
        RemoteEnd("127.0.0.1", 0, controller="127.0.0.2") as end,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other,
    ):
        other.bind(("127.0.0.1", 0))
        other.sendto(packet.tobytes(), end.address)
        heard = end.receive(0.1)
        line.count([] if heard is None and end.foreign == 1 and end.controller is None else ["it was heard"])
    ledger.save()
