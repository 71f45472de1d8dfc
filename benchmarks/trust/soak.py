"""Long operation in lock step with swaps and faults: memory flat, files closed, no process left."""

from __future__ import annotations

import contextlib
import os
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.trust.lab import Lab, gone
from benchmarks.trust.table import Ledger
from fri.errors import LwrError
from lwr_driver.session import read_session, session_metadata

__all__ = ["campaign"]

_SECONDS = 3600.0
_GROWTH_MB = 8.0
_LAPS = 4
_WARM = 0.25  # share of the time in which a process may still grow
_FAULTS: tuple[tuple[str, dict[str, Any]], ...] = (
    ("inject", {"kind": "loss", "probability": 0.2, "cycles": 40}),
    ("inject", {"kind": "duplicate", "probability": 0.5, "cycles": 60}),
    ("inject", {"kind": "corrupt", "probability": 0.1, "bits": 2, "cycles": 40}),
    ("inject", {"kind": "reorder", "probability": 0.2, "cycles": 40}),
    ("inject", {"kind": "truncate", "probability": 0.2, "cycles": 40}),
    ("inject", {"kind": "delay", "probability": 0.2, "length": 2, "cycles": 40}),
    ("inject", {"kind": "burst", "probability": 0.1, "length": 20, "cycles": 40}),
    ("inject", {"kind": "foreign", "probability": 0.5, "cycles": 60}),
    ("emergency_stop", {}),
    ("drives", {"on": False}),
    ("mode", {"name": "T1"}),
    ("drive_fault", {"joint": 2}),
    ("degrade_quality", {"cycles": 50}),
    ("restart", {"silent_cycles": 60}),
)


def campaign(ledger: Ledger, options: Any) -> None:
    """One laboratory for all the time; every other session meets a fault."""
    seconds = options.seconds or _SECONDS
    if ledger.has("soak", f"{seconds:g} s"):
        return
    random = np.random.default_rng(options.seed)
    line = ledger.line("soak", "sessions with swaps and faults")
    began = time.monotonic()
    with tempfile.TemporaryDirectory() as name, Lab() as lab:
        pids = {
            "loop": lab.driver._need(lab.driver._loop).pid,
            "recorder": lab.driver._need(lab.driver._recorder).pid,
            "emulator": lab.emulator.pid or 0,
            "runner": os.getpid(),
        }
        usage: dict[str, list[tuple[float, int]]] = {part: [] for part in pids}
        cycles = 0
        while time.monotonic() - began < seconds:
            bad, samples = _session(lab, line.runs, random, Path(name))
            line.count(bad, f"session {line.runs}")
            cycles += samples
            for part, pid in pids.items():
                usage[part].append(_usage(pid))
            ledger.save()
        virtual_s = float(lab.emulator.status()["time_s"])
        ring = Path(lab.driver.ring_name)
        lab.close()
        left = [f"process {pid}" for pid in gone([pid for part, pid in pids.items() if part != "runner"])]
        left += [f"shared memory {ring}"] if ring.exists() else []
        found = {part: _growth(values) for part, values in usage.items()}
    line.figures = {
        "wall time [s]": round(time.monotonic() - began),
        "virtual time [s]": round(virtual_s),
        "samples logged": cycles,
    }
    line.figures |= {f"{part} grew [MB, files]": value for part, value in found.items()}
    for part, (memory, files) in found.items():
        if memory > _GROWTH_MB or files > 0:
            line.count([f"{part} grew by {memory} MB and {files} open files"])
    if left:
        line.count([f"left behind: {', '.join(left)}"])
    ledger.finish("soak", f"{seconds:g} s")


def _session(lab: Lab, number: int, random: np.random.Generator, folder: Path) -> tuple[list[str], int]:
    driver, pendant = lab.driver, lab.emulator.pendant
    path = folder / "soak.mcap"
    path.unlink(missing_ok=True)
    bad: list[str] = []
    try:
        pendant.clear_faults()
        driver.stop()
        driver.leave_command()
        pendant.release_emergency_stop()
        pendant.mode("EXT")
        # In lock step the arm comes to rest only while packets go to and fro.
        driver.monitor(100)
        pendant.drives(on=True)
        pendant.reset_monitor()
        if number % 3 == 0:
            pendant.mount("paper_load") if number % 2 else pendant.unmount()
        driver.wait_quality(cycles=50)
        driver.record(path, session_metadata(robot="LWR4+"))
        driver.enter_command()
        once = lab.motion()
        motion = once
        for _ in range(_LAPS - 1):
            motion = motion.join(once)
        if number % 2:
            command, arguments = _FAULTS[int(random.integers(len(_FAULTS)))]
            after = int(random.integers(5, len(motion) - 60))
            pendant.schedule(command, after_cycles=after, **arguments)
        outcome = driver.execute(motion)
        recorded = driver.end_record(outcome.status, outcome.reason)
    except LwrError as error:
        with contextlib.suppress(LwrError):
            driver.end_record("fail", str(error))
        return [f"{type(error).__name__}: {error}"], 0
    if number % 2 == 0 and outcome.status != "success":
        bad.append(f"without a fault: {outcome.reason}")
    if len(read_session(path).joint) != recorded.samples:
        bad.append("samples are missing in the log")
    return bad + lab.violations(), recorded.samples


def _usage(pid: int) -> tuple[float, int]:
    """Resident memory [MB] and open files."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6, len(list(Path(f"/proc/{pid}/fd").iterdir()))


def _growth(values: list[tuple[float, int]]) -> tuple[float, int]:
    """From the end of the warm-up to the end: median memory over an eighth of the time, and files."""
    table = np.array(values)
    warm, part = int(_WARM * len(table)), max(1, len(table) // 8)
    early, late = table[warm : warm + part], table[-part:]
    memory = float(np.median(late[:, 0]) - np.median(early[:, 0]))
    return round(memory, 2), int(np.median(late[:, 1]) - np.median(early[:, 1]))
