from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fri.errors import ConfigurationError
from ident.excitation import (
    ExcitationPlan,
    FourierBasis,
    FourierSeries,
    Objective,
    PlanProblem,
    Prior,
    assemble,
    can_bound,
    lower_bound,
)
from ident.excitation.lower_bound import LowerBound, _States
from lwr_driver.configuration import find

OBJECTIVES = [
    Objective("mean_rsd"),
    Objective("worst_rsd"),
    Objective("d_optimality"),
    Objective("condition_number"),
    Objective("condition_number", scaling="parameters"),
]


@pytest.fixture(scope="module")
def problem() -> PlanProblem:
    return PlanProblem.load("plans/default.yaml")


@pytest.fixture(scope="module")
def wrist(problem: PlanProblem) -> PlanProblem:
    """The parameters of the last drive and of the payload: a few seconds for all objectives."""
    assert not isinstance(problem.parameters, str)
    return replace(problem, parameters=tuple(name for name in problem.parameters if name[-1] in "78"))


@pytest.fixture(scope="module")
def stored() -> ExcitationPlan:
    return ExcitationPlan.load(find("plans/default.plan.yaml"))


def test_friction_of_one_drive_is_bounded_by_moving_at_full_speed_both_ways(problem: PlanProblem) -> None:
    """Fv and offset are orthogonal there, so each has the least deviation that any motion gives it."""
    names = ("Fvm7", "offm7")
    small = replace(problem, parameters=names, objective=Objective("mean_rsd"))
    assembled = assemble(small)
    setup, noise = assembled.setup, assembled.setup.estimate.noise
    assert noise is not None
    speed = setup.limits.v_max[6]
    sigma = noise.motor[6] / np.sqrt(noise.samples * len(small.sessions))
    values = assembled.criteria.rsd_mean.values
    best = np.mean(100.0 * sigma / np.array([speed, 1.0]) / values)
    bound = lower_bound(small)
    assert bound.value == pytest.approx(best, rel=0.011)
    assert bound.value <= best * (1.0 + 1e-9)
    assert bound.reached == pytest.approx(best, rel=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("objective", OBJECTIVES, ids=lambda one: f"{one.criterion}-{one.scaling}")
def test_no_motion_is_below_the_bound(
    wrist: PlanProblem, stored: ExcitationPlan, objective: Objective
) -> None:
    wanted = replace(wrist, objective=objective)
    assembled = assemble(wanted)
    bound = lower_bound(wanted)
    target = assembled.setup.target
    assert target is not None
    assert bound.criterion == target.name
    found = target.exact(assembled.view(stored.motion))
    assert bound.value <= bound.reached <= found
    assert bound.times(found) >= 1.0
    assert f"{bound.times(found):.2f} times" in bound.text(found)
    if objective.criterion in ("mean_rsd", "d_optimality"):
        assert bound.times(bound.reached) < 1.05


def test_states_hold_those_of_every_fourier_series_within_the_limits(problem: PlanProblem) -> None:
    """Inequality of Bernstein and Szegő, for the series and for its derivative."""
    setup = assemble(problem).setup
    basis, limits = setup.basis, setup.limits
    assert isinstance(basis, FourierBasis)
    states, rng = _States(setup), np.random.default_rng(3)
    for _ in range(20):
        motion = basis.motion(rng.standard_normal((7, basis.free)))
        low, high = (motion.extrema(0)[k] for k in (0, 1))
        size = np.max(np.abs([low - motion.bias, high - motion.bias]), axis=0)
        fast = np.max(np.abs(motion.extrema(1)[:2]), axis=0)
        scale = np.minimum(states.half / size, limits.v_max / fast)[:, None]
        scaled = FourierSeries(
            basis.period_s, 0.5 * (limits.q_high + limits.q_low), scale * motion.a, scale * motion.b
        )
        q, qd, qdd, _ = scaled.sample(np.linspace(0.0, basis.period_s, 2001))
        off = (q - states.middle) / states.half
        assert np.all(np.abs(off) <= 1.0 + 1e-9)
        assert np.all(
            np.abs(qd) <= states.fastest * states.half * np.sqrt(np.maximum(1.0 - off**2, 0.0)) + 1e-6
        )
        assert np.all(
            np.abs(qdd) <= states.fastest * np.sqrt(np.maximum(states.speed**2 - qd**2, 0.0)) + 1e-6
        )


def test_what_earlier_motions_told_lowers_the_bound(wrist: PlanProblem) -> None:
    again = replace(wrist, prior=(Prior(plan="plans/default.plan.yaml"),))
    assert lower_bound(again).value < 0.9 * lower_bound(wrist).value


@pytest.mark.parametrize(
    "objective", [Objective("goal_attainment"), Objective("condition_number", "columns")]
)
def test_objective_without_a_bound_is_refused(problem: PlanProblem, objective: Objective) -> None:
    assert not can_bound(objective)
    with pytest.raises(ConfigurationError, match="no lower bound"):
        lower_bound(replace(problem, objective=objective))


def test_logarithm_counts_by_the_deviation() -> None:
    assert LowerBound("D", -9.0, -8.9, True).times(-8.0) == pytest.approx(np.exp(0.5))
    assert LowerBound("mean", 2.0, 2.1).times(3.0) == 1.5
