"""Distances along a motion with derivatives: flange bounds, self-collision, ground and boxes.

Every body is one or more capsules (segments with a radius) around its collision shape. The distance of two capsules
is the distance of their segments less the radii. Its derivative follows from the nearest points alone (envelope
theorem): a unit force pair along the connecting line, turned into joint torques.

A capsule encloses its shape wholly, so capsules apart mean shapes apart. At the wrist, where the payload is too near
for that, the limit is eased by what the capsules stick out of the shapes. These distances steer the optimisation; the
verdict comes from the collision checker with the shapes themselves.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields

import coal
import numpy as np
import pinocchio as pin
from numba import njit

from fri.errors import ConfigurationError
from ident.excitation.arm_model import Mechanism
from ident.excitation.motions import Array

_FAR = 0.15
_RIM = 0.4  # distance of the segment's end from the flat end of a cylinder, as a share of the radius
_NEAR_JOINTS = 2  # between the payload and the last link that it is kept apart from


@dataclass(frozen=True, eq=False)
class Space:
    """Capsules of the arm and obstacles of the cell, as arrays.

    body (c,): joint frame carrying each capsule, -1 for the base
    ends (c, 2, 3): ends of its segment in this frame [m]; thickness (c,): its radius [m]
    pairs (p, 2): capsules to be kept apart
    ground : height of the ground in frame 0 [m] (-inf: none); grounded (g,): capsules kept above it
    eased : rows of the payload beside the wrist, and by how much both capsules stick out of their shapes [m]; they
        would never be apart by the clearance
    boxes : half sizes (b, 3), placements (b, 3, 3), (b, 3) in frame 0; boxed (k, 2): (capsule, box) pairs
    """

    body: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    ends: Array = field(default_factory=lambda: np.zeros((0, 2, 3)))
    thickness: Array = field(default_factory=lambda: np.zeros(0))
    pairs: np.ndarray = field(default_factory=lambda: np.zeros((0, 2), dtype=np.int64))
    ground: float = -np.inf
    grounded: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    box_size: Array = field(default_factory=lambda: np.zeros((0, 3)))
    box_rotation: Array = field(default_factory=lambda: np.zeros((0, 3, 3)))
    box_centre: Array = field(default_factory=lambda: np.zeros((0, 3)))
    boxed: np.ndarray = field(default_factory=lambda: np.zeros((0, 2), dtype=np.int64))
    eased: tuple[tuple[int, float], ...] = ()

    @property
    def rows(self) -> int:
        """Number of distances at each sample: two of the flange, then pairs, ground, boxes."""
        return 2 + len(self.pairs) + len(self.grounded) + len(self.boxed)

    def floor(self, clearance: float, flange: tuple[float | None, float | None], reserve: float) -> Array:
        """Least distance of each row [m]: bounds of the flange (None: no bound) plus a reserve, then the clearance."""
        floor = np.full(self.rows, clearance)
        floor[:2] = [-np.inf if bound is None else bound + reserve for bound in flange]
        for row, excess in self.eased:
            floor[row] -= excess
        return floor

    def extents(self, joints: int) -> Array:
        """Distance of the farthest point of each body's capsules from the body's frame, (joints,) [m]."""
        farthest = np.zeros(joints)
        for body, ends, thickness in zip(self.body, self.ends, self.thickness, strict=True):
            if body >= 0:
                size = float(np.linalg.norm(ends, axis=1).max() + thickness)
                farthest[body] = max(farthest[body], size)
        return farthest

    @property
    def shapes(self) -> tuple:
        """The fields in the order of the compiled functions."""
        return tuple(getattr(self, item.name) for item in fields(self) if item.name != "eased")


@njit(cache=True, error_model="numpy")
def _segments(p1, q1, p2, q2, out):  # type: ignore[no-untyped-def]
    """Distance of two segments, nearest points into out (Ericson, Real-Time Collision Detection, 5.1.9)."""
    d1x, d1y, d1z = q1[0] - p1[0], q1[1] - p1[1], q1[2] - p1[2]
    d2x, d2y, d2z = q2[0] - p2[0], q2[1] - p2[1], q2[2] - p2[2]
    rx, ry, rz = p1[0] - p2[0], p1[1] - p2[1], p1[2] - p2[2]
    a = d1x * d1x + d1y * d1y + d1z * d1z
    e = d2x * d2x + d2y * d2y + d2z * d2z
    f = d2x * rx + d2y * ry + d2z * rz
    tiny = 1e-12
    s = 0.0
    t = 0.0
    if a <= tiny:
        if e > tiny:
            t = min(max(f / e, 0.0), 1.0)
    else:
        c = d1x * rx + d1y * ry + d1z * rz
        if e <= tiny:
            s = min(max(-c / a, 0.0), 1.0)
        else:
            b = d1x * d2x + d1y * d2y + d1z * d2z
            denominator = a * e - b * b
            if denominator > tiny * a * e:
                s = min(max((b * f - c * e) / denominator, 0.0), 1.0)
            t = (b * s + f) / e
            if t < 0.0:
                t = 0.0
                s = min(max(-c / a, 0.0), 1.0)
            elif t > 1.0:
                t = 1.0
                s = min(max((b - c) / a, 0.0), 1.0)
    out[0, 0], out[0, 1], out[0, 2] = p1[0] + s * d1x, p1[1] + s * d1y, p1[2] + s * d1z
    out[1, 0], out[1, 1], out[1, 2] = p2[0] + t * d2x, p2[1] + t * d2y, p2[2] + t * d2z
    dx, dy, dz = out[0, 0] - out[1, 0], out[0, 1] - out[1, 1], out[0, 2] - out[1, 2]
    return np.sqrt(dx * dx + dy * dy + dz * dz)


@njit(cache=True, error_model="numpy")
def _box_distance(point, half, rotation, centre, normal):  # type: ignore[no-untyped-def]
    """Signed distance of a point to a box and its gradient into `normal`."""
    d = point - centre
    local = np.empty(3)
    outside = 0.0
    inside = -np.inf
    face = 0
    for k in range(3):
        local[k] = rotation[0, k] * d[0] + rotation[1, k] * d[1] + rotation[2, k] * d[2]
        over = abs(local[k]) - half[k]
        if over > 0.0:
            outside += over * over
        if over > inside:
            inside = over
            face = k
    gradient = np.zeros(3)
    if outside > 0.0:
        distance = np.sqrt(outside)
        for k in range(3):
            over = abs(local[k]) - half[k]
            if over > 0.0:
                gradient[k] = np.sign(local[k]) * over / distance
    else:
        distance = inside
        gradient[face] = 1.0 if local[face] >= 0.0 else -1.0
    for k in range(3):
        normal[k] = rotation[k, 0] * gradient[0] + rotation[k, 1] * gradient[1] + rotation[k, 2] * gradient[2]
    return distance


@njit(cache=True, error_model="numpy")
def _frames(rotation, translation, q, turn, origin):  # type: ignore[no-untyped-def]
    """World rotation and origin of each joint frame at one posture."""
    n = q.shape[0]
    for b in range(n):
        c, s = np.cos(q[b]), np.sin(q[b])
        for k in range(3):
            r0, r1, r2 = rotation[b, k, 0], rotation[b, k, 1], rotation[b, k, 2]
            x, y, z = c * r0 + s * r1, c * r1 - s * r0, r2
            turn[b, k, 0], turn[b, k, 1], turn[b, k, 2] = x, y, z
        if b == 0:
            origin[0, 0] = origin[0, 1] = origin[0, 2] = 0.0
        else:
            r = turn[b - 1]
            x, y, z = translation[b, 0], translation[b, 1], translation[b, 2]
            for k in range(3):
                origin[b, k] = origin[b - 1, k] + (r[k, 0] * x + r[k, 1] * y + r[k, 2] * z)
            for column in range(3):
                x, y, z = turn[b, 0, column], turn[b, 1, column], turn[b, 2, column]
                for k in range(3):
                    turn[b, k, column] = r[k, 0] * x + r[k, 1] * y + r[k, 2] * z


@njit(cache=True, error_model="numpy")
def _push(wrench, body, px, py, pz, fx, fy, fz):  # type: ignore[no-untyped-def]
    """Add a force at a point to the wrench (about the world origin) on a body."""
    if body >= 0:
        wrench[body, 0] += fx
        wrench[body, 1] += fy
        wrench[body, 2] += fz
        wrench[body, 3] += py * fz - pz * fy
        wrench[body, 4] += pz * fx - px * fz
        wrench[body, 5] += px * fy - py * fx


@njit(cache=True, error_model="numpy")
def _place(rotation, translation, tip, q, body, ends, turn, origin, world, point):  # type: ignore[no-untyped-def]
    """Frames, capsule ends and flange in frame 0 at one posture."""
    _frames(rotation, translation, q, turn, origin)
    for c in range(body.shape[0]):
        b = body[c]
        for e in range(2):
            for k in range(3):
                world[c, e, k] = ends[c, e, k]
            if b >= 0:
                x, y, z = ends[c, e, 0], ends[c, e, 1], ends[c, e, 2]
                for k in range(3):
                    world[c, e, k] = origin[b, k] + turn[b, k, 0] * x + turn[b, k, 1] * y + turn[b, k, 2] * z
    last = turn[q.shape[0] - 1]
    for k in range(3):
        x, y, z = last[k, 0] * tip[0], last[k, 1] * tip[1], last[k, 2] * tip[2]
        point[k] = origin[q.shape[0] - 1, k] + x + y + z


@njit(cache=True, error_model="numpy")
def _segment_to_box(start, stop, half, rotation, centre, point, normal):  # type: ignore[no-untyped-def]
    """Distance of a segment to a box; nearest point of the segment into `point`, gradient into `normal`."""
    low, high = 0.0, 1.0
    # the distance to a convex body is convex along the segment, so golden section finds its minimum
    for _ in range(24):
        left = high - 0.6180339887498949 * (high - low)
        right = low + 0.6180339887498949 * (high - low)
        for k in range(3):
            point[k] = start[k] + left * (stop[k] - start[k])
        at_left = _box_distance(point, half, rotation, centre, normal)
        for k in range(3):
            point[k] = start[k] + right * (stop[k] - start[k])
        if at_left < _box_distance(point, half, rotation, centre, normal):
            high = right
        else:
            low = left
    share = 0.5 * (low + high)
    for k in range(3):
        point[k] = start[k] + share * (stop[k] - start[k])
    return _box_distance(point, half, rotation, centre, normal)


@njit(cache=True, error_model="numpy")
def _distances(arm, q, value, shapes):  # type: ignore[no-untyped-def]
    rotation, translation, tip = arm
    body, ends, thickness, pairs, ground, grounded, box_size, box_rotation, box_centre, boxed = shapes
    m, n = q.shape
    turn, origin = np.empty((n, 3, 3)), np.empty((n, 3))
    world, point = np.empty((body.shape[0], 2, 3)), np.empty(3)
    near, normal = np.empty((2, 3)), np.empty(3)
    middle = np.empty((body.shape[0], 4))
    for i in range(m):
        _place(rotation, translation, tip, q[i], body, ends, turn, origin, world, point)
        value[i, 0] = np.sqrt(point[0] * point[0] + point[1] * point[1])
        value[i, 1] = point[2]
        row = 2
        for c in range(body.shape[0]):
            half = 0.0
            for k in range(3):
                middle[c, k] = 0.5 * (world[c, 0, k] + world[c, 1, k])
                half += (world[c, 0, k] - middle[c, k]) ** 2
            middle[c, 3] = np.sqrt(half) + thickness[c]
        for k in range(pairs.shape[0]):
            first, second = pairs[k, 0], pairs[k, 1]
            dx = middle[first, 0] - middle[second, 0]
            dy = middle[first, 1] - middle[second, 1]
            dz = middle[first, 2] - middle[second, 2]
            apart = np.sqrt(dx * dx + dy * dy + dz * dz) - middle[first, 3] - middle[second, 3]
            if apart > _FAR:
                # far pairs need no exact distance: the enclosing spheres give a lower bound
                value[i, row + k] = apart
                continue
            gap = _segments(world[first, 0], world[first, 1], world[second, 0], world[second, 1], near)
            value[i, row + k] = gap - thickness[first] - thickness[second]
        row += pairs.shape[0]
        for k in range(grounded.shape[0]):
            c = grounded[k]
            value[i, row + k] = min(world[c, 0, 2], world[c, 1, 2]) - thickness[c] - ground
        row += grounded.shape[0]
        for k in range(boxed.shape[0]):
            c, x = boxed[k, 0], boxed[k, 1]
            apart = _box_distance(middle[c, :3], box_size[x], box_rotation[x], box_centre[x], normal)
            if apart - middle[c, 3] > _FAR:
                value[i, row + k] = apart - middle[c, 3]
                continue
            gap = _segment_to_box(
                world[c, 0], world[c, 1], box_size[x], box_rotation[x], box_centre[x], point, normal
            )
            value[i, row + k] = gap - thickness[c]


@njit(cache=True, error_model="numpy")
def row_gradient(arm, q, row, weight, qbar, shapes):  # type: ignore[no-untyped-def]
    """Set qbar (m, n) to the derivative of sum_i weight_i * distance_i of one row; zero weights are skipped."""
    rotation, translation, tip = arm
    body, ends, _, pairs, _, grounded, box_size, box_rotation, box_centre, boxed = shapes
    m, n = q.shape
    turn, origin = np.empty((n, 3, 3)), np.empty((n, 3))
    world, point = np.empty((body.shape[0], 2, 3)), np.empty(3)
    near, normal = np.empty((2, 3)), np.empty(3)
    wrench = np.empty((n, 6))
    last = n - 1
    for i in range(m):
        for b in range(n):
            qbar[i, b] = 0.0
        if weight[i] == 0.0:
            continue
        _place(rotation, translation, tip, q[i], body, ends, turn, origin, world, point)
        wrench[:] = 0.0
        force = weight[i]
        if row == 0:
            scale = force / max(np.sqrt(point[0] * point[0] + point[1] * point[1]), 1e-9)
            _push(wrench, last, point[0], point[1], point[2], scale * point[0], scale * point[1], 0.0)
        elif row == 1:
            _push(wrench, last, point[0], point[1], point[2], 0.0, 0.0, force)
        elif row < 2 + pairs.shape[0]:
            first, second = pairs[row - 2, 0], pairs[row - 2, 1]
            gap = _segments(world[first, 0], world[first, 1], world[second, 0], world[second, 1], near)
            scale = force / max(gap, 1e-9)
            dx, dy, dz = near[0, 0] - near[1, 0], near[0, 1] - near[1, 1], near[0, 2] - near[1, 2]
            fx, fy, fz = scale * dx, scale * dy, scale * dz
            _push(wrench, body[first], near[0, 0], near[0, 1], near[0, 2], fx, fy, fz)
            _push(wrench, body[second], near[1, 0], near[1, 1], near[1, 2], -fx, -fy, -fz)
        elif row < 2 + pairs.shape[0] + grounded.shape[0]:
            c = grounded[row - 2 - pairs.shape[0]]
            e = 0 if world[c, 0, 2] < world[c, 1, 2] else 1
            _push(wrench, body[c], world[c, e, 0], world[c, e, 1], world[c, e, 2], 0.0, 0.0, force)
        else:
            k = row - 2 - pairs.shape[0] - grounded.shape[0]
            c, x = boxed[k, 0], boxed[k, 1]
            _segment_to_box(
                world[c, 0], world[c, 1], box_size[x], box_rotation[x], box_centre[x], point, normal
            )
            fx, fy, fz = force * normal[0], force * normal[1], force * normal[2]
            _push(wrench, body[c], point[0], point[1], point[2], fx, fy, fz)
        fx = fy = fz = mx = my = mz = 0.0
        for b in range(n - 1, -1, -1):
            fx += wrench[b, 0]
            fy += wrench[b, 1]
            fz += wrench[b, 2]
            mx += wrench[b, 3]
            my += wrench[b, 4]
            mz += wrench[b, 5]
            ox, oy, oz = origin[b, 0], origin[b, 1], origin[b, 2]
            qbar[i, b] = (
                turn[b, 0, 2] * (mx - oy * fz + oz * fy)
                + turn[b, 1, 2] * (my - oz * fx + ox * fz)
                + turn[b, 2, 2] * (mz - ox * fy + oy * fx)
            )


def distances(mechanism: Mechanism, space: Space, q: Array) -> Array:
    """All distances at the postures q (m, n), as (m, rows) [m]; beyond 0.15 m possibly lower bounds."""
    out = np.empty((q.shape[0], space.rows))
    _distances(mechanism.geometry, np.ascontiguousarray(q), out, space.shapes)
    return out


def enclose(shape: coal.CollisionGeometry) -> tuple[Array, float]:
    """Segment ends (2, 3) [m] in the shape's frame and radius [m] of a capsule around a shape."""
    if isinstance(shape, coal.Sphere):
        return np.zeros((2, 3)), float(shape.radius)
    if isinstance(shape, coal.Capsule):
        return _centred(np.array([0.0, 0.0, 1.0]), float(shape.halfLength)), float(shape.radius)
    if isinstance(shape, coal.Cylinder):
        axis, half, radius = np.array([0.0, 0.0, 1.0]), float(shape.halfLength), float(shape.radius)
    elif isinstance(shape, coal.Box):
        sides = np.array(shape.halfSide)
        longest = int(np.argmax(sides))
        axis, half = np.eye(3)[longest], float(sides[longest])
        radius = float(np.linalg.norm(np.delete(sides, longest)))
    else:
        raise ConfigurationError(
            f"collision shape {type(shape).__name__} is not supported; use sphere, capsule, cylinder or box"
        )
    inset = min(_RIM * radius, half)
    return _centred(axis, half - inset), float(np.hypot(radius, inset))


def _excess(shape: coal.CollisionGeometry) -> float:
    """How far the capsule around a shape sticks out of its flat ends [m]."""
    if isinstance(shape, (coal.Sphere, coal.Capsule)):
        return 0.0
    segment, radius = enclose(shape)
    half = max(shape.halfSide) if isinstance(shape, coal.Box) else shape.halfLength
    return float(np.linalg.norm(segment[1]) + radius - half)


def _centred(axis: Array, half: float) -> Array:
    return np.stack([-half * axis, half * axis])


def space_of(mechanism: Mechanism, geometry: pin.GeometryModel | None) -> tuple[Space, tuple[str, ...]]:
    """The distances of a collision model's pairs as capsules, and a name for each row of `Space`.

    Frame 0 is the first joint's frame at zero. Without a geometry only the flange rows remain.
    """
    names = ["flange distance from axis 1", "flange height"]
    if geometry is None:
        return Space(), tuple(names)
    shapes = _Shapes(mechanism, geometry)
    for pair in geometry.collisionPairs:
        shapes.add(int(pair.first), int(pair.second))
    return shapes.space(), (*names, *shapes.names)


class _Shapes:
    """Capsules and boxes around the shapes of a collision model, and the pairs of them with a distance."""

    def __init__(self, mechanism: Mechanism, geometry: pin.GeometryModel) -> None:
        self._mechanism, self._objects = mechanism, geometry.geometryObjects
        self._to_zero = np.linalg.inv(mechanism.base)
        self._to_zero[:3, 3] -= mechanism.translation[0]
        self._capsules: dict[int, tuple[int, Array, float]] = {}  # joint frame, segment, radius by shape
        self._boxes: dict[int, tuple[Array, Array]] = {}  # half sides, pose by shape
        # Capsules and boxes of each row, and its name.
        self._pairs: list[tuple[tuple[int, int], str]] = []
        self._grounded: list[tuple[int, str]] = []
        self._boxed: list[tuple[tuple[int, int], str]] = []
        self._ground = -np.inf
        self._eased: list[tuple[int, float]] = []

    @property
    def names(self) -> list[str]:
        """Names of the rows."""
        return [label for _, label in (*self._pairs, *self._grounded, *self._boxed)]

    def add(self, first: int, second: int) -> None:
        """A pair of shapes with a distance."""
        indices = (first, second)
        shapes = [self._objects[index] for index in indices]
        fixed = [k for k in range(2) if int(shapes[k].parentJoint) == 0]
        label = f"{shapes[0].name} to {shapes[1].name}"
        flat = [k for k in fixed if isinstance(shapes[k].geometry, coal.Halfspace)]
        solid = [k for k in fixed if isinstance(shapes[k].geometry, coal.Box)]
        if flat:
            half = shapes[flat[0]].geometry
            if not np.allclose(half.n, [0.0, 0.0, 1.0]):
                raise ConfigurationError(f"{shapes[flat[0]].name}: only a level ground is supported")
            self._ground = float((self._to_zero @ np.array([0.0, 0.0, half.d, 1.0]))[2])
            self._grounded.append((self._capsule(indices[1 - flat[0]]), label))
        elif solid:
            box = self._box(indices[solid[0]])
            self._boxed.append(((self._capsule(indices[1 - solid[0]]), box), label))
        else:
            near = abs(int(shapes[0].parentJoint) - int(shapes[1].parentJoint)) <= _NEAR_JOINTS
            if near and "payload" in (shapes[0].name, shapes[1].name):
                row = 2 + len(self._pairs)
                self._eased.append((row, sum(_excess(shape.geometry) for shape in shapes)))
            self._pairs.append(((self._capsule(first), self._capsule(second)), label))

    def _capsule(self, index: int) -> int:
        if index not in self._capsules:
            item = self._objects[index]
            segment, radius = enclose(item.geometry)
            joint = int(item.parentJoint)
            frame = self._to_zero if joint == 0 else self._mechanism.links[joint - 1]
            pose = frame @ np.array(item.placement.homogeneous)
            self._capsules[index] = (joint - 1, segment @ pose[:3, :3].T + pose[:3, 3], radius)
        return list(self._capsules).index(index)

    def _box(self, index: int) -> int:
        box = self._objects[index]
        pose = self._to_zero @ np.array(box.placement.homogeneous)
        self._boxes[index] = (np.array(box.geometry.halfSide), pose)
        return list(self._boxes).index(index)

    def space(self) -> Space:
        """The distances of the pairs so far."""
        capsules, boxes = self._capsules.values(), self._boxes.values()
        return Space(
            body=np.array([body for body, _, _ in capsules], dtype=np.int64),
            ends=np.array([ends for _, ends, _ in capsules]).reshape(-1, 2, 3),
            thickness=np.array([radius for _, _, radius in capsules], dtype=np.float64),
            pairs=np.array([row for row, _ in self._pairs], dtype=np.int64).reshape(-1, 2),
            ground=self._ground,
            grounded=np.array([row for row, _ in self._grounded], dtype=np.int64),
            box_size=np.array([size for size, _ in boxes]).reshape(-1, 3),
            box_rotation=np.ascontiguousarray([pose[:3, :3] for _, pose in boxes]).reshape(-1, 3, 3),
            box_centre=np.array([pose[:3, 3] for _, pose in boxes]).reshape(-1, 3),
            boxed=np.array([row for row, _ in self._boxed], dtype=np.int64).reshape(-1, 2),
            eased=tuple(self._eased),
        )
