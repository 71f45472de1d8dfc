"""The emulated arm from an identified model: what of a `model.yaml` a simulated arm needs.

Torque, mass matrix and gravity depend on the base parameters only, so any standard parameters with the model's
torque will do; those next to the URDF's are taken, which look most like an arm. Where an estimate is that of no
arm at all (its mass matrix is not positive definite), the nearest bodies that can exist stand for it.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from fri.errors import ConfigurationError, DataError
from ident import regressor
from ident.cad_prior import cad_prior
from ident.effects import Simulated, find_effect
from ident.effects.model_torque import parameter_values
from ident.export import consistent_parameters
from ident.model import DynamicModel
from ident.parameters import INERTIAL, PER_LINK
from sim_backend.plant import Drive, Effect
from sim_backend.rigid_body import mass_matrix_floor, with_inertias

__all__ = [
    "Cause",
    "ModelEffect",
    "drive_of",
    "links_of",
    "model_effects",
    "model_parameters",
    "model_payloads",
]

Floats = NDArray[np.float64]

_DRIVE = PER_LINK[len(INERTIAL) :]
_LEAST_INERTIA = 1e-3
_POSES = 100


def model_parameters(model: DynamicModel) -> dict[str, float]:
    """All standard parameters of the links by name, `XX1` ... `offm7`, with the model's torque.

    What an estimate may be and an arm cannot is moved to the next possible value: friction below zero, and
    drives without inertia.
    """
    table = _standard(model)[: len(PER_LINK) * model.structure.chain.n].reshape(-1, len(PER_LINK))
    found = {}
    for link, row in enumerate(table, start=1):
        for symbol, value in zip(PER_LINK, row, strict=True):
            least = {"Ia": _LEAST_INERTIA, "Fvl": 0.0, "Fcl": 0.0, "Fvm": 0.0, "Fcm": 0.0}.get(
                symbol, -np.inf
            )
            found[f"{symbol}{link}"] = max(float(value), least)
    return found


def model_payloads(model: DynamicModel) -> dict[str, dict[str, float]]:
    """Inertial parameters of the model's payloads by name, in the frame of the last link."""
    standard, found = _standard(model), {}
    for name in model.structure.payloads:
        link = model.structure.payload_link(name)
        assert link is not None
        first = len(PER_LINK) * link
        values = standard[first : first + len(INERTIAL)]
        found[name] = dict(zip(INERTIAL, map(float, values), strict=True))
    return found


def links_of(model: DynamicModel, bare: pin.Model, payload: str | None) -> pin.Model:
    """`bare` with the inertias of the model and, where one is named, of its payload.

    Raises DataError where no simulated arm can have them.
    """
    parameters = model_parameters(model)
    last = model.structure.chain.n
    for symbol, value in (model_payloads(model)[payload] if payload is not None else {}).items():
        parameters[f"{symbol}{last}"] += value
    try:
        links = with_inertias(bare, parameters)
    except ConfigurationError as error:
        raise DataError(f"the model cannot be simulated: {error}") from error
    if mass_matrix_floor(links) <= 0.0:
        raise DataError("the mass matrix of the model is not positive definite, so it cannot be simulated")
    return links


def drive_of(model: DynamicModel, stiffness: Floats, damping: Floats) -> Drive:
    """The drives and frictions of the model in joints of a stiffness (n,) [Nm/rad] and damping (n,) [Nm s/rad]."""
    parameters = model_parameters(model)
    n = model.structure.chain.n
    rows = {symbol: np.array([parameters[f"{symbol}{k}"] for k in range(1, n + 1)]) for symbol in _DRIVE}
    return Drive(**rows, stiffness=stiffness, damping=damping)


class ModelEffect(Effect):
    """An effect of a model as the plant calls it. begin_s : time of the session when the plant's begins [s]."""

    def __init__(self, part: Simulated, begin_s: float = 0.0) -> None:
        self.part = part
        self.begin_s = begin_s

    def start(self, joints: int, random: np.random.Generator) -> None:
        """Begin a run."""
        self.part.start(joints, random)

    def load(self, time_s: float, plant: Any, loads: Any) -> None:
        """Change torques and friction."""
        self.part.load(max(0.0, time_s + self.begin_s), plant, loads)

    def sense(self, time_s: float, plant: Any, reading: Any) -> None:
        """Change position and joint torque as reported."""
        self.part.sense(max(0.0, time_s + self.begin_s), plant, reading)

    def sense_motor(self, time_s: float, plant: Any, reading: Any) -> None:
        """Change the motor torque as reported."""
        self.part.sense_motor(max(0.0, time_s + self.begin_s), plant, reading)


class Cause(ModelEffect):
    """An effect of the dictionary as a plug-in of the emulator's configuration: something to be found.

    cause : its name. joint : from 1; of no meaning for the whole arm. parameters : all values by name, SI units.
    Raises ConfigurationError for an unknown cause and where a parameter is missing or foreign.
    """

    def __init__(self, cause: str, parameters: Mapping[str, float], joint: int = 1) -> None:
        effect = find_effect(cause)
        known = [p.name for p in effect.parameters if p.name not in effect.hidden]
        wrong = sorted(set(known) ^ set(parameters))
        if wrong:
            raise ConfigurationError(
                f"effect {cause}: `parameters` must be exactly {', '.join(known)}; look at {wrong[0]!r}"
            )
        super().__init__(
            effect.simulate(joint - 1, {name: float(value) for name, value in parameters.items()})
        )


def model_effects(
    model: DynamicModel, *, session: int | None = None, begin_s: float = 0.0
) -> tuple[ModelEffect, ...]:
    """The model's effects for a simulated arm.

    session : number (from 0) of the session that is simulated, in the order of those that the model was made
    from; None for any other. Effects that belong to a moment of one session act in that session only. begin_s :
    time in it when the simulation begins.
    """
    found = []
    for entry in model.effects:
        effect = find_effect(str(entry["cause"]))
        values = parameter_values(entry)
        own = round(values.get("session", 0.0)) - 1
        if effect.event and own != session:
            continue
        if values.get("time_constant") == 0.0 and session == 0:
            # What changed between the sessions was not there in the first one.
            continue
        for joint in entry["joints"] or [1]:
            found.append(ModelEffect(effect.simulate(int(joint) - 1, values), begin_s))
    return tuple(found)


@lru_cache(maxsize=8)
def _standard(model: DynamicModel) -> Floats:
    """Standard parameters next to the URDF's; where no arm can have them, those of the nearest one that can."""
    if model.base is None:
        return model.standard_parameters()
    near = None
    if model.structure.chain.urdf is not None:
        prior = cad_prior(model.base)
        near = np.zeros(model.structure.n_columns)
        near[prior.bodies] = prior.inertial
    exact = model.standard_parameters(near)
    if all(_possible(model, exact, payload) for payload in (None, *model.structure.payloads)):
        return exact
    return consistent_parameters(model).vector


def _possible(model: DynamicModel, standard: Floats, payload: str | None) -> bool:
    """Whether the mass matrix is positive definite at random poses."""
    random = np.random.default_rng(0)
    q = random.uniform(-np.pi, np.pi, (_POSES, model.structure.chain.n))
    bodies = model.inertial(payload, standard=standard)
    matrices = regressor.mass_matrix(model.structure.chain, q, bodies)
    return bool(np.min(np.linalg.eigvalsh(matrices)) > 0.0)
