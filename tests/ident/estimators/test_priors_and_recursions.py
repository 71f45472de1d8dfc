"""Priors, recursions, bodies and names of the estimators by themselves, against plain formulas."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from fri.errors import ConfigurationError
from ident.dynamics.base_set import numeric_base
from ident.dynamics.parameters import from_com, pseudo_inertia
from ident.dynamics.structure import ModelStructure
from ident.estimators import (
    CovarianceSettings,
    MaximumAPosteriori,
    PhysicallyConsistent,
    Prior,
    Problem,
    RecursiveFilter,
    RecursiveLeastSquares,
    RegressorExtensionMixing,
    RobustLeastSquares,
    RowGroup,
    WeightedLeastSquares,
)
from ident.estimators.covariance import jackknife
from ident.estimators.names import SUMMARIES
from ident.estimators.physical import _compact, _of_svec, _sizes, _svec, _touching, cad_prior
from ident.estimators.prior import Disagreement
from ident.estimators.recursive import _mix, instants
from ident.estimators.registry import ESTIMATORS
from tests.ident import estimation_arm as arm
from tests.ident.regression_problems import BODY, CHI, body_prior, design, noisy, problem, stack

# -- priors --------------------------------------------------------------------------------------------------


def test_the_deviations_of_a_prior_are_those_of_its_known_parameters() -> None:
    root = np.random.default_rng(0).normal(size=(3, 3))
    covariance = root @ root.T
    precision = np.zeros((4, 4))
    known = np.array([0, 2, 3])
    precision[np.ix_(known, known)] = np.linalg.inv(covariance)
    found = Prior(np.zeros(4), precision).std
    np.testing.assert_allclose(found[known], np.sqrt(np.diag(covariance)), rtol=1e-8)
    assert found[1] == np.inf
    assert Prior(np.zeros(2), np.diag([1.0, -1e-10])).mean.tolist() == [0.0, 0.0]
    with pytest.raises(ConfigurationError, match="not positive semi-definite"):
        Prior(np.zeros(2), np.diag([1.0, -1e-8]))


def test_an_open_parameter_has_a_weak_prior_of_the_torque_in_its_rows() -> None:
    matrices = [m.copy() for m in design(samples=40)]
    for matrix in matrices:
        matrix[:, 5] = 3.0 * matrix[:, 4]
        matrix[:, 7] = 0.0
    case = problem(matrices, CHI, [0.1 * np.sin(np.arange(len(m))) for m in matrices])
    prior = Prior(np.zeros(12), np.diag(np.where(np.arange(12) == 0, 2.0, 0.0)))
    weak = np.diag(prior.completed(case).precision)
    matrix, target, classes = stack(case)
    power = np.array([np.mean(target[classes == c] ** 2) for c in range(3)])
    for k in range(1, 12):
        acting = [c for c in range(3) if np.any(matrix[classes == c, k])]
        rows = sum(int(np.sum(classes == c)) for c in acting)
        scaled = float(np.sum(matrix[:, k] ** 2 / power[classes]))
        assert weak[k] == pytest.approx(scaled / rows if rows else 1.0)
    assert weak[0] == 2.0
    whole = noisy(samples=40)
    assert prior.completed(whole) is prior


def test_a_distance_to_a_prior_is_in_units_of_prior_and_data_together() -> None:
    case = noisy(samples=40, scale=(0.3, 0.3, 0.3))
    matrix, target, classes = stack(case)
    weights = np.array([9.0, 10.0, 11.0])
    free = np.array([0, 1, 2])
    known = np.setdiff1d(np.arange(12), free)
    random = np.random.default_rng(3)
    root = random.normal(size=(9, 9))
    covariance = root @ root.T * 1e-3
    mean = CHI + np.where(np.isin(np.arange(12), known), 0.1 * random.normal(size=12), 0.0)
    precision = np.zeros((12, 12))
    precision[np.ix_(known, known)] = np.linalg.inv(covariance)
    found = Disagreement.between(
        Prior(np.where(np.isin(np.arange(12), known), mean, 0.0), precision), case, weights
    )
    data = np.linalg.inv((matrix.T * weights[classes]) @ matrix)
    values = data @ ((matrix.T * weights[classes]) @ target)
    gap = (values - mean)[known]
    together = data[np.ix_(known, known)] + covariance
    # The combinations that the data know better than the prior.
    lower = np.linalg.cholesky(covariance)
    gain, turned = np.linalg.eigh(lower.T @ np.linalg.inv(data[np.ix_(known, known)]) @ lower)
    z = (turned.T @ np.linalg.solve(lower, gap)) / np.sqrt(1.0 + 1.0 / gain)
    told = gain > 1.0
    assert found.freedom == int(told.sum())
    assert found.chi_square == pytest.approx(float(np.sum(z[told] ** 2)), rel=1e-6)
    if told.all():
        assert found.chi_square == pytest.approx(float(gap @ np.linalg.solve(together, gap)), rel=1e-6)
    assert found.p_value == pytest.approx(stats.chi2.sf(found.chi_square, found.freedom))
    std, before = np.sqrt(np.diag(data))[known], np.sqrt(np.diag(covariance))
    single = gap / np.hypot(std, before)
    expected = {case.names[k]: s for k, s, own, b in zip(known, single, std, before, strict=True) if own < b}
    assert dict(zip(found.names, found.deviations, strict=True)) == pytest.approx(expected, rel=1e-4)
    assert [abs(z) for z in found.deviations] == sorted(map(abs, found.deviations), reverse=True)
    assert found.to_dict()["freedom"] == found.freedom
    assert Disagreement(0.0, 0, (), ()).p_value == 1.0


@pytest.mark.parametrize(("factor", "scaled"), [(1.0, False), (0.5, True), (1.1, False)])
def test_a_factor_on_all_parameters_is_told_from_many_small_differences(factor: float, scaled: bool) -> None:
    random = np.random.default_rng(5)
    mean = 1.0 + random.uniform(size=12)
    chi = factor * mean * (1.0 + 0.05 * random.normal(size=12))
    case = problem(design(), chi, [0.1 * random.normal(size=len(m)) for m in design()])
    found = Disagreement.between(Prior.independent(mean, 0.2 * mean), case, np.full(3, 100.0))
    assert found.factor == pytest.approx(factor, abs=4.0 * found.factor_std)
    assert found.factor_std == pytest.approx(0.2 / np.sqrt(12), rel=0.3)
    assert (found.scaled, found.strong) == (scaled, scaled)
    assert ("in all bodies alike" in str(found)) == scaled


def test_bodies_that_the_rows_hardly_show_give_no_factor() -> None:
    case = noisy(samples=40)
    mean = 1e-20 * np.ones(12)
    found = Disagreement.between(Prior.independent(mean, np.ones(12)), case, np.full(3, 100.0))
    assert (found.factor, found.factor_std, found.scaled) == (1.0, np.inf, False)
    assert found.freedom > 0


@pytest.mark.parametrize(("left", "told"), [(0.88, False), (0.92, True)])
def test_a_parameter_with_nine_tenths_of_its_prior_deviation_left_is_from_the_prior(
    left: float, told: bool
) -> None:
    case = noisy(samples=40)
    free = np.array([0.0] * 12)
    plain = MaximumAPosteriori(Prior(CHI, np.diag(free)), 1.0).fit(case)
    # Information of data and prior add up: 1 / after^2 = 1 / before^2 + 1 / data^2.
    data_std = plain.covariances["posterior"].std[4]
    before = data_std * np.sqrt(1.0 / left**2 - 1.0)
    prior = Prior.independent(CHI, np.where(np.arange(12) == 4, before, np.inf))
    found = MaximumAPosteriori(prior, 1.0).fit(case)
    assert found.std[4] / before == pytest.approx(left, abs=0.012)
    assert found.prior_only == (("p4",) if told else ())


def test_the_defaults_of_the_estimators_are_those_documented() -> None:
    def settings(estimator: object, *names: str) -> tuple:
        return tuple(getattr(estimator, name) for name in names)

    prior = Prior(np.zeros(1), np.eye(1))
    assert settings(MaximumAPosteriori(prior), "strength", "blocks", "iterations") == ("evidence", 6, 20)
    assert settings(RecursiveLeastSquares(), "memory_s", "prior", "initial_std", "sigma") == (
        None,
        None,
        1e4,
        None,
    )
    assert settings(RegressorExtensionMixing(), "memory_s", "every", "initial", "initial_std", "sigma", "null") == (
        30.0, 5, None, 1e4, None, 1e-6,
    )  # fmt: skip
    assert settings(RobustLeastSquares(), "loss", "tuning", "iterations", "tolerance") == (
        "huber",
        None,
        100,
        1e-6,
    )
    assert settings(WeightedLeastSquares(), "iterations", "tolerance") == (50, 1e-6)
    assert settings(PhysicallyConsistent(body_prior()), "metric", "strength", "margin") == (
        "pullback",
        1.0,
        1e-3,
    )
    assert body_prior().relative_std == 0.2
    assert not MaximumAPosteriori.needs_rank
    assert not PhysicallyConsistent.needs_rank


# -- recursive -----------------------------------------------------------------------------------------------


def test_instants_come_record_after_record_in_time_with_all_their_rows() -> None:
    times = [np.array([2, 3]), np.array([3, 5]), np.array([1])]
    groups = tuple(
        RowGroup(joint, "joint", record, 10.0 * k + t[:, None], 100.0 * k + t, t)
        for k, (joint, record, t) in enumerate(zip(("A1", "A2", "A1"), (1, 1, 0), times, strict=True))
    )
    found = list(instants(Problem(("a",), groups, 0.1)))
    assert [(one.record, one.time_index) for one in found] == [(0, 1), (1, 2), (1, 3), (1, 5)]
    assert found[2].matrix.tolist() == [[3.0], [13.0]]
    assert found[2].target.tolist() == [3.0, 103.0]
    assert found[2].classes.tolist() == [0, 1]


def test_a_filter_starts_with_its_mean_and_deviation_and_returns_to_them() -> None:
    mean, std = np.array([1.0, -2.0]), np.array([0.5, 3.0])
    recursion = RecursiveFilter.start(mean, std, 0.5)
    np.testing.assert_allclose(recursion.values, mean)
    np.testing.assert_allclose(np.sqrt(np.diag(recursion.root @ recursion.root.T)), std)
    recursion.update(np.array([[1.0, 1.0]]), np.array([4.0]), 0.1)
    information = np.diag(1.0 / std**2) + np.outer([1.0, 1.0], [1.0, 1.0]) / 0.01
    np.testing.assert_allclose(np.linalg.inv(recursion.root @ recursion.root.T), information, rtol=1e-8)
    np.testing.assert_allclose(
        recursion.values, np.linalg.solve(information, mean / std**2 + np.full(2, 4.0 / 0.01)), rtol=1e-8
    )
    for _ in range(60):
        recursion.update(np.zeros((1, 2)), np.zeros(1), 1.0)
    np.testing.assert_allclose(recursion.values, mean, atol=1e-9)


def test_a_track_has_every_instant_unless_told_otherwise() -> None:
    track = RecursiveLeastSquares(sigma={f"A{k} joint": 1.0 for k in (1, 2, 3)}).track(noisy(samples=6))
    assert track.time_index.tolist() == [*range(6), *range(6)]
    assert track.record.tolist() == [0] * 6 + [1] * 6
    assert track.values.shape == track.std.shape == (12, 12)


def test_without_deviations_of_its_own_a_recursion_takes_those_of_weighted_least_squares() -> None:
    case = noisy(samples=30)
    found, plain = RecursiveLeastSquares().fit(case), WeightedLeastSquares().fit(case)
    np.testing.assert_allclose(found.weights, plain.weights)
    np.testing.assert_allclose(found.values, plain.values, atol=1e-6)
    assert found.notes == ()
    for one, other in zip(found.classes, plain.classes, strict=True):
        assert one.parameters == pytest.approx(other.parameters, rel=1e-5)


def test_the_jackknife_of_a_recursion_leaves_out_blocks_of_its_forgotten_rows() -> None:
    case = noisy(samples=30)
    sigma = np.array([0.05, 0.3, 1.0])
    by_label = dict(zip((c.label for c in case.classes), sigma, strict=True))
    settings = CovarianceSettings("jackknife", block_s=1.0)
    found = RecursiveLeastSquares(4.0, Prior(CHI, np.eye(12)), sigma=by_label, covariance=settings).fit(case)
    age = [59 - 30 * group.record - group.time_index for group in case.groups]
    weights = [
        np.exp(-0.05 * a) / sigma[number] ** 2 for a, number in zip(age, case.class_of_group, strict=True)
    ]
    expected = jackknife(
        case,
        found.covariances["textbook"].matrix,
        [w * e for w, e in zip(weights, case.residuals(found.values), strict=True)],
        weights,
        1.0,
        correlation=found.covariances["hac"].matrix,
        consumed=np.array([fit.parameters for fit in found.classes]),
    )
    np.testing.assert_allclose(found.covariance.matrix, expected.matrix, rtol=1e-6)


def test_a_long_memory_forgets_by_its_time_constant() -> None:
    case = noisy(samples=30)
    assert RecursiveLeastSquares(0.2 / np.log(2.0))._forgetting(case) == pytest.approx(0.5)
    assert RecursiveLeastSquares()._forgetting(case) == 1.0


def test_a_mixing_of_an_extended_regressor_is_its_pseudo_inverse_with_the_information_left() -> None:
    random = np.random.default_rng(0)
    rows = random.normal(size=(30, 4)) * [1.0, 100.0, 0.01, 5.0]
    extended = rows.T @ rows
    inverse, gain = _mix(extended, 1e-6)
    np.testing.assert_allclose(inverse @ extended, np.eye(4), atol=1e-8)
    np.testing.assert_allclose(gain, 1.0 / np.diag(np.linalg.inv(extended)), rtol=1e-8)
    # A parameter never excited, and two that are not told apart.
    hidden = np.zeros((6, 6))
    columns = np.column_stack(
        [rows[:, 0], rows[:, 1], 2.0 * rows[:, 1], rows[:, 2], np.zeros(30), rows[:, 3]]
    )
    hidden = columns.T @ columns
    inverse, gain = _mix(hidden, 1e-6)
    alone = rows[:, [0, 1, 2, 3]].T @ rows[:, [0, 1, 2, 3]]
    expected = 1.0 / np.diag(np.linalg.inv(alone))
    np.testing.assert_allclose(gain, [expected[0], 0.0, 0.0, expected[2], 0.0, expected[3]], rtol=1e-6)


def test_mixing_without_deviations_scales_the_rows_by_their_torque() -> None:
    case = noisy(samples=40)
    power = np.array([c.factor.mean_square for c in case.classes])
    estimate = RegressorExtensionMixing(memory_s=5.0).fit(case)
    np.testing.assert_allclose(estimate.weights, 1.0 / power)
    assert [fit.parameters for fit in estimate.classes] == [4.0] * 3
    silent = replace(
        case, groups=tuple(replace(g, target=0.0 * g.target) if g.joint == "A2" else g for g in case.groups)
    )
    weights = RegressorExtensionMixing()._weights(silent)
    assert weights[1] == pytest.approx(1e12 / power[[0, 2]].max())
    np.testing.assert_allclose(weights[[0, 2]], 1.0 / power[[0, 2]])


def test_mixing_names_what_was_never_excited() -> None:
    matrices = [m.copy() for m in design(samples=40)]
    for matrix in matrices:
        matrix[:, 7] = 0.0
    case = problem(matrices, CHI, [0.1 * np.sin(np.arange(len(m))) for m in matrices])
    estimate = RegressorExtensionMixing(memory_s=5.0, initial=np.full(12, 0.25), initial_std=2.0).fit(case)
    assert estimate.notes == ("never excited, kept at their initial values: p7",)
    assert estimate.values[7] == pytest.approx(0.25)
    assert estimate.covariances["textbook"].std[7] == pytest.approx(2.0)
    assert estimate.covariances["hac"].std[7] == pytest.approx(2.0)


# -- bodies and names ----------------------------------------------------------------------------------------


def test_the_triangle_of_a_cone_keeps_the_product_of_matrices() -> None:
    random = np.random.default_rng(0)
    a, b = (m + m.T for m in random.normal(size=(2, 4, 4)))
    assert _svec(a) @ _svec(b) == pytest.approx(float(np.trace(a @ b)))
    np.testing.assert_allclose(_svec(np.diag([1.0, 2.0, 3.0]))[[0, 2, 5]], [1.0, 2.0, 3.0])
    both = np.arange(32.0).reshape(2, 4, 4)
    both = both + both.swapaxes(1, 2)
    np.testing.assert_allclose(_of_svec(_svec(both)), both)


def test_the_size_of_a_body_is_that_of_its_mass_and_inertia() -> None:
    radius = (3.0 * 2.0 / (4.0 * np.pi * 2700.0)) ** (1.0 / 3.0)
    np.testing.assert_allclose(np.diag(_compact(2.0)), [2.0 * radius**2 / 5.0] * 3 + [2.0])
    inertia = float(np.mean(np.abs(BODY[[0, 3, 5]])))
    np.testing.assert_allclose(_sizes(BODY), [inertia] * 6 + [2.0 * np.sqrt(inertia / 2.0)] * 3 + [2.0])
    point = np.zeros(10)
    point[9] = 2.0
    # At least the inertia of a ball of aluminium.
    ball = 2.0 * 2.0 * radius**2 / 5.0
    np.testing.assert_allclose(_sizes(point), [ball] * 6 + [2.0 * np.sqrt(ball / 2.0)] * 3 + [2.0])
    assert _sizes(np.zeros(10))[9] == 1e-3


def test_a_body_touches_the_boundary_within_a_thousandth_of_its_size() -> None:
    prior = body_prior()
    inside = np.concatenate([BODY, 0.5 * BODY, [0.0, 0.0]])
    assert _touching(prior, inside, 1e-3) == 0
    flat = from_com(1.0, [0.05, -0.02, 0.1], np.diag([0.02, 0.018, 0.002]))
    assert np.linalg.eigvalsh(pseudo_inertia(flat))[0] < 1e-9
    assert _touching(prior, np.concatenate([BODY, flat, [0.0, 0.0]]), 1e-3) == 1
    assert _touching(prior, np.concatenate([flat, flat, [0.0, 0.0]]), 1e-3) == 2


def test_the_prior_of_the_arm_is_its_urdf_with_unknown_payloads() -> None:
    structure = ModelStructure(arm.chain(), payloads=("box", "tool"))
    base = numeric_base(structure)
    prior = cad_prior(base, payload_masses={"tool": 1.5})
    np.testing.assert_allclose(prior.relative_std, [0.2] * 7 + [3.0, 3.0])
    np.testing.assert_allclose(cad_prior(base, relative_std=0.4).relative_std, [0.4] * 7 + [3.0, 3.0])
    assert prior.inertial.shape == (9, 10)
    np.testing.assert_allclose(prior.inertial[7], from_com(3.0, np.zeros(3), np.eye(3) * 3.0 * 0.01))
    np.testing.assert_allclose(prior.inertial[8], from_com(1.5, np.zeros(3), np.eye(3) * 1.5 * 0.01))
    names = np.array(structure.names)
    assert [names[body[9]] for body in prior.bodies[:7]] == [f"M{k}" for k in range(1, 8)]
    assert {name[:-1] for name in names[prior.nonnegative]} == {"Ia", "Fvl", "Fcl", "Fvm", "Fcm"}
    assert not set(prior.absent) & set(prior.nonnegative)
    np.testing.assert_array_equal(prior.projection, base.matrix)
    difference = numeric_base(replace(structure, sides=("difference",), payloads=()))
    with pytest.raises(ConfigurationError, match="Model 3 has no rigid bodies"):
        cad_prior(difference)


def test_each_name_of_an_estimator_makes_it_with_its_options() -> None:
    settings = CovarianceSettings("textbook")
    made = {
        "ols": "OrdinaryLeastSquares", "wls": "WeightedLeastSquares", "huber": "RobustLeastSquares",
        "tukey": "RobustLeastSquares", "tls": "TotalLeastSquares", "recursive": "RecursiveLeastSquares",
        "mixing": "RegressorExtensionMixing", "map": "MaximumAPosteriori", "physical": "PhysicallyConsistent",
        "iv": "WeightedLeastSquares",
    }  # fmt: skip
    prior = ("prior_strength", "prior_metric", "prior_std")
    options = {
        "huber": ("tuning",), "tukey": ("tuning",), "tls": ("relative_noise",), "recursive": ("memory_s",),
        "mixing": ("memory_s",), "map": prior, "physical": prior,
    }  # fmt: skip
    assert set(ESTIMATORS) == set(made)
    for name, kind in ESTIMATORS.items():
        assert kind.summary == SUMMARIES[name]
        assert kind.options == options.get(name, ())
        assert kind.body_prior == (name in ("map", "physical"))
        given = {"prior": body_prior()} if kind.body_prior else {}
        estimator = kind.make(covariance=settings, **given)
        assert type(estimator).__name__ == made[name]
        assert estimator.covariance == settings  # type: ignore[attr-defined]
    for loss in ("huber", "tukey"):
        assert ESTIMATORS[loss].make(covariance=settings, tuning=2.0) == RobustLeastSquares(
            loss, 2.0, settings
        )  # type: ignore[arg-type]
    for name in ("map", "physical"):
        estimator = ESTIMATORS[name].make(covariance=settings, prior=body_prior())
        assert estimator.strength == 1.0  # type: ignore[attr-defined]
        other = ESTIMATORS[name].make(
            covariance=settings, prior=body_prior(), prior_strength=0.3, prior_metric="euclidean"
        )
        assert other.strength == 0.3  # type: ignore[attr-defined]
