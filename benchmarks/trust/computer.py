"""Faults of this computer: processes killed at random instants, disk, clock, starvation, Ctrl-C."""

from __future__ import annotations

import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import yaml

from benchmarks.trust.lab import Lab, descendants, gone
from benchmarks.trust.stand import Stand, shared_ring
from benchmarks.trust.table import Ledger
from fri.errors import ConfigurationError, DataError, LwrError
from lwr_driver.control import Word
from lwr_driver.session import read_session, recover, session_metadata

__all__ = ["campaign"]

_RUNS = 200
_FEW = 20
_CHUNK_S = 0.5
_SHORT = {
    "name": "short",
    "emulator_settings": {"fri.period_ms": 5},
    "excitation": {"period_s": 6.0, "harmonics": 3, "periods": 1, "seed": 3},
    "moves": {"home": [0.0, 0.5, 0.0, -1.3, 0.0, 0.8, 0.0], "speed_scale": 0.5, "settle_s": 0.5},
    "identification": {"model": 1},
    "diagnosis": {"run": False},
    "sessions": [{"name": "first"}, {"name": "second"}],
}

Random = np.random.Generator


def _after_cycles(lab: Lab, cycles: int, action: Any) -> threading.Thread:
    """Do something as soon as the loop has seen so many packets more."""
    words = lab.driver._need(lab.driver._control).words
    goal = int(words[Word.CYCLES]) + cycles

    def wait() -> None:
        deadline = time.monotonic() + 20.0
        while int(words[Word.CYCLES]) < goal and time.monotonic() < deadline:
            time.sleep(0.0002)
        action()

    thread = threading.Thread(target=wait)
    thread.start()
    return thread


def _session(lab: Lab, path: Path, cycles: int, action: Any) -> tuple[str, str, Any]:
    """Record a session and let `action` happen within it; status, reason, and how the recording ended."""
    driver = lab.driver
    recorded: Any = None
    thread = None
    try:
        driver.record(path, session_metadata(robot="LWR4+"))
        thread = _after_cycles(lab, cycles, action)
        driver.enter_command()
        outcome = driver.execute(lab.motion())
        status, reason = outcome.status, outcome.reason
        driver.leave_command()
    except LwrError as error:
        status, reason = "fail", str(error)
    finally:
        if thread is not None:
            thread.join()
    try:
        recorded = driver.end_record(status, reason)  # type: ignore[arg-type]
    except LwrError as error:
        reason = reason or str(error)
        status = "fail"
    return status, reason, recorded


def _kill(lab: Lab, victim: str, random: Random, folder: Path) -> list[str]:
    """One run in which a process is killed; what did not hold."""
    driver = lab.driver
    path = folder / "killed.mcap"
    path.unlink(missing_ok=True)
    pids = {
        "loop": driver._need(driver._loop).pid,
        "logger": driver._need(driver._recorder).pid,
        "emulator": lab.emulator.pid,
    }
    ring = driver._need(driver._ring)
    before = ring.head
    published = 0

    def kill() -> None:
        nonlocal published
        published = ring.tail - before
        os.kill(pids[victim], signal.SIGKILL)

    status, reason, recorded = _session(lab, path, int(random.integers(1, 900)), kill)
    ours = [pid for pid in pids.values() if pid is not None]
    lab.close()
    bad = [f"processes left: {left}"] if (left := gone(ours)) else []
    if status != "fail" and recorded is None:
        bad.append(f"ended with {status} {reason!r} although the {victim} was killed")
    if status == "fail" and not reason:
        bad.append("no reason")
    return bad + _readable(path, published, 5, folder)


def _readable(path: Path, taken: int, period_ms: int, folder: Path) -> list[str]:
    """Whether a log holds all but the last chunk of what the recorder took, and recovers."""
    try:
        session = read_session(path)
    except DataError as error:
        # Nothing but the head may be there before the first chunk.
        return [] if taken < 2 * _CHUNK_S / (period_ms * 1e-3) else [f"log: {error}"]
    bad = []
    least = taken - 2 * _CHUNK_S / (period_ms * 1e-3)
    if len(session.joint) < least:
        bad.append(f"log has {len(session.joint)} samples, at least {least:.0f} were taken long before")
    if session.end is None:
        whole = folder / "whole.mcap"
        whole.unlink(missing_ok=True)
        recover(path, whole)
        again = read_session(whole)
        if again.end is None or len(again.joint) != len(session.joint):
            bad.append(f"recovered log has {len(again.joint)} samples instead of {len(session.joint)}")
    return bad


def _full_disk(lab: Lab, random: Random, folder: Path) -> list[str]:
    path = folder / "full.mcap"
    path.unlink(missing_ok=True)
    pid = lab.driver._need(lab.driver._recorder).pid
    size = int(random.integers(10_000, 60_000))
    limit = (size, size)
    status, reason, recorded = _session(
        lab, path, 1, lambda: resource.prlimit(pid, resource.RLIMIT_FSIZE, limit)
    )
    text = f"{reason} {recorded.error if recorded else ''}"
    bad = [] if status == "fail" else [f"ended with {status} on a full disk"]
    if "too large" not in text and "space" not in text and "written" not in text:
        bad.append(f"reason does not name the disk: {text}")
    bad += lab.violations()
    lab.renew()
    return bad + _readable(path, 0, 5, folder)


def _stalled(lab: Lab, victim: str, random: Random, folder: Path) -> list[str]:
    """The process stands still for a while in the middle of a motion; in lock step nothing is lost."""
    path = folder / "stalled.mcap"
    path.unlink(missing_ok=True)
    driver = lab.driver
    pid = driver._need(driver._loop if victim == "loop" else driver._recorder).pid
    pause = float(random.uniform(0.05, 1.5))

    def stall() -> None:
        os.kill(pid, signal.SIGSTOP)
        time.sleep(pause)
        os.kill(pid, signal.SIGCONT)

    status, reason, recorded = _session(lab, path, int(random.integers(1, 700)), stall)
    bad = lab.violations()
    if status != "success":
        bad.append(f"ended with {status}: {reason}")
    if recorded is None or recorded.missed or recorded.overruns:
        bad.append(f"log: {recorded}")
    return bad


def _read_only(lab: Lab) -> list[str]:
    try:
        lab.driver.record(Path("/proc/run.mcap"), session_metadata(robot="LWR4+"))
    except ConfigurationError as error:
        return [] if "/proc/run.mcap" in str(error) else [f"error without the name: {error}"]
    return ["a log could be opened in a folder that cannot be written"]


def _clock_jump(random: Random, ring: Any, folder: Path) -> list[str]:
    """The wall clock jumps while a log is written; its times follow the monotonic clock."""
    with Stand(np.random.SeedSequence(int(random.integers(10**6))), ring, folder, lock_step=False) as stand:
        stand.cycles(100)
        stand.drain()
        jump = int(random.uniform(-3600e9, 3600e9))
        with patch("time.time_ns", lambda: jump):
            stand.cycles(100)
            stand.drain()
        stand.close_log("success", "")
        steps = np.diff(read_session(stand.path).joint.log_time)
    return [] if np.all(steps == 5_000_000) else [f"log times step by {steps.min()} to {steps.max()} ns"]


def _prepared(folder: Path) -> Path:
    """A folder from which the short experiment goes on at its beginning, planned already."""
    template = folder / "template"
    source = folder / "short.yaml"
    source.write_text(yaml.safe_dump(_SHORT))
    command = [sys.executable, "-m", "runner.cli", "experiment", str(source), "--yes", "--out", str(template)]
    subprocess.run(command, check=True, capture_output=True)
    for name in ("first.mcap", "second.mcap", "summary.json", "report.txt", "model.yaml", "report.html"):
        (template / name).unlink(missing_ok=True)
    content = json.loads((template / "progress.json").read_text())
    (template / "progress.json").write_text(json.dumps({**content, "finished": {}, "attempts": {}}))
    return template


def _runner(template: Path, signals: int, number: int, random: Random, folder: Path) -> list[str]:
    """Kill or interrupt the experiment at a random instant, then let it go on; what did not hold."""
    run = folder / "run"
    shutil.rmtree(run, ignore_errors=True)
    shutil.copytree(template, run)
    command = [sys.executable, "-m", "runner.cli", "experiment", "--resume", str(run), "--yes"]
    process = subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    # From the first packets on, so that the interesting part is met more often than the imports.
    begun = time.monotonic()
    while process.poll() is None and len(descendants(process.pid)) < 3 and time.monotonic() - begun < 60.0:
        time.sleep(0.05)
    time.sleep(float(random.uniform(0.0, 6.0)))
    children = descendants(process.pid)
    for _ in range(signals):
        if process.poll() is None:
            process.send_signal(number)
            time.sleep(float(random.uniform(0.02, 0.4)))
    try:
        _, text = process.communicate(timeout=120.0)
    except subprocess.TimeoutExpired:
        process.kill()
        return ["still there two minutes after the signal"]
    bad = [f"processes left: {left}"] if (left := gone(children)) else []
    if number != signal.SIGKILL and "Traceback" in text and "KeyboardInterrupt" not in text:
        bad.append(f"traceback: {text.strip().splitlines()[-1]}")
    if number != signal.SIGKILL and process.returncode not in (0, 1, 4, 5, 6, 130, -number):
        bad.append(f"exit code {process.returncode}: {text.strip().splitlines()[-1:]}")
    for log in sorted(run.glob("*.mcap")):
        bad += [f"{log.name}: {complaint}" for complaint in _readable(log, 0, 5, folder)]
    finished = set(json.loads((run / "progress.json").read_text())["finished"])
    kept = {name: (run / f"{name}.mcap").read_bytes() for name in finished}
    again = subprocess.run(command, capture_output=True, text=True)
    if again.returncode:
        return [*bad, f"--resume failed: {again.stderr.strip().splitlines()[-1:]}"]
    progress = json.loads((run / "progress.json").read_text())
    if set(progress["finished"]) != {"first", "second"}:
        bad.append(f"--resume finished {sorted(progress['finished'])}")
    if any((run / f"{name}.mcap").read_bytes() != content for name, content in kept.items()):
        bad.append("--resume changed a finished session")
    for name, attempts in progress["attempts"].items():
        logs = [run / f"{name}.mcap", *run.glob(f"{name}.attempt-*.mcap")]
        uids = {read_session(log).metadata["uid"] for log in logs if _has_rows(log)}
        if not uids <= set(attempts) or len(set(attempts)) != len(attempts):
            bad.append(f"attempts at {name}: {attempts}, logs: {sorted(uids)}")
    return bad


def _has_rows(path: Path) -> bool:
    try:
        read_session(path)
    except DataError:
        return False
    return True


def campaign(ledger: Ledger, options: Any) -> None:
    """Every fault of the computer, one line each."""
    runs, few = options.runs or _RUNS, min(options.runs or _FEW, _FEW)
    with tempfile.TemporaryDirectory() as name, shared_ring() as ring:
        folder = Path(name)
        template: Path | None = None

        def work(what: str, count: int, one: Any) -> None:
            line = ledger.line("computer", what)
            for number in range(count):
                if not ledger.has("computer", f"{what} {number}"):
                    random = np.random.default_rng([options.seed, number, len(what)])
                    line.count(one(random), f"run {number}")
                    ledger.finish("computer", f"{what} {number}")

        work("clock jump", few, lambda random: _clock_jump(random, ring, folder))
        with Lab() as lab:

            def on_lab(one: Any) -> Any:
                def go(random: Random) -> list[str]:
                    lab.ready() if lab._made else lab.renew()
                    return list(one(random))

                return go

            work("read-only folder", 1, on_lab(lambda random: _read_only(lab)))
            for victim in ("loop", "logger", "emulator"):
                work(f"kill -9 {victim}", runs, on_lab(lambda r, v=victim: _kill(lab, v, r, folder)))
            work("disk full", few, on_lab(lambda random: _full_disk(lab, random, folder)))
            for victim in ("loop", "logger"):
                work(f"{victim} stands still", few, on_lab(lambda r, v=victim: _stalled(lab, v, r, folder)))
        for what, count, number in (
            ("kill -9 runner", 1, signal.SIGKILL),
            ("Ctrl-C", 1, signal.SIGINT),
            ("Ctrl-C twice", 2, signal.SIGINT),
        ):
            if all(ledger.has("computer", f"{what} {place}") for place in range(runs)):
                continue
            template = template or _prepared(folder)
            chosen = template
            work(what, runs, lambda r, c=count, n=number, t=chosen: _runner(t, c, n, r, folder))
