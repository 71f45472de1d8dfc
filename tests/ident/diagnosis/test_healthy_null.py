"""What healthy sets teach: lengths of presliding, and what a further healthy set stays below."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ident.diagnosis.commission import delay_std, with_far_presliding
from ident.diagnosis.nominal import NominalArm
from ident.diagnosis.reference import DELAY_STD_S, Reference
from ident.dynamics.base_set import numeric_base
from ident.dynamics.kinematics import Chain
from ident.dynamics.structure import ModelStructure
from ident.model import DynamicModel


def reference(model: DynamicModel, null: dict[tuple[str, int], float], sets: int) -> Reference:
    return Reference(model, np.zeros(3), 0.0, 0.0, {}, null, sets, habits=True)


@pytest.fixture(scope="module")
def model(chain: Chain) -> DynamicModel:
    structure = ModelStructure(chain, 1)
    base = numeric_base(structure)
    return DynamicModel("arm", structure, base.names, np.ones(len(base)), None, base)


@pytest.fixture
def arm(chain: Chain) -> NominalArm:
    return NominalArm(chain, np.zeros(3), np.ones(3), presliding=np.full(3, 2e-4))


def days(rng: np.random.Generator, mean: float, scatter: float, count: int) -> list[np.ndarray]:
    """Friction that turns slowly (2, 3 distances, 3 joints), each day with a standard deviation of 0.02 Nm."""
    return [
        np.stack([mean + scatter * rng.standard_normal((3, 3)), np.full((3, 3), 0.02)]) for _ in range(count)
    ]


def test_slow_friction_that_the_sets_agree_on_belongs_to_the_arm(arm: NominalArm) -> None:
    found = with_far_presliding(arm, days(np.random.default_rng(1), 0.1, 0.02, 8), [np.full(3, 4.0)] * 8)
    assert found.far_share is not None
    assert found.far is not None
    assert found.far_share == pytest.approx(np.full(3, 0.1 / 4.0), rel=0.3)
    assert np.all(found.far > 3.0 * 2e-4)


def test_slow_friction_that_comes_and_goes_does_not(arm: NominalArm) -> None:
    coulomb = [np.full(3, 4.0)] * 8
    found = with_far_presliding(arm, days(np.random.default_rng(2), 0.0, 0.2, 8), coulomb)
    against = with_far_presliding(arm, days(np.random.default_rng(2), -0.1, 0.02, 8), coulomb)
    for other in (found, against):
        assert other.far_share is not None
        assert np.all(other.far_share == 0.0)
    assert with_far_presliding(arm, days(np.random.default_rng(3), 0.1, 0.0, 2), coulomb[:2]) is arm


def test_friction_turns_partly_within_the_longer_distance(arm: NominalArm) -> None:
    both = replace(arm, far=np.full(3, 1e-2), far_share=np.full(3, 0.3))
    speed = np.repeat(np.where(np.arange(2000) < 1000, 0.1, -0.1)[:, None], 3, axis=1)
    slip = both.slip(speed, 1e-3)
    # Five short reaches after the reversal the rest has turned, and of the slow share a tenth of the way.
    after = 999 + round(1e-3 / 1e-4)
    wanted = -0.7 * (1.0 - 2.0 * np.exp(-5.0)) + 0.3 * (-1.0 + 2.0 * np.exp(-0.1))
    assert slip[after, 0] == pytest.approx(wanted, abs=0.01)


def test_a_further_healthy_set_seldom_exceeds_its_limit(model: DynamicModel) -> None:
    """Deviations that differ from set to set, squared: of the limits from eight sets one in a hundred is broken."""
    rng = np.random.default_rng(4)
    broken = 0
    for _ in range(400):
        gains = 20.0 * rng.standard_normal((9, 7)) ** 2
        null = {("presliding_hysteresis", j): float(gains[:8, j].mean()) for j in range(7)}
        null |= {("stribeck", j): 1.0 for j in range(10)}
        limits = reference(model, null, 8).limits()
        broken += sum(gains[8, j] > limits["presliding_hysteresis", j] for j in range(7))
    assert broken / (400 * 7) < 0.02


def test_few_sets_ask_for_more(model: DynamicModel) -> None:
    null = {("stribeck", 0): 1.0, ("stribeck", 1): 1.0, ("backlash", 0): 12.0}
    limits = [reference(model, null, sets).limits()["backlash", 0] for sets in (1, 4, 20)]
    assert limits[0] > limits[1] > limits[2] > 12.0
    assert reference(model, {}, 0).limits() == {}


def test_scatter_of_a_delay_between_days_is_learned() -> None:
    rng = np.random.default_rng(5)
    late = [(1e-3 + value, 1e-4) for value in rng.normal(0.0, np.hypot(5e-4, 1e-4), 200)]
    assert delay_std(late) == pytest.approx(5e-4, rel=0.1)
    steady = [(1e-3 + value, 1e-4) for value in rng.normal(0.0, 1e-4, 200)]
    assert delay_std(steady) < 0.5 * DELAY_STD_S
    # One day says nothing of other days: what is usual, about a value that has that scatter itself.
    assert delay_std([(3e-3, 1e-4)]) == pytest.approx(np.sqrt(2.0) * DELAY_STD_S)


def test_loosened_parameters_are_less_tied_and_no_others(chain: Chain) -> None:
    structure = ModelStructure(chain, 2)
    base = numeric_base(structure)
    count = len(base)
    model = DynamicModel("arm", structure, base.names, np.full(count, 2.0), 1e-6 * np.eye(count), base)
    healthy = reference(model, {}, 8)
    tied, loose = healthy.prior(base), healthy.loosened("Ia", 0.05).prior(base)
    assert tied is not None
    assert loose is not None
    std = [1.0 / np.sqrt(np.diag(precision)) for precision, _ in (tied, loose)]
    inertias = np.array([name.startswith("Ia") for name in base.names])
    assert inertias.any()
    assert std[1][inertias] == pytest.approx(np.full(inertias.sum(), 1.5 * 0.1), rel=0.01)
    np.testing.assert_allclose(std[1][~inertias], std[0][~inertias])
    np.testing.assert_array_equal(loose[1], tied[1])
