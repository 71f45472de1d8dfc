from __future__ import annotations

import numpy as np
import pytest

from ident.dynamics.base_set import BaseSet, numeric_base
from ident.dynamics.kinematics import Chain
from ident.dynamics.parameters import Floats, from_com
from ident.dynamics.structure import ModelStructure
from ident.estimation.feasibility import Feasibility, feasibility
from ident.estimators.estimate import Covariance, Estimate


@pytest.fixture(scope="module")
def base() -> BaseSet:
    rows = [{"alpha": -np.pi / 2 * (k > 0), "d": 0.2 * (k > 0)} for k in range(3)]
    return numeric_base(ModelStructure(Chain.from_table(rows), model=2))


def values_of(base: BaseSet, bodies: Floats, drive: float = 0.1) -> Floats:
    standard = np.zeros(base.structure.n_columns)
    for k, body in enumerate(bodies):
        standard[17 * k : 17 * k + 10] = body
        standard[17 * k + 10] = drive
    return base.reduce(standard)


def compact() -> Floats:
    return np.array([from_com(2.0, (0.1, 0.02, 0.05), 0.01 * np.eye(3)) for _ in range(3)])


def rods() -> Floats:
    """Bodies on the edge of the possible: all mass on a line."""
    return np.array([from_com(2.0, (0.1, 0.0, 0.0), np.diag([0.0, 0.01, 0.01])) for _ in range(3)])


def estimate_of(base: BaseSet, values: Floats, std: Floats, freedom: float = np.inf) -> Estimate:
    covariance = Covariance(np.diag(std**2), "stated", freedom)
    return Estimate(
        "wls", base.names, values, covariance, {"textbook": covariance}, (), np.zeros(0), (), units=base.units
    )


def judged(base: BaseSet, estimate: Estimate) -> Feasibility:
    found = feasibility(base, estimate)
    assert found is not None
    return found


def test_a_real_arm_has_its_own_parameters(base: BaseSet) -> None:
    values = values_of(base, compact())
    found = judged(base, estimate_of(base, values, np.full(len(values), 1e-3)))
    assert found.real
    assert found.possible
    assert not found.negative


@pytest.mark.parametrize("name", ["ZZ3", "Ia2"])
def test_a_parameter_below_its_least_value_is_named(base: BaseSet, name: str) -> None:
    values, std = values_of(base, compact()), np.full(len(base), 1e-3)
    values[base.names.index(name)] = -6e-3
    found = judged(base, estimate_of(base, values, std))
    assert not found.possible
    assert f"{name} -0.006 ± 0.001 kg m^2, 6.0 standard deviations below zero" in str(found)


def test_only_parameters_with_a_least_value_are_named(base: BaseSet) -> None:
    bodies = compact()
    bodies[:, 7] -= 0.2  # centres of mass at a negative y
    bodies[:, [0, 5]] += 0.2
    values = values_of(base, bodies)
    assert any(value < 0.0 for value, name in zip(values, base.names, strict=True) if name.startswith("MY"))
    assert not judged(base, estimate_of(base, values, np.full(len(values), 1e-3))).negative


def test_an_impossible_combination_of_possible_parameters_has_a_distance(base: BaseSet) -> None:
    values, std = values_of(base, compact()), np.full(len(base), 1e-3)
    values[base.names.index("XZ3")] += 0.5  # a product of inertia beyond what the moments allow
    found = judged(base, estimate_of(base, values, std))
    assert not found.negative
    assert found.distance > 100.0
    assert found.p < 1e-6
    assert "XZ3" in dict(found.moved)


def test_errors_of_an_estimate_of_an_extreme_arm_are_no_impossibility(base: BaseSet) -> None:
    rng = np.random.default_rng(4)
    truth, freedom = values_of(base, rods(), drive=0.0), 20.0
    std = np.full(len(truth), 1e-4)
    draws = 200
    warned = outside = 0
    for _ in range(draws):
        values = truth + std * rng.normal(size=len(truth))
        found = feasibility(
            base, estimate_of(base, values, std * np.sqrt(rng.chisquare(freedom) / freedom), freedom)
        )
        warned += not found.possible
        outside += found.distance > 0.5
    assert outside > 0.75 * draws  # noise alone moves it out of the cone
    assert warned <= 8  # at 1 % for either kind of warning, more than 8 have a chance of 2 %
