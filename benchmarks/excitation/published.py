"""The motions of the published Table 1, rebuilt by its rules: their coefficients were not published.

python -m benchmarks.excitation.published            # writes configs/plans/published/*.plan.yaml, two minutes
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import click

from ident.excitation import ExcitationPlan, PlanProblem, assemble, plan, random_points, table, table_row
from lwr_driver.configuration import CONFIGS

FOLDER = CONFIGS / "plans/published"
# Of random points: share of the speed limits, acceleration [rad/s^2]. Their condition number is the published one then.
SPEED, ACCELERATION, SEED = 0.55, 4.0, 4


def rebuild(folder: Path = FOLDER) -> None:
    """Plan the motions again and write them into `folder`."""
    problem = PlanProblem.load(FOLDER / "algorithm_1.yaml")
    assembled = assemble(problem)
    points = random_points(
        assembled.setup.mechanism,
        assembled.setup.limits,
        seed=SEED,
        speed_scale=SPEED,
        a_max=0.0 * assembled.setup.limits.a_max + ACCELERATION,
        workspace=problem.workspace,
        checker=assembled.checker,
        clearance_m=assembled.clearance_m,
    )
    objectives, deviations = assembled.describe(points)
    found = {
        "random_points": ExcitationPlan(
            points,
            assembled.setup.mechanism.joint_names,
            1,
            objectives,
            deviations,
            assembled.check(points),
            {"method": "random points", "seed": SEED, "speed_scale": SPEED},
        )
    }
    for name in ("algorithm_1", "algorithm_2"):
        found[name] = replace(plan(PlanProblem.load(FOLDER / f"{name}.yaml")), periods=1)
    for name, one in found.items():
        one.save(folder / f"{name}.plan.yaml")
    click.echo(table([table_row(name, assembled, one.motion, one.check) for name, one in found.items()]))


if __name__ == "__main__":
    rebuild()
