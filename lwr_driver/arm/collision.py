"""Distances of the arm to itself, the ground and the boxes of the cell, by pinocchio and coal.

Links three joints apart or more are checked against each other; nearer ones share a joint housing and touch
by construction. Links from the second on are checked against ground and boxes.
"""

from __future__ import annotations

import dataclasses
import math
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from functools import cached_property

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from fri.errors import ConfigurationError
from lwr_driver.arm import JOINTS, Arm
from lwr_driver.arm.cell import Cell, PayloadShape
from lwr_driver.configuration import expect

_APART = 3  # joints between two links of a checked pair
_PAYLOAD_APART = 2  # the payload extends further back than the flange
_FIRST_MOVING = 2  # first link to come near ground or boxes; link 1 turns about its own axis
_STEP = math.radians(0.5)  # largest motion of a joint between two checked postures


@dataclass(frozen=True, eq=False)
class Clearance:
    """The smallest distance, its two bodies, and its place in a path.

    distance : [m]; negative if the bodies overlap
    pair : names of the two bodies: links, `payload`, `ground` or boxes of the cell
    points : (2, 3), the nearest points in `base_link` [m]
    q : (7,), the posture [rad]; row and time_s : place in the path, 0 for a single posture
    """

    distance: float
    pair: tuple[str, str]
    points: NDArray[np.float64]
    q: NDArray[np.float64]
    row: int = 0
    time_s: float = 0.0

    def __str__(self) -> str:
        at = ", ".join(f"{value:.3f}" for value in self.points.mean(axis=0))
        return (
            f"{' to '.join(self.pair)} {1000.0 * self.distance:.1f} mm at ({at}) m, t = {self.time_s:.3f} s"
        )


class CollisionChecker:
    """Distances of the arm to itself, to the ground and to the boxes of the cell.

    arm : its URDF holds the geometry; cell : the surroundings; payload : the shape on the flange
    """

    def __init__(self, arm: Arm, cell: Cell, payload: PayloadShape | None = None) -> None:
        expect(arm, Arm, "arm of a collision check", "give `Arm.load()`")
        expect(cell, Cell, "cell of a collision check", "give `Cell.load()`")
        self.arm, self.cell, self.payload = arm, cell, payload
        try:
            self._model = pin.buildModelFromXML(arm.urdf)
        except (ValueError, RuntimeError) as error:
            raise ConfigurationError(f"{arm.urdf_path}: cannot be read as a URDF: {error}") from error
        if self._model.nq != JOINTS:
            raise ConfigurationError(f"{arm.urdf_path}: {self._model.nq} moving joints; the arm has {JOINTS}")
        try:
            geometry = pin.buildGeomFromUrdfString(self._model, arm.urdf, pin.GeometryType.COLLISION)
        except (ValueError, RuntimeError) as error:
            raise ConfigurationError(f"{arm.urdf_path}: collision shapes cannot be read: {error}") from error
        wanted = len(ElementTree.fromstring(arm.urdf).findall("link/collision"))
        if geometry.ngeoms == 0 or geometry.ngeoms != wanted:
            raise ConfigurationError(
                f"{arm.urdf_path}: {geometry.ngeoms} of {wanted} collision shapes could be read; a check "
                "against the rest proves nothing. Use sphere, cylinder or box"
            )
        self._links = [int(shape.parentJoint) for shape in geometry.geometryObjects]
        self._names = [self._model.frames[shape.parentFrame].name for shape in geometry.geometryObjects]
        self._geometry = geometry
        self._pairs: list[tuple[int, int]] = []
        self._add_payload()
        self._pair_links()
        self._pair_surroundings()
        for first, second in self._pairs:
            geometry.addCollisionPair(pin.CollisionPair(first, second))
        self._data = self._model.createData()
        self._geometry_data = geometry.createData()

    @property
    def geometry(self) -> pin.GeometryModel:
        """Shapes and checked pairs, for planners with derivatives; not to be changed."""
        return self._geometry

    @property
    def pairs(self) -> int:
        """Number of checked pairs of shapes."""
        return len(self._pairs)

    def clearance(self, q: NDArray[np.float64]) -> Clearance:
        """Smallest distance in the posture q, (7,) [rad]."""
        posture = np.asarray(q, dtype=np.float64)
        if posture.shape != (JOINTS,) or not np.all(np.isfinite(posture)):
            raise ConfigurationError(f"posture {posture} must be {JOINTS} finite joint positions")
        nearest = self._nearest(posture)
        result = self._geometry_data.distanceResults[nearest]
        first, second = self._pairs[nearest]
        points = np.array([result.getNearestPoint1(), result.getNearestPoint2()])
        pair = (self._names[first], self._names[second])
        return Clearance(float(result.min_distance), pair, points, posture.copy())

    def check_path(self, q: NDArray[np.float64], *, period_s: float = 0.0) -> Clearance:
        """Smallest distance along the path q, (n, 7) [rad], rows `period_s` apart [s].

        It is computed at postures at most half a degree apart in any joint. In between, a point of the arm
        comes nearer by a few millimetres at most; the margin of the cell covers these.
        """
        path = np.asarray(q, dtype=np.float64)
        if path.ndim != 2 or path.shape[1] != JOINTS or len(path) == 0 or not np.all(np.isfinite(path)):
            raise ConfigurationError(f"path of shape {path.shape} must be (rows, {JOINTS}) and finite")
        postures, place = _subsample(path)
        results = self._geometry_data.distanceResults
        distances = [results[self._nearest(posture)].min_distance for posture in postures]
        best = int(np.argmin(distances))
        row = float(place[best])
        return dataclasses.replace(self.clearance(postures[best]), row=int(row), time_s=row * period_s)

    def distance(self, q: NDArray[np.float64]) -> float:
        """Smallest distance in the posture q, (7,) [rad], alone and unchecked [m]."""
        return float(self._geometry_data.distanceResults[self._nearest(q)].min_distance)

    @cached_property
    def reach(self) -> NDArray[np.float64]:
        """Longest distance of a point of the arm or its payload from each joint in any posture, (7,) [m].

        No distance changes by more than sum(reach |dq|) between two postures.
        """
        reach = np.zeros(JOINTS + 1)
        for joint, shape in zip(self._links, self._geometry.geometryObjects, strict=True):
            if joint == 0:
                continue
            body = shape.geometry
            body.computeLocalAABB()
            size = float(np.linalg.norm(body.aabb_center) + body.aabb_radius)
            reach[joint] = max(reach[joint], float(np.linalg.norm(shape.placement.translation)) + size)
        for joint in range(JOINTS - 1, 0, -1):
            link = float(np.linalg.norm(self._model.jointPlacements[joint + 1].translation))
            reach[joint] = max(reach[joint], link + reach[joint + 1])
        return reach[1:]

    def _nearest(self, q: NDArray[np.float64]) -> int:
        return int(pin.computeDistances(self._model, self._data, self._geometry, self._geometry_data, q))

    def _add_payload(self) -> None:
        if self.payload is None:
            return
        size = self.payload.size_m
        shape = {
            "sphere": lambda: coal.Sphere(size[0]),
            "cylinder": lambda: coal.Cylinder(size[0], size[1]),
            "box": lambda: coal.Box(np.array(size)),
        }[self.payload.shape]()
        joint = self._model.njoints - 1
        frame = self._model.getFrameId(self._names[-1])
        self._add("payload", joint, frame, _placement(self.payload.centre_m, self.payload.rpy_deg), shape)

    def _add(self, name: str, joint: int, frame: int, placement: pin.SE3, shape: coal.ShapeBase) -> int:
        if self._geometry.existGeometryName(name):
            raise ConfigurationError(
                f"{name!r} names a link of the arm; choose another name in the cell file"
            )
        body = pin.GeometryObject(name, joint, frame, placement, shape)
        index = int(self._geometry.addGeometryObject(body))
        self._links.append(joint)
        self._names.append(name)
        return index

    def _pair_links(self) -> None:
        for second in range(len(self._links)):
            apart = _PAYLOAD_APART if self._names[second] == "payload" else _APART
            for first in range(second):
                if self._links[second] - self._links[first] >= apart:
                    self._pairs.append((first, second))

    def _pair_surroundings(self) -> None:
        moving = [index for index, link in enumerate(self._links) if link >= _FIRST_MOVING]
        fixed = []
        if self.cell.ground_z_m is not None:
            ground = coal.Halfspace(np.array([0.0, 0.0, 1.0]), self.cell.ground_z_m)
            fixed.append(self._add("ground", 0, 0, pin.SE3.Identity(), ground))
        for box in self.cell.boxes:
            placement = _placement(box.centre_m, box.rpy_deg)
            fixed.append(self._add(box.name, 0, 0, placement, coal.Box(np.array(box.size_m))))
        self._pairs += [(body, thing) for thing in fixed for body in moving]


def _placement(centre: tuple[float, float, float], rpy_deg: tuple[float, float, float]) -> pin.SE3:
    return pin.SE3(pin.rpy.rpyToMatrix(np.radians(np.array(rpy_deg))), np.array(centre))


def _subsample(path: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Postures along the path at most `_STEP` apart in any joint, and their place in rows."""
    travelled = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(path, axis=0)).max(axis=1))])
    if travelled[-1] == 0.0:
        return path[:1], np.zeros(1)
    marks = np.linspace(0.0, travelled[-1], max(2, math.ceil(travelled[-1] / _STEP) + 1))
    # The smallest distance is often at the reversal of a joint.
    direction = np.sign(np.diff(path, axis=0))
    turns = np.flatnonzero(np.any(direction[1:] * direction[:-1] < 0.0, axis=1)) + 1
    marks = np.union1d(marks, travelled[turns])
    # Rows at rest share one mark; the first of them stands for all.
    distinct = np.concatenate([[True], np.diff(travelled) > 0.0])
    rows = np.arange(len(path))[distinct]
    place = np.interp(marks, travelled[distinct], rows)
    whole = np.minimum(place.astype(int), len(path) - 2)
    part = (place - whole)[:, None]
    return (1.0 - part) * path[whole] + part * path[whole + 1], place
