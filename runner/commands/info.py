"""`lwr-run info`: what a session log contains."""

from __future__ import annotations

from pathlib import Path

import click

from lwr_driver.session import describe
from runner.options import json_option
from runner.plain import as_json as to_json


@click.command("info")
@click.argument("session", type=click.Path(path_type=Path))
@json_option
def command(session: Path, as_json: bool) -> None:
    """Say what a SESSION log contains: who recorded what, how long, which channels, what is missing.

    \b
    lwr-run info experiments/lwr4plus-20260101-120000/loaded.mcap
    """
    summary = describe(session)
    click.echo(to_json(summary.as_dict()) if as_json else str(summary))
