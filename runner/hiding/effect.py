"""The hidden effect: its place in the emulator's settings, and its sealed file among the results."""

from __future__ import annotations

import base64
import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from fri.errors import ConfigurationError, DataError
from runner.experiment_file import Experiment
from runner.terminal import write_json
from sim_backend.configuration import EmulatorConfig, load_configuration

SEALED = "hidden.json"

_PLUGIN = "sim_backend.model_arm:Cause"


@dataclass(frozen=True)
class HiddenEffect:
    """An effect hidden in the emulated arm.

    joints : from 1, empty for the whole arm. form : of an effect of several forms. parameters : SI units.
    rho : its visibility, see `runner.hiding.draw`.
    """

    seed: int
    cause: str
    joints: tuple[int, ...]
    form: str | None
    parameters: dict[str, float]
    rho: float

    @property
    def plugin(self) -> dict[str, Any]:
        """The entry in `robot.effects` of the emulator."""
        joint = self.joints[0] if self.joints else 1
        options = {"cause": self.cause, "joint": joint, "parameters": self.parameters}
        return {"type": _PLUGIN, "options": options | ({} if self.form is None else {"form": self.form})}

    def seal(self, folder: Path) -> None:
        """Write it into a folder of results, encoded against a chance look."""
        sealed = base64.b64encode(json.dumps(asdict(self)).encode()).decode()
        advice = f"`lwr-run experiment --reveal {folder.name}` shows the hidden effect"
        write_json(folder / SEALED, {"schema_version": 1, "advice": advice, "sealed": sealed})

    @classmethod
    def unseal(cls, folder: Path) -> HiddenEffect | None:
        """The effect hidden in the run of a folder, None without one. DataError for a broken file."""
        file = folder / SEALED
        if not file.is_file():
            return None
        try:
            content = json.loads(base64.b64decode(json.loads(file.read_text(encoding="utf-8"))["sealed"]))
            return cls(**{**content, "joints": tuple(content["joints"])})
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise DataError(f"{file}: cannot be read: {error}; run the experiment again") from error


def emulated_arm(experiment: Experiment) -> EmulatorConfig:
    """The emulator's configuration. ConfigurationError unless the arm is the built-in emulator's own."""
    if experiment.backend != "emulator":
        raise ConfigurationError(
            f"--hide: the backend is `{experiment.backend}`, and nothing can be hidden in a real arm; set "
            "`backend: emulator` in the experiment file"
        )
    config = load_configuration(experiment.emulator_path, experiment.emulator_settings)
    if config.robot.plant is not None:
        raise ConfigurationError(
            f"--hide: the emulated arm is the plug-in {config.robot.plant.type}, which takes no effect in its "
            "joints; leave `robot.plant` out of the emulator's settings"
        )
    return config


def with_effect(experiment: Experiment, effect: HiddenEffect) -> Experiment:
    """The experiment with the effect in its emulated arm. Raises as `emulated_arm`."""
    effects = [asdict(one) for one in emulated_arm(experiment).robot.effects]
    settings = {**experiment.emulator_settings, "robot.effects": [*effects, effect.plugin]}
    return experiment.changed(emulator_settings=settings, sealed=True)
