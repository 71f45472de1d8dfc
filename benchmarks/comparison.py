"""Does `lwr-run compare` tell a changed robot from an unchanged one?

Run `python -m benchmarks.comparison [--pairs 40] [--first-seed 2000]`. The same emulated robot is identified from two
independent pairs of sessions, with other motions and noise (those of `benchmarks.coverage`), and the two models are
compared: at most 5 % of the comparisons may find any difference. Then one model of the robot is compared with models
of changed ones, each parameter changed by 10 to 20 %: all changes must be found, and nothing else.
"""

from __future__ import annotations

import argparse
import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from benchmarks.coverage import settings_of
from ident.dynamics.kinematics import Chain
from ident.estimation.compare import compare
from ident.estimation.identify import identify
from ident.model import DynamicModel
from lwr_driver.arm import Arm
from lwr_driver.configuration import CONFIGS
from tests.ident.estimation.emulated_sessions import record_pair

CHANGES = {"Ia3": 1.15, "Fvm2": 1.1, "Fcm5": 0.8, "Fcm1": 1.2, "Fvm6": 0.85}


def model(seed: int, cycle_ms: int, changes: Mapping[str, float] | None = None) -> DynamicModel:
    """The emulated robot, some parameters times a factor, identified from one pair of sessions."""
    arm = Arm.load()
    with tempfile.TemporaryDirectory() as folder:
        settings: dict[str, Any] = {}
        if changes:
            content = yaml.safe_load((CONFIGS / "emulator" / "table2.yaml").read_text())
            for name, factor in changes.items():
                content["parameters"][name] *= factor
            path = Path(folder) / "changed.yaml"
            path.write_text(yaml.safe_dump(content))
            settings["robot.parameters"] = str(path)
        sessions = record_pair(Path(folder), seed, cycle_ms=cycle_ms, settings=settings)
        return identify(sessions, Chain.from_urdf(arm.urdf), settings_of("wls")).model


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--pairs", type=int, default=40)
    parser.add_argument("--first-seed", type=int, default=2000)
    parser.add_argument("--cycle-ms", type=int, default=1)
    options = parser.parse_args(arguments)
    seed, cycle = options.first_seed, options.cycle_ms
    false, first = 0, model(seed, cycle)
    for number in range(options.pairs):
        one, other = (model(seed + 1 + 2 * number + k, cycle) for k in (0, 1))
        found = compare(one, other).significant
        false += bool(found)
        print(f"same robot, pair {number + 1}: {', '.join(found) or 'no difference'}", flush=True)
    missed, wrong = [], []
    for number, (name, factor) in enumerate(CHANGES.items()):
        changed = model(seed + 1 + 2 * options.pairs + number, cycle, {name: factor})
        found = tuple(entry.rstrip("R") for entry in compare(first, changed).significant)
        missed += [] if name in found else [name]
        wrong += [entry for entry in found if entry != name]
        print(f"{name} x {factor:g}: {', '.join(found) or 'no difference'}", flush=True)
    print(f"\nany difference of the same robot: {false} of {options.pairs}")
    print(
        f"changes found: {len(CHANGES) - len(missed)} of {len(CHANGES)}; beyond them: {', '.join(wrong) or 'none'}"
    )


if __name__ == "__main__":
    main()
