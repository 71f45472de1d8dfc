"""A network inside one process: ports that pass datagrams without sockets.

A `Port` has the methods of a UDP socket in use by `fri.remote.RemoteEnd` and `fri.controller_end.ControllerEnd`. Both
ends then run in one thread, in turn: a datagram is there as soon as it is sent, nothing waits, nothing is lost.
"""

from __future__ import annotations

from collections import deque

Address = tuple[str, int]

_FIRST_FREE = 49152


class Network:
    """Ports by address; a datagram to a closed port is refused, as by the network of one host."""

    def __init__(self) -> None:
        self._ports: dict[Address, Port] = {}

    def bind(self, host: str, port: int = 0) -> Port:
        """A new port at an address; port 0 takes a free one. OSError if it is in use."""
        if port == 0:
            port = next(free for free in range(_FIRST_FREE, 65536) if (host, free) not in self._ports)
        if (host, port) in self._ports:
            raise OSError(98, "Address already in use")
        self._ports[host, port] = made = Port(self, (host, port))
        return made

    def send(self, data: bytes | bytearray | memoryview, source: Address, target: Address) -> None:
        """Pass a datagram on. ConnectionRefusedError if the target is closed."""
        port = self._ports.get(target)
        if port is None:
            raise ConnectionRefusedError(111, "Connection refused")
        port.waiting.append((bytes(data), source))

    def release(self, address: Address) -> None:
        """Close the port at an address."""
        self._ports.pop(address, None)


class Port:
    """One end on a `Network`; `waiting` holds its datagrams and their sources, oldest first."""

    def __init__(self, network: Network, address: Address) -> None:
        self._network = network
        self._address = address
        self.waiting: deque[tuple[bytes, Address]] = deque()

    def getsockname(self) -> Address:
        """Address of the port."""
        return self._address

    def sendto(self, data: bytes | bytearray | memoryview, target: Address) -> int:
        """Send one datagram. ConnectionRefusedError if the target is closed."""
        self._network.send(data, self._address, target)
        return len(data)

    def recvfrom(self, size: int) -> tuple[bytes, Address]:
        """The next datagram and its source. BlockingIOError if none is waiting."""
        if not self.waiting:
            raise BlockingIOError
        return self.waiting.popleft()

    def recvfrom_into(self, buffer: bytearray, size: int = 0, flags: int = 0) -> tuple[int, Address]:
        """The next datagram into `buffer`; its length and source. BlockingIOError if none is waiting."""
        if not self.waiting:
            raise BlockingIOError
        data, source = self.waiting.popleft()
        length = min(len(data), len(buffer))
        buffer[:length] = data[:length]
        return length, source

    def recv_into(self, buffer: bytearray, size: int = 0, flags: int = 0) -> int:
        """Length of the next datagram, put into `buffer`. BlockingIOError if none is waiting."""
        return self.recvfrom_into(buffer)[0]

    def fileno(self) -> int:
        """No file descriptor belongs to it."""
        return -1

    def close(self) -> None:
        """Refuse what comes from now on."""
        self._network.release(self._address)
        self.waiting.clear()
