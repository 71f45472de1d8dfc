"""Estimators against their definitions, written out with dense matrices on small problems."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from fri.errors import ConfigurationError, DataError
from ident.dynamics.parameters import from_com, pseudo_inertia
from ident.estimators import (
    BodyPrior,
    CovarianceSettings,
    InstrumentalVariables,
    MaximumAPosteriori,
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
from ident.estimators.covariance import (
    Scores,
    _Blocks,
    _stationary,
    correlation_time,
    effective_rows,
    jackknife,
)
from ident.estimators.least_squares import class_variances
from ident.estimators.problem import Nuisance
from tests.ident.regression_problems import BODY, CHI, ar1, body_prior, design, noisy, problem, stack

# -- problems ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rows", [3, 40, 5000])
@pytest.mark.parametrize("order", ["C", "F"])
def test_a_factor_reproduces_rows_with_idle_columns(rows: int, order: str) -> None:
    random = np.random.default_rng(rows)
    matrix = np.zeros((rows, 6), order=order)  # type: ignore[call-overload]
    matrix[:, [1, 2, 4]] = random.normal(size=(rows, 3))
    # Seen in one row alone, off the rows looked at first.
    matrix[1, 5] = 2.0
    target = random.normal(size=rows)
    factor = TriangularFactor.of(matrix, target)
    whole = np.column_stack([matrix, target])
    assert factor.rows == rows
    assert factor.parameters == 6
    np.testing.assert_allclose(factor.r.T @ factor.r, whole.T @ whole, atol=1e-9 * rows)
    np.testing.assert_allclose(np.tril(factor.r, -1), 0.0)
    np.testing.assert_allclose(factor.normal, matrix.T @ matrix, atol=1e-9 * rows)
    assert factor.mean_square == pytest.approx(float(np.mean(target**2)))
    part = factor.select([4, 1])
    np.testing.assert_allclose(part.normal, matrix[:, [4, 1]].T @ matrix[:, [4, 1]], atol=1e-9 * rows)
    assert part.rows == rows
    values = random.normal(size=6)
    assert factor.sum_of_squares(values) == pytest.approx(float(np.sum((target - matrix @ values) ** 2)))


def test_factors_are_combined_with_their_weights_and_empty_ones_left_out() -> None:
    random = np.random.default_rng(0)
    parts = [random.normal(size=(m, 4)) for m in (7, 0, 9)]
    factors = [TriangularFactor.of(part[:, :3], part[:, 3]) for part in parts]
    assert factors[1].rows == 0
    assert TriangularFactor.of(np.ones((1, 2)), np.array([3.0])).mean_square == pytest.approx(9.0)
    assert factors[1].mean_square == 0.0
    found = TriangularFactor.combine(factors, [2.0, 5.0, 0.5])
    expected = 2.0 * parts[0].T @ parts[0] + 0.5 * parts[2].T @ parts[2]
    np.testing.assert_allclose(found.r.T @ found.r, expected, atol=1e-12)
    assert found.rows == 16


@pytest.mark.parametrize("order", ["C", "F"])
def test_rows_of_a_joint_that_nothing_moves_have_a_factor(order: str) -> None:
    target = np.arange(5.0)
    factor = TriangularFactor.of(np.zeros((5, 3), order=order), target)  # type: ignore[call-overload]
    np.testing.assert_allclose(factor.normal, np.zeros((3, 3)))
    assert factor.sum_of_squares(np.ones(3)) == pytest.approx(float(target @ target))


def test_a_constant_torque_of_zero_has_a_factor() -> None:
    matrix = np.random.default_rng(0).normal(size=(5000, 3))
    factor = TriangularFactor.of(matrix, np.zeros(5000))
    np.testing.assert_allclose(factor.solve(), np.zeros(3), atol=1e-12)
    assert factor.r[3, 3] == pytest.approx(0.0, abs=1e-9)


def test_classes_gather_the_groups_of_a_joint_and_side() -> None:
    case = noisy()
    assert [c.label for c in case.classes] == ["A1 joint", "A2 joint", "A3 joint"]
    assert [c.groups for c in case.classes] == [(0, 3), (1, 4), (2, 5)]
    assert case.class_of_group == (0, 1, 2, 0, 1, 2)
    assert case.rows == 1200
    assert repr(case) == "Problem: 1200 rows of 6 groups, 12 parameters"


def test_a_selection_keeps_rows_names_and_units() -> None:
    case = noisy()
    full = Problem(case.names, case.groups, case.sample_time_s, units=tuple(f"u{k}" for k in range(12)))
    part = full.select([7, 2])
    assert (part.names, part.units) == (("p7", "p2"), ("u7", "u2"))
    for one, other in zip(part.groups, full.groups, strict=True):
        assert np.array_equal(one.matrix, other.matrix[:, [7, 2]])
        assert one.matrix.flags.c_contiguous
    assert case.select([7, 2]).units == ()


def test_the_rank_is_lost_where_the_singular_values_say_so() -> None:
    matrices = [m.copy() for m in design()]
    random = np.random.default_rng(0)
    for matrix in matrices:
        matrix[:, 5] = matrix[:, 6] + 1e-7 * random.normal(size=len(matrix))
    barely = problem(matrices, CHI, [np.zeros(len(m)) for m in matrices])
    assert 1e6 < barely.require_rank() < 1e9
    for matrix in matrices:
        matrix[:, 5] = 2.0 * matrix[:, 6]
        matrix[:, 9] = 0.0
    lost = problem(matrices, CHI, [np.zeros(len(m)) for m in matrices])
    with pytest.raises(DataError, match="no row depends on p9;"):
        lost.require_rank()
    with pytest.raises(DataError, match="cannot tell p5, p6 apart"):
        lost.select([k for k in range(12) if k != 9]).require_rank()
    assert lost.condition > 1e15


def test_of_many_idle_parameters_twelve_are_named() -> None:
    matrix = np.zeros((40, 15))
    matrix[:, 0] = 1.0
    group = RowGroup("A1", "joint", 0, matrix, np.ones(40), np.arange(40))
    names = tuple(f"p{k}" for k in range(15))
    with pytest.raises(DataError, match=r"p1, .*, p12 and 2 more;"):
        Problem(names, (group,), 0.1).require_rank()
    part = Problem(names, (group,), 0.1).select(range(13))
    with pytest.raises(DataError, match=r"p11, p12; move"):
        part.require_rank()


def test_fewer_rows_than_parameters_are_refused() -> None:
    matrix = np.random.default_rng(0).normal(size=(4, 5))
    names = tuple(f"p{k}" for k in range(5))
    group = RowGroup("A1", "joint", 0, matrix, np.ones(4), np.arange(4))
    with pytest.raises(DataError, match="4 rows cannot determine 5 parameters"):
        Problem(names, (group,), 0.1).require_rank()
    square = RowGroup("A1", "joint", 0, np.eye(5), np.ones(5), np.arange(5))
    assert Problem(names, (square,), 0.1).require_rank() == pytest.approx(1.0)


@pytest.mark.parametrize("sample_time_s", [0.0, -1.0, np.nan])
def test_a_problem_needs_rows_names_and_time(sample_time_s: float) -> None:
    group = RowGroup("A1", "joint", 0, np.eye(2), np.ones(2), np.arange(2))
    with pytest.raises(DataError, match="must be positive"):
        Problem(("a", "b"), (group,), sample_time_s)
    with pytest.raises(DataError, match="2 columns for 1 parameter names"):
        Problem(("a",), (group,), 0.1)
    with pytest.raises(DataError, match="no rows to estimate from"):
        Problem(("a", "b"), (), 0.1)


# -- least squares -------------------------------------------------------------------------------------------


def test_ordinary_least_squares_is_the_pseudo_inverse() -> None:
    case = noisy(samples=20, records=1)
    matrix, target, _ = stack(case)
    estimate = OrdinaryLeastSquares(CovarianceSettings("textbook")).fit(case)
    values = np.linalg.lstsq(matrix, target, rcond=None)[0]
    np.testing.assert_allclose(estimate.values, values, atol=1e-10)
    residual = target - matrix @ values
    variance = residual @ residual / (60 - 12)
    np.testing.assert_allclose(
        estimate.covariance.matrix, variance * np.linalg.inv(matrix.T @ matrix), rtol=1e-8
    )
    np.testing.assert_allclose(estimate.weights, 1.0 / variance)


@pytest.mark.parametrize(
    ("loss", "tuning"), [("huber", 1.345), ("huber", 0.8), ("tukey", 4.685), ("tukey", 3.0)]
)
def test_a_robust_estimate_solves_its_equations(loss: str, tuning: float) -> None:
    case = noisy(scale=(0.3, 0.3, 0.3))
    estimate = RobustLeastSquares(loss, None if tuning in (1.345, 4.685) else tuning).fit(case)  # type: ignore[arg-type]
    matrix, target, classes = stack(case)
    u = (target - matrix @ estimate.values) * np.sqrt(estimate.weights)[classes]
    if loss == "huber":
        psi = np.clip(u, -tuning, tuning)
    else:
        psi = np.where(np.abs(u) < tuning, u * (1.0 - (u / tuning) ** 2) ** 2, 0.0)
    score = matrix.T @ (psi * np.sqrt(estimate.weights)[classes])
    size = np.abs(matrix).T @ np.sqrt(estimate.weights)[classes]
    assert np.abs(score / size).max() < 1e-5
    assert estimate.converged


@pytest.mark.parametrize(("loss", "tuning"), [("huber", 1.345), ("tukey", 4.685)])
def test_the_covariance_of_a_robust_estimate_has_the_slope_of_its_loss(loss: str, tuning: float) -> None:
    case = noisy(scale=(0.3, 0.3, 0.3))
    estimate = RobustLeastSquares(loss, covariance=CovarianceSettings("textbook")).fit(case)  # type: ignore[arg-type]
    matrix, target, classes = stack(case)
    weight = estimate.weights[classes]
    u = (target - matrix @ estimate.values) * np.sqrt(weight)

    def psi(at: np.ndarray) -> np.ndarray:
        if loss == "huber":
            return np.clip(at, -tuning, tuning)
        return np.where(np.abs(at) < tuning, at * (1.0 - (at / tuning) ** 2) ** 2, 0.0)

    slope = np.maximum((psi(u + 1e-6) - psi(u - 1e-6)) / 2e-6, 0.0)
    expected = np.mean(psi(u) ** 2) * np.linalg.inv((matrix.T * (weight * slope)) @ matrix)
    np.testing.assert_allclose(estimate.covariance.matrix, expected, rtol=1e-4, atol=1e-12)


def test_iterations_end_where_they_are_told_to() -> None:
    case = noisy()
    prior = correlated_prior()
    for estimator in (
        RobustLeastSquares("huber", iterations=1),
        MaximumAPosteriori(prior, 1.0, iterations=1),
        WeightedLeastSquares(iterations=1),
    ):
        estimate = estimator.fit(case)
        assert (estimate.iterations, estimate.converged) == (1, False)
    assert WeightedLeastSquares().fit(case).converged


# -- priors --------------------------------------------------------------------------------------------------


def tempered(estimate: object, case: Problem) -> np.ndarray:
    """Weight of each row: inverse variance times the share of independent rows of its class."""
    share = np.array([min(fit.n_eff / fit.rows, 1.0) for fit in estimate.classes])  # type: ignore[attr-defined]
    return (estimate.weights * share)[stack(case)[2]]  # type: ignore[attr-defined]


def correlated_prior() -> Prior:
    random = np.random.default_rng(4)
    root = random.normal(size=(12, 12))
    return Prior(CHI + 0.3 * random.normal(size=12), root @ root.T)


@pytest.mark.parametrize("strength", [0.5, 4.0])
def test_a_posterior_is_the_weighted_mean_of_data_and_prior(strength: float) -> None:
    case, prior = noisy(samples=40), correlated_prior()
    estimate = MaximumAPosteriori(prior, strength, iterations=60).fit(case)
    matrix, target, _ = stack(case)
    weight = tempered(estimate, case)
    information = (matrix.T * weight) @ matrix + prior.precision / strength
    values = np.linalg.solve(
        information, (matrix.T * weight) @ target + prior.precision @ prior.mean / strength
    )
    assert estimate.prior_scale == strength
    np.testing.assert_allclose(
        estimate.values, values, atol=2e-3 * np.sqrt(np.diag(np.linalg.inv(information))).max()
    )
    np.testing.assert_allclose(estimate.std, np.sqrt(np.diag(np.linalg.inv(information))), rtol=2e-3)
    assert estimate.converged
    assert f"x {np.sqrt(strength):.3g} (stated)" in estimate.notes[0]


def test_a_posterior_is_wider_by_the_effect_of_a_nuisance() -> None:
    case, prior = noisy(samples=40), correlated_prior()
    column = np.cos(0.3 * np.arange(len(case.groups[0].target)))
    beside = replace(case, nuisances=(Nuisance("delay", 0.5, {0: column}),))
    plain, wide = (MaximumAPosteriori(prior, 1.0).fit(one) for one in (case, beside))
    weight = tempered(plain, case)[: len(column)]
    shift = 0.5 * plain.covariance.matrix @ (case.groups[0].matrix.T * weight) @ column
    np.testing.assert_allclose(
        wide.covariance.matrix - plain.covariance.matrix, np.outer(shift, shift), rtol=1e-3, atol=1e-9
    )


def test_the_evidence_is_the_density_of_the_data() -> None:
    case = noisy(samples=20, records=1, scale=(1.0, 1.0, 1.0))
    prior = Prior.independent(CHI + 0.7, np.full(12, 0.3))
    estimate = MaximumAPosteriori(prior, "evidence", iterations=60).fit(case)
    matrix, target, _ = stack(case)
    noise = np.diag(1.0 / tempered(estimate, case))

    def density(scale: float) -> float:
        covariance = noise + scale * matrix @ np.linalg.inv(prior.precision) @ matrix.T
        return float(multivariate_normal(matrix @ prior.mean, covariance).logpdf(target))

    best = estimate.prior_scale
    assert best is not None
    assert 0.1 < best < 1000.0
    assert density(best) > density(1.2 * best)
    assert density(best) > density(best / 1.2)


def test_cross_validation_predicts_the_blocks_left_out() -> None:
    case = noisy(samples=30, records=1, scale=(1.0, 1.0, 1.0))
    prior = Prior.independent(CHI + 0.5, np.full(12, 0.3))
    estimate = MaximumAPosteriori(prior, "cross_validation", blocks=5, iterations=60).fit(case)
    matrix, target, _ = stack(case)
    weight = tempered(estimate, case)
    block = np.tile(np.arange(30), 3) * 5 // 30

    def error(scale: float) -> float:
        total = 0.0
        for part in range(5):
            rest, out = block != part, block == part
            information = (matrix[rest].T * weight[rest]) @ matrix[rest] + prior.precision / scale
            right = (matrix[rest].T * weight[rest]) @ target[rest] + prior.precision @ prior.mean / scale
            gap = target[out] - matrix[out] @ np.linalg.solve(information, right)
            total += float(np.sum(weight[out] * gap**2))
        return total

    best = estimate.prior_scale
    assert best is not None
    assert error(best) < error(1.3 * best)
    assert error(best) < error(best / 1.3)


def test_a_prior_serves_where_the_motion_excites_nothing() -> None:
    matrices = [m.copy() for m in design()]
    for matrix in matrices:
        matrix[:, 7] = 0.0
        matrix[:, 9] = 2.0 * matrix[:, 8]
    case = problem(matrices, CHI, [0.1 * np.cos(np.arange(len(m))) for m in matrices])
    estimate = MaximumAPosteriori(Prior.independent(CHI + 0.1, np.full(12, 0.5)), 1.0).fit(case)
    assert estimate.values[7] == pytest.approx(CHI[7] + 0.1, abs=1e-9)
    assert estimate.std[7] == pytest.approx(0.5, rel=1e-6)
    # What the data tell of the pair is told, the rest comes from the prior.
    assert estimate.values[8] + 2.0 * estimate.values[9] == pytest.approx(CHI[8] + 2.0 * CHI[9], abs=0.05)
    assert 0.2 < estimate.std[9] < 0.5


def test_a_free_parameter_without_a_column_is_zero_beside_a_prior() -> None:
    matrices = [m.copy() for m in design()]
    for matrix in matrices:
        matrix[:, 5] = 0.0
    case = problem(matrices, CHI, [0.1 * np.random.default_rng(2).normal(size=len(m)) for m in matrices])
    known = np.arange(12) == 2
    found = MaximumAPosteriori(Prior(known * CHI, np.diag(100.0 * known)), 1.0).fit(case)
    others = np.arange(12) != 5
    assert found.values[5] == pytest.approx(0.0, abs=1e-9)
    assert np.abs((found.values - CHI) / found.std)[others].max() < 4.0
    assert found.std[5] > 10.0 * found.std[others].max()


def test_an_independent_prior_has_infinite_deviations_for_free_parameters() -> None:
    prior = Prior.independent(np.array([1.0, 2.0, 3.0]), np.array([0.5, np.inf, 2.0]))
    assert prior.mean.tolist() == [1.0, 0.0, 3.0]
    np.testing.assert_allclose(prior.precision, np.diag([4.0, 0.0, 0.25]))


def test_a_prior_is_projected_onto_the_base_parameters_it_knows() -> None:
    random = np.random.default_rng(2)
    projection, mean = random.normal(size=(4, 6)), random.normal(size=6)
    root = random.normal(size=(6, 6))
    covariance = root @ root.T
    known = np.array([True, False, True, True])
    prior = Prior.projected(mean, covariance, projection, known)
    part = projection[known]
    np.testing.assert_allclose(prior.mean[known], part @ mean)
    assert prior.mean[1] == 0.0
    np.testing.assert_allclose(
        prior.precision[np.ix_(known, known)], np.linalg.inv(part @ covariance @ part.T), rtol=1e-5
    )
    assert not prior.precision[1].any()
    assert not prior.precision[:, 1].any()
    with pytest.raises(ConfigurationError, match="no prior variance"):
        Prior.projected(mean, np.zeros((6, 6)), projection, known)


def test_a_prior_of_the_wrong_size_is_refused() -> None:
    with pytest.raises(DataError, match="the prior has 3 parameters, the problem 12"):
        MaximumAPosteriori(Prior(np.zeros(3), np.eye(3))).fit(noisy())
    with pytest.raises(ConfigurationError, match=r"give \(3, 3\)"):
        Prior(np.zeros(3), np.eye(2))
    with pytest.raises(ConfigurationError, match="not finite"):
        Prior(np.zeros(1), np.array([[np.inf]]))


# -- recursive -----------------------------------------------------------------------------------------------

SIGMA = {"A1 joint": 0.05, "A2 joint": 0.3, "A3 joint": 1.0}


@pytest.mark.parametrize("memory_s", [None, 4.0])
def test_a_recursion_is_the_sum_of_its_forgotten_rows(memory_s: float | None) -> None:
    case, prior = noisy(samples=30), correlated_prior()
    estimate = RecursiveLeastSquares(memory_s, prior, sigma=SIGMA).fit(case)
    forgetting = 1.0 if memory_s is None else np.exp(-0.2 / memory_s)
    # Instants of record 0, then of record 1; the newest has age 0.
    age = 59 - np.concatenate([30 * g.record + g.time_index for g in case.groups])
    matrix, target, classes = stack(case)
    weight = forgetting**age / np.array([0.05, 0.3, 1.0])[classes] ** 2
    start = prior.precision + np.eye(12) / 1e8
    information = (matrix.T * weight) @ matrix + start
    # What is forgotten of the beginning is put in again.
    values = np.linalg.solve(information, (matrix.T * weight) @ target + prior.precision @ prior.mean)
    np.testing.assert_allclose(estimate.values, values, atol=1e-9)
    np.testing.assert_allclose(
        estimate.covariances["textbook"].matrix, np.linalg.inv(information), rtol=1e-7, atol=1e-15
    )
    np.testing.assert_allclose(estimate.weights, [400.0, 1 / 0.09, 1.0])
    assert ("time constant of 4 s" in str(estimate.notes)) == (memory_s is not None)


def test_a_track_shows_every_so_many_instants() -> None:
    case = noisy(samples=10)
    track = RecursiveLeastSquares(sigma=SIGMA).track(case, every=4)
    assert track.record.tolist() == [0, 0, 1, 1, 1]
    assert track.time_index.tolist() == [3, 7, 1, 5, 9]
    whole = RecursiveLeastSquares(sigma=SIGMA).fit(case)
    np.testing.assert_allclose(track.values[-1], whole.values, atol=1e-9)
    np.testing.assert_allclose(
        track.std[-1], np.sqrt(np.diag(whole.covariances["textbook"].matrix)), rtol=1e-9
    )


@pytest.mark.parametrize("forgetting", [0.0, -0.1, 1.1])
def test_forgetting_is_a_share(forgetting: float) -> None:
    with pytest.raises(ConfigurationError, match="must lie in"):
        RecursiveFilter(np.eye(2), forgetting)


def test_a_class_without_a_deviation_is_named() -> None:
    with pytest.raises(ConfigurationError, match="lacks 'A3 joint'"):
        RecursiveLeastSquares(sigma={"A1 joint": 1.0, "A2 joint": 1.0}).fit(noisy())


# -- mixing --------------------------------------------------------------------------------------------------


def test_mixing_follows_its_recursion() -> None:
    case = noisy(samples=40)
    initial, deviation = np.full(12, 0.2), 3.0
    estimator = RegressorExtensionMixing(
        memory_s=5.0, every=3, initial=initial, initial_std=deviation, sigma=SIGMA
    )
    estimate = estimator.fit(case)
    forgetting = np.exp(-0.2 / 5.0)
    extended, moment = np.zeros((12, 12)), np.zeros(12)
    total = np.full(12, 1.0 / deviation**2)
    moving = total * initial
    count = 0
    for record in (0, 1):
        members = [g for g in case.groups if g.record == record]
        for t in range(40):
            extended, moment = forgetting * extended, forgetting * moment
            for group, sigma in zip(members, SIGMA.values(), strict=True):
                extended = extended + np.outer(group.matrix[t], group.matrix[t]) / sigma**2
                moment = moment + group.matrix[t] * group.target[t] / sigma**2
            count += 1
            values = np.linalg.eigvalsh(extended / np.sqrt(np.outer(np.diag(extended), np.diag(extended))))
            if (count % 3 == 0 or t == 39) and values[0] > 1e-9 * values[-1]:
                inverse = np.linalg.inv(extended)
                gain = 1.0 / np.diag(inverse)
                total, moving = total + gain, moving + gain * (inverse @ moment)
    # Instants without full excitation, before the first few, have small gains.
    np.testing.assert_allclose(estimate.values, moving / total, atol=2e-3)


def test_the_covariance_of_mixing_is_that_of_a_linear_estimate() -> None:
    case = noisy(samples=12, records=2)
    estimator = RegressorExtensionMixing(memory_s=3.0, every=2, initial_std=5.0, sigma=SIGMA)
    estimate = estimator.fit(case)
    variance = [c.factor.sum_of_squares(estimate.values) / c.factor.rows for c in case.classes]
    white = np.zeros((12, 12))
    zero = np.zeros(12)
    for number, group in enumerate(case.groups):
        for row in range(len(group.target)):
            groups = list(case.groups)
            for k, other in enumerate(case.groups):
                groups[k] = RowGroup(
                    other.joint, other.side, other.record, other.matrix, np.zeros(12), other.time_index
                )
            unit = np.zeros(12)
            unit[row] = 1.0
            groups[number] = RowGroup(
                group.joint, group.side, group.record, group.matrix, unit, group.time_index
            )
            slope = estimator.fit(Problem(case.names, tuple(groups), 0.2)).values - zero
            white += variance[case.class_of_group[number]] * np.outer(slope, slope)
    # All torques zero: the initial values, zero as well.
    found = estimate.covariances["textbook"].matrix
    rest = found - white
    np.testing.assert_allclose(rest, np.diag(np.diag(rest)), atol=1e-8 * np.abs(found).max())
    assert np.all(np.diag(rest) > -1e-9 * np.diag(found))
    assert np.all(np.diag(rest) < 25.0)


# -- bodies --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("metric", ["pullback", "euclidean"])
def test_the_form_of_a_metric_is_its_definition(metric: str) -> None:
    prior = body_prior(np.array([0.2, 0.5]))  # type: ignore[arg-type]
    found = prior.hessian(metric)  # type: ignore[arg-type]
    step = np.random.default_rng(0).normal(size=22) * np.append(np.tile(np.abs(BODY) + 0.001, 2), [1.0, 1.0])
    expected = 0.0
    for number, std in enumerate((0.2, 0.5)):
        body, change = prior.inertial[number], step[10 * number : 10 * number + 10]
        if metric == "pullback":
            relative = np.linalg.solve(pseudo_inertia(body), pseudo_inertia(change))
            expected += 0.5 * np.trace(relative @ relative) / std**2
        else:
            mass = body[9]
            inertia = np.mean(np.abs(body[[0, 3, 5]]))
            sizes = np.array([inertia] * 6 + [mass * np.sqrt(inertia / mass)] * 3 + [mass])
            expected += float(np.sum((change / sizes) ** 2)) / std**2
    assert step @ found @ step == pytest.approx(expected, rel=1e-9)
    np.testing.assert_allclose(found[20:], 0.0)


@pytest.mark.parametrize("relative_std", [0.0, -0.8, np.array([0.2, np.nan])])
def test_a_prior_of_bodies_has_positive_deviations(relative_std: float) -> None:
    with pytest.raises(ConfigurationError, match="is not positive"):
        body_prior(relative_std)


def bodies_seen(prior: BodyPrior, truth: np.ndarray, noise: float, rows: int = 400) -> Problem:
    random = np.random.default_rng(3)
    scale = 1.0 / np.append(np.tile(np.abs(BODY) + 0.01, 2), [1.0, 1.0])
    matrix = random.normal(size=(rows, 22)) * scale
    target = matrix @ truth + noise * random.normal(size=rows)
    return Problem(
        tuple(f"p{k}" for k in range(22)), (RowGroup("A1", "joint", 0, matrix, target, np.arange(rows)),), 0.2
    )


@pytest.mark.parametrize("metric", ["pullback", "euclidean"])
@pytest.mark.parametrize("strength", [1.0, 0.01])
def test_within_the_possible_the_constraints_change_nothing(metric: str, strength: float) -> None:
    truth = np.concatenate([BODY, 0.55 * BODY, [0.5, 0.2]])
    prior = body_prior()
    case = bodies_seen(prior, truth, 0.1)
    free = MaximumAPosteriori(prior.prior(metric), strength).fit(case)  # type: ignore[arg-type]
    found = PhysicallyConsistent(prior, metric, strength).fit(case)  # type: ignore[arg-type]
    np.testing.assert_allclose(found.values, free.values, atol=0.02 * free.std.max(), rtol=2e-3)
    np.testing.assert_allclose(found.standard, found.values, atol=1e-12)
    assert found.notes[-1] == "0 of 2 bodies at the boundary of consistency"
    assert found.prior_scale == strength


@pytest.mark.parametrize(("best", "digits"), [(0.2, 7.0), (-0.0005, 3.0)])
def test_the_consistent_program_is_exact_whatever_its_condition(best: float, digits: float) -> None:
    """Rows that know some combinations far better than others, and the prior the rest: the minimiser, where it is
    possible, else the one with a friction of zero."""
    prior = body_prior()
    turned = np.linalg.qr(np.random.default_rng(8).normal(size=(22, 22)))[0]
    matrix = (10.0 ** np.linspace(-1.0, digits, 22))[:, None] * turned.T
    wanted = np.concatenate([1.01 * BODY, 0.5 * BODY, [0.5, best]])
    found = PhysicallyConsistent(prior).solve(1.0, matrix, matrix @ wanted)
    free = np.arange(22 if best > 0.0 else 21)
    start = np.concatenate([prior.inertial.ravel(), [0.0, 0.0]])
    hessian = matrix.T @ matrix + prior.hessian("pullback")
    slope = matrix.T @ (matrix @ (found - wanted)) + prior.hessian("pullback") @ (found - start)
    assert found[21] == pytest.approx(max(best, 0.0), abs=1e-3)
    for body in (found[:10], found[10:20]):
        assert np.linalg.eigvalsh(pseudo_inertia(body))[0] > 0.0
    # Distance from the minimiser in standard deviations.
    assert slope[free] @ np.linalg.solve(hessian[np.ix_(free, free)], slope[free]) < 1e-6


def test_at_the_boundary_the_margin_of_the_prior_is_left() -> None:
    impossible = from_com(1.0, [0.05, -0.02, 0.1], np.diag([0.05, 0.009, 0.003]))
    truth = np.concatenate([BODY, impossible, [0.5, -0.3]])
    prior = body_prior()
    for margin in (1e-3, 0.05):
        found = PhysicallyConsistent(prior, "pullback", 100.0, margin).fit(bodies_seen(prior, truth, 1e-3))
        assert found.notes[-1] == "1 of 2 bodies at the boundary of consistency"
        assert found.standard is not None
        pseudo = pseudo_inertia(0.5 * BODY)
        second = pseudo[:3, :3] - np.outer(pseudo[:3, 3], pseudo[:3, 3]) / pseudo[3, 3]
        floor = margin * np.diag([np.linalg.eigvalsh(second)[0]] * 3 + [pseudo[3, 3]])
        left = np.linalg.eigvalsh(pseudo_inertia(found.standard[10:20]) - floor)[0]
        assert left == pytest.approx(0.0, abs=1e-7)
        assert found.standard[20] == pytest.approx(0.5, abs=0.05)
        assert found.standard[21] == pytest.approx(0.0, abs=1e-6)
        residual = bodies_seen(prior, truth, 1e-3).residuals(found.values)[0]
        assert found.classes[0].rms == pytest.approx(float(np.sqrt(np.mean(residual**2))), rel=1e-6)
        assert found.classes[0].sigma > found.classes[0].rms


def test_parameters_left_out_stay_zero() -> None:
    truth = np.concatenate([BODY, 0.5 * BODY, [0.0, 0.2]])
    prior = body_prior(absent=np.array([20]), nonnegative=np.array([21]))
    found = PhysicallyConsistent(prior).fit(bodies_seen(prior, truth, 0.1))
    assert found.standard is not None
    assert found.standard[20] == pytest.approx(0.0, abs=1e-7)
    assert found.standard[21] == pytest.approx(0.2, abs=0.1)


def test_the_entropic_distance_is_the_divergence_of_its_definition() -> None:
    prior = body_prior()
    truth = np.concatenate([0.8 * BODY, 0.55 * BODY, [0.5, 0.2]])
    case = bodies_seen(prior, truth, 2.0)
    found = PhysicallyConsistent(prior, "entropic", 1.0).fit(case)
    assert found.standard is not None
    weight = found.weights[0] * min(found.classes[0].n_eff / found.classes[0].rows, 1.0)
    group = case.groups[0]

    def cost(x: np.ndarray) -> float:
        total = weight * float(np.sum((group.target - group.matrix @ x) ** 2))
        for number in range(2):
            relative = np.linalg.solve(
                pseudo_inertia(prior.inertial[number]), pseudo_inertia(x[10 * number : 10 * number + 10])
            )
            sign, log = np.linalg.slogdet(relative)
            total += (np.trace(relative) - log - 4.0) / 0.2**2 if sign > 0 else np.inf
        return total

    best = cost(found.standard)
    random = np.random.default_rng(1)
    deviation = np.linalg.norm(
        np.linalg.cholesky(np.linalg.inv(weight * group.matrix.T @ group.matrix)), axis=1
    )
    for _ in range(40):
        assert cost(found.standard + 0.1 * deviation * random.normal(size=22)) > best - 1e-3
    for step in np.diag(0.01 * deviation):
        # The slope by a standard deviation; the curvature is 2.
        assert abs(cost(found.standard + step) - cost(found.standard - step)) / 0.02 < 0.02


@pytest.mark.parametrize("margin", [1e-2, 0.2])
def test_the_nearest_consistent_body_has_its_margin(margin: float) -> None:
    flat = from_com(2.0, [0.1, 0.0, 0.2], np.diag([0.01, 0.01, 0.5]))
    (found,) = nearest_consistent(flat, margin=margin)
    # Relative to a ball of aluminium, 2700 kg/m3, of that mass.
    radius = (3.0 * 2.0 / (4.0 * np.pi * 2700.0)) ** (1.0 / 3.0)
    floor = margin * np.diag([2.0 * radius**2 / 5.0] * 3 + [2.0])
    assert np.linalg.eigvalsh(pseudo_inertia(found) - floor)[0] == pytest.approx(0.0, abs=1e-7)


def test_weights_of_a_perfect_fit_stay_finite() -> None:
    matrices = design()
    estimate = WeightedLeastSquares().fit(problem(matrices, CHI, [np.zeros(len(m)) for m in matrices]))
    assert np.all(np.isfinite(estimate.weights))
    assert np.all(estimate.std >= 0.0)


# -- errors in variables -------------------------------------------------------------------------------------


def test_instruments_solve_their_equations() -> None:
    case = noisy(samples=60)
    random = np.random.default_rng(9)
    instruments = [g.matrix + 0.3 * random.normal(size=g.matrix.shape) for g in case.groups]
    estimate = InstrumentalVariables(lambda values: instruments).fit(case)
    matrix, target, classes = stack(case)
    z = np.vstack(instruments)
    weight = estimate.weights[classes]
    bread = np.linalg.inv((z.T * weight) @ matrix)
    np.testing.assert_allclose(estimate.values, bread @ (z.T * weight) @ target, atol=1e-9)
    expected = bread @ (z.T * weight) @ z @ bread.T
    np.testing.assert_allclose(estimate.covariances["textbook"].matrix, expected, rtol=1e-7)
    assert estimate.converged


def test_instruments_are_simulated_with_the_newest_estimate_until_it_rests() -> None:
    case = noisy(samples=60)
    seen: list[np.ndarray] = []

    def simulated(values: np.ndarray) -> list[np.ndarray]:
        seen.append(values.copy())
        return [group.matrix for group in case.groups]

    estimate = InstrumentalVariables(simulated).fit(case)
    plain = WeightedLeastSquares().fit(case)
    # Instruments equal to the regressor: weighted least squares itself.
    np.testing.assert_allclose(estimate.values, plain.values, atol=1e-6)
    np.testing.assert_allclose(seen[0], plain.values, atol=1e-6)
    assert (len(seen), estimate.iterations) == (1, 1)
    never = InstrumentalVariables(simulated, tolerance=0.0, iterations=3).fit(case)
    assert (never.iterations, never.converged) == (3, False)


@pytest.mark.parametrize(
    ("instruments", "message"),
    [
        (lambda case: [g.matrix for g in case.groups][:-1], "5 instrument matrices for 6 row groups"),
        (lambda case: [g.matrix * np.nan for g in case.groups], "not finite"),
        (lambda case: [np.ones_like(g.matrix) for g in case.groups], "do not span the parameters"),
    ],
)
def test_instruments_that_cannot_serve_are_refused(instruments, message) -> None:
    case = noisy(samples=20)
    with pytest.raises(DataError, match=message):
        InstrumentalVariables(lambda values: instruments(case)).fit(case)


def one_class(seed: int, rows: int, share: float) -> tuple[Problem, np.ndarray, np.ndarray]:
    """Rows of one class; the last three of five columns are measured with errors, share times their rms."""
    random = np.random.default_rng(seed)
    true = random.normal(size=(rows, 5)) * np.array([1.0, 2.0, 1.0, 3.0, 0.5])
    chi = np.array([1.0, -1.0, 2.0, 0.5, -3.0])
    target = true @ chi + 0.2 * random.normal(size=rows)
    rms = np.sqrt(np.mean(true**2, axis=0))
    seen = true + share * rms * np.array([0, 0, 1, 1, 1]) * random.normal(size=true.shape)
    group = RowGroup("A1", "joint", 0, seen, target, np.arange(rows))
    names = ("offl1", "offm1", "XX1", "YY1", "ZZ1")
    return Problem(names, (group,), 0.2), chi, np.sqrt(np.mean(seen**2, axis=0))


def test_total_least_squares_minimises_its_criterion() -> None:
    case, chi, rms = one_class(1, 400, 0.1)
    estimate = TotalLeastSquares(0.1).fit(case)
    assert estimate.notes == ("3 columns with errors, 2 exact",)
    group = case.groups[0]
    column = 0.1 * rms * np.array([0.0, 0.0, 1.0, 1.0, 1.0])
    square = float(np.sum((group.target - group.matrix @ estimate.values) ** 2))
    # The torque's variance: what remains of the residual's without the columns' share.
    torque = square / (400 - 5) - float(np.sum((column * estimate.values) ** 2))

    def cost(x: np.ndarray) -> float:
        return float(np.sum((group.target - group.matrix @ x) ** 2) / (torque + np.sum((column * x) ** 2)))

    best = cost(estimate.values)
    for k in range(5):
        for sign in (-1.0, 1.0):
            step = np.zeros(5)
            step[k] = sign * 0.2 * estimate.std[k]
            assert cost(estimate.values + step) > best
    assert np.abs((estimate.values - chi) / estimate.std).max() < 4.0


def test_the_deviations_of_total_least_squares_are_those_of_repeated_data() -> None:
    found = [TotalLeastSquares(0.1).fit(one_class(seed, 300, 0.1)[0]) for seed in range(120)]
    scatter = np.std([estimate.values for estimate in found], axis=0)
    stated = np.mean([estimate.std for estimate in found], axis=0)
    np.testing.assert_allclose(stated / scatter, 1.0, atol=0.25)


@pytest.mark.parametrize("share", [0.03, 0.1])
def test_the_textbook_covariance_of_total_least_squares_is_the_curvature_of_its_criterion(
    share: float,
) -> None:
    case, _, rms = one_class(5, 400, share)
    estimate = TotalLeastSquares(share).fit(case)
    group = case.groups[0]
    column = share * rms * np.array([0.0, 0.0, 1.0, 1.0, 1.0])
    square = float(np.sum((group.target - group.matrix @ estimate.values) ** 2))
    torque = square / (400 - 5) - float(np.sum((column * estimate.values) ** 2))

    def cost(x: np.ndarray) -> float:
        residual = group.target - group.matrix @ (estimate.values + x)
        return 0.5 * float(residual @ residual / (torque + np.sum((column * (estimate.values + x)) ** 2)))

    steps = np.diag(1e-2 * estimate.std)
    curvature = np.array(
        [[cost(a + b) - cost(a - b) - cost(b - a) + cost(-a - b) for b in steps] for a in steps]
    ) / (4.0 * np.outer(np.diag(steps), np.diag(steps)))
    expected = np.linalg.inv(curvature)
    size = np.sqrt(np.diag(expected))
    found = estimate.covariances["textbook"].matrix
    np.testing.assert_allclose(found / np.outer(size, size), expected / np.outer(size, size), atol=5e-3)


def test_without_errors_of_the_columns_total_least_squares_has_the_covariances_of_least_squares() -> None:
    case, *_ = one_class(3, 400, 0.0)
    total, plain = TotalLeastSquares(1e-7).fit(case), WeightedLeastSquares().fit(case)
    for kind in ("textbook", "hac"):
        np.testing.assert_allclose(
            total.covariances[kind].matrix, plain.covariances[kind].matrix, rtol=1e-4, atol=1e-9
        )
    for one, other in zip(total.classes, plain.classes, strict=True):
        assert one.sigma == pytest.approx(other.sigma, rel=1e-4)


def test_column_noise_is_given_by_name_too() -> None:
    case, *_ = one_class(2, 400, 0.1)
    same = TotalLeastSquares({"XX1": 0.1, "YY1": 0.1, "ZZ1": 0.1}).fit(case)
    np.testing.assert_allclose(same.values, TotalLeastSquares(0.1).fit(case).values, atol=1e-10)
    with pytest.raises(DataError, match="given for 'XX9', not a parameter"):
        TotalLeastSquares({"XX9": 0.1}).fit(case)
    none = TotalLeastSquares(0.0).fit(case)
    np.testing.assert_allclose(none.values, WeightedLeastSquares().fit(case).values, atol=1e-10)
    assert none.notes == ("0 columns with errors, 5 exact",)


# -- covariances ---------------------------------------------------------------------------------------------


def test_scores_are_summed_over_all_rows_of_an_instant_with_gaps_as_zeros() -> None:
    random = np.random.default_rng(0)
    times = [np.array([2, 3, 5, 9]), np.array([3, 4, 9]), np.array([0, 1])]
    groups = tuple(
        RowGroup(f"A{k + 1}", "joint", int(k == 2), random.normal(size=(len(t), 2)), np.ones(len(t)), t)
        for k, t in enumerate(times)
    )
    case = Problem(("a", "b"), groups, 0.1)
    coefficients = [random.normal(size=len(t)) for t in times]
    scores = Scores.of(case, coefficients)
    first = np.zeros((8, 2))
    for group, weight in zip(groups[:2], coefficients[:2], strict=True):
        for row, t in enumerate(group.time_index):
            first[t - 2] += weight[row] * group.matrix[row]
    np.testing.assert_allclose(scores.records[0], first, atol=1e-14)
    np.testing.assert_allclose(scores.records[1], coefficients[2][:, None] * groups[2].matrix, atol=1e-14)
    assert scores.samples == 10
    other = [np.ones_like(group.matrix) for group in groups]
    replaced = Scores.of(case, coefficients, other)
    np.testing.assert_allclose(replaced.records[1], np.outer(coefficients[2], [1.0, 1.0]), atol=1e-14)


@pytest.mark.parametrize("length", [1, 3, 7])
def test_bartletts_weights_fall_linearly_with_the_lag_within_a_record(length: int) -> None:
    random = np.random.default_rng(1)
    records = tuple(random.normal(size=(n, 2)) for n in (12, 5))
    expected = np.zeros((2, 2))
    for record in records:
        for i in range(len(record)):
            for j in range(len(record)):
                expected += max(0.0, 1.0 - abs(i - j) / length) * np.outer(record[i], record[j])
    np.testing.assert_allclose(Scores(records).bartlett(length), expected, atol=1e-12)


def test_the_variance_of_stationary_residuals_is_that_of_their_toeplitz_matrix() -> None:
    random = np.random.default_rng(6)
    groups, spread = [], []
    for record, gap in enumerate((0, 7)):
        times = np.arange(200) + np.where(np.arange(200) < 120, 0, gap)
        groups.append(RowGroup("A1", "joint", record, random.normal(size=(200, 2)), np.zeros(200), times))
        spread.append(ar1(random, times[-1] + 1, 0.4)[times])
    for record, count in ((2, 0), (3, 3)):
        few = np.arange(count)
        groups.append(RowGroup("A1", "joint", record, random.normal(size=(count, 2)), np.zeros(count), few))
        spread.append(random.normal(size=count))
    case = Problem(("a", "b"), tuple(groups), 0.1)
    lagged = []
    for lag in range(60):
        pairs = [
            residual[i] * residual[j]
            for group, residual in zip(groups, spread, strict=True)
            for i, j in zip(
                *np.nonzero(np.subtract.outer(group.time_index, group.time_index) == lag), strict=True
            )
        ]
        lagged.append(float(np.mean(pairs)))
    until = next(lag for lag, value in enumerate(lagged) if abs(value) < 2.0 / np.sqrt(403) * lagged[0])
    weight = np.array(lagged[:until] + [0.0] * 300)
    expected = sum(
        group.matrix.T @ weight[np.abs(np.subtract.outer(group.time_index, group.time_index))] @ group.matrix
        for group in groups
    )
    found = _stationary(case, spread, np.array([4.0]), None)
    np.testing.assert_allclose(found, np.asarray(expected) * 403 / 399, rtol=1e-9)


def test_blocks_of_a_period_are_those_of_its_phase() -> None:
    groups = tuple(
        RowGroup("A1", "joint", record, np.ones((n, 1)), np.ones(n), np.arange(n))
        for record, n in enumerate((120, 40))
    )
    cut = _Blocks.of(Problem(("a",), groups, 0.1, periods=(40, None)), 1.0)
    assert cut.periodic
    assert cut.length == 10
    # Three periods of four blocks, and a record of its own four.
    found = [(block, rows.start, rows.stop) for block, rows in cut.runs(groups[0])]
    assert found == [(k % 4, 10 * k, 10 * k + 10) for k in range(12)]
    assert [block for block, _ in cut.runs(groups[1])] == [0, 1, 2, 3]


@pytest.mark.parametrize("block_s", [2.0, 5.0])
def test_a_jackknife_has_one_degree_of_freedom_less_than_blocks(block_s: float) -> None:
    case = noisy()
    plain = WeightedLeastSquares().fit(case)
    weights = plain.weights[list(case.class_of_group)]
    residuals = case.residuals(plain.values)
    found = jackknife(
        case,
        plain.covariances["textbook"].matrix,
        [weight * e for weight, e in zip(weights, residuals, strict=True)],
        [np.full(len(e), weight) for weight, e in zip(weights, residuals, strict=True)],
        block_s,
    )
    # Two records of 40 s.
    assert found.degrees_of_freedom == 2 * 40 / block_s - 1


def test_thinned_scores_are_sums_of_neighbours() -> None:
    record = np.arange(14.0).reshape(7, 2)
    thin = Scores((record,)).thinned(3).records[0]
    np.testing.assert_array_equal(thin, [record[:3].sum(axis=0), record[3:6].sum(axis=0), record[6]])


@pytest.mark.parametrize(
    ("autocovariance", "time"),
    [
        ([2.0, 0.0, 0.0, 0.0], 1.0),
        ([1.0, 0.5, 0.25, 0.125], 2.0 * (1.5 + 0.375) - 1.0),
        # Summed while a pair of lags is positive.
        ([1.0, 0.5, -0.3, -0.4, 0.9, 0.9], 2.0),
        ([4.0, -3.0, 1.0, 0.0], 1.0),
        ([0.0, 1.0], 1.0),
        ([1.0, 0.5, 0.25], 2.0),
    ],
)
def test_the_correlation_time_is_that_of_geyers_sequence(autocovariance: list[float], time: float) -> None:
    assert correlation_time(np.array(autocovariance)) == pytest.approx(time)


def test_effective_rows_follow_from_the_autocovariances_of_each_class() -> None:
    random = np.random.default_rng(6)
    times = [np.arange(5, 305), np.delete(np.arange(200), [20, 21, 90]), np.arange(150)]
    labels = ["A1", "A1", "A2"]
    series = [np.convolve(random.normal(size=len(t) + 9), np.ones(10) / 10.0, "valid") for t in times]
    groups = tuple(
        RowGroup(label, "joint", k, np.ones((len(t), 1)), np.ones(len(t)), t)
        for k, (label, t) in enumerate(zip(labels, times, strict=True))
    )
    found = effective_rows(Problem(("a",), groups, 0.1), series)

    def autocovariance(t: np.ndarray, values: np.ndarray) -> np.ndarray:
        full = np.zeros(t[-1] - t[0] + 1)
        full[t - t[0]] = values
        lags = min(len(full), max(64, len(full) // 3))
        return np.array([full[: len(full) - lag] @ full[lag:] for lag in range(lags)])

    one, two, three = (autocovariance(t, values) for t, values in zip(times, series, strict=True))
    both = one.copy()
    both[: len(two)] += two
    assert found[0] == pytest.approx(497 / correlation_time(both), rel=1e-9)
    assert found[1] == pytest.approx(150 / correlation_time(three), rel=1e-9)
    assert found[0] < 100


@pytest.mark.parametrize("rho", [0.3, 0.8])
def test_the_bandwidth_is_andrews_for_a_process_of_first_order(rho: float) -> None:
    scores = Scores((ar1(np.random.default_rng(0), 200_000, rho)[:, None],))
    alpha = 4.0 * rho**2 / ((1.0 - rho) ** 2 * (1.0 + rho) ** 2)
    expected = 1.1447 * (alpha * 200_000) ** (1.0 / 3.0)
    assert scores.bandwidth(np.eye(1)) == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize(("left", "refused"), [(0.9, True), (-1.0, True), (1.1, False)])
def test_a_class_needs_a_residual_for_its_variance(left: float, refused: bool) -> None:
    case = noisy(samples=20, records=1)
    consumed = np.array([2.0, 20.0 - left, 2.0])
    if refused:
        with pytest.raises(DataError, match=r"A2 joint: 20 rows for .* leave no residual"):
            class_variances(case, CHI, consumed)
    else:
        variance = class_variances(case, CHI, consumed)
        residual = case.residuals(CHI)[1]
        assert variance[1] == pytest.approx(float(residual @ residual) / 1.1)
