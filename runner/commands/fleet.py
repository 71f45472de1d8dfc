"""`lwr-run batch` and `lwr-run trend`: many arms over many days."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Any

import click

from runner.output import NEW_FOLDER, OUTPUT_FILE
from runner.status import answer, next_step, write
from runner.terminal import NAMED_FILE, PATH, GroupedCommand, hold_json, json_option, tell

if TYPE_CHECKING:  # a command imports its own alone
    from runner.fleet.trend import ArmTrend

_STORE = click.option(
    "--store",
    type=NEW_FOLDER,
    default=Path("fleet"),
    show_default=True,
    help="Folder of the results, a folder for each arm.",
)


@click.command(
    "batch",
    cls=GroupedCommand,
    groups={
        "Work": ("store", "diagnose", "reference_days", "settings"),
        "Computers": ("jobs", "dask"),
    },
)
@click.argument("places", nargs=-1, required=True, type=PATH, metavar="FOLDER...")
@_STORE
@click.option(
    "--diagnose",
    type=click.Choice(["changed", "all", "none"]),
    default="changed",
    show_default=True,
    help="Days with a diagnosis; `changed`: the first day after a change, and the newest one.",
)
@click.option(
    "--reference-days",
    type=click.IntRange(1, 60),
    default=3,
    show_default=True,
    help="First days of each arm for its healthy-arm baseline.",
)
@click.option("--settings", type=NAMED_FILE, metavar="FILE", help="As of `lwr-run identify`.")
@click.option(
    "--jobs", type=click.IntRange(-1, 1024), default=1, show_default=True, help="Processes; -1: one a core."
)
@click.option("--dask", metavar="ADDRESS", help="Scheduler of a Dask cluster, such as tcp://host:8786.")
@json_option
def batch_command(
    places: tuple[Path, ...],
    store: Path,
    diagnose: Any,
    reference_days: int,
    settings: str | None,
    jobs: int,
    dask: str | None,
    as_json: bool,
) -> None:
    """Identify and diagnose every arm's every day in the logs below each FOLDER.

    The arm is robot and serial number of a log, or the folder it lies in; the day a date in its path, such as
    2026-03-12, or the log's own, else `undated`. What the store holds is not done again: add a day's folder and repeat
    the command. Copies are known by the identity of the log. An unreadable log or a failed day is noted and stops
    nothing.

    \b
    lwr-run batch logs/ --store fleet --jobs -1
    lwr-run batch logs/*/2026-03-* --diagnose all
    lwr-run batch logs/ --dask tcp://head:8786         on a cluster that shares the disk
    """
    from fri.errors import DataError
    from runner.estimation import IdentifySettings
    from runner.fleet import FleetStore, Order, Progress, find_days, run_batch

    read = IdentifySettings() if settings is None else IdentifySettings.load(settings)
    wanted = replace(read.identification(2, "wls", file=settings or ""), essential=None)
    # A cluster's processes have other working folders.
    store = store.resolve()
    home = FleetStore(store)
    found = find_days([place.resolve() for place in places], home.uids())
    for path, reason in found.unreadable:
        write(f"{path}: left out: {reason}")
    for path in found.repeated:
        write(f"{path}: left out: a copy of another log")
    arms = len({day.arm for day in found.days})
    place = sys.stderr if as_json else sys.stdout
    write(
        f"{len(found.days)} new days of {arms} arms; {found.known} logs are in {store} already", stream=place
    )

    def report(one: Progress) -> None:
        write(f"{one.arm} {one.day} {one.what}{f': {one.error}' if one.error else ''}", stream=place)

    with _cluster(dask):
        order = Order(wanted, diagnose, reference_days, jobs)
        done = run_batch(home, found.days, order, report)
    failed = [one for one in done if one.error]
    if as_json:
        hold_json(
            {
                "schema_version": 1,
                "days": len(found.days),
                "known": found.known,
                "done": [one.__dict__ for one in done],
                "unreadable": [[str(path), reason] for path, reason in found.unreadable],
                "repeated": [str(path) for path in found.repeated],
            }
        )
    else:
        answer(f"{len(done) - len(failed)} done, {len(failed)} failed.")
        next_step(f"lwr-run trend --store {quote(str(store))}")
    if found.days and len(failed) >= len(done) > 0:
        raise DataError(f"no day could be worked on; the first reason: {failed[0].error}")


@contextlib.contextmanager
def _cluster(address: str | None) -> Any:
    """The context in which joblib uses a Dask cluster; the local machine without an address."""
    if address is None:
        yield
        return
    from lwr_driver.notebook import optional

    distributed = optional("distributed", "--dask", "--jobs on this machine", "fleet")
    from joblib import parallel_config

    with distributed.Client(address), parallel_config(backend="dask"):
        yield


@click.command("trend", cls=GroupedCommand, groups={"Results": ("store", "out")})
@click.argument("arm", required=False)
@click.option(
    "--store", type=PATH, default=Path("fleet"), show_default=True, help="Folder of `lwr-run batch`."
)
@click.option("--out", type=OUTPUT_FILE, help="Page to write, e.g. trend.html.")
@json_option
def trend_command(arm: str | None, store: Path, out: Path | None, as_json: bool) -> None:
    """Changes of an ARM over its days, with the first day and its uncertainty; without ARM: of all arms.

    A change is a step or a drift of a parameter, or of the error of a torque, beyond the scatter from day to day; one
    arm in a thousand has one by chance. Of five arms or more, those unlike the others are named.
    With fewer than five days no change can be told.

    \b
    lwr-run trend --store fleet
    lwr-run trend LWR4+_17 --store fleet --out arm17.html
    """
    from fri.errors import DataError
    from runner.ending import open_page
    from runner.fleet import FleetStore, arm_trend, fleet_trend, usual_scatter
    from runner.fleet.page import arm_html, fleet_html
    from runner.report.page import write_page

    home = FleetStore(store)
    if not home.arms():
        raise DataError(f"{store} holds no results; make them with `lwr-run batch FOLDER... --store {store}`")
    if arm is not None:
        one = arm_trend(home.arm(arm), usual_scatter(home))
        arms = [one]
        tell({"schema_version": 1, **one.to_dict()} if as_json else one, as_json)
        text = arm_html(one) if out is not None else ""
    else:
        fleet = fleet_trend(home)
        arms = list(fleet.arms)
        tell({"schema_version": 1, **fleet.to_dict()} if as_json else fleet, as_json)
        text = fleet_html(fleet) if out is not None else ""
    for line in doubts(arms):
        write(line, stream=sys.stderr if as_json else sys.stdout)
    if out is not None:
        next_step(open_page(write_page(text, out)), sys.stderr if as_json else None)


def doubts(arms: Sequence[ArmTrend]) -> list[str]:
    """A line on logs without a date, none where all have one."""
    from runner.fleet.page import UNDATED_ADVICE

    undated = [one.arm for one in arms if one.undated]
    if not undated:
        return []
    return [f"undated logs of {', '.join(undated)} have no part in any course: {UNDATED_ADVICE}"]
