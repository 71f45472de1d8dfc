"""The tests of each line, from one run with coverage, kept by the contents of the files."""

from __future__ import annotations

import hashlib
import json
import sys
import time
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import coverage
import pytest

#: The tests in question. Those of the excitation, the effects and the diagnosis use what these test.
TESTS = (
    "tests/fri",
    "tests/lwr_driver",
    "tests/sim_backend",
    "tests/ident/dynamics",
    "tests/ident/rows",
    "tests/ident/estimators",
    "tests/ident/estimation",
    "tests/ident/import_log",
    "tests/runner/experiment",
)
_SOURCES = ("fri", "lwr_driver", "ident", "runner")


def digest(path: Path) -> str:
    """Fingerprint of a file's content, empty for a missing file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16] if path.is_file() else ""


@dataclass
class FileOfTests:
    """The tests of a file: seconds by function, and lines by source file and function.

    "" in place of a function: lines of module-wide fixtures and of imports. sources : digests.
    """

    digest: str
    seconds: dict[str, float] = field(default_factory=dict)
    lines: dict[str, dict[str, list[int]]] = field(default_factory=dict)
    sources: dict[str, str] = field(default_factory=dict)


class _Recorder:
    """A plugin of pytest that names the test to coverage and takes its time."""

    def __init__(self, measured: coverage.Coverage) -> None:
        self.measured = measured
        self.seconds: dict[str, dict[str, float]] = defaultdict(lambda: defaultdict(float))
        self.failed: list[str] = []

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Any:
        self.measured.switch_context(_name(item.nodeid))
        start = time.monotonic()
        try:
            return (yield)
        finally:
            file, function = _name(item.nodeid).split("::", 1)
            self.seconds[file][function] += time.monotonic() - start
            self.measured.switch_context("")

    def pytest_fixture_setup(self, fixturedef: Any, request: pytest.FixtureRequest) -> None:
        if fixturedef.scope != "function":
            self.measured.switch_context(f"{str(request.node.nodeid).split('::')[0]}::")

    def pytest_runtest_call(self, item: pytest.Item) -> None:
        self.measured.switch_context(_name(item.nodeid))

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed:
            self.failed.append(report.nodeid)


def _name(node: str) -> str:
    """File and function of a test, without its parameters."""
    return node.split("[", 1)[0]


def measure(tests: list[str], root: Path) -> dict[str, FileOfTests]:
    """Run these files of tests in `root`, the working directory, with coverage. RuntimeError if one fails."""
    measured = coverage.Coverage(source_pkgs=list(_SOURCES), data_file=None, config_file=False)
    recorder = _Recorder(measured)
    measured.start()
    pytest.main(["-q", "-m", "not slow", "-p", "no:cacheprovider", *tests], plugins=[recorder])
    measured.stop()
    if recorder.failed:
        raise RuntimeError(f"tests fail before any change: {', '.join(recorder.failed)}")
    found = {file: FileOfTests(digest(root / file), dict(recorder.seconds.get(file, {}))) for file in tests}
    data = measured.get_data()
    for path in data.measured_files():
        source = str(Path(path).relative_to(root))
        for line, contexts in data.contexts_by_lineno(path).items():
            for context in contexts:
                if "::" not in context:
                    continue
                file, function = context.split("::", 1)
                if file in found:
                    found[file].lines.setdefault(source, {}).setdefault(function, []).append(line)
    for entry in found.values():
        entry.sources = {source: digest(root / source) for source in entry.lines}
    return found


def load(path: Path) -> dict[str, FileOfTests]:
    """A stored map, empty if there is none."""
    if not path.is_file():
        return {}
    return {file: FileOfTests(**entry) for file, entry in json.loads(path.read_text("utf-8")).items()}


def save(path: Path, known: dict[str, FileOfTests]) -> None:
    """Store a map."""
    path.write_text(json.dumps({file: vars(entry) for file, entry in known.items()}), encoding="utf-8")


def stale(known: dict[str, FileOfTests], root: Path) -> list[str]:
    """Files of tests that are new or changed, or whose sources are."""
    files = sorted(
        str(path.relative_to(root)) for place in TESTS for path in (root / place).rglob("test_*.py")
    )
    return [
        file
        for file in files
        if file not in known
        or known[file].digest != digest(root / file)
        or any(digest(root / source) != seen for source, seen in known[file].sources.items())
    ]


def tests_of(
    known: dict[str, FileOfTests], source: str, lines: Iterable[int], anywhere: bool
) -> list[tuple[str, list[str], float]]:
    """Tests that run one of the lines: file, functions and seconds, the quickest file first.

    anywhere : tests that run any line of the source, for lines run at import or compiled
    """
    wanted = set(lines)
    found = []
    for file, entry in known.items():
        here = entry.lines.get(source, {})
        functions = [f for f, seen in here.items() if anywhere or wanted.intersection(seen)]
        if "" in functions:
            functions = list(entry.seconds)
        functions = [f for f in functions if f in entry.seconds]
        if functions:
            found.append((file, functions, sum(entry.seconds[f] for f in functions)))
    return sorted(found, key=lambda item: (item[2], item[0]))


def tests_naming(
    known: dict[str, FileOfTests], source: str, root: Path
) -> list[tuple[str, list[str], float]]:
    """Tests of the files that import a source without a line run by a test, such as one of constants alone."""
    module = source.removesuffix(".py").removesuffix("/__init__").replace("/", ".")
    found = [
        (file, list(entry.seconds), sum(entry.seconds.values()))
        for file, entry in known.items()
        if f"{module} import" in (root / file).read_text("utf-8")
    ]
    return sorted(found, key=lambda item: (item[2], item[0]))


if __name__ == "__main__":
    place = Path(sys.argv[1])
    entries = load(place)
    entries.update(measure(sys.argv[2:], Path.cwd()))
    save(place, entries)
