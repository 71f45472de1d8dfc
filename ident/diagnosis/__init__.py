"""Model errors: evidence for causes, an extended model, and its gain."""

from __future__ import annotations

from typing import TYPE_CHECKING

from fri.on_first_use import on_first_use

if TYPE_CHECKING:
    from ident.diagnosis.diagnose import diagnose
    from ident.diagnosis.healthy.bench import ArmData
    from ident.diagnosis.healthy.commission import commission
    from ident.diagnosis.healthy.reference import Reference
    from ident.diagnosis.outcome.result import Diagnosis, Finding, SimulationError
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
    ".healthy.bench": ("ArmData",),
    ".healthy.commission": ("commission",),
    ".diagnose": ("diagnose",),
    ".healthy.reference": ("Reference",),
    ".outcome.result": (
        "Diagnosis",
        "Finding",
        "SimulationError",
    ),
    ".settings": ("DiagnosisSettings",),
}

__getattr__, __dir__ = on_first_use(globals(), _HOMES)
