"""Units of angles and their rates, told by the limits of the joints and by dq/dt."""

from __future__ import annotations

import math
from typing import cast

import numpy as np
from numpy.typing import NDArray

from ident.import_log.rates import ALIKE, Rates
from ident.import_log.tables import Floats

ANGLES = {"rad": 1.0, "deg": math.pi / 180.0}
"""Size of each unit of angle [rad]."""
RATES = {"rad/s": 1.0, "deg/s": 180.0 / math.pi, "rpm": 30.0 / math.pi}
"""Number in each unit of one rad/s."""
_RATIO = 1.5
"""Largest factor between dq/dt and a velocity in the right unit; the units are factors of 5 apart."""
_OFF, _SPREAD = 0.03, 0.25
"""Least deviation of that factor that is said if all joints agree, and their largest spread over it."""
_SLACK = 0.05
"""Share of a joint's range by which positions may exceed it."""
TURNS = 4.0 * math.pi
"""Two turns [rad], beyond which no joint goes."""
_WAY = 0.5
"""Least way of a joint in rad that speaks for rad: in deg it would be at rest."""


def close(ratio: float, other: float = 1.0) -> bool:
    """Whether two ratios of velocity to dq/dt speak for the same unit."""
    return abs(math.log(ratio / other)) < math.log(_RATIO)


def unlike(ratios: Floats, common: float) -> NDArray[np.bool_]:
    """Ratios (k,) of velocity to dq/dt that speak for another unit than the common one; unknown ones do not."""
    return np.abs(np.log(ratios / common)) > math.log(_RATIO)


def excess(angle: Floats, limits: Floats) -> Floats:
    """How far angles (n, k) leave limits (k, 2) with their slack, at most (k,)."""
    slack = _SLACK * np.nan_to_num(limits[:, 1] - limits[:, 0], posinf=0.0)
    past = angle - np.clip(angle, limits[:, 0] - slack, limits[:, 1] + slack)
    return cast(Floats, np.abs(past).max(axis=0))


def beyond_limits(angle: Floats, limits: Floats) -> NDArray[np.bool_]:
    """Joints (k,) whose angles (n, k) [rad] leave their limits (k, 2), or go beyond two turns."""
    return (excess(angle, limits) > 0.0) | (np.abs(angle).max(axis=0) >= TURNS)


def in_degrees(numbers: Floats, limits: Floats, out: NDArray[np.bool_]) -> bool:
    """Whether the numbers (n, k) of turning joints, of which some are `out` of their limits (k, 2) in rad, are degrees.

    With a wrong sign or order a joint keeps the largest limits of the arm. More joints have to be beyond theirs than
    move within them as joints do in rad, or two of them beyond two turns.
    """
    if not out.any():
        return False
    largest = float(np.abs(limits).max())
    largest = largest * (1.0 + _SLACK) if math.isfinite(largest) else TURNS
    within = ~out & (np.ptp(numbers, axis=0) > _WAY)
    size = np.abs(numbers).max(axis=0)
    return bool(size.max() > largest and (out.sum() > within.sum() or np.sum(size >= TURNS) > 1))


def rate_unit(rates: Rates) -> tuple[str, float] | None:
    """Unit of a velocity by dq/dt, and its ratio to that in the unit; None if it is no velocity of these joints."""
    if rates.alike < ALIKE:
        return None
    unit, size = min(RATES.items(), key=lambda item: abs(math.log(rates.ratio / item[1])))
    return (unit, rates.ratio / size) if close(rates.ratio, size) else None


def same_in_all(rates: Rates, factor: float) -> bool:
    """Whether the joints agree about a factor off 1."""
    found = rates.by_channel / rates.ratio
    found = found[np.isfinite(found)]
    off = abs(factor - 1.0)
    return len(found) > 1 and off > _OFF and bool(np.max(np.abs(found - 1.0)) < _SPREAD * off)
