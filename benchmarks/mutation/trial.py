"""Trials of mutants: a process with the slow imports done, forked for each run of tests.

It works in a copy of the tree, with one JSON object a line on its input and output.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import pytest

Outcome = str  # "caught", "time", "survived"


class _Selection:
    """A plugin of pytest that keeps the tests of these functions, in the order of the files given."""

    def __init__(self, files: list[str], functions: set[str]) -> None:
        self.files, self.functions, self.failed = files, functions, ""

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        items[:] = [item for item in items if item.nodeid.split("[", 1)[0] in self.functions]
        items.sort(key=lambda item: self.files.index(item.nodeid.split("::", 1)[0]))

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed and not self.failed:
            self.failed = report.nodeid


def _run(files: list[str], functions: set[str], report: Path) -> None:
    """Run the tests; the end of this process."""
    os.setsid()
    out = os.open(report.with_suffix(".out"), os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    for stream in (1, 2):
        os.dup2(out, stream)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    code, selection = 1, _Selection(files, functions)
    try:
        options = ["-x", "-q", "-m", "not slow", "-p", "no:cacheprovider", "--tb=no"]
        code = int(pytest.main([*options, *files], plugins=[selection]))
    finally:
        report.write_text(json.dumps({"code": code, "test": selection.failed}))
        os._exit(code)


def serve() -> None:
    """Answer requests {files, functions, cache, limit_s} with {outcome, test, seconds}."""
    import clarabel  # noqa: F401
    import hypothesis.strategies  # noqa: F401
    import numba
    import pinocchio  # noqa: F401
    import ruckig  # noqa: F401
    import scipy.fft
    import scipy.optimize
    import scipy.signal  # noqa: F401

    report = Path(tempfile.mkdtemp()) / "report.json"
    for line in sys.stdin:
        request = json.loads(line)
        report.unlink(missing_ok=True)
        start = time.monotonic()
        child = os.fork()
        if child == 0:
            os.environ["NUMBA_CACHE_DIR"] = numba.config.CACHE_DIR = request["cache"]
            sys.dont_write_bytecode = request["quiet"]
            _run(request["files"], set(request["functions"]), report)
        code = _wait(child, start + request["limit_s"])
        with contextlib.suppress(ProcessLookupError):
            os.killpg(child, signal.SIGKILL)
        test = json.loads(report.read_text())["test"] if report.exists() else ""
        # 5: no test collected.
        outcome = "time" if code is None else "survived" if code in (0, 5) else "caught"
        answer = {"outcome": outcome, "test": test, "seconds": time.monotonic() - start}
        print(json.dumps(answer), flush=True)
    shutil.rmtree(report.parent)


def _wait(child: int, deadline: float) -> int | None:
    """The exit code, or None after the deadline."""
    pause = 0.01
    while time.monotonic() < deadline:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        time.sleep(pause)
        pause = min(2.0 * pause, 0.1)
    os.killpg(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return None


class Trials:
    """Trials in a copy of the tree below `folder`. A context manager."""

    def __init__(self, root: Path, folder: Path) -> None:
        self.tree, self._folder = folder / "tree", folder
        self._cache = folder / "numba"
        copy_tree(root, self.tree)
        self.environment = {
            **os.environ,
            "PYTHONPATH": os.pathsep.join([str(self.tree), os.environ.get("PYTHONPATH", "")]),
            "OPENBLAS_NUM_THREADS": "1",
            "NUMBA_CACHE_DIR": str(self._cache),
        }
        self._server: subprocess.Popen[str] | None = None

    def __enter__(self) -> Trials:
        command = [sys.executable, "-c", "from benchmarks.mutation.trial import serve; serve()"]
        self._server = subprocess.Popen(
            command,
            cwd=self.tree,
            env=self.environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        return self

    def __exit__(self, *_: object) -> None:
        assert self._server is not None
        self._server.communicate()

    def run(
        self,
        files: list[str],
        functions: set[str],
        limit_s: float,
        *,
        fresh: bool = False,
        quiet: bool = True,
    ) -> dict[str, Any]:
        """Run tests in the tree as it is. fresh : without any function compiled before. quiet : writes no bytecode."""
        server = self._server
        assert server is not None
        assert server.stdin is not None
        assert server.stdout is not None
        cache = self._cache
        if quiet:
            # Compiled functions hold constants of other modules: what a mutant compiles is thrown away.
            cache = self._folder / "numba_of_mutant"
            shutil.rmtree(cache, ignore_errors=True)
            if not fresh and self._cache.exists():
                shutil.copytree(self._cache, cache, copy_function=os.link)
        request = {"files": files, "functions": sorted(functions), "cache": str(cache)}
        server.stdin.write(json.dumps({**request, "limit_s": limit_s, "quiet": quiet}) + "\n")
        server.stdin.flush()
        answer: dict[str, Any] = json.loads(server.stdout.readline())
        return answer

    def replace(self, file: str, code: str) -> Replacement:
        """Another content of a file for the time of a `with`."""
        return Replacement(self.tree / file, code)


class Replacement:
    """Another content of a file, taken back at the end."""

    def __init__(self, path: Path, code: str) -> None:
        self.path, self.code = path, code

    def __enter__(self) -> None:
        self._before, self._stat = self.path.read_bytes(), self.path.stat()
        self.path.write_text(self.code, encoding="utf-8")
        # Bytecode belongs to a size and a second.
        later = time.time() + 100.0
        os.utime(self.path, (later, later))

    def __exit__(self, *_: object) -> None:
        self.path.write_bytes(self._before)
        os.utime(self.path, ns=(self._stat.st_atime_ns, self._stat.st_mtime_ns))


def copy_tree(root: Path, tree: Path) -> None:
    """The files under version control and the new ones that it does not ignore."""
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard", "-z"]
    listed = subprocess.run(command, cwd=root, check=True, capture_output=True, text=True).stdout
    wanted = {name for name in listed.split("\0") if name and (root / name).is_file()}
    for path in tree.rglob("*") if tree.exists() else ():
        if path.suffix == ".py" and str(path.relative_to(tree)) not in wanted:
            path.unlink()
    for name in wanted:
        source, target = root / name, tree / name
        if target.exists() and target.read_bytes() == source.read_bytes():
            continue
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(source, target)
