from __future__ import annotations

import numpy as np
import pytest

from fri.errors import ConfigurationError
from ident.dynamics import parameters
from ident.dynamics.physical import _root_weight, project, reference_bodies


def bodies(count: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(count, 4, 6))
    return parameters.from_pseudo_inertia(root @ root.transpose(0, 2, 1) * 0.1)


def test_base_parameters_of_real_bodies_are_kept_exactly() -> None:
    rng = np.random.default_rng(1)
    truth, guess = bodies(3), bodies(3, 7)
    matrix = rng.normal(size=(18, 30))
    base = matrix @ truth.ravel()
    found = project(matrix, base, guess)
    assert found.exact
    assert found.worst == 0.0
    np.testing.assert_allclose(matrix @ found.bodies.ravel(), base, rtol=0, atol=1e-11)
    assert all(verdict.consistent for verdict in parameters.consistency(found.bodies))


def test_of_all_bodies_that_fit_the_one_near_the_reference_is_taken() -> None:
    reference = bodies(2)
    matrix = np.random.default_rng(2).normal(size=(12, 20))
    found = project(matrix, matrix @ reference.ravel(), reference)
    np.testing.assert_allclose(found.bodies, reference, atol=1e-9)


def test_impossible_base_parameters_give_way_by_their_own_uncertainty() -> None:
    reference = bodies(1)
    base = reference.ravel().copy()
    base[5] = -0.02
    std = np.full(10, 1e-6)
    std[5] = 0.1
    found = project(np.eye(10), base, reference, covariance=np.diag(std**2))
    assert not found.exact
    assert parameters.consistency(found.bodies)[0].consistent
    assert abs(found.shift[5]) < 10
    np.testing.assert_allclose(np.delete(found.base, 5), np.delete(base, 5), atol=1e-4)


def test_the_margin_is_kept() -> None:
    reference = bodies(1)
    base = reference.ravel().copy()
    base[9] = 0.0
    found = project(np.eye(10), base, reference, covariance=np.eye(10), margin=0.05)
    root = np.linalg.inv(np.linalg.cholesky(parameters.pseudo_inertia(reference[0])))
    relative = root @ parameters.pseudo_inertia(found.bodies[0]) @ root.T
    assert np.linalg.eigvalsh(relative)[0] > 0.05 - 1e-6


def test_reference_bodies_repairs_what_cannot_exist_and_leaves_the_rest() -> None:
    good = bodies(1)[0]
    flat = parameters.from_com(2.0, [0.1, 0.0, 0.2], np.diag([0.01, 0.01, 0.5]))
    repaired = reference_bodies([good, flat, np.zeros(10)])
    np.testing.assert_allclose(repaired[0], good, atol=1e-12)
    assert all(verdict.consistent for verdict in parameters.consistency(repaired))
    np.testing.assert_allclose(repaired[1, 6:], flat[6:], atol=1e-12)


def test_a_reference_that_cannot_exist_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="cannot exist"):
        project(np.eye(10), np.zeros(10), np.zeros((1, 10)))


def test_the_reason_names_the_body_that_cannot_exist() -> None:
    good = bodies(2)
    bad = parameters.from_com(1.0, [0.0, 0.0, 0.0], np.diag([0.01, 0.01, 0.05]))
    with pytest.raises(ConfigurationError, match=r"link 2: principal moments .* triangle inequality"):
        project(np.eye(30), np.zeros(30), np.array([good[0], bad, good[1]]))


def test_repaired_bodies_have_the_smallest_mass_and_radius_asked_for() -> None:
    (found,) = reference_bodies([np.zeros(10)], smallest_mass_kg=0.2, gyration_m=0.03)
    assert found[9] == pytest.approx(0.2)
    second = parameters.pseudo_inertia(found)[:3, :3]
    np.testing.assert_allclose(second, 0.2 * 0.03**2 * np.eye(3), atol=1e-15)
    # A mass away from the origin keeps its first moments.
    (rod,) = reference_bodies([[0, 0, 0, 0, 0, 0, 0.1, 0, 0.3, 1.0]], smallest_mass_kg=0.2, gyration_m=0.03)
    mass, com, inertia = parameters.to_com(rod)
    assert mass == 1.0
    np.testing.assert_allclose(com, [0.1, 0.0, 0.3], atol=1e-12)
    # The origin's second moment was given as zero: the repair is about the centre of mass.
    np.testing.assert_allclose(inertia, 2.0 * 0.03**2 * np.eye(3), atol=1e-12)


@pytest.mark.parametrize("size", [1e-3, 1.0, 1e3])
def test_a_direction_without_variance_is_held_to_a_millionth_of_the_scale(size: float) -> None:
    scale = np.array([2.0, 5.0, 0.0])
    root = _root_weight(scale, np.diag([size * 4.0, 0.0, size]))
    floor = max(1e-12, 1e-12 * size)
    np.testing.assert_allclose(
        root.T @ root, np.diag([1.0 / (4.0 * size), 1.0 / (25.0 * floor), 1.0 / size]), rtol=1e-9, atol=1e-12
    )
    plain = _root_weight(scale, None)
    np.testing.assert_allclose(plain, np.diag([0.5, 0.2, 1.0]))
