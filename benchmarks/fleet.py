"""A simulated fleet through `lwr-run batch` and `lwr-run trend`: arms found, their days, and the cost.

    python -m benchmarks.fleet --out /tmp/fleet --jobs 2

Twenty arms over thirty days: three wear, one gets another torque sensor, one a payload. Printed: each change with its
first day against the day on which it began, arms accused without a cause, processor minutes of the first run, and of
a second one after a further day of one arm. Logs that exist already are kept.
"""

from __future__ import annotations

import json
import resource
import subprocess
import sys
from datetime import date, timedelta
from pathlib import Path

import click

from tests.fleet import START, Event, Fleet
from tests.ident.known_arm import truth

# A day's growth of friction, as a share of it.
_WEAR = 0.01


def events(days: int) -> tuple[Event, ...]:
    """What happens: in the second and third quarter of the days."""
    return (
        Event(2, "wear", days // 3, joint=1, size=_WEAR),
        Event(7, "wear", days // 2, joint=2, size=_WEAR),
        Event(11, "wear", days // 3, joint=4, size=2 * _WEAR),
        Event(14, "sensor", days // 2, joint=3, size=0.5),
        Event(17, "payload", 2 * days // 3),
    )


def _run(*arguments: str) -> tuple[str, float]:
    """Output of `lwr-run`, and its processor time [s]."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    found = subprocess.run(
        [sys.executable, "-m", "runner.cli", *arguments], capture_output=True, text=True, check=False
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    if found.returncode:
        raise SystemExit(found.stderr)
    return found.stdout, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


@click.command()
@click.option("--arms", default=20, show_default=True)
@click.option("--days", default=30, show_default=True)
@click.option("--jobs", default=1, show_default=True)
@click.option("--seed", default=1, show_default=True)
@click.option("--diagnose", default="changed", show_default=True)
@click.option("--out", type=click.Path(path_type=Path), required=True)
def main(arms: int, days: int, jobs: int, seed: int, diagnose: str, out: Path) -> None:
    """Make the fleet, work on it, and compare the findings with the hidden changes."""
    planned = tuple(e for e in events(days) if e.arm < arms)
    fleet = Fleet(truth(), out / "logs", planned, seed)
    for arm in range(arms):
        for day in range(days):
            if not (fleet.folder / f"arm_{arm:02d}" / (START + timedelta(days=day)).isoformat()).is_dir():
                fleet.record(arm, day)
    command = [
        "batch",
        str(fleet.folder),
        "--store",
        str(out / "store"),
        "--jobs",
        str(jobs),
        "--diagnose",
        diagnose,
    ]
    _, first = _run(*command, "--json")
    text, _ = _run("trend", "--store", str(out / "store"), "--json", "--out", str(out / "fleet.html"))
    accused = 0
    for arm in json.loads(text)["arms"]:
        number = int(arm["arm"].rsplit("_", 1)[1])
        event = next((e for e in planned if e.arm == number), None)
        said = [
            (
                c["name"],
                c["course"],
                c["earliest"],
                c["latest"],
                f"{c['after'] - c['before']:+.3g} {c['unit']}",
            )
            for c in arm["changes"]
        ]
        said += [("payload", name, day) for name, day in arm["new_payloads"].items()]
        said += [(f["cause"], f["joints"], f["first_day"], f"{f['confidence']:.2f}") for f in arm["findings"]]
        if event is None:
            accused += bool(said)
        if said or event:
            began = "" if event is None else f"{event.kind} of joint {event.joint} since {_day(event.day)}"
            click.echo(f"{arm['arm']}: {began or 'healthy'}")
            for one in said:
                click.echo(f"    {'  '.join(one)}")
    healthy = arms - len(planned)
    click.echo(f"healthy arms with a change or finding: {accused} of {healthy}")
    fleet.record(0, days)
    again, second = _run(*command, "--json")
    done = json.loads(again)["done"]
    click.echo(
        f"{arms} arms, {days} days: {first / 60:.1f} processor minutes; after one more day of one arm {second:.1f} s "
        f"for {len(done)} task{'s' if len(done) != 1 else ''}"
    )


def _day(number: int) -> date:
    return START + timedelta(days=number)


if __name__ == "__main__":
    main()
