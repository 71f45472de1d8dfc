"""`lwr-run check`: every check of an experiment that can be made without an arm."""

from __future__ import annotations

import json
from dataclasses import asdict

import click

from lwr_driver.arm import Arm
from lwr_driver.cell import Cell
from runner.experiment_file import DEFAULT, Experiment
from runner.planning import excitation_rows, plan_excitation
from runner.preflight import Preflight
from runner.preparation import session_motion


@click.command("check")
@click.argument("file", default=DEFAULT)
@click.option("--period-ms", default=5.0, show_default=True, type=click.FloatRange(1, 100), help="FRI cycle.")
@click.option("--json", "as_json", is_flag=True, help="Machine-readable output.")
def command(file: str, period_ms: float, as_json: bool) -> None:
    """Dry run of the experiment FILE: limits, torques, collisions, from the home position. Nothing moves.

    Exits with 3 where a check fails.

    \b
    lwr-run check my_lab.yaml
    lwr-run check my_lab.yaml --period-ms 2 --json
    """
    experiment = Experiment.load(file)
    arm = Arm.load(experiment.arm, beside=experiment.folder)
    cell = Cell.load(experiment.cell, beside=experiment.folder)
    excite = excitation_rows(plan_excitation(experiment, arm, cell), experiment.excitation.periods)
    home = experiment.home(len(arm.joint_names))
    found: dict[str, Preflight] = {}
    for plan in experiment.sessions:
        motion, found[plan.name] = session_motion(experiment, arm, cell, plan, excite(period_ms / 1000), home)
        if not as_json:
            click.echo(f"\nsession {plan.name}: {motion.duration_s:.1f} s")
            click.echo(str(found[plan.name]))
    if as_json:
        click.echo(
            json.dumps({name: [asdict(item) for item in list_.items] for name, list_ in found.items()})
        )
    for preflight in found.values():
        preflight.enforce()
