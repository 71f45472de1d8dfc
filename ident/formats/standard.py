"""The input of all exports: an arm with one payload and numbers for every standard parameter.

`standard_model` makes it from an identified model, with or without physically consistent bodies.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from fri.errors import ConfigurationError
from ident.dynamics.kinematics import Chain
from ident.dynamics.parameters import INERTIAL, PER_LINK, Floats, from_com
from ident.dynamics.physical import Projection, project, reference_bodies
from ident.dynamics.structure import Side
from ident.effects import PRESLIDING, find_effect, in_force
from ident.model.dynamic_model import DynamicModel


@dataclass(frozen=True)
class CoupledDrives:
    """Two joints (counted from 0) with coupled drives: inertia [kg m^2], viscous [Nm s/rad], coulomb [Nm]."""

    joints: tuple[int, int]
    inertia: float
    viscous: float
    coulomb: float


@dataclass(frozen=True, eq=False)
class StandardModel:
    """Numbers for every standard parameter of a chain, with the payload (if any) as part of the last link.

    inertial : (n, 10) XX ... M of each link in its modified-DH frame. drive : (n, 7) Ia ... offm.
    sides : torques of the model: joint torque, motor torque, or only their difference.
    coulomb_kind, coulomb_width : the function for sign(qd).
    consistent : whether every link is physically consistent (needed for URDF and MJCF, not for code).
    title : one line for the head of a file.
    sensors : entries of the sensors' errors, part of measured torques alone.
    effects : entries of a model's effects that add to its torques. loaded : whether the payload is mounted, or the
    model has none. bodies : (n, 10) as the effects see them.
    """

    chain: Chain
    inertial: Floats
    drive: Floats
    couplings: tuple[CoupledDrives, ...] = ()
    sides: tuple[str, ...] = ("motor", "joint")
    coulomb_kind: str = "sign"
    coulomb_width: float = 0.0
    consistent: bool = False
    title: str = ""
    notes: tuple[str, ...] = field(default=())
    effects: tuple[Mapping[str, Any], ...] = ()
    loaded: bool = True
    bodies: Floats = field(default_factory=lambda: np.zeros((0, 10)))
    sensors: tuple[Mapping[str, Any], ...] = ()

    def __post_init__(self) -> None:
        for name, width in (("inertial", 10), ("drive", 7)):
            values = np.array(getattr(self, name), dtype=np.float64)
            if values.shape != (self.chain.n, width) or not np.all(np.isfinite(values)):
                raise ConfigurationError(
                    f"`{name}` has shape {values.shape} or is not finite; expected ({self.chain.n}, {width})"
                )
            values.setflags(write=False)
            object.__setattr__(self, name, values)

    @property
    def base_gravity(self) -> Floats:
        """(3,) acceleration of gravity in the axes of the base, which is the root of the URDF [m/s^2]."""
        return np.asarray(self.chain.base_placement[:3, :3] @ self.chain.gravity)

    def without(self, entries: Sequence[Mapping[str, Any]], file: str = "this file") -> tuple[str, ...]:
        """Notes on a file without some of the effects; none if it has all."""
        if not entries:
            return ()
        joints: dict[str, list[str]] = {}
        for entry in entries:
            names = [self.chain.joint_names[int(joint) - 1] for joint in entry["joints"]]
            joints.setdefault(str(entry["cause"]), []).extend(names)
        named = ", ".join(cause + (f" ({', '.join(own)})" if own else "") for cause, own in joints.items())
        missing = f"Effects of the model missing in {file}: {named}."
        if set(joints) == {PRESLIDING.cause}:
            return (missing,)
        return (
            missing,
            "The parameters were estimated together with these effects; without them, a model identified "
            "without effects predicts better.",
        )


_LINK, _BODY = len(PER_LINK), len(INERTIAL)
_STATES = 200


@dataclass(frozen=True, eq=False)
class ConsistentParameters:
    """Physically consistent standard parameters (n_columns,), and the change of torque.

    projection : the cone program's result, its base parameters in the order of `names`.
    torque_change_nm : (n,) RMS change of the joint torque at random states [Nm]; zero when exact.
    """

    vector: Floats
    names: tuple[str, ...]
    projection: Projection
    torque_change_nm: Floats

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes for the exported file."""
        if self.projection.exact:
            return ("Physically consistent bodies; the torque of the bodies is exactly the identified one.",)
        order = np.argsort(-np.abs(self.projection.shift))
        moved = ", ".join(
            f"{self.names[k]} by {self.projection.shift[k]:+.1f} sigma"
            for k in order[:3]
            if abs(self.projection.shift[k]) > 0.05
        )
        return (
            "No real bodies have the identified base parameters; the nearest ones were taken"
            + (f" ({moved})." if moved else "."),
            "RMS change of the joint torque at random states [Nm]: "
            + " ".join(f"{value:.3g}" for value in self.torque_change_nm),
        )


def standard_model(
    model: DynamicModel,
    *,
    payload: str | None = None,
    consistent: bool = False,
    reference: Floats | None = None,
) -> StandardModel:
    """The model with one payload (or none) mounted, ready for export.

    consistent : physically consistent bodies, see `consistent_parameters`; else the base parameters as they are
        and zero for the rest, with the same torque in the fewest operations.
    reference : (bodies, 10) of `consistent_parameters`.

    Raises ConfigurationError for an unknown payload, and for `consistent` with a model of torque differences.
    """
    structure, n = model.structure, model.structure.chain.n
    notes: tuple[str, ...] = ()
    if consistent:
        found = consistent_parameters(model, reference)
        vector, notes = found.vector, found.notes
    else:
        vector = np.zeros(structure.n_columns)
        vector[model.columns] = model.values
    title = f"{model.robot}, {'bare arm' if payload is None else f'payload {payload}'}"
    return StandardModel(
        chain=structure.chain,
        inertial=model.inertial(payload, standard=vector),
        drive=vector[: _LINK * n].reshape(n, _LINK)[:, _BODY:],
        couplings=_couplings(model, vector),
        sides=structure.sides,
        coulomb_kind=structure.coulomb.kind,
        coulomb_width=structure.coulomb.width,
        consistent=consistent,
        title=title,
        notes=notes,
        effects=tuple(entry for entry in model.effects if any(in_force([entry]))),
        sensors=tuple(entry for entry in model.effects if find_effect(str(entry["cause"])).side == "sensor"),
        bodies=model.inertial(payload),
        loaded=model.loaded(payload),
    )


def consistent_parameters(model: DynamicModel, reference: Floats | None = None) -> ConsistentParameters:
    """Standard parameters of the model as physically consistent bodies, see `ident.dynamics.physical`.

    reference : (links + payloads, 10) bodies for the free combinations; default the URDF's, made consistent.

    Base parameters eliminated as not essential (value 0) may move by the median standard deviation of the others
    of their unit. Motor torques alone do not tell the inertia of the first drives from that of the links: what the
    reference bodies leave of their sum is the drives'.

    Raises ConfigurationError for a model of torque differences, without bodies.
    """
    structure, n = model.structure, model.structure.chain.n
    if structure.sides == ("difference",):
        raise ConfigurationError(
            f"the model of {model.robot} describes the difference of motor and joint torque and has no "
            "bodies; export code, or identify Model 1 or 2"
        )
    bodies = structure.n_links
    inertial = np.array([_LINK * link + k for link in range(bodies) for k in range(_BODY)])
    matrix, chi, covariance, names = _base(model)
    vector = np.zeros(structure.n_columns)
    others = np.setdiff1d(np.arange(structure.n_columns), inertial)
    own = np.intersect1d(others, model.columns)
    vector[own] = model.values[[int(np.flatnonzero(model.columns == column)[0]) for column in own]]
    rigid = np.flatnonzero(np.any(matrix[:, inertial] != 0.0, axis=1))
    chi, rest = chi[rigid], matrix[np.ix_(rigid, others)] @ vector[others]
    if covariance is not None:
        covariance = covariance[np.ix_(rigid, rigid)]
    start = _reference(model, reference)
    drives = _regrouped_drives(model)
    told = np.any(matrix[np.ix_(rigid, drives)] != 0.0, axis=1)
    if told.any():
        left = (chi - rest - matrix[np.ix_(rigid, inertial)] @ start.ravel())[told]
        vector[drives] = nnls(matrix[np.ix_(rigid[told], drives)], left)[0]
        rest = matrix[np.ix_(rigid, others)] @ vector[others]
    found = project(matrix[np.ix_(rigid, inertial)], chi - rest, start, covariance=covariance)
    vector[inertial] = found.bodies.ravel()
    change = np.zeros(n) if found.exact else _torque_change(model, vector)
    return ConsistentParameters(vector, tuple(names[k] for k in rigid), found, change)


def _regrouped_drives(model: DynamicModel) -> NDArray[np.int64]:
    """Columns of the drive inertias that are part of other base parameters."""
    if model.base is None:
        return np.zeros(0, dtype=np.int64)
    structure = model.structure
    drives = [structure.names.index(f"Ia{k + 1}") for k in range(structure.chain.n)]
    return np.intersect1d(drives, model.base.dependent)


def _base(model: DynamicModel) -> tuple[Floats, Floats, Floats | None, tuple[str, ...]]:
    """K (b, n_columns), chi (b,), covariance (b, b) or None, names of all base parameters."""
    structure = model.structure
    if model.base is None:
        matrix = np.eye(structure.n_columns)[model.positions]
        return matrix, np.array(model.values), model.covariance, model.names
    count = len(model.base)
    chi = np.zeros(count)
    chi[model.positions] = model.values
    if model.covariance is None:
        return np.array(model.base.matrix), chi, None, model.base.names
    covariance = np.zeros((count, count))
    covariance[np.ix_(model.positions, model.positions)] = model.covariance
    std = np.sqrt(np.diag(model.covariance))
    units = np.array(model.base.units)
    for k in np.setdiff1d(np.arange(count), model.positions):
        alike = std[units[model.positions] == units[k]]
        covariance[k, k] = float(np.median(alike if len(alike) else std)) ** 2
    return np.array(model.base.matrix), chi, covariance, model.base.names


def _reference(model: DynamicModel, reference: Floats | None) -> Floats:
    structure, chain = model.structure, model.structure.chain
    if reference is not None:
        if np.shape(reference) != (structure.n_links, _BODY):
            raise ConfigurationError(
                f"reference bodies have shape {np.shape(reference)}; expected ({structure.n_links}, {_BODY})"
            )
        return reference_bodies(reference)
    links = chain.urdf_inertials() if chain.urdf is not None else np.zeros((chain.n, _BODY))
    links = np.where((links[:, 9] > 0.0)[:, None], links, _rods(chain))
    bodies = model.standard[: _LINK * structure.n_links].reshape(-1, _LINK)[:, :_BODY]
    return reference_bodies(np.vstack([links, bodies[chain.n :]]), gyration_m=0.02)


def _rods(chain: Chain) -> Floats:
    """Bodies of 3 kg halfway to the next joint, for links of unknown inertia."""
    com = [0.5 * chain.placement(k)[:3, 3] for k in range(1, chain.n)] + [np.zeros(3)]
    return np.array([from_com(3.0, place, 3.0 * 0.08**2 * np.eye(3)) for place in com])


def _torque_change(model: DynamicModel, vector: Floats) -> Floats:
    """RMS (n,) of the change at random states, all payloads mounted in turn [Nm]."""
    structure = model.structure
    rng = np.random.default_rng(0)
    shape = (_STATES, structure.chain.n)
    states = rng.uniform(-np.pi, np.pi, shape), rng.uniform(-1, 1, shape), rng.uniform(-3, 3, shape)
    side: Side = "joint" if "joint" in structure.sides else "motor"
    total = np.zeros(structure.chain.n)
    for payload in (None, *structure.payloads):
        matrix = structure.regressor(*states, payload=payload, sides=(side,))
        error = (matrix @ (vector - model.standard)).reshape(structure.chain.n, -1)
        total += np.mean(error**2, axis=1)
    return np.sqrt(total / (1 + len(structure.payloads)))


def _couplings(model: DynamicModel, vector: Floats) -> tuple[CoupledDrives, ...]:
    structure = model.structure
    found = []
    for number, coupling in enumerate(structure.couplings):
        first = _LINK * structure.n_links + 3 * number
        a, b = (structure.chain.joint_names.index(name) for name in coupling.joints)
        found.append(CoupledDrives((a, b), *map(float, vector[first : first + 3])))
    return tuple(found)
