"""The controller's socket: sends first, collects the answers of one PC.

``lock_step`` and ``real_time`` run whole cycles of a session. An emulator with faults on the wire uses ``send``
and ``receive`` instead.
"""

from __future__ import annotations

import contextlib
import select
import socket
from collections.abc import Callable
from time import monotonic

from fri.errors import NetworkError
from fri.in_process import Network, Port
from fri.krc import KrcSession, Sample, Setpoint
from fri.states import State

_BUFFER_SIZE = 2048
_SLICE_S = 0.05
_RESEND_S = 0.2
# Of linux/in.h: errors of the network come back to the socket, as the closed port of a PC that left.
_IP_RECVERR = 11
# Time for passing over foreign datagrams, even with a timeout of zero.
_SHORTEST_FLOOD_S = 0.005


class ControllerEnd:
    """UDP client of the controller; as a context manager it closes the socket.

    remote : address and port of the PC; other datagrams are counted in `foreign` and dropped. `refused` counts its
    answers that the port is closed
    local : address and port to send from; port 0 is any free one, as in ``friSetup(..., 0)``
    network : a network inside this process instead of UDP; `receive` never waits there

    Raises NetworkError if the local address cannot be bound.
    """

    def __init__(
        self,
        remote: tuple[str, int],
        local: tuple[str, int] = ("127.0.0.1", 0),
        network: Network | None = None,
    ) -> None:
        self.remote = remote
        self._socket: socket.socket | Port
        try:
            self._socket = _bound(local) if network is None else network.bind(*local)
        except OSError as error:
            raise NetworkError(
                f"cannot bind UDP {local[0]}:{local[1]} for the controller: {error.strerror}; "
                "choose a free port or 0"
            ) from error
        self.address: tuple[str, int] = self._socket.getsockname()
        self.foreign = 0
        self.send_errors = 0
        self.refused = 0

    def fileno(self) -> int:
        """File descriptor, for waiting for several sockets at once."""
        return self._socket.fileno()

    @property
    def waiting(self) -> bool:
        """Whether a datagram is there, on a network inside this process."""
        return isinstance(self._socket, Port) and bool(self._socket.waiting)

    def send(self, datagram: bytes) -> None:
        """Send one datagram to the PC; refusals of the network are counted in `send_errors`."""
        # The error of an earlier datagram is reported instead of sending the next one.
        for _ in range(3):
            try:
                self._socket.sendto(datagram, self.remote)
            except ConnectionRefusedError:
                self._take_errors()
            except OSError:
                self.send_errors += 1
                return
            else:
                return

    def _take_errors(self) -> None:
        """Empty the queue of errors from the network."""
        self.refused += 1
        with contextlib.suppress(OSError):
            while not isinstance(self._socket, Port):
                self._socket.recvmsg(_BUFFER_SIZE, _BUFFER_SIZE, socket.MSG_ERRQUEUE)

    def receive(self, timeout_s: float) -> bytes | None:
        """Next datagram of the PC, or None after `timeout_s` [s]; 0 does not wait."""
        began = monotonic()
        deadline, flooded = began + timeout_s, began + max(timeout_s, _SHORTEST_FLOOD_S)
        while True:
            try:
                datagram, source = self._socket.recvfrom(_BUFFER_SIZE)
            except BlockingIOError:
                remaining = deadline - monotonic()
                if remaining <= 0.0 or isinstance(self._socket, Port):
                    return None
                select.select((self._socket,), (), (), remaining)
                continue
            except OSError:
                self._take_errors()
                continue
            if source == self.remote:
                return datagram
            self.foreign += 1
            if monotonic() >= flooded:
                return None

    def lock_step(
        self,
        session: KrcSession,
        sample: Sample,
        *,
        patience_s: float = 10.0,
        idle: Callable[[], bool] | None = None,
    ) -> Setpoint | None:
        """One cycle in virtual time, which waits for the answer of the PC.

        The wait has no end in monitor mode; in command mode the answer is missing after `patience_s` [s] of
        real time. A malformed answer ends the wait too. Before the first answer of a session the packet is
        sent again every 0.2 s. `idle` is called every 50 ms of waiting; if it returns True the cycle is given
        up: the result is None and the session must be closed.
        """
        if session.state is State.OFF:
            return session.close_cycle()
        packet = session.packet(sample)
        self.send(packet)
        commanding = session.state is State.CMD
        unheard = session.counters()["answered"] == 0
        started = sent = monotonic()
        while not (session.answered or session.malformed_now):
            datagram = self.receive(_SLICE_S)
            if datagram is not None:
                session.receive(datagram)
                continue
            if idle is not None and idle():
                return None
            now = monotonic()
            if commanding and now - started >= patience_s:
                break
            if unheard and now - sent >= _RESEND_S:
                self.send(packet)
                sent = now
        return session.close_cycle()

    def real_time(self, session: KrcSession, sample: Sample, deadline: float) -> Setpoint:
        """One cycle in real time: send now, collect answers until `deadline` (``time.monotonic``), close."""
        if session.state is State.OFF:
            while self.receive(max(0.0, deadline - monotonic())) is not None:
                continue
            return session.close_cycle()
        sent = monotonic()
        self.send(session.packet(sample))
        while True:
            datagram = self.receive(max(0.0, deadline - monotonic()))
            if datagram is None:
                return session.close_cycle()
            now = monotonic()
            session.receive(datagram, now - sent)
            if now >= deadline:
                return session.close_cycle()

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def __enter__(self) -> ControllerEnd:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _bound(local: tuple[str, int]) -> socket.socket:
    end = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        end.bind(local)
    except OSError:
        end.close()
        raise
    end.setblocking(False)
    end.setsockopt(socket.IPPROTO_IP, _IP_RECVERR, 1)
    return end
