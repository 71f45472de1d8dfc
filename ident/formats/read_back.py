"""Exported files, read back: each must give the torques of the model at random states, slow ones included."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import tempfile
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from fri.errors import DataError, LwrError
from ident.dynamics import regressor
from ident.dynamics.kinematics import Chain
from ident.dynamics.parameters import Floats, from_com
from ident.formats.description import friction
from ident.formats.standard import StandardModel
from ident.model.dynamic_model import DynamicModel

_STATES = 24
_CODE = 1e-9
_DESCRIPTION = 1e-6
"""Relative errors: of code by rounding, of a description by angles next to right ones."""

_COMPILE_S = 120.0


def check_numpy(text: str, model: DynamicModel, payload: str | None) -> None:
    """Raise DataError unless the numpy code gives the torque of the model on each side."""
    space: dict[str, Any] = {}
    try:
        exec(compile(text, "export", "exec"), space)
        states = _states(model)
        found = space["inverse_dynamics"](*states)
    except Exception as error:
        raise DataError(f"the code does not run: {error!r}") from error
    sides = model.structure.sides
    outputs = found if len(sides) > 1 else (found,)
    _compare_sides(dict(zip(sides, outputs, strict=True)), model, payload, states)


def check_c(text: str, model: DynamicModel, payload: str | None, name: str) -> str:
    """Compile the C code and raise DataError unless it gives the torque of the model on each side.

    Returns a note for a computer without a C compiler, otherwise an empty text.
    """
    compiler = shutil.which("cc")
    if compiler is None:
        return "The C file was not compiled as a test: this computer has no compiler `cc`."
    n = model.structure.chain.n
    states = _states(model)
    with tempfile.TemporaryDirectory() as folder:
        source, library = Path(folder) / "export.c", Path(folder) / "export.so"
        source.write_text(text, encoding="utf-8")
        command = [compiler, "-std=c99", "-shared", "-fPIC", "-o", str(library), str(source), "-lm"]
        done = subprocess.run(command, capture_output=True, text=True, timeout=_COMPILE_S, check=False)
        if done.returncode:
            raise DataError(f"the C code does not compile: {done.stderr.strip()[:300]}")
        try:
            function = getattr(ctypes.CDLL(str(library)), f"{name}_inverse_dynamics")
        except OSError:
            return "The C file was compiled but not run as a test: this computer loads no library from its folder."
        function.restype = None
        found = {side: np.zeros((_STATES, n)) for side in model.structure.sides}
        for k in range(_STATES):
            rows = [np.ascontiguousarray(part[k]) for part in states]
            function(*(ctypes.c_void_p(row.ctypes.data) for row in (*rows, *(f[k] for f in found.values()))))
    _compare_sides(found, model, payload, states)
    return ""


def check_urdf(text: str, model: StandardModel) -> None:
    """Raise DataError unless the URDF holds the chain, the rigid torques and the friction of the model."""
    chain = model.chain
    gravity = model.base_gravity
    try:
        # Every digit as it stands: other software rounds no angles.
        again = Chain.from_urdf(text, tip=chain.link_names[-1], gravity=gravity, snap_rad=0.0)
    except LwrError as error:
        raise DataError(str(error)) from error
    if again.joint_names == chain.joint_names:
        q, qd, qdd = _random(chain.n, 0.0)
        wanted = regressor.torque(chain, q, qd, qdd, model.inertial)
        _compare("torque", regressor.torque(again, q, qd, qdd, again.urdf_inertials()), wanted, _DESCRIPTION)
    elif again.joint_names[-chain.n :] == chain.joint_names:
        # A chain from a link above the root: the same bodies behind further joints.
        _compare("bodies", again.urdf_inertials()[-chain.n :], model.inertial, _DESCRIPTION)
    elif not set(chain.joint_names) <= set(again.joint_names):
        raise DataError(f"its joints are {' '.join(again.joint_names)}, not {' '.join(chain.joint_names)}")
    joints = {one.get("name"): one.find("dynamics") for one in ElementTree.fromstring(text).findall("joint")}
    damping, dry, _ = friction(model)
    for key, values in (("damping", damping), ("friction", dry)):
        read = [_number(joints[name], key) for name in chain.joint_names]
        _compare(key, np.array(read), values, _CODE)


def check_mjcf(text: str, model: StandardModel) -> None:
    """Raise DataError unless the MJCF holds the bodies, drives and friction of the model."""
    bodies = {body.get("name"): body for body in ElementTree.fromstring(text).iter("body")}
    damping, dry, _ = friction(model)
    drives = {"damping": damping, "frictionloss": dry}
    inertia, order = np.zeros((model.chain.n, model.chain.n)), list(model.chain.joint_names)
    for k, link in enumerate(model.chain.link_names):
        body = bodies.get(link)
        inertial, joint = (None, None) if body is None else (body.find("inertial"), body.find("joint"))
        if inertial is None or joint is None:
            raise DataError(f"link {link} has no body with inertial and joint")
        full = [float(part) for part in inertial.get("fullinertia", "").split()]
        tensor = np.diag(full[:3])
        tensor[np.triu_indices(3, 1)] = full[3:]
        tensor = tensor + np.triu(tensor, 1).T
        com = np.array([float(part) for part in inertial.get("pos", "").split()])
        _compare(link, from_com(_number(inertial, "mass"), com, tensor), model.inertial[k], _DESCRIPTION)
        for key, values in drives.items():
            _compare(f"{key} of {joint.get('name')}", np.array(_number(joint, key)), values[k], _CODE)
        inertia[k, k] += _number(joint, "armature")
    for tendon in ElementTree.fromstring(text).findall("tendon/fixed"):
        row = np.zeros(model.chain.n)
        for part in tendon.findall("joint"):
            row[order.index(part.get("joint", ""))] = _number(part, "coef")
        inertia += float(tendon.get("armature", "0")) * np.outer(row, row)
    _compare("armature", inertia, _drive_inertia(model), _CODE)


def _drive_inertia(model: StandardModel) -> Floats:
    """(n, n) inertia of the drives, with that of the coupled ones where real drives can have it."""
    own = np.maximum(model.drive[:, 0], 0.0)
    matrix = np.diag(own)
    for coupling in model.couplings:
        a, b = coupling.joints
        if coupling.inertia**2 <= own[a] * own[b]:
            matrix[a, b] = matrix[b, a] = coupling.inertia
    return matrix


def _states(model: DynamicModel) -> tuple[Floats, Floats, Floats]:
    return _random(model.structure.chain.n, model.structure.coulomb.width)


def _random(n: int, width: float) -> tuple[Floats, Floats, Floats]:
    """q, qd, qdd (N, n); half of the speeds of the size of the Coulomb function's width."""
    q, qd, qdd = np.random.default_rng(0).normal(size=(3, _STATES, n))
    if width > 0.0:
        qd[::2] *= width
    return q, qd, qdd


def _compare_sides(
    found: Mapping[Any, Floats],
    model: DynamicModel,
    payload: str | None,
    states: tuple[Floats, Floats, Floats],
) -> None:
    for side, torque in found.items():
        _compare(f"{side} torque", torque, model.torque(*states, payload=payload, side=side), _CODE)


def _compare(what: str, found: Floats, wanted: Floats, tolerance: float) -> None:
    scale = max(float(np.max(np.abs(wanted), initial=0.0)), 1.0)
    off = float(np.max(np.abs(found - wanted), initial=0.0))
    if not off <= tolerance * scale:
        raise DataError(f"its {what} differs from the model's by {off:.3g}")


def _number(element: ElementTree.Element | None, key: str) -> float:
    text = None if element is None else element.get(key)
    if text is None:
        raise DataError(f"it has no {key}")
    return float(text)
