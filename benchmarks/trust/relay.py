"""A relay between controller and PC that loses datagrams, as a computer short of memory does on its own wires."""

from __future__ import annotations

import select
import socket
import threading
from collections.abc import Callable

__all__ = ["Relay"]


class Relay:
    """Passes datagrams on between the controller, who sends to `port`, and the PC. A context manager.

    pc_port : where the PC listens on 127.0.0.1. lose : asked for each datagram, by its number and whether it
    is on its way to the PC; True loses it

    passed, lost : counts of datagrams
    """

    def __init__(self, pc_port: int, lose: Callable[[int, bool], bool]) -> None:
        self._lose = lose
        self._pc = ("127.0.0.1", pc_port)
        self._controller: tuple[str, int] | None = None
        self._front, self._back, self._wake = (self._bound() for _ in range(3))
        self.port: int = self._front.getsockname()[1]
        self.passed = self.lost = 0
        self._thread = threading.Thread(target=self._run, daemon=True)

    @staticmethod
    def _bound() -> socket.socket:
        end = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        end.bind(("127.0.0.1", 0))
        return end

    def __enter__(self) -> Relay:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._back.sendto(b"", self._wake.getsockname())
        self._thread.join()
        for end in (self._front, self._back, self._wake):
            end.close()

    def _run(self) -> None:
        while True:
            ready, _, _ = select.select([self._front, self._back, self._wake], [], [])
            if self._wake in ready:
                return
            for end in ready:
                datagram, source = end.recvfrom(2048)
                to_pc = end is self._front
                self.passed += 1
                if self._lose(self.passed, to_pc):
                    self.lost += 1
                elif to_pc:
                    self._controller = source
                    self._back.sendto(datagram, self._pc)
                elif self._controller is not None:
                    self._front.sendto(datagram, self._controller)
