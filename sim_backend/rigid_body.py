"""Rigid-body models: a chain from a URDF, its inertias from standard parameters, and the payload in frame 7.

Standard parameters of a link are referred to its own frame (the modified Denavit-Hartenberg frame): `XX XY XZ
YY YZ ZZ` the inertia about the frame's origin, `MX MY MZ` the first moments, `M` the mass.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import pinocchio as pin

from fri.errors import ConfigurationError

__all__ = ["Payload", "chain", "mass_matrix_floor", "with_inertias", "with_payload"]

_POSES = 50
BODY_PARAMETERS = ("XX", "XY", "XZ", "YY", "YZ", "ZZ", "MX", "MY", "MZ", "M")


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
    # Not through pinocchio's checked constructor: only the whole arm's mass matrix has to be positive
    # definite.
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


def chain(urdf: Path) -> pin.Model:
    """The serial chain of revolute joints that `urdf` describes, with the inertias written there.

    Raises ConfigurationError where the file cannot be read as such a chain.
    """
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
    """Copy of `model` whose link i has the standard parameters `XXi` ... `Mi`.

    poses : (k, n) [rad] in which the mass matrix has to be positive definite; default random ones. Raises
    ConfigurationError for a missing parameter, or when it is not.
    """
    changed = pin.Model(model)
    for link in range(1, changed.njoints):
        names = {name: f"{name}{link}" for name in BODY_PARAMETERS}
        missing = [full for full in names.values() if full not in parameters]
        if missing:
            raise ConfigurationError(f"parameter {missing[0]} is missing; give all ten of link {link}")
        changed.inertias[link] = _inertia({name: float(parameters[full]) for name, full in names.items()})
    floor = mass_matrix_floor(changed, poses)
    if floor <= 0.0:
        raise ConfigurationError(
            f"smallest eigenvalue of the mass matrix is {floor:.3g} kg m^2; "
            "the link inertias are not physical"
        )
    return changed


def with_payload(model: pin.Model, payload: Payload | None) -> pin.Model:
    """Copy of `model` with `payload` welded to the last link, in that link's frame."""
    changed = pin.Model(model)
    if payload is not None and payload.M > 0.0:
        last = changed.njoints - 1
        changed.inertias[last] = changed.inertias[last] + payload.inertia()
    return changed


def mass_matrix_floor(model: pin.Model, poses: np.ndarray | None = None) -> float:
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
