"""`lwr-run payload`: a payload's ten parameters from a known arm model and a loaded session."""

from __future__ import annotations

import json
from pathlib import Path

import click

from fri.errors import ConfigurationError

__all__ = ["command"]


@click.command("payload")
@click.argument("model", type=click.Path(path_type=Path))
@click.argument("sessions", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "--free-offsets", is_flag=True, help="Let the torque offsets move since the arm's identification."
)
@click.option(
    "--write", type=click.Path(path_type=Path), metavar="FILE", help="Write a model with the payload."
)
@click.option("--json", "as_json", is_flag=True, help="Print JSON instead of a table.")
def command(
    model: Path, sessions: tuple[Path, ...], free_offsets: bool, write: Path | None, as_json: bool
) -> None:
    """Estimate mass, centre of mass and inertia of what the arm carries in SESSIONS, with MODEL as the arm.

    The standard deviations contain the uncertainty of the arm model. The mass is held against the one that
    the session announces.

    \b
    lwr-run payload model.yaml loaded.mcap
    """
    from ident.model_file import read_model, write_model
    from ident.payload import identify_payload, with_payload
    from lwr_driver.session import read_session

    if write is not None and write.exists():
        raise ConfigurationError(f"file {write} exists; choose another name")
    arm = read_model(model)
    found = identify_payload(arm, [read_session(path) for path in sessions], free_offsets=free_offsets)
    click.echo(json.dumps(found.to_dict(), indent=1) if as_json else str(found))
    if write is not None:
        write_model(with_payload(arm, found), write)
        click.echo(f"written {write}", err=True)
