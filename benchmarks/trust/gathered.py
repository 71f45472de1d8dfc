"""Promises that tests of the project show already, gathered into the table."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from pathlib import Path

from benchmarks.trust.table import Ledger

__all__ = ["gather"]

_ROOT = Path(__file__).resolve().parents[2]


def gather(ledger: Ledger, section: str, lines: Mapping[str, Sequence[str]]) -> None:
    """Run tests by file and name (`file.py` or `file.py::test`); a line for each promise."""
    for what, tests in lines.items():
        if ledger.has(section, what):
            continue
        with tempfile.TemporaryDirectory() as name:
            report = Path(name) / "report.xml"
            command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", f"--junitxml={report}"]
            paths = [f"tests/{test}" for test in tests]
            subprocess.run([*command, *paths], cwd=_ROOT, capture_output=True, check=False)
            line = ledger.line(section, what)
            if not report.exists():
                line.count(["pytest did not run"])
                continue
            for case in ElementTree.parse(report).iter("testcase"):
                broken = [child for child in case if child.tag in ("failure", "error")]
                line.count([child.get("message", "")[:200] for child in broken], str(case.get("name")))
        ledger.finish(section, what)
