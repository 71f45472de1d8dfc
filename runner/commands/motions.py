"""Commands for motions before they are driven: plan, check, preview."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import click

from lwr_driver.configuration import CONFIGS
from runner import status
from runner.output import OUTPUT_FILE, default_output
from runner.status import StatusLine
from runner.terminal import (
    NAMED_FILE,
    FiniteRange,
    default_file,
    forced,
    hold_json,
    json_option,
    to_json,
    verb,
)


@verb("plan")
@click.argument("file", type=NAMED_FILE, default=str(CONFIGS / "plans/default.yaml"))
@click.option("--out", type=OUTPUT_FILE, help="Plan file; default: NAME.plan.yaml here.")
@json_option
def plan_command(file: str, out: Path | None, as_json: bool) -> None:
    """Plan the exciting motion of the problem FILE; by default the one of the stored plan.

    The plan file has coefficients, margins of all limits on the continuous motion, objective values, predicted
    relative standard deviations, seeds and versions. An experiment uses it through `excitation: {plan: FILE}`.
    Ctrl-C ends the search and keeps the best motion so far that is within every limit; before the first one, which may
    take a minute, there is none to keep. At the end a lower bound tells how far from the best possible motion this one
    may be.

    \b
    lwr-run plan
    lwr-run plan my_arm.yaml --out my_arm.plan.yaml
    """
    from ident.excitation.lower_bound import can_bound, lower_bound
    from ident.excitation.planner import plan
    from ident.excitation.problem import PlanProblem
    from runner.ending import of_plan
    from runner.replanning import show_search

    problem = PlanProblem.load(file)
    target = out if out is not None else default_output(Path(f"{problem.name}.plan.yaml"), forced())
    progress = StatusLine()
    found = plan(problem, lambda now: show_search(progress, now))
    found.save(target)
    bounded = can_bound(problem.objective) and not found.provenance["interrupted"]
    if bounded:
        progress.show("lower bound of the criterion")
    bound = lower_bound(problem) if bounded else None
    progress.clear()
    if as_json:
        keys = ("constraint", "subject", "value", "limit")
        content = {
            "objectives": dict(found.objectives),
            "rsd_percent": dict(found.rsd_percent),
            "margins": [{key: getattr(margin, key) for key in keys} for margin in found.check.margins],
            "provenance": dict(found.provenance),
            "lower_bound": None if bound is None else asdict(bound),
        }
        click.echo(to_json(content))
    else:
        of_plan(found, target, bound).tell()


@verb("check")
@click.argument("file", type=NAMED_FILE, default=default_file)
@click.option("--period-ms", default=5.0, show_default=True, type=FiniteRange(1, 100), help="FRI cycle.")
@json_option
def check_command(file: str, period_ms: float, as_json: bool) -> None:
    """Check the experiment FILE without motion: limits, torques, collisions, from the home position.

    Exits with 3 after a failed check.

    \b
    lwr-run check my_lab.yaml
    lwr-run check my_lab.yaml --period-ms 2 --json
    """
    from lwr_driver.arm import Arm
    from lwr_driver.arm.cell import Cell
    from runner.ending import of_check
    from runner.experiment_file import Experiment
    from runner.files import examine, listed
    from runner.planning import Excitations, session_motion
    from runner.preflight import Preflight

    experiment = Experiment.load(file)
    files = examine(experiment)
    if not as_json:
        status.answer(listed(files))
    arm = Arm.load(experiment.arm, beside=experiment.folder)
    cell = Cell.load(experiment.cell, beside=experiment.folder)
    motions = Excitations.of(experiment, arm, cell)
    home = experiment.home(len(arm.joint_names))
    found: dict[str, Preflight] = {}
    for plan in experiment.sessions:
        rows = motions.rows(plan, period_ms / 1000)
        motion, found[plan.name] = session_motion(experiment, arm, cell, plan, rows, home)
        if not as_json:
            status.answer("", f"session {plan.name}: {motion.duration_s:.1f} s", *found[plan.name].pieces())
    if as_json:
        hold_json({name: list_.items for name, list_ in found.items()})
    for preflight in found.values():
        preflight.enforce()
    if not as_json:
        status.answer("")
        of_check(found, file, len(files)).tell()


@verb("preview")
@click.argument("file", type=NAMED_FILE, default=default_file)
@click.option("--session", metavar="NAME", help="Session of the experiment; default: the heaviest payload.")
@click.option("--out", type=OUTPUT_FILE, help="The page to write; default: preview.html.")
@click.option("--serve", "serving", is_flag=True, help="Serve an interactive scene until Ctrl-C instead.")
@click.option("--port", default=8080, show_default=True, type=click.IntRange(1, 65535), help="Of --serve.")
@json_option
def preview_command(
    file: str, session: str | None, out: Path | None, serving: bool, port: int, as_json: bool
) -> None:
    """Show a planned motion in 3D. FILE is an experiment file, a folder of results or a plan file.

    The page is one file and needs no network. It shows the arm along the motion, the path of its flange coloured
    by clearance, the tightest moment, and the use of every limit.

    \b
    lwr-run preview my_lab.yaml
    lwr-run preview my_lab.yaml --session unloaded --out unloaded.html
    lwr-run preview experiments/lwr4plus-20260101-120000 --serve
    """
    from runner.ending import open_page
    from runner.preflight import Preflight
    from runner.preview import planned_motion, preview_html, serve

    if not serving:
        out = out if out is not None else default_output(Path("preview.html"), forced())
    planned = planned_motion(file, session=session)

    def tell(place: str) -> None:
        if as_json:
            click.echo(to_json({**planned.facts(), "place": place}))
            return
        failed = Preflight(tuple(item for item in planned.preflight.items if not item.ok))
        status.answer(
            f"{planned.title}: {planned.motion.duration_s:.1f} s, tightest moment {planned.tightest}",
            *(failed.pieces() if failed.items else ()),
        )
        status.next_step(open_page(Path(place)) if out else place)

    if out is None:
        serve(planned, port, tell)
        return
    out.write_text(preview_html(planned), encoding="utf-8")
    tell(str(out))
