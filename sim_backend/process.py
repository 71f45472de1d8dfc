"""The emulator as a child process: started, waited for, stopped, and gone when its parent is gone."""

from __future__ import annotations

import json
import logging
import os
import select
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import IO, Any

from fri.errors import ConfigurationError, LwrError, NetworkError, RobotError
from lwr_driver.configuration import find
from lwr_driver.realtime import undisturbed
from sim_backend.pendant import Pendant

__all__ = ["EmulatorProcess"]

log = logging.getLogger(__name__)

_STOP_S = 5.0


class EmulatorProcess:
    """Runs ``python -m sim_backend CONFIG`` as a child; a context manager.

    config : path or name of an emulator configuration (`emulator/default.yaml`)
    lock_step : own clock, one cycle for each answer; otherwise real time
    fri_host, fri_port : where the PC's end of the FRI listens
    pendant_port : 0 takes a free one; see `pendant_port` afterwards
    period_ms : FRI cycle, None as configured
    seed : seed of everything random in the emulator, None as configured
    settings : overrides of configuration keys by their dotted names, e.g. ``{"robot.payload": "paper_load"}``
    start_s : longest time until the emulator answers on its pendant

    The child ends when `stop` is called, when the `with` block is left, and when this process dies in any
    way: it watches a pipe that the operating system closes then.
    """

    def __init__(
        self,
        config: str | Path = "emulator/default.yaml",
        *,
        lock_step: bool = True,
        fri_host: str = "127.0.0.1",
        fri_port: int = 49938,
        pendant_port: int = 0,
        period_ms: float | None = None,
        seed: int | None = None,
        settings: Mapping[str, Any] | None = None,
        start_s: float = 60.0,
    ) -> None:
        self.config = find(config)
        self.lock_step = lock_step
        self.fri_host, self.fri_port = fri_host, fri_port
        self.pendant_port = pendant_port
        self.start_s = start_s
        self._options: list[str] = []
        if period_ms is not None:
            self._options += ["--period-ms", repr(float(period_ms))]
        if seed is not None:
            self._options += ["--seed", str(seed)]
        for key, value in (settings or {}).items():
            self._options += ["--set", f"{key}={json.dumps(value)}"]
        self._process: subprocess.Popen[bytes] | None = None
        self._errors: IO[bytes] | None = None
        self._pendant: Pendant | None = None

    def __enter__(self) -> EmulatorProcess:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

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

    def start(self) -> None:
        """Start the process and wait until its pendant answers."""
        if self.running:
            return
        command = [
            sys.executable,
            "-m",
            "sim_backend",
            str(self.config),
            "--lock-step" if self.lock_step else "--real-time",
            "--fri-host",
            self.fri_host,
            "--fri-port",
            str(self.fri_port),
            "--pendant-port",
            str(self.pendant_port),
            "--follow-stdin",
            "--announce",
            *self._options,
        ]
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 - lives as long as the child
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._errors
        )
        try:
            self.pendant_port = self._announced()
            self._pendant = Pendant(self.pendant_port)
            self._pendant.status()
        except BaseException:
            self.stop()
            raise
        log.info("emulator %d started, pendant on port %d", self._process.pid, self.pendant_port)

    def _announced(self) -> int:
        """Pendant port that the child announces in one line of JSON on its output."""
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
        reason = lines[-1] if lines else "no message"
        kind = ConfigurationError if status == ConfigurationError.exit_code else RobotError
        return kind(f"emulator {self.config.name} ended with status {status}: {reason}")

    def messages(self) -> str:
        """What the process has written to its error output so far."""
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
        if self._errors is not None:
            self._errors.close()
            self._errors = None
        return status
