"""Planning of exciting motions: parametrisations, objectives, constraints, solver, and the plan that comes
out.
"""

from ident.excitation.check import Check, Limits, Margin, Workspace, check_motion
from ident.excitation.feasible import arm_limits, feasible_fourier
from ident.excitation.fourier import FourierBasis, FourierSeries
from ident.excitation.plan import ExcitationPlan

__all__ = [
    "Check",
    "ExcitationPlan",
    "FourierBasis",
    "FourierSeries",
    "Limits",
    "Margin",
    "Workspace",
    "arm_limits",
    "check_motion",
    "feasible_fourier",
]
