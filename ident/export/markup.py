"""What the XML formats share: numbers with all digits, friction of both sides, the comment at the head."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree

import numpy as np
from numpy.typing import NDArray

from fri.errors import ConfigurationError
from ident import parameters
from ident.export.standard import StandardModel

__all__ = ["comment", "digits", "document", "friction", "require_consistent"]


def friction(model: StandardModel) -> tuple[NDArray[np.float64], NDArray[np.float64], tuple[str, ...]]:
    """Damping [Nm s/rad] and dry friction [Nm] of each joint, both sides together, and notes on what was cut
    to zero.

    Simulators refuse negative friction.
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
    """Raise ConfigurationError that names the link which cannot exist."""
    bad = [
        v.reason for v in parameters.consistency(model.inertial, model.chain.link_names) if not v.consistent
    ]
    if bad:
        raise ConfigurationError(
            f"{bad[0]}; no simulator takes such a body, export the physically consistent variant of the model"
        )


def digits(value: float) -> str:
    """Shortest text that reads back as the same number."""
    return repr(float(value) + 0.0)


def comment(model: StandardModel, notes: tuple[str, ...]) -> str:
    """Text of the comment at the head: what the format has no place for."""
    names = model.chain.joint_names
    rows = [
        f" Inertials and friction identified: {model.title or 'a serial arm'}.",
        "Damping and friction are those of both sides of the gear together.",
        "Not part of a URDF, by joint: drive inertia [kg m^2], torque offset joint side, motor side [Nm]:",
    ]
    for k, joint in enumerate(names):
        inertia, joint_offset, motor_offset = model.drive[k, [0, 3, 6]]
        rows.append(f"  {joint}  {inertia:.6g}  {joint_offset:.6g}  {motor_offset:.6g}")
    rows += [*model.notes, *notes]
    return "\n     ".join(rows).replace("--", "- -") + " "


def document(root: ElementTree.Element) -> str:
    """The XML document, indented."""
    ElementTree.indent(root, "  ")
    return '<?xml version="1.0"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"
