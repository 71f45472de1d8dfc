"""The side of the elastic joints with the published positions, from what is kept beside a session."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable
from pathlib import Path

from fri.errors import LwrError
from ident.diagnosis.healthy.reference import Reference
from ident.dynamics.structure import EncoderSide
from ident.model import DynamicModel
from ident.model.model_file import read_model
from ident.model.signals import positions_of_motors
from lwr_driver.configuration import find
from lwr_driver.references import Frozen
from lwr_driver.session import Session
from runner.experiment_file import Experiment
from runner.replay import attached_experiment
from sim_backend.configuration import load_configuration


def encoder_of(session: Session, folder: Path, models: Iterable[DynamicModel]) -> EncoderSide | None:
    """Where the arm of a session has its encoders; None if nothing tells.

    Told by the settings of the emulated arm, else by its healthy-arm baseline (`lwr-run commission`) or by the signals
    of one of `models`, else by an effect found in them with the place as its form. folder : of the session's results.
    """
    models = list(models)
    experiment = _experiment(session, folder)
    if experiment is not None:
        # Without its files the experiment tells nothing.
        with contextlib.suppress(LwrError):
            if experiment.backend == "emulator":
                settings = load_configuration(experiment.emulator_path, experiment.emulator_settings)
                return settings.sensors.position_sensor
            if experiment.diagnosis.reference is not None:
                models.append(read_model(find(experiment.diagnosis.reference, beside=experiment.folder)))
    for model in models:
        reference = Reference.of(model)
        if reference.sets:
            return reference.encoder
        if positions_of_motors(model):
            return "motor"
    for entry in (entry for model in models for entry in model.effects):
        place: dict[str, EncoderSide] = {"encoder at the motor": "motor", "encoder at the link": "link"}
        if entry.get("form") in place:
            return place[entry["form"]]
    return None


def _experiment(session: Session, folder: Path) -> Experiment | None:
    with contextlib.suppress(LwrError):
        frozen = Frozen(folder.resolve())
        if frozen.there:
            return Experiment.load(frozen.root())
    return attached_experiment(session)
