"""The model of all days of an arm, from their triangular factors alone."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ident.estimators.problem import TriangularFactor
from ident.model.dynamic_model import DynamicModel
from ident.model.model_file import read_model, write_model
from runner.fleet.days import day_of
from runner.fleet.store import ArmStore
from runner.fleet.trend import arm_trend

# Least number of days for a standard deviation from the differences of days.
_LEAST_DAYS = 5


def together(store: ArmStore, usual: Mapping[str, float]) -> DynamicModel | None:
    """The model of all days since the last change; None without days of the first model's parameters.

    Values of the stacked rows of all days; covariance from the days left out in turn (jackknife), so that what
    changes from day to day is in it. With few days it is that of the rows alone.
    """
    if not store.model.is_file():
        return None
    first = read_model(store.model)
    begin = max((one.change.earliest for one in arm_trend(store, usual).changes), default=-np.inf)
    kept = [
        (key, factor)
        for key, (names, factor) in store.factors().items()
        if names == first.names and day_of(key) >= begin
    ]
    if not kept:
        return None
    factors = [factor for _, factor in kept]
    whole = TriangularFactor.combine(factors, [1.0] * len(factors))
    root = whole.inverse_root()
    values, covariance = whole.solve(), root @ root.T
    if len(factors) >= _LEAST_DAYS:
        normals = [factor.r.T @ factor.r for factor in factors]
        total, p = np.sum(normals, axis=0), whole.parameters
        parts = [total - one for one in normals]
        without = np.array([np.linalg.solve(one[:p, :p], one[:p, p]) for one in parts])
        apart = without - without.mean(axis=0)
        count = len(factors)
        covariance = (count - 1) / count * apart.T @ apart
    provenance = {
        **{
            key: value
            for key, value in first.provenance.items()
            if key not in ("sessions", "degrees_of_freedom")
        },
        "days": [key for key, _ in kept],
        "degrees_of_freedom": float(max(len(factors) - 1, 1)),
    }
    return replace(first, values=values, covariance=covariance, provenance=provenance)


def write_together(store: ArmStore, usual: Mapping[str, float]) -> None:
    """Write `together.yaml` of an arm, if its days allow one."""
    found = together(store, usual)
    if found is not None:
        write_model(found, store.together)
