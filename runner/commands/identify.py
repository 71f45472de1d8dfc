"""`lwr-run identify`: a model from session logs."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import click

from fri.errors import ConfigurationError
from ident.dynamics.kinematics import Chain
from ident.estimation.essential import EssentialSettings
from ident.estimation.identify import ESTIMATORS, IdentificationSettings, identify
from ident.estimation.mounting import find_mounting
from ident.estimation.validate import validate
from ident.estimators import CovarianceSettings
from ident.model.model_file import write_model
from ident.rows.filters import SignalSettings
from lwr_driver.session import read_session
from runner.estimation import EstimatorChoice, announced, coulomb, couplings
from runner.log_results import new_folder, write_log_results
from runner.options import GroupedCommand, coupling_option, json_option, number_or
from runner.plain import as_json as to_json
from runner.versions import software

_SIGNALS = {field.name: field.default for field in dataclasses.fields(SignalSettings)}
_GROUPS = {
    "Model": ("model", "without", "coupling", "coulomb_text", "tilt", "urdf", "payload"),
    "Estimator": (
        "estimator",
        "covariance",
        "bandwidth_s",
        "block_s",
        "tuning",
        "memory_s",
        "relative_noise",
        "prior_strength",
        "prior_metric",
        "prior_std",
    ),
    "Signals": (
        "cutoff_hz",
        "order",
        "decimate_hz",
        "rate_hz",
        "attenuation_db",
        "choose_cutoff",
        "average_periods",
        "edge_s",
        "longest_bridge_s",
        "bridged_share",
        "standstill_rad_s",
        "standstill_share",
        "outlier_scale",
        "motor_delay_s",
        "delay_search_s",
        "resonance_hz",
    ),
    "Essential parameters": ("essential", "significance", "largest_loss", "keep", "drop"),
}


def _signal(name: str, text: str, **named: Any) -> Any:
    """Option of the signal setting `name`, with its default."""
    kind = named.pop("type", float)
    default = _SIGNALS[name]
    return click.option(
        f"--{name.replace('_', '-')}",
        name,
        default=default,
        type=kind,
        show_default=default is not None,
        help=text,
        **named,
    )


@click.command("identify", cls=GroupedCommand, groups=_GROUPS)
@click.argument("sessions", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "--model",
    type=click.IntRange(1, 3),
    default=2,
    show_default=True,
    help="1: joint torques; 2: motor and joint torques; 3: their difference.",
)
@click.option(
    "--without", multiple=True, metavar="NAME", help="Leave out a parameter (offm3) or a kind (Fvl)."
)
@coupling_option
@click.option(
    "--coulomb",
    "coulomb_text",
    default="sign",
    show_default=True,
    metavar="KIND",
    help="What stands for sign(qd): sign, deadband:WIDTH or tanh:WIDTH [rad/s].",
)
@click.option("--tilt", is_flag=True, help="Find how the base leans, too, and identify under it.")
@click.option(
    "--urdf", type=click.Path(path_type=Path), help="Kinematics; default: the one in the first session."
)
@click.option(
    "--payload",
    multiple=True,
    metavar="FILE=NAME[:KG]",
    help="What a session carried, against its metadata; NAME `none`: the bare arm.",
)
@click.option("--estimator", type=click.Choice(ESTIMATORS), default="wls", show_default=True)
@click.option(
    "--covariance",
    type=click.Choice(("jackknife", "hac", "bootstrap", "textbook")),
    default="jackknife",
    show_default=True,
    help="Where the standard deviations come from; all but textbook hold for correlated residuals.",
)
@click.option("--bandwidth-s", type=float, help="Longest lag of the HAC weights; default: from the data.")
@click.option("--block-s", type=float, help="Block of jackknife and bootstrap; default: from the data.")
@click.option("--tuning", type=float, help="huber, tukey: where the loss bends, in standard deviations.")
@click.option("--memory-s", type=float, help="recursive, mixing: time over which the past is forgotten.")
@click.option("--relative-noise", type=float, help="tls: error of a column as a share of its rms.")
@click.option(
    "--prior-strength",
    type=number_or("evidence", "cross_validation"),
    help="map, physical: weight of the URDF's inertials.",
)
@click.option(
    "--prior-metric",
    type=click.Choice(("pullback", "entropic", "euclidean")),
    help="map, physical: how distance from the URDF's inertials is measured.",
)
@click.option("--prior-std", type=float, help="map, physical: their standard deviation as a share.")
@_signal("cutoff_hz", "Low-pass on the positions.")
@_signal("order", "Its order, run forward and back.", type=int)
@_signal("decimate_hz", "Low-pass of the parallel decimation.")
@_signal("rate_hz", "Rate of the rows; default: 2.5 times --decimate-hz.")
@_signal("attenuation_db", "Stop band of the parallel low-pass.")
@click.option("--choose-cutoff", is_flag=True, help="Take the cut-off from the spectrum of the positions.")
@click.option("--average-periods", is_flag=True, help="Average the periods of a periodic motion first.")
@_signal("edge_s", "Time lost at each end of a stretch; default: 2 / --cutoff-hz.")
@_signal("longest_bridge_s", "Longest gap that is bridged by interpolation.")
@_signal("bridged_share", "Largest share of bridged samples in a row.")
@_signal("standstill_rad_s", "Speed below which the sign of the friction is unknown.")
@_signal("standstill_share", "Largest share of such samples in a row; 1 keeps all.")
@_signal("outlier_scale", "Distance from the running median that makes an outlier, in deviations.")
@_signal("motor_delay_s", "How late the motor torques are.", type=number_or("estimate"))
@_signal("delay_search_s", "Largest delay that is looked for.")
@click.option("--resonance-hz", type=float, help="Lowest resonance of the arm, for advice on the cut-offs.")
@click.option(
    "--essential/--no-essential",
    default=None,
    help="Keep the essential parameters only in the model; or do not look for them. Default: listed.",
)
@click.option(
    "--significance", default=0.01, show_default=True, type=float, help="Level of the test against zero."
)
@click.option(
    "--largest-loss",
    default=1.0,
    show_default=True,
    type=float,
    metavar="PERCENT",
    help="Growth of the residual that all eliminations together may cost.",
)
@click.option("--keep", multiple=True, metavar="NAME", help="A parameter, or a kind, that stays.")
@click.option("--drop", multiple=True, metavar="NAME", help="A parameter, or a kind, that goes untested.")
@click.option(
    "--test",
    multiple=True,
    type=click.Path(path_type=Path),
    metavar="SESSION",
    help="Session that the estimate does not see and is held against (repeatable).",
)
@click.option("--out", type=click.Path(path_type=Path), help="Write the model to this file, e.g. model.yaml.")
@click.option(
    "--results",
    type=click.Path(path_type=Path),
    metavar="FOLDER",
    help="Write a folder as an experiment leaves it: summary.json, model.yaml, report.html.",
)
@json_option
def command(
    sessions: tuple[Path, ...],
    model: int,
    without: tuple[str, ...],
    coupling: tuple[str, ...],
    coulomb_text: str,
    tilt: bool,
    urdf: Path | None,
    payload: tuple[str, ...],
    estimator: str,
    covariance: Any,
    bandwidth_s: float | None,
    block_s: float | None,
    resonance_hz: float | None,
    essential: bool | None,
    significance: float,
    largest_loss: float,
    keep: tuple[str, ...],
    drop: tuple[str, ...],
    test: tuple[Path, ...],
    out: Path | None,
    results: Path | None,
    as_json: bool,
    **others: Any,
) -> None:
    """Estimate the base parameters of an arm from its SESSIONS, stacked.

    Each session's payload is the one that its metadata names; sessions without and with a payload together
    identify the payload apart from the last link, and there may be several payloads.

    \b
    lwr-run identify unloaded.mcap loaded.mcap --out model.yaml
    lwr-run identify unloaded.mcap --model 1 --estimator huber --tuning 2
    lwr-run identify unloaded.mcap loaded.mcap --test another.mcap --results monday
    lwr-run identify short.mcap --model 1 --estimator physical --tilt
    lwr-run identify unloaded.mcap loaded.mcap --essential --keep Fcm --drop offl7 --out small.yaml
    """
    if essential is False and (keep or drop):
        raise ConfigurationError("--keep and --drop say which parameters are essential; leave --no-essential")
    if results is not None:
        new_folder(results)
    logs = announced([read_session(path, status=False) for path in (*sessions, *test)], payload)
    logs, tested = logs[: len(sessions)], logs[len(sessions) :]
    if urdf is None and logs[0].robot_description is None:
        raise ConfigurationError(f"{sessions[0]}: holds no robot description; name the URDF with --urdf")
    chain = Chain.from_urdf(urdf if urdf is not None else str(logs[0].robot_description))
    choice = {name: others.pop(name) for name in _CHOICE}
    settings = IdentificationSettings(
        model=model,
        signals=SignalSettings(**others),
        estimator=EstimatorChoice(estimator, **choice).build(),
        covariance=CovarianceSettings(kind=covariance, bandwidth_s=bandwidth_s, block_s=block_s),
        without=without,
        couplings=couplings(coupling),
        coulomb=coulomb(coulomb_text),
        resonance_hz=resonance_hz,
        essential=None
        if essential is False
        else EssentialSettings(significance, largest_loss, keep=keep, drop=drop),
    )
    mounting = find_mounting(logs, chain, settings) if tilt else None
    found = identify(logs, chain, settings) if mounting is None else mounting.identification
    result = found.essential_model if essential else found.model
    provenance = {**result.provenance, "software": software()}
    result = dataclasses.replace(result, robot=logs[0].metadata.get("robot", "arm"), provenance=provenance)
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


_CHOICE = ("tuning", "memory_s", "relative_noise", "prior_strength", "prior_metric", "prior_std")
