"""Faults of this computer: processes killed at random instants, disk, clock, starvation, Ctrl-C."""

from __future__ import annotations

import contextlib
import json
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import yaml

from benchmarks.trust.lab import Lab, descendants, gone
from benchmarks.trust.stand import Stand, shared_ring
from benchmarks.trust.table import Ledger
from fri.errors import ConfigurationError, DataError, LwrError, NetworkError
from lwr_driver.control import Word
from lwr_driver.session import read_session, recover, session_metadata

__all__ = ["campaign"]

_RUNS = 200
_FEW = 20
_CHUNK_S = 0.5
_END_PATIENCE_S = 600.0
_SHORT: dict[str, Any] = {
    "name": "short",
    "emulator_settings": {"fri.period_ms": 5},
    "excitation": {"period_s": 6.0, "harmonics": 3, "periods": 1, "seed": 3},
    "moves": {"home": [0.0, 0.5, 0.0, -1.3, 0.0, 0.8, 0.0], "speed_scale": 0.5, "settle_s": 0.5},
    "identification": {"model": 1},
    "diagnosis": {"run": False},
    "sessions": [{"name": name} for name in ("first", "second", "third", "fourth")],
}

_NAMED = {
    "loop": "loop process",
    "logger": "recorder process",
    "emulator": "no packet|emulator is gone",
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
    ours = [pid for name, pid in pids.items() if pid is not None and name in (victim, "loop", "logger")]
    if victim == "emulator":
        lab.close()
    else:
        lab.driver.close()
    bad = [f"processes left: {left}"] if (left := gone(ours)) else []
    if status != "fail" and recorded is None:
        bad.append(f"ended with {status} {reason!r} although the {victim} was killed")
    if status == "fail" and not re.search(_NAMED[victim], reason):
        bad.append(f"reason does not name the {victim}: {reason!r}")
    bad += _readable(path, published, 5, folder)
    if victim != "emulator":
        # The same emulator takes the next driver, and its monitor has seen what arrived until the end.
        bad += lab.violations()
        lab.reconnect()
    return bad


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
    size = int(random.integers(8_000, 30_000))
    limit = (size, size)
    status, reason, recorded = _session(
        lab, path, 1, lambda: resource.prlimit(pid, resource.RLIMIT_FSIZE, limit)
    )
    text = f"{reason} {recorded.error if recorded else ''}"
    # What was written last may be told only as the log is closed; `lwr-run` fails the session then.
    told = status == "fail" or (recorded is not None and recorded.exit_status == "fail")
    bad = [] if told else [f"ended with {status} on a full disk"]
    if "too large" not in text and "space" not in text and "written" not in text:
        bad.append(f"reason does not name the disk: {text}")
    bad += lab.violations()
    lab.renew()
    return bad + _readable(path, 0, 5, folder)


def _standstill(lab: Lab, victim: str, pause_s: float) -> Callable[[], None]:
    """What makes the victim's process stand still for so long."""
    driver = lab.driver
    pid = driver._need(driver._loop if victim == "loop" else driver._recorder).pid

    def stall() -> None:
        os.kill(pid, signal.SIGSTOP)
        time.sleep(pause_s)
        os.kill(pid, signal.SIGCONT)

    return stall


def _stalled(lab: Lab, victim: str, random: Random, folder: Path) -> list[str]:
    """The process stands still for a while in the middle of a motion; in lock step nothing is lost."""
    path = folder / "stalled.mcap"
    path.unlink(missing_ok=True)
    stall = _standstill(lab, victim, float(random.uniform(0.05, 1.5)))
    status, reason, recorded = _session(lab, path, int(random.integers(1, 700)), stall)
    bad = lab.violations()
    if status != "success":
        bad.append(f"ended with {status}: {reason}")
    if recorded is None or recorded.missed or recorded.overruns:
        bad.append(f"log: {recorded}")
    return bad


def _starved(lab: Lab, victim: str, random: Random, folder: Path) -> list[str]:
    """The same in real time: the controller notices a loop that is late; a late logger harms nothing."""
    path = folder / "starved.mcap"
    path.unlink(missing_ok=True)
    stall = _standstill(lab, victim, float(random.uniform(0.005, 0.6)))
    status, reason, recorded = _session(lab, path, int(random.integers(60, 200)), stall)
    bad = lab.violations()
    # On a busy computer the controller may find other reasons to end the motion, and says so.
    if status != "success" and not re.search("answers missed|lost|no packet|late|waiting for", reason):
        bad.append(f"reason does not name the cause: {reason}")
    if recorded is None or recorded.error or recorded.overruns:
        return [*bad, f"log: {recorded}"]
    session = read_session(path)
    if len(session.joint) != recorded.samples or session.joint.lost != recorded.missed:
        bad.append(f"log: {len(session.joint)} samples, {session.joint.lost} gaps, {recorded}")
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
    for made in ("*.mcap", "summary.json", "report.txt", "model.yaml", "report.html"):
        for path in template.glob(made):
            path.unlink()
    content = json.loads((template / "progress.json").read_text())
    (template / "progress.json").write_text(json.dumps({**content, "finished": {}, "attempts": {}}))
    return template


class _NoLink(Exception):
    """No run was possible."""


class _Runner:
    """`lwr-run experiment --resume` is interrupted at random instants, again and again.

    Every run goes on in the folder that the one before left, so each of them tests `--resume` too.
    """

    def __init__(self, folder: Path) -> None:
        self._folder, self._run = folder, folder / "run"
        self._template: Path | None = None
        self._kept: dict[str, bytes] = {}

    def __call__(self, random: Random, signals: int, number: int) -> list[str]:
        """One run; what did not hold."""
        template = self._template = self._template or _prepared(self._folder)
        if not self._run.exists():
            shutil.copytree(template, self._run)
            self._kept = {}
        command = [sys.executable, "-m", "runner.cli", "experiment", "--resume", str(self._run), "--yes"]
        process = subprocess.Popen(
            command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, start_new_session=True
        )
        # From the first packets on, so that the interesting part is met more often than the imports.
        begun = time.monotonic()
        while (
            process.poll() is None and len(descendants(process.pid)) < 3 and time.monotonic() - begun < 60.0
        ):
            time.sleep(0.05)
        time.sleep(float(random.uniform(0.0, 8.0)))
        children = descendants(process.pid)
        for _ in range(signals):
            if process.poll() is None:
                # A terminal sends Ctrl-C to all its processes.
                os.killpg(process.pid, number) if number == signal.SIGINT else os.kill(process.pid, number)
                time.sleep(float(random.uniform(0.02, 0.4)))
        try:
            # What is finished is still estimated and reported.
            _, text = process.communicate(timeout=_END_PATIENCE_S)
        except subprocess.TimeoutExpired:
            process.kill()
            return [f"still there {_END_PATIENCE_S:.0f} s after the signal"]
        bad = [f"processes left: {left}"] if (left := gone(children)) else []
        if number != signal.SIGKILL:
            if "Traceback" in text and "KeyboardInterrupt" not in text:
                bad.append(f"traceback: {' | '.join(text.strip().splitlines()[-8:])}")
            if process.returncode not in (0, 1, 4, 5, 6, 130, -number):
                bad.append(f"exit code {process.returncode}: {text.strip().splitlines()[-1:]}")
        for log in sorted(self._run.glob("*.mcap")):
            bad += [f"{log.name}: {complaint}" for complaint in _readable(log, 0, 5, self._folder)]
        finished = self._count(bad)
        if process.returncode == 0 or len(finished) == len(_SHORT["sessions"]) - 1:
            bad += self._finish(command)
        return bad

    def _count(self, bad: list[str]) -> set[str]:
        """Hold the count of sessions and attempts against the logs; names of the finished sessions."""
        progress = json.loads((self._run / "progress.json").read_text())
        finished = set(progress["finished"])
        for name, content in self._kept.items():
            if name not in finished or (self._run / f"{name}.mcap").read_bytes() != content:
                bad.append(f"the finished session {name} was changed")
        self._kept = {name: (self._run / f"{name}.mcap").read_bytes() for name in finished}
        for name in finished:
            end = read_session(self._run / f"{name}.mcap").end or {}
            if end.get("exit_status") != "success":
                bad.append(f"session {name} counts as finished, its log says {end}")
        for name, attempts in progress["attempts"].items():
            logs = [self._run / f"{name}.mcap", *self._run.glob(f"{name}.attempt-*.mcap")]
            uids = {read_session(log).metadata["uid"] for log in logs if _has_rows(log)}
            if not uids <= set(attempts) or len(set(attempts)) != len(attempts):
                bad.append(f"attempts at {name}: {attempts}, logs: {sorted(uids)}")
        return finished

    def _finish(self, command: list[str]) -> list[str]:
        """Let it go on to the end, undisturbed."""
        again = subprocess.run(command, capture_output=True, text=True)
        bad = [f"--resume failed: {again.stderr.strip().splitlines()[-1:]}"] if again.returncode else []
        finished = self._count(bad)
        if finished != {session["name"] for session in _SHORT["sessions"]}:
            bad.append(f"--resume finished {sorted(finished)}")
        shutil.rmtree(self._run)
        return bad


def _has_rows(path: Path) -> bool:
    try:
        read_session(path)
    except DataError:
        return False
    return True


def campaign(ledger: Ledger, options: Any) -> None:
    """Every fault of the computer, one line each; the lines take turns, so that all have grown at any time."""
    runs, few = options.runs or _RUNS, min(options.runs or _FEW, _FEW)
    with tempfile.TemporaryDirectory() as name, contextlib.ExitStack() as stack:
        folder = Path(name)
        ring = stack.enter_context(shared_ring())
        labs: dict[bool, Lab] = {}
        runner = _Runner(folder)

        def on(lock_step: bool, one: Any) -> Any:
            """The same on a laboratory that is made at first use."""

            def go(random: Random) -> list[str]:
                if lock_step not in labs:
                    labs[lock_step] = stack.enter_context(
                        Lab(lock_step=lock_step, period_ms=5 if lock_step else 20)
                    )
                lab = labs[lock_step]
                try:
                    lab.ready() if lab.made else lab.renew()
                except NetworkError:
                    if lock_step:
                        raise
                    # This computer is too busy for any link in real time.
                    raise _NoLink from None
                return list(one(lab, random))

            return go

        work: list[tuple[str, int, Any]] = [
            ("clock jump", few, lambda random: _clock_jump(random, ring, folder)),
            ("read-only folder", 1, on(True, lambda lab, random: _read_only(lab))),
            ("disk full", few, on(True, lambda lab, random: _full_disk(lab, random, folder))),
        ]
        for victim in ("loop", "logger"):
            work.append(
                (
                    f"{victim} stands still",
                    few,
                    on(True, lambda lab, r, v=victim: _stalled(lab, v, r, folder)),
                )
            )
        work += [
            ("loop starved, real time", few, on(False, lambda lab, r: _starved(lab, "loop", r, folder))),
            ("logger starved, real time", few, on(False, lambda lab, r: _starved(lab, "logger", r, folder))),
        ]
        for victim in ("loop", "logger", "emulator"):
            work.append(
                (f"kill -9 {victim}", runs, on(True, lambda lab, r, v=victim: _kill(lab, v, r, folder)))
            )
        for what, times, count, sent in (
            ("kill -9 runner", runs, 1, signal.SIGKILL),
            ("Ctrl-C", few, 1, signal.SIGINT),
            ("Ctrl-C twice", few, 2, signal.SIGINT),
        ):
            work.append((what, times, lambda random, c=count, n=sent: runner(random, c, n)))
        work = [(what, count, one) for what, count, one in work if re.search(options.lines, what)]
        for number in range(max(runs, few)):
            for what, count, one in work:
                if number < count and not ledger.has("computer", f"{what} {number}"):
                    random = np.random.default_rng([options.seed, number, len(what)])
                    line = ledger.line("computer", what)
                    try:
                        line.count(one(random), f"run {number}")
                    except _NoLink:
                        line.figures["no link"] = line.figures.get("no link", 0) + 1
                    except LwrError as error:
                        line.count([f"{type(error).__name__}: {error}"], f"run {number}")
                        for lab in labs.values():
                            lab.close()
                    ledger.finish("computer", f"{what} {number}")
