"""Estimators on regressions with known truth."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fri.errors import ConfigurationError, DataError
from ident.dynamics.parameters import from_com, pseudo_inertia
from ident.estimators import (
    BodyPrior,
    CovarianceSettings,
    InstrumentalVariables,
    MaximumAPosteriori,
    Nuisance,
    OrdinaryLeastSquares,
    PhysicallyConsistent,
    Prior,
    Problem,
    RecursiveFilter,
    RecursiveLeastSquares,
    RegressorExtensionMixing,
    RobustLeastSquares,
    RowGroup,
    TotalLeastSquares,
    TriangularFactor,
    WeightedLeastSquares,
    nearest_consistent,
)
from tests.ident.regression_problems import ar1, design, problem

CHI = np.linspace(-2.0, 2.5, 12)
SIGMA = np.array([0.05, 0.3, 1.0])


def white(seed: int, matrices, scale=SIGMA):
    random = np.random.default_rng(seed)
    return [scale[k % 3] * random.normal(size=len(m)) for k, m in enumerate(matrices)]


def sample(seed: int = 1, **changes) -> Problem:
    matrices = design(**changes)
    return problem(matrices, CHI, white(seed, matrices))


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000), p=st.integers(1, 9))
def test_gram_and_orthogonal_factors_agree(seed, p):
    random = np.random.default_rng(seed)
    matrix = random.normal(size=(5000, p)) * 10.0 ** random.uniform(-3, 3, p)
    target = random.normal(size=5000)
    fast = TriangularFactor.of(matrix, target)
    parts = [TriangularFactor.of(matrix[k::2], target[k::2]) for k in (0, 1)]
    exact = TriangularFactor.combine(parts, [1.0, 1.0])
    values = exact.solve()
    np.testing.assert_allclose(fast.solve(), values, rtol=1e-8, atol=1e-10 * np.abs(values).max())
    assert fast.sum_of_squares(values) == pytest.approx(exact.sum_of_squares(values), rel=1e-9)
    assert exact.sum_of_squares(values) == pytest.approx(
        float(np.sum((target - matrix @ values) ** 2)), rel=1e-9
    )


def test_nearly_dependent_columns_take_the_stable_way():
    random = np.random.default_rng(0)
    matrix = random.normal(size=(6000, 4))
    matrix[:, 3] = matrix[:, 2] + 1e-7 * random.normal(size=6000)
    chi = np.array([1.0, 2.0, 3.0, 4.0])
    found = TriangularFactor.of(matrix, matrix @ chi).solve()
    np.testing.assert_allclose(found, chi, rtol=1e-6)


@pytest.mark.parametrize(
    "estimator",
    [
        OrdinaryLeastSquares(),
        WeightedLeastSquares(),
        RobustLeastSquares("huber"),
        RobustLeastSquares("tukey"),
        TotalLeastSquares(exact=r"p[012]$"),
        RecursiveLeastSquares(),
        RecursiveLeastSquares(memory_s=40.0),
        RegressorExtensionMixing(),
        MaximumAPosteriori(Prior(np.zeros(12), np.zeros((12, 12)))),
    ],
    ids=lambda e: type(e).__name__,
)
def test_every_estimator_finds_the_truth_within_its_intervals(estimator):
    estimate = estimator.fit(sample())
    z = (estimate.values - CHI) / estimate.std
    assert np.sqrt(np.mean(z**2)) < 2.0
    assert np.abs(z).max() < 4.0
    assert np.all(estimate.rsd_percent > 0)
    text = estimate.summary()
    assert all(name in text for name in estimate.names)
    assert "A3 joint" in text
    assert estimate.covariance.kind in text


@pytest.mark.parametrize(
    "estimator",
    [OrdinaryLeastSquares(), WeightedLeastSquares(), RegressorExtensionMixing(), RecursiveLeastSquares()],
)
def test_without_noise_the_truth_is_exact(estimator):
    matrices = design()
    estimate = estimator.fit(problem(matrices, CHI, [np.zeros(len(m)) for m in matrices]))
    np.testing.assert_allclose(estimate.values, CHI, atol=1e-6)


def test_weighted_least_squares_solves_equation_14():
    case = sample()
    estimate = WeightedLeastSquares().fit(case)
    rows = np.vstack([g.matrix * np.sqrt(estimate.weights[k % 3]) for k, g in enumerate(case.groups)])
    target = np.concatenate([g.target * np.sqrt(estimate.weights[k % 3]) for k, g in enumerate(case.groups)])
    np.testing.assert_allclose(estimate.values, np.linalg.lstsq(rows, target, rcond=None)[0], atol=1e-9)
    covariance = np.linalg.inv(rows.T @ rows)
    np.testing.assert_allclose(estimate.covariances["textbook"].matrix, covariance, rtol=1e-7)
    np.testing.assert_allclose(estimate.rsd_percent, 100 * estimate.std / np.abs(estimate.values), rtol=1e-12)
    for group, residual in zip(case.groups, estimate.residuals, strict=True):
        np.testing.assert_allclose(residual, group.target - group.matrix @ estimate.values, atol=1e-12)


def test_variances_have_the_right_degrees_of_freedom():
    matrices = design(samples=20, records=1)
    squares = []
    for seed in range(400):
        estimate = WeightedLeastSquares(CovarianceSettings("textbook")).fit(
            problem(matrices, CHI, white(seed, matrices, np.ones(3)))
        )
        assert sum(fit.parameters for fit in estimate.classes) == pytest.approx(12.0)
        squares.append([fit.sigma**2 for fit in estimate.classes])
    np.testing.assert_allclose(np.mean(squares, axis=0), 1.0, atol=0.06)


def test_weights_are_inverse_variances_with_the_degrees_of_freedom_of_equation_13():
    matrices = design(samples=20, records=1)
    estimate = WeightedLeastSquares().fit(problem(matrices, CHI, white(11, matrices)))
    consumed = []
    normal = sum(w * m.T @ m for w, m in zip(estimate.weights, matrices, strict=True))
    for number, matrix in enumerate(matrices):
        square = float(estimate.residuals[number] @ estimate.residuals[number])
        share = float(np.trace(np.linalg.solve(normal, estimate.weights[number] * matrix.T @ matrix)))
        consumed.append(share)
        assert estimate.weights[number] == pytest.approx((20.0 - share) / square, rel=1e-4)
        assert estimate.classes[number].sigma == pytest.approx(np.sqrt(square / (20.0 - share)), rel=1e-6)
        assert estimate.classes[number].rms == pytest.approx(np.sqrt(square / 20.0), rel=1e-9)
    assert [fit.parameters for fit in estimate.classes] == pytest.approx(consumed, rel=1e-4)
    assert min(consumed) > 2.0


def test_the_intervals_of_a_hac_covariance_are_widened_for_its_bandwidth():
    # Critical value at 97.5 % of Kiefer and Vogelsang (2005), Bartlett kernel, table I.
    matrices = design(records=1, samples=100)
    for share in (0.05, 0.25):
        settings = CovarianceSettings("hac", bandwidth_s=share * 100 * 0.2)
        estimate = WeightedLeastSquares(settings).fit(problem(matrices, CHI, white(2, matrices)))
        critical = 1.96 + 2.9694 * share + 0.4160 * share**2 - 0.5324 * share**3
        low, high = estimate.interval(0.95).T
        np.testing.assert_allclose((high - low) / 2.0 / estimate.std, critical, rtol=1e-4)


def test_ordinary_least_squares_has_one_variance():
    matrices = design()
    case = problem(matrices, CHI, white(3, matrices, np.full(3, 0.4)))
    estimate = OrdinaryLeastSquares(CovarianceSettings("textbook")).fit(case)
    stack = np.vstack(matrices)
    expected = 0.4 * np.sqrt(np.diag(np.linalg.inv(stack.T @ stack)))
    np.testing.assert_allclose(estimate.std, expected, rtol=0.1)


@pytest.mark.parametrize("kind", ["jackknife", "hac", "bootstrap"])
def test_robust_covariances_match_the_textbook_on_white_residuals(kind):
    ratios = []
    matrices = design(samples=400)
    for seed in range(6):
        estimate = WeightedLeastSquares(CovarianceSettings(kind)).fit(
            problem(matrices, CHI, white(seed, matrices))
        )
        ratios.append(estimate.std / estimate.covariances["textbook"].std)
        assert kind in estimate.covariances
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.1)


def test_hac_is_the_double_sum_of_its_definition():
    matrices = design(records=1, samples=60)
    case = problem(matrices, CHI, white(2, matrices))
    estimate = WeightedLeastSquares(CovarianceSettings("hac", bandwidth_s=1.0)).fit(case)
    bread = estimate.covariances["textbook"].matrix
    scores = np.zeros((60, 12))
    for k, group in enumerate(case.groups):
        fit = estimate.classes[k]
        correction = np.sqrt(fit.rows / (fit.rows - fit.parameters))
        scores += group.matrix * (estimate.weights[k] * estimate.residuals[k] * correction)[:, None]
    meat = sum(
        max(0.0, 1 - abs(i - j) / 5) * np.outer(scores[i], scores[j]) for i in range(60) for j in range(60)
    )
    np.testing.assert_allclose(estimate.covariance.matrix, bread @ meat @ bread.T, rtol=1e-9, atol=1e-15)


def test_jackknife_is_the_scatter_of_estimates_without_a_block():
    matrices = design(records=1, samples=64)
    case = problem(matrices, CHI, white(4, matrices))
    estimate = WeightedLeastSquares(CovarianceSettings("jackknife", block_s=0.2)).fit(case)
    rows = np.vstack([g.matrix * np.sqrt(estimate.weights[k]) for k, g in enumerate(case.groups)])
    target = np.concatenate([g.target * np.sqrt(estimate.weights[k]) for k, g in enumerate(case.groups)])
    time = np.tile(np.arange(64), 3)
    shifts, wider = [], np.zeros(len(CHI))
    variance = np.diag(np.linalg.inv(rows.T @ rows))
    for block in range(64):
        rest = time != block
        shifts.append(np.linalg.lstsq(rows[rest], target[rest], rcond=None)[0] - estimate.values)
        wider += np.diag(np.linalg.inv(rows[rest].T @ rows[rest])) - variance
    excess = 63 / 64 * wider / variance
    assert 1.0 < np.median(excess) < 1.2
    expected = np.sqrt(63 / 64 * np.sum(np.square(shifts), axis=0) / excess * np.median(excess))
    np.testing.assert_allclose(estimate.std, expected, rtol=1e-6)


def test_a_jackknife_is_as_wide_for_what_few_blocks_show_as_for_the_rest():
    """Of independent residuals; without the correction the variance of the second is nearly twice as wide."""
    ratios = []
    for seed in range(150):
        random = np.random.default_rng(seed)
        matrix = random.normal(size=(400, 2))
        matrix[:, 1] *= np.repeat([1.0, 0.6, 0.1], [20, 20, 360])
        group = RowGroup(
            "0", "joint", 0, matrix, matrix @ [1.0, 1.0] + random.normal(size=400), np.arange(400)
        )
        case = Problem(("a", "b"), (group,), 0.2)
        found = WeightedLeastSquares(CovarianceSettings("jackknife", block_s=4.0)).fit(case)
        ratios.append(
            np.diag(found.covariances["jackknife"].matrix) / np.diag(found.covariances["textbook"].matrix)
        )
    common, seldom = np.mean(ratios, axis=0)
    assert seldom == pytest.approx(common, rel=0.1)


def test_a_parameter_of_one_short_period_among_long_records_keeps_its_deviation():
    """As a payload that one session carries: blocks as long as the period would leave nothing of it."""
    ratios = []
    for seed in range(40):
        random = np.random.default_rng(seed)
        long, short = np.zeros((600, 2)), np.zeros((120, 2))
        long[:, 0] = random.normal(size=600)
        short[:] = np.tile(random.normal(size=(30, 2)), (4, 1))
        groups = tuple(
            RowGroup("0", "joint", k, m, m @ [1.0, 1.0] + random.normal(size=len(m)), np.arange(len(m)))
            for k, m in enumerate((long, short))
        )
        case = Problem(("a", "b"), groups, 0.2, periods=(None, 30))
        found = WeightedLeastSquares(CovarianceSettings("jackknife", block_s=12.0)).fit(case)
        ratios.append(found.std[1] / np.sqrt(found.covariances["textbook"].matrix[1, 1]))
    assert 0.8 < np.median(ratios) < 1.6
    assert 0.3 < min(ratios) < max(ratios) < 3.0


def test_a_parameter_that_one_block_alone_shows_has_the_deviation_of_the_hac():
    for seed in range(10):
        random = np.random.default_rng(seed)
        matrix = random.normal(size=(400, 3))
        matrix[:, 2] = 0.0
        matrix[105:115, 2] = random.normal(size=10)
        group = RowGroup(
            "0", "joint", 0, matrix, matrix @ np.ones(3) + random.normal(size=400), np.arange(400)
        )
        case = Problem(("a", "b", "c"), (group,), 0.2)
        found = WeightedLeastSquares(CovarianceSettings("jackknife", block_s=4.0)).fit(case)
        of_hac = np.sqrt(np.diag(found.covariances["hac"].matrix))
        assert found.std[2] == pytest.approx(of_hac[2] * max(np.median(found.std[:2] / of_hac[:2]), 1.0))


def test_periods_are_no_independent_witnesses_of_what_the_model_lacks():
    matrices = [np.tile(matrix, (4, 1)) for matrix in design(samples=150, seed=3)]
    inside, alone = [], []
    for seed in range(30):
        random = np.random.default_rng(seed)
        noise = [np.tile(ar1(random, 150, 0.5), 4) + 0.3 * random.normal(size=600) for _ in matrices]
        case = problem(matrices, CHI, noise)
        for found, periods in ((inside, (150, 150)), (alone, ())):
            estimate = WeightedLeastSquares().fit(dataclasses.replace(case, periods=periods))
            low, high = estimate.interval(0.95).T
            found.append((low < CHI) & (high > CHI))
    assert (
        "of the period" in WeightedLeastSquares().fit(dataclasses.replace(case, periods=(150, 150))).summary()
    )
    assert 0.90 < np.mean(inside) < 0.98
    assert np.mean(alone) < 0.80


def test_intervals_cover_on_correlated_residuals_where_the_textbook_fails():
    matrices = design(p=24, joints=4, samples=250, seed=5)
    chi = np.linspace(-1, 1, 24)
    inside, textbook = [], []
    for seed in range(60):
        random = np.random.default_rng(seed)
        noise = [
            (0.1 + 0.3 * (k % 4)) * (0.9 * ar1(random, 250, 0.85) + 0.4 * random.normal(size=250))
            for k in range(8)
        ]
        estimate = WeightedLeastSquares().fit(problem(matrices, chi, noise, joints=4))
        for found, which in ((inside, None), (textbook, "textbook")):
            low, high = estimate.interval(0.95, covariance=which).T
            found.append((low < chi) & (chi < high))
    assert 0.90 < np.mean(inside) < 0.98
    assert np.mean(textbook) < 0.80


def test_effective_rows_of_a_first_order_process():
    matrices = design(samples=4000, records=1)
    random = np.random.default_rng(0)
    rho = 0.8
    estimate = WeightedLeastSquares().fit(problem(matrices, CHI, [ar1(random, 4000, rho) for _ in range(3)]))
    for fit in estimate.classes:
        assert fit.n_eff / fit.rows == pytest.approx((1 - rho) / (1 + rho), rel=0.3)


def test_a_nuisance_adds_its_effect_to_every_covariance():
    case = sample()
    slope = np.cos(np.arange(200) * 0.1)
    shared = Problem(
        case.names, case.groups, case.sample_time_s, nuisances=(Nuisance("delay", 0.5, {1: slope}),)
    )
    plain, loaded = WeightedLeastSquares().fit(case), WeightedLeastSquares().fit(shared)
    moment = plain.weights[1] * case.groups[1].matrix.T @ slope
    shift = 0.5 * plain.covariances["textbook"].matrix @ moment
    for kind in ("textbook", "jackknife"):
        added = loaded.covariances[kind].matrix - plain.covariances[kind].matrix
        np.testing.assert_allclose(added, np.outer(shift, shift), atol=1e-12)


@pytest.mark.parametrize("loss", ["huber", "tukey"])
def test_robust_estimates_shrug_off_gross_errors(loss):
    matrices = design()
    noise = white(7, matrices)
    random = np.random.default_rng(8)
    for series in noise:
        series[random.choice(len(series), 10, replace=False)] += 30.0
    case = problem(matrices, CHI, noise)
    robust, plain = RobustLeastSquares(loss).fit(case), WeightedLeastSquares().fit(case)
    clean = WeightedLeastSquares().fit(sample(7))
    scale = clean.std
    assert np.sqrt(np.mean(((robust.values - CHI) / scale) ** 2)) < 2.5
    assert np.sqrt(np.mean(((plain.values - CHI) / scale) ** 2)) > 8.0
    assert "60 of 1200" in robust.notes[0] or int(robust.notes[0].split()[0]) >= 60


def test_total_least_squares_undoes_the_attenuation_by_noisy_columns():
    matrices = design(samples=2000)
    random = np.random.default_rng(1)
    rms = np.sqrt(np.mean(np.vstack(matrices)[:, 3:] ** 2, axis=0))
    share = 0.3
    measured = []
    for matrix in matrices:
        noisy = matrix.copy()
        noisy[:, 3:] += share * rms * random.normal(size=(2000, 9))
        measured.append(noisy)
    case = problem(matrices, CHI, white(2, matrices, np.full(3, 0.3)), measured=measured)
    share_seen = share * rms / np.sqrt(np.mean(np.vstack(measured)[:, 3:] ** 2, axis=0))
    one = Problem(
        case.names,
        tuple(
            RowGroup("A1", "joint", k, g.matrix, g.target, g.time_index) for k, g in enumerate(case.groups)
        ),
        0.2,
    )
    plain = OrdinaryLeastSquares().fit(one)
    levels = {f"p{k + 3}": float(share_seen[k]) for k in range(9)}
    total = TotalLeastSquares(levels, exact=r"p[012]$").fit(one)
    assert np.abs(plain.values[3:] - CHI[3:]).max() > 0.1
    assert np.abs(total.values[3:] - CHI[3:]).max() < 0.35 * np.abs(plain.values[3:] - CHI[3:]).max()
    assert np.sqrt(np.mean(((total.values - CHI) / total.std) ** 2)) < 1.6


@pytest.mark.parametrize("share", [1.0, 5.0])
def test_total_least_squares_refuses_more_column_noise_than_residual(share):
    with pytest.raises(DataError, match=r"relative_noise|leaves the torque out"):
        TotalLeastSquares(share, exact=r"p[012]$").fit(sample())


def test_instruments_remove_the_bias_of_a_noisy_regressor():
    matrices = design(samples=3000)
    random = np.random.default_rng(1)
    measured = [m + np.where(np.arange(12) < 3, 0.0, 0.5) * random.normal(size=m.shape) for m in matrices]
    case = problem(matrices, CHI, white(3, matrices), measured=measured)
    plain = WeightedLeastSquares().fit(case)
    calls = []

    def simulated(values):
        calls.append(values)
        return matrices

    instrumental = InstrumentalVariables(simulated).fit(case)
    z = (instrumental.values - CHI) / instrumental.std
    assert np.sqrt(np.mean(z**2)) < 1.6
    assert np.abs((plain.values - CHI) / plain.std).max() > 10
    assert instrumental.converged
    assert len(calls) >= 2


def test_instruments_of_the_wrong_shape_are_refused():
    with pytest.raises(DataError, match="instruments"):
        InstrumentalVariables(lambda values: [np.zeros((3, 12))] * 6).fit(sample())


def test_a_firm_prior_wins_and_a_loose_one_yields():
    case = sample()
    mean = CHI + 0.5
    prior = Prior.independent(mean, np.full(12, 0.1))
    firm = MaximumAPosteriori(prior, 1e-10).fit(case)
    loose = MaximumAPosteriori(prior, 1e10).fit(case)
    np.testing.assert_allclose(firm.values, mean, atol=1e-3)
    np.testing.assert_allclose(loose.values, CHI, atol=0.5)
    assert np.all(firm.std < loose.std)


@pytest.mark.parametrize("strength", ["evidence", "cross_validation"])
def test_the_data_choose_how_far_to_trust_the_prior(strength):
    matrices = design(samples=60)
    case = problem(matrices, CHI, white(5, matrices, np.full(3, 1.0)))
    good = MaximumAPosteriori(Prior.independent(CHI + 0.01, np.full(12, 0.3)), strength).fit(case)
    bad = MaximumAPosteriori(Prior.independent(CHI + 3.0, np.full(12, 0.3)), strength).fit(case)
    assert good.prior_scale < 0.3 < bad.prior_scale
    plain = WeightedLeastSquares().fit(case)
    assert np.linalg.norm(good.values - CHI) < np.linalg.norm(plain.values - CHI)


def test_a_prior_must_be_an_inverse_covariance():
    with pytest.raises(ConfigurationError, match="positive semi-definite"):
        Prior(np.zeros(2), np.diag([1.0, -1.0]))


def _body_problem(noise: float, seed: int = 0):
    """One body seen through a full-rank and a rank-deficient (7 of 10) random regressor."""
    random = np.random.default_rng(seed)
    truth = from_com(2.0, [0.05, -0.02, 0.1], np.diag([0.02, 0.018, 0.006]))
    projection = random.normal(size=(7, 10)) / np.array([0.05] * 6 + [0.2] * 3 + [2.0])
    matrix = random.normal(size=(300, 7))
    target = matrix @ (projection @ truth) + noise * random.normal(size=300)
    group = RowGroup("A1", "joint", 0, matrix, target, np.arange(300))
    start = from_com(1.6, [0.03, 0.0, 0.12], np.diag([0.025, 0.02, 0.01]))
    prior = BodyPrior(projection, np.arange(10)[None, :], np.zeros(0, dtype=int), start[None, :])
    return truth, projection, prior, Problem(tuple(f"p{k}" for k in range(7)), (group,), 0.2)


@pytest.mark.parametrize("metric", ["pullback", "entropic", "euclidean"])
def test_consistent_estimates_fit_and_belong_to_a_body(metric):
    truth, projection, prior, case = _body_problem(1e-3)
    estimate = PhysicallyConsistent(prior, metric).fit(case)
    assert np.linalg.eigvalsh(pseudo_inertia(estimate.standard))[0] > 0
    np.testing.assert_allclose(estimate.values, projection @ estimate.standard, rtol=1e-9)
    np.testing.assert_allclose(estimate.values, projection @ truth, atol=5e-3)


@pytest.mark.parametrize("metric", ["pullback", "entropic", "euclidean"])
def test_consistency_holds_when_the_data_ask_for_the_impossible(metric):
    _, projection, prior, case = _body_problem(1e-3)
    impossible = from_com(2.0, [0.05, -0.02, 0.1], np.diag([0.08, 0.018, 0.006]))
    group = case.groups[0]
    wrong = RowGroup("A1", "joint", 0, group.matrix, group.matrix @ projection @ impossible, group.time_index)
    estimate = PhysicallyConsistent(prior, metric, 100.0).fit(Problem(case.names, (wrong,), 0.2))
    assert np.linalg.eigvalsh(pseudo_inertia(estimate.standard))[0] > 0


def test_drives_only_dissipate():
    random = np.random.default_rng(0)
    matrix = random.normal(size=(200, 12))
    truth = np.append(from_com(2.0, [0.0, 0.0, 0.1], np.eye(3) * 0.02), [0.5, -0.2])
    group = RowGroup(
        "A1", "joint", 0, matrix, matrix @ truth + 0.001 * random.normal(size=200), np.arange(200)
    )
    prior = BodyPrior(np.eye(12), np.arange(10)[None, :], np.array([10, 11]), truth[None, :10])
    estimate = PhysicallyConsistent(prior).fit(Problem(tuple(f"p{k}" for k in range(12)), (group,), 0.2))
    assert estimate.standard[10] == pytest.approx(0.5, abs=0.05)
    assert -1e-6 < estimate.standard[11] < 1e-6


def test_an_inconsistent_prior_is_refused_and_can_be_mended():
    bad = np.array([0.01, 0, 0, 0.01, 0, 0.05, 0, 0, 0.1, 1.0])
    with pytest.raises(ConfigurationError, match="nearest_consistent"):
        BodyPrior(np.eye(10), np.arange(10)[None, :], np.zeros(0, dtype=int), bad[None, :])
    mended = nearest_consistent(bad)
    assert np.linalg.eigvalsh(pseudo_inertia(mended[0]))[0] > 0
    good = from_com(2.0, [0.05, -0.02, 0.1], np.diag([0.02, 0.018, 0.006]))
    np.testing.assert_allclose(nearest_consistent(good)[0], good, atol=1e-6)


def test_recursive_without_forgetting_is_the_batch_solution():
    case = sample()
    batch, recursive = WeightedLeastSquares().fit(case), RecursiveLeastSquares().fit(case)
    np.testing.assert_allclose(recursive.values, batch.values, atol=1e-6)
    np.testing.assert_allclose(recursive.std, batch.std, rtol=1e-3)


def test_recursive_estimates_follow_a_change():
    matrices = design(p=6, joints=3, records=1, samples=600, seed=2)
    random = np.random.default_rng(0)
    before, after = np.ones(6), np.array([1, 1, 1, 2, 1, 1.0])
    groups = []
    for k, matrix in enumerate(matrices):
        target = np.where(np.arange(600) < 300, matrix @ before, matrix @ after) + 0.05 * random.normal(
            size=600
        )
        groups.append(RowGroup(f"A{k + 1}", "joint", 0, matrix, target, np.arange(600)))
    case = Problem(tuple(f"p{k}" for k in range(6)), tuple(groups), 0.2)
    sigma = {f"A{k + 1} joint": 0.05 for k in range(3)}
    track = RecursiveLeastSquares(memory_s=10.0, sigma=sigma).track(case, every=10)
    assert track.values[28, 3] == pytest.approx(1.0, abs=0.1)
    assert track.values[-1, 3] == pytest.approx(2.0, abs=0.1)
    assert track.std.shape == (60, 6)


def test_forgetting_does_not_wind_up_without_excitation():
    recursion = RecursiveFilter.start(np.array([1.0, 2.0]), np.array([0.1, 0.1]), forgetting=0.9)
    for _ in range(2000):
        recursion.update(np.array([[1.0, 0.0]]), np.array([5.0]), 0.1)
    assert recursion.values[0] == pytest.approx(4.6, abs=0.1)
    assert recursion.values[1] == pytest.approx(2.0, abs=1e-9)
    assert np.linalg.norm(recursion.root, axis=1)[1] == pytest.approx(0.1, rel=1e-6)


def test_mixing_keeps_what_is_never_excited_and_finds_the_rest():
    matrices = [m.copy() for m in design(samples=300)]
    for matrix in matrices:
        matrix[:, 7] = 0.0
        matrix[:, 9] = 2.0 * matrix[:, 8]
    chi = CHI.copy()
    case = problem(matrices, chi, white(1, matrices))
    with pytest.raises(DataError):
        WeightedLeastSquares().fit(case)
    initial = np.full(12, 0.7)
    estimate = RegressorExtensionMixing(initial=initial).fit(case)
    for k in (7, 8, 9):
        assert estimate.values[k] == pytest.approx(0.7)
        assert f"p{k}" in estimate.notes[0]
    rest = [k for k in range(12) if k not in (7, 8, 9)]
    z = (estimate.values[rest] - chi[rest]) / estimate.std[rest]
    assert np.abs(z).max() < 4.0


def test_missing_columns_and_confused_parameters_are_named():
    matrices = [m.copy() for m in design()]
    for matrix in matrices:
        matrix[:, 5] = 0.0
    with pytest.raises(DataError, match="p5"):
        WeightedLeastSquares().fit(problem(matrices, CHI, white(0, matrices)))
    for matrix in matrices:
        matrix[:, 5] = 3.0 * matrix[:, 6]
    with pytest.raises(DataError, match="cannot tell p5, p6 apart"):
        WeightedLeastSquares().fit(problem(matrices, CHI, white(0, matrices)))


@pytest.mark.parametrize(
    "estimator",
    [
        OrdinaryLeastSquares(),
        WeightedLeastSquares(),
        RobustLeastSquares("huber"),
        TotalLeastSquares(1e-3, exact=r"p[012]$"),
    ],
    ids=lambda e: type(e).__name__,
)
def test_every_estimator_refuses_columns_that_are_sums_of_others(estimator):
    matrices = [m.copy() for m in design()]
    for matrix in matrices:
        matrix[:, 5] = 3.0 * matrix[:, 6] - matrix[:, 7]
    with pytest.raises(DataError, match="cannot tell p5, p6, p7 apart"):
        estimator.fit(problem(matrices, CHI, white(0, matrices)))


@pytest.mark.parametrize(
    "estimator",
    [
        WeightedLeastSquares(),
        RobustLeastSquares("huber"),
        TotalLeastSquares(exact=r"p[012]$"),
        RecursiveLeastSquares(memory_s=40.0),
        RegressorExtensionMixing(),
    ],
    ids=lambda e: type(e).__name__,
)
def test_a_record_may_begin_at_any_time(estimator):
    case = sample()
    later = tuple(
        RowGroup(g.joint, g.side, g.record, g.matrix, g.target, g.time_index + 37) for g in case.groups
    )
    plain, moved = estimator.fit(case), estimator.fit(Problem(case.names, later, case.sample_time_s))
    np.testing.assert_allclose(moved.values, plain.values, rtol=1e-9)
    for kind in ("textbook", "hac"):
        if kind in plain.covariances:
            np.testing.assert_allclose(moved.covariances[kind].std, plain.covariances[kind].std, rtol=1e-9)


def test_a_plot_has_each_value_in_the_middle_of_its_interval():
    estimate = WeightedLeastSquares().fit(sample())
    (axis,) = estimate.plot()
    np.testing.assert_allclose(axis.lines[0].get_xdata(), estimate.values)
    ends = np.array([segment[:, 0] for segment in axis.collections[0].get_segments()])
    np.testing.assert_allclose(ends, estimate.interval())


def test_too_few_rows_and_non_finite_rows_are_refused():
    matrices = design(samples=3, records=1)
    with pytest.raises(DataError, match=r"record a longer motion|cannot tell"):
        WeightedLeastSquares().fit(problem(matrices, CHI, white(0, matrices)))
    matrices = design()
    noise = white(0, matrices)
    noise[2][5] = np.nan
    with pytest.raises(DataError, match="non-finite"):
        WeightedLeastSquares().fit(problem(matrices, CHI, noise))


def test_rows_out_of_order_and_shapes_that_differ_are_refused():
    with pytest.raises(DataError, match="time index must increase"):
        RowGroup("A1", "joint", 0, np.ones((3, 1)), np.ones(3), np.array([0, 2, 2]))
    with pytest.raises(DataError, match="do not agree"):
        RowGroup("A1", "joint", 0, np.ones((3, 1)), np.ones(4), np.arange(4))


def test_condition_number_is_that_of_the_unweighted_stack():
    case = sample()
    stack = np.vstack([group.matrix for group in case.groups])
    assert case.condition == pytest.approx(np.linalg.cond(stack), rel=1e-9)
    assert case.require_rank() == pytest.approx(
        np.linalg.cond(stack / np.linalg.norm(stack, axis=0)), rel=1e-9
    )
