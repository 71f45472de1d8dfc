"""`lwr-run diagnose`: what the simulation gets wrong, by cause and joint."""

from __future__ import annotations

import json
from pathlib import Path

import click

from runner.options import json_option

__all__ = ["command"]


@click.command("diagnose")
@click.argument("sessions", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "--test",
    multiple=True,
    type=click.Path(path_type=Path),
    metavar="SESSION",
    help="Session for measuring only, never fitted (repeatable).",
)
@click.option(
    "--model", type=click.Path(path_type=Path), help="Present model, whose simulation is the baseline."
)
@click.option(
    "--reference", type=click.Path(path_type=Path), help="Model of `lwr-run commission`, arm healthy."
)
@click.option("--out", required=True, type=click.Path(path_type=Path), help="Folder of the results.")
@click.option("--arm", help="Arm file (stiffness, gear ratios); default: the one of the sessions' robot.")
@click.option(
    "--urdf", type=click.Path(path_type=Path), help="Kinematics; default: the one in the first session."
)
@click.option("--no-simulation", is_flag=True, help="Leave out the replay of the sessions.")
@json_option
def command(
    sessions: tuple[Path, ...],
    test: tuple[Path, ...],
    model: Path | None,
    reference: Path | None,
    out: Path,
    arm: str | None,
    urdf: Path | None,
    no_simulation: bool,
    as_json: bool,
) -> None:
    """Show what the model gets wrong in SESSIONS, name the causes, and extend the model.

    Writes diagnosis.json, model_extended.yaml, plots and, where causes look alike, plans of the motions that
    would decide into the folder of --out. Finding nothing is a result as well.

    \b
    lwr-run diagnose unloaded.mcap loaded.mcap --out diagnosis
    lwr-run diagnose a.mcap b.mcap --test c.mcap --reference commissioned.yaml --out diagnosis
    """
    from ident.model_file import read_model
    from lwr_driver.session import read_session
    from runner.diagnosis import chain_of, known_arm, study
    from runner.diagnosis.deciding import offers_of_sessions

    logs = [read_session(path) for path in sessions]
    held = [read_session(path) for path in test]
    chain = chain_of(logs, urdf)
    found = study(
        logs,
        chain,
        test=held,
        arm=known_arm(arm, chain),
        model=None if model is None else read_model(model),
        reference=None if reference is None else read_model(reference),
        simulate=not no_simulation,
    )
    found = found.with_offers(offers_of_sessions(found.diagnosis, logs))
    found.write(out)
    click.echo(json.dumps(found.diagnosis.to_dict(), indent=1, allow_nan=False) if as_json else str(found))
    click.echo(str(out), err=as_json)
