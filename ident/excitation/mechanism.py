"""The arm's geometry as plain arrays, the form that the compiled sweeps read.

`dynamics.kinematics.Chain` is the arm everywhere else, and every number here is taken from it. The search for a motion
needs the same numbers as contiguous arrays of rotations and translations, because its forward and reverse sweeps
(`sweep`, `space`: values and exact gradients in one compiled loop over the samples) cannot read an object, and it
needs the flange, which the limits of the workspace are about and which no dynamic parameter refers to.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from fri.errors import ConfigurationError
from ident.dynamics.kinematics import Chain
from ident.dynamics.urdf import read_urdf
from ident.excitation.motion import Array

__all__ = ["Mechanism", "tip_path"]


@dataclass(frozen=True, eq=False)
class Mechanism:
    """A serial arm of revolute joints about their frames' z axes, and the flange at its end.

    rotation (n, 3, 3), translation (n, 3): placement of joint frame i in frame i - 1 at q_i = 0 [m]
    gravity (3,): [m/s²] in frame 0; tip (3,): flange in the last frame [m]
    bodies (n, 10): nominal XX XY XZ YY YZ ZZ MX MY MZ M of each link about its frame's origin
    base (4, 4): frame 0 in the root link; links (n, 4, 4): each URDF link frame in its joint frame
    """

    rotation: Array
    translation: Array
    gravity: Array
    tip: Array
    bodies: Array
    base: Array
    links: Array
    joint_names: tuple[str, ...]
    chain: Chain

    @property
    def joints(self) -> int:
        """Number of joints."""
        return int(self.translation.shape[0])

    @property
    def dynamics(self) -> tuple[Array, Array, Array]:
        """Rotation, translation, gravity, as the sweeps take them."""
        return self.rotation, self.translation, self.gravity

    @property
    def geometry(self) -> tuple[Array, Array, Array]:
        """Rotation, translation, flange, as the distances take them."""
        return self.rotation, self.translation, self.tip

    @classmethod
    def from_urdf(cls, urdf: str, tip: str = "flange") -> Mechanism:
        """Read the arm from URDF text; ConfigurationError if it is no serial chain of revolute joints.

        tip : link whose position the workspace bounds; where the URDF lacks `flange`, the last link's origin.
        """
        chain = Chain.from_urdf(urdf)
        for name, sliding in zip(chain.joint_names, chain.prismatic, strict=True):
            if sliding:
                raise ConfigurationError(
                    f"joint {name} is prismatic; exciting motions are for revolute joints"
                )
        tree = read_urdf(urdf)
        flange = np.eye(4)
        if tip == "flange" and not any(joint.child == tip for joint in tree.joints):
            tip = chain.link_names[-1]
        for joint in tree.chain(None, tip):
            flange = np.eye(4) if joint.movable else flange @ joint.origin
        links = np.array(chain.link_placements)
        placements = np.array([chain.placement(joint) for joint in range(chain.n)])
        return cls(
            rotation=np.ascontiguousarray(placements[:, :3, :3]),
            translation=np.ascontiguousarray(placements[:, :3, 3]),
            gravity=np.array(chain.gravity),
            tip=np.ascontiguousarray((links[-1] @ flange)[:3, 3]),
            bodies=chain.urdf_inertials(),
            base=np.array(chain.base_placement),
            links=links,
            joint_names=chain.joint_names,
            chain=chain,
        )


def tip_path(mechanism: Mechanism, q: Array) -> Array:
    """Flange position (n, 3) [m] at the postures q (n, joints).

    Axes of frame 0, origin where the first joint's frame is: for the LWR4+ the shoulder, 0.31 m above the
    base plate, which is the base frame of the paper's Denavit-Hartenberg table.
    """
    out = np.empty((q.shape[0], 3))
    _tip(mechanism.geometry, np.ascontiguousarray(q), out)
    return out


@njit(cache=True, error_model="numpy")
def _tip(arm, q, out):  # type: ignore[no-untyped-def]
    rotation, translation, tip = arm
    m, n = q.shape
    for i in range(m):
        x, y, z = tip[0], tip[1], tip[2]
        for b in range(n - 1, -1, -1):
            c, s = np.cos(q[i, b]), np.sin(q[i, b])
            u, v, w = c * x - s * y, s * x + c * y, z
            r = rotation[b]
            x = r[0, 0] * u + r[0, 1] * v + r[0, 2] * w
            y = r[1, 0] * u + r[1, 1] * v + r[1, 2] * w
            z = r[2, 0] * u + r[2, 1] * v + r[2, 2] * w
            if b > 0:
                x += translation[b, 0]
                y += translation[b, 1]
                z += translation[b, 2]
        out[i, 0], out[i, 1], out[i, 2] = x, y, z
