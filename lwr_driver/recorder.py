"""The recorder: a process of its own, from the ring of the FRI loop to session logs.

`Recorder` is the handle in the driving process. It starts the recorder as a fresh interpreter with one
inherited socket for requests and answers. The recorder attaches to the ring and drains it all the time; rows
outside a session are dropped. It outlives Ctrl-C. When the driving process or the FRI loop vanishes, it ends
the open session with exit status `fail` and a reason.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, Pipe
from pathlib import Path
from types import FrameType
from typing import Any

from fri import interpreter
from fri.errors import ConfigurationError, DataError, FileError, LwrError
from lwr_driver.ring import Ring
from lwr_driver.session.recording import Recorded, Recording, SessionRequest, utc_offset_ns
from lwr_driver.session.writer import ExitStatus

_PAUSE_S = 0.02
_BUSY_ROWS = 1000
# Rows are encoded in batches: so many at least, or this share of the ring, or those of this time.
_BATCH_ROWS, _BATCH_SHARE, _BATCH_S = 2000, 4, 0.2
_START_TIMEOUT_S = 60.0
_REPLY_TIMEOUT_S = 60.0
_NICE = 5
_BOOT = "import sys; from lwr_driver.recorder import main; main(sys.argv[1:])"


@dataclass(frozen=True)
class _Failure:
    """An error as data: name of the exception's class and its message."""

    kind: str
    message: str

    @classmethod
    def of(cls, error: BaseException) -> _Failure:
        return cls(type(error).__name__, str(error) or repr(error))

    def error(self) -> LwrError:
        kind = ConfigurationError if self.kind == "ConfigurationError" else DataError
        return kind(self.message)


@dataclass(frozen=True)
class _Event:
    """A failure between requests, and how it ended the session."""

    failure: _Failure
    recorded: Recorded | None


class Recorder:
    """Handle of the recorder process. A context manager; leaving it ends an open session with `fail`.

    ring : made by this process
    heartbeat_timeout_s : after so much silence the loop counts as dead; None watches its process only
    nice : nice value of the recorder

    Every call may raise DataError if the recorder process died; its file can be read and recovered.
    """

    def __init__(self, ring: Ring, *, heartbeat_timeout_s: float | None = 2.0, nice: int = _NICE) -> None:
        self.ring = ring
        self._events: list[_Event] = []
        self._path: Path | None = None
        self._reply_timeout_s = _REPLY_TIMEOUT_S
        mine, theirs = Pipe(duplex=True)
        self._connection = mine
        timeout = "none" if heartbeat_timeout_s is None else repr(float(heartbeat_timeout_s))
        try:
            self._process = subprocess.Popen(
                interpreter.command("-c", _BOOT, str(theirs.fileno()), ring.inherited, timeout, str(nice)),
                pass_fds=(theirs.fileno(), ring.descriptor),
                stdin=subprocess.DEVNULL,
                env=interpreter.environment(),
                start_new_session=True,
            )
        except OSError as error:
            mine.close()
            raise FileError.of(error, "the recorder process cannot be started") from error
        finally:
            theirs.close()
        try:
            self._receive(_START_TIMEOUT_S)
        except BaseException:
            self._process.kill()
            self._process.wait()
            mine.close()
            raise

    @property
    def pid(self) -> int:
        """Process id of the recorder."""
        return self._process.pid

    @property
    def lag(self) -> int:
        """Rows published by the loop and not yet taken."""
        return self.ring.head - self.ring.tail

    def open(self, request: SessionRequest) -> None:
        """Begin a session; every row published after the return is in it.

        Raises ConfigurationError if the file cannot be created (it exists, the folder is read-only).
        """
        self._events.clear()
        self._ask("open", request)
        self._path = request.path

    def add_phases(self, names: Sequence[str]) -> int:
        """Add phase names to the open session; returns the number of the first, for the rows' `phase`.

        Raises the failure that ended the session, if any.
        """
        try:
            return int(self._ask("phases", tuple(names)))
        except LwrError:
            self.check()
            raise

    def close(
        self,
        exit_status: ExitStatus = "success",
        reason: str = "",
        *,
        upto: int | None = None,
        restarts: int = 0,
    ) -> Recorded:
        """End the session with all rows published until now, or until row number `upto`.

        restarts : of the controller in this session, for its closing record

        For a session already ended by a failure (disk full, loop dead), that end is returned.
        """
        upto = self.ring.head if upto is None else upto
        answer: Recorded = self._ask("close", exit_status, reason, upto, restarts)
        self._path = None
        return answer

    def check(self) -> None:
        """Raise a failure since the session was opened, such as a full disk; never waits."""
        self._drain()
        if self._events:
            raise self._events[0].failure.error()
        if self._process.poll() is not None:
            raise self._died()

    def stop(self, timeout_s: float = 30.0) -> None:
        """End an open session with `fail`, then the process. Safe to call twice."""
        if self._connection.closed:
            return
        with contextlib.suppress(OSError, DataError):
            self._connection.send(("stop",))
        self._connection.close()
        try:
            self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def __enter__(self) -> Recorder:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def _ask(self, *request: object) -> Any:
        try:
            self._connection.send(request)
        except (OSError, ValueError) as error:
            raise self._died() from error
        return self._receive(self._reply_timeout_s)

    def _receive(self, timeout_s: float) -> Any:
        deadline = time.monotonic() + timeout_s
        try:
            while self._connection.poll(max(0.0, deadline - time.monotonic())):
                answer = self._connection.recv()
                if isinstance(answer, _Event):
                    self._events.append(answer)
                    continue
                if isinstance(answer, _Failure):
                    raise answer.error()
                return answer
        except (EOFError, OSError) as error:
            raise self._died() from error
        raise DataError(
            f"the recorder process {self._process.pid} has not answered for {timeout_s:.0f} s; "
            "the disk may be stuck, end the motion"
        )

    def _drain(self) -> None:
        with contextlib.suppress(EOFError, OSError):
            while self._connection.poll(0):
                answer = self._connection.recv()
                if isinstance(answer, _Event):
                    self._events.append(answer)

    def _died(self) -> DataError:
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(1.0)
        code = self._process.returncode
        how, where = "is gone", ""
        if code is not None:
            how = f"was killed by signal {-code}" if code < 0 else f"ended with code {code}"
        if self._path:
            where = f"; {self._path} is readable up to its last chunk, `lwr-run recover` makes it whole"
        return DataError(f"the recorder process {self._process.pid} {how}{where}")


class _Server:
    """The other side: drains the ring and answers requests, in the recorder process."""

    def __init__(self, connection: Connection, ring: Ring, heartbeat_timeout_s: float | None) -> None:
        self._connection = connection
        self._ring = ring
        self._timeout_ns = None if heartbeat_timeout_s is None else round(heartbeat_timeout_s * 1e9)
        self._utc_offset = utc_offset_ns()
        self._recording: Recording | None = None
        self._ended: Recorded | None = None
        self._overruns = 0
        self._due_s = 0.0
        self.end_reason = ""

    def run(self) -> None:
        """Serve until a request to stop, or until the driving process is gone."""
        self._connection.send("ready")
        busy = False
        while True:
            if self.end_reason:
                self._end_by_failure(self.end_reason)
                return
            try:
                if self._connection.poll(0 if busy else _PAUSE_S) and not self._answer(
                    *self._connection.recv()
                ):
                    return
            except (EOFError, OSError):
                self._drain(None)
                self._end_by_failure("the process that drove the experiment died")
                return
            busy = self._due() and self._drain(None) >= _BUSY_ROWS
            self._watch_writer()

    def _due(self) -> bool:
        """Whether there are rows enough for a batch, or the last one was long ago."""
        waiting, now = self._ring.head - self._ring.tail, time.monotonic()
        if waiting < min(_BATCH_ROWS, self._ring.capacity // _BATCH_SHARE) and now < self._due_s:
            return False
        self._due_s = now + _BATCH_S
        return True

    def _answer(self, name: str, *arguments: Any) -> bool:
        try:
            if name == "stop":
                self._drain(None)
                self._end_by_failure("the recorder was stopped before the session was closed")
                return False
            answers: dict[str, Callable[..., Any]] = {
                "open": self._open,
                "phases": self._add_phases,
                "close": self._close,
            }
            self._connection.send(answers[name](*arguments))
        except Exception as error:  # the recorder goes on after any failed request
            self._connection.send(_Failure.of(error))
        return True

    def _open(self, request: SessionRequest) -> str:
        if self._recording is not None:
            raise DataError(f"session {self._recording.request.path} is still open; close it first")
        self._drain(None)
        self._ended = None
        self._overruns = self._ring.overruns
        self._recording = Recording(request, self._utc_offset)
        return "open"

    def _add_phases(self, names: tuple[str, ...]) -> int:
        if self._recording is None:
            raise DataError("no session is open, so phases have no place")
        return self._recording.add_phases(names)

    def _close(self, exit_status: ExitStatus, reason: str, upto: int, restarts: int) -> Recorded:
        if self._recording is not None:
            self._drain(upto)
            self._watch_writer()
        if self._recording is not None:
            recorded = self._recording.close(exit_status, reason, self._lost_rows(), restarts)
            self._recording = None
            return recorded
        if self._ended is None:
            raise DataError("no session is open")
        return self._ended

    def _lost_rows(self) -> int:
        return self._ring.overruns - self._overruns

    def _drain(self, upto: int | None) -> int:
        """Record all rows, or those before row number `upto`; returns their number."""
        rows = self._ring.take(upto)
        if len(rows) and self._recording is not None:
            try:
                self._recording.write(rows)
            except Exception as error:  # the session ends in order, also on impossible rows
                self._ring.release(len(rows))
                self._end_by_failure(str(error), _Failure.of(error))
                return len(rows)
        self._ring.release(len(rows))
        return len(rows)

    def _watch_writer(self) -> None:
        writer = self._ring.writer_pid
        if not writer or self._recording is None:
            return
        if not _alive(writer):
            self._drain(None)
            self._end_by_failure(f"the FRI loop (process {writer}) died")
        elif self._timeout_ns is not None:
            silence = time.monotonic_ns() - self._ring.heartbeat_ns
            if silence > self._timeout_ns:
                self._drain(None)
                self._end_by_failure(
                    f"the FRI loop (process {writer}) has given no sign of life for {silence * 1e-9:.1f} s"
                )

    def _end_by_failure(self, reason: str, failure: _Failure | None = None) -> None:
        recording, self._recording = self._recording, None
        if recording is None:
            return
        self._ended = recording.close("fail", reason, self._lost_rows())
        event = _Event(failure or _Failure("DataError", f"{recording.request.path}: {reason}"), self._ended)
        with contextlib.suppress(OSError, ValueError):
            self._connection.send(event)


def main(arguments: Sequence[str]) -> None:
    """Entry of the recorder process: socket, ring name, heartbeat timeout, nice value."""
    descriptor, name, timeout, nice = arguments
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGPIPE, signal.SIG_IGN)
    connection = Connection(int(descriptor))
    _step_back(int(nice))
    try:
        ring = Ring.attach(name)
    except LwrError as error:
        connection.send(_Failure.of(error))
        return
    server = _Server(connection, ring, None if timeout == "none" else float(timeout))

    def end(number: int, frame: FrameType | None) -> None:
        server.end_reason = f"the recorder was ended by {signal.Signals(number).name}"

    signal.signal(signal.SIGTERM, end)
    try:
        server.run()
    finally:
        ring.close()


def _step_back(nice: int) -> None:
    """Ordinary scheduling with a nice value, also below a real-time parent."""
    with contextlib.suppress(OSError, AttributeError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    with contextlib.suppress(OSError):
        os.nice(nice)


def _alive(pid: int) -> bool:
    """Whether a process runs; a zombie does not."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except (OSError, IndexError):
        return True
    return state not in ("Z", "X")
