"""The emulator as a child process: started, waited for, stopped, and gone when its parent is gone."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import select
import subprocess
import tempfile
import time
from collections.abc import Mapping
from ipaddress import IPv4Address
from math import inf, nan
from numbers import Real
from pathlib import Path
from typing import IO, Any

from fri import interpreter
from fri.errors import ConfigurationError, LwrError, NetworkError, RobotError
from lwr_driver.configuration import CONFIGS, find
from lwr_driver.hosted_loop import LoopHost
from lwr_driver.realtime import undisturbed
from sim_backend.pendant import Pendant

log = logging.getLogger(__name__)

_STOP_S = 5.0


class Emulator:
    """The emulated arm and controller as a child process (``python -m sim_backend CONFIG``); a context manager.

    config : path or name of an emulator configuration (`emulator/default.yaml`)
    lock_step : own clock, one cycle for each answer; otherwise real time
    fri_host, fri_port : IPv4 address and UDP port of the PC's end of the FRI
    pendant_port : 0 takes a free one; see `pendant_port` afterwards
    period_ms : FRI cycle, whole milliseconds from 1 to 100; None as configured
    seed : seed of everything random in the emulator, None as configured
    settings : overrides of configuration keys by their dotted names, e.g. ``{"robot.payload": "paper_load"}``
    once : in lock step, end when the client has left
    verbosity : None keeps messages for `messages`; otherwise they go to the terminal: 0 what must be seen, 1 events of
    the session, 2 finer changes
    hosting : in lock step, take the loop of this process's driver in, `Driver(..., host=emulator.host)`; no UDP then
    start_s : time limit for the start of the emulator [s]; the first on a computer compiles for half a minute or more

    The child ends with `stop`, with the `with` block, and with this process: it watches a pipe from its parent.
    Raises ConfigurationError for a wrong argument.
    """

    def __init__(
        self,
        config: str | Path = CONFIGS / "emulator/default.yaml",
        *,
        lock_step: bool = True,
        fri_host: str = "127.0.0.1",
        fri_port: int = 49938,
        pendant_port: int = 0,
        period_ms: float | None = None,
        seed: int | None = None,
        settings: Mapping[str, Any] | None = None,
        once: bool = False,
        verbosity: int | None = None,
        hosting: bool = False,
        start_s: float = 300.0,
    ) -> None:
        self.config = find(config)
        self.lock_step = lock_step
        try:
            self.fri_host = str(IPv4Address(fri_host))
        except ValueError as error:
            raise ConfigurationError(f"fri_host: {error}; give an IPv4 address such as 127.0.0.1") from error
        self.fri_port = _whole("fri_port", fri_port, 1, 65535)
        self.pendant_port = _whole("pendant_port", pendant_port, 0, 65535)
        self.start_s = start_s
        if hosting and not lock_step:
            raise ConfigurationError("hosting needs lock step; in real time the driver talks UDP")
        self._hosting = hosting
        self.host: LoopHost | None = None
        self._process: subprocess.Popen[bytes] | None = None
        self._errors: IO[bytes] | None = None
        self._pendant: Pendant | None = None
        if not isinstance(settings or {}, Mapping):
            raise ConfigurationError(
                f"settings {settings!r} is no mapping; give values by dotted key, "
                'such as {"robot.payload": "paper_load"}'
            )
        self.settings = dict(settings or {})
        self._shown = verbosity is not None
        self._options: list[str] = ["-v"] * (verbosity or 0) + ["--once"] * once
        if period_ms is not None:
            self._options += ["--period-ms", str(_whole("period_ms", period_ms, 1, 100))]
        if seed is not None:
            self._options += ["--seed", str(_whole("seed", seed, 0))]
        for key, value in self.settings.items():
            try:
                self._options += ["--set", f"{key}={json.dumps(value)}"]
            except TypeError as error:
                raise ConfigurationError(
                    f"settings[{key!r}]: {error}; give numbers, texts or lists"
                ) from error

    def __repr__(self) -> str:
        """Configuration, state and addresses."""
        state = f"running (process {self.pid})" if self.running else "not running; `start` it or use `with`"
        clock = "lock step" if self.lock_step else "real time"
        clock += ", in one process" if self._hosting else ""
        lines = [
            f"Emulator {self.config.name}: {state}",
            f"  FRI      to {self.fri_host}:{self.fri_port} in {clock}",
            f"  pendant  on 127.0.0.1:{self.pendant_port or 'a free port'}",
        ]
        shown = list(self.settings.items())[:5]
        lines += [f"  {key} = {str(value)[:60]}" for key, value in shown]
        if len(self.settings) > len(shown):
            lines.append(f"  and {len(self.settings) - len(shown)} more settings")
        return "\n".join(lines)

    def __enter__(self) -> Emulator:
        return self.start()

    def __exit__(self, *_: object) -> None:
        self.stop()

    @property
    def address(self) -> tuple[str, int]:
        """Address and UDP port of the PC's end of the FRI, for the driver."""
        return self.fri_host, self.fri_port

    @property
    def pendant(self) -> Pendant:
        """The client of this emulator's pendant."""
        if self._pendant is None:
            raise RobotError("emulator is not running; call `start` or use it in a `with` block")
        return self._pendant

    @property
    def pid(self) -> int | None:
        """Process id, None before the start and after the end."""
        return self._process.pid if self._process is not None and self.running else None

    @property
    def running(self) -> bool:
        """Whether the process is alive."""
        return self._process is not None and self._process.poll() is None

    def status(self) -> dict[str, Any]:
        """Status from the pendant."""
        return self.pendant.status()

    def start(self) -> Emulator:
        """Start the process, wait until its pendant answers, and return the emulator itself."""
        if self.running:
            return self
        command = [
            *interpreter.command("-m", "sim_backend"),
            str(self.config),
            "--lock-step" if self.lock_step else "--real-time",
            f"--fri-host={self.fri_host}",
            f"--fri-port={self.fri_port}",
            f"--pendant-port={self.pendant_port}",
            "--follow-stdin",
            "--announce",
            *self._options,
        ]
        self._errors = None
        if not self._shown:
            self._errors = tempfile.TemporaryFile()  # noqa: SIM115 - lives as long as the child
        if self._hosting:
            self.host = LoopHost()
            command.append(f"--seat={self.host.descriptor}")
        try:
            self._process = subprocess.Popen(
                command,
                pass_fds=() if self.host is None else (self.host.descriptor,),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self._errors,
                env=interpreter.environment(),
            )
        except OSError:
            self.stop()
            raise
        if self.host is not None:
            self.host.started(self._process.pid)
        try:
            self.pendant_port = self._announced()
            self._pendant = Pendant(self.pendant_port)
            self._pendant.status()
        except BaseException:
            self.stop()
            raise
        log.info("emulator %d started, pendant on port %d", self._process.pid, self.pendant_port)
        return self

    def _announced(self) -> int:
        """Pendant port from the child's output, one line of JSON."""
        assert self._process is not None
        assert self._process.stdout is not None
        deadline = time.monotonic() + self.start_s
        while (remaining := deadline - time.monotonic()) > 0.0:
            if select.select([self._process.stdout], [], [], remaining)[0]:
                line = self._process.stdout.readline()
                if line:
                    return int(json.loads(line)["pendant_port"])
                status = self._process.wait()
                raise self._failure(status)
        raise NetworkError(f"emulator {self.config.name} did not start within {self.start_s:g} s")

    def _failure(self, status: int) -> LwrError:
        lines = self.messages().strip().splitlines()
        reason = "its message is above" if self._shown else lines[-1] if lines else "no message"
        kind = ConfigurationError if status == ConfigurationError.exit_code else RobotError
        return kind(f"emulator {self.config.name} ended with status {status}: {reason}")

    def messages(self) -> str:
        """Error output of the process so far."""
        if self._errors is None:
            return ""
        # The child writes at the same file offset, so it must not be moved.
        return os.pread(self._errors.fileno(), 1 << 20, 0).decode(errors="replace")

    def wait(self) -> int:
        """Wait until the process ends by itself; returns its exit status."""
        if self._process is None:
            raise RobotError("emulator is not running; call `start` or use it in a `with` block")
        return self._process.wait()

    def stop(self) -> int | None:
        """End the process; returns its exit status, None if it never ran. Safe to call twice."""
        with undisturbed():
            return self._stop()

    def _stop(self) -> int | None:
        if self._pendant is not None:
            self._pendant.close()
            self._pendant = None
        if self.host is not None:
            self.host.close()
            self.host = None
        errors, self._errors = self._errors, None
        with contextlib.nullcontext() if errors is None else errors:
            return self._ended()

    def _ended(self) -> int | None:
        """Exit status of the process, ended now; None if it never ran."""
        if self._process is None:
            return None
        process, self._process = self._process, None
        # Closing the pipe is the child's sign to end.
        for stream in (process.stdin, process.stdout):
            if stream is not None:
                stream.close()
        try:
            status = process.wait(_STOP_S)
        except subprocess.TimeoutExpired:
            log.warning("emulator %d did not end within %g s and is killed", process.pid, _STOP_S)
            process.kill()
            status = process.wait()
        return status


def _whole(name: str, value: object, low: int, high: int | None = None) -> int:
    """`value` as a whole number from `low` to `high`, or ConfigurationError."""
    number = float(value) if isinstance(value, Real) and not isinstance(value, bool) else nan
    if number.is_integer() and low <= number <= (inf if high is None else high):
        return int(number)
    bounds = f"from {low} to {high}" if high is not None else f"of at least {low}"
    raise ConfigurationError(f"{name} {value!r} is no whole number {bounds}")


#: The emulator by its former name.
EmulatorProcess = Emulator
