"""Tails and quantiles of distributions from `scipy.special`, without the slow import of `scipy.stats`."""

from __future__ import annotations

from typing import TypeVar

from scipy import special

from ident.dynamics.parameters import Floats

__all__ = [
    "chi_square_tail",
    "fisher_limit",
    "fisher_tail",
    "normal_quantile",
    "normal_tail",
    "student_quantile",
    "student_tail",
]


Value = TypeVar("Value", float, Floats)


def normal_tail(z: Value) -> Value:
    """Probability of a standard normal variable above z, for a number or elementwise."""
    return special.ndtr(-z)  # type: ignore[no-any-return]


def normal_quantile(p: float) -> float:
    """Quantile p of the standard normal distribution."""
    return float(special.ndtri(p))


def student_tail(t: float, freedom: float) -> float:
    """Probability of Student's t with `freedom` degrees of freedom above t."""
    return float(special.stdtr(freedom, -t))


def student_quantile(p: float, freedom: float) -> float:
    """Quantile p of Student's t with `freedom` degrees of freedom."""
    return float(special.stdtrit(freedom, p))


def chi_square_tail(x: float, freedom: float) -> float:
    """Probability of chi-square with `freedom` degrees of freedom above x."""
    return float(special.chdtrc(freedom, x))


def fisher_tail(f: float, freedom: float, rest: float) -> float:
    """Probability of Fisher's F(freedom, rest) above f."""
    return float(special.fdtrc(freedom, rest, f))


def fisher_limit(p: float, freedom: float, rest: float) -> float:
    """Quantile 1 - p of Fisher's F(freedom, rest)."""
    return float(special.fdtri(freedom, rest, 1.0 - p))
