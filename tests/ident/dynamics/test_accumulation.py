"""Least-squares data of a stream equal those of the whole matrix."""

import numpy as np
import pytest

from fri.errors import ConfigurationError, DataError
from ident.accumulation import Accumulation, solve_normal
from ident.base import numeric_base
from ident.structure import Condition, Coupling, ModelStructure, Samples
from tests.ident.dynamics.core_arms import lwr, states, tx40

FACTORS = pytest.mark.parametrize("factor", ["gram", "qr"])


def session(structure, samples, seed, *, payload=None, motor=True, joint=True) -> Samples:
    rng = np.random.default_rng(seed)
    tau = rng.normal(size=(2, samples, structure.chain.n))
    q, qd, qdd = states(structure.chain, samples, seed)
    return Samples(q, qd, qdd, tau[0] if motor else None, tau[1] if joint else None, payload)


def pieces(samples: Samples, sizes: list[int]) -> list[Samples]:
    ends = np.cumsum([0, *sizes])

    def part(array, k):
        return None if array is None else array[ends[k] : ends[k + 1]]

    return [
        Samples(
            *(part(getattr(samples, name), k) for name in ("q", "qd", "qdd", "motor", "joint")),
            samples.payload,
        )
        for k in range(len(sizes))
    ]


@pytest.fixture(scope="module")
def structure():
    return ModelStructure(lwr(), 2, payloads=("load",))


@pytest.fixture(scope="module")
def base(structure):
    return numeric_base(structure)


@FACTORS
def test_every_joint_and_side_equals_its_rows_of_the_whole_matrix(structure, base, factor):
    sessions = [session(structure, 150, 1), session(structure, 230, 2, payload="load", motor=False)]
    accumulation = Accumulation(structure, base.columns, factor=factor)
    for number, whole in enumerate(sessions):
        for piece in pieces(whole, [100, len(whole.q) - 100]):
            accumulation.add(piece, session=number)
    matrix = structure.stack(sessions, columns=base.columns)
    torque = np.concatenate([structure.torques(s) for s in sessions])
    described = [(Condition(), 150), (Condition("load", ("joint",)), 230)]
    for block in structure.row_blocks(described):
        w, y = matrix[block.rows], torque[block.rows]
        normal = accumulation.normal(block.side, block.joint, block.session)
        assert normal.rows == len(y)
        assert np.abs(normal.gram - w.T @ w).max() < 1e-9
        assert np.abs(normal.moment - w.T @ y).max() < 1e-9
        assert normal.square == pytest.approx(y @ y)
        triangle, rows = accumulation.triangle(block.side, block.joint, block.session)
        both = np.column_stack([w, y])
        assert rows == len(y)
        assert triangle.shape == (103, 103)
        assert np.abs(triangle.T @ triangle - both.T @ both).max() < 1e-9


@FACTORS
def test_weighted_least_squares_from_parts_equals_the_whole(structure, base, factor):
    sessions = [session(structure, 120, 3), session(structure, 140, 4, payload="load")]
    accumulation = Accumulation(structure, base.columns, factor=factor)
    for number, samples in enumerate(sessions):
        accumulation.add(samples, session=number)
    rng = np.random.default_rng(0)
    weight = {(side, joint): rng.uniform(0.1, 10.0) for side in structure.sides for joint in range(7)}
    parts = [accumulation.normal(side, joint) for side, joint in weight]
    found, covariance = solve_normal(parts, list(weight.values()))
    matrix = structure.stack(sessions, columns=base.columns)
    torque = np.concatenate([structure.torques(s) for s in sessions])
    root = np.zeros(len(torque))
    blocks = list(structure.row_blocks([(Condition(), 120), (Condition("load"), 140)]))
    for block in blocks:
        root[block.rows] = np.sqrt(weight[block.side, block.joint])
    expected = np.linalg.lstsq(matrix * root[:, None], torque * root, rcond=None)[0]
    assert found == pytest.approx(expected, abs=1e-9)
    weighted = matrix * root[:, None]
    assert covariance == pytest.approx(np.linalg.inv(weighted.T @ weighted), rel=1e-6, abs=1e-12)
    motor = np.concatenate(
        [np.arange(len(torque))[b.rows] for b in blocks if (b.side, b.joint) == ("motor", 3)]
    )
    residual = torque[motor] - matrix[motor] @ found
    assert parts[3].sum_of_squares(found) == pytest.approx(residual @ residual)


def test_triangular_factors_see_residuals_that_gram_matrices_cannot():
    structure = ModelStructure(lwr(), 1)
    base = numeric_base(structure)
    samples = session(structure, 400, 5, motor=False)
    values = np.random.default_rng(1).normal(size=len(base))
    exact = structure.regressor(samples.q, samples.qd, samples.qdd, columns=base.columns) @ values
    clean = Samples(samples.q, samples.qd, samples.qdd, joint=exact.reshape(7, -1).T)
    accumulation = Accumulation(structure, base.columns, factor="qr")
    accumulation.add(clean)
    residual = [
        np.linalg.norm(accumulation.triangle("joint", joint)[0] @ np.append(-values, 1.0))
        for joint in range(7)
    ]
    assert max(residual) < 1e-11 * np.linalg.norm(exact)


def test_filtered_atoms_are_filtered_rows(structure, base):
    """Atoms averaged in pairs, with the torques, give the least-squares data of the averaged rows."""
    samples = session(structure, 200, 6, payload="load")

    def halved(array):
        return 0.5 * (array[..., ::2] + array[..., 1::2])

    accumulation = Accumulation(structure, base.columns)
    atoms = halved(accumulation.atoms(samples.q, samples.qd, samples.qdd))
    torques = Samples(
        samples.q[::2],
        samples.qd[::2],
        samples.qdd[::2],
        halved(samples.motor.T).T,
        halved(samples.joint.T).T,
        "load",
    )
    accumulation.add_atoms(atoms, torques)
    w = structure.regressor(samples.q, samples.qd, samples.qdd, payload="load", columns=base.columns)
    w = halved(w.reshape(14, 200, -1).transpose(0, 2, 1))
    normal = accumulation.normal("joint", 4)
    assert normal.rows == 100
    assert normal.gram == pytest.approx(w[11] @ w[11].T, abs=1e-9)
    assert normal.moment == pytest.approx(w[11] @ torques.joint[:, 4], abs=1e-9)


def test_difference_rows_and_coupled_joints():
    structure = ModelStructure(tx40(), 3, couplings=(Coupling(("q5", "q6")),))
    base = numeric_base(structure)
    samples = session(structure, 90, 7)
    accumulation = Accumulation(structure, base.columns)
    accumulation.add(samples)
    matrix = structure.regressor(samples.q, samples.qd, samples.qdd, columns=base.columns).reshape(6, 90, -1)
    for joint in range(6):
        normal = accumulation.normal("difference", joint)
        y = samples.motor[:, joint] - samples.joint[:, joint]
        assert normal.gram == pytest.approx(matrix[joint].T @ matrix[joint], abs=1e-9)
        assert normal.moment == pytest.approx(matrix[joint].T @ y, abs=1e-9)
        assert normal.square == pytest.approx(y @ y)


def test_a_side_that_was_not_measured_has_no_rows(structure, base):
    accumulation = Accumulation(structure, base.columns)
    accumulation.add(session(structure, 20, 8, motor=False))
    assert accumulation.normal("motor", 0).rows == 0
    assert accumulation.triangle("motor", 0)[1] == 0
    with pytest.raises(ConfigurationError, match="no session 3"):
        accumulation.normal("joint", 0, 3)


def test_sessions_keep_their_payload_and_channels(structure, base):
    accumulation = Accumulation(structure, base.columns)
    accumulation.add(session(structure, 20, 9))
    with pytest.raises(DataError, match="session 0 changes its payload"):
        accumulation.add(session(structure, 20, 9, payload="load"))
    with pytest.raises(DataError, match="session 0 changes its payload or its channels"):
        accumulation.add(session(structure, 20, 9, motor=False))


def test_bad_torques_are_named(structure, base):
    accumulation = Accumulation(structure, base.columns)
    samples = session(structure, 20, 10)
    samples.motor[7, 4] = np.inf
    with pytest.raises(DataError, match="motor torque of joint A4 is not finite at sample 7"):
        accumulation.add(samples)
    short = session(structure, 20, 11)
    with pytest.raises(DataError, match=r"joint torque has shape \(19, 7\)"):
        accumulation.add(Samples(short.q, short.qd, short.qdd, short.motor, short.joint[:19]))
    with pytest.raises(DataError, match="atoms have shape"):
        accumulation.add_atoms(np.zeros((3, 7, 20)), short)
    with pytest.raises(ConfigurationError, match="neither `gram` nor `qr`"):
        Accumulation(structure, base.columns, factor="lu")


def test_singular_normal_equations_are_reported(structure):
    accumulation = Accumulation(structure, np.arange(20))
    accumulation.add(session(structure, 50, 12))
    with pytest.raises(DataError, match="singular"):
        solve_normal([accumulation.normal("joint", 0)], [1.0])
