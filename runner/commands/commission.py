"""`lwr-run commission`: a healthy-arm baseline for later diagnoses."""

from __future__ import annotations

from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Any

import click

from lwr_driver.listing import Listing, Piece
from runner.output import OUTPUT_FILE
from runner.terminal import (
    NAMED_FILE,
    PATH,
    arm_options,
    default_file,
    json_option,
    to_json,
    verb,
    verbosity,
)

if TYPE_CHECKING:
    from ident.diagnosis import Reference
    from runner.ending import Ending
    from runner.experiment_file import Experiment


_RECORDED_SETS = 3
_LOUDEST = 5
_RIGID = (
    "taken as the links', for no stiffness is given (`--stiffness`) and the sets show no twist of the joints"
)
_FIRST_SEED = 1001
"""Seed of the emulator's noise in the first set; other runs begin at 1, so no noise comes twice."""


@verb("commission")
@click.argument("sessions", nargs=-1, type=PATH)
@click.option(
    "--experiment",
    "file",
    type=NAMED_FILE,
    help="Experiment whose sessions are recorded; default: experiment.yaml here, else on the emulator.",
)
@click.option(
    "--sets",
    type=click.IntRange(1),
    help="Number of sets: to record (default 3), or in SESSIONS, set after set (default 1).",
)
@click.option("--out", required=True, type=OUTPUT_FILE, help="Model file of the healthy arm.")
@arm_options
@click.option("--yes", is_flag=True, help="Confirm every question; for automation.")
@click.option(
    "--allow-non-realtime", is_flag=True, help="Command the real arm without real-time rights; may stutter."
)
@json_option
def command(
    sessions: tuple[Path, ...],
    file: str | None,
    sets: int | None,
    out: Path,
    arm: str | None,
    urdf: Path | None,
    coupling: tuple[str, ...],
    gear_ratio: str | None,
    stiffness: str | None,
    yes: bool,
    allow_non_realtime: bool,
    as_json: bool,
) -> None:
    """Record a healthy-arm baseline: parameters, stiffness, delays, noise, and the gains of causes by chance.

    Without SESSIONS an experiment is recorded first, set after set, beside the file of --out. Each set should equal
    the input of a later diagnosis, at best from another day. One set is a beginning, three separate chance from
    causes, eight are good.

    \b
    lwr-run commission --out commissioned.yaml                          on the emulator
    lwr-run commission --experiment my_lab.yaml --sets 3 --out commissioned.yaml
    lwr-run commission u1.mcap l1.mcap u2.mcap l2.mcap --sets 2 --out commissioned.yaml
    """
    from fri.errors import ConfigurationError
    from ident.diagnosis import commission
    from ident.dynamics.known_arm import known_arm
    from ident.import_log import read_recording
    from runner.diagnosis import arm_data, chain_of
    from runner.experiment_file import Experiment
    from runner.files import locked
    from runner.status import StatusLine

    if sessions and file is not None:
        raise ConfigurationError(
            "--experiment records sessions, and SESSIONS are there already; leave one out"
        )
    if sessions:
        count = sets or 1
        if len(sessions) % count:
            raise ConfigurationError(
                f"{len(sessions)} sessions do not make {count} sets of equal size; give them set after set"
            )
        size = len(sessions) // count
        paths = [list(sessions[k : k + size]) for k in range(0, len(sessions), size)]
    else:
        experiment = Experiment.commanded(file or default_file(), implied=file is None)
        folder, count = out.with_name(f"{out.stem}_sessions"), sets or _RECORDED_SETS
        folder.mkdir(parents=True, exist_ok=True)
        click.get_current_context().with_resource(locked(folder))
        paths = record_sets(experiment, folder, count, assume_yes=yes, allow_non_realtime=allow_non_realtime)
    status = StatusLine()
    status.show("estimating the healthy arm")
    parts = [[read_recording(path, status=False) for path in part] for part in paths]
    chain = chain_of(parts[0], urdf)
    data = arm_data(known_arm(chain, arm), chain, coupling, gear_ratio, stiffness)
    found = commission(parts, chain, arm=data)
    status.clear()
    found.save(out)
    if as_json:
        click.echo(to_json(_content(found, paths, out)))
    else:
        stated = data.stiffness is not None
        _ending(found, len(parts), sum(map(len, parts)), chain.joint_names, out, stated=stated).tell()


def record_sets(
    experiment: Experiment,
    folder: Path,
    sets: int,
    *,
    assume_yes: bool = False,
    allow_non_realtime: bool = False,
) -> list[list[Path]]:
    """Logs of `sets` sets in `folder/set_K`, each with all sessions of the experiment but those for validation.

    Finished sessions are not run again. Raises OperatorError for an abort, RobotError or the error of a failure.
    """
    from fri.errors import ConfigurationError, OperatorError, RobotError
    from lwr_driver.arm import Arm
    from lwr_driver.arm.cell import Cell
    from lwr_driver.references import Frozen
    from runner.experiment import ExperimentProgress, Run
    from runner.files import begin, check_finished, gather, go_on, listed
    from runner.laboratory import Laboratory
    from runner.planning import Excitations
    from runner.status import StatusLine

    frozen = Frozen(folder.resolve())
    remarks: list[str] = []
    if frozen.there:
        given = experiment.text
        experiment, remarks = go_on(folder.resolve())
        if experiment.text != given:
            raise ConfigurationError(
                f"{folder} was recorded with another experiment file; choose another --out"
            )
    else:
        references = gather(experiment)
        folder.mkdir(parents=True, exist_ok=True)
        experiment = begin(experiment, references, folder.resolve())
    arm = Arm.load(experiment.arm, beside=experiment.folder)
    cell = Cell.load(experiment.cell, beside=experiment.folder)
    status = StatusLine()
    status.say(
        "\n".join([listed(frozen.files()) if verbosity() else f"files frozen in {frozen.folder}", *remarks])
    )
    motions = Excitations.of(experiment, arm, cell, folder)
    motions.save(folder)
    found = []
    for number in range(sets):
        place = folder / f"set_{number + 1}"
        place.mkdir(parents=True, exist_ok=True)
        if not (place / "progress.json").is_file():
            ExperimentProgress.create(place, experiment.folder)
        check_finished(_of_set(experiment, number), place)
        status.say(f"set {number + 1} of {sets}")
        one = _of_set(experiment, number)
        laboratory = Laboratory(
            one, assume_yes=assume_yes, allow_non_realtime=allow_non_realtime, status=status
        )
        with laboratory as bench:
            records = Run(one, place, bench, motions.rows).sessions()
        last = records[-1]
        if last.status != "success":
            text = f"set {number + 1}, session {last.name}: {last.reason}; the same command goes on from here"
            if last.status == "abort":
                raise OperatorError(text)
            raise RobotError(text) if last.error is None else type(last.error)(text)
        found.append([record.path for record in records])
    return found


def _of_set(experiment: Experiment, number: int) -> Experiment:
    """The experiment with its own noise and without the sessions for validation."""
    settings = dict(experiment.emulator_settings)
    settings["seed"] = int(settings.get("seed", 0)) + _FIRST_SEED + number
    sessions = tuple(session for session in experiment.sessions if not session.validation)
    return experiment.changed(emulator_settings=settings, sessions=sessions)


def _content(found: Reference, paths: list[list[Path]], out: Path) -> dict[str, Any]:
    stored = next(iter(found.stored().values()))
    return {"file": out, "sets": paths, **{k: v for k, v in stored.items() if k != "sets"}}


def _percent(std: float, compliance: float) -> str:
    """Standard error of a compliance in percent. Beyond that of a stated one it is none."""
    from ident.diagnosis.healthy.bench import UNSURE

    if not (std > 0.0 and compliance > 0.0):
        return "–"
    return "unknown" if std >= UNSURE * compliance else f"{100.0 * std / compliance:.0f}"


def _ending(
    found: Reference, sets: int, sessions: int, names: tuple[str, ...], out: Path, *, stated: bool
) -> Ending:
    from runner.ending import Ending
    from runner.report.verdicts import Verdict

    rows: list[tuple[str, ...]] = []
    if (found.compliance > 0.0).any():
        rows.append(("stiffness [Nm/rad]", *(f"{1.0 / c:.0f}" if c else "rigid" for c in found.compliance)))
        if found.compliance_std is not None:
            known = zip(found.compliance_std, found.compliance, strict=True)
            rows.append(("  ± [%]", *(_percent(std, c) for std, c in known)))
    rows += [(f"noise, {side} [Nm]", *(f"{v:.4f}" for v in values)) for side, values in found.noise.items()]
    delays = [
        (f"{side} torque", f"{1e3 * delay:.2f} ± {1e3 * found.delay_std_s[side]:.2f} ms from day to day")
        for side, delay in (("motor", found.motor_delay_s), ("joint", found.joint_delay_s))
        if side in found.noise
    ]
    elastic = bool((found.compliance > 0.0).any())
    # Without the kinds of nameless functions, of which each is at most that of any.
    whole = [item for item in found.null.items() if " " not in item[0][0]]
    loudest = sorted(whole, key=lambda item: -item[1])[:_LOUDEST]
    listed = ", ".join(
        f"{cause}{f' {names[joint]}' if joint >= 0 else ''} {gain:.0f}" for (cause, joint), gain in loudest
    )
    tables: list[Piece] = [
        Listing(("", *names), rows),
        "",
        f"largest gains of causes by chance, mean of the sets (fall of chi-square): {listed}",
    ]
    look: list[Verdict] = []
    if sets < _RECORDED_SETS:
        text = (
            f"{sets} set{'s say' if sets > 1 else ' says'} little about changes from day to day; with "
            f"{_RECORDED_SETS} or more a diagnosis claims more and errs less"
        )
        look.append(Verdict("few sets", text, "", "look"))
    if unknown := ", ".join(found.unknown_stiffness):
        held = stated and found.encoder == "motor"
        held_to = "held to the stated one within a factor of two; " if held else ""
        mend = (
            "more sets, or faster motions"
            if len(found.noise) > 1
            else "joint torques beside the motors' tell it"
        )
        text = f"the sets do not tell it within 20 % in {unknown}; {held_to}{mend}"
        look.append(Verdict("stiffness unknown", text, "", "look"))
    return Ending(
        "look" if look else "good",
        f"The healthy arm, from {sessions} sessions in {sets} set{'s' if sets > 1 else ''}.",
        [
            *((f"delay of the {name}", value) for name, value in delays),
            ("positions", f"of the {found.encoder}s" if elastic else _RIGID),
        ],
        look,
        ["An experiment compares itself with it by `diagnosis: {reference: FILE}` in its file."],
        f"lwr-run diagnose SESSIONS --reference {quote(str(out))} --out diagnosis",
        tables,
        tables[:1],
    )
