"""`lwr-run compare`: two models, parameter by parameter."""

from __future__ import annotations

from pathlib import Path

import click

from runner.options import json_option
from runner.plain import as_json as to_json

__all__ = ["command"]


@click.command("compare")
@click.argument("first", type=click.Path(path_type=Path))
@click.argument("second", type=click.Path(path_type=Path))
@json_option
@click.option(
    "--level",
    type=click.FloatRange(0.0, 1.0, min_open=True, max_open=True),
    default=0.05,
    show_default=True,
    help="Probability of calling any parameter different when none is.",
)
def command(first: Path, second: Path, as_json: bool, level: float) -> None:
    """Say which parameters of two models differ by more than chance: two robots, two dates, two settings.

    Models of different base sets are compared in the combinations that both determine.

    \b
    lwr-run compare robot_a.yaml robot_b.yaml
    """
    from ident.estimation.compare import compare
    from ident.model.model_file import read_model

    labels = (f"{first}", f"{second}")
    result = compare(read_model(first), read_model(second), level=level, labels=labels)
    click.echo(to_json(result.to_dict()) if as_json else str(result))
