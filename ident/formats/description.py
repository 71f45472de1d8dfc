"""Export to the XML descriptions URDF and MJCF, with all digits of the numbers.

A URDF holds rigid bodies and, for each joint, `damping` and `friction`; read back, it gives the torques of the
model. Drive inertias, torque offsets, coupled drives and a gravity that does not point straight down have no place in
the format and go to a comment.

MJCF, the model format of MuJoCo, holds bodies, drive inertia as `armature`, `frictionloss` and `damping` of each
joint; coupled drives are fixed tendons with `armature`, which an old MuJoCo does not know. Body frames are the modified
Denavit-Hartenberg frames of the chain; every joint has a motor. Torque offsets go to a comment.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree

import numpy as np

from fri.errors import ConfigurationError
from ident.dynamics import parameters
from ident.dynamics.kinematics import Chain
from ident.dynamics.parameters import Floats
from ident.dynamics.urdf import read_urdf
from ident.formats.standard import CoupledDrives, StandardModel


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


def comment(model: StandardModel, kind: str, notes: tuple[str, ...]) -> str:
    """Text of the comment at the head: parameters without a place in the format, "URDF" or "MJCF"."""
    names, both = model.chain.joint_names, len(model.sides) > 1
    columns: list[tuple[str, Floats]] = []
    if "motor" in model.sides and kind == "URDF":
        columns.append(("drive inertia [kg m^2]", model.drive[:, 0]))
    if "joint" in model.sides:
        columns.append(("torque offset joint side [Nm]", model.drive[:, 3]))
    if "motor" in model.sides:
        columns.append(
            ("torque offset motor side [Nm]", model.drive[:, 6] + (0 if both else model.drive[:, 3]))
        )
    rows = [
        f" Inertials and friction identified: {model.title or 'a serial arm'}.",
        "Damping and friction are those of both sides of the gear together."
        if "motor" in model.sides
        else "Damping and friction are those behind the gear alone.",
        f"Not part of {_A[kind]}, by joint: {', '.join(name for name, _ in columns)}:",
    ]
    for k, joint in enumerate(names):
        rows.append("  ".join([f"  {joint}", *(f"{values[k]:.6g}" for _, values in columns)]))
    if model.coulomb_kind != "sign":
        law = f"{model.coulomb_kind} with width {model.coulomb_width:g} rad/s"
        rows.append(
            f"The friction was estimated as a {law}; the simulator has a law of its own near zero speed."
        )
    rows += [
        *model.notes,
        *left_out(model, kind),
        *motors_unknown(model),
        *model.without(model.effects),
        *notes,
    ]
    if kind == "MJCF" and model.couplings:
        rows.append("Coupled drives are fixed tendons; their armature needs a MuJoCo that knows it.")
    return "\n     ".join(rows).replace("--", "- -") + " "


_A = {"URDF": "a URDF", "MJCF": "an MJCF file"}


def left_out(model: StandardModel, kind: str, file: str = "this file") -> tuple[str, ...]:
    """Notes on what a file of a format, "URDF" or "MJCF", lacks of the model: gravity and coupled drives."""
    notes = []
    if kind == "URDF":
        notes.append(_tilted(model, file))
    for coupling in model.couplings:
        a, b = (model.chain.joint_names[joint] for joint in coupling.joints)
        own = {
            "inertia": (coupling.inertia, "kg m^2", kind == "MJCF" and _shared(model, coupling) is not None),
            "viscous friction": (coupling.viscous, "Nm s/rad", kind == "MJCF" and coupling.viscous >= 0.0),
            "Coulomb friction": (coupling.coulomb, "Nm", kind == "MJCF" and coupling.coulomb >= 0.0),
        }
        missing = [
            f"{name} {value:.4g} {unit}" for name, (value, unit, held) in own.items() if not held and value
        ]
        if missing:
            notes.append(
                f"Missing in {file}, the coupled drives of {a} and {b}: {', '.join(missing)}; the torques of both "
                "joints differ from the model's by these. C and numpy code have them"
                + (", and MJCF as far as it can." if kind == "URDF" else ".")
            )
    return tuple(filter(None, notes))


def motors_unknown(model: StandardModel, file: str = "this file") -> tuple[str, ...]:
    """Note on a file of a model without motor torques."""
    if "motor" in model.sides:
        return ()
    return (
        "The model is one of joint torques: drive inertia and motor friction are unknown, not zero, and missing in "
        f"{file}; a model with motor torques has them.",
    )


_UPRIGHT = 1e-6


def _tilted(model: StandardModel, file: str) -> str:
    """Note on a file without gravity, for a base where it does not point straight down; otherwise ""."""
    gravity = model.base_gravity
    size = float(np.linalg.norm(gravity))
    if size == 0.0:
        return (
            f"Gravity of the model is zero, for which {file} has no place: set it to zero in the simulator."
        )
    tilt = float(np.arctan2(np.hypot(gravity[0], gravity[1]), -gravity[2]))
    if tilt <= _UPRIGHT:
        return ""
    vector = " ".join(f"{value:.6g}" for value in gravity + 0.0)
    roll, pitch = (
        np.arctan2(-gravity[1], -gravity[2]),
        np.arctan2(gravity[0], np.hypot(gravity[1], gravity[2])),
    )
    return (
        f"The base is tilted by {np.rad2deg(tilt):.3g} degrees, for which {file} has no place: give the simulator "
        f"gravity [{vector}] m/s^2 in the axes of the base, or mount the base with "
        f'rpy="{roll + 0.0:.6g} {pitch + 0.0:.6g} 0".'
    )


def _shared(model: StandardModel, coupling: CoupledDrives) -> tuple[float, float] | None:
    """Inertia of a tendon and its coefficient at the second joint, that make the inertia of coupled drives.

    A tendon of inertia w and coefficients 1 and c adds w, w c and w c^2; None if the joints have less than that.
    """
    first, second = (max(float(model.drive[joint, 0]), 0.0) for joint in coupling.joints)
    inertia = coupling.inertia
    if 0.0 <= inertia <= min(first, second):
        return inertia, 1.0
    if inertia**2 > first * second:
        return None
    factor = float(np.copysign(np.sqrt(second / first), inertia))
    return inertia / factor, factor


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


_SAME_POSE = 1e-12
_SAME_BASE = 1e-3
"""Differences of poses: none but rounding; and of the first link's, that the rounding of right angles explains."""


def to_urdf(model: StandardModel, *, name: str | None = None) -> str:
    """URDF text of a consistent model: the arm's own with new inertials, or a new one for a chain from a table.

    Bodies fixed to a moving link are part of that link's parameters and lose their own inertial. Origins of joints
    are those of the chain, which takes an angle of 1.5708 for a right one.

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
    origins = _origins(chain)
    for joint in root.findall("joint"):
        if joint.get("name") in origins:
            for old in joint.findall("origin"):
                joint.remove(old)
            joint.insert(0, ElementTree.Element("origin", _origin(origins[joint.get("name", "")])))
        if joint.get("name") in order:
            k = order[joint.get("name", "")]
            for old in joint.findall("dynamics"):
                joint.remove(old)
            tags = {"damping": digits(damping[k]), "friction": digits(dry[k])}
            joint.append(ElementTree.Element("dynamics", tags))
    root.insert(0, ElementTree.Comment(comment(model, "URDF", notes)))
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
    root.append(ElementTree.Comment(comment(model, "URDF", notes)))
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
    angles = " ".join(digits(_tidy(float(angle))) for angle in (roll, pitch, yaw))
    return {"xyz": " ".join(map(digits, pose[:3, 3])), "rpy": angles}


def _origins(chain: Chain) -> dict[str, Floats]:
    """Origins (4, 4) of the chain's joints where the file's own differ from the chain's kinematics."""
    assert chain.urdf is not None
    assert chain.link_placements is not None
    tree = read_urdf(chain.urdf)
    above = {joint.child: joint for joint in tree.joints}
    found: dict[str, Floats] = {}
    for k, name in enumerate(chain.joint_names):
        joint = above[chain.link_names[k]]
        step = chain.placement(k) @ chain.link_placements[k]
        step = np.linalg.inv(chain.link_placements[k - 1]) @ step if k else chain.base_placement @ step
        # Between a joint of the chain and the one before it may be others, which do not move.
        before, parent, start = np.eye(4), joint.parent, chain.link_names[k - 1] if k else None
        while parent != start and parent in above:
            # A chain that begins above the root does so where the pose is right.
            if start is None and np.abs(before @ joint.origin - step).max() < _SAME_BASE:
                break
            before, parent = above[parent].origin @ before, above[parent].parent
        difference = np.abs(before @ joint.origin - step).max()
        if difference > _SAME_POSE and (start is not None or difference < _SAME_BASE):
            found[name] = np.linalg.inv(before) @ step
    return found


def _tidy(angle: float) -> float:
    nearest = round(angle / (np.pi / 2)) * (np.pi / 2)
    return nearest if abs(angle - nearest) <= _SAME_POSE else angle


def to_mjcf(model: StandardModel, *, name: str = "arm") -> str:
    """MJCF text of a consistent model.

    Armature and friction of both sides of the gear act at the joint; negative ones are written as 0 and noted.
    Raises ConfigurationError for a physically inconsistent model: project it first.
    """
    require_consistent(model)
    chain = model.chain
    damping, dry, notes = friction(model)
    armature = np.maximum(model.drive[:, 0], 0.0)
    for coupling in model.couplings:
        (a, b), (inertia, factor) = coupling.joints, _shared(model, coupling) or (0.0, 0.0)
        armature[[a, b]] -= inertia, inertia * factor**2
    armature = np.maximum(armature, 0.0)
    for joint, inertia in zip(chain.joint_names, model.drive[:, 0], strict=True):
        if inertia < 0.0:
            notes += (f"drive inertia of {joint} was estimated as {inertia:.6g} and is written as 0",)
    root = ElementTree.Element("mujoco", {"model": name})
    root.append(ElementTree.Comment(comment(model, "MJCF", notes)))
    ElementTree.SubElement(root, "compiler", {"angle": "radian", "autolimits": "true"})
    ElementTree.SubElement(root, "option", {"gravity": " ".join(map(digits, model.base_gravity))})
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
    if model.couplings:
        _tendons(ElementTree.SubElement(root, "tendon"), model)
    actuators = ElementTree.SubElement(root, "actuator")
    for joint in chain.joint_names:
        ElementTree.SubElement(actuators, "motor", {"name": f"{joint}_motor", "joint": joint, "gear": "1"})
    return document(root)


def _tendons(parent: ElementTree.Element, model: StandardModel) -> None:
    """Coupled drives as tendons over both joints: friction of the sum of speeds, and the shared inertia."""
    for coupling in model.couplings:
        joints = [model.chain.joint_names[joint] for joint in coupling.joints]
        inertia, factor = _shared(model, coupling) or (0.0, 1.0)
        tendons = {
            "friction": (
                1.0,
                {"damping": max(coupling.viscous, 0.0), "frictionloss": max(coupling.coulomb, 0.0)},
            ),
            "inertia": (factor, {"armature": inertia}),
        }
        for kind, (second, values) in tendons.items():
            tags = {"name": f"{joints[0]}_{joints[1]}_{kind}"}
            tags |= {key: digits(value) for key, value in values.items()}
            tendon = ElementTree.SubElement(parent, "fixed", tags)
            for joint, coefficient in zip(joints, (1.0, second), strict=True):
                ElementTree.SubElement(tendon, "joint", {"joint": joint, "coef": digits(coefficient)})


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
