"""Recordings of six other arms, from files to a result in one attempt: python -m benchmarks.first_attempt.

Every case is one command with defaults only, as a stranger would type it (`--yes` in place of the prompt). Printed are
the time, the exit code, and every message the command gave beside its tables. `--data` is the folder of the recordings;
docs/real_data.md has their sources.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tests.archives import unpack

CASES = {
    "LWR4+, runs 1 and 2 to run 3": (
        "lwr4_flobaroid/measurements_1.npz lwr4_flobaroid/measurements_2.npz --test lwr4_flobaroid/measurements_3.npz "
        "--urdf lwr4_flobaroid/kuka_lwr4_2016-04-11.urdf"
    ),
    "xMate, runs 1 and 2 to run 3": "xmate7p/t1.csv xmate7p/t2.csv --test xmate7p/t3.csv --urdf xmate7p/XM7p.urdf",
    "Panda": "panda_gaz/panda.csv --urdf panda_gaz/panda_arm.urdf",
    "Kinova, testing2 to testing1": (
        "kinova_gen3/opti_traj_testing2.csv --test kinova_gen3/opti_traj_testing1.csv --urdf kinova_gen3/gen3.urdf"
    ),
    "iiwa, sweep of joint 5": "SWEEP/friction_model/joint5/vel_p3 --urdf iiwa14/iiwa14.urdf",
    "TX40, by its names": "tx40 --urdf tx40/tx40_mdh_modified.urdf",
    "TX40, by its mapping": "TX40/tx40.mcap",
}
_MESSAGE = re.compile(r"^(WARNING|warning|\w*Error|Error)\b|^  (note|holes|repeated) ")
_RESULT = re.compile(r"relative error|^(WLS|Model) ?\d?")


def run(words: list[str]) -> tuple[float, subprocess.CompletedProcess[str]]:
    """Seconds and outcome of a command."""
    before = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-m", "runner.cli", *words],
        capture_output=True,
        text=True,
        check=False,
        stdin=subprocess.DEVNULL,
        env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},
    )
    return time.perf_counter() - before, done


def main() -> None:
    """Run every case and print what a user sees."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--data", type=Path, default=Path(__file__).resolve().parents[2] / "shared/data")
    parser.add_argument("--only", help="cases with this text in their name")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        unpack(options.data / "iiwa14/friction_sweeps_J4_J5_J6.tar.xz", place / "sweeps")
        mapped = place / "tx40.mcap"
        urdf = options.data / "tx40/tx40_mdh_modified.urdf"
        _, imported = run(["import", "tx40", str(options.data / "tx40"), str(mapped), "--urdf", str(urdf)])
        print(imported.stdout + imported.stderr)
        for number, (name, text) in enumerate(CASES.items()):
            if options.only and options.only not in name:
                continue
            words = [
                str(mapped)
                if word == "TX40/tx40.mcap"
                else str(place / "sweeps" / word.removeprefix("SWEEP/"))
                if word.startswith("SWEEP/")
                else word
                if word.startswith("--")
                else str(options.data / word)
                for word in text.split()
            ]
            seconds, done = run(["identify", *words, "--yes", "--results", str(place / str(number))])
            print(f"{name}: exit {done.returncode}, {seconds:.1f} s")
            print(f"  lwr-run identify {text} --yes --results FOLDER")
            lines = (done.stderr + done.stdout).splitlines()
            shown = dict.fromkeys(
                line.strip() for line in lines if _MESSAGE.search(line) or _RESULT.search(line)
            )
            print("".join(f"    {line}\n" for line in shown))


if __name__ == "__main__":
    main()
