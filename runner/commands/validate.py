"""`lwr-run validate`: how well a model predicts sessions that it was not made from."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import click

from runner.options import json_option
from runner.plain import as_json as to_json

__all__ = ["command"]


@click.command("validate")
@click.argument("model", type=click.Path(path_type=Path))
@click.argument("sessions", nargs=-1, required=True, type=click.Path(path_type=Path))
@json_option
@click.option("--allow-seen", is_flag=True, help="Score sessions that the estimate was made from, labelled.")
@click.option(
    "--against",
    multiple=True,
    type=click.Path(path_type=Path),
    metavar="MODEL",
    help="Another model as competitor (repeatable).",
)
@click.option("--forward", is_flag=True, help="Simulate forward along the commanded motion too.")
@click.option("--cross", is_flag=True, help="Cross-validate over the sessions too.")
@click.option("--cutoff-hz", type=float, help="Cut-off of the position filter (default: the estimation's).")
def command(
    model: Path,
    sessions: tuple[Path, ...],
    as_json: bool,
    allow_seen: bool,
    against: tuple[Path, ...],
    forward: bool,
    cross: bool,
    cutoff_hz: float | None,
) -> None:
    """Predict the torque of SESSIONS with MODEL and show what is left, per joint and side.

    Competitors appear beside it where they exist: the controller's own mass matrix and gravity (logged
    through FRI), the inertials of the URDF, other models. A session that the model was estimated from is
    refused.

    \b
    lwr-run validate model.yaml check.mcap
    lwr-run validate model.yaml a.mcap b.mcap --against old.yaml --forward --json
    """
    from ident.estimation.compare import competitor_scores
    from ident.estimation.forward_simulation import simulate_session
    from ident.estimation.identify import IdentificationSettings
    from ident.estimation.validate import cross_validate, validate
    from ident.model.model_file import read_model
    from ident.rows.filters import SignalSettings
    from lwr_driver.session import read_session

    tested = read_model(model)
    logs = [read_session(path) for path in sessions]
    settings = None if cutoff_hz is None else SignalSettings(cutoff_hz=cutoff_hz)
    result = validate(tested, logs, settings=settings, allow_seen=allow_seen)
    others = [read_model(path) for path in against]
    result = replace(result, competitors=competitor_scores(tested, logs, settings=settings, others=others))
    content: dict[str, Any] = result.to_dict()
    texts = [str(result)]
    if forward:
        runs = [simulate_session(tested, log, settings=settings) for log in logs]
        content["forward"] = [run.to_dict() for run in runs]
        texts += [str(run) for run in runs]
    if cross:
        structure = tested.structure
        wanted = IdentificationSettings(
            model=structure.model,
            signals=settings if settings is not None else SignalSettings(),
            without=structure.without,
            couplings=structure.couplings,
            coulomb=structure.coulomb,
        )
        folds = cross_validate(logs, structure.chain, wanted)
        content["cross_validation"] = folds.to_dict()
        texts.append(str(folds))
    click.echo(to_json(content) if as_json else "\n\n".join(texts))
