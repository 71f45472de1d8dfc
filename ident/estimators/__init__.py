"""Estimators of the stacked linear regression: one interface, one results object.

Each takes its settings in the constructor and has `fit(problem) -> Estimate`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

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


@dataclass(frozen=True)
class EstimatorKind:
    """An estimator that can be chosen by name.

    summary : one line for help and documents. options : names of its settings.
    make : from `covariance` and any of the options, with `body_prior` also from `prior`, the `BodyPrior` of the
        arm. body_prior : the estimate starts from the inertials of the URDF.
    """

    summary: str
    make: Callable[..., Estimator]
    options: tuple[str, ...] = ()
    body_prior: bool = False


def _map(
    prior: BodyPrior,
    covariance: CovarianceSettings,
    prior_strength: Any = 1.0,
    prior_metric: Any = "pullback",
) -> Estimator:
    return MaximumAPosteriori(prior.prior(prior_metric), prior_strength, covariance)


def _physical(
    prior: BodyPrior,
    covariance: CovarianceSettings,
    prior_strength: Any = 1.0,
    prior_metric: Any = "pullback",
) -> Estimator:
    return PhysicallyConsistent(prior, prior_metric, prior_strength, covariance=covariance)


def _robust(loss: Any) -> Callable[..., Estimator]:
    return lambda **settings: RobustLeastSquares(loss, **settings)


_PRIOR = ("prior_strength", "prior_metric", "prior_std")

ESTIMATORS: dict[str, EstimatorKind] = {
    "ols": EstimatorKind("ordinary least squares, for comparison", OrdinaryLeastSquares),
    "wls": EstimatorKind("least squares weighted by joint and side", WeightedLeastSquares),
    "huber": EstimatorKind("robust: linear loss for large residuals", _robust("huber"), ("tuning",)),
    "tukey": EstimatorKind("robust: constant loss for large residuals", _robust("tukey"), ("tuning",)),
    "tls": EstimatorKind(
        "total least squares: noise in the regressor too", TotalLeastSquares, ("relative_noise",)
    ),
    "recursive": EstimatorKind("recursive, for parameters that drift", RecursiveLeastSquares, ("memory_s",)),
    "mixing": EstimatorKind(
        "one scalar regression per parameter, for weak excitation", RegressorExtensionMixing, ("memory_s",)
    ),
    "map": EstimatorKind("least squares with the URDF's inertials as prior", _map, _PRIOR, True),
    "physical": EstimatorKind(
        "`map` over physically consistent bodies, for prediction", _physical, _PRIOR, True
    ),
    # `identify` compares this weighted estimate with that of `InstrumentalVariables`.
    "iv": EstimatorKind("instrumental variables from the commanded motion", WeightedLeastSquares),
}
"""The estimators by name."""
