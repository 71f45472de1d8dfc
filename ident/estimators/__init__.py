"""Estimators of the stacked linear regression: one interface, one results object.

Each takes its settings in the constructor and has `fit(problem) -> Estimate`.
"""

from __future__ import annotations

from ident.estimators.covariance import CovarianceSettings
from ident.estimators.estimate import ClassFit, Covariance, Estimate, Estimator
from ident.estimators.instrumental import InstrumentalVariables
from ident.estimators.ordinary import OrdinaryLeastSquares
from ident.estimators.prior import MaximumAPosteriori, Prior
from ident.estimators.problem import Problem, RowClass, RowGroup, TriangularFactor
from ident.estimators.robust import RobustLeastSquares
from ident.estimators.total import TotalLeastSquares
from ident.estimators.weighted import WeightedLeastSquares

__all__ = [
    "ClassFit",
    "Covariance",
    "CovarianceSettings",
    "Estimate",
    "Estimator",
    "InstrumentalVariables",
    "MaximumAPosteriori",
    "OrdinaryLeastSquares",
    "Prior",
    "Problem",
    "RobustLeastSquares",
    "RowClass",
    "RowGroup",
    "TotalLeastSquares",
    "TriangularFactor",
    "WeightedLeastSquares",
]
