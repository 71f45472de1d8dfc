"""Reply latency in real time, of the driver and of a minimal C client, seen by the same sender at the same time.

The sender stands in for the controllers of both on the first processor (see `benchmarks/reply_latency.py`), half a
cycle apart; who answers is on the last, the C client with the higher priority, so that whatever stops that
processor meets both alike. What the sender sent late itself is left out: it says nothing about who answers. With
and without real-time rights, with and without other programs that want the processors.

The tail of the latency is made by a few stalls of the computer, so its quantile is uncertain: the ratio comes
with the range in which it lies when the seconds of the measurement are drawn anew. The promise is broken
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
from collections.abc import Iterator
from dataclasses import dataclass, field
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
_TURN_S = 100.0  # of one driver process
_ON_TIME_S = 0.2e-3
_QUANTILES = (0.5, 0.99, 0.999)
_RATIO = 1.3
_DRAWS = 200
_FIRST = 85  # priority of the C client: above the driver's loop

Floats = NDArray[np.float64]


@dataclass
class _Answers:
    """Latency and lateness [s] of what was sent to one of the two, by second; inf without an answer."""

    period_s: float
    latency: list[Floats] = field(default_factory=list)
    lateness: list[Floats] = field(default_factory=list)

    def add(self, latency: Floats, lateness: Floats) -> None:
        """Append a turn, in parts of a second."""
        ends = np.arange(1, len(latency) * self.period_s) / self.period_s
        cuts = np.round(ends).astype(int)
        self.latency += np.split(latency, cuts)
        self.lateness += np.split(lateness, cuts)

    def on_time(self) -> list[Floats]:
        """Latencies [s] of what left on time, by second."""
        pairs = zip(self.latency, self.lateness, strict=True)
        return [latency[lateness < _ON_TIME_S] for latency, lateness in pairs]

    def figures(self) -> dict[str, Any]:
        """Quantiles over the packets that left on time [us], answers later than a cycle included; packets
        without any answer count as infinite.
        """
        chosen = np.concatenate([np.zeros(0), *self.on_time()])
        if not len(chosen):
            return {"packets": 0}
        micros = [round(1e6 * _quantile(chosen, q), 1) for q in _QUANTILES]
        found = {
            f"p{100 * q:g}": value if np.isfinite(value) else None
            for q, value in zip(_QUANTILES, micros, strict=True)
        }
        return {
            "packets": sum(map(len, self.latency)),
            "on time": len(chosen),
            "late": int(np.sum(chosen > self.period_s)),
            **found,
        }


def _quantile(values: Floats, q: float) -> float:
    """The smallest value that a share `q` of all does not exceed."""
    return float(np.quantile(values, q, method="inverted_cdf"))


def _range(ours: _Answers, plain: _Answers) -> tuple[float, float]:
    """5 and 95 % of the ratio at p99.9 when the seconds are drawn anew, the same for both (block bootstrap)."""
    mine, theirs = ours.on_time(), plain.on_time()
    random = np.random.default_rng(1)
    ratios = []
    for _ in range(_DRAWS):
        drawn = random.integers(0, len(mine), len(mine))
        a, b = (np.concatenate([seconds[k] for k in drawn]) for seconds in (mine, theirs))
        if len(a) and len(b):
            ratios.append(_quantile(a, 0.999) / _quantile(b, 0.999))
    low, high = np.quantile(ratios, (0.05, 0.95), method="inverted_cdf")
    return float(low), float(high)


def _measure(
    program: Path | None, period_ms: int, seconds: float, rights: bool
) -> list[tuple[Floats, Floats]]:
    """Latency and lateness of a turn [s], of the driver and of the C client where there is one."""
    ports = [free_port("127.0.0.1")]
    clients = []
    if program is not None:
        ports.append(free_port("127.0.0.1"))
        cpu = max(os.sched_getaffinity(0)) if rights else -1
        clients.append(compiled.start(program, ports[1], priority=_FIRST if rights else 0, cpu=cpu))
    context = multiprocessing.get_context("spawn")
    mine, theirs = context.Pipe()
    sender = context.Process(target=send, args=(ports, period_ms, theirs), daemon=True)
    sender.start()
    try:
        _drive(ports[0], seconds, rights)
        mine.send("enough")
        found: list[tuple[Floats, Floats]] = mine.recv() if mine.poll(60.0) else []
    finally:
        sender.join(10.0)
        sender.kill()
        for client in clients:
            client.kill()
            client.wait()
    # What was sent after the driver had ended tells nothing.
    heard = [1 + int(np.flatnonzero(np.isfinite(latency)).max(initial=-1)) for latency, _ in found]
    end = min(heard, default=0)
    return [(latency[:end], lateness[:end]) for latency, lateness in found]


@contextlib.contextmanager
def _load(count: int) -> Iterator[None]:
    burners = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for burner in burners:
            burner.kill()
            burner.wait()


def _drive(port: int, seconds: float, rights: bool) -> None:
    """The driver with its recorder answers, moving the arm."""
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
    names = ["driver [us]"] if program is None else ["driver [us]", "C client [us]"]
    answers = [_Answers(period_ms * 1e-3) for _ in names]
    turns = max(2, round(seconds / _TURN_S))
    for _ in range(turns):
        for answer, found in zip(answers, _measure(program, period_ms, seconds / turns, rights), strict=True):
            answer.add(*found)
    line = ledger.line("realtime", piece)
    line.figures = {"seconds": seconds}
    line.figures |= {name: answer.figures() for name, answer in zip(names, answers, strict=True)}
    bad: list[str] = []
    both = [line.figures[name].get("p99.9") for name in names]
    if len(both) == 2 and all(both):
        ratio, (low, high) = both[0] / both[1], _range(*answers)
        line.figures["ratio at p99.9"] = round(ratio, 2)
        line.figures["ratio, 5 to 95 %"] = [round(low, 2), round(high, 2)]
        if rights:
            held = "yes" if ratio <= _RATIO else "open" if low <= _RATIO else "no"
            line.figures[f"within {_RATIO}"] = held
            if held == "no":
                bad.append(f"p99.9 is {ratio:.2f} times the C client's, at most {_RATIO}")
    line.figures["load average"] = round(os.getloadavg()[0], 1)
    line.count(bad)
