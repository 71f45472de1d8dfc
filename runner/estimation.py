"""From what a person types to the settings of an identification."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, cast

from fri.errors import ConfigurationError
from ident.dynamics.base_set import BaseSet
from ident.dynamics.structure import Coulomb, Coupling
from ident.estimation.identify import EstimatorFactory
from ident.estimators import (
    CovarianceSettings,
    Estimator,
    MaximumAPosteriori,
    PhysicallyConsistent,
    Problem,
    RecursiveLeastSquares,
    RegressorExtensionMixing,
    RobustLeastSquares,
    TotalLeastSquares,
)
from ident.estimators.physical import cad_prior
from lwr_driver.session import Session

__all__ = ["EstimatorChoice", "announced", "coulomb", "couplings"]

# Which settings which estimators take.
_TAKEN = {
    "tuning": ("huber", "tukey"),
    "memory_s": ("recursive", "mixing"),
    "relative_noise": ("tls",),
    "prior_strength": ("map", "physical"),
    "prior_metric": ("map", "physical"),
    "prior_std": ("map", "physical"),
}


@dataclass(frozen=True)
class EstimatorChoice:
    """An estimator by name with the settings that it takes; None leaves its default.

    tuning : of the loss, in standard deviations. memory_s : time over which the past is forgotten [s].
    relative_noise : of the columns. prior_strength, prior_metric : see the estimators. prior_std : standard
    deviation of the URDF's inertials as a share of themselves
    """

    name: str
    tuning: float | None = None
    memory_s: float | None = None
    relative_noise: float | None = None
    prior_strength: float | str | None = None
    prior_metric: str | None = None
    prior_std: float | None = None

    def __post_init__(self) -> None:
        for name, takers in _TAKEN.items():
            if getattr(self, name) is not None and self.name not in takers:
                option = f"--{name.replace('_', '-')}"
                raise ConfigurationError(f"{option} is for {' and '.join(takers)}, not for {self.name}")

    def build(self) -> str | EstimatorFactory:
        """The name where nothing is set, else what makes the estimator for a base set and a problem."""
        given = {
            field.name: getattr(self, field.name)
            for field in dataclasses.fields(self)
            if field.name != "name" and getattr(self, field.name) is not None
        }
        if not given:
            return self.name
        make = _MAKERS[self.name]

        def factory(base: BaseSet, problem: Problem, covariance: CovarianceSettings) -> Estimator:
            return make(base, covariance, **given)

        return factory


def _robust(loss: str) -> Callable[..., Estimator]:
    def make(base: BaseSet, covariance: CovarianceSettings, tuning: float) -> Estimator:
        return RobustLeastSquares(cast(Any, loss), tuning=tuning, covariance=covariance)

    return make


def _total(base: BaseSet, covariance: CovarianceSettings, relative_noise: float) -> Estimator:
    return TotalLeastSquares(relative_noise, covariance=covariance)


def _recursive(base: BaseSet, covariance: CovarianceSettings, memory_s: float) -> Estimator:
    return RecursiveLeastSquares(memory_s, covariance=covariance)


def _mixing(base: BaseSet, covariance: CovarianceSettings, memory_s: float) -> Estimator:
    return RegressorExtensionMixing(memory_s, covariance=covariance)


def _map(
    base: BaseSet,
    covariance: CovarianceSettings,
    prior_strength: Any = 1.0,
    prior_metric: Any = "pullback",
    prior_std: float = 0.2,
) -> Estimator:
    prior = cad_prior(base, relative_std=prior_std).prior(prior_metric)
    return MaximumAPosteriori(prior, prior_strength, covariance)


def _physical(
    base: BaseSet,
    covariance: CovarianceSettings,
    prior_strength: Any = 1.0,
    prior_metric: Any = "pullback",
    prior_std: float = 0.2,
) -> Estimator:
    prior = cad_prior(base, relative_std=prior_std)
    return PhysicallyConsistent(prior, prior_metric, prior_strength, covariance=covariance)


_MAKERS: dict[str, Callable[..., Estimator]] = {
    "huber": _robust("huber"),
    "tukey": _robust("tukey"),
    "tls": _total,
    "recursive": _recursive,
    "mixing": _mixing,
    "map": _map,
    "physical": _physical,
}


def coulomb(text: str) -> Coulomb:
    """`sign`, `deadband:0.01` or `tanh:0.01` (width in rad/s)."""
    kind, _, width = text.partition(":")
    try:
        return Coulomb(cast(Any, kind), float(width) if width else 0.0)
    except ValueError as error:
        raise ConfigurationError(f"--coulomb {text!r}: {error}") from error


def couplings(texts: Sequence[str]) -> tuple[Coupling, ...]:
    """Each `A5:A6`: two joints whose drives are coupled."""
    found = []
    for text in texts:
        first, mark, second = text.partition(":")
        if not mark or not first or not second or first == second:
            raise ConfigurationError(f"--coupling {text!r} does not name two joints, such as A5:A6")
        found.append(Coupling((first, second)))
    return tuple(found)


def announced(sessions: Sequence[Session], payloads: Sequence[str]) -> list[Session]:
    """The sessions with the payloads that `FILE=NAME[:KG]` say in place of those in their metadata."""
    corrected = list(sessions)
    known = ", ".join(session.path.name for session in sessions)
    for text in payloads:
        file, mark, payload = text.rpartition("=")
        name, _, mass = payload.partition(":")
        places = [k for k, session in enumerate(sessions) if file in (str(session.path), session.path.name)]
        if not mark or not name or len(places) != 1:
            raise ConfigurationError(
                f"--payload {text!r}: write FILE=NAME or FILE=NAME:KG with one of the files {known}"
            )
        session = corrected[places[0]]
        metadata = {key: value for key, value in session.metadata.items() if key != "payload_mass"}
        metadata |= {"payload": name} | ({"payload_mass": str(_mass(text, mass))} if mass else {})
        corrected[places[0]] = dataclasses.replace(session, metadata=metadata)
    return corrected


def _mass(option: str, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise ConfigurationError(f"--payload {option!r}: {text!r} is no mass in kg") from None
