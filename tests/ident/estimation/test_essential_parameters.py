"""Elimination of parameters not supported by the data."""

from __future__ import annotations

import numpy as np
import pytest

from fri.errors import ConfigurationError
from ident.estimation.essential import EssentialSettings, find_essential
from ident.estimators import Problem, WeightedLeastSquares
from tests.ident.regression_problems import ar1, design, problem

CHI = np.array([0.8, -1.0, 0.5, 2.0, 0.0, 1.0, 0.0, -1.5, 0.0, 0.7, 0.0, -2.0])
ZEROS = {"p4", "p6", "p8", "p10"}


def case(seed: int = 0, rho: float = 0.6, chi=CHI) -> Problem:
    matrices = design()
    random = np.random.default_rng(seed)
    return problem(matrices, chi, [0.5 * ar1(random, 200, rho) for _ in matrices])


def test_what_is_zero_goes_and_what_is_not_stays():
    survivors = 0
    for seed in range(15):
        data = case(seed)
        found = find_essential(data, WeightedLeastSquares().fit(data))
        gone = {elimination.name for elimination in found.eliminated}
        assert gone <= ZEROS
        survivors += len(ZEROS - gone)
        assert all("not distinguishable from zero" in e.reason for e in found.eliminated)
    assert survivors <= 4


def test_the_closed_form_is_the_restricted_solution():
    data = case()
    full = WeightedLeastSquares().fit(data)
    found = find_essential(
        data, full, EssentialSettings(drop=("p3", "p7"), significance=1e-12, largest_loss_percent=0)
    )
    first, second = found.eliminated[:2]
    assert (first.name, second.name) == ("p3", "p7")
    rest = [k for k in range(12) if k != 3]
    weights = np.repeat(full.weights[[0, 1, 2, 0, 1, 2]], 200)
    rows = np.vstack([g.matrix for g in data.groups])[:, rest] * np.sqrt(weights)[:, None]
    target = np.concatenate([g.target for g in data.groups]) * np.sqrt(weights)
    restricted = np.linalg.lstsq(rows, target, rcond=None)[0]
    assert second.estimate == pytest.approx(restricted[rest.index(7)], rel=1e-8)
    loss = np.sum((target - rows @ restricted) ** 2)
    before = 1200 - 12
    assert first.loss_percent == pytest.approx(100 * (np.sqrt(loss / before) - 1), rel=1e-3)


def test_keep_and_drop_lists_are_obeyed_and_explained():
    data = case()
    settings = EssentialSettings(keep=("p4",), drop=("p0",))
    found = find_essential(data, WeightedLeastSquares().fit(data), settings)
    assert "p4" in found.names
    assert "keep list" in found.kept_because["p4"]
    assert "p0" not in found.names
    assert found.eliminated[0].reason == "on the drop list"
    assert "p0" in found.summary()
    assert found.to_dict()["count"] == len(found.names)


def test_the_bound_on_the_loss_of_fit_holds():
    data = case(chi=np.where(CHI == 0.0, 0.02, CHI), rho=0.9)
    full = WeightedLeastSquares().fit(data)
    tight = find_essential(data, full, EssentialSettings(largest_loss_percent=0.05))
    wide = find_essential(data, full, EssentialSettings(largest_loss_percent=50.0))
    assert tight.loss_percent <= 0.05
    assert len(tight.names) >= len(wide.names)
    assert sum(e.loss_percent for e in tight.eliminated) == pytest.approx(tight.loss_percent, abs=1e-9)


def test_the_reduced_estimate_is_estimated_again():
    data = case()
    found = find_essential(data, WeightedLeastSquares().fit(data))
    again = WeightedLeastSquares().fit(data.select(found.columns))
    np.testing.assert_allclose(found.estimate.values, again.values, rtol=1e-12)
    truth = CHI[found.columns]
    assert np.abs((found.estimate.values - truth) / found.estimate.std).max() < 4.5


@pytest.mark.parametrize(
    "settings",
    [{"significance": 0.0}, {"largest_loss_percent": -1.0}, {"keep": ("p1",), "drop": ("p1",)}],
)
def test_impossible_settings_are_refused(settings):
    with pytest.raises(ConfigurationError):
        EssentialSettings(**settings)


def test_an_unknown_name_is_refused():
    data = case()
    with pytest.raises(ConfigurationError, match="not a base parameter"):
        find_essential(data, WeightedLeastSquares().fit(data), EssentialSettings(keep=("Fvl9",)))
