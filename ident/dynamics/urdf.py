"""Inertials of the links and the tree of joints from a URDF, read with plain XML.

Positions, axes and inertia are taken as written (roll-pitch-yaw as in the URDF specification); meshes,
visuals and extensions are ignored, so a file reads without its packages.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fri.errors import ConfigurationError
from ident.dynamics import parameters
from ident.dynamics.parameters import Floats

_KINDS = {"revolute": "revolute", "continuous": "revolute", "prismatic": "prismatic", "fixed": "fixed"}


@dataclass(frozen=True, eq=False)
class Joint:
    """One joint: kind ("revolute", "prismatic", "fixed"), parent and child, origin (4, 4), unit axis (3,)."""

    name: str
    kind: str
    parent: str
    child: str
    origin: Floats
    axis: Floats

    @property
    def movable(self) -> bool:
        """Whether the joint has a coordinate."""
        return self.kind != "fixed"


@dataclass(frozen=True, eq=False)
class Urdf:
    """A URDF: robot name, text, joints in the file's order, inertials (10,) by link about its frame."""

    name: str
    text: str
    joints: tuple[Joint, ...]
    inertials: dict[str, Floats]

    @property
    def root(self) -> str:
        """The only link without a parent joint."""
        children = {joint.child for joint in self.joints}
        roots = [link for link in self.inertials if link not in children]
        if len(roots) != 1:
            raise ConfigurationError(f"robot {self.name!r}: {len(roots)} root links; a tree has exactly one")
        return roots[0]

    def chain(self, root: str | None = None, tip: str | None = None) -> list[Joint]:
        """Joints from `root` to `tip`; without a tip, the one chain through all movable joints."""
        start = root if root is not None else self.root
        for link in (start, tip):
            if link is not None and link not in self.inertials:
                raise ConfigurationError(
                    f"robot {self.name!r} has no link {link!r}; links: {', '.join(self.inertials)}"
                )
        if tip is None:
            tip = self._only_tip(start)
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
        while branches := [joint for joint in self._below(link) if joint.movable]:
            if len(branches) > 1:
                named = ", ".join(joint.name for joint in branches)
                raise ConfigurationError(
                    f"robot {self.name!r} branches at link {link!r} (joints {named}); give the arm's `tip`"
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


def read_urdf(source: str | Path) -> Urdf:
    """Read a URDF from a path, or from its text when `source` begins with `<`.

    Raises ConfigurationError with file, element and remedy for an invalid URDF.
    """
    text, place = _text(source)
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
    return Joint(
        name,
        _KINDS[kind],
        parent.get("link", ""),
        child.get("link", ""),
        _pose(element.find("origin"), where),
        axis / max(length, 1e-300),
    )
