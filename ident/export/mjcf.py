"""MJCF, the model format of MuJoCo: bodies, drive inertia as `armature`, `frictionloss` and `damping` of each
joint.

Body frames are the modified Denavit-Hartenberg frames of the chain; every joint has a motor. Torque offsets
have no place in the format; they stand in a comment.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree

import numpy as np
from numpy.typing import NDArray

from ident import parameters
from ident.export.markup import comment, digits, document, friction, require_consistent
from ident.export.standard import StandardModel

__all__ = ["to_mjcf"]


def to_mjcf(model: StandardModel, *, name: str = "arm") -> str:
    """MJCF text of a consistent model.

    Armature and friction of both sides of the gear act at the joint; what is negative is written as 0 and
    noted. Raises ConfigurationError for a model whose links cannot exist: project it first.
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
    """Ranges of the joints that the URDF limits."""
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


def _quaternion(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
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
