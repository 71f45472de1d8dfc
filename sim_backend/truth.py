"""The emulated arm's true parameters by name: what an estimate is held against.

`truth("emulator/default.yaml", payload="paper_load")` gives all 136 standard parameters, `XX1` ... `offm8`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin

from fri.errors import ConfigurationError, DataError
from lwr_driver.configuration import parse, read_mapping
from sim_backend.configuration import JOINTS, EmulatorConfig, RobotConfig, load_configuration
from sim_backend.plant import Drive
from sim_backend.rigid_body import BODY_PARAMETERS, Payload, chain, with_inertias

if TYPE_CHECKING:
    from ident.model.dynamic_model import DynamicModel

__all__ = ["DRIVE_PARAMETERS", "RobotFile", "robot_file", "robot_model", "true_arm", "truth"]

DRIVE_PARAMETERS = ("Ia", "Fvl", "Fcl", "offl", "Fvm", "Fcm", "offm")


@dataclass(frozen=True)
class RobotFile:
    """A parameter file: standard parameters of the links by name, and payloads known by name (in frame 7)."""

    parameters: dict[str, float]
    payloads: dict[str, Payload]
    schema_version: int = 1

    def __post_init__(self) -> None:
        known = {f"{name}{i}" for name in (*BODY_PARAMETERS, *DRIVE_PARAMETERS) for i in range(1, JOINTS + 1)}
        for name in sorted(known - set(self.parameters)):
            raise ConfigurationError(f"parameter `{name}` is missing")
        for name in sorted(set(self.parameters) - known):
            raise ConfigurationError(f"parameter `{name}` is unknown; names are XX1 to offm{JOINTS}")
        for name, value in self.parameters.items():
            if name[:-1] in ("Ia", "Fvl", "Fcl", "Fvm", "Fcm", "M") and value < 0.0:
                raise ConfigurationError(f"parameter `{name}` is {value}; it cannot be negative")
            if name[:-1] == "Ia" and value == 0.0:
                raise ConfigurationError(f"parameter `{name}` is zero; a motor has inertia")

    def payload(self, name: str) -> Payload | None:
        """The payload called `name`; None for `none`. Raises ConfigurationError for an unknown name."""
        if name == "none":
            return None
        if name not in self.payloads:
            raise ConfigurationError(
                f"payload {name!r} is unknown; known: none, {', '.join(sorted(self.payloads))}"
            )
        return self.payloads[name]


def robot_file(config: EmulatorConfig) -> RobotFile:
    """Read what `config` names as the arm's parameters: a parameter file, or an identified `model.yaml`."""
    path = config.beside(config.robot.parameters)
    model = robot_model(config)
    if model is None:
        return parse(RobotFile, read_mapping(path), str(path))
    from sim_backend.model_arm import model_parameters, model_payloads

    try:
        payloads = {name: Payload(**values) for name, values in model_payloads(model).items()}
        return RobotFile(model_parameters(model), payloads)
    except (ConfigurationError, DataError) as error:
        raise ConfigurationError(f"{path}: this model cannot be emulated: {error}") from error


def robot_model(config: EmulatorConfig) -> DynamicModel | None:
    """The identified model that `config` names as the arm's parameters; None where it names a parameter file."""
    path = config.beside(config.robot.parameters)
    content = read_mapping(path)
    if "chain" not in content:
        return None
    # An arm by its parameters needs nothing of the estimation, and is there in half the time.
    from ident.model.model_file import read_model

    model = read_model(content)
    if model.structure.chain.n != JOINTS:
        raise ConfigurationError(
            f"{path}: a model of {model.structure.chain.n} joints; the FRI carries {JOINTS}"
        )
    return model


def truth(config: EmulatorConfig | str | Path, payload: str | None = None) -> dict[str, float]:
    """All standard parameters by name: links 1 to 7, and link 8, the payload (zeros without one).

    payload : name of the payload, None for the one the configuration starts with
    """
    if not isinstance(config, EmulatorConfig):
        config = load_configuration(config)
    content = robot_file(config)
    load = content.payload(config.robot.payload if payload is None else payload) or Payload(0.0)
    values = {}
    for link in range(1, JOINTS + 1):
        for name in (*BODY_PARAMETERS, *DRIVE_PARAMETERS):
            values[f"{name}{link}"] = float(content.parameters[f"{name}{link}"])
    for name in BODY_PARAMETERS:
        values[f"{name}{JOINTS + 1}"] = float(getattr(load, name))
    for name in DRIVE_PARAMETERS:
        values[f"{name}{JOINTS + 1}"] = 0.0
    return values


def true_arm(config: EmulatorConfig, content: RobotFile) -> tuple[pin.Model, Drive]:
    """Rigid-body model without payload, and the drives, of the arm that `config` describes."""
    robot: RobotConfig = config.robot
    path = config.beside(robot.urdf)
    bare = chain(path)
    if bare.nv != JOINTS:
        raise ConfigurationError(f"{path}: {bare.nv} joints; the FRI carries {JOINTS}")
    model = with_inertias(bare, content.parameters)
    rows = {
        name: np.array([content.parameters[f"{name}{i}"] for i in range(1, JOINTS + 1)], dtype=float)
        for name in DRIVE_PARAMETERS
    }
    drive = Drive(
        **rows,
        stiffness=np.array(robot.stiffness),
        damping=np.array(robot.damping),
        brake_torque=np.array(robot.brake_torque),
    )
    return model, drive
