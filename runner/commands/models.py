"""Commands for identified models: validate, compare, payload, export."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import click

from runner.file_names import MODEL
from runner.output import OUTPUT_FILE
from runner.status import answer
from runner.terminal import NAMED_FILE, PATH, FiniteRange, forced, json_option, to_json, verb


@verb("validate")
@click.argument("model", type=PATH)
@click.argument("sessions", nargs=-1, required=True, type=PATH)
@json_option
@click.option("--allow-seen", is_flag=True, help="Accept sessions of the estimate; their scores are marked.")
@click.option(
    "--against", multiple=True, type=PATH, metavar="MODEL", help="Another model to compare (repeatable)."
)
@click.option(
    "--payload",
    multiple=True,
    metavar="FILE=NAME[:KG]",
    help="Payload of a session by its name in the model, in place of its metadata.",
)
@click.option("--forward", is_flag=True, help="Simulate along the commanded motion too.")
@click.option("--cross", is_flag=True, help="Cross-validate over the sessions too.")
@click.option(
    "--settings",
    type=NAMED_FILE,
    metavar="FILE",
    help="Settings of `identify`; its `signals` replace those of the model.",
)
@click.option(
    "--estimate-delay", is_flag=True, help="Estimate the motor channel's delay anew in each session."
)
def validate_command(
    model: Path,
    sessions: tuple[Path, ...],
    as_json: bool,
    allow_seen: bool,
    against: tuple[Path, ...],
    payload: tuple[str, ...],
    forward: bool,
    cross: bool,
    settings: str | None,
    estimate_delay: bool,
) -> None:
    """Test MODEL on SESSIONS it was not fitted to: torque residuals per joint and side.

    The signals are filtered as for the estimate of MODEL, and its delay of the motor channel is taken. Competitors
    are scored as well: the controller's own mass matrix and gravity (logged through FRI), the inertials of the URDF,
    other models. A session of the model's own estimate is refused.

    \b
    lwr-run validate model.yaml check.mcap
    lwr-run validate model.yaml a.mcap b.mcap --against old.yaml --forward --json
    """
    from ident.estimation.compare import competitor_scores
    from ident.estimation.forward_simulation import simulate_session
    from ident.estimation.identification import IdentificationSettings
    from ident.estimation.validate import cross_validate, signals_for, validate
    from ident.import_log import read_recording
    from ident.model.model_file import read_model
    from runner.ending import of_validation
    from runner.estimation import IdentifySettings, announced

    tested = read_model(model)
    logs = announced([read_recording(path, status=False) for path in sessions], payload, sessions)
    signals = None if settings is None else IdentifySettings.load(settings).signals
    if estimate_delay:
        signals = signals_for(tested, signals, estimate_delay=True)
    result = validate(tested, logs, settings=signals, allow_seen=allow_seen)
    others = {str(path): read_model(path) for path in against}
    result = replace(result, competitors=competitor_scores(tested, logs, settings=signals, others=others))
    content: dict[str, Any] = result.to_dict()
    tables = result.pieces()
    asked: list[tuple[str, str]] = []
    if forward:
        runs = [simulate_session(tested, log, settings=signals) for log in logs]
        content["forward"] = [run.to_dict() for run in runs]
        for run in runs:
            tables += ["", *run.pieces()]
            asked.append(("simulated", f"{run.session}: torque error {100 * run.relative:.2f} %"))
    if cross:
        structure = tested.structure
        keys = ("model", "without", "couplings", "coulomb")
        wanted = IdentificationSettings(**{key: getattr(structure, key) for key in keys})
        if signals is not None:
            wanted = replace(wanted, signals=signals)
        folds = cross_validate(logs, structure.chain, wanted)
        content["cross_validation"] = folds.to_dict()
        tables += ["", *folds.pieces()]
        errors = [max(score.relative.values()) for score in folds.scores]
        left = f", {len(folds.skipped)} skipped" if folds.skipped else ""
        span = f"torque error {100 * min(errors):.2f} to {100 * max(errors):.2f} %" if errors else "no score"
        asked.append(("left out in turn", f"{len(errors)} session{'s' * (len(errors) != 1)}{left}: {span}"))
    if as_json:
        click.echo(to_json(content))
    else:
        of_validation(result, tables, sessions, asked).tell()


@verb("compare")
@click.argument("first", type=PATH)
@click.argument("second", type=PATH)
@json_option
@click.option(
    "--level",
    type=FiniteRange(0.0, 1.0, min_open=True, max_open=True),
    default=0.05,
    show_default=True,
    help="Probability of any false difference.",
)
@click.option("--report", type=OUTPUT_FILE, metavar="HTML", help="Page to write, e.g. comparison.html.")
def compare_command(first: Path, second: Path, as_json: bool, level: float, report: Path | None) -> None:
    """List the significant differences between two models: two robots, two dates, two settings.

    FIRST and SECOND are models, or folders of results with one. Models with different base sets are compared in the
    parameter combinations common to both.

    \b
    lwr-run compare robot_a.yaml robot_b.yaml
    lwr-run compare monday friday --report comparison.html    two runs, as a page
    """
    from ident.estimation.compare import compare
    from ident.model.model_file import read_model
    from runner.ending import of_comparison

    labels = (f"{first}", f"{second}")
    paths = [path / MODEL if path.is_dir() else path for path in (first, second)]
    models = [read_model(path) for path in paths]
    result = compare(*models, level=level, labels=labels)
    page = None
    if report is not None:
        from runner.report.comparison import ComparedModel, comparison_html
        from runner.report.page import write_page

        pair = ComparedModel.both((first, second), (models[0], models[1]))
        page = write_page(comparison_html(result, models[0].structure.chain.joint_names, pair), report)
    if as_json:
        click.echo(to_json(result.to_dict()))
    else:
        of_comparison(result, (first, second), page).tell()


@verb("payload")
@click.argument("model", type=PATH)
@click.argument("sessions", nargs=-1, required=True, type=PATH)
@click.option("--free-offsets", is_flag=True, help="Estimate the torque offsets anew.")
@click.option("--out", type=OUTPUT_FILE, metavar="FILE", help="Model file to write, with the payload.")
@json_option
def payload_command(
    model: Path, sessions: tuple[Path, ...], free_offsets: bool, out: Path | None, as_json: bool
) -> None:
    """Estimate mass, centre of mass and inertia of the payload in SESSIONS, with MODEL as the arm.

    The standard deviations include the uncertainty of the arm model. The mass is compared with the announced
    one.

    \b
    lwr-run payload model.yaml loaded.mcap
    lwr-run payload model.yaml loaded.mcap --out with_payload.yaml
    """
    from ident.estimation.payload import identify_payload, with_payload
    from ident.import_log import read_recording
    from ident.model.model_file import read_model, write_model
    from runner.ending import of_payload

    arm = read_model(model)
    found = identify_payload(arm, [read_recording(path) for path in sessions], free_offsets=free_offsets)
    if out is not None:
        write_model(with_payload(arm, found), out)
    if as_json:
        click.echo(to_json(found.to_dict()))
    else:
        of_payload(found, model, sessions, out, arm.structure.payloads).tell()


@verb("export")
@click.argument("model", type=PATH)
@click.argument("outputs", nargs=-1, required=True, type=OUTPUT_FILE)
@click.option("--payload", help="Payload of the model to mount; default: the bare arm.")
@click.option("--name", default="arm", show_default=True, help="Name in the file; prefix of the C functions.")
@json_option
def export_command(
    model: Path, outputs: tuple[Path, ...], payload: str | None, name: str, as_json: bool
) -> None:
    """Write a model in other formats, chosen by the endings of OUTPUTS.

    \b
    .urdf  URDF: consistent inertials, damping and friction
    .xml   MJCF (MuJoCo): the same with drive inertia as armature
    .c     C99 inverse dynamics without dependencies
    .py    numpy inverse dynamics

    URDF and MJCF need physically consistent bodies. Unidentifiable parameters come from the arm's own URDF; an
    inconsistent estimate is replaced by the nearest consistent body, with a note. C and numpy also hold those effects
    of an extended model that follow from the present motion.

    \b
    lwr-run export results/model.yaml lwr.urdf lwr.xml lwr.c lwr.py
    """
    from ident.formats import FORMATS, export

    done = export(model, *outputs, payload=payload, name=name, overwrite=forced())
    if as_json:
        files = [{"file": output, "format": FORMATS[output.suffix]} for output in outputs]
        click.echo(to_json({"files": files, "title": done.title, "notes": done.notes}))
        return
    answer(
        *(f"{output}: {FORMATS[output.suffix]}, {done.title}" for output in outputs),
        *(f"  {note}" for note in done.notes),
    )
