"""Essential parameters: base parameters not supported by the data are set to zero, one after the other.

Backward elimination begins with the parameter of the largest relative standard deviation. It is set to zero if
an F test with the variance robust to serial correlation cannot distinguish it from zero and the loss of fit
stays within a bound. After each step the others adapt (restricted least squares), so the order matters and is
recorded. `keep` and `drop` lists serve the supervised way of the paper.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from fri.errors import ConfigurationError
from fri.quantities import Name, within
from ident.dynamics.tables import Tabular
from ident.estimators.covariance import CovarianceSettings
from ident.estimators.estimate import Estimate, fisher_limit, percent
from ident.estimators.least_squares import WeightedLeastSquares
from ident.estimators.problem import Problem
from lwr_driver.listing import Listing, Piece, text_of


@dataclass(frozen=True)
class EssentialSettings:
    """Limits of the elimination of parameters.

    significance : level of the F test against zero. largest_loss_percent : bound on the growth of the
        weighted residual rms, all eliminations together. keep : parameters never eliminated. drop : parameters
        eliminated first and untested. Names with or without their `R`, or a symbol for all links (`Fvl`).
    """

    significance: Annotated[float, within(0.0, 1.0, "share", above=True, below=True)] = 0.01
    largest_loss_percent: Annotated[float, within(0.0, 1e6, "%")] = 1.0
    keep: tuple[Name, ...] = ()
    drop: tuple[Name, ...] = ()

    def __post_init__(self) -> None:
        if not 0.0 < self.significance < 1.0:
            raise ConfigurationError(f"`significance` is {self.significance}; it must lie between 0 and 1")
        if self.largest_loss_percent < 0.0:
            raise ConfigurationError(
                f"`largest_loss_percent` is {self.largest_loss_percent}; it must not be negative"
            )
        both = set(self.keep) & set(self.drop)
        if both:
            raise ConfigurationError(f"{sorted(both)[0]!r} is in both `keep` and `drop`; choose one")


@dataclass(frozen=True)
class Elimination:
    """One parameter set to zero: its estimate and RSD just before, F statistic and loss of fit."""

    name: str
    estimate: float
    rsd_percent: float
    f_statistic: float
    loss_percent: float
    reason: str


@dataclass(frozen=True)
class Essential(Tabular):
    """The essential parameters, estimated again without the others.

    columns : positions of the essential parameters in the base set. estimate : WLS of the reduced problem.
    loss_percent : growth of the weighted residual rms over the base parameters.
    """

    columns: NDArray[np.int64]
    estimate: Estimate
    eliminated: tuple[Elimination, ...]
    kept_because: dict[str, str] = field(default_factory=dict)
    loss_percent: float = 0.0

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the essential parameters."""
        return self.estimate.names

    def records(self) -> list[dict[str, Any]]:
        """One row for each eliminated parameter."""
        return [entry.__dict__ for entry in self.eliminated]

    def __repr__(self) -> str:
        names = " ".join(e.name for e in self.eliminated[:12]) + (" ..." if len(self.eliminated) > 12 else "")
        return (
            f"{len(self.names)} essential parameters, {len(self.eliminated)} eliminated ({names or 'none'}); "
            f"the weighted residual grew by {self.loss_percent:.2f} %"
        )

    def summary(self) -> str:
        """Counts and the reason for each elimination."""
        return text_of(self.pieces())

    def pieces(self) -> list[Piece]:
        """The same with its table."""
        rows = [
            (
                e.name,
                f"{e.estimate:.4g}",
                percent(e.rsd_percent, ".1f"),
                f"{e.f_statistic:.2f}",
                f"{e.loss_percent:.3f}",
                e.reason,
            )
            for e in self.eliminated
        ]
        return [
            f"{len(self.names)} essential parameters, {len(self.eliminated)} eliminated; the weighted "
            f"residual grew by {self.loss_percent:.2f} %",
            Listing(("eliminated", "estimate", "RSD %", "F", "loss %", "reason"), rows, 0),
            *(f"{name}: {reason}" for name, reason in self.kept_because.items()),
        ]

    def to_dict(self) -> dict[str, Any]:
        """Plain content for files."""
        return {
            "count": len(self.names),
            "names": list(self.names),
            "loss_percent": self.loss_percent,
            "eliminated": [
                {key.removesuffix("_statistic"): value for key, value in e.__dict__.items()}
                for e in self.eliminated
            ],
            "kept_because": dict(self.kept_because),
        }


def find_essential(
    problem: Problem,
    estimate: Estimate,
    settings: EssentialSettings | None = None,
    covariance: CovarianceSettings | None = None,
) -> Essential:
    """Eliminate backwards from an estimate of the base parameters, then estimate the remaining ones by WLS.

    The restricted solutions follow in closed form: with C the textbook covariance and V the robust one,
    setting chi_i = 0 takes chi to P chi, C to P C P^T and V to P V P^T with P = I - C e_i e_i^T / C_ii.
    """
    settings = settings or EssentialSettings()
    names = list(problem.names)
    keep, drop = _positions(names, settings.keep, "keep"), _positions(names, settings.drop, "drop")
    values = estimate.values.copy()
    plain = estimate.covariances["textbook"].matrix.copy()
    robust = estimate.covariance.matrix.copy()
    freedom = min(estimate.covariance.degrees_of_freedom, max(problem.rows - len(names), 1))
    critical = fisher_limit(settings.significance, 1, freedom)
    # Weighted sum of squares of the full model: one per degree of freedom by the choice of the weights.
    base_square = max(problem.rows - len(names), 1)
    lost = 0.0
    alive = np.ones(len(names), dtype=bool)
    eliminated: list[Elimination] = []
    kept: dict[str, str] = {}
    waiting = list(drop)
    blocked: set[int] = set()
    while True:
        if waiting:
            index, reason = waiting.pop(0), "on the drop list"
        else:
            open_ = [k for k in np.flatnonzero(alive) if k not in keep and k not in blocked]
            if not open_:
                break
            statistic = values[open_] ** 2 / np.maximum(np.diag(robust)[open_], 1e-300)
            index = int(open_[int(np.argmin(statistic))])
            if float(np.min(statistic)) >= critical:
                break
            reason = f"F below {critical:.2f}: not distinguishable from zero"
        f_statistic = float(values[index] ** 2 / max(robust[index, index], 1e-300))
        loss = float(values[index] ** 2 / plain[index, index])
        growth = 100.0 * (np.sqrt(1.0 + (lost + loss) / base_square) - 1.0)
        if growth > settings.largest_loss_percent and reason != "on the drop list":
            blocked.add(index)
            kept[names[index]] = (
                f"kept although F = {f_statistic:.2f}: without it the residual would have grown by "
                f"{growth:.2f} %"
            )
            continue
        before = 100.0 * (np.sqrt(1.0 + lost / base_square) - 1.0)
        lost += loss
        rsd = 100.0 / np.sqrt(f_statistic) if f_statistic > 0 else float("inf")
        eliminated.append(
            Elimination(names[index], float(values[index]), rsd, f_statistic, float(growth - before), reason)
        )
        direction = plain[:, index] / plain[index, index]
        values = values - direction * values[index]
        project = np.eye(len(names))
        project[:, index] -= direction
        robust = project @ robust @ project.T
        plain = plain - np.outer(plain[:, index], direction)
        plain[index, :] = plain[:, index] = 0.0
        plain[index, index] = 1.0
        robust[index, :] = robust[:, index] = 0.0
        robust[index, index] = 1.0
        values[index] = 0.0
        alive[index] = False
    for index in sorted(keep):
        if alive[index] and values[index] ** 2 < critical * robust[index, index]:
            kept[names[index]] = "on the keep list although not distinguishable from zero"
    columns = np.flatnonzero(alive)
    reduced = problem.select(columns)
    final = WeightedLeastSquares(covariance or CovarianceSettings()).fit(reduced)
    loss_percent = 100.0 * (np.sqrt(1.0 + lost / base_square) - 1.0)
    return Essential(columns, final, tuple(eliminated), kept, float(loss_percent))


def _positions(names: Sequence[str], wanted: Sequence[str], which: str) -> list[int]:
    found: list[int] = []
    for item in wanted:
        hits = [
            k
            for k, name in enumerate(names)
            if item in (name, name.removesuffix("R"), name.rstrip("R0123456789"))
        ]
        if not hits:
            raise ConfigurationError(
                f"`{which}` names {item!r}, not a base parameter; the base parameters are {', '.join(names)}"
            )
        found += [k for k in hits if k not in found]
    return found
