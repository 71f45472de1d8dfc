"""How well the diagnosis finds what it was not told: hidden cases from seeds, judged against their truth.

    python -m benchmarks.discovery --cases 100 --jobs 2 --out campaign
    python -m benchmarks.discovery --cases 500 --out campaign        goes on where it was left
    python -m benchmarks.discovery --report --out campaign           tables of what is there
    python -m benchmarks.discovery --again --out campaign            diagnoses once more, on the same logs

The hidden arms, their sensors and the drawing of cases are in `tests/hidden_physics`. Sessions, the
references of the healthy arm, one line a case in `results.jsonl` and the figures in `summary.json` are in the
folder; the truth stands in the results only, and no diagnosis gets to see it.
"""

from __future__ import annotations

import os
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import click

from benchmarks.discovery.campaign import KINDS, Plan, run
from benchmarks.discovery.tally import read_results, summary, tables


@click.command()
@click.option("--cases", default=60, show_default=True, help="Number of cases altogether.")
@click.option("--seed", default=1, show_default=True, help="Of the first case; case i has seed + i.")
@click.option("--skip", default=0, show_default=True, help="Leave out so many of the first cases.")
@click.option("--jobs", default=1, show_default=True, help="Processes at a time.")
@click.option("--days", default=12, show_default=True, help="Healthy days that the reference rests on.")
@click.option(
    "--eras", default=1, show_default=True, help="References, each of other days, for cases in turn."
)
@click.option("--without-reference", is_flag=True, help="Diagnose as if the arm had never been commissioned.")
@click.option("--cause", "causes", multiple=True, help="Hide only these, one at a time.")
@click.option("--kind", "kinds", multiple=True, type=click.Choice(KINDS), help="Draw only such cases.")
@click.option("--again", is_flag=True, help="Diagnose cases once more that have a result.")
@click.option("--recommission", is_flag=True, help="Make the references of the healthy arm anew.")
@click.option("--discard", is_flag=True, help="Delete the logs of a case once it is judged.")
@click.option(
    "--members/--no-members",
    default=True,
    show_default=True,
    help="Record each cause of a pair or triple by itself too, for how visible it is alone.",
)
@click.option("--report", is_flag=True, help="Run nothing.")
@click.option("--out", type=click.Path(path_type=Path), default=Path("discovery"), show_default=True)
def main(
    cases: int,
    seed: int,
    skip: int,
    jobs: int,
    days: int,
    eras: int,
    without_reference: bool,
    causes: tuple[str, ...],
    kinds: tuple[str, ...],
    again: bool,
    recommission: bool,
    discard: bool,
    members: bool,
    report: bool,
    out: Path,
) -> None:
    """Hide physics in simulated sessions, have them diagnosed, and count what is found."""
    plan = Plan(out, cases, seed, days, not without_reference, causes, kinds, discard, members, skip, eras)
    if not report:
        if recommission:
            plan.forget_references()
        run(plan, jobs, again, click.echo)
    results = read_results(plan.results)
    if not results:
        raise click.ClickException(f"{plan.results} has no result yet")
    click.echo(tables(results))
    (out / "summary.json").write_text(summary(results), encoding="utf-8")


if __name__ == "__main__":
    main()
