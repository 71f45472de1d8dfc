"""`lwr-run diagnose`: errors of the model by cause and joint."""

from __future__ import annotations

from pathlib import Path

import click

from runner.output import OUTPUT_FOLDER
from runner.terminal import (
    PATH,
    GroupedCommand,
    arm_options,
    hold_json,
    json_option,
)

_GROUPS = {
    "Sessions": ("test", "model", "reference"),
    "Arm": ("arm", "urdf", "coupling", "gear_ratio", "stiffness"),
}


@click.command("diagnose", cls=GroupedCommand, groups=_GROUPS)
@click.argument("sessions", nargs=-1, required=True, type=PATH)
@click.option(
    "--test",
    multiple=True,
    type=PATH,
    metavar="SESSION",
    help="Held-out session, never fitted (repeatable).",
)
@click.option("--model", type=PATH, help="Present model, replayed beside the extended one.")
@click.option("--reference", type=PATH, help="Healthy-arm baseline of `lwr-run commission`.")
@click.option("--out", required=True, type=OUTPUT_FOLDER, help="Folder of the results.")
@arm_options
@click.option(
    "--compare",
    nargs=2,
    multiple=True,
    metavar="CAUSE:JOINT CAUSE:JOINT",
    help="Put two causes side by side, with their overlap and the discriminating experiment (repeatable).",
)
@click.option("--no-simulation", is_flag=True, help="Leave out the replay of the sessions.")
@click.option(
    "--jobs",
    type=click.IntRange(-1, 1024),
    default=-1,
    show_default=True,
    help="Threads, with the same results; -1: one a core.",
)
@json_option
def command(
    sessions: tuple[Path, ...],
    test: tuple[Path, ...],
    model: Path | None,
    reference: Path | None,
    out: Path,
    arm: str | None,
    urdf: Path | None,
    coupling: tuple[str, ...],
    gear_ratio: str | None,
    stiffness: str | None,
    compare: tuple[tuple[str, str], ...],
    no_simulation: bool,
    jobs: int,
    as_json: bool,
) -> None:
    """Find errors of the model in SESSIONS, name the causes, and extend the model.

    Writes report.html, diagnosis.json, model_extended.yaml, plots and, for causes that look alike, plans of
    discriminating experiments into the folder of --out. Finding nothing is a result as well.

    One session is enough, but repetition supports more claims: sessions without and with a payload, the same motion
    twice, a --test session on another motion. A missing motor torque, a missing --reference or an earlier low-pass
    limits the claims; the notes at the end list the limits.

    \b
    lwr-run diagnose unloaded.mcap loaded.mcap --out diagnosis
    lwr-run diagnose a.mcap b.mcap --test c.mcap --reference commissioned.yaml --out diagnosis
    lwr-run diagnose a.mcap --compare cable_spring:A4 sensor_ripple:A4 --out diagnosis    can they be told apart?
    lwr-run diagnose tx40.mcap --urdf tx40.urdf --coupling joint_5:joint_6 --out tx40     another arm
    lwr-run diagnose a.mcap --no-simulation --json --out diagnosis    quicker, and for a program
    """
    from fri.errors import ConfigurationError
    from ident.diagnosis.outcome.claims_in_words import SURE
    from ident.dynamics.known_arm import known_arm
    from ident.import_log import read_recording
    from ident.model.model_file import read_model
    from ident.rows.sessions import recorded_couplings
    from runner.diagnosis import arm_data, asked, chain_of, study
    from runner.diagnosis.discriminating import offers_after_logs
    from runner.diagnosis.study import replaceable
    from runner.ending import compared, of_diagnosis
    from runner.replay import attached_experiment
    from runner.report.page import write_diagnosis_report
    from runner.status import StatusLine

    replaceable(out)
    status = StatusLine()
    status.show("diagnosing model errors")
    logs = [read_recording(path, status=False) for path in sessions]
    held = [read_recording(path, status=False) for path in test]
    chain = chain_of(logs, urdf)
    known = known_arm(chain, arm)
    pairs = [(asked(a, chain.joint_names), asked(b, chain.joint_names)) for a, b in compare]
    experiment = next((one for one in map(attached_experiment, logs) if one is not None), None)
    found = study(
        logs,
        chain,
        test=held,
        arm=known,
        data=arm_data(known, chain, coupling or recorded_couplings(logs), gear_ratio, stiffness),
        model=None if model is None else read_model(model),
        reference=None if reference is None else read_model(reference),
        simulate=not no_simulation,
        compare=pairs,
        sure=SURE if experiment is None else experiment.diagnosis.sure,
        jobs=jobs,
    )
    found = found.with_offers(offers_after_logs(found.diagnosis, experiment))
    found.write(out)
    content = {**found.diagnosis.to_dict(), "look_alikes": [pair.to_dict() for pair in found.pairs]}
    status.show("writing the report")
    page = None
    try:
        page = write_diagnosis_report(out)
    except ConfigurationError as error:
        status.say(f"no report.html: {error}")
    status.clear()
    if as_json:
        hold_json(content)
    else:
        asked_for = [compared(pair, chain.joint_names) for pair in found.pairs if not pair.finding]
        of_diagnosis(found.said, page, out, asked_for).tell()
