"""Distributions, stacks and covariances by themselves, against plain formulas."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
from scipy import stats
from scipy.special import digamma, polygamma

from fri.errors import DataError
from ident.estimators import (
    CovarianceSettings,
    Problem,
    RowGroup,
    TriangularFactor,
    WeightedLeastSquares,
)
from ident.estimators.covariance import Scores, _Blocks, bootstrap, hac, moderated
from ident.estimators.estimate import (
    Covariance,
    chi_square_tail,
    fisher_limit,
    fisher_tail,
    normal_quantile,
    normal_tail,
    rsd_percent,
    student_quantile,
    student_tail,
)
from ident.estimators.least_squares import _loss, _scales, class_variances, consumed_parameters, factor_of
from ident.estimators.problem import Nuisance, _gram_factor, _listed
from tests.ident.regression_problems import CHI, design, noisy, problem, stack

# -- estimates -----------------------------------------------------------------------------------------------


def test_tails_and_quantiles_are_those_of_the_distributions() -> None:
    for x in (-1.3, 0.0, 0.4, 2.7):
        assert normal_tail(x) == pytest.approx(stats.norm.sf(x))
        assert student_tail(x, 7.0) == pytest.approx(stats.t.sf(x, 7.0))
    for p in (0.05, 0.5, 0.975):
        assert normal_quantile(p) == pytest.approx(stats.norm.ppf(p))
        assert student_quantile(p, 4.0) == pytest.approx(stats.t.ppf(p, 4.0))
    assert chi_square_tail(7.0, 3.0) == pytest.approx(stats.chi2.sf(7.0, 3.0))
    assert fisher_tail(2.5, 3.0, 20.0) == pytest.approx(stats.f.sf(2.5, 3.0, 20.0))
    assert fisher_limit(0.05, 3.0, 20.0) == pytest.approx(stats.f.isf(0.05, 3.0, 20.0))


def test_an_interval_is_the_quantile_times_inflation_and_deviation() -> None:
    estimate = WeightedLeastSquares(CovarianceSettings("textbook")).fit(noisy(samples=20))
    matrix = np.diag(np.arange(12.0) ** 2)
    plain = Covariance(matrix, "plain")
    assert (plain.degrees_of_freedom, plain.inflation) == (np.inf, 1.0)
    student = Covariance(matrix, "t", degrees_of_freedom=5.0, inflation=1.3)
    made = replace(estimate, covariance=plain, covariances={"other": student})
    np.testing.assert_allclose(made.std, np.arange(12.0))
    for level in (0.95, 0.5):
        half = stats.norm.ppf(0.5 + 0.5 * level) * np.arange(12.0)
        np.testing.assert_allclose(
            made.interval(level), np.column_stack([made.values - half, made.values + half])
        )
        half = 1.3 * stats.t.ppf(0.5 + 0.5 * level, 5.0) * np.arange(12.0)
        np.testing.assert_allclose(
            made.interval(level, covariance="other"),
            np.column_stack([made.values - half, made.values + half]),
        )
    np.testing.assert_allclose(made.interval(), made.interval(0.95))
    assert made.correlation[0, 0] == 0.0
    np.testing.assert_allclose(np.diag(made.correlation)[1:], 1.0)
    assert Covariance(np.array([[-1e-9]]), "negative").std.tolist() == [0.0]


def test_a_relative_deviation_of_zero_is_infinite() -> None:
    assert rsd_percent(np.array([2.0, -4.0, 0.0]), np.array([0.1, 1.0, 3.0])).tolist() == [5.0, 25.0, np.inf]


def test_a_record_of_the_estimate_has_name_unit_value_and_deviations() -> None:
    case = noisy(samples=20)
    units = tuple(f"u{k}" for k in range(12))
    estimate = WeightedLeastSquares(CovarianceSettings("textbook")).fit(replace(case, units=units))
    row = estimate.records()[3]
    assert row == {
        "name": "p3", "unit": "u3", "estimate": estimate.values[3], "std": estimate.std[3],
        "rsd_percent": pytest.approx(100.0 * estimate.std[3] / abs(estimate.values[3])),
    }  # fmt: skip
    assert (estimate.iterations > 1, estimate.notes, estimate.standard) == (True, (), None)
    assert (estimate.prior_scale, estimate.prior_only) == (None, ())


# -- the stack -----------------------------------------------------------------------------------------------


def test_the_condition_of_a_stack_without_full_rank_is_infinite() -> None:
    group = RowGroup("A1", "joint", 0, np.array([[1.0, 0.0], [2.0, 0.0]]), np.ones(2), np.arange(2))
    lost = Problem(("a", "b"), (group,), 0.1)
    assert lost.condition == np.inf
    assert lost.normalised_condition == np.inf
    scaled = Problem(("a", "b"), (replace(group, matrix=np.diag([1.0, 4.0])),), 0.1)
    assert (scaled.condition, scaled.normalised_condition) == (pytest.approx(4.0), pytest.approx(1.0))


def test_infinite_entries_are_found_in_long_and_short_stacks() -> None:
    for rows in (10, 5000):
        matrix = np.random.default_rng(0).normal(size=(rows, 3))
        matrix[4, 1] = np.inf
        factor = TriangularFactor.of(matrix, np.ones(rows))
        assert factor.r.shape == (4, 4)
        assert np.isnan(factor.r).all()
        group = RowGroup("A1", "joint", 0, matrix, np.ones(rows), np.arange(rows))
        with pytest.raises(DataError, match="A1 joint: non-finite"):
            _ = Problem(("a", "b", "c"), (group,), 0.1).classes


def test_a_gram_matrix_that_loses_digits_is_not_taken() -> None:
    matrix = np.random.default_rng(0).normal(size=(500, 2))
    assert _gram_factor(matrix, matrix[:, 0] + 1.0) is not None
    # The pivot is the sine of the angle between the columns.
    for angle, taken in ((0.9e-5, False), (1.5e-5, True)):
        close = np.column_stack([matrix[:, 0], matrix[:, 0] + angle * matrix[:, 1]])
        assert (_gram_factor(close, np.ones(500)) is not None) == taken


@pytest.mark.parametrize(("count", "text"), [(2, "a, b"), (3, "a, b, c"), (5, "a, b, c and 2 more")])
def test_a_long_list_of_names_is_cut(count: int, text: str) -> None:
    assert _listed("abcde"[:count], 3) == text


@pytest.mark.parametrize(("times", "taken"), [([0, 1, 3], True), ([0, 1, 1], False), ([0, 2, 1], False)])
def test_rows_are_in_the_order_of_time(times: list[int], taken: bool) -> None:
    def made() -> RowGroup:
        return RowGroup("A1", "motor", 0, np.ones((3, 2)), np.ones(3), np.array(times))

    if taken:
        assert made().label == "A1 motor"
    else:
        with pytest.raises(DataError, match="must increase"):
            made()


def test_each_class_consumes_its_share_of_the_parameters() -> None:
    case = noisy(samples=30)
    matrix, _, classes = stack(case)
    weights = np.array([4.0, 1.0, 0.5])
    normal = (matrix.T * weights[classes]) @ matrix
    root = factor_of(case, weights).inverse_root()
    np.testing.assert_allclose(root @ root.T, np.linalg.inv(normal), rtol=1e-8)
    found = consumed_parameters(case, weights, root)
    hat = np.einsum("ij,jk,ik->i", matrix, np.linalg.inv(normal), matrix) * weights[classes]
    np.testing.assert_allclose(found, np.bincount(classes, hat), rtol=1e-8)
    assert found.sum() == pytest.approx(12.0)


def test_the_variance_of_a_class_has_a_floor_of_its_torque() -> None:
    matrices = design(samples=30)
    exact = problem(matrices, CHI, [np.zeros(len(m)) for m in matrices])
    found = class_variances(exact, CHI, np.full(3, 4.0))
    square = sum(float(g.target @ g.target) for g in exact.groups) / exact.rows
    assert np.all(found >= 0.99e-20 * square)
    assert np.all(found < 1e-18 * square)


@pytest.mark.parametrize(
    ("u", "huber", "tukey"),
    [(0.0, (1.0, 1.0), (1.0, 1.0)), (1.0, (1.0, 1.0), (0.5625, -0.1875)), (-4.0, (0.25, 0.0), (0.0, 0.0))],
)
def test_the_weight_of_a_residual_falls_with_its_size(
    u: float, huber: tuple[float, float], tukey: tuple[float, float]
) -> None:
    for loss, tuning, expected in (("huber", 1.0, huber), ("tukey", 2.0, tukey)):
        weight, slope = _loss(np.array([u]), loss, tuning)
        assert (weight[0], slope[0]) == pytest.approx(expected)


def test_the_robust_scale_is_the_median_of_the_residuals() -> None:
    case = noisy(samples=40)
    consumed = np.array([3.0, 4.0, 5.0])
    found = _scales(case, CHI, consumed)
    for number, row_class in enumerate(case.classes):
        size = np.abs(np.concatenate([case.residuals(CHI)[k] for k in row_class.groups]))
        correction = np.sqrt(80.0 / (80.0 - consumed[number]))
        assert found[number] == pytest.approx(1.4826 * np.median(size) * correction, rel=1e-9)


# -- covariances ---------------------------------------------------------------------------------------------


def test_the_settings_of_a_covariance_begin_as_documented() -> None:
    found = CovarianceSettings()
    assert {field.name: getattr(found, field.name) for field in fields(found)} == {
        "kind": "jackknife", "bandwidth_s": None, "block_s": None, "draws": 400, "seed": 20160,
    }  # fmt: skip


@pytest.mark.parametrize(
    ("samples", "block_s", "length"),
    # At least eight blocks and at most eighty, of 0.2 s a sample.
    [(200, 2.0, 10), (200, 100.0, 50), (200, 0.2, 5), (201, 0.2, 6), (20, 0.2, 1), (4, 9.0, 1)],
)
def test_a_block_is_an_eightieth_to_an_eighth_of_the_time(samples: int, block_s: float, length: int) -> None:
    groups = tuple(
        RowGroup("A1", "joint", k, np.ones((samples, 1)), np.ones(samples), np.arange(samples))
        for k in range(2)
    )
    case = Problem(("a",), groups, 0.2)
    cut = _Blocks.of(case, block_s)
    assert (cut.length, cut.periodic, cut.note) == (length, False, "")
    runs = cut.runs(groups[1])
    assert len(runs) == max(1, round(samples / length))
    assert [rows.stop - rows.start for _, rows in runs] == pytest.approx(
        [samples / len(runs)] * len(runs), abs=1
    )
    assert (runs[0][1].start, runs[-1][1].stop) == (0, samples)
    periodic = _Blocks.of(replace(case, periods=(samples, samples // 2)), block_s)
    assert (periodic.periodic, periodic.note) == (True, " of the period")
    assert [spans[1] for spans in periodic.spans.values()] == [samples, samples // 2]


def test_a_bootstrap_is_the_scatter_of_solutions_over_blocks_drawn_again() -> None:
    case = noisy(samples=40, records=1)
    weights = np.array([400.0, 11.0, 1.0])
    found = bootstrap(case, weights, 1.0, 60, 5)
    matrix, target, classes = stack(case)
    block = np.tile(np.arange(40) // 5, 3)
    random = np.random.default_rng(5)
    solutions = []
    for _ in range(60):
        counts = random.multinomial(8, np.full(8, 1.0 / 8.0))
        w = counts[block] * weights[classes]
        solutions.append(np.linalg.solve((matrix.T * w) @ matrix, (matrix.T * w) @ target))
    np.testing.assert_allclose(found.matrix, np.cov(np.array(solutions).T), rtol=1e-5, atol=1e-12)
    assert found.degrees_of_freedom == 7.0
    assert "8 blocks of 1.00 s, 60 draws" in found.kind


@pytest.mark.parametrize(("bandwidth_s", "length"), [(2.0, 10), (0.0, 1), (900.0, 25), (0.31, 2)])
def test_a_stated_bandwidth_is_kept_up_to_a_quarter_of_the_samples(bandwidth_s: float, length: int) -> None:
    scores = Scores((np.random.default_rng(0).normal(size=(100, 2)),))
    bread = np.array([[2.0, 0.3], [0.3, 1.0]])
    found, used = hac(scores, bread, 0.2, bandwidth_s)
    assert used == pytest.approx(0.2 * length)
    np.testing.assert_allclose(found.matrix, bread @ scores.bartlett(length) @ bread.T)
    b = length / 100
    # Kiefer and Vogelsang 2005, table 1: the critical value of the Bartlett kernel.
    assert found.inflation == pytest.approx((1.96 + 2.9694 * b + 0.416 * b**2 - 0.5324 * b**3) / 1.96)
    assert f"stated bandwidth {0.2 * length:.2f} s" in found.kind


def test_an_automatic_bandwidth_is_the_next_larger_one_and_one_more() -> None:
    values = np.random.default_rng(0).normal(size=(400, 2)).cumsum(axis=0)
    scores = Scores((values - values.mean(axis=0),))
    found, used = hac(scores, np.eye(2), 0.5)
    assert used == pytest.approx(0.5 * min(int(np.ceil(scores.bandwidth(np.eye(2)))) + 1, 100))
    assert "automatic" in found.kind


def test_the_scores_of_a_long_record_are_summed_to_four_thousand() -> None:
    scores = Scores((np.random.default_rng(0).normal(size=(8001, 1)), np.zeros((30, 1))))
    found, used = hac(scores, np.eye(1), 0.1, 3.0)
    assert used == pytest.approx(3.0)
    np.testing.assert_allclose(found.matrix, scores.thinned(3).bartlett(10))
    short, _ = hac(Scores((scores.records[0][:4000],)), np.eye(1), 0.1, 3.0)
    np.testing.assert_allclose(short.matrix, Scores((scores.records[0][:4000],)).bartlett(30))


def test_the_bandwidth_weighs_the_parameters_by_their_relative_innovations() -> None:
    random = np.random.default_rng(2)
    records = tuple(
        random.normal(size=(n, 2)).cumsum(axis=0) * [1.0, 0.2] + random.normal(size=(n, 2)) for n in (60, 90)
    )
    bread = np.array([[2.0, 0.5], [0.5, 3.0]])
    top = bottom = 0.0
    for record in records:
        for k in range(2):
            series = record @ bread[k] / np.sqrt(bread[k, k])
            rho = np.clip(series[1:] @ series[:-1] / (series[:-1] @ series[:-1]), -0.97, 0.97)
            share = np.mean((series[1:] - rho * series[:-1]) ** 2) / np.mean(series**2)
            top += 4 * rho**2 * share**2 / ((1 - rho) ** 6 * (1 + rho) ** 2)
            bottom += share**2 / (1 - rho) ** 4
    assert Scores(records).bandwidth(bread) == pytest.approx(1.1447 * (top / bottom * 150) ** (1 / 3))
    assert Scores((np.zeros((20, 2)),)).bandwidth(bread) == 0.0


def test_variances_that_scatter_by_chance_alone_become_a_common_multiple() -> None:
    plain = np.array([1.0, 4.0, 9.0, 16.0, 25.0])
    found, freedom = moderated(3.0 * plain, plain, 11.0)
    assert freedom == 11.0 + 1e4
    bias = np.exp(np.log(5.5) - digamma(5.5))
    np.testing.assert_allclose(
        found, (1e4 * 3.0 * bias * plain + 11.0 * 3.0 * plain) / (1e4 + 11.0), rtol=1e-3
    )


def test_variances_that_scatter_by_themselves_stay_their_own() -> None:
    random = np.random.default_rng(0)
    plain, spread = np.ones(400), np.exp(random.normal(0.0, 1.5, 400))
    found, freedom = moderated(spread, plain, 11.0)
    ratios = np.log(spread) - digamma(5.5) + np.log(5.5)
    own = freedom - 11.0
    # The freedom of the prior explains the scatter beyond chance.
    assert float(polygamma(1, 0.5 * own)) == pytest.approx(np.var(ratios, ddof=1) - float(polygamma(1, 5.5)))
    common = np.exp(np.median(ratios) + digamma(0.5 * own) - np.log(0.5 * own))
    np.testing.assert_allclose(found, (own * common + 11.0 * spread) / freedom)


def test_two_nuisances_add_the_squares_of_their_effects() -> None:
    case = noisy(samples=30)
    random = np.random.default_rng(8)
    effects = [{k: random.normal(size=30) for k in some} for some in ((0, 3), (1, 2, 5))]
    nuisances = tuple(
        Nuisance(f"n{k}", std, columns)
        for k, (std, columns) in enumerate(zip((0.3, 0.0), effects, strict=True))
    )
    settings = CovarianceSettings("textbook")
    plain = WeightedLeastSquares(settings).fit(case)
    changed = WeightedLeastSquares(settings).fit(replace(case, nuisances=nuisances))
    moment = sum(
        plain.weights[case.class_of_group[k]] * case.groups[k].matrix.T @ column
        for k, column in effects[0].items()
    )
    shift = 0.3 * plain.covariance.matrix @ moment
    np.testing.assert_allclose(
        changed.covariance.matrix - plain.covariance.matrix, np.outer(shift, shift), atol=1e-12
    )
