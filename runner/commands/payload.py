"""`lwr-run payload`: a payload's ten parameters from a known arm model and a loaded session."""

from __future__ import annotations

from pathlib import Path

import click

from fri.errors import ConfigurationError
from runner.options import json_option
from runner.plain import as_json as to_json

__all__ = ["command"]


@click.command("payload")
@click.argument("model", type=click.Path(path_type=Path))
@click.argument("sessions", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "--free-offsets", is_flag=True, help="Let the torque offsets move since the arm's identification."
)
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Write a model with the payload to this file.",
)
@json_option
def command(
    model: Path, sessions: tuple[Path, ...], free_offsets: bool, out: Path | None, as_json: bool
) -> None:
    """Estimate mass, centre of mass and inertia of what the arm carries in SESSIONS, with MODEL as the arm.

    The standard deviations contain the uncertainty of the arm model. The mass is held against the one that
    the session announces.

    \b
    lwr-run payload model.yaml loaded.mcap
    lwr-run payload model.yaml loaded.mcap --out with_payload.yaml
    """
    from ident.estimation.payload import identify_payload, with_payload
    from ident.model.model_file import read_model, write_model
    from lwr_driver.session import read_session

    if out is not None and out.exists():
        raise ConfigurationError(f"file {out} exists; choose another name")
    arm = read_model(model)
    found = identify_payload(arm, [read_session(path) for path in sessions], free_offsets=free_offsets)
    click.echo(to_json(found.to_dict()) if as_json else str(found))
    if out is not None:
        write_model(with_payload(arm, found), out)
        click.echo(str(out), err=as_json)
