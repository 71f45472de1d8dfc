"""Recording what a healthy arm is like: an experiment's sessions, set after set."""

from __future__ import annotations

from pathlib import Path

from fri.errors import OperatorError, RobotError
from lwr_driver.arm import Arm
from lwr_driver.arm.cell import Cell
from runner.experiment import Progress, Run
from runner.experiment_file import Experiment
from runner.laboratory import Laboratory
from runner.planning import Excitations
from runner.terminal import StatusLine

__all__ = ["record_sets"]

_FIRST_SEED = 1001
"""Seed of the emulator's noise in the first set; other runs begin at 1, so that no noise comes twice."""


def record_sets(
    experiment: Experiment,
    folder: Path,
    sets: int,
    *,
    assume_yes: bool = False,
    allow_non_realtime: bool = False,
) -> list[list[Path]]:
    """Logs of `sets` sets in `folder/set_K`, each with the sessions of the experiment that are estimated from.

    What is finished there is not run again. Raises OperatorError for an abort, RobotError or what stopped it for
    a failure.
    """
    arm = Arm.load(experiment.arm, beside=experiment.folder)
    cell = Cell.load(experiment.cell, beside=experiment.folder)
    status = StatusLine()
    motions = Excitations.of(experiment, arm, cell)
    found = []
    for number in range(sets):
        place = folder / f"set_{number + 1}"
        place.mkdir(parents=True, exist_ok=True)
        if not (place / "progress.json").is_file():
            Progress.create(place, experiment.folder)
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
    """The experiment with its own noise and without the sessions that only validate."""
    settings = dict(experiment.emulator_settings)
    settings["seed"] = int(settings.get("seed", 0)) + _FIRST_SEED + number
    sessions = tuple(session for session in experiment.sessions if not session.validation)
    return experiment.changed(emulator_settings=settings, sessions=sessions)
