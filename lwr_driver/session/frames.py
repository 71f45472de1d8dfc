"""Poses of the link frames from the joint positions, for `/tf`: by batches, straight from the URDF."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fri.errors import ConfigurationError

__all__ = ["LinkFrames"]


@dataclass(frozen=True)
class _Joint:
    name: str
    kind: str
    origin: NDArray[np.float64]
    rotation: NDArray[np.float64]
    axis: NDArray[np.float64]


class LinkFrames:
    """Pose of every link relative to its parent, as `/tf` wants it: no chain has to be multiplied.

    A joint with origin (p, r) and axis a at position q has the translation p and the rotation r * (cos q/2, a
    sin q/2) (quaternions); a prismatic joint has the translation p + q R(r) a and the rotation r.

    pairs : (parent, child) links in the order of the URDF
    """

    def __init__(self, urdf: str) -> None:
        try:
            robot = ElementTree.fromstring(urdf)
        except ElementTree.ParseError as error:
            raise ConfigurationError(f"robot description is not XML: {error}") from error
        self._joints: list[_Joint] = []
        pairs: list[tuple[str, str]] = []
        for joint in robot.iterfind("joint"):
            name, kind = joint.get("name", ""), joint.get("type", "")
            if kind not in ("revolute", "continuous", "prismatic", "fixed"):
                raise ConfigurationError(
                    f"robot description: joint {name!r} of type {kind!r} is not understood"
                )
            parent, child = joint.find("parent"), joint.find("child")
            if parent is None or child is None:
                raise ConfigurationError(f"robot description: joint {name!r} lacks its parent or child link")
            pairs.append((parent.get("link", ""), child.get("link", "")))
            origin, axis = joint.find("origin"), joint.find("axis")
            xyz = _numbers(name, origin.get("xyz", "0 0 0") if origin is not None else "0 0 0")
            rpy = _numbers(name, origin.get("rpy", "0 0 0") if origin is not None else "0 0 0")
            direction = _numbers(name, axis.get("xyz", "1 0 0") if axis is not None else "1 0 0")
            norm = float(np.linalg.norm(direction))
            if norm == 0.0:
                raise ConfigurationError(f"robot description: joint {name!r} has an axis of length zero")
            self._joints.append(_Joint(name, kind, xyz, _from_rpy(rpy), direction / norm))
        self.pairs: tuple[tuple[str, str], ...] = tuple(pairs)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """The moving joints of the URDF in its order."""
        return tuple(joint.name for joint in self._joints if joint.kind != "fixed")

    def poses(self, joint_names: Sequence[str], q: ArrayLike) -> NDArray[np.float64]:
        """Poses x y z [m], quaternion x y z w of every link relative to its parent: (n, links, 7).

        joint_names : names of the columns of `q`; joints of the URDF that are not among them stay at zero
        q : (n, J) float64, joint positions [rad] or [m]
        """
        positions = np.asarray(q, dtype=np.float64)
        column = {name: index for index, name in enumerate(joint_names)}
        out = np.empty((len(positions), len(self._joints), 7))
        for index, joint in enumerate(self._joints):
            out[:, index, :3] = joint.origin
            out[:, index, 3:] = joint.rotation
            if joint.kind == "fixed" or joint.name not in column:
                continue
            value = positions[:, column[joint.name]]
            if joint.kind == "prismatic":
                out[:, index, :3] += value[:, None] * _rotate(joint.rotation, joint.axis)
            else:
                turn = np.empty((len(value), 4))
                turn[:, :3] = np.sin(0.5 * value)[:, None] * joint.axis
                turn[:, 3] = np.cos(0.5 * value)
                out[:, index, 3:] = _multiply(joint.rotation, turn)
        return out


def _numbers(name: str, text: str) -> NDArray[np.float64]:
    try:
        values = np.array([float(word) for word in text.split()])
    except ValueError:
        values = np.empty(0)
    if values.shape != (3,) or not np.isfinite(values).all():
        raise ConfigurationError(f"robot description: joint {name!r} has {text!r} where three numbers belong")
    return values


def _from_rpy(rpy: NDArray[np.float64]) -> NDArray[np.float64]:
    """Quaternion x y z w of the rotation Rz(yaw) Ry(pitch) Rx(roll)."""
    (sr, sp, sy), (cr, cp, cy) = np.sin(0.5 * rpy), np.cos(0.5 * rpy)
    return np.array(
        [
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
            cr * cp * cy + sr * sp * sy,
        ]
    )


def _multiply(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Product of the quaternion `a` (4,) with each of `b` (n, 4)."""
    vector = a[3] * b[:, :3] + b[:, 3:] * a[:3] + np.cross(a[:3], b[:, :3])
    scalar = a[3] * b[:, 3] - b[:, :3] @ a[:3]
    return np.concatenate([vector, scalar[:, None]], axis=1)


def _rotate(rotation: NDArray[np.float64], vector: NDArray[np.float64]) -> NDArray[np.float64]:
    twice = 2.0 * np.cross(rotation[:3], vector)
    return vector + rotation[3] * twice + np.cross(rotation[:3], twice)
