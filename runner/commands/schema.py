"""`lwr-run schema`: JSON Schemas of the YAML files, for editors."""

from __future__ import annotations

from pathlib import Path

import click

from fri.errors import ConfigurationError
from lwr_driver.listing import Listing
from runner.output import OUTPUT_FILE
from runner.terminal import PATH, json_option, tell, verb


@verb("schema")
@click.argument("name", required=False)
@click.option("--out", type=OUTPUT_FILE, help="Write the schema to this file.")
@click.option(
    "--refer",
    "files",
    multiple=True,
    type=PATH,
    help="Let this YAML file refer to its schema, so that an editor finds it (repeatable).",
)
@json_option
def command(name: str | None, out: Path | None, files: tuple[Path, ...], as_json: bool) -> None:
    """Print the JSON Schema of a kind of file; without NAME list the kinds.

    An editor with a YAML language server completes keys and marks errors. Templates refer to their schemas; a
    copy in another folder needs --refer, which replaces the first line.

    \b
    lwr-run schema                               the kinds of files
    lwr-run schema experiment                    the schema of experiment files
    lwr-run schema cell --out cell.json          to a file
    lwr-run schema --refer my_lab.yaml           my_lab.yaml is a copy of a template
    lwr-run schema cell --refer my_cell.yaml     my_cell.yaml is written by hand
    """
    from runner.editor import refer
    from runner.schema import FILES, schema_text

    if out is not None and name is None:
        raise ConfigurationError(f"--out {out} needs the NAME of a schema: {', '.join(FILES)}")
    done = {str(file): refer(file, name) for file in files}
    if done:
        lines = "\n".join(f"{file} refers to {target}" for file, target in done.items())
        tell({"files": done} if as_json else lines, as_json)
    elif name is None:
        known = {kind: file.meaning for kind, file in FILES.items()}
        tell(known if as_json else Listing(("file", "meaning"), list(known.items()), 0), as_json)
    elif out is not None:
        out.write_text(schema_text(name), encoding="utf-8")
        tell({"file": str(out)} if as_json else str(out), as_json)
    else:
        click.echo(schema_text(name), nl=False)
