"""What a group of columns adds to a model."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ident.diagnosis.gain.products import Floats
from ident.estimators.estimate import fisher_tail


@dataclass(frozen=True, eq=False)
class Score:
    """Contribution of a group of k columns to the model.

    gain, fitted : fall of the chi-square on the parts held back in turn, and on the fitted rows.
    coefficients (k,), covariance (k, k) from blocks. p_value : of the hypothesis of all zero. inflation : the gain
    over the number of rows of the joints and sides it acts on, the explained relative excess of power. robust : gives
    covariance and number of active blocks, on demand. chance : a p-value from another source.
    """

    gain: float
    fitted: float
    coefficients: Floats
    inflation: float
    robust: Callable[[], tuple[Floats, int]]
    chance: float | None = None

    @cached_property
    def uncertainty(self) -> tuple[Floats, int]:
        """Covariance (k, k) from blocks, and their number."""
        return self.robust()

    @property
    def covariance(self) -> Floats:
        """(k, k), from blocks."""
        return self.uncertainty[0]

    @cached_property
    def p_value(self) -> float:
        """Probability of such coefficients where all are zero."""
        if self.chance is not None:
            return self.chance
        return chance(self.coefficients, *self.uncertainty)


def chance(coefficients: Floats, covariance: Floats, blocks: int) -> float:
    """Probability of such coefficients (k,) where all are zero; their covariance (k, k) from a number of blocks."""
    k = len(coefficients)
    try:
        value = float(coefficients @ np.linalg.solve(covariance, coefficients))
    except np.linalg.LinAlgError:
        return 1.0
    return fisher_tail(value / k, k, max(blocks - k, 1))


def widened(sandwich: Floats, independent: Floats) -> Floats:
    """A covariance from blocks, its standard deviations at least those of independent rows."""
    floor = np.sqrt(np.maximum(np.diag(independent), 0.0) / np.maximum(np.diag(sandwich), 1e-300))
    widen = np.maximum(floor, 1.0)
    return sandwich * np.outer(widen, widen)
