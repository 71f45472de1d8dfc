"""Two drivers on one computer: starts and ends of the second beside a motion of the first.

A sender stands in for both controllers, on a processor of its own as far as there are two (see
`benchmarks/reply_latency.py`), and clocks every answer of the first driver, which moves its arm all the time. The
second driver is connected, answers in monitor mode, and ends, again and again: by itself, or killed. A controller
bridges three missing answers, so the fourth late one in a row would have cost command mode. Packets that the sender
itself sent late say nothing about the driver and are left out.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import re
import signal
import tempfile
import threading
import time
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.reply_latency import START, send
from benchmarks.trust.lab import descendants, gone
from benchmarks.trust.table import Ledger, stamp
from fri.errors import LwrError
from lwr_driver.arm import Arm
from lwr_driver.driver import Driver, LinkSettings
from lwr_driver.motion import move_to
from lwr_driver.realtime import assess
from lwr_driver.session import session_metadata
from runner.laboratory import free_port

__all__ = ["campaign"]

_RUNS = 50
_PERIODS_MS = (2, 5)
_BRIDGED = 3
_ON_TIME_S = 0.2e-3
_STAY_S = 0.3

Floats = NDArray[np.float64]


class _Moving:
    """The first driver, moving its arm to and fro until `stop`; failures are why a motion ended."""

    def __init__(self, port: int) -> None:
        self.failures: list[str] = []
        self.motions = 0
        self.ready = threading.Event()
        self._end = threading.Event()
        self._driver = Driver(Arm.load(), LinkSettings("127.0.0.1", port, realtime="allow"))
        self.processor: int | None = None
        self._thread = threading.Thread(target=self._move)

    def __enter__(self) -> _Moving:
        # A busy computer may take long to start the sender.
        self._driver.connect(timeout_s=300.0)
        rights = self._driver.rights
        self.processor = None if rights is None else rights.processor
        self._thread.start()
        self.ready.wait(60.0)
        return self

    def __exit__(self, *_: object) -> None:
        self._end.set()
        self._thread.join()
        self._driver.close()

    def _move(self) -> None:
        driver = self._driver
        with tempfile.TemporaryDirectory() as folder:
            driver.record(Path(folder) / "first.mcap", session_metadata(robot="LWR4+"))
            while not self._end.is_set():
                try:
                    if driver.state().mode != "hold":
                        driver.enter_command(timeout_s=60.0)
                    state = driver.state()
                    goal = START + (0.5 if self.motions % 2 == 0 else 0.0)
                    self.ready.set()
                    driver.execute(
                        move_to(driver.arm, state.q_command, goal, state.period_s, speed_scale=0.3)
                    ).check()
                except LwrError as error:
                    self.failures.append(str(error))
                self.motions += 1
            driver.end_record("success")


def _visit(port: int, kill: bool) -> list[str]:
    """The second driver comes, answers, and goes; what it left behind."""
    driver = Driver(Arm.load(), LinkSettings("127.0.0.1", port, realtime="allow"))
    try:
        driver.connect(timeout_s=60.0)
        time.sleep(_STAY_S)
        loop = driver._need(driver._loop).pid
        processes = [loop, driver._need(driver._recorder).pid, *descendants(loop)]
        if kill:
            os.kill(loop, signal.SIGKILL)
    except LwrError as error:
        return [f"the second driver: {error}"]
    finally:
        with contextlib.suppress(LwrError):
            driver.close()
    left = gone(processes, 10.0)
    return [f"processes left: {left}"] if left else []


def _late_in_a_row(latency: Floats, lateness: Floats, period_s: float) -> int:
    """Most answers in a row that came after the next packet, of packets sent on time."""
    late = (latency > period_s) & (lateness < _ON_TIME_S)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], late.astype(int), [0]])))
    return int(np.max(edges[1::2] - edges[::2], initial=0))


def _measure(period_ms: int, runs: int, what: str, line: Any, say: Any) -> None:
    ports = [free_port("127.0.0.1"), free_port("127.0.0.1")]
    context = multiprocessing.get_context("spawn")
    mine, theirs = context.Pipe()
    sender = context.Process(target=_send, args=(ports, period_ms, theirs), daemon=True)
    sender.start()
    bad: list[list[str]] = []
    with _Moving(ports[0]) as first:
        for number in range(runs):
            failures, motions = len(first.failures), first.motions
            found = _visit(ports[1], kill="killed" in what)
            if len(first.failures) > failures:
                found.append(f"the first driver: {first.failures[-1]}")
            bad.append(found)
            say(f"  {what}: {number + 1} of {runs}, {first.motions - motions} motions meanwhile")
        mine.send("enough")
        [(latency, lateness), _] = mine.recv()
        processor = first.processor
    sender.join(10.0)
    worst = _late_in_a_row(latency, lateness, period_ms * 1e-3)
    if worst > _BRIDGED:
        bad[-1].append(f"{worst} answers late in a row, a controller bridges {_BRIDGED}")
    for number, found in enumerate(bad):
        line.count(found, f"run {number}")
    on_time = latency[lateness < _ON_TIME_S]
    line.figures = {
        "packets": len(latency),
        "on time": len(on_time),
        "late": int(np.sum(on_time > period_ms * 1e-3)),
        "late in a row": worst,
        "p99.9 [us]": round(1e6 * float(np.quantile(on_time, 0.999, method="inverted_cdf")), 1),
        "motions": first.motions,
        "processor": processor,
        **stamp(),
    }


def _send(ports: list[int], period_ms: int, results: Connection) -> None:
    """The controllers of both; the first one's packets count while it is in command mode."""
    from benchmarks import reply_latency

    made = reply_latency._Link

    class _Second(made):  # type: ignore[misc, valid-type]
        """A controller whose own state does not matter for what counts."""

        @property
        def commanding(self) -> bool:
            return True

        @property
        def awaited(self) -> bool:
            # The sender must not take its whole processor while the second driver starts there.
            return False

    kinds = iter((made, _Second))
    reply_latency._Link = lambda *arguments: next(kinds)(*arguments)  # type: ignore[assignment, misc]
    send(ports, period_ms, results)


def campaign(ledger: Ledger, options: Any) -> None:
    """A line for each period, and one for a second driver that is killed."""
    stamp()
    for shortage in (*assess().missing, *assess().advice):
        options.say(f"  {shortage}")
    runs = options.runs or _RUNS
    for period_ms in _PERIODS_MS:
        for what, count in ((f"{period_ms} ms", runs), (f"{period_ms} ms, killed", max(1, runs // 5))):
            if re.search(options.lines, what) and not ledger.has("drivers", what):
                _measure(period_ms, count, what, ledger.line("drivers", what), options.say)
                ledger.finish("drivers", what)
