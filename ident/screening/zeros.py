"""Wrong zeros of positions that only the URDF contradicts.

A wrong zero of an elbow between parallel axes turns the bodies behind it; the data remain consistent. So identified
gravity is compared with that of the URDF's bodies, times a factor for each joint, as stated masses are seldom right.
With the wrong zero undone the two agree, if the URDF is roughly right.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ident.dynamics.kinematics import Chain
from ident.dynamics.parameters import INERTIAL, Floats
from ident.dynamics.regressor import rigid_regressor, torque

# Least zero told at the joint with the longest lever, largest sought [rad]: centres of mass of a URDF are 2 degrees
# aside on real arms, 4 on simulated ones with 15 % of error in each coordinate.
_LEAST, _MOST = float(np.radians(5.0)), 0.5
# Difference of gravity left with the zero undone over that before: 0.58 and more on arms without a wrong zero. And over
# the torque, as right as a URDF is: a smaller one contradicts nothing, a larger one remains unexplained.
_LEFT, _RIGHT = 0.45, 0.1
# Least power of gravity in a joint over the largest.
_BEARING = 1e-4
# An angle so close to the end of the range is no minimum [rad]; the search is a hundred times finer.
_STEP = 1e-3


class GravityZero(NamedTuple):
    """Joint (from 0), recorded over true zero [rad], and difference from the URDF's gravity before and after."""

    joint: int
    size: float
    before: float
    after: float


def zero_by_gravity(chain: Chain, q: Floats, bodies: Floats, nominal: Floats) -> GravityZero | None:
    """The wrong zero between identified gravity and the URDF's, None without a clear one.

    q : (N, n) poses. bodies : (10 n,) identified, nominal : of the URDF.
    """
    from scipy.optimize import minimize_scalar  # on use: its import is slow

    still = np.zeros_like(q)
    identified = (rigid_regressor(chain, q, still, still) @ bodies).T
    identified = identified - identified.mean(axis=0)
    power = np.sum(identified**2, axis=0)
    bearing = np.flatnonzero(power > max(_BEARING * float(power.max()), 1e-12))
    target = identified[:, bearing] / np.sqrt(power[bearing])
    if not len(bearing):
        return None

    def left(joint: int, angle: float) -> float:
        """Share (rms) of gravity left by the URDF's, times a factor for each joint, with the joint turned."""
        pose = q.copy()
        pose[:, joint] += angle
        own = torque(chain, pose, still, still, nominal)[:, bearing]
        own = own - own.mean(axis=0)
        factor = np.sum(own * target, axis=0) / np.maximum(np.sum(own**2, axis=0), 1e-300)
        return float(np.linalg.norm(target - factor * own) / np.linalg.norm(target))

    turning = np.flatnonzero(~np.asarray(chain.prismatic))
    best: GravityZero | None = None
    for joint in turning.tolist():
        found = minimize_scalar(
            lambda angle, own=joint: left(own, angle), bounds=(-_MOST, _MOST), method="bounded"
        )
        if best is None or found.fun < best.after:
            best = GravityZero(joint, -float(found.x), left(joint, 0.0), float(found.fun))
    if best is None:
        return None
    # Centres of mass are wrong by lengths, the same of a wrist as of a shoulder: a larger angle of a short lever.
    levers = _levers(chain, q, nominal)
    least = _LEAST * float(levers[turning].max()) / max(float(levers[best.joint]), 1e-12)
    # A least at the end of the range is none.
    if not least <= abs(best.size) < _MOST - _STEP:
        return None
    return best if best.after < min(_LEFT * best.before, _RIGHT) and best.before > _RIGHT else None


def _levers(chain: Chain, q: Floats, nominal: Floats) -> Floats:
    """Distance (n,) [m], rms over poses (N, n), of the centre of mass behind each joint from its axis, along the
    horizontal."""
    still = np.zeros_like(q)
    mass = np.cumsum(nominal.reshape(chain.n, -1)[::-1, INERTIAL.index("M")])[::-1]
    weight = np.maximum(mass * float(np.linalg.norm(chain.gravity)), 1e-12)
    return np.asarray(np.sqrt(np.mean(torque(chain, q, still, still, nominal) ** 2, axis=0)) / weight)
