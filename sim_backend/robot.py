"""The emulated arm's parameters: rigid bodies, drives and payloads, and their true values by name.

Standard parameters of a link are referred to its own frame (the modified Denavit-Hartenberg frame): `XX XY XZ
YY YZ ZZ` the inertia about the frame's origin, `MX MY MZ` the first moments, `M` the mass; then `Ia Fvl Fcl offl
Fvm Fcm offm` of its drive. `truth("emulator/default.yaml", payload="paper_load")` gives all 136 of them, `XX1` ...
`offm8`, the reference for an estimate.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin

from fri.errors import ConfigurationError, DataError
from lwr_driver.configuration import parse, read_mapping
from sim_backend.configuration import JOINTS, EmulatorConfig, RobotConfig, load_configuration

if TYPE_CHECKING:
    from ident.model import DynamicModel

_POSES = 50
BODY_PARAMETERS = ("XX", "XY", "XZ", "YY", "YZ", "ZZ", "MX", "MY", "MZ", "M")
DRIVE_PARAMETERS = ("Ia", "Fvl", "Fcl", "offl", "Fvm", "Fcm", "offm")


@dataclass(frozen=True)
class Payload:
    """Ten inertial parameters of a body in the frame of the last link: kg, kg m, kg m^2."""

    M: float
    MX: float = 0.0
    MY: float = 0.0
    MZ: float = 0.0
    XX: float = 0.0
    XY: float = 0.0
    XZ: float = 0.0
    YY: float = 0.0
    YZ: float = 0.0
    ZZ: float = 0.0

    def __post_init__(self) -> None:
        if self.M < 0.0:
            raise ConfigurationError(f"payload mass {self.M} kg is negative")
        if self.M == 0.0 and any((self.MX, self.MY, self.MZ)):
            raise ConfigurationError("payload has first moments but no mass; give `M`")

    def inertia(self) -> pin.Inertia:
        """The body as pinocchio wants it: mass, centre of mass, inertia about the centre of mass."""
        return _inertia({field.name: getattr(self, field.name) for field in fields(self)})

    @classmethod
    def from_centre_of_mass(
        cls, mass: float, centre: tuple[float, ...], inertia: tuple[float, ...] = (0.0,) * 6
    ) -> Payload:
        """From mass [kg], centre of mass [m] and inertia about it, (xx, xy, xz, yy, yz, zz) [kg m^2]."""
        xx, xy, xz, yy, yz, zz = inertia
        about_centre = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        skew = pin.skew(np.array(centre, dtype=float))
        about_origin = about_centre - mass * skew @ skew
        moments = mass * np.array(centre, dtype=float)
        return cls(
            mass,
            *map(float, moments),
            *(float(about_origin[i, j]) for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))),
        )


def _inertia(values: Mapping[str, float]) -> pin.Inertia:
    # Without pinocchio's check of each body: only the mass matrix of the arm has to be positive definite.
    mass = values["M"]
    if mass == 0.0:
        if any(values[name] for name in ("MX", "MY", "MZ")):
            raise ConfigurationError(
                "a link has first moments but no mass; regrouped parameters cannot be simulated"
            )
        mass = 1e-12
    order = ("XX", "XY", "YY", "XZ", "YZ", "ZZ")
    return pin.Inertia.FromDynamicParameters(
        np.array([mass, *(values[name] for name in ("MX", "MY", "MZ", *order))])
    )


@dataclass(frozen=True)
class Drive:
    """Parameters of the drives, (n,) each: the last seven standard parameters of a link, and the elasticity."""

    Ia: np.ndarray
    Fvl: np.ndarray
    Fcl: np.ndarray
    offl: np.ndarray
    Fvm: np.ndarray
    Fcm: np.ndarray
    offm: np.ndarray
    stiffness: np.ndarray
    damping: np.ndarray
    brake_torque: np.ndarray = field(default_factory=lambda: np.full(7, 200.0))


def chain(urdf: Path) -> pin.Model:
    """The serial chain of revolute joints in `urdf`, with its inertias; ConfigurationError for any other file."""
    try:
        model = pin.buildModelFromXML(urdf.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, ValueError, RuntimeError) as error:
        raise ConfigurationError(f"{urdf}: cannot be read as a URDF: {error}") from error
    if model.nq != model.nv or model.njoints != model.nv + 1:
        raise ConfigurationError(
            f"{urdf}: {model.njoints - 1} joints with {model.nv} degrees of freedom; "
            "only chains of revolute joints are simulated"
        )
    return model


def with_inertias(
    model: pin.Model, parameters: Mapping[str, float], poses: np.ndarray | None = None
) -> pin.Model:
    """Copy of `model` with the standard parameters `XXi` ... `Mi` for link i.

    poses : (k, n) [rad] for the check of the mass matrix, None takes random ones. Raises ConfigurationError for a
    missing parameter, or for a mass matrix without positive definiteness.
    """
    changed = pin.Model(model)
    for link in range(1, changed.njoints):
        names = {name: f"{name}{link}" for name in BODY_PARAMETERS}
        missing = [full for full in names.values() if full not in parameters]
        if missing:
            raise ConfigurationError(f"parameter {missing[0]} is missing; give all ten of link {link}")
        changed.inertias[link] = _inertia({name: float(parameters[full]) for name, full in names.items()})
    floor = _mass_matrix_floor(changed, poses)
    if floor <= 0.0:
        raise ConfigurationError(
            f"smallest eigenvalue of the mass matrix is {floor:.3g} kg m^2; "
            "the link inertias are not physical"
        )
    return changed


def with_payload(model: pin.Model, payload: Payload | None) -> pin.Model:
    """Copy of `model` with `payload` welded to the last link."""
    changed = pin.Model(model)
    if payload is not None and payload.M > 0.0:
        last = changed.njoints - 1
        changed.inertias[last] = changed.inertias[last] + payload.inertia()
    return changed


def _mass_matrix_floor(model: pin.Model, poses: np.ndarray | None = None) -> float:
    """Smallest eigenvalue of the mass matrix over `poses` (k, n), default 50 seeded random ones [kg m^2]."""
    data = model.createData()
    if poses is None:
        poses = np.random.default_rng(0).uniform(-np.pi, np.pi, (_POSES, model.nq))
    smallest = np.inf
    for pose in poses:
        mass = pin.crba(model, data, np.asarray(pose, dtype=float))
        mass = np.triu(mass) + np.triu(mass, 1).T
        smallest = min(smallest, float(np.linalg.eigvalsh(mass)[0]))
    return smallest


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
    """Read the arm's parameters of `config`: a parameter file, or an identified `model.yaml`."""
    path = config.beside(config.robot.parameters)
    model = robot_model(config)
    own = {
        name: Payload.from_centre_of_mass(body.mass, body.com, body.inertia)
        for name, body in config.robot.payloads.items()
    }
    if model is None:
        content = parse(RobotFile, read_mapping(path), path)
        return replace(content, payloads={**content.payloads, **own})
    from sim_backend.model_arm import model_parameters, model_payloads

    try:
        payloads = {name: Payload(**values) for name, values in model_payloads(model).items()}
        return RobotFile(model_parameters(model), {**payloads, **own})
    except (ConfigurationError, DataError) as error:
        raise ConfigurationError(f"{path}: this model cannot be emulated: {error}") from error


def robot_model(config: EmulatorConfig) -> DynamicModel | None:
    """The identified model of `config`; None with a parameter file."""
    path = config.beside(config.robot.parameters)
    content = read_mapping(path)
    if "chain" not in content:
        return None
    # Imported only here: the start without the estimation takes half the time.
    from ident.model.model_file import read_model

    model = read_model(content)
    if model.structure.chain.n != JOINTS:
        raise ConfigurationError(
            f"{path}: a model of {model.structure.chain.n} joints; the FRI carries {JOINTS}"
        )
    return model


def truth(
    config: EmulatorConfig | str | Path,
    payload: str | Payload | None = None,
    *,
    link: int = JOINTS + 1,
) -> dict[str, float]:
    """All standard parameters by name: links 1 to 7, and `link`, the payload (zeros without one).

    payload : its name or the body itself; None for the one the configuration starts with
    """
    if not isinstance(config, EmulatorConfig):
        config = load_configuration(config)
    content = robot_file(config)
    if not isinstance(payload, Payload):
        payload = content.payload(config.robot.payload if payload is None else payload)
    load = payload or Payload(0.0)
    names = (*BODY_PARAMETERS, *DRIVE_PARAMETERS)
    own = [f"{name}{number}" for number in range(1, JOINTS + 1) for name in names]
    values = {name: float(content.parameters[name]) for name in own}
    return values | {f"{name}{link}": float(getattr(load, name, 0.0)) for name in names}


def true_arm(config: EmulatorConfig, content: RobotFile) -> tuple[pin.Model, Drive]:
    """Rigid-body model without payload, and the drives, of the arm of `config`."""
    robot: RobotConfig = config.robot
    path = config.beside(robot.urdf)
    bare = chain(path)
    if bare.nv != JOINTS:
        raise ConfigurationError(f"{path}: {bare.nv} joints; the FRI carries {JOINTS}")
    model = with_inertias(bare, content.parameters)
    model.gravity.linear = np.array(robot.gravity, dtype=float)
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
