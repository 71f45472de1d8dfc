"""Covariance matrices that stay positive semi-definite in a file of ten digits.

Estimates of a covariance from few rows, such as the HAC form with more parameters than blocks, are singular:
their smallest eigenvalues are zero, and rounding makes them negative.
"""

from __future__ import annotations

import logging

import numpy as np

from ident.dynamics.parameters import Floats

logger = logging.getLogger(__name__)

DIGITS = 10
_HALF_DIGIT = 0.5 * 10.0 ** (1 - DIGITS)
"""Largest relative error of a number of that many digits."""


def rounded(values: Floats) -> Floats:
    """The values with the digits of a file, and no negative zero."""
    flat = [float(f"{value:.{DIGITS}g}") + 0.0 for value in np.ravel(values)]
    return np.array(flat, dtype=np.float64).reshape(np.shape(values))


def smallest_eigenvalue(covariance: Floats) -> float:
    """The smallest eigenvalue of the correlation matrix; 0 is the limit of a covariance."""
    return float(np.linalg.eigvalsh(_correlation(covariance)[0])[0]) if len(covariance) else 0.0


def nearest_covariance(covariance: Floats, where: str = "covariance") -> Floats:
    """The covariance (p, p), or the nearest positive semi-definite one with the same standard deviations.

    The eigenvalues of the correlation matrix are clipped (Higham, 2002) at the largest error by rounding to the
    digits of a file, p x 5e-10, so that the rounded matrix is positive semi-definite too. Repairs beyond
    rounding are logged with their size. where : begins the message.
    """
    count = len(covariance)
    if not count or _is_semi_definite(rounded(covariance)):
        return covariance
    correlation, std = _correlation(covariance)
    values, vectors = np.linalg.eigh(correlation)
    floor = count * _HALF_DIGIT
    while True:
        lifted = (vectors * np.maximum(values, floor)) @ vectors.T
        own = np.sqrt(np.diag(lifted))
        lifted /= np.outer(own, own)
        result = np.asarray(0.5 * (lifted + lifted.T) * np.outer(std, std), dtype=np.float64)
        np.fill_diagonal(result, np.maximum(np.diag(covariance), 0.0))
        if _is_semi_definite(rounded(result)):
            break
        # The new scaling to ones on the diagonal has lowered the eigenvalues.
        floor *= 2.0
    if values[0] < -count * _HALF_DIGIT:
        logger.warning(
            "%s is not positive semi-definite (smallest eigenvalue of the correlations %.2g); the nearest one "
            "is taken, with the same standard deviations and correlations moved by up to %.2g",
            where,
            values[0],
            float(np.max(np.abs(lifted - correlation))),
        )
    return result


def _is_semi_definite(covariance: Floats) -> bool:
    # The eigenvalues themselves are exact to the rounding of the solver.
    if np.any(np.diag(covariance) < 0.0):
        return False
    return smallest_eigenvalue(covariance) >= -len(covariance) * float(np.finfo(np.float64).eps)


def _correlation(covariance: Floats) -> tuple[Floats, Floats]:
    """Correlations (p, p), 1 on the diagonal, and standard deviations (p,)."""
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    known = std > 0.0
    inverse = np.divide(1.0, std, out=np.zeros_like(std), where=known)
    correlation = 0.5 * (covariance + covariance.T) * np.outer(inverse, inverse)
    np.fill_diagonal(correlation, 1.0)
    return correlation, std
