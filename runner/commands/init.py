"""`lwr-run init`: the files of a new laboratory."""

from __future__ import annotations

from pathlib import Path
from shlex import quote

import click

from fri.errors import ConfigurationError
from lwr_driver.configuration import CONFIGS
from runner.editor import hand_out
from runner.output import OUTPUT_FOLDER
from runner.status import answer, next_step
from runner.terminal import json_option, to_json, verb

FILES = {
    "experiment.yaml": "experiments/default.yaml",
    "lwr4plus.yaml": "lwr4plus.yaml",
    "cell.yaml": "cell.yaml",
    "krl/lwr_identification.src": "krl/lwr_identification.src",
    "krl/lwr_identification.dat": "krl/lwr_identification.dat",
    "krl/README.md": "krl/README.md",
    "README.md": "laboratory.md",
}
"""Files of a laboratory, and where `configs` has them."""


@verb("init")
@click.argument("folder", type=OUTPUT_FOLDER)
@json_option
def command(folder: Path, as_json: bool) -> None:
    """Hand out a laboratory: experiment.yaml, arm, cell, KRL program and a README, in FOLDER.

    It runs on the emulator as it is. Other files named in experiment.yaml come from this installation.

    \b
    lwr-run init my_lab
    """
    for name, source in FILES.items():
        target = folder / name
        if target.is_dir():
            raise ConfigurationError(f"{target} is a folder; choose another FOLDER")
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes((CONFIGS / source).read_bytes())
    hand_out(folder)
    if as_json:
        click.echo(to_json({"folder": folder, "files": list(FILES)}))
        return
    answer(*(str(folder / name) for name in FILES))
    next_step(f"cd {quote(str(folder))} && lwr-run experiment")
