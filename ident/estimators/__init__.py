"""Estimators of the stacked linear regression: one interface, one results object.

Each takes its settings in the constructor and has `fit(problem) -> Estimate`.
"""

from __future__ import annotations

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
from ident.estimators.recursive import RecursiveFilter, RecursiveLeastSquares, RegressorExtensionMixing, Track

__all__ = [
    "BodyPrior",
    "ClassFit",
    "Covariance",
    "CovarianceSettings",
    "Estimate",
    "Estimator",
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
