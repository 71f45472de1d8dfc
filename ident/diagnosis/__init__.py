"""Model errors: evidence for causes, an extended model, and its gain."""

from __future__ import annotations

from typing import TYPE_CHECKING

from fri.on_first_use import on_first_use

if TYPE_CHECKING:
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

_HOMES = {
    ".bench": ("ArmData",),
    ".commission": ("commission",),
    ".diagnose": ("diagnose",),
    ".reference": ("Reference",),
    ".result": (
        "Diagnosis",
        "Finding",
        "SimulationError",
    ),
    ".settings": ("DiagnosisSettings",),
}

__getattr__, __dir__ = on_first_use(globals(), _HOMES)
