"""`lwr-run export`: a model as URDF, MJCF, or stand-alone inverse dynamics."""

from __future__ import annotations

from pathlib import Path

import click

from fri.errors import ConfigurationError
from runner.options import json_option
from runner.plain import as_json as to_json

__all__ = ["command"]


@click.command("export")
@click.argument("model", type=click.Path(path_type=Path))
@click.argument("outputs", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("--payload", help="Mount this payload of the model (default: the bare arm).")
@click.option("--name", default="arm", show_default=True, help="Name in the file; begins the C functions.")
@click.option("--force", is_flag=True, help="Replace files that exist.")
@json_option
def command(
    model: Path, outputs: tuple[Path, ...], payload: str | None, name: str, force: bool, as_json: bool
) -> None:
    """Write a model in the formats that the OUTPUTS' endings say.

    \b
    .urdf  URDF: consistent inertials, damping and friction
    .xml   MJCF (MuJoCo): the same with drive inertia as armature
    .c     C99 inverse dynamics without dependencies
    .py    numpy inverse dynamics

    URDF and MJCF need bodies that can exist: what the identification leaves open follows the arm's own URDF,
    and where the estimate itself is of no real body the nearest one is taken and the change is stated.

    \b
    lwr-run export results/model.yaml lwr.urdf lwr.xml lwr.c lwr.py
    """
    from ident.formats import FORMATS, export

    for output in outputs:
        if output.suffix in FORMATS and output.exists() and not force:
            raise ConfigurationError(f"output {output} exists; choose another name or give --force")
    done = export(model, *outputs, payload=payload, name=name, overwrite=force)
    if as_json:
        files = [{"file": output, "format": FORMATS[output.suffix]} for output in outputs]
        click.echo(to_json({"files": files, "title": done.title, "notes": done.notes}))
        return
    for output in outputs:
        click.echo(f"{output}: {FORMATS[output.suffix]}, {done.title}")
    for note in done.notes:
        click.echo(f"  {note}")
