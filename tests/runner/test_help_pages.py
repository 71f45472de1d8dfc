"""Help pages come without the numerical libraries."""

from __future__ import annotations

import subprocess
import sys

LISTED = """
import sys
from click.testing import CliRunner
from runner.cli import VERBS, main
for words in ([], *([verb] for verb in VERBS)):
    result = CliRunner().invoke(main, [*words, "-h"])
    assert result.exit_code == 0, result.output
    heavy = {"numpy", "scipy", "pinocchio", "numba", "mcap"} & set(sys.modules)
    assert not heavy, f"lwr-run {' '.join(words)} -h imports {', '.join(sorted(heavy))}"
"""


def test_no_help_page_imports_a_numerical_library() -> None:
    done = subprocess.run([sys.executable, "-c", LISTED], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
