"""The teach pendant over UDP: status and actions of an operator at the emulated controller.

Requests and replies are JSON datagrams on 127.0.0.1. Request: ``{"id": n, "command": name, "arguments":
{...}}``; reply: ``{"id": n, "ok": true, "result": ...}`` or ``{"id": n, "ok": false, "error": text}``. A
repeated request (late reply) is answered again but carried out once.

`Pendant` is the client. The commands are the methods of `sim_backend.operator.Operator`.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import socket
import time
from collections import OrderedDict
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from fri.errors import ConfigurationError, NetworkError, RobotError

MAX_DATAGRAM = 65_000
_REMEMBERED = 64
_TRACE_S = 120.0


class Pendant:
    """Client of one emulator's pendant; a context manager.

    Every call returns the result, or raises RobotError with the emulator's reason, or NetworkError when the
    emulator does not answer within `timeout_s`.
    """

    def __init__(self, port: int, *, host: str = "127.0.0.1", timeout_s: float = 10.0) -> None:
        self.address = (host, port)
        self.timeout_s = timeout_s
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.connect(self.address)
        # Ids of different clients must differ.
        self._ids = itertools.count((os.getpid() << 20) + (time.monotonic_ns() & 0xFFFFF))

    def __enter__(self) -> Pendant:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Release the socket; the emulator goes on."""
        self._socket.close()

    def request(self, command: str, **arguments: Any) -> Any:
        """Send one command and return its result."""
        number = next(self._ids)
        message = json.dumps({"id": number, "command": command, "arguments": arguments}).encode()
        deadline = time.monotonic() + self.timeout_s
        while (remaining := deadline - time.monotonic()) > 0.0:
            try:
                self._socket.send(message)
                reply = self._reply(number, min(remaining, 0.5))
            except ConnectionRefusedError as error:
                raise NetworkError(
                    f"emulator at {self.address[0]}:{self.address[1]} is gone (command `{command}`)"
                ) from error
            if reply is None:
                continue
            if reply["ok"]:
                return reply["result"]
            raise RobotError(f"emulator refused `{command}`: {reply['error']}")
        raise NetworkError(
            f"emulator at {self.address[0]}:{self.address[1]} did not answer `{command}` "
            f"within {self.timeout_s:g} s"
        )

    def _reply(self, number: int, timeout_s: float) -> dict[str, Any] | None:
        deadline = time.monotonic() + timeout_s
        while (remaining := deadline - time.monotonic()) > 0.0:
            self._socket.settimeout(remaining)
            try:
                reply: dict[str, Any] = json.loads(self._socket.recv(MAX_DATAGRAM))
            except TimeoutError:
                return None
            if reply.get("id") == number:
                return reply
        return None

    def status(self) -> dict[str, Any]:
        """State of controller, arm, link and command monitor; see `Operator.status`."""
        return dict(self.request("status"))

    def mount(
        self,
        payload: str | None = None,
        *,
        mass: float | None = None,
        com: Sequence[float] = (0.0, 0.0, 0.0),
        inertia: Sequence[float] = (0.0,) * 6,
    ) -> None:
        """Hang a payload on the flange: by its name in the parameter file, or by its properties.

        mass [kg], com in the frame of link 7 [m], inertia XX XY XZ YY YZ ZZ about the centre of mass [kg
        m^2].
        """
        self.request("mount", payload=payload, mass=mass, com=list(com), inertia=list(inertia))

    def unmount(self) -> None:
        """Take the payload off."""
        self.request("unmount")

    def set_load(
        self, mass: float, com: Sequence[float] = (0.0, 0.0, 0.0), inertia: Sequence[float] = (0.0,) * 6
    ) -> None:
        """Load data of the controller (`$LOAD`), independent of the mounted payload."""
        self.request("set_load", mass=mass, com=list(com), inertia=list(inertia))

    def drives(self, on: bool) -> None:
        """Switch the drives on (from wherever the arm stands) or off (brakes close)."""
        self.request("drives", on=on)

    def emergency_stop(self) -> None:
        """Press the emergency stop: drives off, brakes closed, latched until `release_emergency_stop`."""
        self.request("emergency_stop")

    def release_emergency_stop(self) -> None:
        """Release the emergency stop; the drives stay off."""
        self.request("release_emergency_stop")

    def mode(self, name: str) -> None:
        """Turn the mode switch: T1, T2, AUT or EXT; switching stops the motion and drops the drives."""
        self.request("mode", name=name)

    def start_program(self, name: str | None = None, period_ms: float | None = None) -> None:
        """Select and start a KRL program (see `fri.krl`); None is the configured one."""
        self.request("start_program", name=name, period_ms=period_ms)

    def stop_program(self) -> None:
        """Cancel the KRL program: FRI closes, the controller falls silent."""
        self.request("stop_program")

    def restart(self, silent_cycles: int = 1000) -> None:
        """Cold start of the controller: silence, counters from zero, program started again."""
        self.request("restart", silent_cycles=silent_cycles)

    def silence(self, cycles: int | None = None) -> None:
        """The controller sends nothing for `cycles` cycles, None for ever."""
        self.request("silence", cycles=cycles)

    def inject(self, kind: str, **settings: Any) -> int:
        """Start a fault on the wire (see `sim_backend.faults.WireFault`); returns its number."""
        return int(self.request("inject", kind=kind, **settings))

    def clear_faults(self) -> None:
        """End all faults on the wire."""
        self.request("clear_faults")

    def schedule(
        self, command: str, *, when: str = "now", after_cycles: int = 0, occurrence: int = 1, **arguments: Any
    ) -> None:
        """Let the operator do `command` later: `after_cycles` cycles after `when` began for the nth time.

        when : `now`, `start`, `monitor`, `command` (FRI state) or `moving` (the command moves)
        """
        self.request(
            "schedule",
            entry={
                "command": command,
                "when": when,
                "after_cycles": after_cycles,
                "occurrence": occurrence,
                "arguments": arguments,
            },
        )

    def degrade_quality(self, cycles: int) -> None:
        """The controller rates the link UNACCEPTABLE for `cycles` cycles."""
        self.request("degrade_quality", cycles=cycles)

    def gravity_compensation(self, active: bool = True) -> None:
        """Gravity compensation: a push moves the arm; False is position control again. Not in command mode."""
        self.request("gravity_compensation", active=active)

    def drive_fault(self, joint: int, error: bool = True) -> None:
        """Error (drives off) or warning bit of the drive of `joint` (0 to 6)."""
        self.request("drive_fault", joint=joint, error=error)

    def displace(self, offset: Sequence[float]) -> None:
        """A person opens the brakes and moves the arm by `offset` (7,) [rad]; the drives must be off."""
        self.request("displace", offset=list(offset))

    def push(self, torque: Sequence[float]) -> None:
        """External torque (7,) on the links [Nm] from now on; zeros end it."""
        self.request("push", torque=list(torque))

    def start_trace(self) -> None:
        """Begin a controller trace; an unsaved one is dropped."""
        self.request("start_trace")

    def save_trace(self, path: Path | str) -> int:
        """End the controller trace and write it to `path`; returns its number of samples."""
        samples = int(self.request("save_trace", path=str(Path(path).resolve())))
        deadline = time.monotonic() + _TRACE_S
        while self.status()["saving_trace"]:
            if time.monotonic() > deadline:
                raise NetworkError(f"emulator did not finish writing {path} within {_TRACE_S:g} s")
            time.sleep(0.02)
        return samples

    def reset_monitor(self) -> None:
        """Forget the extremes of the command monitor."""
        self.request("reset_monitor")

    def shutdown(self) -> None:
        """End the emulator."""
        self.request("shutdown")


class PendantServer:
    """The emulator's end: one non-blocking socket, requests handed to `handle(command, arguments)`."""

    def __init__(self, port: int, handle: Callable[[str, dict[str, Any]], Any]) -> None:
        self._handle = handle
        self._answered: OrderedDict[tuple[Any, Any], bytes] = OrderedDict()
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self.socket.bind(("127.0.0.1", port))
        except OSError as error:
            self.socket.close()
            raise ConfigurationError(
                f"pendant port {port} on 127.0.0.1 cannot be bound: {error}; "
                "choose another with --pendant-port"
            ) from error
        self.socket.setblocking(False)
        self.port: int = self.socket.getsockname()[1]

    def close(self) -> None:
        """Release the socket."""
        self.socket.close()

    def serve(self) -> None:
        """Answer all waiting requests."""
        while True:
            try:
                datagram, sender = self.socket.recvfrom(MAX_DATAGRAM)
            except (BlockingIOError, ConnectionError):
                return
            reply = self._answer(datagram, sender)
            if reply is not None:
                with contextlib.suppress(OSError):  # the client is gone
                    self.socket.sendto(reply, sender)

    def _answer(self, datagram: bytes, sender: Any) -> bytes | None:
        try:
            request = json.loads(datagram)
            number, command = request["id"], request["command"]
            arguments = request.get("arguments", {})
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
            return None
        if not isinstance(number, int) or not isinstance(command, str) or not isinstance(arguments, dict):
            return None
        key = (sender, number)
        if key in self._answered:
            return self._answered[key]
        try:
            message = {"id": number, "ok": True, "result": self._handle(command, arguments)}
        except Exception as error:  # whatever the request asked for, the emulator must outlive it
            message = {"id": number, "ok": False, "error": f"{error}" or type(error).__name__}
        reply = json.dumps(message).encode()
        self._answered[key] = reply
        while len(self._answered) > _REMEMBERED:
            self._answered.popitem(last=False)
        return reply
