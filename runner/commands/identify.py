"""`lwr-run identify`: a model from session logs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import click

from fri.errors import ConfigurationError
from ident.dynamics.kinematics import Chain
from ident.estimation.choice import choose
from ident.estimation.identify import AUTO, identify
from ident.estimation.mounting import find_mounting
from ident.estimation.validate import validate
from ident.estimators import ESTIMATORS
from ident.model.model_file import write_model
from lwr_driver.session import read_session
from runner.estimation import IdentifySettings, announced
from runner.results import named_model, new_folder, write_log_results
from runner.terminal import json_option, to_json

_SUMMARIES = {
    AUTO: "of wls and physical, base upright or leaning, the best on held-back motion",
    **{name: kind.summary for name, kind in ESTIMATORS.items()},
}
_EPILOG = "\b\nEstimators:\n" + "\n".join(f"  {name:<10} {text}" for name, text in _SUMMARIES.items())


@click.command("identify", epilog=_EPILOG)
@click.argument("sessions", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "--model",
    type=click.IntRange(1, 3),
    default=2,
    show_default=True,
    help="1: joint torques; 2: motor and joint torques; 3: their difference.",
)
@click.option(
    "--estimator",
    type=click.Choice((AUTO, *ESTIMATORS)),
    default=AUTO,
    show_default=True,
    help="See below. The paper's is wls.",
)
@click.option(
    "--payload",
    multiple=True,
    metavar="FILE=NAME[:KG]",
    help="Payload of a session, in place of its metadata; `none`: the bare arm.",
)
@click.option("--urdf", type=click.Path(path_type=Path), help="Kinematics; default: from the first session.")
@click.option(
    "--tilt", is_flag=True, help="Estimate the tilt of the base too; `auto` otherwise does so where it helps."
)
@click.option(
    "--without", multiple=True, metavar="NAME", help="Parameter (`offm3`) or kind (`Fvl`) to leave out."
)
@click.option("--essential", is_flag=True, help="Reduce the model to its essential parameters.")
@click.option(
    "--test",
    multiple=True,
    type=click.Path(path_type=Path),
    metavar="SESSION",
    help="Held-out session to validate the model (repeatable).",
)
@click.option(
    "--settings",
    metavar="FILE",
    help="YAML file of filters, covariance and more; see docs/identify_settings.md.",
)
@click.option("--out", type=click.Path(path_type=Path), help="Model file to write, e.g. model.yaml.")
@click.option(
    "--results",
    type=click.Path(path_type=Path),
    metavar="FOLDER",
    help="Folder for summary.json, model.yaml and report.html, as of an experiment.",
)
@json_option
def command(
    sessions: tuple[Path, ...],
    model: int,
    estimator: str,
    payload: tuple[str, ...],
    urdf: Path | None,
    tilt: bool,
    without: tuple[str, ...],
    essential: bool,
    test: tuple[Path, ...],
    settings: str | None,
    out: Path | None,
    results: Path | None,
    as_json: bool,
) -> None:
    """Estimate the base parameters of an arm from its SESSIONS, stacked.

    The payload of each session is in its metadata. Sessions without and with payloads together identify each
    payload separately from the last link.

    All other settings are in the file of --settings; configs/identify.yaml is a template with every key.

    \b
    lwr-run identify unloaded.mcap loaded.mcap --out model.yaml
    lwr-run identify unloaded.mcap loaded.mcap --estimator wls
    lwr-run identify unloaded.mcap --model 1 --estimator huber
    lwr-run identify unloaded.mcap loaded.mcap --test another.mcap --results monday
    lwr-run identify short.mcap --model 1 --estimator physical --tilt
    lwr-run identify unloaded.mcap loaded.mcap --essential --settings my_settings.yaml
    """
    read = IdentifySettings() if settings is None else IdentifySettings.load(settings)
    wanted = read.identification(model, estimator, file=settings or "")
    wanted = replace(wanted, without=(*wanted.without, *without))
    if essential and wanted.essential is None:
        raise ConfigurationError(
            f"--essential needs the essential parameters, and {settings} has `essential: null`; leave one out"
        )
    if results is not None:
        new_folder(results)
    logs = announced([read_session(path, status=False) for path in (*sessions, *test)], payload)
    logs, tested = logs[: len(sessions)], logs[len(sessions) :]
    if urdf is None and logs[0].robot_description is None:
        raise ConfigurationError(f"{sessions[0]}: holds no robot description; name the URDF with --urdf")
    chain = Chain.from_urdf(urdf if urdf is not None else str(logs[0].robot_description))
    mounting = None
    if estimator == AUTO:
        found = choose(logs, chain, wanted, tilt=tilt or None)
    elif tilt:
        mounting = find_mounting(logs, chain, wanted)
        found = mounting.identification
    else:
        found = identify(logs, chain, wanted)
    result = named_model(
        found.essential_model if essential else found.model, logs[0].metadata.get("robot", "arm")
    )
    content, text = found.to_dict(), found.summary()
    if mounting is not None:
        content["mounting"], text = mounting.to_dict(), f"{text}\n\n{mounting}"
    if tested:
        validation = validate(result, tested)
        content["validation"] = validation.to_dict()["sessions"]
        text = f"{text}\n\n{validation}"
    click.echo(to_json(content) if as_json else text)
    if out is not None:
        write_model(result, out)
        click.echo(str(out), err=as_json)
    if results is not None:
        page = write_log_results(results, found, logs, tested, result, text=text)
        click.echo(str(page), err=as_json)
