"""Reply latency in real time, the driver and a minimal C client in turn, seen by the same sender.

The sender stands in for the controller on the first processor (see `benchmarks/reply_latency.py`). What it sent
late itself is left out: it says nothing about who answers. With and without real-time rights, with and
without other programs that want the processors.

The tail of the latency is made by a few stalls of the computer, so its quantile is uncertain: the ratio comes
with the range in which it lies when the seconds of both measurements are drawn anew. The promise is broken
where even the lower end is above it, and open where only the ratio is.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from benchmarks.reply_latency import START, send
from benchmarks.trust import compiled
from benchmarks.trust.table import Ledger
from fri.errors import LwrError
from lwr_driver.arm import Arm
from lwr_driver.driver import Driver, LinkSettings
from lwr_driver.loop_process import Scheduling
from lwr_driver.motion import move_to
from lwr_driver.realtime import assess
from lwr_driver.session import session_metadata
from runner.laboratory import free_port

__all__ = ["campaign"]

_SECONDS = 600.0
_TURN_S = 20.0  # of the driver, then of the client: what else the computer does meets both alike
_CLIENT_SHARE = 0.5  # of the driver's time
_ON_TIME_S = 0.2e-3
_QUANTILES = (0.5, 0.99, 0.999)
_RATIO = 1.3
_DRAWS = 200
_BEFORE = 400  # packets before command mode


class _Sent:
    """Latency and own lateness of the sender's packets in command mode [s]."""

    def __init__(self, period_ms: int) -> None:
        self._period_s = period_ms * 1e-3
        self.latency: list[NDArray[np.float64]] = []
        self.lateness: list[NDArray[np.float64]] = []

    def take(self, port: int, answer: Callable[[], None]) -> None:
        """Send while `answer` lasts."""
        period_ms = round(self._period_s * 1e3)
        context = multiprocessing.get_context("spawn")
        mine, theirs = context.Pipe()
        sender = context.Process(target=send, args=(port, period_ms, theirs), daemon=True)
        sender.start()
        try:
            answer()
            mine.send("enough")
            if mine.poll(60.0):
                latency, lateness = mine.recv()
                # What was sent after the other side had ended tells nothing.
                heard = 1 + np.flatnonzero(np.isfinite(latency)).max(initial=-1)
                self.latency.append(latency[:heard])
                self.lateness.append(lateness[:heard])
        finally:
            sender.join(10.0)
            sender.kill()

    def spread(self, random: np.random.Generator) -> NDArray[np.float64]:
        """p99.9 [s] of data sets drawn anew, with repetition, from the seconds of this one (bootstrap)."""
        blocks = []
        for latency, lateness in zip(self.latency, self.lateness, strict=True):
            count = max(1, round(len(latency) * self._period_s))
            parts = zip(np.array_split(latency, count), np.array_split(lateness, count), strict=True)
            blocks += [part[late < _ON_TIME_S] for part, late in parts]
        found = []
        for _ in range(_DRAWS):
            drawn = np.concatenate([blocks[k] for k in random.integers(0, len(blocks), len(blocks))])
            found.append(np.quantile(drawn, 0.999, method="inverted_cdf") if len(drawn) else np.inf)
        return np.array(found)

    def figures(self) -> dict[str, Any]:
        """Quantiles over the packets that left on time [us], answers later than a cycle included; packets
        without any answer count as infinite.
        """
        nothing = [np.zeros(0)]
        latency = np.concatenate(self.latency + nothing)
        lateness = np.concatenate(self.lateness + nothing)
        chosen = np.sort(latency[lateness < _ON_TIME_S])
        if not len(chosen):
            return {"packets": 0}
        places = [min(len(chosen) - 1, int(np.ceil(q * len(chosen))) - 1) for q in _QUANTILES]
        micros = [round(1e6 * float(chosen[place]), 1) for place in places]
        found = {
            f"p{100 * q:g}": value if np.isfinite(value) else None
            for q, value in zip(_QUANTILES, micros, strict=True)
        }
        return {
            "packets": len(latency),
            "on time": len(chosen),
            "late": int(np.sum(latency > self._period_s)),
            **found,
        }


@contextlib.contextmanager
def _load(count: int) -> Iterator[None]:
    burners = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for burner in burners:
            burner.kill()
            burner.wait()


def _drive(port: int, seconds: float, rights: bool) -> Callable[[], None]:
    """What answers: the driver with its recorder, moving the arm."""

    def answer() -> None:
        arm = Arm.load()
        link = LinkSettings("127.0.0.1", port, realtime="allow", link_timeout_s=5.0)

        def scheduling(apply: bool, required: bool, **more: Any) -> Scheduling:
            return Scheduling(apply and rights, required and rights, **more)

        with (
            patch("lwr_driver.driver.Scheduling", scheduling),
            tempfile.TemporaryDirectory() as folder,
            Driver(arm, link) as driver,
        ):
            driver.connect(timeout_s=60.0)
            driver.record(Path(folder) / "latency.mcap", session_metadata(robot=arm.name))
            end, motions = time.monotonic() + seconds, 0
            while time.monotonic() < end:
                # Without rights a motion may end early; then command mode is asked for again.
                with contextlib.suppress(LwrError):
                    state = driver.state()
                    if state.mode != "hold":
                        driver.enter_command(timeout_s=20.0)
                        continue
                    goal = START + (0.5 if motions % 2 == 0 else 0.0)
                    driver.execute(move_to(arm, state.q_command, goal, state.period_s, speed_scale=0.3))
                    motions += 1
            driver.end_record("success")

    return answer


def _plain(program: Path, port: int, period_ms: int, seconds: float, rights: bool) -> Callable[[], None]:
    """What answers: the C client."""

    def answer() -> None:
        cpu = max(os.sched_getaffinity(0)) if rights else -1
        packets = _BEFORE + round(seconds / (1e-3 * period_ms))
        client = compiled.start(program, port, realtime=rights, cpu=cpu, packets=packets)
        with contextlib.suppress(subprocess.TimeoutExpired):
            client.wait(60.0 + 2.0 * seconds)
        client.kill()
        client.wait()

    return answer


def campaign(ledger: Ledger, options: Any) -> None:
    """For each period, rights and load: the driver, the C client, and the ratio at p99.9."""
    seconds = options.seconds or _SECONDS
    for shortage in (*assess().missing, *assess().advice):
        options.say(f"  {shortage}")
    with tempfile.TemporaryDirectory() as name:
        program = compiled.client(Path(name))
        processors = len(os.sched_getaffinity(0))
        for load, rights in ((0, True), (0, False), (processors, True), (processors, False)):
            for period_ms in options.periods_ms:
                piece = f"{period_ms} ms{'' if rights else ', no rights'}{', load' if load else ''}"
                if re.search(options.lines, piece) and not ledger.has("realtime", piece):
                    with _load(load):
                        _compare(ledger, program, period_ms, seconds, rights, piece)
                    ledger.finish("realtime", piece)
                    options.say(ledger.table("realtime").splitlines()[-1])


def _compare(
    ledger: Ledger, program: Path | None, period_ms: int, seconds: float, rights: bool, piece: str
) -> None:
    ours, plain = _Sent(period_ms), _Sent(period_ms)
    turns = max(2, round(seconds / _TURN_S))
    for _ in range(turns):
        port = free_port("127.0.0.1")
        ours.take(port, _drive(port, seconds / turns, rights))
        if program is not None:
            port = free_port("127.0.0.1")
            plain.take(port, _plain(program, port, period_ms, _CLIENT_SHARE * seconds / turns, rights))
    found = ours.figures()
    line = ledger.line("realtime", piece)
    line.figures = {"seconds": seconds, "turns": turns, "driver [us]": found}
    bad: list[str] = []
    if program is not None:
        yardstick = plain.figures()
        line.figures["C client [us]"] = yardstick
        if found.get("p99.9") and yardstick.get("p99.9"):
            ratio = found["p99.9"] / yardstick["p99.9"]
            random = np.random.default_rng(1)
            low, high = np.quantile(ours.spread(random) / plain.spread(random), (0.05, 0.95))
            line.figures["ratio at p99.9"] = round(ratio, 2)
            line.figures["ratio, 5 to 95 %"] = [round(float(low), 2), round(float(high), 2)]
            if rights:
                held = "yes" if ratio <= _RATIO else "open" if low <= _RATIO else "no"
                line.figures[f"within {_RATIO}"] = held
                if held == "no":
                    bad.append(f"p99.9 is {ratio:.2f} times the C client's, at most {_RATIO}")
    line.figures["load average"] = round(os.getloadavg()[0], 1)
    line.count(bad)
