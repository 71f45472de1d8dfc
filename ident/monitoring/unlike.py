"""Arms unlike the others of their kind."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ident.estimators.estimate import student_tail

# Least number of arms: their spread is unknown with fewer.
_LEAST = 5
# Median of the magnitude of a normal variable.
_MEDIAN = 0.6745


@dataclass(frozen=True)
class Unlike:
    """A quantity of an arm beyond the spread of the arms.

    value, std : of the arm; median, spread : of all arms. p : probability of such a distance of any arm in any
    quantity by chance.
    """

    arm: str
    name: str
    value: float
    std: float
    median: float
    spread: float
    p: float


def unlike(
    quantities: Mapping[str, Mapping[str, tuple[float, float]]], level: float = 0.01
) -> tuple[Unlike, ...]:
    """Quantities of arms beyond the spread of all arms, the strangest first.

    quantities : value and standard deviation by name of the quantity and name of the arm. level : probability of any
    arm among like ones. Needs five arms with a quantity; the spread comes from the median of the distances from the
    median, so a few strange arms hardly enter it.
    """
    known = {name: arms for name, arms in quantities.items() if len(arms) >= _LEAST}
    tests = sum(len(arms) for arms in known.values())
    found = []
    for name, arms in known.items():
        values = np.array([value for value, _ in arms.values()])
        median = float(np.median(values))
        spread = float(np.median(np.abs(values - median))) / _MEDIAN
        for arm, (value, std) in arms.items():
            size = float(np.hypot(spread, std))
            if not size > 0.0:
                continue
            p = min(1.0, 2.0 * tests * float(student_tail(abs(value - median) / size, len(arms) - 1)))
            if p < level:
                found.append(Unlike(arm, name, value, std, median, spread, p))
    return tuple(sorted(found, key=lambda one: one.p))
