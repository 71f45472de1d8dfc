"""Driver, emulator and recorder in lock step over UDP and in one process: time of a cycle, and equal logs.

    python -m benchmarks.transports
    python -m benchmarks.transports --seconds 30 --period-ms 2

A joint-space motion of `--seconds` is driven and recorded both ways. Processor time is that of all processes; the
figures of one run compare with each other, not with those of another computer.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
import time
from pathlib import Path

import click
import numpy as np
from mcap.reader import make_reader

from benchmarks.emulator_speed import cpu_s
from lwr_driver.arm import Arm
from lwr_driver.driver import Driver, LinkSettings
from lwr_driver.motion import Motion, check_motion
from lwr_driver.session import session_metadata
from lwr_driver.session.motor_torque import KrlMotorTorque
from runner.laboratory import free_port
from sim_backend.process import EmulatorProcess

PROGRAM = "lwr_identification"


def motion(arm: Arm, start: np.ndarray, period_s: float, seconds: float) -> Motion:
    """All joints to and fro within every limit, from rest to rest."""
    time_s = np.arange(round(seconds / period_s) + 1) * period_s
    rise = np.sin(np.pi * time_s / time_s[-1])[:, None] ** 4
    made = Motion(
        start + 0.3 * rise * np.sin(2.0 * np.pi * 0.2 * time_s)[:, None], period_s, ((0, "period 1"),)
    )
    check_motion(arm, made)
    return made


def drive(path: Path, hosting: bool, period_ms: int, seconds: float) -> tuple[int, float, float]:
    """Cycles, wall time and processor time of the recorded motion [s]."""
    arm, port = Arm.load(), free_port("127.0.0.1")
    link = LinkSettings("127.0.0.1", port, lock_step=True, handshake=PROGRAM, lock_step_patience_s=60.0)
    with (
        EmulatorProcess(
            fri_port=port, period_ms=period_ms, settings={"fri.program": PROGRAM}, hosting=hosting
        ) as emulator,
        Driver(arm, link, motor_torque=KrlMotorTorque(), host=emulator.host) as driver,
    ):
        driver.connect()
        driver.wait_quality()
        driver.enter_command()
        driver.record(path, session_metadata(robot="LWR4+", uid="1", utc_start="2020-01-01T00:00:00+00:00"))
        state = driver.state()
        rows = motion(arm, state.q_command, state.period_s, seconds)
        assert emulator.pid is not None
        assert driver._loop is not None
        assert driver._recorder is not None
        pids = {os.getpid(), emulator.pid, driver._loop.pid, driver._recorder.pid}
        cpu, wall = sum(cpu_s(pid) for pid in pids), time.perf_counter()
        outcome = driver.execute(rows)
        wall = time.perf_counter() - wall
        cpu = sum(cpu_s(pid) for pid in pids) - cpu
        driver.end_record(outcome.status, outcome.reason)
        outcome.check()
    return len(rows), wall, cpu


def digest(path: Path) -> str:
    """Hash of all messages of a log with their topics, times and numbers."""
    found = hashlib.sha256()
    with path.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages():
            head = f"{channel.topic} {message.log_time} {message.publish_time} {message.sequence} "
            found.update(head.encode() + message.data)
    return found.hexdigest()


@click.command()
@click.option("--seconds", default=20.0, help="Length of the motion.")
@click.option("--period-ms", default=1, help="FRI cycle.")
def main(seconds: float, period_ms: int) -> None:
    click.echo("transport     cycles  wall/cycle  cpu/cycle  x real time  x real time by processor time")
    with tempfile.TemporaryDirectory() as folder:
        hashes = set()
        for name, hosting in (("udp", False), ("in process", True)):
            path = Path(folder) / f"{hosting}.mcap"
            cycles, wall, cpu = drive(path, hosting, period_ms, seconds)
            hashes.add(digest(path))
            times = f"{1e6 * wall / cycles:8.0f} us {1e6 * cpu / cycles:7.0f} us"
            click.echo(f"{name:<12} {cycles:7d} {times} {seconds / wall:12.1f} {seconds / cpu:12.1f}")
    click.echo("the logs are equal" if len(hashes) == 1 else "THE LOGS DIFFER")


if __name__ == "__main__":
    main()
