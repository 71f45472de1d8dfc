"""The arm identified by the estimator that predicts best (`ident.estimation.estimator_comparison`).

An arm with gains of its sensors is identified from the torques divided by them, and its model states them as effects.
So it does with friction of the drives that turns over a path after a reversal (`ident.estimation.turning`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ident.dynamics.base_set import BaseSet
from ident.dynamics.kinematics import Chain
from ident.dynamics.parameters import Floats
from ident.effects import SENSOR_GAIN, entry_of
from ident.estimation.choice import Choice
from ident.estimation.estimator_comparison import LOOSEST, PLAIN, compared
from ident.estimation.identification import EstimatorFactory, Identification, IdentificationSettings, Known
from ident.estimation.identify import estimator_factory, identify, observed
from ident.estimation.mounting import find_mounting
from ident.estimation.turning import friction_turning
from ident.estimators.covariance import CovarianceSettings
from ident.estimators.estimate import Estimate, Estimator
from ident.estimators.physical import lacking_bodies
from ident.estimators.problem import Nuisance, Problem
from ident.rows.content import Recall
from ident.rows.sessions import require
from lwr_driver.session import Session, Sessions, as_sessions


def choose(
    sessions: Sessions,
    chain: Chain,
    settings: IdentificationSettings | None = None,
    *,
    tilt: bool | None = None,
    known: Known | None = None,
    like: Choice | None = None,
    recall: Recall | None = None,
) -> Identification:
    """The arm identified by the candidate with the least held-back error; arguments as for `identify`.

    tilt : True scores the leaning base only, False the upright one, None both. like : an earlier choice for such
    sessions, taken instead of a comparison.

    The result's `choice` says what was compared. Raises the errors of `identify`.
    """
    settings = settings or IdentificationSettings()
    sessions = as_sessions(sessions)
    require(chain, Chain, "chain", "read one with `Chain.from_urdf`")
    prior = settings.model != 3 and not lacking_bodies(chain)
    plain = replace(settings, estimator="map" if prior else "wls", essential=None)
    rows = observed(sessions, chain, plain, known=known, recall=recall)
    # With a prior the covariance is the posterior's, whatever the settings.
    first = rows.identified(replace(rows.settings, covariance=PLAIN) if prior else rows.settings)
    choice = compared(first, sessions, tilt=tilt, recall=rows.recall) if like is None else _again(like)
    winner = choice.winner
    options: dict[str, Any] = {"prior_strength": winner.prior_scale} if winner.estimator == "physical" else {}
    settled = replace(
        first.settings,
        estimator=settings.estimator,
        essential=settings.essential,
        covariance=settings.covariance,
    )
    factory = estimator_factory(winner.estimator, **options)
    final = replace(settled, estimator=_beside_gains(factory, choice) if choice.gains else factory)
    sessions = [_calibrated(session, choice.gains) for session in sessions]
    if winner.tilt:
        # The prior as stated, however loose the winner's: bodies free of it absorb a part of the tilt. Placeholder
        # masses know nothing of it.
        strength = LOOSEST if choice.urdf_doubt else 1.0
        mounting = find_mounting(sessions, chain, final, prior_strength=strength, known=first.known)
        found, choice = mounting.identification, replace(choice, mounting=mounting)
    elif choice.gains:
        found = identify(sessions, chain, final, known=first.known)
    else:
        found = rows.identified(final)
    effects: tuple[Mapping[str, Any], ...] = tuple(
        entry_of(SENSOR_GAIN, [chain.joint_names.index(joint) + 1], {"error": gain})
        for joint, gain in choice.gains.items()
    )
    turning = friction_turning(found.model, rows.sessions, recall=rows.recall)
    if turning is not None:
        choice, effects = replace(choice, turning=turning), (*effects, *turning.entries)
    apart = choice.disagreement
    contradiction = str(apart) if apart is not None and apart.strong else choice.contradiction
    warnings = (*found.warnings, *filter(None, [contradiction]))
    return replace(found, settings=settled, choice=choice, effects=effects, warnings=warnings)


def _again(choice: Choice) -> Choice:
    """A choice for other sessions, without what was estimated from the first ones."""
    return replace(choice, mounting=None, turning=None)


def _beside_gains(factory: EstimatorFactory, choice: Choice) -> EstimatorFactory:
    """The estimator with the uncertainty of the sensors' gains in its covariance."""

    def made(base: BaseSet, problem: Problem, covariance: CovarianceSettings) -> Estimator:
        return BesideGains(factory(base, problem, covariance), choice.gains, choice.gains_covariance)

    return made


@dataclass(frozen=True)
class BesideGains:
    """An estimator of calibrated torques. gains : as of `Choice`. covariance : (k, k) of their errors."""

    estimator: Estimator
    gains: Mapping[str, tuple[float, float]]
    covariance: Floats

    @property
    def needs_rank(self) -> bool:
        """Whether the rows have to determine all parameters."""
        return bool(getattr(self.estimator, "needs_rank", True))

    def fit(self, problem: Problem) -> Estimate:
        """Estimate the parameters of the problem."""
        # Independent combinations of the gains: their common part, which the bodies take up, is known least.
        power, vectors = np.linalg.eigh(self.covariance)
        further = []
        for k, (variance, vector) in enumerate(zip(power, vectors.T, strict=True)):
            share = dict(zip(self.gains, vector.tolist(), strict=True))
            columns = {
                number: -share[group.joint] / (1.0 + self.gains[group.joint][0]) * group.target
                for number, group in enumerate(problem.groups)
                if group.side == "joint" and group.joint in share
            }
            further.append(Nuisance(f"sensor gains {k + 1}", float(np.sqrt(max(variance, 0.0))), columns))
        return self.estimator.fit(replace(problem, nuisances=(*problem.nuisances, *further)))


def _calibrated(session: Session, gains: Mapping[str, tuple[float, float]]) -> Session:
    """The session with the joint torques that sensors without these errors of scale would have read."""
    scale = [1.0 + gains[name][0] if name in gains else 1.0 for name in session.joint.names]
    if not gains or not session.joint.effort.shape[1]:
        return session
    return replace(session, joint=replace(session.joint, effort=session.joint.effort / np.array(scale)))
