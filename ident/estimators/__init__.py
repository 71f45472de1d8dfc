"""Estimators of the stacked linear regression: one interface, one results object.

Each takes its settings in the constructor and has `fit(problem) -> Estimate`.
"""

from __future__ import annotations

from ident.estimators.covariance import CovarianceSettings
from ident.estimators.estimate import ClassFit, Covariance, Estimate, Estimator
from ident.estimators.instrumental import InstrumentalVariables
from ident.estimators.mixing import RegressorExtensionMixing
from ident.estimators.ordinary import OrdinaryLeastSquares
from ident.estimators.physical import BodyPrior, PhysicallyConsistent, nearest_consistent
from ident.estimators.prior import MaximumAPosteriori, Prior
from ident.estimators.problem import Nuisance, Problem, RowClass, RowGroup, TriangularFactor
from ident.estimators.recursive import RecursiveFilter, RecursiveLeastSquares, Track
from ident.estimators.robust import RobustLeastSquares
from ident.estimators.total import TotalLeastSquares
from ident.estimators.weighted import WeightedLeastSquares

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
    "nearest_consistent",
]
