"""Modified Denavit-Hartenberg frames (Khalil and Kleinfinger, 1986): the transform, and frames for axes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fri.errors import ConfigurationError
from ident.urdf import Joint

__all__ = ["build_frames", "exact_cos_sin", "mdh_transform", "table_as_is"]

_LENGTH_SNAP_M = 1e-9
_PARALLEL = 1e-7


def exact_cos_sin(angle: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """cos and sin of angles, exactly 0 at right angles."""
    cosine, sine = np.cos(angle), np.sin(angle)
    for values in (cosine, sine):
        values[np.abs(values) < 1e-15] = 0.0
    return cosine, sine


def mdh_transform(alpha: float, d: float, theta: float, r: float) -> NDArray[np.float64]:
    """(4, 4) pose Rx(alpha) Tx(d) Rz(theta) Tz(r) of a frame in the one before it."""
    (ca, ct), (sa, st) = exact_cos_sin(np.array([alpha, theta]))
    return np.array(
        [
            [ct, -st, 0.0, d],
            [ca * st, ca * ct, -sa, -sa * r],
            [sa * st, sa * ct, ca, ca * r],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def _read_transform(pose: NDArray[np.float64], snap_rad: float) -> NDArray[np.float64] | None:
    """alpha, d, theta, r of a pose that has the modified-DH form, else None."""
    rotation, shift = pose[:3, :3], pose[:3, 3]
    alpha = np.arctan2(-rotation[1, 2], rotation[2, 2])
    theta = np.arctan2(-rotation[0, 1], rotation[0, 0])
    angles = np.array([_snap(alpha, snap_rad), _snap(theta, snap_rad)])
    (ca,), (sa,) = exact_cos_sin(angles[:1])
    d, r = shift[0], ca * shift[2] - sa * shift[1]
    found = np.array([angles[0], _zero(d), angles[1], _zero(r)])
    error = np.abs(mdh_transform(*found) - pose).max()
    return found if error < 2.0 * max(snap_rad, 1e-9) else None


def _snap(angle: float, tolerance: float) -> float:
    nearest = round(angle / (np.pi / 2)) * (np.pi / 2)
    snapped = nearest if abs(angle - nearest) <= tolerance else angle
    return float(np.pi if snapped == -np.pi else snapped)


def _zero(length: float) -> float:
    return 0.0 if abs(length) < _LENGTH_SNAP_M else float(length)


def table_as_is(
    local: Sequence[NDArray[np.float64]], joints: Sequence[Joint], snap_rad: float
) -> NDArray[np.float64] | None:
    """The (n, 4) table when the URDF's own frames obey the convention, else None."""
    rows = []
    for pose, joint in zip(local, joints, strict=True):
        row = _read_transform(pose, snap_rad) if np.allclose(joint.axis, (0.0, 0.0, 1.0), atol=1e-9) else None
        if row is None:
            return None
        rows.append(row)
    return np.array(rows)


def build_frames(
    local: Sequence[NDArray[np.float64]], joints: Sequence[Joint], snap_rad: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Modified-DH frames on the joint axes at q = 0.

    x_j lies along the common normal of axes j and j+1 (towards j+1; for crossing axes, the direction nearest
    to the link frame's x). Frame 0 is frame 1 at q = 0. The last frame keeps the origin and, as far as the
    axis allows, the x axis of the URDF's link frame, so that a payload's frame is the one users know. Returns
    base placement, (n, 4) table, (n, 4, 4) link placements.
    """
    links, pose = [], np.eye(4)
    for step in local:
        pose = pose @ step
        links.append(pose)
    origins = [pose[:3, 3] for pose in links]
    axes = [pose[:3, :3] @ joint.axis for pose, joint in zip(links, joints, strict=True)]
    frames: list[NDArray[np.float64]] = []
    for j in range(len(links)):
        entry = origins[j] if j == 0 else _foot(frames[-1], origins[j], axes[j])
        if j + 1 == len(links):
            x, origin = _perpendicular(links[j], axes[j]), origins[j]
        else:
            x, origin = _common_normal(links[j], entry, axes[j], origins[j + 1], axes[j + 1])
        frame = np.eye(4)
        frame[:3, :3] = np.column_stack([x, np.cross(axes[j], x), axes[j]])
        frame[:3, 3] = origin
        frames.append(frame)
    table, before = [], frames[0]
    for frame in frames:
        row = _read_transform(np.linalg.inv(before) @ frame, snap_rad)
        if row is None:
            raise ConfigurationError(
                "the joint axes of the URDF do not yield modified-DH frames; check its joint origins"
            )
        table.append(row)
        before = frame
    placements = np.array([np.linalg.inv(frame) @ link for frame, link in zip(frames, links, strict=True)])
    placements[np.abs(placements) < 1e-12] = 0.0
    return frames[0], np.array(table), placements


def _foot(
    frame: NDArray[np.float64], point: NDArray[np.float64], axis: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Where axis j meets the x axis of the frame before it (the foot of the incoming common normal)."""
    x, z, start = frame[:3, 0], frame[:3, 2], frame[:3, 3]
    # start + s x + t z = point + u axis, where for parallel axes t = 0 is taken by least squares.
    solution = np.linalg.lstsq(np.column_stack([x, z, -axis]), point - start, rcond=1e-9)[0]
    if np.linalg.norm(np.cross(z, axis)) < _PARALLEL:
        return point + axis * float(axis @ (start - point))
    return point + solution[2] * axis


def _common_normal(
    link: NDArray[np.float64],
    entry: NDArray[np.float64],
    axis: NDArray[np.float64],
    next_point: NDArray[np.float64],
    next_axis: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Direction of x_j and origin of frame j."""
    cross = np.cross(axis, next_axis)
    between = next_point - entry
    if np.linalg.norm(cross) < _PARALLEL:
        # Parallel axes: every common normal serves; take the one that makes r_j zero.
        normal = between - axis * float(axis @ between)
        if np.linalg.norm(normal) < _LENGTH_SNAP_M:
            return _perpendicular(link, axis), entry
        return normal / np.linalg.norm(normal), entry
    x = cross / np.linalg.norm(cross)
    system = np.column_stack([axis, x, -next_axis])
    along, distance, _ = np.linalg.solve(system, between)
    if abs(distance) > _LENGTH_SNAP_M:
        x = x * np.sign(distance)
    else:
        preferences = [float(x @ link[:3, k]) for k in range(3)]
        decisive = next(value for value in preferences if abs(value) > 1e-6)
        x = x * np.sign(decisive)
    return x, entry + along * axis


def _perpendicular(link: NDArray[np.float64], axis: NDArray[np.float64]) -> NDArray[np.float64]:
    """The link frame's x axis (or y, z) made perpendicular to the joint axis."""
    for k in range(3):
        x = link[:3, k] - axis * float(axis @ link[:3, k])
        if np.linalg.norm(x) > 1e-3:
            return x / np.linalg.norm(x)
    raise ConfigurationError("a link frame of the URDF is not a rotation; check its joint origins")
