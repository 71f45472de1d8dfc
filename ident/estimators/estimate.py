"""The result of an estimator, the interface of all estimators, and the distributions of intervals and tests.

Tails and quantiles come from `scipy.special`, without the slow import of `scipy.stats`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol, TypeVar

import numpy as np
from scipy import special

from ident.dynamics.parameters import Floats
from ident.dynamics.tables import Tabular, rows_of
from ident.estimators.problem import Problem
from lwr_driver.listing import Listing, Piece, in_units, text_of
from lwr_driver.notebook import subplots

Value = TypeVar("Value", float, Floats)


MOST_PERCENT = 1000.0
"""Largest relative standard deviation worth its digits: the parameter is not told from zero."""


def percent(value: float, form: str) -> str:
    """A relative standard deviation as text; of a large one only that it is."""
    return f"> {MOST_PERCENT:g}" if value > MOST_PERCENT else format(value, form)


def two_digits(value: float) -> str:
    """A relative standard deviation [%] in two digits, without an exponent."""
    return percent(float(f"{value:.2g}"), "g")


@dataclass(frozen=True)
class Covariance:
    """Covariance (p, p) of the estimate, its assumption (`kind`) and the degrees of freedom of its intervals.

    `inflation` multiplies the half width of a normal or t interval: fixed-b critical values exceed the normal
    ones because a variance robust to serial correlation is itself uncertain.
    """

    matrix: Floats
    kind: str
    degrees_of_freedom: float = float("inf")
    inflation: float = 1.0

    @property
    def std(self) -> Floats:
        """Standard deviations (p,)."""
        return np.sqrt(np.maximum(np.diag(self.matrix), 0.0))


@dataclass(frozen=True)
class ClassFit:
    """Residual of one joint and side.

    sigma : std of the rows with the correct degrees of freedom [`unit`]. rms : plain root mean square [`unit`].
    parameters : share of the p parameters consumed by these rows (the trace of their part of the hat matrix).
    n_eff : effective number of independent rows under serial correlation.
    """

    joint: str
    side: str
    rows: int
    parameters: float
    sigma: float
    rms: float
    n_eff: float
    unit: str = "Nm"

    @property
    def label(self) -> str:
        """Joint and side."""
        return f"{self.joint} {self.side}"


@dataclass(frozen=True)
class Estimate(Tabular):
    """Result of an estimator.

    values : (p,) estimates. covariance : the stated one. covariances : all computed ones by name
        ("textbook", "hac", "bootstrap", "exact channels"). weights : (classes,) inverse variances. residuals :
        y - A chi [Nm] of each row group. standard : standard parameters, if the estimator finds them. prior_scale :
        factor s on the prior's covariance, with a prior. prior_only : names of the parameters known through the prior
        alone.
        bread : (p, p), derivative of the estimate by its scores; score_weights : (classes,) of the residuals in them.
    """

    method: str
    names: tuple[str, ...]
    values: Floats
    covariance: Covariance
    covariances: Mapping[str, Covariance]
    classes: tuple[ClassFit, ...]
    weights: Floats
    residuals: tuple[Floats, ...]
    iterations: int = 1
    converged: bool = True
    notes: tuple[str, ...] = ()
    units: tuple[str, ...] = ()
    standard: Floats | None = None
    prior_scale: float | None = None
    prior_only: tuple[str, ...] = ()
    bread: Floats = field(default_factory=lambda: np.zeros((0, 0)), repr=False)
    score_weights: Floats = field(default_factory=lambda: np.zeros(0), repr=False)

    @property
    def std(self) -> Floats:
        """Stated standard deviations (p,)."""
        return self.covariance.std

    @property
    def rsd_percent(self) -> Floats:
        """Relative standard deviations (p,) of equation (15) [%], from the stated covariance."""
        return rsd_percent(self.values, self.std)

    @property
    def correlation(self) -> Floats:
        """Correlation matrix (p, p) of the stated covariance."""
        std = np.where(self.std > 0, self.std, 1.0)
        return self.covariance.matrix / np.outer(std, std)

    def interval(self, level: float = 0.95, *, covariance: str | None = None) -> Floats:
        """Confidence limits (p, 2) at `level`, from the stated covariance or the one named."""
        chosen = self.covariance if covariance is None else self.covariances[covariance]
        tail = 0.5 + level / 2.0
        finite = np.isfinite(chosen.degrees_of_freedom)
        factor = student_quantile(tail, chosen.degrees_of_freedom) if finite else normal_quantile(tail)
        half = chosen.inflation * factor * chosen.std
        return np.column_stack([self.values - half, self.values + half])

    def records(self) -> list[dict[str, Any]]:
        """One row for each parameter: name, unit, estimate, std, rsd_percent."""
        values, std, rsd = self.values.tolist(), self.std.tolist(), self.rsd_percent.tolist()
        return rows_of(name=self.names, unit=self._units, estimate=values, std=std, rsd_percent=rsd)

    def plot(self) -> Any:
        """Values with their 95 % intervals; the matplotlib Axes, one for each unit."""
        units = list(dict.fromkeys(self._units))
        groups = [[k for k, unit in enumerate(self._units) if unit == wanted] for wanted in units]
        height = 0.6 + 0.16 * max(map(len, groups))
        size = (2.6 * len(units), height)
        axes = subplots(1, len(units), figsize=size)
        half = self.interval()[:, 1] - self.values
        for axis, unit, group in zip(axes, units, groups, strict=True):
            names = [self.names[k] for k in group]
            axis.errorbar(self.values[group], names, xerr=half[group], fmt=".", capsize=2.0)
            axis.axvline(0.0, linewidth=0.5, color="grey")
            axis.invert_yaxis()
            axis.tick_params(labelsize="small")
            axis.set_xlabel(f"[{unit}]")
        return axes

    @property
    def _units(self) -> tuple[str, ...]:
        return self.units or ("",) * len(self.names)

    def __repr__(self) -> str:
        rms = [fit.rms for fit in self.classes]
        residual = f"; residual rms {min(rms):.3g} to {max(rms):.3g} Nm" if rms else ""
        lines = [
            f"Estimate ({self.method}): {len(self.names)} parameters, {sum(c.rows for c in self.classes)} rows"
            f"{residual}{'' if self.converged else ', NOT converged'}",
            f"  standard deviations: {self.covariance.kind}",
            "  least certain parameters:",
        ]
        rsd = self.rsd_percent
        for k in np.argsort(-rsd, kind="stable")[:5]:
            lines.append(
                f"  {self.names[k]:<10}{self.values[k]:>11.4g} ± {self.std[k]:<9.2g} {self._units[k]:<9} "
                f"RSD {percent(rsd[k], '.1f')} %"
            )
        return "\n".join(lines)

    def summary(self) -> str:
        """Table of the parameters and of the residual per joint and side."""
        return text_of(self.pieces())

    def pieces(self) -> list[Piece]:
        """The same with its tables."""
        lines: list[Piece] = [
            f"{self.method}: {len(self.names)} parameters, {sum(c.rows for c in self.classes)} rows, "
            f"{self.iterations} iteration{'s' if self.iterations != 1 else ''}"
            + ("" if self.converged else ", NOT converged"),
            f"standard deviations: {self.covariance.kind}",
            "",
        ]
        rows = [
            (
                name,
                f"{value:.5g}",
                f"{std:.3g}",
                percent(rsd, ".2f"),
                unit + (", from the prior" if name in self.prior_only else ""),
            )
            for name, value, std, rsd, unit in zip(
                self.names, self.values, self.std, self.rsd_percent, self._units, strict=True
            )
        ]
        lines += [Listing(("parameter", "estimate", "std", "RSD %", "unit"), rows, 0), ""]
        classes = [
            (c.label, f"{c.rows}", f"{c.n_eff:.0f}", f"{c.parameters:.1f}", f"{c.sigma:.4f}", f"{c.rms:.4f}")
            for c in self.classes
        ]
        head = ("rows", "count", "n_eff", "consumed", "sigma {unit}", "rms {unit}")
        lines.append(in_units(head, classes, [c.unit for c in self.classes], 0))
        lines += [f"note: {note}" for note in self.notes]
        if self.prior_only:
            lines.append(
                f"note: the motion does not show {', '.join(self.prior_only)}: value and standard deviation are "
                "those of the prior"
            )
        return lines


class Estimator(Protocol):
    """Interface of the estimators: settings in the constructor, work in `fit`."""

    def fit(self, problem: Problem) -> Estimate:
        """Estimate the parameters of the problem."""
        ...


def rsd_percent(values: Floats, std: Floats) -> Floats:
    """100 std / |value|, equation (15); infinite for a value of zero."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(values != 0.0, 100.0 * std / np.abs(values), np.inf)


def normal_tail(z: Value) -> Value:
    """Probability of a standard normal variable above z, for a number or elementwise."""
    return special.ndtr(-z)  # type: ignore[no-any-return]


def normal_quantile(p: float) -> float:
    """Quantile p of the standard normal distribution."""
    return float(special.ndtri(p))


def student_tail(t: Any, freedom: Any) -> Any:
    """Probability of Student's t with `freedom` degrees of freedom above t, elementwise."""
    return special.stdtr(freedom, -t)


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
