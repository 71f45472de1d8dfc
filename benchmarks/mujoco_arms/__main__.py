"""Cases of a second generator: arms in MuJoCo, their healthy days, and a hidden fault of chosen visibility.

    python -m benchmarks.mujoco_arms --seed 1 --cases 20 --out mujoco_cases
    python -m benchmarks.mujoco_arms --seed 1 --cases 20 --out mujoco_cases --diagnose --jobs 2
    python -m benchmarks.mujoco_arms --out mujoco_cases --report

Each case is a folder with `reference_day_*`, `train_*.mcap`, `test_*.mcap` and `truth.json`. With `--diagnose` the
reference days are commissioned and the case is diagnosed by the commands that users have; a case that has its
sessions or its verdict is not made again. Needs the extra `generator`.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from pathlib import Path

import click

from benchmarks.mujoco_arms.campaign import Plan, read_results, run
from benchmarks.mujoco_arms.cases import ALL, KINDS_OF_CASES
from benchmarks.mujoco_arms.tally import table


@click.command()
@click.option("--seed", default=1, show_default=True, help="Of the first case; case i has seed + i.")
@click.option("--cases", default=10, show_default=True, help="Number of cases.")
@click.option("--kind", type=click.Choice(KINDS_OF_CASES), help="Only such cases; default: a mixture.")
@click.option("--cause", type=click.Choice(sorted(ALL)), help="Hide only this.")
@click.option("--arm", type=click.Choice(["lwr4plus", "ur5"]), help="Only this arm.")
@click.option("--diagnose", is_flag=True, help="Commission, diagnose and judge.")
@click.option("--without-reference", is_flag=True, help="Diagnose as if the arm had never been commissioned.")
@click.option("--again", is_flag=True, help="Commission and diagnose once more what has a verdict.")
@click.option(
    "--twins", is_flag=True, help="Diagnose the healthy twin of every case, not only where no name is right."
)
@click.option("--jobs", default=1, show_default=True, help="Processes at a time.")
@click.option("--report", is_flag=True, help="Run nothing; print the table of what is there.")
@click.option("--out", type=click.Path(path_type=Path), default=Path("mujoco_cases"), show_default=True)
def main(
    seed: int,
    cases: int,
    kind: str | None,
    cause: str | None,
    arm: str | None,
    diagnose: bool,
    without_reference: bool,
    again: bool,
    twins: bool,
    jobs: int,
    report: bool,
    out: Path,
) -> None:
    """Make cases, have them diagnosed, and judge what is said."""
    if not report:
        plan = Plan(out, seed, cases, kind, cause, arm, diagnose, again, twins, not without_reference)
        run(plan, jobs, click.echo)
    results = read_results(out, not without_reference)
    if results:
        click.echo(table(results))
    elif report:
        raise click.ClickException(f"{out} has no verdict yet; run with --diagnose")


if __name__ == "__main__":
    main()
