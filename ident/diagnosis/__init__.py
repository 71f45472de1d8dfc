"""Model errors: evidence for causes, an extended model, and its gain."""

from __future__ import annotations

from ident.diagnosis.bench import ArmData
from ident.diagnosis.commission import commission
from ident.diagnosis.diagnose import diagnose
from ident.diagnosis.reference import Reference
from ident.diagnosis.result import Diagnosis, Finding, SimulationError
from ident.diagnosis.settings import DiagnosisSettings

__all__ = [
    "ArmData",
    "Diagnosis",
    "DiagnosisSettings",
    "Finding",
    "Reference",
    "SimulationError",
    "commission",
    "diagnose",
]
