"""Export of a model: URDF, MJCF, and stand-alone inverse dynamics in C and numpy."""

from __future__ import annotations

from ident.formats.code import Program, to_c, to_numpy
from ident.formats.description import to_mjcf, to_urdf
from ident.formats.files import FORMATS, export
from ident.formats.standard import (
    ConsistentParameters,
    CoupledDrives,
    StandardModel,
    consistent_parameters,
    standard_model,
)

__all__ = [
    "FORMATS",
    "ConsistentParameters",
    "CoupledDrives",
    "Program",
    "StandardModel",
    "consistent_parameters",
    "export",
    "standard_model",
    "to_c",
    "to_mjcf",
    "to_numpy",
    "to_urdf",
]
