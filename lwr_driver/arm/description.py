"""The arm as a description: names, limits, gears, stiffness and the URDF, checked once on loading.

Nothing here needs pinocchio: the real-time process takes its limits from this module and must stay light.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fri.errors import ConfigurationError
from fri.quantities import FileName, Name, Version, check, suspected, within
from lwr_driver.arm.ceilings import JOINT_NAMES, LWR4PLUS, MODEL
from lwr_driver.configuration import CONFIGS, find, parse, read_mapping, read_text
from lwr_driver.places import Place

JOINTS = 7

Vector = NDArray[np.float64]


_Angle = Annotated[float, within(-360.0, 360.0, "deg")]
_LEAST_RANGE_DEG = 10.0


@dataclass(frozen=True)
class _JointEntry:
    """One joint of the arm file. Limits are magnitudes; `position_deg` is (lower, upper).

    torque_sign : -1 where the joint torque sensor counts against the direction of the joint
    """

    name: Name
    position_deg: tuple[_Angle, _Angle]
    velocity_deg_s: Annotated[float, within(5.0, 720.0, "deg/s")]
    acceleration_rad_s2: Annotated[float, within(0.1, 100.0, "rad/s²")]
    jerk_rad_s3: Annotated[float, within(1.0, 10000.0, "rad/s³")]
    torque_nm: Annotated[float, within(1.0, 1000.0, "Nm")]
    gear_ratio: Annotated[float, within(1.0, 1000.0)]
    stiffness_nm_rad: Annotated[float, within(100.0, 1e6, "Nm/rad")]
    torque_sign: Annotated[int, within(-1, 1)] = 1

    def __post_init__(self) -> None:
        lower, upper = self.position_deg
        if not lower < upper:
            raise ConfigurationError(
                f"joint {self.name}: position_deg {lower} to {upper} is no range; the lower end comes first"
            )
        if upper - lower < _LEAST_RANGE_DEG:
            advice = suspected([lower, upper], "deg", lambda angle: abs(angle) <= 360.0)
            raise ConfigurationError(
                f"joint {self.name}: position_deg {lower:g} to {upper:g} deg is less than {_LEAST_RANGE_DEG:g} deg; "
                f"{advice or 'give both ends'}"
            )
        if self.torque_sign == 0:
            raise ConfigurationError(f"joint {self.name}: torque_sign is 0; it must be 1 or -1")


@dataclass(frozen=True)
class ArmFile:
    """The arm file as written; units are in the key names."""

    schema_version: Version
    name: Name
    urdf: FileName
    position_margin_deg: Annotated[float, within(0.0, 20.0, "deg")]
    lowest_resonance_hz: Annotated[float, within(0.1, 1000.0, "Hz")]
    joints: tuple[_JointEntry, ...]
    model: Name = MODEL

    def __post_init__(self) -> None:
        check(self)
        if len(self.joints) != JOINTS:
            raise ConfigurationError(f"{len(self.joints)} joints listed; the LWR4+ has {JOINTS}")


@dataclass(frozen=True, eq=False)
class ArmLimits:
    """Limits of every command, each (7,) float64.

    q_low, q_high [rad]; v_max [rad/s]; a_max [rad/s²]; j_max [rad/s³]
    """

    q_low: Vector
    q_high: Vector
    v_max: Vector
    a_max: Vector
    j_max: Vector


@dataclass(frozen=True, eq=False)
class LinkInertia:
    """Inertia of one URDF link in link axes: mass [kg], centre of mass [m], inertia about it [kg m²]."""

    link: str
    mass: float
    centre: Vector
    inertia: Vector

    def defect(self, tolerance: float = 1e-9) -> str | None:
        """The reason why no rigid body has this inertia, or None if one can.

        A body of positive density has a positive definite pseudo-inertia (Wensing, Kim and Slotine 2018):
        mass above zero and Σ = ½ tr(I) 1 - I positive semidefinite. The latter contains the triangle
        inequality of the principal moments.
        """
        if not self.mass > 0.0:
            return f"mass {self.mass} kg is not above zero"
        moments = np.linalg.eigvalsh(self.inertia)
        if moments[0] <= 0.0:
            return f"principal moment {moments[0]:.3g} kg m² is not above zero"
        slack = float(moments[0] + moments[1] - moments[2])
        if slack < -tolerance * float(moments[2]):
            listed = ", ".join(f"{moment:.4g}" for moment in moments)
            return f"principal moments {listed} kg m² break I1 + I2 >= I3"
        return None


@dataclass(frozen=True, eq=False, repr=False)
class Arm:
    """Description of the arm. Arrays are (7,), read-only, in kinematic order A1 A2 E1 A3 A4 A5 A6.

    q_min, q_max : position limits [rad]; `q_low`, `q_high` are narrower by `margin` [rad]
    v_max, a_max, j_max : limits of every command [rad/s], [rad/s²], [rad/s³]
    tau_max : joint torque limits [Nm]; gear_ratio : motor turns per joint turn
    torque_sign : +1 or -1, of the joint torque sensors; the driver turns the torques to the direction of the joint
    stiffness : joint stiffness [Nm/rad]; resonance_hz : lowest structural resonance [Hz]
    model : what the arm is; the limits of the LWR4+ (`ceilings`) hold for it whatever its file says, and for every arm
    with its joint names. Raises ConfigurationError beyond them.
    """

    name: str
    joint_names: tuple[str, ...]
    q_min: Vector
    q_max: Vector
    margin: float
    v_max: Vector
    a_max: Vector
    j_max: Vector
    tau_max: Vector
    gear_ratio: Vector
    stiffness: Vector
    resonance_hz: float
    urdf: str
    urdf_path: Path
    model: str = MODEL
    torque_sign: Vector = field(default_factory=lambda: _fixed(np.ones(JOINTS)))

    def __post_init__(self) -> None:
        if self.model == MODEL or self.joint_names == JOINT_NAMES:
            if self.joint_names != JOINT_NAMES:
                raise ConfigurationError(
                    f"joints {' '.join(self.joint_names)} are not those of {MODEL}, {' '.join(JOINT_NAMES)}; for "
                    "another arm name it in `model` and give its own limits"
                )
            enforce_ceilings(self)

    def __repr__(self) -> str:
        rows = (
            ("q from [deg]", np.degrees(self.q_min)),
            ("q to [deg]", np.degrees(self.q_max)),
            ("qd [deg/s]", np.degrees(self.v_max)),
            ("qdd [rad/s²]", self.a_max),
            ("jerk [rad/s³]", self.j_max),
            ("tau [Nm]", self.tau_max),
        )
        names = "".join(f"{name:>8}" for name in self.joint_names)
        limits = (f"  {title:<14}" + "".join(f"{value:8.5g}" for value in values) for title, values in rows)
        return "\n".join([f"Arm {self.name} ({self.urdf_path.name})", f"  {'joint':<14}{names}", *limits])

    @property
    def q_low(self) -> Vector:
        """Lowest commanded position [rad], (7,)."""
        return self.q_min + self.margin

    @property
    def q_high(self) -> Vector:
        """Highest commanded position [rad], (7,)."""
        return self.q_max - self.margin

    @property
    def limits(self) -> ArmLimits:
        """Limits of every command: positions within the margin, the rest unchanged."""
        return ArmLimits(self.q_low, self.q_high, self.v_max, self.a_max, self.j_max)

    @classmethod
    def load(cls, name: str | Path = CONFIGS / "lwr4plus.yaml", *, beside: Path | None = None) -> Arm:
        """Read and check an arm file and its URDF.

        beside : folder of the file naming it, see `configuration.find`.

        Raises ConfigurationError if a limit is not sane or beyond those of the LWR4+, the joint names differ from
        the URDF's chain, a link's inertia or collision shape is impossible, or the URDF has no collision geometry.
        """
        path = find(name, beside=beside)
        place = Place.of(path)
        content = parse(ArmFile, read_mapping(path), place)
        urdf_path = find(content.urdf, beside=path.parent)
        urdf = read_text(urdf_path)
        joints = content.joints
        position = np.radians([joint.position_deg for joint in joints])
        margin = float(np.radians(content.position_margin_deg))
        if np.any(position[:, 1] - position[:, 0] <= 2.0 * margin):
            raise ConfigurationError(f"{place.key('position_margin_deg')} leaves no range; lower it")
        values: dict[str, Any] = dict(  # noqa: C408
            name=content.name,
            joint_names=tuple(joint.name for joint in joints),
            q_min=_fixed(position[:, 0]),
            q_max=_fixed(position[:, 1]),
            margin=margin,
            v_max=_fixed(np.radians([joint.velocity_deg_s for joint in joints])),
            a_max=_fixed([joint.acceleration_rad_s2 for joint in joints]),
            j_max=_fixed([joint.jerk_rad_s3 for joint in joints]),
            tau_max=_fixed([joint.torque_nm for joint in joints]),
            gear_ratio=_fixed([joint.gear_ratio for joint in joints]),
            stiffness=_fixed([joint.stiffness_nm_rad for joint in joints]),
            resonance_hz=content.lowest_resonance_hz,
            urdf=urdf,
            urdf_path=urdf_path,
            model=content.model,
            torque_sign=_fixed([joint.torque_sign for joint in joints]),
        )
        try:
            arm = cls(**values)
        except ConfigurationError as error:
            raise ConfigurationError(f"{_place(error, place, content)}: {error}") from error
        _check_urdf(arm, str(urdf_path))
        return arm


def _place(error: ConfigurationError, place: Place, content: ArmFile) -> Place:
    """The line of the joint, and of its key, that an error names."""
    said = str(error).split()
    for number, joint in enumerate(content.joints):
        if f"{joint.name}:" in said[:2]:
            joints = replace(place, keys=("joints", number))
            return joints.named_in(" ".join(said[2:]), vars(joint))
    return place.named_in(str(error), vars(content))


def _usual(limit: float, value: float) -> bool:
    """Whether a value is a likely one below a limit."""
    return 0.05 * limit < value <= limit * (1.0 + 1e-6)


def enforce_ceilings(arm: Arm) -> None:
    """Raise ConfigurationError for a limit beyond what the LWR4+ can stand, joint by joint along the chain."""
    given = {
        "position_deg": ("deg", np.degrees(np.maximum(np.abs(arm.q_min), np.abs(arm.q_max)))),
        "velocity_deg_s": ("deg/s", np.degrees(arm.v_max)),
        "acceleration_rad_s2": ("rad/s²", arm.a_max),
        "jerk_rad_s3": ("rad/s³", arm.j_max),
        "torque_nm": ("Nm", arm.tau_max),
    }
    for key, (unit, values) in given.items():
        for joint, value, limit in zip(arm.joint_names, values.tolist(), LWR4PLUS[key], strict=True):
            if not 0.0 < value <= limit * (1.0 + 1e-6):
                advice = suspected(value, unit, partial(_usual, limit))
                raise ConfigurationError(
                    f"joint {joint}: {key} {value:g} {unit} is beyond {limit:g} {unit}, which the {MODEL} can stand; "
                    f"{advice or 'an arm file may only narrow its limits'}"
                )


def link_inertias(urdf: str, where: str = "URDF") -> dict[str, LinkInertia]:
    """Inertias in a URDF text by link name, as far as links have one.

    Raises ConfigurationError if the text is not XML or an entry is incomplete or not finite.
    """
    inertias = {}
    for link in _root(urdf, where).findall("link"):
        entry = link.find("inertial")
        if entry is None:
            continue
        name = link.get("name", "?")
        place = f"{where}: inertial of link {name}"
        mass, inertia = entry.find("mass"), entry.find("inertia")
        if mass is None or inertia is None:
            raise ConfigurationError(f"{place}: `mass` and `inertia` are both needed")
        centre, rpy = _origin(entry, place)
        turn = _rotation(rpy)
        xx, xy, xz, yy, yz, zz = (
            _numbers(inertia.get(key, ""), 1, f"{place}: {key}")[0]
            for key in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
        )
        local = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        value = _numbers(mass.get("value", ""), 1, f"{place}: mass")[0]
        inertias[name] = LinkInertia(name, float(value), centre, turn @ local @ turn.T)
    return inertias


def _check_urdf(arm: Arm, where: str) -> None:
    root = _root(arm.urdf, where)
    moving = [joint for joint in root.findall("joint") if joint.get("type") in ("revolute", "continuous")]
    names = tuple(joint.get("name", "?") for joint in moving)
    if names != arm.joint_names:
        raise ConfigurationError(
            f"{where}: moving joints are {' '.join(names)}, the arm file lists {' '.join(arm.joint_names)}; "
            "names and kinematic order must agree"
        )
    inertias = link_inertias(arm.urdf, where)
    for joint, lower, upper in zip(moving, arm.q_min, arm.q_max, strict=True):
        child = getattr(joint.find("child"), "attrib", {}).get("link", "(none)")
        if child not in inertias:
            raise ConfigurationError(
                f"{where}: link {child} is moved by {joint.get('name')} but has no inertial"
            )
        limit = joint.find("limit")
        if limit is not None and joint.get("type") == "revolute":
            low, high = (
                _numbers(limit.get(key, "0"), 1, f"{where}: limit of {joint.get('name')}")[0]
                for key in ("lower", "upper")
            )
            if lower < low - 1e-4 or upper > high + 1e-4:
                raise ConfigurationError(
                    f"{where}: {joint.get('name')} may move {low:.4f} to {high:.4f} rad, the arm file allows "
                    f"{lower:.4f} to {upper:.4f}; narrow the arm file's position_deg"
                )
    for inertia in inertias.values():
        defect = inertia.defect()
        if defect is not None:
            raise ConfigurationError(
                f"{where}: link {inertia.link}: {defect}; no rigid body has this inertia"
            )
    for joint in root.findall("joint"):
        place = f"{where}: joint {joint.get('name')}"
        _origin(joint, place)
        axis = joint.find("axis")
        if axis is not None and not np.any(_numbers(axis.get("xyz", "1 0 0"), 3, f"{place}: axis")):
            raise ConfigurationError(f"{place} has an axis of length zero")
    _check_shapes(root, where)
    if not root.findall("link/collision"):
        raise ConfigurationError(
            f"{where}: no link has collision geometry, so every collision check would pass; add primitive "
            "geometry"
        )


_SHAPES = {
    "sphere": ("radius",),
    "cylinder": ("radius", "length"),
    "capsule": ("radius", "length"),
    "box": ("size",),
}


def _check_shapes(root: Any, where: str) -> None:
    """Raise ConfigurationError for a collision shape that is no primitive of a size between 1 mm and 2 m."""
    for link in root.findall("link"):
        for collision in link.findall("collision"):
            place = f"{where}: collision shape of link {link.get('name')}"
            _origin(collision, place)
            shapes = list(collision.find("geometry") if collision.find("geometry") is not None else ())
            if len(shapes) != 1 or shapes[0].tag not in _SHAPES:
                found = ", ".join(str(shape.tag) for shape in shapes) or "none"
                raise ConfigurationError(f"{place}: found {found}; use one {', '.join(_SHAPES)}")
            for key in _SHAPES[shapes[0].tag]:
                sizes = _numbers(shapes[0].get(key, ""), 3 if key == "size" else 1, f"{place}: {key}")
                if not (np.all(sizes >= 0.001) and np.all(sizes <= 2.0)):
                    mm = np.all(sizes * 1e-3 >= 0.001) and np.all(sizes * 1e-3 <= 2.0)
                    advice = "it looks like mm; a URDF is in m" if mm else "give a size above zero"
                    raise ConfigurationError(
                        f"{place}: {key} {' '.join(f'{size:g}' for size in sizes)} m is outside 0.001 to 2 m; {advice}"
                    )


def _root(urdf: str, where: str) -> Any:
    if "<!DOCTYPE" in urdf or "<!ENTITY" in urdf:
        raise ConfigurationError(f"{where}: document type declarations are not read; remove them")
    try:
        return ElementTree.fromstring(urdf)
    except (ElementTree.ParseError, ValueError, RecursionError) as error:
        raise ConfigurationError(f"{where}: not valid XML: {error}") from error


def _origin(element: Any, where: str) -> tuple[Vector, Vector]:
    """Translation [m] and roll, pitch, yaw [rad] of an element's origin; zero without one."""
    origin = element.find("origin")
    xyz, rpy = ("0 0 0" if origin is None else origin.get(key, "0 0 0") for key in ("xyz", "rpy"))
    return _numbers(xyz, 3, where), _numbers(rpy, 3, where)


def _numbers(text: str, count: int, where: str) -> Vector:
    try:
        values = np.array([float(word) for word in text.split()])
    except ValueError:
        values = np.empty(0)
    if values.shape != (count,) or not np.all(np.isfinite(values)):
        raise ConfigurationError(f"{where}: expected {count} finite number(s), found {text!r}")
    return values


def _rotation(rpy: Vector) -> Vector:
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy), np.sin(rpy)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def _fixed(values: Any) -> Vector:
    array = np.array(values, dtype=np.float64)
    array.flags.writeable = False
    return array


@dataclass(frozen=True)
class _Joint:
    name: str
    kind: str
    origin: NDArray[np.float64]
    rotation: NDArray[np.float64]
    axis: NDArray[np.float64]


class LinkFrames:
    """Pose of every link relative to its parent, for `/tf`: no chain to multiply.

    A joint with origin (p, r) and axis a at position q has the translation p and the rotation
    r * (cos q/2, a sin q/2) (quaternions); a prismatic joint has p + q R(r) a and r.

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
            axis = joint.find("axis")
            place = f"robot description: joint {name!r}"
            xyz, rpy = _origin(joint, place)
            direction = _numbers(axis.get("xyz", "1 0 0") if axis is not None else "1 0 0", 3, place)
            norm = float(np.linalg.norm(direction))
            if norm == 0.0:
                raise ConfigurationError(f"robot description: joint {name!r} has an axis of length zero")
            self._joints.append(_Joint(name, kind, xyz, _from_rpy(rpy), direction / norm))
        self.pairs: tuple[tuple[str, str], ...] = tuple(pairs)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Moving joints in the order of the URDF."""
        return tuple(joint.name for joint in self._joints if joint.kind != "fixed")

    def poses(self, joint_names: Sequence[str], q: ArrayLike) -> NDArray[np.float64]:
        """Poses x y z [m], quaternion x y z w of every link relative to its parent: (n, links, 7).

        joint_names : names of the columns of `q`; all other joints of the URDF stay at zero
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
