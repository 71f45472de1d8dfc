"""URDF with the identified inertials and friction: reading it back gives the torques of the model.

A URDF holds rigid bodies and, for each joint, `damping` and `friction`. Drive inertias and torque offsets
have no place in it; they stand in a comment. Numbers are written with all digits.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree

import numpy as np
from numpy.typing import NDArray

from ident import parameters
from ident.export.markup import comment, digits, document, friction, require_consistent
from ident.export.standard import StandardModel
from ident.urdf import read_urdf

__all__ = ["to_urdf"]

_SNAP_RAD = 1e-5


def to_urdf(model: StandardModel, *, name: str | None = None) -> str:
    """URDF text of a consistent model: the arm's own URDF with new inertials, or a new one for a chain from a
    table.

    What is fixed to a moving link belongs to that link's parameters, so its own inertial is taken away.
    Angles of joint origins within 1e-5 of a multiple of pi/2 are written as that multiple, as the chain takes
    them.

    Raises ConfigurationError for a model whose links cannot exist: project it first.
    """
    require_consistent(model)
    return _changed(model, name) if model.chain.urdf is not None else _new(model, name or "arm")


def _changed(model: StandardModel, name: str | None) -> str:
    chain = model.chain
    assert chain.urdf is not None
    parser = ElementTree.XMLParser(target=ElementTree.TreeBuilder(insert_comments=True))
    root = ElementTree.fromstring(chain.urdf, parser=parser)
    if name is not None:
        root.set("name", name)
    links = {link.get("name"): link for link in root.findall("link")}
    bodies = dict(zip(chain.link_names, chain.inertial_to_links(model.inertial), strict=True))
    for fixed in _carried(chain.urdf, chain.link_names, chain.joint_names):
        for element in links[fixed].findall("inertial"):
            links[fixed].remove(element)
    for link, body in bodies.items():
        element = links[link]
        for old in element.findall("inertial"):
            element.remove(old)
        element.insert(0, _inertial(body))
    damping, dry, notes = friction(model)
    order = {joint: k for k, joint in enumerate(chain.joint_names)}
    for joint in root.findall("joint"):
        _snap_origin(joint)
        if joint.get("name") in order:
            k = order[joint.get("name", "")]
            for old in joint.findall("dynamics"):
                joint.remove(old)
            tags = {"damping": digits(damping[k]), "friction": digits(dry[k])}
            joint.append(ElementTree.Element("dynamics", tags))
    root.insert(0, ElementTree.Comment(comment(model, notes)))
    return document(root)


def _carried(urdf: str, moving: tuple[str, ...], joints: tuple[str, ...]) -> list[str]:
    """Links that hang on a moving link without being one: their bodies are part of its parameters."""
    tree = read_urdf(urdf)
    found, pending = [], list(moving)
    while pending:
        here = pending.pop()
        for joint in tree.joints:
            if joint.parent == here and joint.name not in joints:
                found.append(joint.child)
                pending.append(joint.child)
    return found


def _new(model: StandardModel, name: str) -> str:
    chain = model.chain
    root = ElementTree.Element("robot", {"name": name})
    damping, dry, notes = friction(model)
    root.append(ElementTree.Comment(comment(model, notes)))
    base = ElementTree.SubElement(root, "link", {"name": "base_link"})
    parent = base.get("name", "")
    for k, joint_name in enumerate(chain.joint_names):
        pose = chain.placement(k) if k else chain.base_placement @ chain.placement(0)
        kind = "prismatic" if chain.prismatic[k] else "continuous"
        joint = ElementTree.SubElement(root, "joint", {"name": joint_name, "type": kind})
        ElementTree.SubElement(joint, "parent", {"link": parent})
        ElementTree.SubElement(joint, "child", {"link": chain.link_names[k]})
        ElementTree.SubElement(joint, "origin", _origin(pose))
        ElementTree.SubElement(joint, "axis", {"xyz": "0 0 1"})
        if kind == "prismatic":
            limits = {"lower": "-1", "upper": "1", "velocity": "10", "effort": "1000"}
            ElementTree.SubElement(joint, "limit", limits)
        tags = {"damping": digits(damping[k]), "friction": digits(dry[k])}
        ElementTree.SubElement(joint, "dynamics", tags)
        link = ElementTree.SubElement(root, "link", {"name": chain.link_names[k]})
        link.append(_inertial(model.inertial[k]))
        parent = chain.link_names[k]
    return document(root)


def _inertial(body: NDArray[np.float64]) -> ElementTree.Element:
    mass, com, tensor = parameters.to_com(body)
    element = ElementTree.Element("inertial")
    ElementTree.SubElement(element, "origin", {"xyz": " ".join(map(digits, com)), "rpy": "0 0 0"})
    ElementTree.SubElement(element, "mass", {"value": digits(float(mass))})
    entries = {
        "ixx": tensor[0, 0],
        "ixy": tensor[0, 1],
        "ixz": tensor[0, 2],
        "iyy": tensor[1, 1],
        "iyz": tensor[1, 2],
        "izz": tensor[2, 2],
    }
    ElementTree.SubElement(element, "inertia", {key: digits(value) for key, value in entries.items()})
    return element


def _origin(pose: NDArray[np.float64]) -> dict[str, str]:
    r = pose[:3, :3]
    pitch = np.arctan2(-r[2, 0], np.hypot(r[0, 0], r[1, 0]))
    if np.hypot(r[0, 0], r[1, 0]) > 1e-9:
        roll, yaw = np.arctan2(r[2, 1], r[2, 2]), np.arctan2(r[1, 0], r[0, 0])
    else:
        roll, yaw = np.arctan2(-r[1, 2], r[1, 1]), 0.0
    angles = " ".join(digits(_snapped(float(angle))) for angle in (roll, pitch, yaw))
    return {"xyz": " ".join(map(digits, pose[:3, 3])), "rpy": angles}


def _snap_origin(joint: ElementTree.Element) -> None:
    origin = joint.find("origin")
    if origin is None or origin.get("rpy") is None:
        return
    angles = [float(part) for part in origin.get("rpy", "").split()]
    if angles != [_snapped(angle) for angle in angles]:
        origin.set("rpy", " ".join(digits(_snapped(angle)) for angle in angles))


def _snapped(angle: float) -> float:
    nearest = round(angle / (np.pi / 2)) * (np.pi / 2)
    return nearest if abs(angle - nearest) <= _SNAP_RAD else angle
