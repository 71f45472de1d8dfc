"""Ordinary least squares, equation (11): every row counts alike."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ident.estimators.covariance import CovarianceSettings, textbook
from ident.estimators.estimate import Estimate
from ident.estimators.problem import Problem
from ident.estimators.solution import consumed_parameters, estimate_from, factor_of

__all__ = ["OrdinaryLeastSquares"]


@dataclass(frozen=True)
class OrdinaryLeastSquares:
    """Minimises ||Y - Omega chi||; one variance for all rows."""

    covariance: CovarianceSettings = field(default_factory=CovarianceSettings)

    def fit(self, problem: Problem) -> Estimate:
        """Estimate (p,) by QR; textbook covariance sigma^2 (A^T A)^-1."""
        ones = np.ones(len(problem.classes))
        factor = factor_of(problem, ones)
        values = factor.solve()
        root = factor.inverse_root()
        freedom = max(factor.rows - factor.parameters, 1)
        variance = max(factor.sum_of_squares(values) / freedom, np.finfo(float).tiny)
        return estimate_from(
            problem,
            method="OLS",
            values=values,
            weights=ones / variance,
            bread=variance * (root @ root.T),
            consumed=consumed_parameters(problem, ones, root),
            settings=self.covariance,
            plain=textbook(variance * (root @ root.T)),
        )
