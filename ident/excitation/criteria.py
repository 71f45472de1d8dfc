"""Scalar criteria of an information matrix, each with its exact derivative; all are logarithms, so all have
one scale.

The condition number and the largest relative deviation are not differentiable where extremes coincide, which
is where the optimum lies. They are replaced by norms of order `sharpness` that bound them from above and
approach them as it grows: the condition number by the Schatten norms of the matrix and of its inverse, the
maximum by a p-norm.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve, eigh
from scipy.linalg.lapack import dpotrf, dpotri

from fri.errors import ConfigurationError
from ident.excitation.motion import Array

__all__ = ["d_optimality", "log_condition", "relative_deviations", "rsd_mean", "rsd_worst", "scaled"]

_HUGE = 50.0
_LEAST_EIGENVALUE = 1e-13


def log_condition(information: Array, sharpness: float = np.inf) -> tuple[float, Array]:
    """log cond(Omega) = (log of the eigenvalue ratio) / 2 of Omega^T Omega, and its derivative (p, p)."""
    if np.isinf(sharpness):
        return _log_condition_exact(information)
    power = int(sharpness)
    if power == sharpness and power >= 2 and power & (power - 1) == 0:
        return _log_condition_powers(information, power)
    raise ConfigurationError(f"sharpness {sharpness} is neither a power of two nor infinite")


def _log_condition_exact(information: Array) -> tuple[float, Array]:
    try:
        w, v = eigh(information, check_finite=False, driver="evd")
    except LinAlgError:
        return _HUGE, np.zeros_like(information)
    if not w[0] > _LEAST_EIGENVALUE * w[-1]:
        return _HUGE, np.zeros_like(information)
    value = 0.5 * float(np.log(w[-1] / w[0]))
    return value, 0.5 * (np.outer(v[:, -1], v[:, -1]) / w[-1] - np.outer(v[:, 0], v[:, 0]) / w[0])


def _log_condition_powers(information: Array, power: int) -> tuple[float, Array]:
    """Schatten norms by repeated squaring: several times cheaper than eigenvectors.

    log |H|_p = log(tr H^p) / p with derivative H^(p-1) / tr H^p, and the same for the inverse.
    """
    size = float(np.trace(information))
    inverse = _positive_inverse(information / size) if size > 0.0 else None
    if inverse is None:
        return _HUGE, np.zeros_like(information)
    upper, upper_bar = _log_norm(information / size, power)
    scale = float(np.trace(inverse))
    lower, lower_bar = _log_norm(inverse / scale, power)
    bar = upper_bar - inverse @ (lower_bar @ inverse) / scale
    return 0.5 * (upper + lower + float(np.log(scale))), 0.5 * bar / size


def _log_norm(matrix: Array, power: int) -> tuple[float, Array]:
    """log of the Schatten norm of even order `power` of a positive definite matrix, and its derivative."""
    below, square = matrix, matrix
    log_square = log_below = 0.0  # what `square` and `below` have been divided by, against underflow
    for _ in range(power.bit_length() - 2):
        square = square @ square
        size = float(np.trace(square))
        square = square / size
        log_square = 2.0 * log_square + float(np.log(size))
        below = below @ square
        log_below += log_square
    total = float(np.sum(square * square))
    value = (float(np.log(total)) + 2.0 * log_square) / power
    return value, below * (np.exp(log_below - 2.0 * log_square) / total)


def _positive_inverse(matrix: Array) -> Array | None:
    factor, failed = dpotrf(matrix, lower=True, overwrite_a=False)
    if failed:
        return None
    inverse, failed = dpotri(factor, lower=True, overwrite_c=True)
    if failed:
        return None
    lower = np.tril(inverse)
    return np.asarray(lower + np.tril(inverse, -1).T)


def d_optimality(information: Array) -> tuple[float, Array]:
    """-log det(information) / p, and its derivative."""
    p = information.shape[0]
    inverse, logdet = _inverse(information)
    if inverse is None:
        return _HUGE, np.zeros_like(information)
    return -logdet / p, -inverse / p


def relative_deviations(information: Array, values: Array) -> Array:
    """Relative standard deviations (15) in percent, (p,); infinite where the information is singular."""
    inverse, _ = _inverse(information)
    if inverse is None:
        return np.full(values.shape, np.inf)
    return 100.0 * np.sqrt(np.diag(inverse)) / np.abs(values)


def rsd_mean(information: Array, values: Array) -> tuple[float, Array]:
    """log of the mean relative standard deviation [%], and its derivative."""
    inverse, _ = _inverse(information)
    if inverse is None:
        return _HUGE, np.zeros_like(information)
    deviation = np.sqrt(np.diag(inverse))
    rsd = 100.0 * deviation / np.abs(values)
    total = float(rsd.sum())
    slope = 100.0 / (2.0 * np.abs(values) * deviation) / total
    return float(np.log(total / values.size)), -(inverse * slope) @ inverse


def rsd_worst(information: Array, values: Array, sharpness: float = np.inf) -> tuple[float, Array]:
    """log of the largest relative standard deviation [%] (a norm of order `sharpness`), and its
    derivative.
    """
    inverse, _ = _inverse(information)
    if inverse is None:
        return _HUGE, np.zeros_like(information)
    variance = np.diag(inverse)
    rsd = 100.0 * np.sqrt(variance) / np.abs(values)
    peak = float(rsd.max())
    if np.isinf(sharpness):
        share = np.zeros_like(rsd)
        share[int(np.argmax(rsd))] = 1.0
        value = float(np.log(peak))
    else:
        power = (rsd / peak) ** sharpness
        total = float(power.sum())
        share = power / total
        value = float(np.log(peak) + np.log(total) / sharpness)
    slope = share / (2.0 * variance)
    return value, -(inverse * slope) @ inverse


def scaled(information: Array) -> tuple[Array, Array]:
    """Information of the matrix with columns normalised to length one, and the scale 1 / length, (p,)."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-300))
    return information * np.outer(scale, scale), scale


def unscale(bar: Array, normalised: Array, scale: Array) -> Array:
    """Derivative with respect to the information from that with respect to its normalised form."""
    through = bar * np.outer(scale, scale)
    correction = np.sum(bar * normalised, axis=1) * scale**2
    through[np.diag_indices_from(through)] -= correction
    return through


def _inverse(information: Array) -> tuple[Array | None, float]:
    """Inverse by Cholesky with unit diagonal scaling, and log det; None where not positive definite."""
    normalised, scale = scaled(information)
    try:
        factor = cho_factor(normalised, lower=True, check_finite=False)
    except LinAlgError:
        return None, -np.inf
    diagonal = np.diag(factor[0])
    if diagonal.min() ** 2 < _LEAST_EIGENVALUE:
        return None, -np.inf
    inverse = cho_solve(factor, np.eye(information.shape[0]), check_finite=False)
    logdet = 2.0 * float(np.sum(np.log(diagonal)) - np.sum(np.log(scale)))
    return inverse * np.outer(scale, scale), logdet
