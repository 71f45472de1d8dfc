"""Kinematics, rigid-body regressor, structure of the model and its base parameters."""

from __future__ import annotations

from ident.dynamics.base_closed_form import closed_form_base
from ident.dynamics.base_set import BaseSet, columns_by_preference, numeric_base
from ident.dynamics.kinematics import Chain
from ident.dynamics.structure import Condition, Coulomb, Coupling, ModelStructure, Side

__all__ = [
    "BaseSet",
    "Chain",
    "Condition",
    "Coulomb",
    "Coupling",
    "ModelStructure",
    "Side",
    "closed_form_base",
    "columns_by_preference",
    "numeric_base",
]
