"""Whether rigid bodies and drives exist that have the estimated base parameters.

Bodies of positive mass density have a positive semi-definite pseudo-inertia P (`ident.dynamics.parameters`), drives an
inertia of at least zero. Their base parameters K x form a convex cone. The distance of an estimate chi to it in
standard deviations is::

    d^2 = min_x (K x - chi)' C^-1 (K x - chi)   subject to  P(x) >= 0 of every body,  Ia >= 0 of every drive

with the covariance C. For the nearest point on a face of the cone with k conditions, d^2 / k of a real arm follows
Fisher's F(k, degrees of freedom of C), so a large d^2 is no chance. d is also the largest deviation from zero, over all
combinations of the parameters that no real arm has below zero.

Reference: Sousa and Cortesao, Physical feasibility of robot base inertial parameter identification, 2014; Shapiro,
Towards a unified theory of inequality constrained testing in multivariate analysis, 1988 (distances to a cone).
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fri.errors import DataError
from ident.dynamics.base_set import BaseSet
from ident.dynamics.parameters import INERTIAL, PER_LINK, Floats, from_com, from_pseudo_inertia
from ident.dynamics.physical import nearest_real, reference_bodies
from ident.dynamics.structure import ModelStructure
from ident.estimators.estimate import (
    Covariance,
    Estimate,
    chi_square_tail,
    fisher_tail,
    normal_tail,
    student_tail,
)

logger = logging.getLogger(__name__)

_LEVEL = 0.01
"""Chance of a false warning of a healthy arm, for all parameters together."""
_NAMED = 4
"""Parameters named in a sentence."""
_FAR = 3.0
"""Standard deviations from which on a parameter below zero is named, and a distance told."""
_ROUNDING = 1e-9
"""Rounding of the regrouping."""

_TOLD = 0.05
"""Least distance with a digit."""

NEAREST_REAL = (
    "for simulation and control choose the estimator `physical`, which keeps to real ones; `lwr-run export` to URDF or "
    "MJCF takes the nearest"
)
"""What to do with an estimate that is no real arm."""

Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Negative:
    """A base parameter far below zero that no real arm has below zero. p : of chance, over all parameters."""

    name: str
    value: float
    std: float
    unit: str
    p: float

    def __str__(self) -> str:
        deviations = -self.value / self.std
        size = f"{self.value:.3g} ± {self.std:.2g} {self.unit}".strip()
        far = f"{deviations:.1f} standard deviations below zero, its least value"
        return f"{self.name} {size}, {far} ({_chance(self.p)})"


@dataclass(frozen=True)
class Feasibility:
    """Distance of base parameters to those of real bodies and drives.

    distance : d, in standard deviations. conditions : k of the face. p : of chance. negative : parameters far below
    zero by themselves. moved : those that differ most at the nearest real arm, in standard deviations.
    """

    distance: float
    conditions: int
    p: float
    negative: tuple[Negative, ...] = ()
    moved: tuple[tuple[str, float], ...] = ()

    @property
    def real(self) -> bool:
        """Whether real bodies and drives have these values within the usual scatter."""
        return self.distance < _FAR and not self.negative and self.possible

    @property
    def possible(self) -> bool:
        """Whether the arm may be real all the same, by the standard deviations."""
        return min(self.p, *(one.p for one in self.negative), 1.0) >= _LEVEL

    def to_dict(self) -> dict[str, Any]:
        """Plain content for files."""
        return {
            "real": self.real,
            "possible": self.possible,
            "distance_std": self.distance,
            "conditions": self.conditions,
            "p": self.p,
            "negative": [vars(one) for one in self.negative],
            "moved_std": dict(self.moved),
            "text": str(self),
        }

    def __str__(self) -> str:
        if self.real:
            far = f" within {self.distance:.1f} standard deviations" if self.distance >= _TOLD else ""
            return f"real bodies and drives have these parameters{far}"
        parts = [str(one) for one in self.negative[:_NAMED]]
        more = len(self.negative) - _NAMED
        parts += [f"{more} more below zero"] if more > 0 else []
        if not self.negative or self.p < _LEVEL:
            moved = ", ".join(f"{name} by {shift:+.1f}" for name, shift in self.moved)
            parts.append(
                f"the nearest real ones are {self.distance:.1f} standard deviations away ({_chance(self.p)})"
                + (f", with {moved}" if moved else "")
            )
        return f"no real bodies and drives have these parameters: {'; '.join(parts)}"


def _chance(p: float) -> str:
    return f"p {p:.0e}" if p < _LEVEL else f"p {p:.2g}, so it may be chance"


def feasibility(base: BaseSet, estimate: Estimate) -> Feasibility | None:
    """Distance of an estimate of the base parameters to real bodies and drives, see the head of the module.

    None where rounding hides it.
    """
    structure = base.structure
    body = np.array([len(PER_LINK) * k + i for k in range(structure.n_links) for i in range(len(INERTIAL))])
    drive = np.array([structure.names.index(f"Ia{k + 1}") for k in range(structure.chain.n)])
    bounded = np.concatenate([body, drive])
    matrix = np.asarray(base.matrix)
    rows = np.flatnonzero(np.any(matrix[:, bounded] != 0.0, axis=1) & (estimate.std > 0.0))
    if not len(rows):
        return Feasibility(0.0, 0, 1.0)
    k, chi, std = matrix[rows], estimate.values[rows], estimate.std[rows]
    free = np.setdiff1d(np.flatnonzero(np.any(k != 0.0, axis=0)), bounded)
    covariance = estimate.covariance
    stated = covariance.matrix[np.ix_(rows, rows)]
    # The robust covariance of p parameters from few blocks is near singular in some directions: the nearest arm, and
    # with it the combination to test, comes from the well-conditioned one of uncorrelated residuals.
    few = np.isfinite(covariance.degrees_of_freedom)
    metric = estimate.covariances.get("textbook", covariance).matrix[np.ix_(rows, rows)] if few else stated
    try:
        near = nearest_real(
            k[:, body], chi, _sizes(structure), metric, nonnegative=k[:, drive], free=k[:, free]
        )
    except DataError as error:
        logger.info("feasibility unknown: %s", error)
        return None
    names, units = estimate.names, estimate.units or ("",) * len(estimate.names)
    negative = []
    for row, value, deviation, coefficients in zip(rows, chi, std, k, strict=True):
        if value >= 0.0 or not _least_is_zero(coefficients, body, drive, free):
            continue
        # Bonferroni's factor for all parameters.
        p = min(1.0, len(rows) * _below(-value / deviation, covariance))
        if -value > _FAR * deviation:
            negative.append(Negative(names[row], float(value), float(deviation), units[row], p))
    negative.sort(key=lambda one: one.value / one.std)
    gap = near.base - chi
    combination = np.linalg.solve(metric, gap)
    spread = float(combination @ stated @ combination)
    distance = float(combination @ gap / np.sqrt(spread)) if spread > 0.0 else 0.0
    order = [i for i in np.argsort(-np.abs(near.shift))[:_NAMED] if abs(near.shift[i]) >= 1.0]
    moved = tuple((names[rows[i]], float(near.shift[i])) for i in order)
    return Feasibility(
        distance, near.conditions, _beyond(distance, near.conditions, covariance), tuple(negative), moved
    )


def _sizes(structure: ModelStructure) -> Floats:
    """Bodies (k, 10) for the scale of the links: the URDF's, else 1 kg within 0.1 m."""
    chain = structure.chain
    plain = from_com(1.0, np.zeros(3), 0.01 * np.eye(3))
    bodies = np.tile(plain, (structure.n_links, 1))
    if chain.urdf is not None:
        own = chain.urdf_inertials()
        bodies[: chain.n] = np.where(own[:, 9:] > 0.0, own, plain)
    return reference_bodies(bodies)


def _least_is_zero(coefficients: Floats, body: Ints, drive: Ints, free: Ints) -> bool:
    """Whether a combination (n_columns,) of standard parameters is at least zero for every real arm."""
    if np.any(coefficients[free] != 0.0) or np.any(coefficients[drive] < 0.0):
        return False
    # The combination of a body is tr(F P): at least zero for all P >= 0 where F is so.
    for own in coefficients[body].reshape(-1, len(INERTIAL)):
        half = 0.5 * (np.ones((4, 4)) + np.eye(4))
        entries = [from_pseudo_inertia(_unit(i, j)) @ own for i in range(4) for j in range(4)]
        values = np.linalg.eigvalsh(np.array(entries).reshape(4, 4) * half)
        if values[0] < -_ROUNDING * max(values[-1], 0.0) or values[-1] < 0.0:
            return False
    return True


def _unit(i: int, j: int) -> Floats:
    unit = np.zeros((4, 4))
    unit[i, j] = unit[j, i] = 1.0
    return unit


def _below(deviations: float, covariance: Covariance) -> float:
    """Chance of a parameter so many standard deviations below its true value."""
    size, freedom = deviations / covariance.inflation, covariance.degrees_of_freedom
    return float(student_tail(size, freedom) if np.isfinite(freedom) else normal_tail(size))


def _beyond(distance: float, conditions: int, covariance: Covariance) -> float:
    """Chance of a real arm's estimate so far from a face of so many conditions (Hotelling's T^2)."""
    if conditions == 0:
        return 1.0
    square, rest = (distance / covariance.inflation) ** 2, covariance.degrees_of_freedom - conditions + 1.0
    if not np.isfinite(rest):
        return chi_square_tail(square, conditions)
    if rest <= 0.0:
        return 1.0
    return fisher_tail(square * rest / (covariance.degrees_of_freedom * conditions), conditions, rest)
