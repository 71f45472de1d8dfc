"""Emulator, driver and recorder as processes, used by one run after the other and made anew when broken."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

import numpy as np

from fri.errors import LwrError
from lwr_driver.arm import Arm
from lwr_driver.driver import Driver, LinkSettings
from lwr_driver.motion import Motion, move_to
from runner.laboratory import free_port
from runner.planning import dwell
from sim_backend.process import EmulatorProcess

__all__ = ["Lab", "descendants", "gone"]

HOME = np.array([0.0, 0.5, 0.0, -1.3, 0.0, 0.8, 0.0])
HOP = np.array([0.3, 0.2, 0.3, 0.4, 0.5, 0.2, 0.6])

# A busy computer may take long to start a process.
_START_S = 300.0


class Lab:
    """A laboratory of processes. A context manager.

    settings : of the emulator, by dotted names

    made : whether there are processes
    """

    def __init__(
        self, *, period_ms: int = 5, lock_step: bool = True, settings: dict[str, Any] | None = None
    ) -> None:
        self.arm = Arm.load()
        self._period_ms, self._lock_step = period_ms, lock_step
        # A dead driver is waited for no longer than needed.
        self._settings = {"fri.patience_s": 2.0, **(settings or {})}
        self.emulator: EmulatorProcess
        self.driver: Driver
        self.made = False

    def __enter__(self) -> Lab:
        self.renew()
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """End all processes."""
        if self.made:
            self.driver.close()
            self.emulator.stop()
            self.made = False

    def renew(self) -> None:
        """New processes."""
        self.close()
        self.emulator = EmulatorProcess(
            start_s=_START_S,
            lock_step=self._lock_step,
            fri_port=free_port("127.0.0.1"),
            period_ms=self._period_ms,
            settings=self._settings,
        )
        self.emulator.start()
        self.made = True
        self.reconnect()

    def reconnect(self) -> None:
        """A new driver at the same emulator."""
        link = LinkSettings(
            "127.0.0.1",
            self.emulator.fri_port,
            lock_step=self._lock_step,
            lock_step_patience_s=3.0,
            realtime="allow",
        )
        self.driver = Driver(self.arm, link)
        self.driver.connect()

    def ready(self) -> None:
        """Back to monitor mode, as an operator brings it there; new processes where that fails."""
        try:
            pendant = self.emulator.pendant
            pendant.clear_faults()
            self.driver.stop()
            self.driver.leave_command()
            pendant.release_emergency_stop()
            pendant.mode("EXT")
            # In lock step the arm comes to rest only while packets go to and fro.
            self.driver.monitor(100)
            pendant.drives(on=True)
            pendant.reset_monitor()
            self.driver.wait_quality(cycles=50)
        except LwrError:
            self.renew()
            self.driver.wait_quality(cycles=50)

    def motion(self) -> Motion:
        """Away, rest, and back."""
        state = self.driver.state()
        here = state.q_command
        # Towards home in every joint, so that motions broken off midway never lead astray.
        there = here + np.where(here < HOME, HOP, -HOP)
        away = move_to(self.arm, here, there, state.period_s, speed_scale=0.5)
        back = move_to(self.arm, there, here, state.period_s, speed_scale=0.5, phase="excitation")
        return away.join(dwell(there, 0.3, state.period_s, "settle")).join(back)

    def violations(self) -> list[str]:
        """What the emulator's command monitor has to say."""
        monitor = self.emulator.status()["monitor"]
        return [f"outside the limits: {monitor['first_violation']}"] if monitor["violations"] else []


def descendants(pid: int) -> list[int]:
    """Children of a process and theirs."""
    parents: dict[int, int] = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                fields = (entry / "stat").read_text().rpartition(")")[2].split()
            except OSError:
                continue
            parents[int(entry.name)] = int(fields[1])
    found, front = [], [pid]
    while front:
        front = [child for child, parent in parents.items() if parent in front]
        found += front
    return found


def gone(pids: list[int], patience_s: float = 60.0) -> list[int]:
    """Those of the processes that are still there after a while."""
    deadline = time.monotonic() + patience_s
    left = list(pids)
    while left and time.monotonic() < deadline:
        left = [pid for pid in left if _runs(pid)]
        time.sleep(0.05)
    return left


def _runs(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state not in ("Z", "X") and pid != os.getpid()
