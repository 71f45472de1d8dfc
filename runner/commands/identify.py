"""`lwr-run identify`: a model from session logs."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import click

from fri.errors import ConfigurationError
from ident.identify import ESTIMATORS, IdentificationSettings, identify
from ident.kinematics import Chain
from ident.model_file import write_model
from ident.mounting import find_mounting
from ident.signals.settings import SignalSettings
from lwr_driver.session import Session, read_session
from runner.results import identified_model


@click.command("identify")
@click.argument("sessions", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "--model",
    type=click.IntRange(1, 3),
    default=2,
    show_default=True,
    help="1: joint torques; 2: motor and joint torques; 3: their difference.",
)
@click.option("--estimator", type=click.Choice(ESTIMATORS), default="wls", show_default=True)
@click.option(
    "--without", multiple=True, metavar="NAME", help="Leave out a parameter (offm3) or a kind (Fvl)."
)
@click.option(
    "--payload",
    "mounted",
    multiple=True,
    metavar="FILE=NAME",
    help="What hung on the arm (`none`: nothing) in a session whose metadata are wrong; repeatable.",
)
@click.option("--cutoff-hz", default=10.0, show_default=True, help="Low-pass on the positions.")
@click.option("--decimate-hz", default=2.0, show_default=True, help="Low-pass of the parallel decimation.")
@click.option("--choose-cutoff", is_flag=True, help="Take the cut-off from the spectrum of the positions.")
@click.option("--average-periods", is_flag=True, help="Average the periods of a periodic motion first.")
@click.option("--tilt", is_flag=True, help="Find how the base leans, too, and identify under it.")
@click.option(
    "--urdf", type=click.Path(path_type=Path), help="Kinematics; default: the one in the first session."
)
@click.option("--out", type=click.Path(path_type=Path), help="Write the model to this file, e.g. model.yaml.")
@click.option("--json", "as_json", is_flag=True, help="Machine-readable output.")
def command(
    sessions: tuple[Path, ...],
    model: int,
    estimator: str,
    without: tuple[str, ...],
    mounted: tuple[str, ...],
    cutoff_hz: float,
    decimate_hz: float,
    choose_cutoff: bool,
    average_periods: bool,
    tilt: bool,
    urdf: Path | None,
    out: Path | None,
    as_json: bool,
) -> None:
    """Estimate the base parameters of an arm from its SESSIONS, stacked.

    Each session's payload is the one that its metadata names; sessions without and with a payload together
    identify the payload apart from the last link.

    \b
    lwr-run identify unloaded.mcap loaded.mcap --out model.yaml
    lwr-run identify unloaded.mcap --model 1 --estimator huber
    lwr-run identify short.mcap --model 1 --estimator physical --tilt
    lwr-run identify a.mcap b.mcap --payload b.mcap=gripper
    """
    logs = _with_payloads([read_session(path) for path in sessions], mounted)
    if urdf is None and logs[0].robot_description is None:
        raise ConfigurationError(f"{sessions[0]}: holds no robot description; name the URDF with --urdf")
    chain = Chain.from_urdf(urdf if urdf is not None else str(logs[0].robot_description))
    settings = IdentificationSettings(
        model=model,
        signals=SignalSettings(
            cutoff_hz=cutoff_hz,
            decimate_hz=decimate_hz,
            choose_cutoff=choose_cutoff,
            average_periods=average_periods,
        ),
        estimator=estimator,
        without=without,
    )
    mounting = find_mounting(logs, chain, settings) if tilt else None
    found = identify(logs, chain, settings) if mounting is None else mounting.identification
    if as_json:
        content = found.to_dict() | ({} if mounting is None else {"mounting": mounting.to_dict()})
        click.echo(json.dumps(content, indent=1))
    else:
        click.echo(found.summary() if mounting is None else f"{found.summary()}\n\n{mounting}")
    if out is not None:
        write_model(identified_model(found, logs[0].metadata.get("robot", "arm")), out)
        click.echo(str(out), err=as_json)


def _with_payloads(logs: list[Session], mounted: tuple[str, ...]) -> list[Session]:
    """The sessions with the payloads that the user names in place of those of the metadata."""
    corrected = list(logs)
    for entry in mounted:
        file, equals, name = entry.rpartition("=")
        places = [k for k, log in enumerate(logs) if file in (str(log.path), log.path.name)]
        if not equals or not name or len(places) != 1:
            names = ", ".join(log.path.name for log in logs)
            raise ConfigurationError(f"--payload {entry!r}: write FILE=NAME with one of the files {names}")
        log = logs[places[0]]
        metadata = {key: value for key, value in log.metadata.items() if key != "payload_mass"}
        corrected[places[0]] = replace(log, metadata=metadata | {"payload": name})
    return corrected
