"""`lwr-run info`: what a session log contains."""

from __future__ import annotations

import json
from pathlib import Path

import click

from lwr_driver.session import describe


@click.command("info")
@click.argument("session", type=click.Path(path_type=Path))
@click.option("--json", "as_json", is_flag=True, help="Machine-readable output.")
def command(session: Path, as_json: bool) -> None:
    """Say what a SESSION log contains: who recorded what, how long, which channels, what is missing.

    \b
    lwr-run info experiments/lwr4plus-20260101-120000/loaded.mcap
    """
    summary = describe(session)
    click.echo(json.dumps(summary.as_dict(), indent=1) if as_json else str(summary))
