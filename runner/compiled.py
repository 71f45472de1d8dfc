"""Compiled code made ahead: `python -m runner.compiled`, about a minute, once an installation.

It runs a short experiment with the built-in emulator in a folder that is removed; what the first command would compile
is in the cache afterwards (`fri.compiler_cache`).
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

SHORT = """\
name: short
emulator_settings: {fri.period_ms: 10}
excitation: {period_s: 6.0, harmonics: 3, periods: 1, seed: 3}
sessions:
  - {name: unloaded}
  - {name: loaded, payload: {name: plate, mass: 3.0, com: [0.0, 0.0, 0.1]}}
  - {name: unseen, payload: {name: plate, mass: 3.0, com: [0.0, 0.0, 0.1]}, validation: true}
"""


def main() -> int:
    """Exit code of the experiment; what it said goes to standard error if it is not 0."""
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        (place / "short.yaml").write_text(SHORT)
        words = [sys.executable, "-m", "runner.cli", "experiment", "short.yaml", "--yes", "--out", "results"]
        done = subprocess.run(words, cwd=place, capture_output=True, text=True)
    if done.returncode:
        sys.stderr.write(done.stdout + done.stderr)
    return done.returncode


if __name__ == "__main__":
    sys.exit(main())
