"""The trust campaign: one command, seeded, resumable, with a table as its result.

    python -m benchmarks.trust                         all sections, with their full numbers
    python -m benchmarks.trust wire --runs 10000       faults on the wire, in lock step
    python -m benchmarks.trust realtime --seconds 600  ten minutes of each measurement
    python -m benchmarks.trust wire --only 857         repeat one run and tell all about it
    python -m benchmarks.trust table                   what there is, as a table

Results go to a JSON file after every piece of work; the same command goes on where it was broken off. `table`
joins several such files into the first and writes Markdown. Exit code 1 if a promise was broken.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import click

from benchmarks.trust.table import Ledger

SECTIONS = {
    "wire": "faults on the wire, alone and mixed, in every phase",
    "clocks": "counters and clocks that disagree, in lock step and real time",
    "reaction": "from a fault to the safe reaction, in cycles",
    "contact": "pushes on each joint and an obstacle: stopped in time, and no alarm without them",
    "robot": "faults of the robot: emergency stop, drives, modes, quality, temperature, payload, people",
    "computer": "faults of this computer: kill -9, disk, clock, starvation, Ctrl-C",
    "network": "what is bound, who is answered, what is said",
    "realtime": "reply latency beside a minimal C client, at 1, 2, 5 and 10 ms",
    "files": "crafted files: an error with advice, never a traceback or an hour of work",
    "resume": "aborts at random instants, each finished by --resume; folders that changed since",
    "drivers": "two drivers on one computer: starts and ends beside a running motion",
    "input": "mangled packets, logs, files: an error of ours or a correct result",
    "physics": "the emulated arm against theory",
    "clients": "other people's FRI clients on the emulator",
    "torque": "the motor torque channel",
    "soak": "long operation in lock step with swaps and faults",
}


@dataclass(frozen=True)
class Options:
    """What the sections may look at. runs, seconds : None takes each section's own number."""

    seed: int
    runs: int | None
    seconds: float | None
    only: int | None
    lines: str
    periods_ms: tuple[int, ...]
    say: Callable[[str], None]


@click.command(help=__doc__, context_settings={"max_content_width": 110})
@click.argument("sections", nargs=-1, type=click.Choice([*SECTIONS, "table"]))
@click.option("--seed", default=1, show_default=True)
@click.option("--runs", type=int, help="Runs of each line of a section; wire: of all lines together.")
@click.option("--seconds", type=float, help="Duration of soak and of each real-time measurement.")
@click.option("--periods-ms", default="1,2,5,10", show_default=True, help="FRI cycles of `realtime`.")
@click.option("--only", type=int, help="One run of `wire` by its number.")
@click.option("--lines", default="", help="Pattern: only such lines of `computer`, `drivers`, `realtime`.")
@click.option("--anew", is_flag=True, help="Forget what the file holds of these sections.")
@click.option("--join", multiple=True, type=click.Path(path_type=Path, exists=True), help="For `table`.")
@click.option("--out", type=click.Path(path_type=Path), default=Path("trust.json"), show_default=True)
def main(
    sections: tuple[str, ...],
    seed: int,
    runs: int | None,
    seconds: float | None,
    periods_ms: str,
    only: int | None,
    lines: str,
    anew: bool,
    join: tuple[Path, ...],
    out: Path,
) -> None:
    """Run the sections and print the table."""
    ledger = Ledger(None if only is not None else out, seed)
    if "table" in sections:
        for path in join:
            ledger.join(Ledger(path, seed))
        ledger.save()
        click.echo(ledger.markdown(tuple(SECTIONS)))
        sys.exit(1 if ledger.failed else 0)
    periods = tuple(int(text) for text in periods_ms.split(","))
    options = Options(seed, runs, seconds, only, lines, periods, click.echo)
    for section in sections or tuple(SECTIONS):
        if anew:
            ledger.forget(section)
        importlib.import_module(f"benchmarks.trust.{section}").campaign(ledger, options)
        ledger.save()
        click.echo(ledger.table(section))
    for line in ledger.lines.values():
        for failure in line.failures:
            click.echo(f"{line.section} {line.what}: {failure}")
    sys.exit(1 if ledger.failed else 0)


if __name__ == "__main__":
    main()
