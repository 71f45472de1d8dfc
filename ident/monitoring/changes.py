"""Change points of a quantity over days.

A healthy quantity scatters from day to day beyond its standard deviations: friction follows temperature, zeros of
sensors drift. The arm's own scatter is learned from the differences of consecutive days, so a change hardly enters it,
and shrunk to a usual one, such as the median of other arms, while the days are few.

Two courses are compared with a constant one: a step, after which the quantity is another, and a drift, from a day on
proportional to time. The gain of the best over all days is judged by Student's t distribution with Bonferroni's
factor for the number of courses tried (Basseville and Nikiforov, Detection of Abrupt Changes, 1993, ch. 2; Worsley,
J. Am. Stat. Assoc. 74 (1979)). The days in question are those of 95 % of the posterior with a flat prior. After a
step both sides are searched for further ones (binary segmentation).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fri.errors import DataError
from ident.estimators.estimate import student_tail

Floats = NDArray[np.float64]
Course = Literal["step", "drift"]

# Least number of days on either side of a change: one alone may be an outlier.
_SIDE = 2
LEAST_DAYS = 2 * _SIDE + 1
"""Least number of days of which a change can be told."""
# Least number of days of a drift: fewer are a step or outliers.
_DRIFTING = 4
# Weight of the usual scatter, in days.
_USUAL_DAYS = 10.0
# Posterior probability of the interval of a change's day.
_INTERVAL = 0.95
# Least size of a value for a percentage of it, in standard deviations.
_KNOWN = 3.0
# Largest number of changes in one quantity.
_MOST = 4


@dataclass(frozen=True, eq=False)
class Series:
    """A quantity over days.

    name : such as `Fcm2`. time : (N,) rising [days]. values, std : (N,), in its unit; std 0 where unknown.
    usual : day-to-day scatter of such arms in its unit, None if unknown.
    """

    name: str
    time: Floats
    values: Floats
    std: Floats
    usual: float | None = None

    def __post_init__(self) -> None:
        if not len(self.time) == len(self.values) == len(self.std):
            raise DataError(
                f"{self.name}: {len(self.time)} days, {len(self.values)} values and {len(self.std)} standard "
                "deviations; give one of each a day"
            )
        if np.any(np.diff(self.time) <= 0.0):
            raise DataError(f"{self.name}: the days do not rise; sort them, one value a day")

    def part(self, places: slice) -> Series:
        """Some of the days."""
        return Series(self.name, self.time[places], self.values[places], self.std[places], self.usual)


@dataclass(frozen=True)
class Change:
    """A change of a quantity.

    course : step, or drift in proportion to time. time : of the first value after a step, or where a drift begins;
    earliest, latest : its 95 % interval [days]. before, after : value with standard deviation before the change, and
    after it (of a drift: on the last day). p : probability of such a gain without any change.
    """

    name: str
    course: Course
    time: float
    earliest: float
    latest: float
    before: float
    before_std: float
    after: float
    after_std: float
    p: float

    @property
    def difference(self) -> float:
        """After minus before."""
        return self.after - self.before

    @property
    def percent(self) -> float:
        """Difference, of the value before [%]; infinite where that is not distinguishable from zero."""
        known = abs(self.before) > _KNOWN * self.before_std
        return 100.0 * self.difference / abs(self.before) if known else np.inf


def day_scatter(series: Series) -> float:
    """Standard deviation from day to day beyond the stated ones, shrunk to the usual one."""
    count = len(series.values) - 1
    own = 0.0
    if count > 0:
        # The median of squares of a normal variable is 0.455 of its variance.
        variance = float(np.median(np.diff(series.values) ** 2)) / (2.0 * 0.4549)
        own = max(variance - float(np.mean(series.std**2)), 0.0)
    if series.usual is None:
        return float(np.sqrt(own))
    return float(np.sqrt((count * own + _USUAL_DAYS * series.usual**2) / (count + _USUAL_DAYS)))


def changes(series: Series, level: float = 1e-4) -> tuple[Change, ...]:
    """Changes of the series with a probability below `level` without any, in the order of their days.

    The level is that of one series; with many, divide it by their number.
    """
    good = np.isfinite(series.values) & np.isfinite(series.std)
    if not good.all():
        series = Series(series.name, series.time[good], series.values[good], series.std[good], series.usual)
    noise = np.sqrt(series.std**2 + day_scatter(series) ** 2)
    if not np.all(noise > 0.0):
        noise = np.maximum(noise, 1e-9 * max(float(np.max(np.abs(series.values), initial=0.0)), 1e-300))
    found: list[Change] = []
    open_parts = [slice(0, len(series.values))]
    while open_parts and len(found) < _MOST:
        here = open_parts.pop()
        change, place = _best(series.part(here), noise[here])
        if change is None or change.p >= level:
            continue
        found.append(change)
        if change.course == "step":
            open_parts += [slice(here.start, here.start + place), slice(here.start + place, here.stop)]
    return tuple(sorted(found, key=lambda change: change.time))


def _best(series: Series, noise: Floats) -> tuple[Change | None, int]:
    """The change with the largest gain, and the place of its first new value."""
    places = range(_SIDE, len(series.values) - _SIDE + 1)
    if len(places) < 1 or len(series.values) < 2 * _SIDE + 1:
        return None, 0
    courses: dict[Course, Callable[[int], Floats]] = {
        "step": lambda k: (np.arange(len(series.values)) >= k).astype(float),
        "drift": lambda k: np.maximum(series.time - series.time[k - 1], 0.0),
    }
    constant, _, _ = _fit(series, noise, [])
    tried = {
        (course, k): _fit(series, noise, [make(k)])
        for course, make in courses.items()
        for k in places
        if course == "step" or len(noise) - k >= _DRIFTING
    }
    course, k = min(tried, key=lambda key: tried[key][0])
    left, values, covariance = tried[course, k]
    freedom = len(series.values) - 2 + (0.0 if series.usual is None else _USUAL_DAYS)
    scale = max(left / (len(series.values) - 2), 1.0)
    t = float(np.sqrt(max(constant - left, 0.0) / scale))
    p = min(1.0, 2.0 * len(tried) * float(student_tail(t, freedom)))
    alike = np.array([other for kind, other in tried if kind == course])
    excess = np.array([tried[course, int(other)][0] for other in alike]) - left
    weight = np.exp(-0.5 * excess / scale)
    days = _interval(alike, weight / weight.sum())
    # A drift begins on the day before its first new value.
    first = 1 if course == "drift" else 0
    column = courses[course](k)
    end = np.array([1.0, column[-1]])
    return (
        Change(
            series.name,
            course,
            float(series.time[k - first]),
            float(series.time[days[0] - first]),
            float(series.time[days[-1] - first]),
            float(values[0]),
            float(np.sqrt(scale * covariance[0, 0])),
            float(end @ values),
            float(np.sqrt(scale * end @ covariance @ end)),
            p,
        ),
        k,
    )


def _fit(series: Series, noise: Floats, columns: Sequence[Floats]) -> tuple[float, Floats, Floats]:
    """Chi-square, values and covariance of a constant with further columns."""
    matrix = np.stack([np.ones(len(noise)), *columns], axis=1) / noise[:, None]
    inverse = np.asarray(np.linalg.pinv(matrix.T @ matrix), dtype=np.float64)
    values = inverse @ (matrix.T @ (series.values / noise))
    left = series.values / noise - matrix @ values
    return float(left @ left), values, inverse


def _interval(places: NDArray[np.int64], weight: Floats) -> NDArray[np.int64]:
    """The places that hold most of the weight, from first to last."""
    order = np.argsort(-weight)
    count = int(np.searchsorted(np.cumsum(weight[order]), _INTERVAL)) + 1
    return np.sort(places[order[:count]])
