"""Each assumption is found to hold or to be violated, as it is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ident.estimation.assumptions import (
    Assumptions,
    Check,
    check_assumptions,
    repeatability,
    weak_parameters,
)
from ident.estimators import InstrumentalVariables, Problem, RowGroup, WeightedLeastSquares
from ident.estimators.covariance import CovarianceSettings
from tests.ident.regression_problems import ar1, design, problem

CHI = np.linspace(-2.0, 2.5, 12)
NAMES = (
    "zero mean",
    "serially uncorrelated",
    "equal variance",
    "normality",
    "exogeneity",
    "condition number",
)


def verdicts(case: Problem, **options) -> dict[str, bool | None]:
    found = check_assumptions(case, WeightedLeastSquares().fit(case), **options)
    return {check.name: check.holds for check in found.checks}


def test_white_normal_residuals_pass_every_check():
    matrices = design(samples=300)
    passed = []
    for seed in range(10):
        random = np.random.default_rng(seed)
        passed.append(verdicts(problem(matrices, CHI, [random.normal(size=300) for _ in matrices])))
    for name in NAMES:
        if name == "exogeneity":
            assert all(found[name] is None for found in passed)
        else:
            assert np.mean([bool(found[name]) for found in passed]) >= 0.9, name


def test_correlation_matters_to_the_textbook_covariance_alone():
    matrices = design(samples=300)
    random = np.random.default_rng(0)
    case = problem(matrices, CHI, [ar1(random, 300, 0.7) for _ in matrices])
    robust = check_assumptions(case, WeightedLeastSquares().fit(case))["serially uncorrelated"]
    assert robust.p_value < 1e-6
    assert robust.holds is True
    textbook = WeightedLeastSquares(CovarianceSettings(kind="textbook")).fit(case)
    found = check_assumptions(case, textbook)["serially uncorrelated"]
    assert found.holds is False
    assert "robust covariance" in found.consequence


def test_too_few_blocks_do_not_allow_for_correlation():
    matrices = design(samples=300)
    random = np.random.default_rng(0)
    case = problem(matrices, CHI, [ar1(random, 300, 0.7) for _ in matrices])
    estimate = WeightedLeastSquares().fit(case)
    few = replace(estimate, covariance=replace(estimate.covariance, degrees_of_freedom=2.0))
    assert check_assumptions(case, few)["serially uncorrelated"].holds is False


def test_a_variance_that_grows_with_the_torque_is_told_but_bends_nothing():
    matrices = design(samples=300)
    random = np.random.default_rng(0)
    noise = [0.3 * np.abs(m @ CHI) * random.normal(size=300) for m in matrices]
    found = check_assumptions(case := problem(matrices, CHI, noise), WeightedLeastSquares().fit(case))
    assert found["equal variance"].p_value < 1e-6
    assert found["equal variance"].holds is True


@pytest.mark.parametrize(("every", "holds"), [(150, True), (7, False)])
def test_spikes_count_by_what_they_bend(every, holds):
    matrices = design(samples=300)
    random = np.random.default_rng(0)
    noise = [0.1 * random.normal(size=300) for _ in matrices]
    for k in (1, 4):
        # The torque is doubled in some samples: a false gain, and not only scatter.
        noise[k][::every] += (matrices[k] @ CHI)[::every]
    found = check_assumptions(case := problem(matrices, CHI, noise), WeightedLeastSquares().fit(case))
    assert found["normality"].p_value < 1e-6
    assert found["normality"].holds is holds
    assert "A2" in found["normality"].finding


def test_a_missing_offset_is_found():
    matrices = [np.delete(m, 1, axis=1) for m in design(samples=300)]
    random = np.random.default_rng(0)
    noise = [random.normal(size=300) + (5.0 if k % 3 == 1 else 0.0) for k in range(6)]
    found = verdicts(problem(matrices, np.delete(CHI, 1), noise))
    assert found["zero mean"] is False


@pytest.mark.parametrize(("column_noise", "holds"), [(0.0, True), (0.5, False)])
def test_noise_in_the_regressor_is_found_by_instruments(column_noise, holds):
    matrices = design(samples=1000)
    random = np.random.default_rng(2)
    measured = [
        m + column_noise * np.where(np.arange(12) < 3, 0, 1) * random.normal(size=m.shape) for m in matrices
    ]
    noise = [0.5 * random.normal(size=1000) for _ in matrices]
    case = problem(matrices, CHI, noise, measured=measured)
    # Instruments near the truth, as a commanded motion is, but not equal to it.
    near = [m + 0.05 * np.roll(m, 1, axis=0) for m in matrices]
    estimate = WeightedLeastSquares().fit(case)
    instrumental = InstrumentalVariables(lambda values: near).fit(case)
    assert check_assumptions(case, estimate, instrumental=instrumental)["exogeneity"].holds is holds


def _periodic(repeating: float, seed: int = 0) -> Problem:
    random = np.random.default_rng(seed)
    period, periods = 50, 6
    time = np.arange(period) * 2 * np.pi / period
    matrix = np.tile(np.column_stack([np.ones(period), np.sin(time), np.cos(time)]), (periods, 1))
    error = np.tile(repeating * np.sin(3 * time), periods)
    target = matrix @ np.array([1.0, 2.0, 3.0]) + error + 0.1 * random.normal(size=period * periods)
    return Problem(
        ("a", "b", "c"), (RowGroup("A1", "joint", 0, matrix, target, np.arange(period * periods)),), 0.2
    )


def test_a_model_error_below_the_sensors_accuracy_does_not_matter():
    small = check_assumptions(case := _periodic(0.06), WeightedLeastSquares().fit(case), period_rows=50)
    assert small["lack of fit"].p_value < 0.01
    assert small["lack of fit"].holds is True
    assert "matters" in small["lack of fit"].finding


def test_model_error_is_told_from_noise_by_the_periods():
    clean, wrong = _periodic(0.0), _periodic(0.2)
    assert verdicts(clean, period_rows=50)["lack of fit"] is True
    assert verdicts(wrong, period_rows=50)["lack of fit"] is False
    structured, noise, _ = repeatability(wrong, WeightedLeastSquares().fit(wrong), 50)["A1 joint"]
    assert structured == pytest.approx(0.2 / np.sqrt(2), rel=0.15)
    assert noise == pytest.approx(0.1, rel=0.1)


def test_the_verdict_table_names_every_check_and_what_follows():
    matrices = design(samples=300)
    random = np.random.default_rng(0)
    case = problem(matrices, CHI, [ar1(random, 300, 0.9) for _ in matrices])
    textbook = WeightedLeastSquares(CovarianceSettings(kind="textbook")).fit(case)
    found = check_assumptions(case, textbook)
    text = found.summary()
    assert all(name in text for name in NAMES)
    assert "VIOLATED" in text
    assert "state a robust covariance" in text
    assert found.to_dict()["serially uncorrelated"]["verdict"] == "VIOLATED"


def test_a_departure_without_consequence_does_not_hold_but_is_harmless():
    small = Check("normality", True, "p 6.5e-10", "outliers", 40.0, 6.5e-10)
    assert (small.verdict, replace(small, p_value=0.2).verdict) == ("harmless", "holds")
    assert replace(small, holds=False).verdict == "VIOLATED"
    assert Check("condition number", True, "12", "").verdict == "holds"
    assert "beyond chance" not in Assumptions((replace(small, p_value=0.2),)).summary()
    assert "harmless: a departure beyond chance" in Assumptions((small,)).summary()


def test_with_a_prior_the_torque_alone_tells_the_consequence():
    matrices = design(samples=300)
    random = np.random.default_rng(0)
    case = problem(matrices, CHI, [ar1(random, 300, 0.0) for _ in matrices])
    plain = WeightedLeastSquares().fit(case)
    assert "of its standard deviations" in check_assumptions(case, plain)["normality"].finding
    found = check_assumptions(case, replace(plain, prior_scale=1.0))["normality"]
    assert "of its standard deviations" not in found.finding
    assert found.holds


def nearly_alike(samples: int, apart: float) -> Problem:
    """Two columns that differ by a small wave, beside others."""
    random = np.random.default_rng(3)
    time = 0.2 * np.arange(samples)
    wave = np.sin(0.5 * time)
    matrix = np.column_stack([wave, wave + apart * np.cos(0.9 * time), np.ones(samples)])
    noise = random.normal(size=samples)
    return Problem(("a", "b", "c"), (RowGroup("A1", "joint", 0, matrix, noise, np.arange(samples)),), 0.2)


@pytest.mark.parametrize(
    ("samples", "apart", "weak"), [(4000, 0.05, False), (100, 0.05, True), (100, 0.5, False)]
)
def test_a_condition_number_counts_where_a_torque_is_uncertain(
    samples: int, apart: float, weak: bool
) -> None:
    case = nearly_alike(samples, apart)
    estimate = WeightedLeastSquares().fit(case)
    check = check_assumptions(case, estimate)["condition number"]
    assert check.holds != weak
    assert {one.name for one in weak_parameters(case, estimate)} == ({"a", "b"} if weak else set())
    if weak:
        assert "a" in check.finding
        (first, _) = weak_parameters(case, estimate)
        size = np.sqrt(np.mean(case.groups[0].matrix[:, case.names.index(first.name)] ** 2))
        assert first.torque == pytest.approx(estimate.std[case.names.index(first.name)] * size)
        assert first.torque > first.matters
        assert weak_parameters(case, estimate, {"A1"}) == []
        assert check_assumptions(case, estimate, doubted={"A1"})["condition number"].holds
        assert len(weak_parameters(case, estimate, {"A2"})) == 2
    assert (check.statistic > 25.0) == (apart == 0.05)
