"""What the model gets wrong: evidence for causes, an extended model, and what it gains."""

from __future__ import annotations

from ident.discrepancy.bench import ArmData
from ident.discrepancy.commission import commission
from ident.discrepancy.diagnose import diagnose
from ident.discrepancy.reference import Reference
from ident.discrepancy.result import Diagnosis, Finding, SimulationError
from ident.discrepancy.settings import DiagnosisSettings

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
