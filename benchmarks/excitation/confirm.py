"""The planned motion against random points in a whole experiment on the emulator: deviations and true errors.

    python -m benchmarks.excitation.confirm [--out FOLDER]

Both experiments move for the same time with the same arm, payload, noise, cycle (5 ms) and identification; only the
motion differs. Finished experiments in FOLDER are not repeated.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
import numpy as np
import yaml

from fri.errors import ConfigurationError
from ident.excitation import ExcitationPlan, PlanProblem, assemble, random_points
from lwr_driver.configuration import CONFIGS, find
from runner.file_names import SUMMARY

GROUPS = {
    "drive inertia": ("Ia",),
    "motor viscous friction": ("Fvm",),
    "motor Coulomb friction": ("Fcm",),
    "joint Coulomb friction": ("Fcl",),
    "offsets": ("offl", "offm"),
    "arm, inertial": ("XX", "XY", "XZ", "YY", "YZ", "ZZ", "MX", "MY", "MZ", "M"),
    "payload": (),
}


def random_plan(planned: ExcitationPlan, seed: int, speed: float) -> ExcitationPlan:
    """As many random points as fit into the planned motion's time, at a share of full speed, 1 s to reach it."""
    assembled = assemble(replace(PlanProblem.load("plans/default.yaml"), speed_scale=0.95))
    # far below the jerk limit: the third difference of float32 positions is noisy
    limits = replace(assembled.setup.limits, j_max=np.full(7, 20.0))
    for count in range(20, 2, -1):
        try:
            motion = random_points(
                assembled.setup.mechanism,
                limits,
                count=count,
                seed=seed,
                speed_scale=speed,
                a_max=speed * limits.v_max,
                workspace=assembled.problem.workspace,
                checker=assembled.checker,
                clearance_m=assembled.clearance_m,
                duration_s=planned.duration_s,
            )
        except ConfigurationError:
            continue
        return ExcitationPlan(
            motion, planned.joint_names, provenance={"method": "random points", "count": count}
        )
    raise ConfigurationError("no random motion fits into the planned time")


def experiment(folder: Path, name: str, plan: ExcitationPlan) -> list[dict[str, Any]]:
    """Run one experiment on the emulator; the parameters of its summary."""
    plan.save(folder / f"{name}.plan.yaml")
    content = yaml.safe_load((CONFIGS / "experiments/default.yaml").read_text(encoding="utf-8"))
    content["name"] = name
    content["diagnosis"] = {"run": False}
    content["emulator_settings"] = {"fri.period_ms": 5}
    content["sessions"] = [session for session in content["sessions"] if not session.get("validation")]
    content["excitation"] = {"plan": str(folder / f"{name}.plan.yaml"), "periods": plan.periods}
    file = folder / f"{name}.yaml"
    file.write_text(yaml.safe_dump(content), encoding="utf-8")
    out = folder / name
    if not (out / SUMMARY).is_file():
        begun = (
            ["--resume", str(out)] if (out / "experiment.yaml").is_file() else [str(file), "--out", str(out)]
        )
        command = [sys.executable, "-m", "runner.cli", "experiment", *begun, "--yes", "--no-diagnosis"]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    summary = json.loads((out / SUMMARY).read_text(encoding="utf-8"))
    parameters: list[dict[str, Any]] = summary["parameters"]
    return parameters


def group(name: str) -> str:
    """Group of a parameter."""
    symbol, link = name.rstrip("R").rstrip("0123456789"), int("".join(c for c in name if c.isdigit()))
    if link == 8:
        return "payload"
    return next((label for label, symbols in GROUPS.items() if symbol in symbols), "other")


@click.command()
@click.option("--out", type=click.Path(path_type=Path), help="Folder to keep the experiments in.")
@click.option("--seed", default=1, show_default=True, help="Of the random points.")
@click.option("--speed", default=1.0, show_default=True, help="Of the random points, share of full speed.")
def main(out: Path | None, seed: int, speed: float) -> None:
    """Run both experiments and print ratios, random over planned, by parameter group."""
    folder = out if out is not None else Path(tempfile.mkdtemp(prefix="excitation-"))
    folder.mkdir(parents=True, exist_ok=True)
    planned = ExcitationPlan.load(find("plans/default.plan.yaml"))
    found = {
        "planned": experiment(folder, "planned", planned),
        "random": experiment(
            folder, f"random-seed{seed}-speed{100 * speed:.0f}", random_plan(planned, seed, speed)
        ),
    }
    click.echo(f"{planned.duration_s:g} s each; random points over planned motion, medians and rms by group")
    click.echo(
        f"{'group':26s} {'n':>3s}  RSD % planned  random  ratio   error ratio (rms, in stated units of planned)"
    )
    names = {entry["name"] for entry in found["planned"]} & {entry["name"] for entry in found["random"]}
    tables = {key: {entry["name"]: entry for entry in entries} for key, entries in found.items()}
    essential = set(assemble(PlanProblem.load("plans/default.yaml")).criteria.condition.assembly.names)
    for label in GROUPS:
        chosen = sorted(name for name in names if group(name) == label and name in essential)
        if not chosen:
            continue
        rsd = {
            key: np.array([table[name]["rsd_percent"] for name in chosen]) for key, table in tables.items()
        }
        scale = np.array([tables["planned"][name]["std"] for name in chosen])
        error = {
            key: np.array([table[name]["estimate"] - table[name]["truth"] for name in chosen]) / scale
            for key, table in tables.items()
        }
        rms = {key: float(np.sqrt(np.mean(values**2))) for key, values in error.items()}
        middle = {key: float(np.median(values)) for key, values in rsd.items()}
        click.echo(
            f"{label:26s} {len(chosen):3d}  {middle['planned']:13.3f} {middle['random']:7.3f} "
            f"{float(np.median(rsd['random'] / rsd['planned'])):6.2f}   {rms['random'] / rms['planned']:.2f}"
        )
    click.echo(f"experiments: {folder}")


if __name__ == "__main__":
    main()
