"""`lwr-run import`: a recording made elsewhere becomes a session log."""

from __future__ import annotations

from pathlib import Path

import click

from fri.errors import ConfigurationError
from runner.options import json_option
from runner.plain import as_json as to_json

__all__ = ["command"]


def _rows(context: click.Context, parameter: click.Parameter, value: str | None) -> tuple[int, int] | None:
    if value is None:
        return None
    first, mark, last = value.partition(":")
    if not mark or not first.isdigit() or not last.isdigit():
        raise click.BadParameter(f"{value!r} is no range of rows such as 0:24750", context, parameter)
    return int(first), int(last)


@click.command("import")
@click.argument("mapping")
@click.argument("source", type=click.Path(path_type=Path))
@click.argument("output", type=click.Path(path_type=Path))
@click.option("--rows", callback=_rows, metavar="A:B", help="Take rows A to B-1 only, counted from 0.")
@click.option("--payload", help="Name of the payload; `none` if there is none.")
@click.option("--payload-mass", type=float, metavar="KG", help="Mass of the payload as weighed.")
@click.option("--serial", help="Serial number of the arm.")
@json_option
def command(
    mapping: str,
    source: Path,
    output: Path,
    rows: tuple[int, int] | None,
    payload: str | None,
    payload_mass: float | None,
    serial: str | None,
    as_json: bool,
) -> None:
    """Turn a CSV or NPZ recording into a session log.

    MAPPING is a mapping file (columns, units, signs, gears, time base) or the name of one in configs/imports.
    SOURCE is the recording: a file, or the folder of the files that the mapping names. OUTPUT is the new log.

    \b
    lwr-run import lwr4_flobaroid measurements_1.npz run_1.mcap
    lwr-run import tx40 recordings/tx40 tx40.mcap --rows 0:24750
    """
    from ident.import_log import LogMapping, import_log
    from ident.import_log.mapping import mapping_path

    if output.suffix != ".mcap":
        raise ConfigurationError(f"output {output}: a session log ends in .mcap")
    report = import_log(
        LogMapping.load(mapping),
        source,
        output,
        rows=rows,
        payload=payload,
        payload_mass=payload_mass,
        serial=serial,
        beside=mapping_path(mapping).parent,
    )
    click.echo(to_json(report) if as_json else str(report))
