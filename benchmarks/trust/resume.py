"""Experiments aborted at random instants, each finished by one `--resume`; and folders that changed since.

A run of three sessions, the last ones with a payload, is ended in its swap or its motion, in each session in turn: by
Ctrl-C once or twice, or by `kill -9` of runner, loop or emulator. `lwr-run experiment --resume` then has to finish: no
finished log changes, the payload of the first remaining session is asked for, no process stays behind. Then what
`--resume` must refuse before anything moves: a plan, a frozen file or the experiment file edited, a finished log empty,
cut or of another session, a second `--resume` at the same time.
"""

from __future__ import annotations

import contextlib
import json
import multiprocessing
import os
import shutil
import signal
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from benchmarks.trust.lab import descendants, gone
from benchmarks.trust.table import Ledger, stamp
from lwr_driver.session import read_session

__all__ = ["REFUSED", "campaign"]

_RUNS = 100
_AT_ONCE = 2
_PATIENCE_S = 900.0
_LOAD = {"name": "paper_load", "mass": 3.34, "com": [0.0, -0.066, 0.144]}
_SESSIONS: list[dict[str, Any]] = [
    {"name": "unloaded"},
    {"name": "loaded", "payload": _LOAD},
    {"name": "validation", "validation": True, "payload": _LOAD},
]
_SHORT: dict[str, Any] = {
    "name": "short",
    "emulator_settings": {"fri.period_ms": 20},
    "excitation": {"period_s": 4.0, "harmonics": 3, "periods": 1, "seed": 3},
    "moves": {"speed_scale": 0.8, "settle_s": 0.5, "brake_s": 0.1},
    "identification": {"model": 1},
    "diagnosis": {"run": False},
    "sessions": _SESSIONS,
}
_NAMES = [session["name"] for session in _SESSIONS]
_HOW = ("Ctrl-C", "Ctrl-C twice", "kill -9 runner", "kill -9 loop", "kill -9 emulator")
_PRELOAD = [
    "runner.commands.experiment",
    "runner.report.page",
    "sim_backend.rehearsal",
    "ident.estimation.identify",
]

Random = np.random.Generator


def _command(arguments: list[str], out: str) -> None:
    os.setsid()
    stream = os.open(out, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(stream, 1)
    os.dup2(stream, 2)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    from runner.cli import main

    main(["experiment", *arguments, "--yes"])


class _Command:
    """`lwr-run experiment` in a process of its own session, its output in a file."""

    def __init__(self, folder: Path, *arguments: str) -> None:
        self.out = folder / f"output-{len(list(folder.glob('output-*')))}.txt"
        context = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload(_PRELOAD)
        self._process = context.Process(target=_command, args=(list(arguments), str(self.out)))
        self._process.start()
        assert self._process.pid is not None
        self.pid = self._process.pid

    @property
    def ended(self) -> bool:
        return self._process.exitcode is not None

    @property
    def text(self) -> str:
        return self.out.read_text(errors="replace") if self.out.exists() else ""

    def wait(self) -> int | None:
        """Its exit code; None if it does not end."""
        self._process.join(_PATIENCE_S)
        if self._process.exitcode is None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self.pid, signal.SIGKILL)
        return self._process.exitcode


def _progress(run: Path) -> dict[str, Any]:
    try:
        content: dict[str, Any] = json.loads((run / "progress.json").read_text())
        return content
    except (OSError, ValueError):
        return {"finished": {}, "attempts": {}}


def _reached(run: Path, session: int, moment: str) -> bool:
    progress = _progress(run)
    if moment == "motion":
        return _NAMES[session] in progress["attempts"]
    if session == 0:
        return (run / "plan.yaml").is_file()
    return _NAMES[session - 1] in progress["finished"]


def _named(pids: list[int], word: str) -> list[int]:
    found = []
    for pid in pids:
        with contextlib.suppress(OSError):
            if word in Path(f"/proc/{pid}/cmdline").read_text().replace("\0", " "):
                found.append(pid)
    return found


def _deliver(how: str, command: _Command) -> None:
    pids = descendants(command.pid)
    with contextlib.suppress(ProcessLookupError):
        if how.startswith("Ctrl-C"):
            # A terminal sends Ctrl-C to all its processes.
            for _ in range(2 if how.endswith("twice") else 1):
                os.killpg(command.pid, signal.SIGINT)
                time.sleep(0.1)
        elif how == "kill -9 runner":
            os.kill(command.pid, signal.SIGKILL)
        else:
            for pid in _named(pids, {"loop": "loop_process", "emulator": "sim_backend"}[how.split()[-1]])[:1]:
                os.kill(pid, signal.SIGKILL)


def _abort(folder: Path, random: Random, session: int) -> tuple[str, list[str]]:
    """One experiment, aborted and resumed; where it was aborted, and what did not hold."""
    file, run = folder / "short.yaml", folder / "run"
    moment, how = str(random.choice(["swap", "motion"])), str(random.choice(_HOW))
    delay = float(random.uniform(0.0, 1.0))
    # Loop and emulator are killed as processes of their own; half of the others have the quicker lane of the default.
    apart = how.endswith(("loop", "emulator")) or random.random() < 0.5
    file.write_text(yaml.safe_dump(_SHORT | {"transport": "udp" if apart else "in_process"}))
    command = _Command(folder, str(file), "--out", str(run))
    while not command.ended and not _reached(run, session, moment):
        time.sleep(0.01)
    time.sleep(delay)
    children = descendants(command.pid)
    _deliver(how, command)
    code = command.wait()
    bad = [] if code is not None else [f"{how}: not ended after {_PATIENCE_S:.0f} s"]
    if "Traceback" in command.text and "kill" not in how:
        bad.append(f"{how}: traceback: {command.text[-400:]}")
    progress = _progress(run)
    left = [name for name in _NAMES if name not in progress["finished"]]
    if code == 0 or not left:
        return "after the last motion", bad
    kept = {name: (run / f"{name}.mcap").read_bytes() for name in progress["finished"]}
    if alive := gone(children):
        bad.append(f"{how}: processes left: {alive}")
    resumed = _Command(folder, "--resume", str(run))
    if (code := resumed.wait()) != 0:
        bad.append(f"{how} in {left[0]}: --resume exits with {code}: {resumed.text[-400:]}")
    if f"payload for session {left[0]}" not in resumed.text:
        bad.append(f"{how} in {left[0]}: the payload was not asked for")
    bad += [
        f"{name}.mcap changed" for name, data in kept.items() if (run / f"{name}.mcap").read_bytes() != data
    ]
    for name in _NAMES if code == 0 else ():
        end = read_session(run / f"{name}.mcap").end or {}
        if end.get("exit_status") != "success":
            bad.append(f"{name}: the log ends with {end}")
    return left[0], bad


def _edit(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text, f"{old!r} is not in {path}"
    path.write_text(text.replace(old, new, 1))


def _swap_logs(run: Path) -> None:
    (run / "loaded.mcap").write_bytes((run / "unloaded.mcap").read_bytes())


def _cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-3000])


def _scaled_plan(run: Path) -> None:
    content = yaml.safe_load((run / "plan.yaml").read_text())
    content["motion"]["a"] = [[0.8 * value for value in row] for row in content["motion"]["a"]]
    (run / "plan.yaml").write_text(yaml.safe_dump(content, sort_keys=False))


def _reversed_joints(run: Path) -> None:
    content = yaml.safe_load((run / "plan.yaml").read_text())
    content["joint_names"].reverse()
    (run / "plan.yaml").write_text(yaml.safe_dump(content, sort_keys=False))


#: What is done to the folder of an aborted experiment, by name; each has to be refused.
REFUSED: dict[str, Callable[[Path], Any]] = {
    "plan scaled": _scaled_plan,
    "plan with reversed joints": _reversed_joints,
    "frozen arm edited": lambda run: _edit(
        run / "files/configs/lwr4plus.yaml", "velocity_deg_s: 110", "velocity_deg_s: 90"
    ),
    "frozen cell removed": lambda run: (run / "files/configs/cell.yaml").unlink(),
    "experiment file edited": lambda run: _edit(run / "experiment.yaml", "settle_s: 0.5", "settle_s: 0.9"),
    "manifest broken": lambda run: (run / "files/files.json").write_text("{}"),
    "finished log empty": lambda run: (run / "unloaded.mcap").write_bytes(b""),
    "finished log cut": lambda run: _cut(run / "unloaded.mcap"),
    "finished log of another session": _swap_logs,
    "progress of no numbers": lambda run: _edit(run / "progress.json", '"tau": [', '"tau": ["x", '),
}


def _template(folder: Path) -> Path:
    """A folder whose experiment was aborted in its last session."""
    file, run = folder / "short.yaml", folder / "run"
    file.write_text(yaml.safe_dump(_SHORT))
    command = _Command(folder, str(file), "--out", str(run))
    while not command.ended and not _reached(run, 2, "motion"):
        time.sleep(0.01)
    os.killpg(command.pid, signal.SIGINT)
    command.wait()
    return run


def _refused(template: Path, folder: Path, change: Callable[[Path], Any]) -> list[str]:
    run = folder / "run"
    shutil.copytree(template, run)
    change(run)
    before = _progress(run)
    command = _Command(folder, "--resume", str(run))
    code = command.wait()
    bad = [] if code in (2, 7) else [f"exit code {code}: {command.text[-300:]}"]
    if "Traceback" in command.text:
        bad.append(f"traceback: {command.text[-300:]}")
    if _progress(run).get("attempts") != before.get("attempts"):
        bad.append("a session began")
    return bad


def _two_at_once(template: Path, folder: Path) -> list[str]:
    run = folder / "run"
    shutil.copytree(template, run)
    both = [_Command(folder, "--resume", str(run))]
    while not both[0].ended and not both[0].text:
        time.sleep(0.01)
    both.append(_Command(folder, "--resume", str(run)))
    codes = [command.wait() for command in both]
    if sorted(str(code) for code in codes) != ["0", "3"]:
        return [f"exit codes {codes}: {both[1].text[-300:]}"]
    return []


def _counted(ledger: Ledger, line: str, bad: list[str], name: str) -> None:
    entry = ledger.line("resume", line)
    entry.figures |= stamp()
    entry.count(bad, name)


def campaign(ledger: Ledger, options: Any) -> None:
    """Aborts by the session they met, then the refusals."""

    def one(number: int) -> tuple[int, str, list[str]]:
        random = np.random.default_rng([options.seed, number])
        with tempfile.TemporaryDirectory() as name:
            where, bad = _abort(Path(name), random, number % len(_NAMES))
        return number, where, bad

    todo = [n for n in range(options.runs or _RUNS) if not ledger.has("resume", str(n))]
    with ThreadPoolExecutor(_AT_ONCE) as pool:
        for number, where, bad in pool.map(one, todo):
            _counted(
                ledger, f"abort in {where}" if where in _NAMES else f"abort {where}", bad, f"run {number}"
            )
            for complaint in bad:
                options.say(f"run {number}: {complaint}")
            ledger.finish("resume", str(number))
    with tempfile.TemporaryDirectory() as name:
        template: Path | None = None
        for what, change in {**REFUSED, "two at once": None}.items():
            if ledger.has("resume", what):
                continue
            template = template or _template(Path(name))
            place = Path(name) / what.replace(" ", "_")
            place.mkdir()
            bad = _two_at_once(template, place) if change is None else _refused(template, place, change)
            _counted(ledger, "folder changed since" if change else what, bad, what)
            for complaint in bad:
                options.say(f"{what}: {complaint}")
            ledger.finish("resume", what)
