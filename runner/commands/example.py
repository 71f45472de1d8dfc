"""`lwr-run example`: public recordings of real arms."""

from __future__ import annotations

from pathlib import Path

import click

from fri.errors import ConfigurationError
from runner.output import NEW_FOLDER
from runner.status import answer, write
from runner.terminal import json_option, tell, to_json, verb


@verb("example")
@click.argument("name", required=False)
@click.option("--list", "listing", is_flag=True, help="List the recordings, with source and licence.")
@click.option("--out", type=NEW_FOLDER, help="Folder of the files; default: ./NAME.")
@click.option("--mirror", help="Folder or URL with the same files, in place of the source.")
@json_option
def command(name: str | None, listing: bool, out: Path | None, mirror: str | None, as_json: bool) -> None:
    """Fetch a public recording of a real arm. Each file is checked by its SHA-256.

    The recordings belong to their authors and have licences of their own, shown here. Files that are there already
    are checked and kept.

    \b
    lwr-run example --list                       the recordings
    lwr-run example lwr4                         the only public one of a KUKA LWR4+, into ./lwr4
    lwr-run example lwr4 --mirror /media/usb     from another computer, where this one has no internet
    """
    from runner.examples import EXAMPLES, fetch

    if listing or name is None:
        if name is not None:
            raise ConfigurationError(f"--list lists every recording; leave {name} out")
        entries = [
            {"name": key, "meaning": e.meaning, "source": e.source, "licence": e.licence}
            for key, e in EXAMPLES.items()
        ]
        lines = (f"{e['name']}\n  {e['meaning']}\n  {e['source']}; {e['licence']}" for e in entries)
        tell(entries if as_json else "\n".join(lines), as_json)
        return
    folder = Path(name) if out is None else out
    found = EXAMPLES.get(name)
    if found is not None and not as_json:
        write(f"{found.meaning}\nfrom {found.source}\nlicence: {found.licence}")
    files = fetch(name, folder, mirror)
    assert found is not None
    if as_json:
        click.echo(
            to_json({"files": files, "source": found.source, "licence": found.licence, "then": found.then})
        )
        return
    answer(*map(str, files))
    write("then, in that folder:")
    for line in found.then:
        write(f"  {line}", command=True)
