"""Prior of an arm's bodies by its URDF, for the parameters of `Redundancy`."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from ident.dynamics.kinematics import Chain
from ident.dynamics.parameters import INERTIAL
from ident.estimators.physical import BodyPrior, lacking_bodies, nearest_consistent
from ident.estimators.prior import Prior


# Every change of the rows asks again.
@lru_cache(maxsize=16)
def nominal(chain: Chain, width: int, relative_std: float) -> Prior:
    """Prior of `width` parameters, those of the bodies first, the others free; without bodies all are.

    relative_std : as of `BodyPrior`. Placeholder masses are no knowledge.
    """
    if lacking_bodies(chain) or chain.placeholder_masses():
        return Prior(np.zeros(width), np.zeros((width, width)))
    places = np.arange(len(INERTIAL) * chain.n).reshape(chain.n, -1)
    bodies = BodyPrior(
        np.eye(width),
        places,
        np.zeros(0, dtype=np.int64),
        nearest_consistent(chain.urdf_inertials()),
        relative_std=relative_std,
    )
    return Prior(bodies.standard, bodies.hessian("pullback"))
