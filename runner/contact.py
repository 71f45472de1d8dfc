"""The watch of torque and contact in an experiment: its limits, and the model of its own estimate."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pinocchio as pin

from fri.errors import ConfigurationError, DataError
from fri.quantities import FileName
from lwr_driver.arm import Arm
from lwr_driver.configuration import find
from lwr_driver.contact import ContactSettings, ExpectedArm

_COVERAGE = 3.0  # standard deviations of friction and offset


@dataclass(frozen=True)
class ContactPlan(ContactSettings):
    """Limits of torque and contact, see `lwr_driver.contact`.

    model : file of an identified model for the own estimate; None takes the nominal arm.
    """

    model: FileName | None = None


def expected_arm(plan: ContactPlan, arm: Arm, folder: Path) -> ExpectedArm:
    """The arm of the own estimate: bodies, friction and its uncertainty from the model's parameters.

    folder : of the experiment file. Raises ConfigurationError for a model of another arm or without joint torques.
    """
    if plan.model is None:
        return ExpectedArm.nominal(arm)
    from ident.model.model_file import read_model
    from sim_backend.model_arm import model_parameters
    from sim_backend.robot import with_inertias

    path = find(plan.model, beside=folder)
    model = read_model(path)
    n = model.structure.chain.n
    if "joint" not in model.structure.sides or n != len(arm.joint_names):
        raise ConfigurationError(
            f"contact.model {path}: a model of the joint torques of {len(arm.joint_names)} joints is needed; "
            "identify with `identification.model: 2`, or leave the key out"
        )
    try:
        values = model_parameters(model)
        links = with_inertias(pin.buildModelFromXML(arm.urdf), values)
    except (ConfigurationError, DataError) as error:
        raise ConfigurationError(f"contact.model {path}: {error}") from error
    spread = {} if model.std is None else dict(zip(model.names, model.std.tolist(), strict=True))
    uncertain = [
        _COVERAGE * float(np.hypot(*(spread.get(f"{name}{joint}", 0.0) for name in ("Fcl", "offl"))))
        for joint in range(1, n + 1)
    ]
    viscous, coulomb, offset = (
        tuple(values[f"{name}{joint}"] for joint in range(1, n + 1)) for name in ("Fvl", "Fcl", "offl")
    )
    return ExpectedArm(links.saveToString(), viscous, coulomb, offset, tuple(uncertain))
