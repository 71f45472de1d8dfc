"""How fast the loop process answers: its latency in real time, measured by the other side.

    python benchmarks/reply_latency.py --period-ms 1 --seconds 10 [--json FILE]

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
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np

from fri.krc import KrcSession
from fri.krl import PROGRAMS, Interpreter
from fri.packets import CMD_SIZE
from fri.policy import KrcLimits, KrcPolicy
from fri.sample import Sample
from fri.states import Quality
from lwr_driver.arm import Arm
from lwr_driver.driver import Driver, LinkSettings
from lwr_driver.motion import move_to
from lwr_driver.realtime import assess, set_up
from lwr_driver.session import session_metadata

START = np.array([0.0, 0.5, 0.0, -1.3, 0.0, 0.8, 0.0])
QUANTILES = (0.5, 0.9, 0.99, 0.999, 1.0)


def send(port: int, period_ms: int, results: Connection) -> None:
    """The controller's side: a session that forgives every miss, on its own processor if there are two."""
    arm = Arm.load()
    processors = sorted(os.sched_getaffinity(0))
    set_up(90, processors[0] if len(processors) > 1 else None)
    limits = KrcLimits(arm.q_min, arm.q_max, 1e6 * arm.v_max, np.full(7, 1e3))
    policy = KrcPolicy(
        bridged_cycles=10**6,
        hold_quality=Quality.UNACCEPTABLE,
        perfect_latency=1e3,
        perfect_rate=0.0,
        ok_rate=0.0,
        bad_rate=0.0,
    )
    session = KrcSession(limits, START, policy)
    interpreter = Interpreter(session, PROGRAMS["stanford"](period_ms))
    sample = Sample()
    wire = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    wire.connect(("127.0.0.1", port))
    wire.setblocking(False)
    latency: list[float] = []
    lateness: list[float] = []
    # When the packets left, and where their latency is told; an answer may come cycles later.
    under_way: dict[bytes, tuple[float, int]] = {}
    due = time.monotonic()
    while not results.poll(0):
        interpreter.advance(period_ms)
        if session.state == 0:
            sample.msr_jnt_pos[:] = session.close_cycle().position
            due = time.monotonic()
            continue
        due += period_ms * 1e-3
        time.sleep(max(0.0, due - time.monotonic()))
        packet = session.packet(sample)
        left = time.monotonic()
        sent = True
        try:
            wire.send(packet)
        except ConnectionRefusedError:
            sent = False
        commanding = session.state == 2
        if commanding:
            under_way[packet[:2]] = left, len(latency)
            latency.append(np.inf)
            lateness.append(left - due)
        arrived = None
        while sent and arrived is None and time.monotonic() < due + period_ms * 1e-3:
            try:
                answer = wire.recv(CMD_SIZE + 1)
            except BlockingIOError:
                continue
            except ConnectionRefusedError:
                break
            now = time.monotonic()
            before, place = under_way.pop(answer[2:4], (left, -1))
            if place >= 0:
                latency[place] = now - before
            if answer[2:4] == packet[:2]:
                arrived = now - left
                session.receive(answer, min(arrived, period_ms * 0.999e-3))
        sample.msr_jnt_pos[:] = session.close_cycle().position
    results.send((np.array(latency), np.array(lateness)))


def measure(period_ms: int, seconds: float) -> dict[str, object]:
    """One run: distribution of the reply latency [us] as the sender sees it and as the loop sees it."""
    arm = Arm.load()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    context = multiprocessing.get_context("spawn")
    mine, theirs = context.Pipe()
    sender = context.Process(target=send, args=(port, period_ms, theirs), daemon=True)
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
        latency, lateness = mine.recv()
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
