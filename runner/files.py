"""The files of an experiment: read before anything moves, frozen beside the results, checked on resumption.

A folder of results belongs to one process at a time, by a lock that its end gives back, however it ends.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

from fri.errors import ConfigurationError, DataError, LwrError, RefusedError
from ident.model.model_file import read_model
from lwr_driver.arm import Arm
from lwr_driver.arm.cell import Cell
from lwr_driver.arm.description import enforce_ceilings
from lwr_driver.arm.load import check_load
from lwr_driver.configuration import find
from lwr_driver.places import Place
from lwr_driver.references import Frozen, Reference, UsedFile, freeze, noting, sha256, used
from lwr_driver.session import read_session
from runner.contact import expected_arm
from runner.experiment import ExperimentProgress
from runner.experiment_file import Experiment
from runner.planning import read_plan
from runner.preflight import load_data

COPY = "experiment.yaml"
_LOCK = ".lock"
_MCAP_END = b"\x89MCAP0\r\n"


def examine(experiment: Experiment) -> list[UsedFile]:
    """Read every file that an experiment names, as its run will; returns them with their hashes."""
    return used(experiment.source, gather(experiment))


def gather(experiment: Experiment, rounds: int = 0) -> list[Reference]:
    """Read every file that an experiment names, as its run will.

    Raises ConfigurationError for the first one that cannot be used. rounds : further rounds asked for.
    """
    beside = experiment.folder
    with noting() as found:
        arm = Arm.load(experiment.arm, beside=beside)
        _check_ceilings(experiment, arm)
        _check_home(experiment, arm)
        Cell.load(experiment.cell, beside=beside)
        for payload in experiment.payloads().values():
            check_load(*load_data(arm, payload))
        for plan in (experiment.excitation.plan, experiment.excitation.validation_plan):
            if plan is not None:
                read_plan(find(plan, beside=beside), arm)
        expected_arm(experiment.contact, arm, beside)
        if experiment.diagnosis.reference is not None:
            read_model(find(experiment.diagnosis.reference, beside=beside))
        _examine_problem(experiment, needed=max(rounds, experiment.replan.rounds) > 0)
        if experiment.backend == "emulator":
            _examine_emulator(experiment)
    return found


def _check_ceilings(experiment: Experiment, arm: Arm) -> None:
    """Raise ConfigurationError for a real arm with limits beyond the LWR4+'s, as its driver will."""
    if experiment.backend != "fri":
        return
    try:
        enforce_ceilings(arm)
    except ConfigurationError as error:
        raise ConfigurationError(f"{experiment.arm}: {error}") from error


def _check_home(experiment: Experiment, arm: Arm) -> None:
    """Raise ConfigurationError for a home position outside the limits of the arm."""
    home = experiment.home(len(arm.joint_names))
    for joint, q, low, high in zip(arm.joint_names, home, arm.q_low, arm.q_high, strict=True):
        if not low <= q <= high:
            where = Place.of(experiment.source).line_of("moves").line_of("home")
            raise ConfigurationError(
                f"{where}: moves.home: {joint} {q:.4g} rad is outside {low:.4f} to {high:.4f} rad; choose a position "
                "within the limits"
            )


def _examine_problem(experiment: Experiment, *, needed: bool) -> None:
    """The planning problem of further rounds; without any, one that is missing or broken does no harm."""
    from ident.excitation.problem import PlanProblem

    try:
        PlanProblem.load(find(experiment.replan.problem, beside=experiment.folder))
    except ConfigurationError:
        if needed:
            raise


def _examine_emulator(experiment: Experiment) -> None:
    from sim_backend.configuration import load_configuration
    from sim_backend.rehearsal import rehearse

    settings = {"fri.program": experiment.link.handshake, **experiment.emulator_settings}
    rehearse(load_configuration(experiment.emulator_path, settings))


def begin(experiment: Experiment, references: list[Reference], folder: Path) -> Experiment:
    """Freeze the files of an experiment in the folder of its results; returns the experiment of the frozen files.

    references : of `gather`. Raises ConfigurationError if the folder cannot be written.
    """
    try:
        freeze(experiment.source, references, folder)
        shutil.copyfile(experiment.source, folder / COPY)
        ExperimentProgress.create(folder, experiment.folder)
    except OSError as error:
        raise ConfigurationError(
            f"{folder} cannot be written: {error.strerror}; choose another --out"
        ) from error
    return Experiment.load(Frozen(folder).root())


def go_on(folder: Path, *, rounds: int = 0) -> tuple[Experiment, list[str]]:
    """The experiment of the frozen files in `folder`, checked as at its start, and remarks on edited originals.

    Raises ConfigurationError for a frozen file that changed or, with a real arm, an original that did, and DataError
    for a finished log that is broken or another one.
    """
    frozen = Frozen(folder)
    if not (folder / COPY).is_file():
        raise ConfigurationError(f"{folder} holds no {COPY}; name the folder of an aborted experiment")
    if not frozen.there:
        raise ConfigurationError(
            f"{folder} holds no frozen files; it is of an earlier version of this software. Start a new experiment"
        )
    frozen.check()
    root = frozen.root()
    if sha256(folder / COPY) != sha256(root):
        raise ConfigurationError(
            f"{folder / COPY} changed since the start of the experiment; put it back ({root} is a copy), or start a "
            "new experiment"
        )
    experiment = Experiment.load(root)
    gather(experiment, rounds)
    edited = [str(file.path) for file in frozen.edited()]
    if edited and experiment.backend == "fri":
        raise ConfigurationError(
            f"{', '.join(edited)} changed since the start of the experiment, so the arm or its surroundings may have; "
            f"put it back (copies in {root.parent.parent}), or start a new experiment"
        )
    check_finished(experiment, folder)
    return experiment, [
        f"{path} changed since the start of the experiment; it goes on with the copy of then"
        for path in edited
    ]


def check_finished(experiment: Experiment, folder: Path) -> None:
    """Raise DataError unless every finished log is readable, whole, not empty and of this experiment."""
    progress = ExperimentProgress.load(folder)
    payloads = {plan.name: plan.payload for plan in experiment.sessions}
    for name in progress.finished:
        path = folder / f"{name}.mcap"
        if not path.exists():
            continue
        advice = f"put the log back, or move it away to drive session {name} again"
        try:
            session = read_session(path, status=False)
        except LwrError as error:
            raise DataError(f"finished session {name}: {error}; {advice}") from error
        metadata, end = session.metadata, session.end or {}
        wanted = {"uid": (progress.attempts.get(name) or ["none"])[-1], "experiment": experiment.name}
        if name in payloads:
            payload = payloads[name]
            wanted["payload"] = "none" if payload is None else payload.name
        samples = len(session.joint)
        with path.open("rb") as stream:
            stream.seek(-len(_MCAP_END), os.SEEK_END)
            closed = stream.read() == _MCAP_END
        if (
            not closed
            or end.get("exit_status") != "success"
            or end.get("samples", str(samples)) != str(samples)
        ):
            raise DataError(f"finished session {name}: {path} is not whole; {advice}")
        if samples < max(1, progress.rows(name)):
            raise DataError(
                f"finished session {name}: {path} has {samples} samples of {progress.rows(name)}; {advice}"
            )
        for key, value in wanted.items():
            if str(metadata.get(key)) != value:
                raise DataError(
                    f"finished session {name}: {path} has {key} {metadata.get(key)!r}, not {value!r}; {advice}"
                )


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold the folder of the results alone; RefusedError while another process holds it."""
    try:
        stream = (folder / _LOCK).open("a+", encoding="utf-8")
    except OSError as error:
        raise ConfigurationError(
            f"{folder} cannot be written: {error.strerror}; choose another folder"
        ) from error
    with stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            stream.seek(0)
            holder = stream.read(40).strip() or "unknown"
            raise RefusedError(
                f"{folder} is in use by process {holder}; wait for its end, or stop it with Ctrl-C in its terminal"
            ) from error
        stream.seek(0)
        stream.truncate()
        stream.write(f"{os.getpid()}\n")
        stream.flush()
        yield


def listed(files: list[UsedFile]) -> str:
    """The files in the form of `sha256sum`."""
    return "\n".join(["files of the experiment, SHA-256 and path:", *(f"  {file}" for file in files)])
