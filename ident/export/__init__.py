"""Export of a model: URDF, MJCF, and stand-alone inverse dynamics in C and numpy."""

from __future__ import annotations

from ident.export.code import Program, to_c, to_numpy
from ident.export.from_model import ConsistentParameters, consistent_parameters, standard_model
from ident.export.mjcf import to_mjcf
from ident.export.standard import CoupledDrives, StandardModel
from ident.export.urdf import to_urdf

__all__ = [
    "ConsistentParameters",
    "CoupledDrives",
    "Program",
    "StandardModel",
    "consistent_parameters",
    "standard_model",
    "to_c",
    "to_mjcf",
    "to_numpy",
    "to_urdf",
]
