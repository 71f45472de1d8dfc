"""Export to the XML descriptions URDF and MJCF, with all digits of the numbers.

A URDF holds rigid bodies and, for each joint, `damping` and `friction`; read back, it gives the torques of the
model. Drive inertias and torque offsets have no place in the format and go to a comment.

MJCF, the model format of MuJoCo, holds bodies, drive inertia as `armature`, `frictionloss` and `damping` of each
joint. Body frames are the modified Denavit-Hartenberg frames of the chain; every joint has a motor. Torque offsets
go to a comment.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree

import numpy as np

from fri.errors import ConfigurationError
from ident.dynamics import parameters
from ident.dynamics.parameters import Floats
from ident.dynamics.urdf import read_urdf
from ident.formats.standard import StandardModel


def friction(model: StandardModel) -> tuple[Floats, Floats, tuple[str, ...]]:
    """Damping [Nm s/rad] and dry friction [Nm] of each joint, both sides together, and notes.

    Negative friction, refused by simulators, becomes zero and is noted.
    """
    damping = model.drive[:, 1] + model.drive[:, 4]
    dry = model.drive[:, 2] + model.drive[:, 5]
    notes = []
    for symbol, values in (("damping", damping), ("friction", dry)):
        for k in np.flatnonzero(values < 0.0):
            notes.append(
                f"{symbol} of {model.chain.joint_names[k]} was estimated as {values[k]:.6g}, written as 0"
            )
    return np.maximum(damping, 0.0), np.maximum(dry, 0.0), tuple(notes)


def require_consistent(model: StandardModel) -> None:
    """Raise ConfigurationError with the name of a physically inconsistent link."""
    bad = [
        v.reason for v in parameters.consistency(model.inertial, model.chain.link_names) if not v.consistent
    ]
    if bad:
        raise ConfigurationError(
            f"{bad[0]}; no simulator takes such a body, export the physically consistent variant of the model"
        )


def digits(value: float) -> str:
    """Shortest text with all digits of the number."""
    return repr(float(value) + 0.0)


def comment(model: StandardModel, notes: tuple[str, ...]) -> str:
    """Text of the comment at the head: parameters without a place in the format."""
    names = model.chain.joint_names
    rows = [
        f" Inertials and friction identified: {model.title or 'a serial arm'}.",
        "Damping and friction are those of both sides of the gear together.",
        "Not part of a URDF, by joint: drive inertia [kg m^2], torque offset joint side, motor side [Nm]:",
    ]
    for k, joint in enumerate(names):
        inertia, joint_offset, motor_offset = model.drive[k, [0, 3, 6]]
        rows.append(f"  {joint}  {inertia:.6g}  {joint_offset:.6g}  {motor_offset:.6g}")
    if model.coulomb_kind != "sign":
        law = f"{model.coulomb_kind} with width {model.coulomb_width:g} rad/s"
        rows.append(
            f"The friction was estimated as a {law}; the simulator has a law of its own near zero speed."
        )
    rows += [*model.notes, *model.without(model.effects), *notes]
    return "\n     ".join(rows).replace("--", "- -") + " "


def drives_left_out(model: StandardModel, file: str) -> str:
    """Note on a URDF of the model: its drives have inertia, for which the format has no place; "" without."""
    inertia = model.drive[:, 0]
    if not np.any(inertia > 0.0):
        return ""
    chain = model.chain
    listed = ", ".join(
        f"{name} {value:.3g} {parameters.unit('Ia1', prismatic=slides)}"
        for name, value, slides in zip(chain.joint_names, inertia, chain.prismatic, strict=True)
        if value > 0.0
    )
    return (
        f"{file} has the bodies without the drives, for which a URDF has no place: give their inertia to the simulator "
        f"as armature ({listed}), or export an MJCF file, which holds it."
    )


def document(root: ElementTree.Element) -> str:
    """The XML document, indented."""
    ElementTree.indent(root, "  ")
    return '<?xml version="1.0"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"


_SNAP_RAD = 1e-5


def to_urdf(model: StandardModel, *, name: str | None = None) -> str:
    """URDF text of a consistent model: the arm's own with new inertials, or a new one for a chain from a table.

    Bodies fixed to a moving link are part of that link's parameters and lose their own inertial. Angles of joint
    origins within 1e-5 of a multiple of pi/2 are written as that multiple, as in the chain.

    Raises ConfigurationError for a physically inconsistent model: project it first.
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
    """Links fixed to a moving link; their bodies are part of its parameters."""
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
    parent = "base_link"
    ElementTree.SubElement(root, "link", {"name": parent})
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


def _inertial(body: Floats) -> ElementTree.Element:
    mass, com, tensor = parameters.to_com(body)
    element = ElementTree.Element("inertial")
    ElementTree.SubElement(element, "origin", {"xyz": " ".join(map(digits, com)), "rpy": "0 0 0"})
    ElementTree.SubElement(element, "mass", {"value": digits(float(mass))})
    entries = map(digits, tensor[np.triu_indices(3)])
    keys = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    ElementTree.SubElement(element, "inertia", dict(zip(keys, entries, strict=True)))
    return element


def _origin(pose: Floats) -> dict[str, str]:
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


def to_mjcf(model: StandardModel, *, name: str = "arm") -> str:
    """MJCF text of a consistent model.

    Armature and friction of both sides of the gear act at the joint; negative ones are written as 0 and noted.
    Raises ConfigurationError for a physically inconsistent model: project it first.
    """
    require_consistent(model)
    chain = model.chain
    damping, dry, notes = friction(model)
    armature = np.maximum(model.drive[:, 0], 0.0)
    for joint, inertia in zip(chain.joint_names, model.drive[:, 0], strict=True):
        if inertia < 0.0:
            notes += (f"drive inertia of {joint} was estimated as {inertia:.6g} and is written as 0",)
    root = ElementTree.Element("mujoco", {"model": name})
    root.append(ElementTree.Comment(comment(model, notes)))
    ElementTree.SubElement(root, "compiler", {"angle": "radian", "autolimits": "true"})
    gravity = chain.base_placement[:3, :3] @ chain.gravity
    ElementTree.SubElement(root, "option", {"gravity": " ".join(map(digits, gravity))})
    parent = ElementTree.SubElement(ElementTree.SubElement(root, "worldbody"), "body", {"name": "base"})
    limits = _limits(chain.urdf)
    for k, joint in enumerate(chain.joint_names):
        pose = chain.placement(k) if k else chain.base_placement @ chain.placement(0)
        position = " ".join(map(digits, pose[:3, 3]))
        quaternion = " ".join(map(digits, _quaternion(pose[:3, :3])))
        body = ElementTree.SubElement(
            parent, "body", {"name": chain.link_names[k], "pos": position, "quat": quaternion}
        )
        mass, com, tensor = parameters.to_com(model.inertial[k])
        entries = (tensor[0, 0], tensor[1, 1], tensor[2, 2], tensor[0, 1], tensor[0, 2], tensor[1, 2])
        ElementTree.SubElement(
            body,
            "inertial",
            {
                "pos": " ".join(map(digits, com)),
                "mass": digits(float(mass)),
                "fullinertia": " ".join(map(digits, entries)),
            },
        )
        tags = {
            "name": joint,
            "type": "slide" if chain.prismatic[k] else "hinge",
            "axis": "0 0 1",
            "armature": digits(armature[k]),
            "damping": digits(damping[k]),
            "frictionloss": digits(dry[k]),
        }
        if joint in limits:
            tags["range"] = limits[joint]
        ElementTree.SubElement(body, "joint", tags)
        parent = body
    actuators = ElementTree.SubElement(root, "actuator")
    for joint in chain.joint_names:
        ElementTree.SubElement(actuators, "motor", {"name": f"{joint}_motor", "joint": joint, "gear": "1"})
    return document(root)


def _limits(urdf: str | None) -> dict[str, str]:
    """Ranges of the joints with limits in the URDF."""
    if urdf is None:
        return {}
    found = {}
    for joint in ElementTree.fromstring(urdf).findall("joint"):
        limit = joint.find("limit")
        if limit is None or joint.get("type") == "continuous":
            continue
        lower, upper = limit.get("lower"), limit.get("upper")
        if lower is not None and upper is not None and float(lower) < float(upper):
            found[joint.get("name", "")] = f"{lower} {upper}"
    return found


def _quaternion(rotation: Floats) -> Floats:
    """Unit quaternion w x y z, the eigenvector of Bar-Itzhack (2000): no branch, no loss at half turns."""
    (a, b, c), (d, e, f), (g, h, i) = rotation
    matrix = np.array(
        [
            [a + e + i, h - f, c - g, d - b],
            [h - f, a - e - i, b + d, c + g],
            [c - g, b + d, e - a - i, f + h],
            [d - b, c + g, f + h, i - a - e],
        ]
    )
    quaternion = np.linalg.eigh(matrix)[1][:, -1]
    quaternion[np.abs(quaternion) < 1e-15] = 0.0
    return quaternion * (1.0 if quaternion[np.flatnonzero(quaternion)[0]] > 0 else -1.0)
