"""`lwr-run experiment`: plan, drive, log, swap the payload, estimate."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

from fri.errors import ConfigurationError, DataError, LwrError, OperatorError, RobotError
from lwr_driver.listing import text_of
from runner.output import NEW_FOLDER, new_folder
from runner.status import StatusLine, next_step
from runner.terminal import NAMED_FILE, default_file, hold_json, json_option, tell, verb, verbosity

# Everything else is imported on use: the help page needs none of it.
if TYPE_CHECKING:
    from lwr_driver.arm import Arm
    from runner.experiment import Bench, Record
    from runner.experiment_file import Experiment
    from runner.planning import Excitations


@verb("experiment")
@click.argument("file", required=False, type=NAMED_FILE)
@click.option("--out", type=NEW_FOLDER, help="Folder of the results; default: experiments/NAME-STAMP.")
@click.option("--yes", is_flag=True, help="Confirm every question; for automation.")
@click.option(
    "--resume",
    type=click.Path(path_type=Path),
    metavar="FOLDER",
    help="Continue the aborted experiment in FOLDER.",
)
@click.option(
    "--allow-non-realtime", is_flag=True, help="Command a real arm without real-time rights; may stutter."
)
@click.option("--live", is_flag=True, help="Show arm, torques, link and remaining time in the browser.")
@click.option(
    "--live-port", default=8080, show_default=True, type=click.IntRange(1, 65535), help="Of --live."
)
@click.option("--no-diagnosis", is_flag=True, help="Omit the diagnosis of model errors.")
@click.option("--decide", is_flag=True, help="Run the discriminating experiments for look-alike causes.")
@click.option(
    "--replan",
    type=click.IntRange(min=0),
    metavar="N",
    help="N further rounds, planned with the estimate so far.",
)
@click.option(
    "--hide",
    type=click.IntRange(min=0),
    metavar="SEED",
    help="Hide an effect, drawn from SEED, in the emulated arm; the report shows what is found of it.",
)
@click.option(
    "--reveal",
    is_flag=False,
    flag_value="",
    type=click.Path(),
    metavar="[FOLDER]",
    help="Show the effect hidden in the run of FOLDER (default: the latest) beside the findings.",
)
@json_option
def command(
    file: str | None,
    out: Path | None,
    yes: bool,
    resume: Path | None,
    allow_non_realtime: bool,
    live: bool,
    live_port: int,
    no_diagnosis: bool,
    decide: bool,
    replan: int | None,
    hide: int | None,
    reveal: str | None,
    as_json: bool,
) -> None:
    """Run the experiment FILE; by default against the built-in emulator.

    Plans and checks an exciting motion, drives the arm and logs it, has the payload swapped and checked, drives
    again, estimates the model, and diagnoses its errors. Ends with the verdict, its numbers, and the command that
    opens the report; report.txt and --verbose have the tables.

    Without FILE it takes the experiment.yaml of `lwr-run init` in this folder, else the default experiment. A real arm
    moves only if you name its FILE.

    Ctrl-C once stops the arm within its limits, twice drops the link.

    \b
    lwr-run experiment                                   the default, on the emulator
    lwr-run experiment my_lab.yaml --out results/monday
    lwr-run experiment --resume results/monday           go on after an abort
    lwr-run experiment --resume results/monday --decide  discriminate between look-alikes
    lwr-run experiment my_lab.yaml --replan 1            a second round, planned with the first
    lwr-run experiment --hide 7                          something is wrong with the emulated arm
    lwr-run experiment --reveal                          what it was, beside the findings
    """
    if reveal is not None:
        if file is not None or out is not None or resume is not None or hide is not None:
            raise ConfigurationError("--reveal shows a finished run; leave FILE, --out, --resume and --hide")
        _reveal(Path(reveal) if reveal else None, as_json)
        return
    from lwr_driver.arm import Arm
    from lwr_driver.arm.cell import Cell
    from lwr_driver.references import Frozen
    from runner.ahead import import_ahead
    from runner.ending import of_folder
    from runner.experiment import Run
    from runner.laboratory import Laboratory
    from runner.planning import Excitations
    from runner.replanning import Rounds, rounds_begun
    from runner.results import estimate, held_out_errors, summarise, write_results, write_text

    status, ahead = StatusLine(), None
    experiment, folder = _begin(file, out, resume, hide, replan or 0, status)
    arm = Arm.load(experiment.arm, beside=experiment.folder)
    cell = Cell.load(experiment.cell, beside=experiment.folder)
    status.show("checking the planned motion" if experiment.excitation.plan else "planning the excitation")
    motions = Excitations.of(experiment, arm, cell, folder)
    status.clear()
    motions.save(folder)
    experiment = _sealed(experiment, arm, motions, folder, hide)
    laboratory = partial(Laboratory, assume_yes=yes, allow_non_realtime=allow_non_realtime, status=status)
    with laboratory(experiment) as bench, _watched(bench, experiment, live_port if live else None) as watched:
        if experiment.hosted and experiment.diagnosis.run and not no_diagnosis:
            ahead = import_ahead("runner.diagnosis.after_run", "runner.report.page")
        first = Run(experiment, folder, watched, motions.rows)
        rounds = max(experiment.replan.rounds if replan is None else replan, rounds_begun(folder))
        records = Rounds(experiment, arm, cell, folder, status).run(first, first.sessions(), rounds)
    done = all(record.status == "success" for record in records)
    if done:
        status.show("estimating the model")
    found = estimate(experiment, arm, records, status.say) if done else None
    with remarked(status, failed=not done):
        summary = summarise(experiment, records, found)
        summary["files"] = [dataclasses.asdict(file) for file in Frozen(folder).files()]
        tables = write_results(folder, experiment, arm, summary, found)
        if found is not None:
            status.say(held_out_errors(summary, folder))
        more, advice = [], []
        if done and experiment.diagnosis.run and not no_diagnosis:
            if ahead is not None:
                ahead.join()
            from runner.diagnosis.after_run import conclude_run

            status.show("diagnosing model errors")
            concluded = conclude_run(
                experiment, arm, cell, motions, folder, records, laboratory=laboratory, decide=decide
            )
            summary |= concluded.to_dict()
            tables += concluded.pieces(folder)
            more = [] if concluded.study is None else [concluded.study.said.headline]
            advice = concluded.advice(folder)
        if experiment.sealed:
            advice.append(
                f"An effect is hidden in the emulated arm; `lwr-run experiment --reveal {folder}` shows it."
            )
        write_text(folder / "report.txt", text_of(tables))
        status.show("writing the report")
        page = _page(folder, status)
        status.clear()
        if as_json:
            hold_json({**summary, "folder": str(folder)})
        else:
            of_folder(folder, page, tables, more, advice).tell()
    if not done:
        raise _failure(records[-1], folder)
    if summary.get("unscored"):
        raise DataError(
            "; ".join(f"{one['session']} was not scored: {one['reason']}" for one in summary["unscored"])
        )


def _page(folder: Path, status: StatusLine) -> Path | None:
    """The report of a folder, None with a message where it cannot be written."""
    from runner.report.page import write_report

    try:
        return write_report(folder)
    except LwrError as error:
        status.say(f"no report.html: {error}")
        return None


@contextmanager
def remarked(status: StatusLine, *, failed: bool) -> Iterator[None]:
    """After a failed session, an error of its report is a remark beside the failure, such as the full disk of both."""
    try:
        yield
    except (LwrError, OSError) as error:
        if not failed:
            raise
        status.clear()
        status.say(f"no report: {error}")


@contextmanager
def _watched(bench: Bench, experiment: Experiment, port: int | None) -> Iterator[Bench]:
    if port is None:
        yield bench
        return
    from runner.live import LiveView

    with LiveView(experiment, bench.driver.ring_name, port=port) as view:
        bench.status.say(f"live view: {view.url}")
        yield dataclasses.replace(bench, onlooker=view)


def _sealed(
    experiment: Experiment, arm: Arm, motions: Excitations, folder: Path, seed: int | None
) -> Experiment:
    """The experiment with its hidden effect: drawn now, or in an earlier run of the folder."""
    from runner.hiding.effect import HiddenEffect, with_effect

    effect = HiddenEffect.unseal(folder)
    if effect is None:
        if seed is None:
            return experiment
        from runner.hiding.draw import draw_effect

        effect = draw_effect(seed, experiment, arm, motions)
        effect.seal(folder)
    return with_effect(experiment, effect)


def _reveal(folder: Path | None, as_json: bool) -> None:
    from runner.ending import open_page
    from runner.hiding.reveal import hidden_run, reveal

    status = StatusLine()
    folder = hidden_run(folder)
    shown = reveal(folder)
    shown.save(folder)
    status.show("writing the report")
    page = _page(folder, status)
    status.clear()
    tell(shown, as_json)
    if page is not None and not as_json:
        next_step(open_page(page))


def _begin(
    file: str | None, out: Path | None, resume: Path | None, hide: int | None, rounds: int, status: StatusLine
) -> tuple[Experiment, Path]:
    """The experiment of frozen files and its folder, held until the end of the command."""
    from runner.experiment_file import Experiment
    from runner.files import begin, gather, go_on, locked

    context = click.get_current_context()
    if resume is not None:
        if file is not None or out is not None or hide is not None:
            raise ConfigurationError(
                "--resume takes its experiment file, folder and hidden effect from FOLDER; leave FILE, --out and "
                "--hide"
            )
        if not resume.is_dir():
            raise ConfigurationError(
                f"{resume} is no folder and holds no experiment.yaml; name the folder of an aborted experiment"
            )
        context.with_resource(locked(resume))
        experiment, remarks = go_on(resume.resolve(), rounds=rounds)
        _tell_files(status, resume, remarks)
        return experiment, resume
    experiment = Experiment.commanded(file or default_file(), implied=file is None)
    if hide is not None:
        from runner.hiding.effect import emulated_arm

        emulated_arm(experiment)
    stamp = datetime.now().astimezone().strftime("%Y%m%d-%H%M%S")
    folder = out if out is not None else Path("experiments") / f"{experiment.name}-{stamp}"
    references = gather(experiment, rounds)
    new_folder(folder, "choose another --out, or go on there with --resume")
    context.with_resource(locked(folder))
    experiment = begin(experiment, references, folder.resolve())
    _tell_files(status, folder)
    return experiment, folder


def _tell_files(status: StatusLine, folder: Path, remarks: Sequence[str] = ()) -> None:
    """Name the experiment and its folder; `--verbose` lists its files with their hashes."""
    from lwr_driver.references import Frozen
    from runner.files import listed

    files = Frozen(folder).files()
    status.say(listed(files) if verbosity() else f"experiment {_short(files[0].path)}, results in {folder}")
    for remark in remarks:
        status.say(remark)


def _short(path: Path) -> Path:
    """The path within the working folder or this software, else the whole."""
    from lwr_driver.configuration import CONFIGS

    for folder in (Path.cwd(), CONFIGS.parent):
        if path.is_relative_to(folder):
            return path.relative_to(folder)
    return path


def _failure(record: Record, folder: Path) -> LwrError:
    text = f"session {record.name}: {record.reason}. `lwr-run experiment --resume {folder}` goes on from here"
    if record.status == "abort":
        return OperatorError(text)
    return type(record.error)(text) if record.error is not None else RobotError(text)
