"""References of a healthy arm of three joints without measurements, made by several tests."""

from __future__ import annotations

from typing import Any

import numpy as np

from ident.diagnosis import Reference
from ident.model import DynamicModel


def bare_reference(model: DynamicModel, sets: int = 2, **content: Any) -> Reference:
    """Rigid joints, punctual channels and no noise, with `content` besides."""
    stored: dict[str, Any] = {"noise": {}, "null": {}} | content
    return Reference(model, compliance=np.zeros(3), motor_delay_s=0.0, joint_delay_s=0.0, sets=sets, **stored)
