"""The size of each candidate on the healthy arm: its mean over the healthy sets, and how much a set differs from it.

A base model is never quite the arm. What it lacks has the same size on each day, and a gain of its own: no change, and
no measure of changes. So a candidate is also held against its mean size, by the scatter around it alone. Where the
motions of the healthy sets show little of it they have hardly a gain, but their size may be that of the present
sessions all the same.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np

from fri.errors import ConfigurationError
from ident.diagnosis.causes.candidates import Dictionary
from ident.diagnosis.gain.products import Floats
from ident.diagnosis.gain.score import Score
from ident.diagnosis.gain.size import Size
from ident.effects import find_effect
from ident.estimators.estimate import fisher_limit

# Least square of a size over its variance, for each of its coefficients, for one other than zero.
_THERE = 9.0
# Largest change of a size from day to day as a share of it: three standard deviations of friction's.
_LARGEST_SHARE = 0.3
# The same in standard deviations.
_LARGEST = 3.0

LEAST_SETS = 2
"""Least number of sets for a limit."""

_Any = TypeVar("_Any")
Key = tuple[str, int]
"""Cause, and joint from 0."""
Table = Mapping[Key, Mapping[str, Score]]
"""Scores of the candidates in a set by the shapes of their grid."""


@dataclass(frozen=True, eq=False)
class KnownSize:
    """A size other than zero in the healthy sets. mean : (k,) coefficients. covariance : (k, k) of the size on a
    further day, but for the error of that day's own estimate.
    """

    mean: Floats
    covariance: Floats

    @classmethod
    def of(cls, scores: Sequence[Score], usual: float) -> KnownSize | None:
        """From the scores of a shape in the sets; None for a size that may be zero. usual : as of `Size.of`."""
        size = Size.of([one.coefficients for one in scores], [one.covariance for one in scores], usual)
        k = len(size.mean)
        covariance = size.covariance + np.eye(k) * size.from_set_to_set**2 / k
        square = float(size.mean @ np.linalg.pinv(covariance) @ size.mean)
        return cls(size.mean, covariance) if square > _THERE * k else None

    def stored(self) -> dict[str, Any]:
        """Plain content."""
        return {"mean": _rounded(self.mean), "covariance": [_rounded(row) for row in self.covariance]}

    @classmethod
    def read(cls, content: Mapping[str, Any]) -> KnownSize:
        """From plain content."""
        mean, covariance = _coefficients(content["mean"]), np.array(content["covariance"], dtype=np.float64)
        if covariance.shape != (len(mean), len(mean)):
            raise ConfigurationError(
                f"covariance of shape {covariance.shape} for {len(mean)} coefficients; commission the arm again"
            )
        return cls(mean, covariance)

    def holds(self, score: Score) -> bool:
        """Whether the coefficients of a score are this size, within all uncertainties and the usual changes."""
        if score.coefficients.shape != self.mean.shape:
            return False
        share = _LARGEST_SHARE / _LARGEST
        covariance = self.covariance + score.covariance + share**2 * np.outer(self.mean, self.mean)
        away = score.coefficients - self.mean
        return float(away @ np.linalg.pinv(covariance) @ away) <= _LARGEST**2 * len(away)


@dataclass(frozen=True, eq=False)
class UsualSize:
    """A candidate on the healthy arm.

    shape : of its grid, as text. mean : (k,) coefficients. scatter : gain of a set's difference from the mean size,
    its unbiased mean square. known : sizes clearly other than zero, by shape of the grid.
    """

    shape: str
    mean: Floats
    scatter: float
    known: Mapping[str, KnownSize] = field(default_factory=dict)

    def stored(self) -> dict[str, Any]:
        """Plain content."""
        known = {shape: one.stored() for shape, one in self.known.items()}
        content = {"shape": self.shape, "mean": _rounded(self.mean), "scatter": round(float(self.scatter), 2)}
        return content | ({"known": known} if known else {})

    @classmethod
    def read(cls, content: Mapping[str, Any]) -> UsualSize:
        """From plain content."""
        known = {shape: KnownSize.read(one) for shape, one in content.get("known", {}).items()}
        return cls(str(content["shape"]), _coefficients(content["mean"]), float(content["scatter"]), known)

    def change(self, score: Score) -> float:
        """Gain of a score's difference from the mean size, in its shape."""
        return self._gain(score, score.coefficients - self.mean) if self._alike(score) else score.gain

    def beyond(self, score: Score) -> float:
        """The same beyond the usual changes of a size: 0 for less of it than usual, which is no cause of its own."""
        if not self._alike(score):
            return score.gain
        away = score.coefficients - self.mean
        if float(score.coefficients @ np.linalg.pinv(score.covariance) @ away) <= 0.0:
            return 0.0
        change, usual = self._gain(score, away), (_LARGEST_SHARE**2) * self._gain(score, self.mean)
        return change if change > usual else 0.0

    def clear(self, score: Score, scatter: float) -> bool:
        """Whether the mean size would show in the rows of a score, beyond the scatter of the sets [gain] there."""
        return self._alike(score) and self._gain(score, self.mean) > _THERE * max(scatter, 1.0)

    def _alike(self, score: Score) -> bool:
        return score.coefficients.shape == self.mean.shape

    def _gain(self, score: Score, size: Floats) -> float:
        """Gain of coefficients (k,) in the shape of a score."""
        inverse, own = np.linalg.pinv(score.covariance), score.coefficients
        square = float(own @ inverse @ own)
        # The covariance from blocks and cross-validation differ by a factor, unknown for what is hardly there.
        factor = max(score.gain, 0.0) / square if square > _THERE else 1.0
        return factor * float(size @ inverse @ size)


@dataclass(frozen=True)
class OfDays:
    """Gain of a cause that follows from one state of a day in all joints. mean : over the healthy sets, beyond noise.
    by_joints : upper limit in a further set where each joint's gain is an observation of its own, so in a state as on
    the days of the sets. by_days : the same from the few days alone, in any state."""

    mean: float
    by_joints: float
    by_days: float


@dataclass(frozen=True, eq=False)
class Healthy:
    """What healthy sets say of the candidates. limits : upper limit of the gain in a healthy set. shown : mean
    information, by shape of the grid. sizes : usual size, and the upper limit of the gain of a difference from it.
    days : of what may follow from the state of a day."""

    limits: Mapping[Key, float] = field(default_factory=dict)
    shown: Mapping[Key, Mapping[str, float]] = field(default_factory=dict)
    sizes: Mapping[Key, tuple[UsualSize, float]] = field(default_factory=dict)
    days: Mapping[Key, OfDays] = field(default_factory=dict)

    def without(self, causes: Collection[str]) -> Healthy:
        """The same, saying nothing of these causes."""

        def others(table: Mapping[Key, _Any]) -> dict[Key, _Any]:
            return {key: value for key, value in table.items() if key[0] not in causes}

        return Healthy(others(self.limits), others(self.shown), others(self.sizes), others(self.days))


def scores(dictionary: Dictionary) -> Table:
    """Scores of all candidates with a size of their own, beside the present columns of the evidence."""
    return {
        candidate.key: {shape: _settled(score) for shape, score in dictionary.scores(candidate).items()}
        for candidate in dictionary.candidates
    }


def _settled(score: Score) -> Score:
    """The score with its covariance, without the products that it is made of."""
    covariance, blocks = score.uncertainty
    return replace(score, robust=lambda: (covariance, blocks))


def usual_sizes(sets: Sequence[Table]) -> dict[Key, UsualSize]:
    """The usual size of each candidate in several sets, empty for one set: in the shape of most gain, with the rest of
    each set's gain, of another shape, as a difference."""
    found: dict[Key, UsualSize] = {}
    for key in sets[0] if len(sets) > 1 else ():
        tables = [table.get(key, {}) for table in sets]
        shapes = [shape for shape in tables[0] if all(shape in table for table in tables)]
        if not shapes:
            continue
        best = max(shapes, key=lambda shape: sum(max(table[shape].gain, 0.0) for table in tables))
        mean = np.mean([table[best].coefficients for table in tables], axis=0)
        size = UsualSize(best, mean, 0.0)
        total = 0.0
        for table in tables:
            here = table[best]
            largest = max(max(score.gain, 0.0) for score in table.values())
            total += max(largest - max(here.gain, 0.0) + size.change(here), 0.0)
        usual = find_effect(key[0]).usual_change
        known = {shape: KnownSize.of([table[shape] for table in tables], usual) for shape in shapes}
        found[key] = UsualSize(
            best,
            mean,
            total / (len(sets) - 1),
            {shape: one for shape, one in known.items() if one is not None},
        )
    return found


def _rounded(values: Floats) -> list[float]:
    return [float(f"{value:.6g}") for value in values]


def _coefficients(content: Any) -> Floats:
    values = np.array(content, dtype=np.float64)
    if values.ndim != 1 or not len(values):
        raise ConfigurationError(f"mean size {content!r:.40}: give a list of numbers")
    return values


def independent(key: Key, own: float, with_joints: float) -> float:
    """Number of independent sets behind a mean: with those that the other joints count for, unless all joints of an
    arm have the cause from one state of a day; two at least, since a limit from one is none."""
    return max(own, LEAST_SETS) if find_effect(key[0]).together else with_joints


def scatter_limits(
    sizes: Mapping[Key, UsualSize], sets: int, one_in: float, as_changes: float
) -> dict[Key, float]:
    """Upper limit of the gain of a further set's difference from the mean size, exceeded by one healthy set in
    1 / `one_in`; the mean of a cause over the joints counts as further changes."""
    if not sizes:
        return {}
    by_cause: dict[str, list[float]] = {}
    for (cause, _), size in sizes.items():
        by_cause.setdefault(cause, []).append(size.scatter)
    noise = float(np.median([size.scatter for size in sizes.values()]))
    changes = sets - 1 + as_changes
    found = {}
    for key, size in sizes.items():
        mean = ((sets - 1) * size.scatter + as_changes * float(np.mean(by_cause[key[0]]))) / changes
        factor = fisher_limit(one_in, 1, independent(key, sets - 1, changes)) * (1.0 - sets**-2.0)
        found[key] = noise + factor * max(mean - noise, 0.0)
    return found
