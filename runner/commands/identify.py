"""`lwr-run identify`: a model from session logs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fri.errors import ConfigurationError
from ident.estimators.names import AUTO, SUMMARIES
from lwr_driver.listing import text_of
from runner.output import NEW_FOLDER, OUTPUT_FILE, new_folder
from runner.recordings import GUESSED, guess_options, read_recordings
from runner.status import StatusLine
from runner.terminal import NAMED_FILE, PATH, GroupedCommand, hold_json, json_option

if TYPE_CHECKING:
    from ident.dynamics.kinematics import Chain
    from ident.estimation.identification import Identification, IdentificationSettings
    from ident.estimation.mounting import Mounting
    from ident.rows.content import Recall
    from lwr_driver.session import Session

_SUMMARIES = {
    AUTO: "of wls and physical, base upright or leaning, the best on held-back motion",
    **SUMMARIES,
}
_EPILOG = "\b\nEstimators:\n" + "\n".join(f"  {name:<10} {text}" for name, text in _SUMMARIES.items())


_GROUPS = {
    "Estimation": (
        "model",
        "estimator",
        "payload",
        "urdf",
        "tilt",
        "without",
        "essential",
        "test",
        "settings",
        "out",
        "results",
    ),
    "Recordings of other arms": ("base", "tip", *GUESSED),
}


@click.command("identify", epilog=_EPILOG, cls=GroupedCommand, groups=_GROUPS)
@click.argument("sessions", nargs=-1, required=True, type=PATH)
@click.option(
    "--model",
    type=click.IntRange(1, 3),
    help="1: joint torques; 2: motor torques, with joint torques if measured; 3: their difference. "
    "Default: 2, or 1 without motor torques.",
)
@click.option(
    "--estimator",
    type=click.Choice((AUTO, *SUMMARIES)),
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
@click.option("--urdf", type=PATH, help="Kinematics; default: from the first session.")
@click.option("--base", metavar="LINK", help="First link of the arm; gravity points down in its axes.")
@click.option("--tip", metavar="LINK", help="Last link of the arm; default: behind the last measured joint.")
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
    type=PATH,
    metavar="SESSION",
    help="Held-out session to validate the model (repeatable).",
)
@click.option(
    "--settings",
    type=NAMED_FILE,
    metavar="FILE",
    help="YAML file of filters, covariance and more; see docs/identify_settings.md.",
)
@click.option("--out", type=OUTPUT_FILE, help="Model file to write, e.g. model.yaml.")
@click.option(
    "--results",
    type=NEW_FOLDER,
    metavar="FOLDER",
    help="Folder for summary.json, model.yaml and report.html, as of an experiment.",
)
@guess_options
@json_option
def command(
    sessions: tuple[Path, ...],
    model: int | None,
    estimator: str,
    payload: tuple[str, ...],
    urdf: Path | None,
    base: str | None,
    tip: str | None,
    tilt: bool,
    without: tuple[str, ...],
    essential: bool,
    test: tuple[Path, ...],
    settings: str | None,
    out: Path | None,
    results: Path | None,
    as_json: bool,
    **known: Any,
) -> None:
    """Estimate the base parameters of an arm from its SESSIONS, stacked.

    A session is a log of this program, a ROS 2 bag with sensor_msgs/JointState, or, with --urdf, a CSV, NPZ or
    MATLAB file or a folder of text files: its columns are guessed by their names and shown for confirmation. The
    guessed mapping and the session log are written beside the results.

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
    lwr-run identify data.csv --urdf arm.urdf --results first      another arm, columns guessed
    """
    # Imported on use: the help page needs none of them.
    from ident.dynamics.session_chain import session_chain
    from ident.estimation.identify import known_settings
    from ident.estimation.validate import validate
    from ident.model.model_file import write_model
    from ident.rows.content import Recall
    from runner.ending import of_estimate, of_folder
    from runner.estimation import (
        IdentifySettings,
        announced,
        check_spans,
        named_model,
        of_file,
    )

    file = Path(settings or "settings")
    read = IdentifySettings() if settings is None else IdentifySettings.load(settings)
    wanted = read.identification(model or 2, estimator, file=file)
    wanted = replace(wanted, without=(*wanted.without, *without))
    if essential and wanted.essential is None:
        raise ConfigurationError(
            f"--essential needs the essential parameters, and {settings} has `essential: null`; leave one out"
        )
    if results is not None:
        new_folder(results)
    folder = results if results is not None else Path() if out is None else out.parent
    status = StatusLine()
    logs = read_recordings((*sessions, *test), urdf=urdf, folder=folder, base=base, tip=tip, **known)
    logs = announced(logs, payload, (*sessions, *test))
    logs, tested = logs[: len(sessions)], logs[len(sessions) :]
    chain = session_chain(logs[0], urdf, base=base, tip=tip)
    wanted = known_settings(logs, chain, wanted, model=model)
    check_spans(logs, wanted, file)
    status.show("estimating the model")
    recall = Recall()
    with of_file(settings):
        found, mounting = _estimate(logs, chain, wanted, estimator, tilt=tilt, recall=recall)
    result = named_model(
        found.essential_model if essential else found.model, logs[0].metadata.get("robot", "") or "arm"
    )
    content, tables = found.to_dict(), found.pieces()
    if mounting is not None:
        content["mounting"] = mounting.to_dict()
        tables += ["", f"{mounting}"]
    # The model first: nothing in a test session may cost it.
    if out is not None:
        write_model(result, out)
    status.show("testing the model")
    if results is None or as_json:
        scored = validate(result, logs, allow_seen=True, keep_going=True, known=found.known, recall=recall)
        fit = scored.to_dict()
        content |= {"fit": fit["sessions"], "unscored": fit["unscored"]}
    validation = None
    if tested:
        validation = validate(result, tested, keep_going=True)
        whole = validation.to_dict()
        content |= {"validation": whole["sessions"], "validation_warnings": whole["warnings"]}
        content["unscored"] = [*content.get("unscored", ()), *whole["unscored"]]
        tables += ["", *validation.pieces()]
    page = None
    if results is not None:
        from runner.results import write_log_results

        status.show("writing the report")
        page = write_log_results(results, found, logs, tested, result, text=text_of(tables))
    status.clear()
    if as_json:
        hold_json(content)
    elif results is not None:
        of_folder(results, page, tables).tell()
    else:
        of_estimate(content, out, tables).tell()
    if validation is not None:
        validation.require_all()


def _estimate(
    logs: Sequence[Session],
    chain: Chain,
    wanted: IdentificationSettings,
    estimator: str,
    *,
    tilt: bool,
    recall: Recall,
) -> tuple[Identification, Mounting | None]:
    """The estimate, and the tilt of the base where it was asked for; `auto` has its own in its choice."""
    if estimator == AUTO:
        from ident.estimation.automatic import choose

        return choose(logs, chain, wanted, tilt=tilt or None, recall=recall), None
    if tilt:
        from ident.estimation.mounting import find_mounting

        mounting = find_mounting(logs, chain, wanted)
        return mounting.identification, mounting
    from ident.estimation.identify import identify

    return identify(logs, chain, wanted, recall=recall), None
