"""Dynamic parameters: their names, order and units, and the algebra of one body's ten inertial parameters.

Every link has 17 standard parameters in this order::

    XX XY XZ YY YZ ZZ  MX MY MZ  M  Ia  Fvl Fcl offl  Fvm Fcm offm

The first ten are the *inertial* ones: the inertia tensor about the origin of the link frame (tensor entries,
so `XY` = -int x y dm), the first moments and the mass. The other seven are the *drive* ones: drive inertia,
viscous and Coulomb friction and offset on the joint side (`l`, after the gear, seen by a joint torque sensor)
and on the motor side (`m`). A payload is a body of its own, number n + 1, in the frame of the last link.

Functions on inertial parameters take arrays whose last axis has length 10 and keep the leading axes.

Reference: Khalil and Dombre, Modeling, Identification and Control of Robots, 2002, chapter 9; Traversaro et
al., Identification of fully physical consistent inertial parameters, 2016; Wensing, Kim and Slotine, 2018
(pseudo-inertia).
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fri.errors import ConfigurationError

Floats = NDArray[np.float64]

INERTIAL = ("XX", "XY", "XZ", "YY", "YZ", "ZZ", "MX", "MY", "MZ", "M")
LINK_FRICTION = ("Fvl", "Fcl", "offl")
DRIVE = ("Ia", *LINK_FRICTION, "Fvm", "Fcm", "offm")
PER_LINK = INERTIAL + DRIVE

# Positions of our ten parameters in pinocchio's order m, mcx, mcy, mcz, Ixx, Ixy, Iyy, Ixz, Iyz, Izz.
_IN_PINOCCHIO = np.array([4, 5, 7, 6, 8, 9, 1, 2, 3, 0])

_UNITS = dict.fromkeys(INERTIAL[:6], "kg m^2") | dict.fromkeys(INERTIAL[6:9], "kg m") | {"M": "kg"}
_DRIVE_UNITS_REVOLUTE = {"I": "kg m^2", "v": "Nm s/rad", "c": "Nm", "o": "Nm"}
_DRIVE_UNITS_PRISMATIC = {"I": "kg", "v": "N s/m", "c": "N", "o": "N"}

_NAME = re.compile(r"([A-Za-z]+?)(\d+)(R?)$")


def parameter_names(n_links: int) -> tuple[str, ...]:
    """Names of the 17 standard parameters of links 1..n_links, link after link: `XX1`, ..., `offm8`."""
    return tuple(f"{symbol}{link}" for link in range(1, n_links + 1) for symbol in PER_LINK)


def split_name(name: str) -> tuple[str, int, bool]:
    """Symbol, link number and whether regrouped, of a parameter name: `ZZ2R` -> ("ZZ", 2, True).

    Raises ConfigurationError when `name` is not of that form.
    """
    match = _NAME.match(name)
    if match is None:
        raise ConfigurationError(
            f"parameter name {name!r} is not a symbol followed by a link number, as in `ZZ2R`"
        )
    return match[1], int(match[2]), bool(match[3])


def unit(name: str, *, prismatic: bool = False) -> str:
    """SI unit of the parameter `name`; `prismatic` is the kind of its joint, for the drive parameters."""
    symbol = split_name(name)[0]
    if symbol in _UNITS:
        return _UNITS[symbol]
    kind = symbol[0].upper() if symbol[0].upper() != "F" else symbol[1]
    units = _DRIVE_UNITS_PRISMATIC if prismatic else _DRIVE_UNITS_REVOLUTE
    return units["o" if kind == "O" else kind]


def printed_unit(unit: str) -> str:
    """A unit as it is printed: kg m², Nm/rad³."""
    return unit.replace("^2", "²").replace("^3", "³")


def joint_unit(unit: str, *, prismatic: bool) -> str:
    """A unit such as `Nm`, `rad` or `rad/Nm`, for a `prismatic` joint in N and m."""
    return unit.replace("Nm", "N").replace("rad", "m") if prismatic else unit


def _inertial(parameters: ArrayLike) -> Floats:
    array = np.asarray(parameters, dtype=np.float64)
    if array.shape[-1:] != (10,):
        raise ConfigurationError(
            f"inertial parameters have shape {array.shape}; the last axis must hold {' '.join(INERTIAL)}"
        )
    return array


def _tensor(inertial: Floats) -> Floats:
    """Symmetric (..., 3, 3) matrix of the six tensor entries."""
    return inertial[..., [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(*inertial.shape[:-1], 3, 3)


def _pack(tensor: Floats, moment: Floats, mass: Floats) -> Floats:
    entries = tensor.reshape(*tensor.shape[:-2], 9)[..., [0, 1, 2, 4, 5, 8]]
    return np.concatenate([entries, moment, mass[..., None]], axis=-1)


def _steiner(u: Floats, v: Floats) -> Floats:
    """(u . v) 1 - (u v' + v u') / 2, the symmetric product of Steiner's theorem."""
    outer = u[..., :, None] * v[..., None, :]
    dot = np.sum(u * v, axis=-1)[..., None, None]
    return dot * np.eye(3) - 0.5 * (outer + np.swapaxes(outer, -1, -2))


def to_com(parameters: ArrayLike) -> tuple[Floats, Floats, Floats]:
    """Mass [kg] (...,), centre of mass [m] (..., 3) and inertia about it [kg m^2] (..., 3, 3), link axes.

    The centre of mass of a body without mass and first moments is the origin. Raises ConfigurationError for
    first moments with zero mass.
    """
    inertial = _inertial(parameters)
    mass, moment = inertial[..., 9], inertial[..., 6:9]
    massless = mass == 0.0
    if np.any(massless[..., None] & (moment != 0.0)):
        raise ConfigurationError("a link has first moments but no mass; its centre of mass does not exist")
    com = moment / np.where(massless, 1.0, mass)[..., None]
    return mass.copy(), com, _tensor(inertial) - mass[..., None, None] * _steiner(com, com)


def from_com(mass: ArrayLike, com: ArrayLike, inertia: ArrayLike) -> Floats:
    """Ten inertial parameters (..., 10) from mass, centre of mass and inertia about it: undoes `to_com`."""
    m = np.asarray(mass, dtype=np.float64)
    c = np.asarray(com, dtype=np.float64)
    tensor = np.asarray(inertia, dtype=np.float64) + m[..., None, None] * _steiner(c, c)
    return _pack(tensor, m[..., None] * c, m)


def transform(parameters: ArrayLike, placement: ArrayLike) -> Floats:
    """The same body's parameters in another frame.

    placement : (4, 4) homogeneous pose of the frame of `parameters` in the wanted frame.
    """
    pose = np.asarray(placement, dtype=np.float64)
    rotation, shift = pose[:3, :3], pose[:3, 3]
    inertial = _inertial(parameters)
    mass = inertial[..., 9]
    moment = inertial[..., 6:9] @ rotation.T
    tensor = rotation @ _tensor(inertial) @ rotation.T
    tensor = tensor + 2.0 * _steiner(moment, np.broadcast_to(shift, moment.shape))
    tensor = tensor + mass[..., None, None] * _steiner(shift, shift)
    return _pack(tensor, moment + mass[..., None] * shift, mass)


def frame_change(placement: ArrayLike) -> Floats:
    """(10, 10) matrix of `transform`: parameters in the wanted frame = matrix @ parameters."""
    return transform(np.eye(10), placement).T


def pseudo_inertia(parameters: ArrayLike) -> Floats:
    """Pseudo-inertia matrix (..., 4, 4): [[tr(J)/2 1 - J, h], [h', m]], J about the origin, h first moments.

    It is positive definite exactly for the parameters of a rigid body of positive mass density.
    """
    inertial = _inertial(parameters)
    tensor = _tensor(inertial)
    trace = np.trace(tensor, axis1=-2, axis2=-1)[..., None, None]
    matrix = np.empty((*inertial.shape[:-1], 4, 4))
    matrix[..., :3, :3] = 0.5 * trace * np.eye(3) - tensor
    matrix[..., :3, 3] = matrix[..., 3, :3] = inertial[..., 6:9]
    matrix[..., 3, 3] = inertial[..., 9]
    return matrix


def from_pseudo_inertia(matrix: ArrayLike) -> Floats:
    """Ten inertial parameters (..., 10) from the pseudo-inertia matrix (..., 4, 4)."""
    full = np.asarray(matrix, dtype=np.float64)
    second = full[..., :3, :3]
    trace = np.trace(second, axis1=-2, axis2=-1)[..., None, None]
    return _pack(trace * np.eye(3) - second, full[..., :3, 3], full[..., 3, 3])


def to_pinocchio(parameters: ArrayLike) -> Floats:
    """The ten in pinocchio's order m mc Ixx Ixy Iyy Ixz Iyz Izz (for `Inertia.FromDynamicParameters`)."""
    inertial = _inertial(parameters)
    reordered = np.empty_like(inertial)
    reordered[..., _IN_PINOCCHIO] = inertial
    return reordered


def from_pinocchio(parameters: ArrayLike) -> Floats:
    """Our order from pinocchio's (`Inertia.toDynamicParameters`)."""
    return _inertial(parameters)[..., _IN_PINOCCHIO]


@dataclass(frozen=True)
class Consistency:
    """Verdict on the physical consistency of one body's ten parameters.

    link : the name used in messages. mass : [kg].
    smallest_eigenvalue : of the pseudo-inertia matrix; positive for a real body.
    principal : (3,) principal moments about the centre of mass [kg m^2], ascending (NaN without mass).
    consistent : mass positive and pseudo-inertia positive semi-definite to the tolerance.
    reason : why not, in words; empty when consistent.
    """

    link: str
    mass: float
    smallest_eigenvalue: float
    principal: tuple[float, float, float]
    consistent: bool
    reason: str


def consistency(
    parameters: ArrayLike, names: Iterable[str] | None = None, *, tolerance: float = 1e-12
) -> tuple[Consistency, ...]:
    """Physical consistency of each of the bodies `parameters` (k, 10) or (10,).

    A body is consistent when its mass is positive and its pseudo-inertia has no eigenvalue below
    -tolerance x (its largest eigenvalue): the inertia about the centre of mass is then positive semi-definite
    and obeys the triangle inequality.
    """
    bodies = np.atleast_2d(_inertial(parameters))
    labels = list(names) if names is not None else [f"link {k + 1}" for k in range(len(bodies))]
    verdicts = []
    for label, body in zip(labels, bodies, strict=True):
        eigenvalues = np.linalg.eigvalsh(pseudo_inertia(body))
        mass = float(body[9])
        principal = np.full(3, np.nan)
        reason = ""
        if mass <= 0.0:
            reason = f"{label}: mass {mass:.6g} kg is not positive"
        else:
            principal = np.linalg.eigvalsh(to_com(body)[2])
            if eigenvalues[0] < -tolerance * max(eigenvalues[-1], 1e-300):
                if principal[0] < 0.0:
                    reason = f"{label}: principal moment of inertia {principal[0]:.6g} kg m^2 is negative"
                else:
                    reason = (
                        f"{label}: principal moments {principal[0]:.6g} + {principal[1]:.6g} < "
                        f"{principal[2]:.6g} kg m^2 violate the triangle inequality"
                    )
        moments = (float(principal[0]), float(principal[1]), float(principal[2]))
        verdicts.append(Consistency(label, mass, float(eigenvalues[0]), moments, not reason, reason))
    return tuple(verdicts)
