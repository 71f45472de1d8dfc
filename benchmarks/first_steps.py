"""How long do a newcomer's first hours take? The commands of the tutorials, timed.

Run `python -m benchmarks.first_steps [--only emulator logs fault] [--lwr-run COMMAND]`. Each command runs in an empty
folder, as a person would give it; wall and processor time are printed, and the end of its output. `logs` reads the
ROKAE recordings in `../shared/data/xmate7p`, and is left out without them. The compiled code of an earlier run is used
again.
"""

from __future__ import annotations

import argparse
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

DATA = Path(__file__).resolve().parents[2] / "shared/data/xmate7p"
_SHOWN = 8
"""Last lines of each command that are printed, too."""

HOSE = """
emulator_settings:
  robot.effects:
    - type: sim_backend.model_arm:Cause
      options: {cause: cable_spring, joint: 4, form: linear, parameters: {stiffness: 1.0}}
"""
TRIALS: dict[str, tuple[str, ...]] = {
    "emulator": (
        "init my_laboratory",
        "check my_laboratory/experiment.yaml",
        "experiment my_laboratory/experiment.yaml --yes --out results",
    ),
    "logs": (
        "identify t1.csv t2.csv --urdf XM7p.urdf --model 1 --yes --out model.yaml --test t3.csv --results from_logs",
        "validate model.yaml from_logs/t3.mcap",
        "report from_logs --figures paper --format pdf",
    ),
    "fault": (
        "init hose",
        "experiment hose/experiment.yaml --yes --out results",
        "validate results/diagnosis/model_extended.yaml results/validation.mcap --against results/model.yaml",
        "export results/diagnosis/model_extended.yaml lwr.urdf lwr.c",
    ),
}


def trial(name: str, lwr_run: str) -> None:
    """Run the commands of one trial and print their times."""
    with tempfile.TemporaryDirectory() as place:
        if name == "logs":
            for file in DATA.iterdir():
                shutil.copy(file, place)
        for line in TRIALS[name]:
            began, used = time.monotonic(), processor_s()
            done = subprocess.run([lwr_run, *line.split()], cwd=place, capture_output=True, text=True)
            wall, used = time.monotonic() - began, processor_s() - used
            print(f"{wall:7.1f} s  processor {used:6.1f} s  lwr-run {line}", flush=True)
            for text in done.stdout.rstrip().splitlines()[-_SHOWN:]:
                print(f"    {text}")
            if done.returncode:
                sys.exit(f"ended with {done.returncode}: {done.stderr.strip()}")
            if line == "init hose":
                with (Path(place) / "hose/experiment.yaml").open("a") as file:
                    file.write(HOSE)


def processor_s() -> float:
    """Processor time of all commands so far."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=TRIALS, default=list(TRIALS))
    parser.add_argument("--lwr-run", default=str(Path(sys.executable).parent / "lwr-run"))
    options = parser.parse_args()
    for name in options.only:
        print(name)
        if name == "logs" and not DATA.is_dir():
            print(f"  left out: there is no {DATA}")
            continue
        trial(name, options.lwr_run)


if __name__ == "__main__":
    main()
