"""Serial chains of revolute and prismatic joints in modified Denavit-Hartenberg frames.

The pose of frame j, with z_j along the axis of joint j, in frame j-1 is (Khalil and Kleinfinger, 1986)::

    T(j-1, j) = Rx(alpha_j) Tx(d_j) Rz(theta_j) Tz(r_j)

with theta_j = theta0_j + q_j for a revolute joint and r_j = r0_j + q_j for a prismatic one. The names of the
dynamic parameters refer to these frames. A chain comes from a table of those numbers or from a URDF. Link
frames of the URDF that obey the convention are used as they are. Otherwise such frames are built on the joint
axes. `link_placements` keeps the pose of each URDF link frame in its modified-DH frame, for the conversion of
inertial parameters both ways.
"""

from __future__ import annotations

import logging
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fri.errors import ConfigurationError
from ident.dynamics import parameters
from ident.dynamics.parameters import Floats, joint_unit
from ident.dynamics.tables import Tabular
from ident.dynamics.urdf import Joint, read_urdf

_LENGTH_SNAP_M = 1e-9
_PARALLEL = 1e-7


def exact_cos_sin(angle: Floats) -> tuple[Floats, Floats]:
    """cos and sin of angles, exactly 0 at right angles."""
    cosine, sine = np.cos(angle), np.sin(angle)
    for values in (cosine, sine):
        values[np.abs(values) < 1e-15] = 0.0
    return cosine, sine


def mdh_transform(alpha: float, d: float, theta: float, r: float) -> Floats:
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


def _read_transform(pose: Floats, snap_rad: float) -> Floats | None:
    """alpha, d, theta, r of a pose of the modified-DH form, else None."""
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


def table_as_is(local: Sequence[Floats], joints: Sequence[Joint], snap_rad: float) -> Floats | None:
    """The (n, 4) table when the URDF's own frames obey the convention, else None."""
    rows = []
    for pose, joint in zip(local, joints, strict=True):
        row = _read_transform(pose, snap_rad) if np.allclose(joint.axis, (0.0, 0.0, 1.0), atol=1e-9) else None
        if row is None:
            return None
        rows.append(row)
    return np.array(rows)


def build_frames(
    local: Sequence[Floats], joints: Sequence[Joint], snap_rad: float
) -> tuple[Floats, Floats, Floats]:
    """Modified-DH frames on the joint axes at q = 0.

    x_j lies along the common normal of axes j and j+1 (towards j+1; for crossing axes, the direction nearest
    to the link frame's x). Frame 0 is frame 1 at q = 0. The last frame keeps the origin and, as far as the
    axis allows, the x axis of the URDF's link frame, and so the usual frame of a payload. Returns base
    placement, (n, 4) table, (n, 4, 4) link placements.
    """
    links, pose = [], np.eye(4)
    for step in local:
        pose = pose @ step
        links.append(pose)
    origins = [pose[:3, 3] for pose in links]
    axes = [pose[:3, :3] @ joint.axis for pose, joint in zip(links, joints, strict=True)]
    frames: list[Floats] = []
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


def _foot(frame: Floats, point: Floats, axis: Floats) -> Floats:
    """Intersection of axis j with the x axis of the frame before it (the foot of the common normal)."""
    x, z, start = frame[:3, 0], frame[:3, 2], frame[:3, 3]
    # start + s x + t z = point + u axis; least squares takes t = 0 for parallel axes.
    solution = np.linalg.lstsq(np.column_stack([x, z, -axis]), point - start, rcond=1e-9)[0]
    if np.linalg.norm(np.cross(z, axis)) < _PARALLEL:
        return point + axis * float(axis @ (start - point))
    return point + solution[2] * axis


def _common_normal(
    link: Floats, entry: Floats, axis: Floats, next_point: Floats, next_axis: Floats
) -> tuple[Floats, Floats]:
    """Direction of x_j and origin of frame j."""
    cross = np.cross(axis, next_axis)
    between = next_point - entry
    if np.linalg.norm(cross) < _PARALLEL:
        # Parallel axes: of all common normals take the one with r_j = 0.
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


def _perpendicular(link: Floats, axis: Floats) -> Floats:
    """The link frame's x axis (or y, z) made perpendicular to the joint axis."""
    for k in range(3):
        x = link[:3, k] - axis * float(axis @ link[:3, k])
        if np.linalg.norm(x) > 1e-3:
            return x / np.linalg.norm(x)
    raise ConfigurationError("a link frame of the URDF is not a rotation; check its joint origins")


logger = logging.getLogger(__name__)

STANDARD_GRAVITY = (0.0, 0.0, -9.81)
_CONSTANTS = ("alpha", "d", "theta", "r")


def _transformed(inertial: ArrayLike, poses: NDArray[np.floating[Any]]) -> Floats:
    rows = np.asarray(inertial, dtype=np.float64)
    return np.array([parameters.transform(row, pose) for row, pose in zip(rows, poses, strict=True)])


# Mass of all links and reach, below and above which masses look like no arm's, and the share of the largest torque that
# the links' weight has at least, stretched out: 0.5 and more in real arms.
_LIGHTEST_KG, _REACH_M, _LEAST_LOAD = 1.0, 0.3, 0.02


@dataclass(frozen=True, eq=False)
class Chain(Tabular):
    """A serial arm: n joints, modified-DH constants, gravity.

    joint_names : n names, from the base to the tip.
    prismatic : (n,) bool, the kind of each joint.
    alpha, d, theta, r : (n,) float64, the constants of the table [rad, m, rad, m] (at q = 0).
    gravity : (3,) acceleration of gravity in frame 0 [m/s^2].
    base_placement : (4, 4) pose of frame 0 in the root link of the URDF (identity for a table).
    link_names : n names of the links moved by the joints.
    link_placements : (n, 4, 4) pose of each URDF link frame in the modified-DH frame of its joint.
    urdf : text of the URDF the chain was read from, or None.
    """

    joint_names: tuple[str, ...]
    prismatic: NDArray[np.bool_]
    alpha: Floats
    d: Floats
    theta: Floats
    r: Floats
    gravity: Floats = field(default_factory=lambda: np.array(STANDARD_GRAVITY))
    base_placement: Floats = field(default_factory=lambda: np.eye(4))
    link_names: tuple[str, ...] = ()
    link_placements: Floats | None = None
    urdf: str | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        n = len(self.joint_names)
        if n == 0:
            raise ConfigurationError("the chain has no movable joint; at least one is needed")
        if len(set(self.joint_names)) != n:
            raise ConfigurationError(f"joint names {', '.join(self.joint_names)} repeat; each must be unique")
        shapes = dict.fromkeys(("prismatic", *_CONSTANTS), (n,))
        for name, shape in {**shapes, "gravity": (3,), "base_placement": (4, 4)}.items():
            value = np.array(getattr(self, name), dtype=bool if name == "prismatic" else np.float64)
            object.__setattr__(self, name, value)
            if value.shape != shape or not np.all(np.isfinite(value)):
                raise ConfigurationError(
                    f"chain: `{name}` of shape {value.shape}: expected finite values of shape {shape}"
                )
            value.setflags(write=False)
        if not self.link_names:
            object.__setattr__(self, "link_names", tuple(f"link_{k}" for k in range(1, n + 1)))
        placements = self.link_placements
        placements = (
            np.tile(np.eye(4), (n, 1, 1)) if placements is None else np.array(placements, dtype=float)
        )
        if placements.shape != (n, 4, 4) or len(self.link_names) != n:
            raise ConfigurationError(
                f"chain: {n} joints need {n} link names and link placements of shape (4, 4)"
            )
        placements.setflags(write=False)
        object.__setattr__(self, "link_placements", placements)

    def records(self) -> list[dict[str, Any]]:
        """One row for each joint: name, link, kind, and alpha, d, theta, r."""
        rows: list[dict[str, Any]] = self.to_dict()["joints"]
        return rows

    def __repr__(self) -> str:
        kinds = "".join("P" if prismatic else "R" for prismatic in self.prismatic)
        gravity = ", ".join(f"{value:.4g}" for value in self.gravity)
        source = "a table" if self.urdf is None else "a URDF"
        return f"Chain of {self.n} joints ({kinds}) {' '.join(self.joint_names)} from {source}, gravity [{gravity}]"

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.joint_names)

    @property
    def torque_units(self) -> tuple[str, ...]:
        """Unit of each joint's torque, or of its force: `Nm` or `N`."""
        return tuple(joint_unit("Nm", prismatic=bool(slides)) for slides in self.prismatic)

    @classmethod
    def from_table(
        cls,
        rows: Sequence[Mapping[str, Any]],
        *,
        gravity: ArrayLike = STANDARD_GRAVITY,
        base_placement: ArrayLike | None = None,
    ) -> Chain:
        """Chain from a modified-DH table: a mapping for each joint with `alpha`, `d`, `theta`, `r` (default 0).

        `name` (default `q1`, `q2`, ...) and `kind` ("revolute" or "prismatic") are optional. Raises
        ConfigurationError on unknown keys or kinds.
        """
        names, prismatic, table = [], [], []
        for number, row in enumerate(rows, start=1):
            unknown = set(row) - {"name", "kind", *_CONSTANTS}
            if unknown:
                raise ConfigurationError(
                    f"joint {number}: unknown key `{sorted(unknown)[0]}` in the modified-DH table"
                )
            kind = row.get("kind", "revolute")
            if kind not in ("revolute", "prismatic"):
                raise ConfigurationError(
                    f"joint {number}: kind {kind!r} is neither `revolute` nor `prismatic`"
                )
            names.append(str(row.get("name", f"q{number}")))
            prismatic.append(kind == "prismatic")
            table.append([float(row.get(key, 0.0)) for key in _CONSTANTS])
        columns = np.array(table, dtype=np.float64).reshape(-1, 4).T
        constants: dict[str, Any] = dict(zip(_CONSTANTS, columns, strict=True))
        return cls(
            tuple(names),
            np.array(prismatic, dtype=bool),
            **constants,
            gravity=np.asarray(gravity, dtype=np.float64),
            base_placement=np.eye(4)
            if base_placement is None
            else np.asarray(base_placement, dtype=np.float64),
        )

    @classmethod
    def from_urdf(
        cls,
        source: str | Path,
        *,
        root: str | None = None,
        tip: str | None = None,
        joints: Collection[str] | None = None,
        gravity: ArrayLike = STANDARD_GRAVITY,
        snap_rad: float = 1e-5,
    ) -> Chain:
        """Chain from a URDF: a path, or the text itself (it begins with `<`).

        root, tip : link names; default the root of the tree and the end of its only chain of driven joints.
        joints : names of the joints of the chain, in any order; all others are held at zero, gripper, mimic
            and floating root included. Without a tip the chain ends at the last of them.
        gravity : (3,) in the axes of the root link [m/s^2].
        snap_rad : angles alpha and theta this near to a multiple of pi/2 are rounded to it, because files
            write 1.5708; 0 takes every digit as it stands.

        Fixed joints, and those held at zero, are merged. Raises ConfigurationError for an unreadable file,
        unknown joints or links, or a tree without a unique chain.
        """
        urdf = read_urdf(source)
        path = urdf.chain(root, tip, joints)
        movable = [joint for joint in path if (joint.driven if joints is None else joint.name in joints)]
        if not movable:
            raise ConfigurationError(
                f"robot {urdf.name!r}: no movable joint between {root or urdf.root!r} and the tip"
            )
        local, pending = [], np.eye(4)
        for joint in path:
            pending = pending @ joint.origin
            if joint in movable:
                local.append(pending)
                pending = np.eye(4)
        table = table_as_is(local, movable, snap_rad)
        if table is not None:
            base, placements = np.eye(4), np.tile(np.eye(4), (len(movable), 1, 1))
        else:
            logger.info("robot %s: link frames are not modified-DH frames; building them", urdf.name)
            base, table, placements = build_frames(local, movable, snap_rad)
        return cls(
            tuple(joint.name for joint in movable),
            np.array([joint.kind == "prismatic" for joint in movable]),
            **dict(zip(_CONSTANTS, table.T, strict=True)),
            gravity=base[:3, :3].T @ np.asarray(gravity, dtype=np.float64),
            base_placement=base,
            link_names=tuple(joint.child for joint in movable),
            link_placements=placements,
            urdf=urdf.text,
        )

    @cached_property
    def cos_sin_alpha(self) -> tuple[Floats, Floats]:
        """cos and sin of alpha, exactly 0 and 1 at right angles."""
        return exact_cos_sin(self.alpha)

    @cached_property
    def table(self) -> Floats:
        """(6, n) read-only: cos and sin of alpha, d, theta, r, and 1 for a prismatic joint."""
        rows = np.array([*self.cos_sin_alpha, self.d, self.theta, self.r, self.prismatic], dtype=np.float64)
        rows.setflags(write=False)
        return rows

    def placement(self, joint: int, position: float = 0.0) -> Floats:
        """(4, 4) pose of frame `joint` (counted from 0) in the frame before it at a joint position."""
        theta = self.theta[joint] + (0.0 if self.prismatic[joint] else position)
        r = self.r[joint] + (position if self.prismatic[joint] else 0.0)
        return mdh_transform(self.alpha[joint], self.d[joint], theta, r)

    def forward(self, q: ArrayLike) -> Floats:
        """Poses (n, 4, 4) of frames 1..n in the root link of the URDF (frame 0 of a table) for one q (n,)."""
        position = np.asarray(q, dtype=np.float64)
        if position.shape != (self.n,):
            raise ConfigurationError(f"q has shape {position.shape}; the chain has {self.n} joints")
        pose, poses = self.base_placement, []
        for joint in range(self.n):
            pose = pose @ self.placement(joint, position[joint])
            poses.append(pose)
        return np.array(poses)

    def inertial_from_links(self, inertial: ArrayLike) -> Floats:
        """(n, 10) parameters in modified-DH frames from the same about the URDF's link frames."""
        assert self.link_placements is not None
        return _transformed(inertial, self.link_placements)

    def inertial_to_links(self, inertial: ArrayLike) -> Floats:
        """(n, 10) parameters about the URDF's link frames from those in modified-DH frames."""
        assert self.link_placements is not None
        return _transformed(inertial, np.linalg.inv(self.link_placements))

    def efforts(self) -> Floats | None:
        """Largest torques (n,) [Nm] by the URDF; None without one, or without that of every joint."""
        if self.urdf is None:
            return None
        stated = {joint.name: joint.effort for joint in read_urdf(self.urdf).joints}
        found = np.array([stated.get(name) or np.nan for name in self.joint_names])
        return found if np.isfinite(found).all() else None

    def urdf_inertials(self) -> Floats:
        """(n, 10) inertial parameters of the URDF, in modified-DH frames.

        Bodies fixed to a moving link, side branches included, are added to it (with their own movable joints
        at 0). Raises ConfigurationError for a chain from a table.
        """
        if self.urdf is None:
            raise ConfigurationError(
                "the chain comes from a table, not from a URDF; it has no inertial parameters"
            )
        urdf = read_urdf(self.urdf)
        stop = set(self.joint_names)
        return self.inertial_from_links([urdf.lumped_inertial(link, stop) for link in self.link_names])

    def placeholder_masses(self) -> str:
        """Why the masses of the URDF look like no arm's, in words; empty where they may be one's.

        Links of one mass, or together too light for the reach or the torque limits: an arm with that reach weighs more
        than a kilogramme, and the weight of its links stretched out is more than a fiftieth of its largest torque.
        Raises ConfigurationError for a chain from a table.
        """
        masses = self.urdf_inertials()[:, 9]
        if not (total := float(masses.sum())) > 0.0:
            return ""
        if self.n > 1 and float(np.ptp(masses)) < 1e-6 * float(masses.max()):
            return f"the URDF gives every link the same mass ({masses[0]:.3g} kg)"
        reach = float(np.hypot(self.d, self.r).sum())
        if total < _LIGHTEST_KG and reach > _REACH_M:
            return f"the URDF gives all links together {total:.3g} kg, for a reach of {reach:.2g} m"
        efforts = self.efforts()
        largest = 0.0 if efforts is None else float(efforts[~self.prismatic].max(initial=0.0))
        if total * float(np.linalg.norm(STANDARD_GRAVITY)) * reach < _LEAST_LOAD * largest:
            return f"the URDF gives all links together {total:.3g} kg, for torques up to {largest:.4g} Nm"
        return ""

    def to_pinocchio(self, inertial: ArrayLike | None = None) -> Any:
        """pinocchio `Model` in the modified-DH frames; `inertial` (n, 10), default zero.

        Positions are those of the chain (theta0 and r0 are inside the joint placements).
        """
        import pinocchio as pin

        model = pin.Model()
        rotation = self.base_placement[:3, :3]
        model.gravity.linear = rotation @ self.gravity
        pose = self.base_placement
        bodies = np.zeros((self.n, 10)) if inertial is None else np.asarray(inertial, dtype=np.float64)
        parent = 0
        for k, name in enumerate(self.joint_names):
            joint = pin.JointModelPZ() if self.prismatic[k] else pin.JointModelRZ()
            pose = pose @ self.placement(k)
            parent = model.addJoint(parent, joint, pin.SE3(pose), name)
            body = pin.Inertia.Zero()
            if np.any(bodies[k] != 0.0):
                body = pin.Inertia.FromDynamicParameters(parameters.to_pinocchio(bodies[k]))
            model.appendBodyToJoint(parent, body, pin.SE3.Identity())
            pose = np.eye(4)
        return model

    def to_dict(self) -> dict[str, Any]:
        """Plain content of the chain (without the URDF text) for YAML or JSON, read by `from_dict`."""
        assert self.link_placements is not None
        rows = [
            {
                "name": name,
                "link": link,
                "kind": "prismatic" if self.prismatic[k] else "revolute",
                **{key: float(getattr(self, key)[k]) for key in _CONSTANTS},
            }
            for k, (name, link) in enumerate(zip(self.joint_names, self.link_names, strict=True))
        ]
        content: dict[str, Any] = {"joints": rows, "gravity": self.gravity.tolist()}
        if not np.array_equal(self.base_placement, np.eye(4)):
            content["base_placement"] = self.base_placement.tolist()
        if not np.array_equal(self.link_placements, np.tile(np.eye(4), (self.n, 1, 1))):
            content["link_placements"] = self.link_placements.tolist()
        return content

    @classmethod
    def from_dict(cls, content: Mapping[str, Any], *, urdf: str | None = None) -> Chain:
        """The chain from the content of `to_dict`. Raises ConfigurationError on missing or unknown keys."""
        unknown = set(content) - {"joints", "gravity", "base_placement", "link_placements"}
        if unknown or "joints" not in content or "gravity" not in content:
            named = f"unknown key `{sorted(unknown)[0]}`" if unknown else "`joints` and `gravity` are needed"
            raise ConfigurationError(f"chain: {named}")
        rows = [{key: value for key, value in row.items() if key != "link"} for row in content["joints"]]
        plain = cls.from_table(rows, gravity=content["gravity"], base_placement=content.get("base_placement"))
        return replace(
            plain,
            link_names=tuple(str(row.get("link", f"link_{k}")) for k, row in enumerate(content["joints"], 1)),
            link_placements=content.get("link_placements"),
            urdf=urdf,
        )
