"""Inertials of the links and the tree of joints from a URDF, read with plain XML.

Positions, axes and inertia are taken as written (roll-pitch-yaw as in the URDF specification); meshes,
visuals and extensions are ignored, so a file reads without its packages. Floating and planar joints are held
at zero, as are all joints off the chain; a mimic joint has no coordinate unless the chain names it.
"""

from __future__ import annotations

import difflib
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from fri.errors import ConfigurationError
from ident.dynamics import parameters
from ident.dynamics.parameters import Floats

_KINDS = {
    "revolute": "revolute",
    "continuous": "revolute",
    "prismatic": "prismatic",
    "fixed": "fixed",
    "floating": "fixed",
    "planar": "fixed",
}


_GRIPPER = re.compile("grip|finger|jaw|claw|grasp", re.IGNORECASE)


@dataclass(frozen=True, eq=False)
class Joint:
    """One joint: kind ("revolute", "prismatic", "fixed"), parent and child, origin (4, 4), unit axis (3,).

    mimic : name of the joint it follows, or None. limits : lower and upper position [rad or m], or None.
    effort : largest torque or force [Nm or N], or None.
    """

    name: str
    kind: str
    parent: str
    child: str
    origin: Floats
    axis: Floats
    mimic: str | None = None
    limits: tuple[float, float] | None = None
    effort: float | None = None

    @property
    def movable(self) -> bool:
        """Whether the joint can move, by itself or after another."""
        return self.kind != "fixed"

    @property
    def driven(self) -> bool:
        """Whether the joint has a coordinate of its own."""
        return self.movable and self.mimic is None

    @property
    def grips(self) -> bool:
        """Whether the joint is that of a gripper, by its name."""
        return bool(_GRIPPER.search(f"{self.name} {self.child}"))


@dataclass(frozen=True, eq=False)
class Urdf:
    """A URDF: robot name, text, joints in the file's order, inertials (10,) by link about its frame."""

    name: str
    text: str
    joints: tuple[Joint, ...]
    inertials: Mapping[str, Floats]

    @property
    def root(self) -> str:
        """The only link without a parent joint."""
        children = {joint.child for joint in self.joints}
        roots = [link for link in self.inertials if link not in children]
        if len(roots) != 1:
            raise ConfigurationError(f"robot {self.name!r}: {len(roots)} root links; a tree has exactly one")
        return roots[0]

    def chain(
        self, root: str | None = None, tip: str | None = None, joints: Collection[str] | None = None
    ) -> list[Joint]:
        """All joints from `root` to `tip`, fixed ones included.

        joints : names that must lie on the way; without a tip it ends behind the last of them. Without both,
            the one chain through all driven joints.

        Raises ConfigurationError for unknown names, joints without a common chain, and a mimic joint between
        them that follows one of them.
        """
        start = root if root is not None else self.root
        for link in (start, tip):
            if link is not None and link not in self.inertials:
                raise ConfigurationError(f"robot {self.name!r} has no link {_unknown(link, self.inertials)}")
        if joints is None:
            return self._path(start, self._only_tip(start) if tip is None else tip)
        self.require(joints)
        paths = [self._path(start, joint.child) for joint in self.joints if joint.name in joints]
        longest = max(paths, key=len) if tip is None else self._path(start, tip)
        on_it = {joint.name for joint in longest}
        off = [name for name in joints if name not in on_it]
        if off:
            raise ConfigurationError(
                f"robot {self.name!r}: joint {off[0]!r} is not on the chain from link {start!r} to "
                f"{longest[-1].child!r}; leave it out of `joints`, or give another `tip`"
            )
        for joint in longest:
            if joint.mimic in joints and joint.name not in joints:
                raise ConfigurationError(
                    f"robot {self.name!r}: joint {joint.name!r} on the chain follows {joint.mimic!r} (mimic), and a "
                    "chain has independent joints only; name it in `joints` with its measured position"
                )
        return longest

    def require(self, names: Collection[str]) -> None:
        """Raise ConfigurationError unless every name is a joint that can move."""
        movable = [joint.name for joint in self.joints if joint.movable]
        fixed = {joint.name for joint in self.joints if not joint.movable}
        for name in names:
            if name in fixed:
                raise ConfigurationError(
                    f"joint {name!r} of robot {self.name!r} is fixed and cannot have been measured"
                )
            if name not in movable:
                raise ConfigurationError(f"robot {self.name!r} has no joint {_unknown(name, movable)}")

    def arm(
        self, *, count: int | None = None, names: Collection[str] | None = None, root: str | None = None
    ) -> tuple[str, ...]:
        """Names of the driven joints of a serial piece of the tree, base to tip.

        A piece begins at the root or a branching and ends at a later branching or a leaf. Any movable joint
        branches, a mimic too, so a gripper with two fingers ends the arm before it.

        count : the only piece with that many joints; or else with as many before those of a gripper, by their names.
        names : the longest unbranched piece with all its joints among them, and the named joints below it.

        Raises ConfigurationError, with the pieces, if there is none or more than one.
        """
        pieces: dict[tuple[str, ...], bool] = {}
        for piece, direct in self._pieces(root):
            if piece:
                key = tuple(joint.name for joint in piece)
                # A piece on to a mimic joint has the same joints as the one that ends before it.
                pieces[key] = direct or pieces.get(key, False)
        if count is not None:
            found = [piece for piece in pieces if len(piece) == count]
            grips = {joint.name for joint in self.joints if joint.grips}
            found = found or [
                piece[:count]
                for piece in pieces
                if len(piece) > count and grips.issuperset(piece[count:]) and piece[count - 1] not in grips
            ]
            wanted = f"with {count} joints"
        else:
            covered = {piece: direct for piece, direct in pieces.items() if set(piece) <= set(names or ())}
            longest = max((len(piece) for piece, direct in covered.items() if direct), default=0)
            found = [piece for piece, direct in covered.items() if direct and len(piece) == longest]
            if len(found) == 1:
                found = [max((piece for piece in covered if piece[-longest:] == found[0]), key=len)]
            wanted = f"among the joints {', '.join(names or ())}"
        if len(found) != 1:
            choice = "; ".join(f"{len(piece)}: {', '.join(piece)}" for piece in found or pieces)
            raise ConfigurationError(
                f"robot {self.name!r} has {len(found) or 'no'} serial arms {wanted} ({choice}); name the "
                "`joints` in a mapping, or with --joints"
            )
        return found[0]

    def beside(
        self, joints: Collection[str], root: str | None = None, tip: str | None = None
    ) -> tuple[frozenset[str], frozenset[str]]:
        """Driven joints that are not of the chain of `joints` and act on it: on its way, and on branches.

        On the way are those between its joints and root, and those on from its end up to a branching; all of these can
        be joints of the chain. The branches are what else its links carry.
        """
        way = self.chain(root, tip, joints)
        first = next(k for k, joint in enumerate(way) if joint.name in joints)
        on_way, carried = {joint.name for joint in way}, set[str]()
        pending = [joint.child for joint in way[first:]]
        while pending:
            below = self._below(pending.pop())
            carried |= {joint.name for joint in below}
            pending += [joint.child for joint in below if joint.movable and joint.name not in on_way]
        link = way[-1].child
        while len(further := [joint for joint in self._below(link) if joint.movable]) == 1:
            on_way.add(further[0].name)
            link = further[0].child
        driven = {joint.name for joint in self.joints if joint.driven} - set(joints)
        return frozenset(on_way & driven), frozenset((carried - on_way) & driven)

    def _pieces(self, root: str | None) -> Iterator[tuple[tuple[Joint, ...], bool]]:
        """Driven joints of each piece, and whether it is without a branching."""

        def walk(link: str, above: list[list[Joint]]) -> Iterator[tuple[tuple[Joint, ...], bool]]:
            branches = [joint for joint in self._below(link) if joint.movable]
            if len(branches) != 1:
                for piece in above:
                    yield tuple(joint for joint in piece if joint.driven), piece is above[-1]
                above = [*above, []]
            for joint in branches:
                yield from walk(joint.child, [[*piece, joint] for piece in above])

        yield from walk(root if root is not None else self.root, [[]])

    def _path(self, start: str, tip: str) -> list[Joint]:
        parent_joint = {joint.child: joint for joint in self.joints}
        path: list[Joint] = []
        link = tip
        while link != start:
            if link not in parent_joint or len(path) > len(self.joints):
                raise ConfigurationError(f"robot {self.name!r}: link {tip!r} does not hang on link {start!r}")
            path.append(parent_joint[link])
            link = path[-1].parent
        return path[::-1]

    def _only_tip(self, start: str) -> str:
        link = start
        while branches := [joint for joint in self._below(link) if joint.driven]:
            if len(branches) > 1:
                named = ", ".join(joint.name for joint in branches)
                raise ConfigurationError(
                    f"robot {self.name!r} branches at link {link!r} (joints {named}); give the arm's `joints` or `tip`"
                )
            link = branches[0].child
        return link

    def _below(self, link: str) -> list[Joint]:
        """Movable joints from `link` or a body fixed to it, and the fixed joints between."""
        found, pending = [], [link]
        while pending:
            here = pending.pop()
            for joint in self.joints:
                if joint.parent == here:
                    found.append(joint)
                    if not joint.movable:
                        pending.append(joint.child)
        return found

    def lumped_inertial(self, link: str, stop: Collection[str]) -> Floats:
        """(10,) inertial parameters about the frame of `link`, all on it up to joints `stop` included."""
        total = self.inertials[link].copy()
        for joint in self.joints:
            if joint.parent == link and joint.name not in stop:
                total += parameters.transform(self.lumped_inertial(joint.child, stop), joint.origin)
        return total


def held(text: str, positions: Mapping[str, float]) -> str:
    """The URDF with joints fixed at positions [rad or m]. ConfigurationError for joints that cannot move."""
    from scipy.spatial.transform import Rotation  # on use: its import is slow

    urdf = read_urdf(text)
    urdf.require(positions)
    tree = ElementTree.fromstring(text)
    known = {joint.name: joint for joint in urdf.joints}
    for element in tree.findall("joint"):
        name = element.get("name", "")
        if name not in positions:
            continue
        joint, value = known[name], positions[name]
        motion = np.eye(4)
        if joint.kind == "prismatic":
            motion[:3, 3] = value * joint.axis
        else:
            motion[:3, :3] = Rotation.from_rotvec(value * joint.axis).as_matrix()
        pose = joint.origin @ motion
        # URDF: rotations about the fixed axes x, y, z in this order.
        angles = Rotation.from_matrix(pose[:3, :3]).as_euler("xyz", suppress_warnings=True)
        for old in [child for child in element if child.tag in ("origin", "axis", "limit", "mimic")]:
            element.remove(old)
        words = {"xyz": pose[:3, 3], "rpy": angles}
        origin = {key: " ".join(repr(float(x)) for x in values) for key, values in words.items()}
        element.insert(0, ElementTree.Element("origin", origin))
        element.set("type", "fixed")
    return ElementTree.tostring(tree, encoding="unicode")


def _unknown(name: str, known: Collection[str]) -> str:
    """A name that is not known, with the nearest one and all others."""
    near = difflib.get_close_matches(name, known, n=1)
    hint = f"did you mean {near[0]!r}? It" if near else "it"
    return f"{name!r}; {hint} has {', '.join(known)}"


def read_urdf(source: str | Path) -> Urdf:
    """Read a URDF from a path, or from its text when `source` begins with `<`.

    Raises ConfigurationError with file, element and remedy for an invalid URDF.
    """
    return _parsed(*_text(source))


# A command asks for one arm's bodies, joints and limits many times.
@lru_cache(maxsize=8)
def _parsed(text: str, place: str) -> Urdf:
    try:
        tree = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise ConfigurationError(f"{place}: not well-formed XML: {error}") from error
    if tree.tag != "robot":
        raise ConfigurationError(f"{place}: the top element is <{tree.tag}>; a URDF begins with <robot>")
    inertials: dict[str, Floats] = {}
    for link in tree.findall("link"):
        inertials[link.get("name", "")] = _inertial(link, place)
    joints = tuple(_joint(element, place) for element in tree.findall("joint"))
    for joint in joints:
        for name in (joint.parent, joint.child):
            if name not in inertials:
                raise ConfigurationError(
                    f"{place}: joint {joint.name!r} refers to link {name!r}, missing in the file"
                )
    for shared in (
        *inertials.values(),
        *(values for joint in joints for values in (joint.origin, joint.axis)),
    ):
        shared.setflags(write=False)
    return Urdf(tree.get("name", "robot"), text, joints, inertials)


def _text(source: str | Path) -> tuple[str, str]:
    if isinstance(source, str) and source.lstrip().startswith("<"):
        return source, "URDF text"
    try:
        return Path(source).read_text(encoding="utf-8"), str(source)
    except (OSError, ValueError) as error:
        raise ConfigurationError(f"{str(source)[:200]}: cannot be read: {error}") from error


def _numbers(element: ElementTree.Element | None, key: str, default: tuple[float, ...], place: str) -> Floats:
    text = element.get(key) if element is not None else None
    if text is None:
        return np.array(default)
    try:
        values = np.array([float(part) for part in text.split()])
    except ValueError as error:
        raise ConfigurationError(f'{place}: `{key}="{text}"` is not a list of numbers') from error
    if values.shape != (len(default),) or not np.all(np.isfinite(values)):
        raise ConfigurationError(f'{place}: `{key}="{text}"` must hold {len(default)} finite numbers')
    return values


def _pose(element: ElementTree.Element | None, place: str) -> Floats:
    shift = _numbers(element, "xyz", (0.0, 0.0, 0.0), place)
    roll, pitch, yaw = _numbers(element, "rpy", (0.0, 0.0, 0.0), place)
    (cr, cp, cy), (sr, sp, sy) = np.cos([roll, pitch, yaw]), np.sin([roll, pitch, yaw])
    pose = np.eye(4)
    pose[:3, :3] = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    pose[:3, 3] = shift
    return pose


def _inertial(link: ElementTree.Element, place: str) -> Floats:
    element = link.find("inertial")
    where = f"{place}: link {link.get('name', '')!r}"
    if element is None:
        return np.zeros(10)
    mass = _numbers(element.find("mass"), "value", (0.0,), where)[0]
    tensor = element.find("inertia")
    entries = [_numbers(tensor, key, (0.0,), where)[0] for key in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")]
    xx, xy, xz, yy, yz, zz = entries
    about_com = parameters.from_com(mass, np.zeros(3), np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]))
    return parameters.transform(about_com, _pose(element.find("origin"), where))


def _joint(element: ElementTree.Element, place: str) -> Joint:
    name, kind = element.get("name", ""), element.get("type", "")
    where = f"{place}: joint {name!r}"
    if kind not in _KINDS:
        raise ConfigurationError(f"{where}: type {kind!r} is not supported; known: {', '.join(_KINDS)}")
    parent, child = element.find("parent"), element.find("child")
    if parent is None or child is None:
        raise ConfigurationError(f"{where}: <parent> and <child> are needed")
    axis = _numbers(element.find("axis"), "xyz", (1.0, 0.0, 0.0), where)
    length = float(np.linalg.norm(axis))
    if _KINDS[kind] != "fixed" and length < 1e-9:
        raise ConfigurationError(f"{where}: the axis has no length")
    mimic, limit = element.find("mimic"), element.find("limit")
    bounded = limit is not None and kind != "continuous" and limit.get("lower") != limit.get("upper")
    return Joint(
        name,
        _KINDS[kind],
        parent.get("link", ""),
        child.get("link", ""),
        _pose(element.find("origin"), where),
        axis / max(length, 1e-300),
        None if mimic is None else mimic.get("joint"),
        (float(_numbers(limit, "lower", (0.0,), where)[0]), float(_numbers(limit, "upper", (0.0,), where)[0]))
        if bounded
        else None,
        _effort(limit),
    )


def _effort(limit: ElementTree.Element | None) -> float | None:
    """The largest torque, if it is a positive number: zero, `inf` and words stand for unknown in many files."""
    try:
        value = float("nan" if limit is None else limit.get("effort", "nan"))
    except ValueError:
        return None
    return value if 0.0 < value < np.inf else None
