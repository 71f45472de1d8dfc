"""Identification of a model from session logs, its validation, comparison and payloads."""

from __future__ import annotations

from ident.estimation.compare import Comparison, compare
from ident.estimation.identify import Identification, IdentificationSettings, identify
from ident.estimation.mounting import Mounting, find_mounting
from ident.estimation.payload import identify_payload
from ident.estimation.validate import Validation, cross_validate, validate

__all__ = [
    "Comparison",
    "Identification",
    "IdentificationSettings",
    "Mounting",
    "Validation",
    "compare",
    "cross_validate",
    "find_mounting",
    "identify",
    "identify_payload",
    "validate",
]
