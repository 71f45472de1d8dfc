"""Tilt of the base: the direction of gravity in the base's own axes, from the sessions of the identification.

Under a tilt t gravity acts on the first joint with about t times the moment of the whole arm: half a newton
metre per degree on an LWR4+. It varies with the position of the first joint, unlike the torque of any link
parameter, so the two angles can be estimated together with the base parameters. Gravity enters the torque
linearly, tau(q, qd, qdd; g + dg) = tau(q, qd, qdd; g) + G(q; dg), so d tau / d t_k = G(q; dg / dt_k), with
G the regressor at rest under the gravity dg / dt_k. A few Gauss-Newton steps suffice.

Similar causes are crosstalk from joint 2 to the torque sensor of joint 1 and a cable across joint 1. A spirit
level on the base decides.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fri.errors import ConfigurationError
from ident.dynamics.kinematics import Chain
from ident.dynamics.parameters import INERTIAL, Floats
from ident.dynamics.regressor import torque
from ident.dynamics.structure import ModelStructure, Side
from ident.effects.link import sideways_gravity
from ident.estimation.identification import Identification, IdentificationSettings, Known
from ident.estimation.identify import estimator_factory, identify
from ident.estimators.covariance import CovarianceSettings
from ident.estimators.estimate import Covariance, fisher_tail
from ident.estimators.physical import cad_prior, lacking_bodies
from ident.estimators.prior import MaximumAPosteriori, Prior
from ident.rows.content import Recall
from ident.rows.observation import observe
from ident.rows.prepare import prepare
from ident.rows.prepared import PreparedSession, TorqueChannel
from ident.rows.sessions import require
from ident.screening.screen import without_dead
from lwr_driver.session import Session, Sessions, as_sessions

# Standard deviation of the tilt before the data. It hardly matters beside a tenth of a degree from the data, and keeps
# an unexcited angle at zero.
_PRIOR_STD_RAD = float(np.deg2rad(2.0))
# A few steps suffice, see above; a search that needs more of them has not converged.
_MOST_STEPS = 6


@dataclass(frozen=True)
class Mounting:
    """Estimated direction of gravity in the base's axes.

    axes : (2, 3), unit vectors in the base's axes, perpendicular to the assumed gravity.
    tilt_rad : (2,), rotation of the base about them; its norm is the tilt.
    covariance : (2, 2) [rad^2]. assumed, gravity : (3,) before and after, in the base's axes [m/s^2].
    identification : the arm identified under the estimated gravity, with it in the chain.
    steps : number of Gauss-Newton steps. converged : the last was below a tenth of a standard deviation.
    """

    axes: Floats
    tilt_rad: Floats
    covariance: Covariance
    assumed: Floats
    gravity: Floats
    identification: Identification
    steps: int
    converged: bool

    @property
    def chain(self) -> Chain:
        """The arm under the estimated gravity."""
        return self.identification.structure.chain

    @property
    def std(self) -> Floats:
        """Standard deviations of the two angles (2,) [rad]."""
        return self.covariance.std

    @property
    def p_value(self) -> float:
        """Probability of so large a tilt on an upright base (Hotelling's T^2)."""
        square = float(self.tilt_rad @ np.linalg.solve(self.covariance.matrix, self.tilt_rad))
        freedom = max(self.covariance.degrees_of_freedom, 2.0)
        return fisher_tail(square * (freedom - 1.0) / (2.0 * freedom), 2, freedom - 1.0)

    def to_dict(self) -> dict[str, Any]:
        """Plain content for JSON."""
        return {
            "axes": self.axes.tolist(),
            "tilt_rad": self.tilt_rad.tolist(),
            "std_rad": self.std.tolist(),
            "p_value": self.p_value,
            "assumed_gravity": self.assumed.tolist(),
            "gravity": self.gravity.tolist(),
            "steps": self.steps,
            "converged": self.converged,
        }

    def __repr__(self) -> str:
        return f"Mounting: {self}"

    def __str__(self) -> str:
        degrees, std = np.rad2deg(self.tilt_rad), np.rad2deg(self.std)
        parts = [
            f"{angle:.2f} ± {s:.2f} deg about [{', '.join(f'{round(float(x), 3) + 0.0:g}' for x in axis)}]"
            for angle, s, axis in zip(degrees, std, self.axes, strict=True)
        ]
        size = float(np.linalg.norm(degrees))
        return f"the base leans by {size:.2f} deg: {', '.join(parts)} (p = {self.p_value:.1e})" + (
            "" if self.converged else "; NOT converged"
        )


def find_mounting(
    sessions: Sessions,
    chain: Chain,
    settings: IdentificationSettings | None = None,
    *,
    prior_strength: float = 1.0,
    known: Known | None = None,
) -> Mounting:
    """Tilt of the base of `chain` from the sessions, and the arm identified under it.

    sessions, settings, known : as for `identify`. The steps are maximum a posteriori with the inertials of the URDF as
        prior (`cad_prior`; weighted least squares without one), so that weakly excited parameters do not
        absorb the tilt.
    prior_strength : factor on the variance of that prior.

    The standard deviations are the larger of the block jackknife's and the posterior's; those of the arm's
    parameters do not include the tilt's.

    Raises ConfigurationError for Model 3 (no gravity), and the errors of `identify`.
    """
    settings = settings or IdentificationSettings()
    require(chain, Chain, "chain", "read one with `Chain.from_urdf`")
    sessions = as_sessions(sessions)
    if settings.model == 3:
        raise ConfigurationError("Model 3 has no gravity in it; find the mounting with Model 1 or 2")
    if not np.any(chain.gravity):
        raise ConfigurationError("the chain has no gravity, so its base cannot lean; give `gravity`")
    axes = _axes(chain.gravity)
    tilt = np.zeros(2)
    # The steps need plausible values of all parameters, with any final estimator.
    estimator = "wls" if lacking_bodies(chain) else estimator_factory("map", prior_strength=prior_strength)
    inner = replace(settings, essential=None, estimator=estimator)
    found = identify(sessions, chain, inner, known=known)
    settings = replace(found.settings, essential=settings.essential, estimator=settings.estimator)
    inner = found.settings
    done, converged = 0, False
    covariance = None
    while done < _MOST_STEPS and not converged:
        done += 1
        prior = _prior(found, tilt, prior_strength)
        step, covariance = _step(found, sessions, axes, prior)
        tilt = tilt + step
        turned = replace(chain, gravity=_turned(chain.gravity, axes, tilt))
        found = identify(sessions, turned, inner, known=found.known)
        converged = bool(np.all(np.abs(step) < 0.1 * covariance.std))
    assert covariance is not None
    found = identify(sessions, found.structure.chain, settings, known=found.known)
    gravity = found.structure.chain.gravity
    return Mounting(axes, tilt, covariance, chain.gravity, gravity, found, done, converged)


def _axes(gravity: Floats) -> Floats:
    """Two axes perpendicular to gravity, for gravity along -z those of x and y."""
    up = -gravity / np.linalg.norm(gravity)
    first = np.eye(3)[int(np.argmin(np.abs(up)))]
    first = first - (first @ up) * up
    first /= np.linalg.norm(first)
    return np.vstack([first, np.cross(up, first)]) + 0.0


def _turned(gravity: Floats, axes: Floats, tilt: Floats) -> Floats:
    """Gravity in the axes of a base rotated by `tilt` about `axes` (Rodrigues, inverse rotation)."""
    vector = -(tilt @ axes)
    angle = float(np.linalg.norm(vector))
    if angle == 0.0:
        return gravity.copy()
    axis = vector / angle
    return (
        gravity * np.cos(angle)
        + np.cross(axis, gravity) * np.sin(angle)
        + axis * (axis @ gravity) * (1.0 - np.cos(angle))
    )


def _step(
    found: Identification, sessions: Sequence[Session], axes: Floats, prior: Prior
) -> tuple[Floats, Covariance]:
    """One Gauss-Newton step (2,) with all base parameters free, and the covariance of the tilt."""
    gravity = found.structure.chain.gravity
    columns = _columns(found, sessions, list(sideways_gravity(gravity, axes)))
    problem = found.problem.with_columns(("tilt_1", "tilt_2"), columns, "rad")
    estimate = MaximumAPosteriori(prior, 1.0, CovarianceSettings(kind="jackknife")).fit(problem)
    posterior, jackknife = (estimate.covariances[kind] for kind in ("posterior", "jackknife"))
    std = np.maximum(posterior.std, jackknife.std)[-2:]
    correlation = posterior.matrix[-2:, -2:] / np.outer(posterior.std[-2:], posterior.std[-2:])
    stated = replace(jackknife, matrix=correlation * np.outer(std, std))
    return estimate.values[-2:], stated


def tilt_columns(
    found: Identification, sessions: Sequence[Session], recall: Recall | None = None
) -> list[Floats]:
    """d(torque) / d(tilt) (m, 2) [Nm/rad] of each row group, with the estimated parameters. recall : see `prepare`."""
    gravity = found.structure.chain.gravity
    return _columns(found, sessions, list(sideways_gravity(gravity, _axes(gravity))), recall)


def _columns(
    found: Identification,
    sessions: Sequence[Session],
    directions: Sequence[Floats],
    recall: Recall | None = None,
) -> list[Floats]:
    """Torque (m, 2) of each row group at rest under each gravity, the change of torque for one of gravity."""
    structure, settings = found.structure, found.settings
    chains = tuple(replace(structure.chain, gravity=direction) for direction in directions)
    leaning = _Leaning(structure, chains, found.base.columns, found.estimate.values)
    result = []
    for session, payload, known in zip(sessions, found.payloads, found.prepared, strict=True):
        chosen = session.select(structure.chain.joint_names)
        moving = prepare(
            chosen,
            known.signals,
            resonance_hz=settings.resonance_hz,
            motor=settings.model == 2,
            log=False,
            blocks=True,
            recall=recall,
        )
        still = _at_rest(moving)
        rows = without_dead(observe([still], [payload], leaning), chosen)
        result += [group.matrix for group in rows.groups]
    return result


@dataclass(frozen=True)
class _Leaning:
    """The torque of an arm at rest, with known parameters, under several gravities: a column each of a regressor.

    chains : the arm under each gravity. columns, values : (p,), of the structure, and their parameters.
    """

    structure: ModelStructure
    chains: tuple[Chain, ...]
    columns: NDArray[np.int64]
    values: Floats

    @property
    def chain(self) -> Chain:
        """The arm."""
        return self.structure.chain

    @property
    def sides(self) -> tuple[Side, ...]:
        """Sides of the rows."""
        return self.structure.sides

    @property
    def names(self) -> tuple[str, ...]:
        """One a gravity."""
        return tuple(f"tilt_{k + 1}" for k in range(len(self.chains)))

    @property
    def active(self) -> NDArray[np.bool_]:
        """All of them."""
        return np.ones(len(self.chains), dtype=bool)

    @cached_property
    def _bodies(self) -> dict[str | None, Floats]:
        """Inertial parameters (n, 10) by payload."""
        found = {
            payload: np.zeros((self.chain.n, len(INERTIAL))) for payload in (None, *self.structure.payloads)
        }
        for payload, bodies in found.items():
            for column, value in zip(self.columns.tolist(), self.values, strict=True):
                if (place := self.structure.rigid_of(column, payload)) is not None:
                    bodies[place] += value
        return found

    def regressor(
        self, q: Floats, qd: Floats, qdd: Floats, *, payload: str | None, sides: Sequence[Side], **rest: Any
    ) -> Floats:
        """(sides x n x N, gravities): as `ModelStructure.regressor`, at rest."""
        bodies = self._bodies[payload]
        still = np.zeros_like(q)
        torques = [torque(chain, q, still, still, bodies).T for chain in self.chains]
        return np.array([[own] * len(sides) for own in torques]).reshape(len(torques), -1).T


def _at_rest(session: PreparedSession) -> PreparedSession:
    def still(channel: TorqueChannel) -> TorqueChannel:
        zero = np.zeros_like(channel.qd)
        return replace(channel, qd=zero, qdd=zero)

    passages = tuple(
        replace(p, joint=still(p.joint), motor=None if p.motor is None else still(p.motor))
        for p in session.passages
    )
    return replace(session, passages=passages)


def _prior(found: Identification, tilt: Floats, strength: float) -> Prior:
    """The arm's prior, `strength` times its variance, with the tilt's: zero for the whole tilt, earlier steps
    included."""
    p = len(found.base.names)
    mean, precision = np.zeros(p + 2), np.zeros((p + 2, p + 2))
    if not lacking_bodies(found.structure.chain):
        arm = cad_prior(found.base).prior("pullback")
        mean[:p], precision[:p, :p] = arm.mean, arm.precision / strength
    mean[p:] = -tilt
    precision[p, p] = precision[p + 1, p + 1] = _PRIOR_STD_RAD**-2
    return Prior(mean, precision)
