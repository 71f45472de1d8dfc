"""`lwr-run recover`: a whole file from one whose recorder was killed."""

from __future__ import annotations

from pathlib import Path

import click

from lwr_driver.session import recover
from runner.options import json_option
from runner.plain import as_json as to_json


@click.command("recover")
@click.argument("session", type=click.Path(path_type=Path))
@click.option(
    "--out", type=click.Path(path_type=Path), help="Recovered file; default: SESSION.recovered.mcap."
)
@json_option
def command(session: Path, out: Path | None, as_json: bool) -> None:
    """Make the SESSION log of a killed recorder whole. The broken file stays as it is.

    Everything up to the last whole chunk is kept; the result is read back before it is called good.

    \b
    lwr-run recover experiments/lwr4plus-20260101-120000/loaded.mcap
    """
    target = out if out is not None else session.with_suffix(".recovered.mcap")
    done = recover(session, target)
    click.echo(to_json(done) if as_json else str(done))
