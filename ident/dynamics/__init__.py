"""Kinematics, rigid-body regressor, structure of the model and its base parameters."""

from __future__ import annotations

from ident.dynamics.base_closed_form import closed_form_base
from ident.dynamics.base_set import BaseSet, columns_by_preference, numeric_base
from ident.dynamics.kinematics import Chain
from ident.dynamics.parameters import (
    DRIVE,
    INERTIAL,
    PER_LINK,
    Floats,
    from_com,
    pseudo_inertia,
    split_name,
    to_com,
)
from ident.dynamics.physical import Projection, project, reference_bodies
from ident.dynamics.structure import Condition, Coulomb, Coupling, ModelStructure, Side
from ident.dynamics.tables import Tabular
from ident.dynamics.urdf import read_urdf

__all__ = [
    "DRIVE",
    "INERTIAL",
    "PER_LINK",
    "BaseSet",
    "Chain",
    "Condition",
    "Coulomb",
    "Coupling",
    "Floats",
    "ModelStructure",
    "Projection",
    "Side",
    "Tabular",
    "closed_form_base",
    "columns_by_preference",
    "from_com",
    "numeric_base",
    "project",
    "pseudo_inertia",
    "read_urdf",
    "reference_bodies",
    "split_name",
    "to_com",
]
