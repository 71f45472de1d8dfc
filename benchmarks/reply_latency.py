"""How fast the loop process answers: its latency in real time, measured by the other side.

    python -m benchmarks.reply_latency --period-ms 1 --seconds 10 [--json FILE]

A sender process stands in for the controller: it sends at the FRI rate in command mode and clocks each answer
from the moment its packet left. The loop under test is the driver's own process, with recorder, ring and
guard, and it executes motions. How late the sender itself was is measured too: on a busy computer both wait
for the same processor, and a packet that left late says nothing about the loop. Numbers are printed, nothing
is asserted.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import platform
import socket
import tempfile
import time
from collections.abc import Sequence
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np

from fri.krc import KrcSession, Sample
from fri.krl import Interpreter
from fri.packets import CMD_SIZE
from fri.policy import KrcLimits, KrcPolicy
from fri.states import Quality
from lwr_driver.arm import Arm
from lwr_driver.driver import Driver, LinkSettings
from lwr_driver.motion import move_to
from lwr_driver.realtime import assess, set_up
from lwr_driver.session import session_metadata
from sim_backend.program import krl_program

START = np.array([0.0, 0.5, 0.0, -1.3, 0.0, 0.8, 0.0])
# Sleeping longer, the sender's processor would wake late.
_NAP_S = 0.15e-3
_READY_S = 0.5e-3  # before a packet is due, it is ready
QUANTILES = (0.5, 0.9, 0.99, 0.999, 1.0)


class _Link:
    """One of those who answer, as the controller sees it: a session that forgives every miss."""

    def __init__(self, port: int, period_ms: int) -> None:
        arm = Arm.load()
        limits = KrcLimits(arm.q_min, arm.q_max, 1e6 * arm.v_max, np.full(7, 1e3))
        policy = KrcPolicy(
            bridged_cycles=10**6,
            hold_quality=Quality.UNACCEPTABLE,
            perfect_latency=1e3,
            perfect_rate=0.0,
            ok_rate=0.0,
            bad_rate=0.0,
        )
        self._period_ms = period_ms
        self.session = KrcSession(limits, START, policy)
        self._interpreter = Interpreter(self.session, krl_program("stanford", period_ms))
        self._sample = Sample()
        self._wire = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._wire.connect(("127.0.0.1", port))
        self._wire.setblocking(False)
        # When the packets left, and where their latency is told; an answer may come cycles later.
        self._under_way: dict[bytes, tuple[float, int]] = {}
        self._open: tuple[bytes, float] | None = None
        self._packet = b""
        self._looked = 0.0
        self.latency: list[float] = []
        self.lateness: list[float] = []

    @property
    def commanding(self) -> bool:
        return int(self.session.state) == 2

    @property
    def awaited(self) -> bool:
        """Whether the last packet is not answered yet."""
        return self._open is not None

    def prepare(self) -> None:
        """End the cycle before, and have the packet of the next one ready."""
        self._sample.msr_jnt_pos[:] = self.session.close_cycle().position
        self._interpreter.advance(self._period_ms)
        self._packet = self.session.packet(self._sample) if self.session.state else b""

    def send(self, due: float, counts: bool) -> None:
        """The packet of this cycle, which was `due` [s]; its latency is told where it `counts`."""
        packet = self._packet
        if not packet:
            return
        left = self._looked = time.monotonic()
        self._open = packet[:2], left
        try:
            self._wire.send(packet)
        except ConnectionRefusedError:
            self._open = None
        if counts:
            self._under_way[packet[:2]] = left, len(self.latency)
            self.latency.append(np.inf)
            self.lateness.append(left - due)

    def look(self) -> None:
        """Take an answer, if one is there. How long the sender did not look for it counts as late as well."""
        before, self._looked = self._looked, time.monotonic()
        try:
            answer = self._wire.recv(CMD_SIZE + 1)
        except BlockingIOError:
            return
        except ConnectionRefusedError:
            self._open = None
            return
        now = time.monotonic()
        left, place = self._under_way.pop(answer[2:4], (now, -1))
        if place >= 0:
            self.latency[place] = now - left
            self.lateness[place] = max(self.lateness[place], now - before)
        if self._open is not None and answer[2:4] == self._open[0]:
            self.session.receive(answer, min(now - self._open[1], self._period_ms * 0.999e-3))
            self._open = None


def send(ports: Sequence[int], period_ms: int, results: Connection) -> None:
    """The controller's side, on its own processor if there are two: sends to each port in turn, at even distances
    within a cycle, and counts what it sent while all were in command mode.

    A stall of its own delays the cycles that follow, so that no burst of packets is blamed on who must answer it.
    """
    processors = sorted(os.sched_getaffinity(0))
    set_up(90, processors[0] if len(processors) > 1 else None)
    links = [_Link(port, period_ms) for port in ports]
    step_s = period_ms * 1e-3 / len(links)

    def look(until: float) -> None:
        while (wait := until - time.monotonic()) > 0.0:
            for link in links:
                link.look()
            if not any(link.awaited for link in links):
                time.sleep(min(wait, _NAP_S))

    due = time.monotonic()
    while not results.poll(0):
        for link in links:
            due += step_s
            look(due - min(_READY_S, 0.5 * step_s))
            link.prepare()
            look(due)
            link.send(due, all(other.commanding for other in links))
            late = time.monotonic() - due
            if late > 0.5 * step_s:
                due += late
    results.send([(np.array(link.latency), np.array(link.lateness)) for link in links])


def measure(period_ms: int, seconds: float) -> dict[str, object]:
    """One run: distribution of the reply latency [us] as the sender sees it and as the loop sees it."""
    arm = Arm.load()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    context = multiprocessing.get_context("spawn")
    mine, theirs = context.Pipe()
    sender = context.Process(target=send, args=([port], period_ms, theirs), daemon=True)
    link = LinkSettings(address="127.0.0.1", port=port, realtime="allow", link_timeout_s=5.0)
    sender.start()
    with tempfile.TemporaryDirectory() as folder, Driver(arm, link) as driver:
        driver.connect(timeout_s=60.0)
        period_s = driver.state().period_s
        driver.record(Path(folder) / "latency.mcap", session_metadata(robot=arm.name))
        driver.enter_command()
        end = time.monotonic() + seconds
        motions = 0
        while time.monotonic() < end:
            here = driver.state().q_command
            goal = START + (0.5 if motions % 2 == 0 else 0.0)
            driver.execute(move_to(arm, here, goal, period_s, speed_scale=0.3)).check()
            motions += 1
        state = driver.state()
        recorded = driver.end_record("success")
        mine.send("enough")
        if not mine.poll(30.0):
            raise TimeoutError("the sender did not hand over its measurements within 30 s")
        [(latency, lateness)] = mine.recv()
        rights = driver.rights
    sender.join(10.0)
    assert rights is not None
    on_time = lateness < 0.2e-3
    return {
        "period_ms": period_ms,
        "packets": len(latency),
        "unanswered_in_time": int(np.sum(latency > period_ms * 1e-3)),
        "motions": motions,
        "recorded": recorded.samples,
        "overruns": recorded.overruns,
        "latency_us": _quantiles(latency),
        "latency_us_sender_on_time": _quantiles(latency[on_time]),
        "sender_late_share": float(np.mean(~on_time)),
        "sender_lateness_us": _quantiles(lateness),
        "inside_the_loop_us": {str(q): round(1e6 * value, 1) for q, value in state.latency_s.items()},
        "missing_rights": [shortage.what for shortage in rights.missing],
        "advice": [shortage.what for shortage in rights.advice],
        "processor": rights.processor,
    }


def _quantiles(values: np.ndarray) -> dict[str, float | None]:
    if len(values) == 0:
        return {}
    # Unanswered packets are infinite; they count, at the top, and are written as None.
    ordered = np.sort(values)
    places = [min(len(ordered) - 1, int(np.ceil(q * len(ordered))) - 1) for q in QUANTILES]
    found = {q: 1e6 * float(ordered[place]) for q, place in zip(QUANTILES, places, strict=True)}
    return {str(q): round(value, 1) if np.isfinite(value) else None for q, value in found.items()}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--period-ms", type=int, nargs="+", default=[1, 2, 5])
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    print(f"{platform.machine()}, {os.cpu_count()} processors, load {os.getloadavg()[0]:.1f}")
    for shortage in (*assess().missing, *assess().advice):
        print(f"  {shortage}")
    runs = [measure(period_ms, options.seconds) for period_ms in options.period_ms]
    print(f"{'period':>7} {'packets':>8} {'missed':>7}  reply latency [us] at p50 / p90 / p99 / p99.9 / max")
    for run in runs:
        for name, key in (("all", "latency_us"), ("sender on time", "latency_us_sender_on_time")):
            quantiles = run[key]
            assert isinstance(quantiles, dict)
            row = " / ".join(
                "none" if quantiles[str(q)] is None else f"{quantiles[str(q)]:.0f}" for q in QUANTILES
            )
            print(
                f"{run['period_ms']:>4} ms {run['packets']:>8} {run['unanswered_in_time']:>7}  "
                f"{row}  ({name})"
            )
    if options.json is not None:
        options.json.write_text(json.dumps({"load": os.getloadavg(), "runs": runs}, indent=1))


if __name__ == "__main__":
    main()
