"""`lwr-run check`: every check of an experiment that can be made without an arm."""

from __future__ import annotations

import click

from lwr_driver.arm import Arm
from lwr_driver.arm.cell import Cell
from runner.experiment_file import DEFAULT, Experiment
from runner.options import json_option
from runner.plain import as_json as to_json
from runner.planning import Excitations
from runner.preflight import Preflight
from runner.preparation import session_motion


@click.command("check")
@click.argument("file", default=DEFAULT)
@click.option("--period-ms", default=5.0, show_default=True, type=click.FloatRange(1, 100), help="FRI cycle.")
@json_option
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
    motions = Excitations.of(experiment, arm, cell)
    home = experiment.home(len(arm.joint_names))
    found: dict[str, Preflight] = {}
    for plan in experiment.sessions:
        rows = motions.rows(plan, period_ms / 1000)
        motion, found[plan.name] = session_motion(experiment, arm, cell, plan, rows, home)
        if not as_json:
            click.echo(f"\nsession {plan.name}: {motion.duration_s:.1f} s")
            click.echo(str(found[plan.name]))
    if as_json:
        click.echo(to_json({name: list_.items for name, list_ in found.items()}))
    for preflight in found.values():
        preflight.enforce()
