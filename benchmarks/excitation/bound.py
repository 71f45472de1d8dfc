"""Lower bounds of the criteria, and how far from them the motion of a plan file is.

python -m benchmarks.excitation.bound
python -m benchmarks.excitation.bound --problem my_arm.yaml --plan my_arm.plan.yaml
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import time
from dataclasses import replace

import click

from ident.excitation import ExcitationPlan, Objective, PlanProblem, assemble, lower_bound
from lwr_driver.configuration import find

OBJECTIVES = (
    Objective("mean_rsd"),
    Objective("worst_rsd"),
    Objective("d_optimality"),
    Objective("condition_number"),
    Objective("condition_number", scaling="parameters"),
)


@click.command()
@click.option("--problem", default="plans/default.yaml", show_default=True, help="Planning problem.")
@click.option("--plan", "motion", default="plans/default.plan.yaml", show_default=True, help="Plan file.")
@click.option("--seed", default=0, show_default=True, help="Of the search for states.")
def main(problem: str, motion: str, seed: int) -> None:
    """Print each criterion's value, its bound, and the processor time of the bound."""
    asked, found = PlanProblem.load(problem), ExcitationPlan.load(find(motion))
    for objective in OBJECTIVES:
        wanted = replace(asked, objective=objective)
        assembled = assemble(wanted)
        target = assembled.setup.target
        assert target is not None
        begun = time.process_time()
        bound = lower_bound(wanted, seed=seed)
        spent = time.process_time() - begun
        value = target.exact(assembled.view(found.motion))
        click.echo(f"{target.name}: {bound.text(value)} (reached {bound.reached:.4g}), {spent:.1f} s")


if __name__ == "__main__":
    main()
