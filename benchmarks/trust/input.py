"""Mangled input, seeded: packets, logs, files. An error of ours or a correct result, in bounded time and memory.

Where atheris is installed (`pip install .[fuzz]`), a coverage-guided fuzzer goes on from there, `--seconds` for
each target; `python -m benchmarks.trust.fuzz TARGET` runs it alone. What breaks a promise is left in a file
`crash-...` beside the results.
"""

from __future__ import annotations

import hashlib
import importlib.util
import multiprocessing
import re
import resource
import subprocess
import sys
import time
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from benchmarks.trust import targets
from benchmarks.trust.table import Ledger, Line

__all__ = ["campaign", "mangle"]

_ROOT = Path(__file__).resolve().parents[2]
_RUNS = 2000
_BLOCK = 50
_GUIDED_S = 60.0
_PATIENCE_S = 60.0
_MEMORY = 6 << 30
_TEXT = frozenset({"experiment", "arm", "cell", "emulator", "mapping"})
_ODD: tuple[Any, ...] = (
    None, True, "", "nan", float("nan"), float("inf"), -1, 0, 1e308, -1e308, 2**63, 10**30, [], {}, [[]], [None],
    "../../etc/passwd", "/etc/passwd", "a" * 5000, "\x00", "ä", {"a": {"b": []}}, [1.0] * 1000, -0.0, 1e-320,
)  # fmt: skip
_TAGS = (
    b"!!python/object/apply:os.system ['true']\n",
    b"a: &a [1]\nb: [*a, *a, *a, *a]\n",
    b"&x [*x]\n",
    b"? [1, 2]\n: 3\n",
    b"\xff\xfe",
    b"- " * 3000,
    b"[" * 3000,
)


def mangle(name: str, data: bytes, random: np.random.Generator) -> bytes:
    """A bad version of good input."""
    if name in _TEXT and random.random() < 0.7:
        return _mangle_tree(data, random)
    changed = bytearray(data)
    for _ in range(int(random.integers(1, 6))):
        size = len(changed)
        place = int(random.integers(size + 1))
        kind = int(random.integers(7))
        if kind == 0 and size:
            changed[place % size] ^= 1 << int(random.integers(8))
        elif kind == 1:
            del changed[place : place + int(random.integers(1, 200))]
        elif kind == 2:
            changed[place:place] = random.bytes(int(random.integers(1, 40)))
        elif kind == 3:
            del changed[place:]
        elif kind == 4 and size:
            length = int(random.integers(1, 300))
            other = int(random.integers(size))
            changed[place:place] = changed[other : other + length]
        elif kind == 5 and size > 8:
            at = place % (size - 8)
            value = [0, 0xFF, 0x7F, 0x80][int(random.integers(4))]
            changed[at : at + int(random.choice([1, 2, 4, 8]))] = bytes([value]) * 4
        elif kind == 6 and name in _TEXT:
            changed[place:place] = _TAGS[int(random.integers(len(_TAGS)))]
    return bytes(changed)


def _mangle_tree(data: bytes, random: np.random.Generator) -> bytes:
    tree = yaml.safe_load(data)
    for _ in range(int(random.integers(1, 4))):
        node: Any = tree
        path: list[tuple[Any, Any]] = []
        while isinstance(node, dict | list) and node and (not path or random.random() < 0.75):
            keys = list(node) if isinstance(node, dict) else list(range(len(node)))
            key = keys[int(random.integers(len(keys)))]
            path.append((node, key))
            node = node[key]
        if not path:
            break
        parent, key = path[-1]
        kind = int(random.integers(4))
        if kind == 0:
            del parent[key]
        elif kind == 1 and isinstance(parent, dict):
            parent[f"{key}x"] = parent.pop(key)
        else:
            parent[key] = _ODD[int(random.integers(len(_ODD)))]
    return yaml.safe_dump(tree).encode()


def _worker(pipe: Connection) -> None:
    resource.setrlimit(resource.RLIMIT_AS, (_MEMORY, _MEMORY))
    while True:
        name, data = pipe.recv()
        began = time.monotonic()
        answer = targets.check(name, data)
        pipe.send((answer, time.monotonic() - began))


class _Watched:
    """A process that tries inputs and may crash or hang without harm."""

    def __init__(self) -> None:
        self._context = multiprocessing.get_context("spawn")
        self._start()

    def _start(self) -> None:
        self._pipe, theirs = self._context.Pipe()
        self._process = self._context.Process(target=_worker, args=(theirs,), daemon=True)
        self._process.start()
        theirs.close()

    def check(self, name: str, data: bytes) -> tuple[str, float]:
        """What came of it, and how long it took [s]."""
        self._pipe.send((name, data))
        try:
            if self._pipe.poll(_PATIENCE_S):
                answer: tuple[str, float] = self._pipe.recv()
                return answer
            what = f"hangs for {_PATIENCE_S:.0f} s"
        except (EOFError, OSError):
            what = "crashed the interpreter"
        self.close()
        self._start()
        return what, _PATIENCE_S

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.join()
        self._pipe.close()


def campaign(ledger: Ledger, options: Any) -> None:
    """A line for each target."""
    runs = options.runs or _RUNS
    watched = _Watched()
    try:
        for name in targets.TARGETS:
            corpus = targets.corpus(name)
            line = ledger.line("input", name)
            for first in range(0, runs if corpus else 0, _BLOCK):
                if ledger.has("input", f"{name} {first}"):
                    continue
                for number in range(first, min(first + _BLOCK, runs)):
                    random = np.random.default_rng([options.seed, number, len(name)])
                    data = (
                        mangle(name, corpus[number % len(corpus)], random)
                        if number >= len(corpus)
                        else corpus[number]
                    )
                    answer, took = watched.check(name, data)
                    bad = [] if answer in ("ok", "refused") else [answer]
                    line.count(bad, f"run {number}, sha256 {hashlib.sha256(data).hexdigest()[:8]}")
                    if answer in ("ok", "refused"):
                        line.figures[answer] = line.figures.get(answer, 0) + 1
                    line.figures["slowest [s]"] = max(line.figures.get("slowest [s]", 0.0), round(took, 3))
                ledger.finish("input", f"{name} {first}")
    finally:
        watched.close()
    for name in targets.TARGETS:
        if not ledger.has("input", f"{name}, guided"):
            _guided(ledger.line("input", f"{name}, guided by coverage"), name, options)
            ledger.finish("input", f"{name}, guided")


def _guided(line: Line, name: str, options: Any) -> None:
    """Run the fuzzer in a process of its own and take its count of runs, and what it found."""
    if importlib.util.find_spec("atheris") is None:
        line.figures = {"not run": "atheris is not installed"}
        return
    seconds = options.seconds or _GUIDED_S
    command = [sys.executable, "-m", "benchmarks.trust.fuzz", name, f"-max_total_time={seconds:.0f}"]
    command += [f"-seed={options.seed}", f"-timeout={_PATIENCE_S:.0f}", "-rss_limit_mb=6144"]
    command.append(f"-artifact_prefix={Path.cwd()}/")
    done = subprocess.run(command, cwd=_ROOT, capture_output=True, text=True, errors="replace")
    counts = re.findall(r"^#(\d+)\s.*?cov: (\d+)", done.stderr, re.MULTILINE)
    line.runs += int(counts[-1][0]) if counts else 0
    line.figures = {"seconds": seconds, "edges covered": int(counts[-1][1]) if counts else 0}
    if done.returncode:
        line.failed += 1
        line.failures.append(" | ".join(done.stderr.strip().splitlines()[-6:])[:400])
