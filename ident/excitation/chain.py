"""The arm's geometry as plain arrays, the form that the compiled sweeps read."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pinocchio as pin
from numba import njit

from fri.errors import ConfigurationError
from ident.excitation.motion import Array
from ident.parameters import from_pinocchio

__all__ = ["Chain", "tip_path"]

GRAVITY = 9.81


@dataclass(frozen=True, eq=False)
class Chain:
    """A serial chain of revolute joints about their frames' z axes, and the flange at its end.

    rotation (n, 3, 3), translation (n, 3): placement of joint frame i in frame i - 1 at q_i = 0 [m]
    gravity (3,): [m/s²] in the base frame; tip (3,): flange in the last frame [m]
    bodies (n, 10): nominal XX XY XZ YY YZ ZZ MX MY MZ M of each link about its frame's origin
    """

    rotation: Array
    translation: Array
    gravity: Array
    tip: Array
    bodies: Array
    joint_names: tuple[str, ...]

    @property
    def joints(self) -> int:
        """Number of joints."""
        return int(self.translation.shape[0])

    @classmethod
    def from_urdf(cls, urdf: str, tip: str = "flange", gravity: float = GRAVITY) -> Chain:
        """Read a chain from URDF text; ConfigurationError if it is no serial chain of revolute z joints."""
        try:
            model = pin.buildModelFromXML(urdf)
        except (ValueError, RuntimeError) as error:
            raise ConfigurationError(f"URDF not readable: {error}") from error
        n = model.njoints - 1
        if n < 1:
            raise ConfigurationError("the URDF has no moving joint, so there is no motion to plan")
        names = tuple(str(name) for name in list(model.names)[1:])
        for index in range(1, n + 1):
            if model.joints[index].shortname() != "JointModelRZ":
                raise ConfigurationError(
                    f"joint {names[index - 1]} is a {model.joints[index].shortname()}; exciting motions are "
                    "planned for revolute joints about the z axis of their frame"
                )
            if model.parents[index] != index - 1:
                raise ConfigurationError(
                    f"joint {names[index - 1]} branches off; the arm must be one serial chain"
                )
        flange = np.zeros(3)
        if model.existFrame(tip):
            frame = model.frames[model.getFrameId(tip)]
            if frame.parentJoint != n:
                raise ConfigurationError(f"frame {tip} is not carried by the last joint")
            flange = np.array(frame.placement.translation)
        elif tip != "flange":
            raise ConfigurationError(f"the URDF has no link {tip}")
        placements = [model.jointPlacements[index] for index in range(1, n + 1)]
        return cls(
            rotation=np.ascontiguousarray([placement.rotation for placement in placements]),
            translation=np.ascontiguousarray([placement.translation for placement in placements]),
            gravity=np.array([0.0, 0.0, -gravity]),
            tip=flange,
            bodies=np.array(
                [from_pinocchio(model.inertias[index].toDynamicParameters()) for index in range(1, n + 1)]
            ),
            joint_names=names,
        )

    @classmethod
    def from_file(cls, path: Path, tip: str = "flange") -> Chain:
        """Read a chain from a URDF file."""
        return cls.from_urdf(path.read_text(encoding="utf-8"), tip)


def tip_path(chain: Chain, q: Array) -> Array:
    """Flange position in the frame of the first joint (the base frame of the Denavit-Hartenberg table), (n,
    3) [m].
    """
    out = np.empty((q.shape[0], 3))
    _tip(chain.rotation, chain.translation, chain.tip, np.ascontiguousarray(q), out)
    return out


@njit(cache=True, error_model="numpy")
def _tip(rotation, translation, tip, q, out):  # type: ignore[no-untyped-def]
    m, n = q.shape
    for i in range(m):
        x, y, z = tip[0], tip[1], tip[2]
        for b in range(n - 1, -1, -1):
            c, s = np.cos(q[i, b]), np.sin(q[i, b])
            u, v = c * x - s * y, s * x + c * y
            r = rotation[b]
            w = z
            x = r[0, 0] * u + r[0, 1] * v + r[0, 2] * w
            y = r[1, 0] * u + r[1, 1] * v + r[1, 2] * w
            z = r[2, 0] * u + r[2, 1] * v + r[2, 2] * w
            if b > 0:
                x += translation[b, 0]
                y += translation[b, 1]
                z += translation[b, 2]
        out[i, 0], out[i, 1], out[i, 2] = x, y, z
