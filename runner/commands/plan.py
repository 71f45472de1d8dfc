"""`lwr-run plan`: an optimal exciting motion, inside all limits."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from fri.errors import ConfigurationError
from ident.excitation import ExcitationPlan
from ident.excitation.plan import plan_report
from ident.excitation.planner import plan
from ident.excitation.problem import PlanProblem
from runner.options import json_option
from runner.plain import as_json as to_json
from runner.replanning import show_search
from runner.status import StatusLine

DEFAULT = "plans/default.yaml"


@click.command("plan")
@click.argument("file", default=DEFAULT)
@click.option("--out", type=click.Path(path_type=Path), help="Plan file; default: NAME.plan.yaml here.")
@click.option("--force", is_flag=True, help="Replace the plan file if it exists.")
@json_option
def command(file: str, out: Path | None, force: bool, as_json: bool) -> None:
    """Plan the exciting motion of the problem FILE; without one the default, which gives the stored plan.

    The plan holds coefficients, margins of every limit on the continuous motion, objective values, the
    predicted relative standard deviation of each parameter, seeds and versions. An experiment uses it through
    `excitation: {plan: FILE}`. Ctrl-C ends the search and keeps the best motion found so far.

    \b
    lwr-run plan
    lwr-run plan my_arm.yaml --out my_arm.plan.yaml
    """
    problem = PlanProblem.load(file)
    target = out if out is not None else Path(f"{problem.name}.plan.yaml")
    if target.exists() and not force:
        raise ConfigurationError(f"{target} exists; choose another --out, or replace it with --force")
    status = StatusLine()
    found = plan(problem, lambda now: show_search(status, now))
    status.clear()
    found.save(target)
    click.echo(to_json(_summary(found)) if as_json else plan_report(found))
    click.echo(str(target), err=as_json)


def _summary(found: ExcitationPlan) -> dict[str, Any]:
    return {
        "objectives": dict(found.objectives),
        "rsd_percent": dict(found.rsd_percent),
        "margins": [
            {
                "constraint": margin.constraint,
                "subject": margin.subject,
                "value": margin.value,
                "limit": margin.limit,
            }
            for margin in found.check.margins
        ],
        "provenance": dict(found.provenance),
    }
