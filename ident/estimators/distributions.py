"""Tails and quantiles of the distributions that tests and intervals need, from `scipy.special`.

They are what `scipy.stats` evaluates too; importing that takes longer than most commands take to do their work.
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy import special

__all__ = [
    "chi_square_tail",
    "fisher_limit",
    "fisher_tail",
    "normal_quantile",
    "normal_tail",
    "student_quantile",
    "student_tail",
]


Value = TypeVar("Value", float, NDArray[np.float64])


def normal_tail(z: Value) -> Value:
    """Probability that a standard normal variable exceeds z; of an array, of each."""
    return special.ndtr(-z)  # type: ignore[no-any-return]


def normal_quantile(p: float) -> float:
    """Value that a standard normal variable stays below with probability p."""
    return float(special.ndtri(p))


def student_tail(t: float, freedom: float) -> float:
    """Probability that Student's t of so many degrees of freedom exceeds t."""
    return float(special.stdtr(freedom, -t))


def student_quantile(p: float, freedom: float) -> float:
    """Value that Student's t of so many degrees of freedom stays below with probability p."""
    return float(special.stdtrit(freedom, p))


def chi_square_tail(x: float, freedom: float) -> float:
    """Probability that chi-square of so many degrees of freedom exceeds x."""
    return float(special.chdtrc(freedom, x))


def fisher_tail(f: float, freedom: float, rest: float) -> float:
    """Probability that Fisher's F(freedom, rest) exceeds f."""
    return float(special.fdtrc(freedom, rest, f))


def fisher_limit(p: float, freedom: float, rest: float) -> float:
    """Value that Fisher's F(freedom, rest) exceeds with probability p."""
    return float(special.fdtri(freedom, rest, 1.0 - p))
