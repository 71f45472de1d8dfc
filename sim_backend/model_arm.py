"""The emulated arm from an identified model (`model.yaml`).

Torque, mass matrix and gravity depend on the base parameters only. Of all standard parameters with the model's
torque, those next to the URDF's are taken. An estimate can be unphysical: a mass matrix without positive
definiteness in the poses of the arm. The nearest physical bodies then replace it.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from fri.errors import ConfigurationError, DataError
from ident.dynamics import regressor
from ident.dynamics.kinematics import Chain, mdh_transform
from ident.dynamics.parameters import INERTIAL, PER_LINK
from ident.effects import Parameters, Simulated, find_effect, parameter_values
from ident.estimators.physical import cad_prior
from ident.formats import consistent_parameters
from ident.model import DynamicModel
from sim_backend.plant import PlantEffect
from sim_backend.robot import Drive, with_inertias

Floats = NDArray[np.float64]

_DRIVE = PER_LINK[len(INERTIAL) :]
_LEAST_INERTIA = 1e-3
_POSES = 100


def model_parameters(model: DynamicModel, poses: Floats | None = None) -> dict[str, float]:
    """All standard parameters of the links by name, `XX1` ... `offm7`, with the model's torque.

    poses : (k, n) poses of the arm [rad]; default random ones. Unphysical values are moved to the next physical
    ones: friction below zero, drives without inertia, and all bodies together if the mass matrix is not positive
    definite in the poses.
    """
    table = _standard(model, poses)[: len(PER_LINK) * model.structure.chain.n].reshape(-1, len(PER_LINK))
    found = {}
    for link, row in enumerate(table, start=1):
        for symbol, value in zip(PER_LINK, row, strict=True):
            least = {"Ia": _LEAST_INERTIA, "Fvl": 0.0, "Fcl": 0.0, "Fvm": 0.0, "Fcm": 0.0}.get(
                symbol, -np.inf
            )
            found[f"{symbol}{link}"] = max(float(value), least)
    return found


def model_payloads(model: DynamicModel, poses: Floats | None = None) -> dict[str, dict[str, float]]:
    """Inertial parameters of the model's payloads by name, in the frame of the last link. poses : as above."""
    standard, found = _standard(model, poses), {}
    for name in model.structure.payloads:
        link = model.structure.payload_link(name)
        assert link is not None
        first = len(PER_LINK) * link
        values = standard[first : first + len(INERTIAL)]
        found[name] = dict(zip(INERTIAL, map(float, values), strict=True))
    return found


def links_of(chain: Chain) -> pin.Model:
    """Joints of a chain, one body each in its modified Denavit-Hartenberg frame, without inertia."""
    links = pin.Model()
    links.gravity.linear = np.array(chain.gravity)
    for k, name in enumerate(chain.joint_names):
        kind = pin.JointModelPZ() if chain.prismatic[k] else pin.JointModelRZ()
        place = mdh_transform(chain.alpha[k], chain.d[k], chain.theta[k], chain.r[k])
        links.addJoint(k, kind, pin.SE3(place), name)
    return links


def arm_of(
    model: DynamicModel,
    bare: pin.Model,
    payload: str | None,
    *,
    stiffness: Floats,
    damping: Floats,
    poses: Floats | None = None,
    motors: Drive | None = None,
) -> tuple[pin.Model, Drive]:
    """`bare` with the inertias of the model and of its payload, and the model's drives and frictions.

    stiffness, damping : of the joints, (n,) [Nm/rad], [Nm s/rad]. poses : (k, n) poses of the arm [rad].
    motors : drives for a model of the joint torques only.
    Raises DataError for parameters of no simulated arm.
    """
    parameters = model_parameters(model, poses)
    n = model.structure.chain.n
    for symbol, value in (model_payloads(model, poses)[payload] if payload is not None else {}).items():
        parameters[f"{symbol}{n}"] += value
    try:
        links = with_inertias(bare, parameters, poses)
    except ConfigurationError as error:
        raise DataError(f"the model cannot be simulated: {error}") from error
    rows = {symbol: np.array([parameters[f"{symbol}{k}"] for k in range(1, n + 1)]) for symbol in _DRIVE}
    if motors is not None and "motor" not in model.structure.sides:
        rows |= {"Ia": motors.Ia, "Fvm": motors.Fvm, "Fcm": motors.Fcm, "offm": motors.offm}
    return links, Drive(**rows, stiffness=stiffness, damping=damping)


class ModelEffect(PlantEffect):
    """An effect of a model for the plant. begin_s : time of the session at time zero of the plant [s]."""

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
        """Change the reported position and joint torque."""
        self.part.sense(max(0.0, time_s + self.begin_s), plant, reading)

    def sense_motor(self, time_s: float, plant: Any, reading: Any) -> None:
        """Change the reported motor torque."""
        self.part.sense_motor(max(0.0, time_s + self.begin_s), plant, reading)


class Cause(ModelEffect):
    """An effect of the dictionary as a plug-in of the emulator's configuration, for the identification to find.

    cause : its name. joint : from 1; of no meaning for the whole arm. form : of an effect of several forms.
    parameters : all values of the form by name, SI units. Raises ConfigurationError for an unknown cause or form, and
    for a missing or foreign parameter.
    """

    def __init__(
        self, cause: str, parameters: Mapping[str, float], joint: int = 1, form: str | None = None
    ) -> None:
        effect = find_effect(cause)
        effect.check(parameters, form, whole=True)
        values = {name: float(value) for name, value in parameters.items()}
        super().__init__(effect.simulate(joint - 1, values, form))


def model_effects(
    model: DynamicModel, *, session: int | None = None, begin_s: float = 0.0
) -> tuple[ModelEffect, ...]:
    """The model's effects for a simulated arm.

    session : number (from 0) of the simulated session among those of the model; None for any other. An effect at a
    moment of one session acts in this session only. begin_s : time in it at the beginning of the simulation [s].
    """
    found = []
    for entry in model.effects:
        effect = find_effect(str(entry["cause"]))
        values: Parameters = parameter_values(entry)
        own = round(values.get("session", 0.0)) - 1
        if effect.event and own != session:
            continue
        form = entry.get("form")
        values = effect.in_session(values, form, session)
        for joint in entry["joints"] or [1]:
            found.append(ModelEffect(effect.simulate(int(joint) - 1, values, form), begin_s))
    return tuple(found)


def is_possible(model: DynamicModel, poses: Floats | None = None) -> bool:
    """Whether the mass matrix is positive definite in `poses` (k, n), default random ones, with each payload.

    Otherwise the nearest physical bodies are simulated.
    """
    if poses is None:
        random = np.random.default_rng(0)
        poses = random.uniform(-np.pi, np.pi, (_POSES, model.structure.chain.n))
    exact = _nearest(model)
    for payload in (None, *model.structure.payloads):
        bodies = model.inertial(payload, standard=exact)
        if np.min(np.linalg.eigvalsh(regressor.mass_matrix(model.structure.chain, poses, bodies))) <= 0.0:
            return False
    return True


def _standard(model: DynamicModel, poses: Floats | None) -> Floats:
    return _nearest(model) if is_possible(model, poses) else _consistent(model)


@lru_cache(maxsize=8)
def _nearest(model: DynamicModel) -> Floats:
    if model.base is None or model.structure.chain.urdf is None:
        return model.standard_parameters()
    prior = cad_prior(model.base)
    near = np.zeros(model.structure.n_columns)
    near[prior.bodies] = prior.inertial
    return model.standard_parameters(near)


@lru_cache(maxsize=8)
def _consistent(model: DynamicModel) -> Floats:
    """Standard parameters of physical bodies, with offsets and frictions moved along with them.

    An offset highly correlated with a moment follows it: the conditional mean ``y + C_yx C_xx^-1 (x' - x)`` of the
    other parameters y, given the inertial ones x.
    """
    vector = np.array(consistent_parameters(model).vector)
    if model.base is None or model.covariance is None:
        return vector
    inertial = np.arange(model.structure.n_columns) % len(PER_LINK) < len(INERTIAL)
    inertial[len(PER_LINK) * model.structure.n_links :] = False
    bodies = np.any(model.base.matrix[model.positions][:, inertial] != 0.0, axis=1)
    moved = model.base.reduce(vector)[model.positions] - model.values
    scale = np.sqrt(np.maximum(np.diag(model.covariance), 1e-300))
    correlation = model.covariance / np.outer(scale, scale)
    inverse = np.linalg.pinv(correlation[np.ix_(bodies, bodies)], rcond=1e-10, hermitian=True)
    follow = correlation[np.ix_(~bodies, bodies)] @ (inverse @ (moved[bodies] / scale[bodies]))
    vector[model.columns[~bodies]] += follow * scale[~bodies]
    return vector
