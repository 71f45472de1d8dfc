"""Rivals of a cause: which gains tell two causes apart, and how sure the better one is."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np

from ident.estimators.estimate import normal_tail

_Cause = TypeVar("_Cause")

# Least probability of a claim without a look-alike.
_SURE = 0.8


def margin(gain: float) -> float:
    """Largest difference of gains between indistinguishable causes."""
    return 12.0 + 0.1 * gain


def exceeds(gain: float, special: float) -> bool:
    """Whether a cause gains so much more than a special case of it that it is needed."""
    return gain - special > margin(special)


def likelihood(gain: float, best: float) -> float:
    """Of a cause over that of the best one.

    Gains are differences of chi-square, up to the misfit of any effect's form, taken as 3 % of the gain.
    """
    return float(np.exp(-max(best - gain, 0.0) / (2.0 * (1.0 + 0.03 * best))))


def confidence(gain: float, rivals: Sequence[float]) -> float:
    """Probability of the best cause among itself, its rivals and chance."""
    others = sum(likelihood(rival, gain) for rival in rivals)
    chance = float(2.0 * normal_tail(np.sqrt(max(gain, 0.0)))) * 500.0
    return 1.0 / (1.0 + others + chance)


def look_alikes(
    gain: float, rivals: Sequence[tuple[_Cause, float]], sure: float
) -> tuple[tuple[_Cause, float], ...]:
    """The rivals, best first, that a cause of a gain is not distinguishable from; the best one at least where rivals
    leave it a probability `sure` below that of a sure claim."""
    alike = tuple((rival, other) for rival, other in rivals if gain - other < margin(gain))
    return alike or (tuple(rivals[:1]) if sure < _SURE else ())
