"""The estimators that can be chosen by name: how each is made and what it needs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from ident.estimators.covariance import CovarianceSettings
from ident.estimators.errors_in_variables import TotalLeastSquares
from ident.estimators.estimate import Estimator
from ident.estimators.least_squares import OrdinaryLeastSquares, RobustLeastSquares, WeightedLeastSquares
from ident.estimators.names import SUMMARIES
from ident.estimators.physical import BodyPrior, PhysicallyConsistent
from ident.estimators.prior import MaximumAPosteriori
from ident.estimators.recursive import RecursiveLeastSquares, RegressorExtensionMixing


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
    "ols": EstimatorKind(SUMMARIES["ols"], OrdinaryLeastSquares),
    "wls": EstimatorKind(SUMMARIES["wls"], WeightedLeastSquares),
    "huber": EstimatorKind(SUMMARIES["huber"], _robust("huber"), ("tuning",)),
    "tukey": EstimatorKind(SUMMARIES["tukey"], _robust("tukey"), ("tuning",)),
    "tls": EstimatorKind(SUMMARIES["tls"], TotalLeastSquares, ("relative_noise",)),
    "recursive": EstimatorKind(SUMMARIES["recursive"], RecursiveLeastSquares, ("memory_s",)),
    "mixing": EstimatorKind(SUMMARIES["mixing"], RegressorExtensionMixing, ("memory_s",)),
    "map": EstimatorKind(SUMMARIES["map"], _map, _PRIOR, True),
    "physical": EstimatorKind(SUMMARIES["physical"], _physical, _PRIOR, True),
    # `identify` compares this weighted estimate with that of `InstrumentalVariables`.
    "iv": EstimatorKind(SUMMARIES["iv"], WeightedLeastSquares),
}
"""The estimators by name."""
