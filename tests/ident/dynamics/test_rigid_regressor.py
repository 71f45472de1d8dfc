"""The batched regressor and inverse dynamics against pinocchio."""

import numpy as np
import pinocchio as pin
import pytest

from fri.errors import ConfigurationError, DataError
from ident.dynamics import parameters, regressor
from ident.dynamics.kinematics import Chain
from tests.ident.dynamics.core_arms import bodies, lwr, puma560, random_chain, scara, states


def pinocchio_regressor(chain: Chain, q, qd, qdd) -> np.ndarray:
    """(n, N, 10 n) in our order of parameters."""
    model = chain.to_pinocchio(bodies(chain.n))
    data = model.createData()
    rows = [pin.computeJointTorqueRegressor(model, data, *row) for row in zip(q, qd, qdd, strict=True)]
    theirs = np.array(rows).reshape(len(q), chain.n, chain.n, 10)
    return parameters.from_pinocchio(theirs).reshape(len(q), chain.n, -1).transpose(1, 0, 2)


@pytest.mark.parametrize("arm", [lwr, puma560, scara])
def test_regressor_equals_pinocchios(arm):
    chain = arm()
    q, qd, qdd = states(chain, 300)
    found = regressor.rigid_regressor(chain, q, qd, qdd)
    assert np.abs(found - pinocchio_regressor(chain, q, qd, qdd)).max() < 1e-10


@pytest.mark.parametrize("seed", range(12))
def test_regressor_of_random_chains_equals_pinocchios(seed):
    chain = random_chain(np.random.default_rng(seed), longest=7)
    q, qd, qdd = states(chain, 5, seed)
    found = regressor.rigid_regressor(chain, q, qd, qdd)
    assert np.abs(found - pinocchio_regressor(chain, q, qd, qdd)).max() < 1e-10


def test_regressor_does_not_depend_on_where_blocks_begin():
    chain = lwr()
    q, qd, qdd = states(chain, 300)
    whole = regressor.rigid_regressor(chain, q, qd, qdd)
    for part in (slice(0, 1), slice(100, 231), slice(127, 130)):
        piece = regressor.rigid_regressor(chain, q[part], qd[part], qdd[part])
        assert np.abs(piece - whole[:, part]).max() < 1e-13


def test_angles_far_from_zero_keep_full_precision():
    chain = lwr()
    q, qd, qdd = states(chain, 50)
    turns = 2 * np.pi * np.array([-1000, 3, 0, 50, 1, -2, 10000])
    near, far = (regressor.rigid_regressor(chain, x, qd, qdd) for x in (q, q + turns))
    assert np.abs(near - far).max() < 1e-9


def test_multiples_of_a_right_angle_are_exact():
    chain = Chain.from_table([{}, {"alpha": np.pi / 2}])
    q = np.stack([np.zeros(41), np.arange(-20, 21) * (np.pi / 2)], axis=1)
    gravity = regressor.gravity_torque(chain, q, [[0] * 10, [0] * 6 + [1.0, 0.0, 0.0, 0.0]])
    assert gravity[:, 1] == pytest.approx(9.81 * np.cos(q[:, 1]), abs=1e-13)


@pytest.mark.parametrize("arm", [lwr, puma560, scara])
def test_torque_equals_pinocchio_and_the_regressor(arm):
    chain = arm()
    q, qd, qdd = states(chain, 40)
    inertial = bodies(chain.n)
    model = chain.to_pinocchio(inertial)
    data = model.createData()
    expected = np.array([pin.rnea(model, data, *row) for row in zip(q, qd, qdd, strict=True)])
    found = regressor.torque(chain, q, qd, qdd, inertial)
    assert np.abs(found - expected).max() < 1e-10
    matrix = regressor.rigid_regressor(chain, q, qd, qdd)
    assert np.abs((matrix @ inertial.ravel()).T - expected).max() < 1e-10


def test_mass_matrix_and_gravity_equal_pinocchios():
    chain, inertial = scara(), bodies(4)
    q = states(chain, 6)[0]
    model = chain.to_pinocchio(inertial)
    data = model.createData()
    masses, gravities = (
        regressor.mass_matrix(chain, q, inertial),
        regressor.gravity_torque(chain, q, inertial),
    )
    for k, position in enumerate(q):
        upper = np.triu(pin.crba(model, data, position))
        assert masses[k] == pytest.approx(upper + np.triu(upper, 1).T, abs=1e-11)
        assert gravities[k] == pytest.approx(pin.computeGeneralizedGravity(model, data, position), abs=1e-11)


def test_energy_balance():
    """d/dt (kinetic + potential energy) = qd . tau, which no code of the regressor knows."""
    chain, inertial = lwr(), bodies(7)
    model = chain.to_pinocchio(inertial)
    data = model.createData()
    amplitude, phase = np.random.default_rng(1).uniform(0.5, 1.5, (2, 7))

    def energy(t: float) -> float:
        q, qd = amplitude * np.sin(t + phase), amplitude * np.cos(t + phase)
        return pin.computeKineticEnergy(model, data, q, qd) + pin.computePotentialEnergy(model, data, q)

    q, qd, qdd = amplitude * np.sin(phase), amplitude * np.cos(phase), -amplitude * np.sin(phase)
    power = float(regressor.torque(chain, q, qd, qdd, inertial)[0] @ qd)
    step = 1e-5
    assert power == pytest.approx((energy(step) - energy(-step)) / (2 * step), rel=1e-6)


@pytest.mark.parametrize("seed", range(6))
def test_any_choice_of_columns_has_the_values_of_all_columns(seed: int):
    random = np.random.default_rng(seed)
    chain = random_chain(random, longest=5)
    q, qd, qdd = states(chain, 4, seed)
    whole = regressor.rigid_regressor(chain, q, qd, qdd)
    for share in (0.2, 0.5, 0.8):
        chosen = np.flatnonzero(random.random(10 * chain.n) < share)
        places = np.full(10 * chain.n, -1)
        places[chosen] = random.permutation(len(chosen))
        # It may leave a column without a parameter.
        places[random.integers(10 * chain.n)] = len(chosen)
        part = regressor.rigid_regressor(chain, q, qd, qdd, columns=places.reshape(-1, 10))
        for column in np.flatnonzero(places >= 0):
            np.testing.assert_allclose(part[..., places[column]], whole[..., column], atol=1e-12)
        empty = np.setdiff1d(np.arange(part.shape[-1]), places)
        assert not part[..., empty].any()


def test_wanted_columns_go_where_the_map_says():
    chain = lwr()
    q, qd, qdd = states(chain, 10)
    whole = regressor.rigid_regressor(chain, q, qd, qdd)
    wanted = np.full((7, 10), -1)
    wanted[2, 6], wanted[6, 9] = 1, 0
    part = regressor.rigid_regressor(chain, q, qd, qdd, columns=wanted)
    assert part.shape == (7, 10, 2)
    assert np.array_equal(part, whole[:, :, [69, 26]])


def test_result_is_ready_for_lapack_and_a_buffer_is_reused():
    chain = lwr()
    q, qd, qdd = states(chain, 200)
    out = np.zeros((70, 7, 200))
    first = regressor.rigid_regressor(chain, q, qd, qdd, out=out)
    stacked = first.reshape(7 * 200, 70)
    assert stacked.flags.f_contiguous
    assert np.shares_memory(stacked, out)
    again = regressor.rigid_regressor(chain, q[::-1], qd[::-1], qdd[::-1], out=out)
    assert np.array_equal(again, regressor.rigid_regressor(chain, q[::-1], qd[::-1], qdd[::-1]))


def test_bad_samples_are_named():
    chain = lwr()
    q, qd, qdd = states(chain, 5)
    qd[3, 2] = np.nan
    with pytest.raises(DataError, match="`qd` of joint E1 is nan at sample 3"):
        regressor.rigid_regressor(chain, q, qd, qdd)
    with pytest.raises(DataError, match=r"expected \(samples, 7\)"):
        regressor.torque(chain, q[:, :6], q[:, :6], q[:, :6], bodies(7))
    with pytest.raises(DataError, match="must be equal"):
        regressor.torque(chain, q, q[:4], q, bodies(7))
    with pytest.raises(ConfigurationError, match=r"\(7, 10\)"):
        regressor.torque(chain, q, q, q, bodies(6))
    with pytest.raises(ConfigurationError, match="C-contiguous"):
        regressor.rigid_regressor(chain, q, q, q, out=np.zeros((70, 7, 4)))


def test_a_plain_single_sample_is_a_batch_of_one():
    chain = lwr()
    q, qd, qdd = states(chain, 20)
    inertial = bodies(7)
    torque = regressor.torque(chain, q, qd, qdd, inertial)
    whole = regressor.rigid_regressor(chain, q, qd, qdd)
    for k in range(20):
        now = q[k].copy(), qd[k].copy(), qdd[k].copy()
        assert np.array_equal(regressor.torque(chain, *now, inertial), torque[k : k + 1])
        assert np.array_equal(regressor.rigid_regressor(chain, *now), whole[:, k : k + 1])
    now[1][2] = np.inf
    with pytest.raises(DataError, match="`qd` of joint E1 is inf at sample 0"):
        regressor.torque(chain, *now, inertial)
    with pytest.raises(DataError, match="`qd` of joint E1 is inf at sample 0"):
        regressor.rigid_regressor(chain, *now)


@pytest.mark.parametrize("arm", [lwr, scara])
def test_frames_with_one_joint_elsewhere_are_those_of_the_changed_positions(arm):
    chain = arm()
    q, qd, qdd = states(chain, 20)
    at = regressor.frames(chain, q)
    before = [part.copy() for part in at]
    for joint in range(chain.n):
        moved = q.copy()
        moved[:, joint] += 0.3
        found = regressor.moved_frames(chain, at, moved[:, joint], joint)
        for one, other in zip(found, regressor.frames(chain, moved), strict=True):
            np.testing.assert_allclose(one, other, atol=1e-13)
        np.testing.assert_allclose(
            regressor.torque_in(chain, found, qd, qdd, bodies(chain.n)),
            regressor.torque(chain, moved, qd, qdd, bodies(chain.n)),
            atol=1e-10,
        )
    for one, other in zip(at, before, strict=True):
        np.testing.assert_array_equal(one, other)
