"""The FRI loop as a guest of the other side's process, for lock step without sockets.

The emulator's process has a `Seat`; the driver's process has the `LoopHost` of it, and a `HostedLoop` in place of a
`LoopProcess`. Loop, packets, requests and rows are the same: only the datagrams pass through a
`fri.in_process.Network` instead of UDP, and the two sides take turns instead of waiting for each other.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import socket
import time
import traceback
from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from fri.errors import ConfigurationError, LwrError, NetworkError
from fri.in_process import Network
from fri.packets import CMD
from lwr_driver.arm import ArmLimits
from lwr_driver.control import Control, Word
from lwr_driver.loop import Loop, LoopSettings
from lwr_driver.loop_process import Watch, loop_of, order_of
from lwr_driver.realtime import Rights
from lwr_driver.ring import Ring

T = TypeVar("T")

_NONE = np.zeros(0, CMD)
_MESSAGE_BYTES = 1 << 17
_START_TIMEOUT_S = 60.0
_END_TIMEOUT_S = 3.0


class LoopHost:
    """The driver's side of a `Seat`: `descriptor` goes to the child process with the seat, `pid` is its number.

    One loop at a time; the next may follow its end.
    """

    def __init__(self) -> None:
        self.connection, self._theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.pid = 0

    @property
    def descriptor(self) -> int:
        """File descriptor of the other end, for the child process."""
        return self._theirs.fileno()

    def started(self, pid: int) -> None:
        """The child process has its end."""
        self.pid = pid
        self._theirs.close()

    def close(self) -> None:
        """Give the connection up; a loop in the seat ends."""
        self.connection.close()
        self._theirs.close()


class HostedLoop:
    """Puts the loop into the seat and waits until it is there; the interface of `LoopProcess`.

    Raises ConfigurationError or NetworkError if the loop cannot be made there, NetworkError without an answer.
    """

    def __init__(
        self,
        host: LoopHost,
        settings: LoopSettings,
        limits: ArmLimits,
        control: Control,
        ring: Ring,
        watch: Watch,
    ) -> None:
        if not settings.lock_step:
            raise ConfigurationError("a loop in the emulator's process needs lock step; use UDP in real time")
        self._host, self._control = host, control
        self._end: str | None = None
        order = json.dumps(order_of(settings, limits, control, watch)).encode()
        try:
            socket.send_fds(host.connection, [order], [control.descriptor, ring.descriptor])
        except OSError as error:
            raise NetworkError(f"the emulator's process {host.pid} is gone: {error}") from error
        answer = self._next(_START_TIMEOUT_S)
        while answer is not None and "ended" in answer:  # the loop before this one
            answer = self._next(_START_TIMEOUT_S)
        if answer is None:
            raise NetworkError(f"the loop did not get ready within {_START_TIMEOUT_S:g} s")
        if "error" in answer:
            kinds = {kind.__name__: kind for kind in (NetworkError, ConfigurationError)}
            raise kinds.get(answer["kind"], LwrError)(answer["error"])
        self.port = int(answer.get("port", 0))
        self.rights = Rights()

    @property
    def pid(self) -> int:
        """Process id of the host."""
        return self._host.pid

    def check(self) -> None:
        """Raise NetworkError if the loop has ended by itself."""
        if self._end is None:
            self._next(0.0)
        if self._end is not None:
            raise NetworkError(f"the loop in process {self.pid} ended. {self._end}".strip())

    def stop(self) -> None:
        """Ask the loop to end, and wait for it."""
        self._control.words[Word.QUIT] = 1
        deadline = time.monotonic() + _END_TIMEOUT_S
        while self._end is None and (left := deadline - time.monotonic()) > 0.0:
            self._next(left)

    def _next(self, timeout_s: float) -> dict[str, Any] | None:
        """The next message of the seat; None without one. An end is noted."""
        try:
            if not select.select((self._host.connection,), (), (), timeout_s)[0]:
                return None
            content = self._host.connection.recv(_MESSAGE_BYTES)
        except (OSError, ValueError):
            content = b""
        if not content:
            self._end = "Its process is gone"
            return {"kind": "NetworkError", "error": f"the emulator's process {self.pid} is gone"}
        message: dict[str, Any] = json.loads(content)
        self._end = message.get("ended")
        return message


class Seat:
    """A place for one loop in this process.

    descriptor : the end of a `LoopHost`'s connection; network : shared with the other side
    """

    def __init__(self, descriptor: int, network: Network) -> None:
        self._connection = socket.socket(fileno=descriptor)
        self._network = network
        self._loop: Loop | None = None
        self._control: Control | None = None
        self._ring: Ring | None = None

    @property
    def descriptor(self) -> int:
        """File descriptor to wait at for `serve`."""
        return self._connection.fileno()

    def turn(self) -> bool:
        """Let the loop do one step; False if it handled no packet, or if there is none."""
        loop, control = self._loop, self._control
        if loop is None or control is None:
            return False
        if control.words[Word.QUIT]:
            self._leave("")
            return False
        return self._ask(loop.turn, False)

    def offer(self, most: int) -> NDArray[Any]:
        """Answers to the coming packets beforehand, see `Loop.offer`; none without a loop."""
        loop, control = self._loop, self._control
        if loop is None or control is None or control.words[Word.QUIT]:
            return _NONE
        return self._ask(partial(loop.offer, most), _NONE)

    def accept(self, packets: NDArray[Any], commands: NDArray[Any]) -> int:
        """For how many of the `packets` the answers hold, see `Loop.accept`."""
        return 0 if self._loop is None else self._ask(partial(self._loop.accept, packets, commands), 0)

    def take(self, packets: NDArray[Any], commands: NDArray[Any]) -> None:
        """Hand accepted `packets` over, see `Loop.take`."""
        if self._loop is not None:
            self._ask(partial(self._loop.take, packets, commands), None)

    def _ask(self, question: Callable[[], T], otherwise: T) -> T:
        try:
            return question()
        except Exception as error:  # a process of its own would have ended
            traceback.print_exc()
            self._leave(f"{type(error).__name__}: {error}")
            return otherwise

    def serve(self) -> bool:
        """Take an order; False if the driver's process is gone."""
        try:
            content, descriptors, _, _ = socket.recv_fds(self._connection, _MESSAGE_BYTES, 2)
        except OSError:
            content, descriptors = b"", []
        if not content:
            self._leave("")
            return False
        self._leave("another one took its seat")
        control, ring = descriptors
        try:
            order = json.loads(content)
            self._control = Control(control, order["plan_rows"])
            self._ring = Ring.attach(f"/proc/self/fd/{ring}")
            self._loop = loop_of(order, self._control, self._ring, self._network)
        except LwrError as error:
            self._leave("")
            self._say({"error": str(error), "kind": type(error).__name__})
            return True
        finally:
            os.close(ring)
        self._loop.begin()
        self._say({"port": self._loop.remote.address[1]})
        return True

    def close(self) -> None:
        """End the loop and the connection."""
        self._leave("")
        self._connection.close()

    def _leave(self, why: str) -> None:
        loop, self._loop = self._loop, None
        if loop is not None:
            loop.end()
            self._say({"ended": why})
        if self._ring is not None:
            self._ring.close()
            self._ring = None
        if self._control is not None:
            self._control.close()
            self._control = None

    def _say(self, message: dict[str, Any]) -> None:
        with contextlib.suppress(OSError):
            self._connection.send(json.dumps(message).encode())
