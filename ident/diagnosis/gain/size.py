"""The size of an effect from several sets of sessions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ident.diagnosis.gain.products import Floats
from ident.diagnosis.gain.score import chance

USUAL_CHANGES = 2.0
"""Weight of the usual change of a parameter, a gain or the size of an effect beside this arm's own, in changes."""
# The mean over the standard deviation from set to set.
_CLEAR = 3.0


@dataclass(frozen=True, eq=False)
class Size:
    """Coefficients (k,) of an effect from several sets, their covariance (k, k) and standard deviation from set to set.

    blocks : behind the covariance.
    """

    mean: Floats
    covariance: Floats
    from_set_to_set: float
    blocks: int

    @classmethod
    def of(
        cls,
        values: Sequence[Floats],
        covariances: Sequence[Floats],
        usual: float = 0.0,
        *,
        blocks: int = 0,
    ) -> Size:
        """Weighted mean of the sets' values (k,) with their own covariances (k, k) (DerSimonian and Laird 1986).

        usual : standard deviation of such a size from day to day on any arm, counted as some further changes.
        """
        each, own = np.array(values), np.array([float(np.trace(c)) for c in covariances])
        between = float(np.sum(np.var(each, axis=0, ddof=1))) if len(each) > 1 else 0.0
        changes, more = len(each) - 1, USUAL_CHANGES if usual else 0.0
        excess = changes * max(between - float(np.mean(own)), 0.0) + more * usual**2
        excess /= max(changes + more, 1.0)
        weights = 1.0 / np.maximum(own + excess, 1e-300)
        weights /= weights.sum()
        covariance = np.einsum("d,dij->ij", weights**2, np.array(covariances))
        return cls(weights @ each, covariance, float(np.sqrt(excess)), blocks)

    @property
    def lasting(self) -> bool:
        """Whether it differs little from set to set."""
        return bool(np.linalg.norm(self.mean) > _CLEAR * self.from_set_to_set)

    @property
    def certainty(self) -> float:
        """The mean over its own standard deviation and that from set to set."""
        own = np.trace(self.covariance) + self.from_set_to_set**2
        return float(np.linalg.norm(self.mean) / np.sqrt(max(own, 1e-300)))

    @property
    def p_value(self) -> float:
        """Probability of such a mean where all are zero."""
        return chance(self.mean, self.covariance, self.blocks)
