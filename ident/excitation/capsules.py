"""Capsules that enclose the collision shapes of the arm, the payload and the cell, for the optimiser's
distances.

A capsule encloses its shape wholly, so a motion that keeps the capsules apart keeps the shapes apart; the
collision checker, which knows the shapes themselves, has the last word all the same.
"""

from __future__ import annotations

import coal
import numpy as np
import pinocchio as pin

from fri.errors import ConfigurationError
from ident.excitation.mechanism import Mechanism
from ident.excitation.motion import Array
from ident.excitation.space import Space

__all__ = ["enclose", "space_of"]

_RIM = 0.4  # share of the radius by which the segment ends before the flat end of a cylinder


def enclose(shape: coal.CollisionGeometry) -> tuple[Array, float]:
    """Segment ends (2, 3) [m] in the shape's frame and radius [m] of a capsule around a shape."""
    if isinstance(shape, coal.Sphere):
        return np.zeros((2, 3)), float(shape.radius)
    if isinstance(shape, coal.Capsule):
        return _segment(np.array([0.0, 0.0, 1.0]), float(shape.halfLength)), float(shape.radius)
    if isinstance(shape, coal.Cylinder):
        axis, half, radius = np.array([0.0, 0.0, 1.0]), float(shape.halfLength), float(shape.radius)
    elif isinstance(shape, coal.Box):
        sides = np.array(shape.halfSide)
        longest = int(np.argmax(sides))
        axis, half = np.eye(3)[longest], float(sides[longest])
        radius = float(np.linalg.norm(np.delete(sides, longest)))
    else:
        raise ConfigurationError(
            f"collision shape {type(shape).__name__} is not understood; use sphere, capsule, cylinder or box"
        )
    inset = min(_RIM * radius, half)
    return _segment(axis, half - inset), float(np.hypot(radius, inset))


def _segment(axis: Array, half: float) -> Array:
    return np.stack([-half * axis, half * axis])


def space_of(mechanism: Mechanism, geometry: pin.GeometryModel | None) -> tuple[Space, tuple[str, ...]]:
    """The distances of a collision model's pairs as capsules, and a name for each row of `Space`.

    Frame 0 stands where the first joint's frame is at zero. Without a geometry only the flange rows remain.
    """
    names = ["flange distance from axis 1", "flange height"]
    if geometry is None:
        return Space(), tuple(names)
    to_zero = np.linalg.inv(mechanism.base)
    to_zero[:3, 3] -= mechanism.translation[0]
    body: list[int] = []
    ends: list[Array] = []
    thickness: list[float] = []
    place: dict[int, int] = {}
    pairs: list[tuple[int, int]] = []
    grounded: list[int] = []
    boxed: list[tuple[int, int]] = []
    boxes: list[tuple[Array, Array]] = []
    box_place: dict[int, int] = {}
    ground = -np.inf
    pair_names: list[str] = []
    ground_names: list[str] = []
    box_names: list[str] = []

    def capsule(index: int) -> int:
        if index not in place:
            item = geometry.geometryObjects[index]
            segment, radius = enclose(item.geometry)
            joint = int(item.parentJoint)
            frame = to_zero if joint == 0 else mechanism.links[joint - 1]
            pose = frame @ np.array(item.placement.homogeneous)
            place[index] = len(body)
            body.append(joint - 1)
            ends.append(segment @ pose[:3, :3].T + pose[:3, 3])
            thickness.append(radius)
        return place[index]

    for pair in geometry.collisionPairs:
        first, second = int(pair.first), int(pair.second)
        shapes = [geometry.geometryObjects[index] for index in (first, second)]
        fixed = [k for k in range(2) if int(shapes[k].parentJoint) == 0]
        label = f"{shapes[0].name} to {shapes[1].name}"
        flat = [k for k in fixed if isinstance(shapes[k].geometry, coal.Halfspace)]
        solid = [k for k in fixed if isinstance(shapes[k].geometry, coal.Box)]
        if flat:
            half = shapes[flat[0]].geometry
            if not np.allclose(half.n, [0.0, 0.0, 1.0]):
                raise ConfigurationError(f"{shapes[flat[0]].name}: only a level ground is understood")
            ground = float((to_zero @ np.array([0.0, 0.0, half.d, 1.0]))[2])
            grounded.append(capsule((first, second)[1 - flat[0]]))
            ground_names.append(label)
        elif solid:
            index = (first, second)[solid[0]]
            if index not in box_place:
                box_place[index] = len(boxes)
                pose = to_zero @ np.array(shapes[solid[0]].placement.homogeneous)
                boxes.append((np.array(shapes[solid[0]].geometry.halfSide), pose))
            boxed.append((capsule((first, second)[1 - solid[0]]), box_place[index]))
            box_names.append(label)
        else:
            pairs.append((capsule(first), capsule(second)))
            pair_names.append(label)
    space = Space(
        body=np.array(body, dtype=np.int64),
        ends=np.array(ends).reshape(-1, 2, 3),
        thickness=np.array(thickness, dtype=np.float64),
        pairs=np.array(pairs, dtype=np.int64).reshape(-1, 2),
        ground=ground,
        grounded=np.array(grounded, dtype=np.int64),
        box_size=np.array([size for size, _ in boxes]).reshape(-1, 3),
        box_rotation=np.ascontiguousarray(np.array([pose[:3, :3] for _, pose in boxes]).reshape(-1, 3, 3)),
        box_centre=np.array([pose[:3, 3] for _, pose in boxes]).reshape(-1, 3),
        boxed=np.array(boxed, dtype=np.int64).reshape(-1, 2),
    )
    return space, tuple(names + pair_names + ground_names + box_names)
