"""Estimators of the stacked linear regression: one interface, one results object.

Each takes its settings in the constructor and has `fit(problem) -> Estimate`. Names are imported on first use.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from fri.on_first_use import on_first_use

if TYPE_CHECKING:
    from ident.estimators.covariance import CovarianceSettings, correlation_time
    from ident.estimators.errors_in_variables import InstrumentalVariables, TotalLeastSquares
    from ident.estimators.estimate import (
        ClassFit,
        Covariance,
        Estimate,
        Estimator,
        chi_square_tail,
        fisher_limit,
        fisher_tail,
        normal_tail,
        student_tail,
    )
    from ident.estimators.least_squares import OrdinaryLeastSquares, RobustLeastSquares, WeightedLeastSquares
    from ident.estimators.physical import BodyPrior, PhysicallyConsistent, cad_prior, nearest_consistent
    from ident.estimators.prior import MaximumAPosteriori, Prior
    from ident.estimators.problem import Nuisance, Problem, RowClass, RowGroup, TriangularFactor
    from ident.estimators.recursive import (
        RecursiveFilter,
        RecursiveLeastSquares,
        RegressorExtensionMixing,
        Track,
    )
    from ident.estimators.registry import ESTIMATORS, EstimatorKind

__all__ = [
    "ESTIMATORS",
    "BodyPrior",
    "ClassFit",
    "Covariance",
    "CovarianceSettings",
    "Estimate",
    "Estimator",
    "EstimatorKind",
    "InstrumentalVariables",
    "MaximumAPosteriori",
    "Nuisance",
    "OrdinaryLeastSquares",
    "PhysicallyConsistent",
    "Prior",
    "Problem",
    "RecursiveFilter",
    "RecursiveLeastSquares",
    "RegressorExtensionMixing",
    "RobustLeastSquares",
    "RowClass",
    "RowGroup",
    "TotalLeastSquares",
    "Track",
    "TriangularFactor",
    "WeightedLeastSquares",
    "cad_prior",
    "chi_square_tail",
    "correlation_time",
    "fisher_limit",
    "fisher_tail",
    "nearest_consistent",
    "normal_tail",
    "student_tail",
]

_HOMES = {
    ".covariance": ("CovarianceSettings", "correlation_time"),
    ".errors_in_variables": (
        "InstrumentalVariables",
        "TotalLeastSquares",
    ),
    ".estimate": (
        "ClassFit",
        "Covariance",
        "Estimate",
        "Estimator",
        "chi_square_tail",
        "fisher_limit",
        "fisher_tail",
        "normal_tail",
        "student_tail",
    ),
    ".least_squares": (
        "OrdinaryLeastSquares",
        "RobustLeastSquares",
        "WeightedLeastSquares",
    ),
    ".physical": (
        "BodyPrior",
        "PhysicallyConsistent",
        "cad_prior",
        "nearest_consistent",
    ),
    ".prior": (
        "MaximumAPosteriori",
        "Prior",
    ),
    ".problem": (
        "Nuisance",
        "Problem",
        "RowClass",
        "RowGroup",
        "TriangularFactor",
    ),
    ".recursive": (
        "RecursiveFilter",
        "RecursiveLeastSquares",
        "RegressorExtensionMixing",
        "Track",
    ),
    ".registry": (
        "ESTIMATORS",
        "EstimatorKind",
    ),
}
__getattr__, __dir__ = on_first_use(globals(), _HOMES)
