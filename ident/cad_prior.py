"""The arm's own URDF as the prior model of an estimation."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from fri.errors import ConfigurationError
from ident.base import BaseSet
from ident.estimators.physical import BodyPrior, nearest_consistent
from ident.parameters import INERTIAL, PER_LINK, from_com, split_name

__all__ = ["cad_prior"]

# A payload of which nothing but perhaps the mass is known: a body of this radius of gyration, anywhere
# within reach.
_PAYLOAD_KG = 3.0
_PAYLOAD_RADIUS_M = 0.1
_PAYLOAD_STD = 3.0
_DISSIPATIVE = ("Ia", "Fvl", "Fcl", "Fvm", "Fcm")


def cad_prior(
    base: BaseSet, *, relative_std: float = 0.2, payload_masses: Mapping[str, float] | None = None
) -> BodyPrior:
    """Prior of the base set's arm: the inertials of the URDF, within `relative_std` of themselves.

    payload_masses : stated mass [kg] by payload name; a payload is otherwise as good as unknown. Inertials
        that belong to no rigid body are replaced by the nearest that do. Raises ConfigurationError for a
        chain without URDF and for a structure without rigid bodies (Model 3).
    """
    structure = base.structure
    if "difference" in structure.sides:
        raise ConfigurationError("Model 3 has no rigid bodies, so a prior of them says nothing; use `wls`")
    n = structure.chain.n
    masses = payload_masses or {}
    spheres = []
    for payload in structure.payloads:
        mass = masses.get(payload, _PAYLOAD_KG)
        inertia = np.eye(3) * mass * _PAYLOAD_RADIUS_M**2
        spheres.append(from_com(mass, np.zeros(3), inertia))
    links = nearest_consistent(structure.chain.urdf_inertials())
    inertial = np.vstack([links, *[sphere[None, :] for sphere in spheres]])
    bodies = np.array(
        [[len(PER_LINK) * k + i for i in range(len(INERTIAL))] for k in range(structure.n_links)],
        dtype=np.int64,
    )
    symbols = [split_name(name)[0] for name in structure.names]
    acts = np.any(base.matrix != 0.0, axis=0)
    rigid = np.zeros(structure.n_columns, dtype=bool)
    rigid[bodies.ravel()] = True
    return BodyPrior(
        projection=np.asarray(base.matrix),
        bodies=bodies,
        nonnegative=np.array(
            [k for k, s in enumerate(symbols) if s in _DISSIPATIVE and acts[k]], dtype=np.int64
        ),
        inertial=inertial,
        absent=np.flatnonzero((~rigid & ~acts) | ~structure.active),
        relative_std=np.array([relative_std] * n + [_PAYLOAD_STD] * len(spheres)),
    )
