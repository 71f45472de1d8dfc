"""Columns and rows of Models 1, 2 and 3."""

import numpy as np
import pytest

from fri.errors import ConfigurationError
from ident.dynamics import regressor
from ident.dynamics.parameters import PER_LINK
from ident.dynamics.structure import Coulomb, Coupling, ModelStructure
from tests.ident.dynamics.core_arms import bodies, lwr, states, tx40


def standard(structure: ModelStructure, seed: int = 0) -> np.ndarray:
    """Random values of all columns, physically possible bodies."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=structure.n_columns)
    size = len(PER_LINK)
    for link, body in enumerate(bodies(structure.n_links, seed)):
        x[size * link : size * link + 10] = body
    return x


def expected_torques(structure, x, q, qd, qdd, payload):
    """Equations (1) to (4) written out: (joint, motor) torques (N, n)."""
    n = structure.chain.n
    table = x[: 17 * structure.n_links].reshape(-1, 17)
    inertial = table[:n, :10].copy()
    if payload is not None:
        inertial[-1] += table[structure.payload_link(payload), :10]
    ia, fvl, fcl, offl, fvm, fcm, offm = table[:n, 10:].T
    joint = regressor.torque(structure.chain, q, qd, qdd, inertial) + fvl * qd + fcl * np.sign(qd) + offl
    return joint, ia * qdd + joint + fvm * qd + fcm * np.sign(qd) + offm


@pytest.mark.parametrize("payload", [None, "load", "box"])
def test_rows_are_equations_1_to_4_in_the_documented_order(payload):
    structure = ModelStructure(lwr(), 2, payloads=("load", "box"))
    assert structure.n_columns == 9 * 17
    x = standard(structure)
    q, qd, qdd = states(structure.chain, 11)
    joint, motor = expected_torques(structure, x, q, qd, qdd, payload)
    motor_rows, joint_rows = (structure.regressor(q, qd, qdd, payload=payload) @ x).reshape(2, 7, 11)
    assert pytest.approx(motor, abs=1e-10) == motor_rows.T
    assert pytest.approx(joint, abs=1e-10) == joint_rows.T


def test_models_1_and_3_have_joint_and_difference_rows():
    q, qd, qdd = states(lwr(), 6)
    two = ModelStructure(lwr(), 2)
    x = standard(two)
    motor, joint = (two.regressor(q, qd, qdd) @ x).reshape(2, -1)
    assert ModelStructure(lwr(), 1).regressor(q, qd, qdd) @ x == pytest.approx(joint, abs=1e-12)
    assert ModelStructure(lwr(), 3).regressor(q, qd, qdd) @ x == pytest.approx(motor - joint, abs=1e-10)


def test_a_matrix_is_written_over_an_earlier_one_of_the_same_columns():
    structure = ModelStructure(lwr(), 2, payloads=("load",))
    memory = np.zeros((structure.n_columns, 2, 7, 5))
    for seed in range(2):
        q, qd, qdd = states(structure.chain, 5, seed)
        found = structure.regressor(q, qd, qdd, payload="load", out=memory)
        assert np.shares_memory(found, memory)
        np.testing.assert_array_equal(found, structure.regressor(q, qd, qdd, payload="load"))
    with pytest.raises(ConfigurationError, match="`out` has shape"):
        structure.regressor(q, qd, qdd, payload="load", out=memory[:, :, :, :4])


def test_a_payloads_columns_are_zero_where_it_is_absent():
    structure = ModelStructure(lwr(), 2, payloads=("load",))
    q, qd, qdd = states(structure.chain, 5)
    bare = structure.regressor(q, qd, qdd)
    loaded = structure.regressor(q, qd, qdd, payload="load")
    assert not bare[:, 119:].any()
    assert np.array_equal(loaded[:, 119:129], loaded[:, 102:112])
    assert loaded[:, 119:129].any(axis=0).all()


def test_selected_columns_are_those_of_the_whole_matrix():
    structure = ModelStructure(lwr(), 2, payloads=("load",))
    q, qd, qdd = states(structure.chain, 9)
    columns = [128, 120, 16, 30, 112, 119, 103]
    for sides in (("motor", "joint"), ("joint",)):
        whole = structure.regressor(q, qd, qdd, payload="load", sides=sides)
        part = structure.regressor(q, qd, qdd, payload="load", sides=sides, columns=columns)
        assert np.array_equal(part, whole[:, columns])


def test_terms_are_left_out_by_symbol_and_by_name():
    structure = ModelStructure(lwr(), 2, without=("Fvl", "offm3"))
    q, qd, qdd = states(structure.chain, 5)
    matrix = structure.regressor(q, qd, qdd)
    gone = [k for k, name in enumerate(structure.names) if name.startswith("Fvl") or name == "offm3"]
    assert np.flatnonzero(~structure.active).tolist() == gone
    assert not matrix[:, gone].any()
    with pytest.raises(ConfigurationError, match="'Fvx', not a parameter"):
        ModelStructure(lwr(), 2, without=("Fvx",))


def test_the_wrist_of_the_tx40_is_coupled():
    """Terms of FIGAROH's TX40 example: Iam6, fvm6, fcm6."""
    structure = ModelStructure(tx40(), 2, sides=("motor",), couplings=(Coupling(("q5", "q6")),))
    assert structure.names[-3:] == ("Iam6", "fvm6", "fcm6")
    q, qd, qdd = states(structure.chain, 30)
    rows = structure.regressor(q, qd, qdd)[:, -3:].reshape(6, 30, 3)
    assert not rows[:4].any()
    assert np.array_equal(rows[4, :, 0], qdd[:, 5])
    assert np.array_equal(rows[5, :, 0], qdd[:, 4])
    for joint in (4, 5):
        assert np.array_equal(rows[joint, :, 1], qd[:, 4] + qd[:, 5])
        assert np.array_equal(rows[joint, :, 2], np.sign(qd[:, 4] + qd[:, 5]))
    with pytest.raises(ConfigurationError, match="`couplings` names joint 'A9', not one of"):
        ModelStructure(lwr(), 2, couplings=(Coupling(("A1", "A9")),))


@pytest.mark.parametrize("model", [1, 2, 3])
def test_a_coupling_of_the_drives_is_not_seen_at_the_joints(model):
    structure = ModelStructure(tx40(), model, couplings=(Coupling(("q5", "q6")),))
    q, qd, qdd = states(structure.chain, 12)
    rows = structure.regressor(q, qd, qdd)[:, -3:].reshape(len(structure.sides), 6, 12, 3)
    for side, block in zip(structure.sides, rows, strict=True):
        assert block[4:].any() == (side != "joint")
        assert not block[:4].any()


@pytest.mark.parametrize(
    ("coulomb", "expected"),
    [
        (Coulomb(), [-1, -1, 0, 1, 1]),
        (Coulomb("deadband", 0.1), [-1, 0, 0, 0, 1]),
        (Coulomb("tanh", 0.1), np.tanh([-10, -0.5, 0, 0.5, 10])),
    ],
)
def test_the_sign_of_small_speeds_is_a_choice(coulomb, expected):
    assert coulomb(np.array([-1.0, -0.05, 0.0, 0.05, 1.0])) == pytest.approx(np.array(expected, dtype=float))


def test_unknown_choices_are_refused():
    with pytest.raises(ConfigurationError, match="model 4"):
        ModelStructure(lwr(), 4)
    with pytest.raises(ConfigurationError, match="not a choice of"):
        ModelStructure(lwr(), 2, sides=("motors",))
    with pytest.raises(ConfigurationError, match="repeat"):
        ModelStructure(lwr(), 2, payloads=("a", "a"))
    with pytest.raises(ConfigurationError, match=r"width 0\.0 must be positive"):
        Coulomb("tanh")
    structure = ModelStructure(lwr(), 1, payloads=("load",))
    q = states(structure.chain, 2)[0]
    with pytest.raises(ConfigurationError, match=r"payload 'laod' is not in this model \(payloads: load\)"):
        structure.regressor(q, q, q, payload="laod")
    with pytest.raises(ConfigurationError, match="not a choice of joint"):
        structure.regressor(q, q, q, sides=("motor",))
    with pytest.raises(ConfigurationError, match="did you mean 'ZZ2'"):
        structure.index("ZZ2R")


def test_units_of_all_columns():
    structure = ModelStructure(tx40(), 2, payloads=("p",), couplings=(Coupling(("q5", "q6")),))
    units = dict(zip(structure.names, structure.units, strict=True))
    assert units["Iam6"] == "kg m^2"
    assert units["fvm6"] == "Nm s/rad"
    assert units["M7"] == "kg"


def test_signals_are_written_over_whatever_was_there():
    structure = ModelStructure(tx40(), 2, couplings=(Coupling(("q2", "q5")),))
    _, qd, qdd = states(structure.chain, 4)
    out = np.full((structure.n_signals, 6, 4), np.nan)
    structure.signals(qd, qdd, out)
    expected = np.zeros((7, 6, 4))
    expected[:4] = qdd.T, qd.T, np.sign(qd).T, np.ones((6, 4))
    expected[4, 1], expected[4, 4] = qdd[:, 4], qdd[:, 1]
    expected[5, [1, 4]] = qd[:, 1] + qd[:, 4]
    expected[6, [1, 4]] = np.sign(qd[:, 1] + qd[:, 4])
    np.testing.assert_array_equal(out, expected)


@pytest.mark.parametrize("columns", [[-1], [119], [[1]]])
def test_columns_outside_the_matrix_are_refused(columns):
    structure = ModelStructure(lwr(), 2)
    q = np.zeros((2, 7))
    with pytest.raises(ConfigurationError, match="indices below 119"):
        structure.regressor(q, q, q, columns=columns)


def test_a_column_can_be_asked_for_twice():
    structure = ModelStructure(lwr(), 2)
    q, qd, qdd = states(structure.chain, 3)
    whole = structure.regressor(q, qd, qdd)
    columns = [30, 9, 30, 11, 118]
    assert np.array_equal(structure.regressor(q, qd, qdd, columns=columns), whole[:, columns])


def test_conditions_and_payloads_are_counted_after_the_links():
    structure = ModelStructure(lwr(), 2, payloads=("a", "b"))
    assert [structure.payload_link(name) for name in (None, "a", "b")] == [None, 7, 8]
    assert [condition.payload for condition in structure.conditions()] == [None, "a", "b"]
    assert structure.n_links == 9
    assert structure.rigid_of(17 * 7 + 3, "a") == (6, 3)
    assert structure.rigid_of(17 * 7 + 3, "b") is None
    assert structure.rigid_of(17 * 8 + 9, "b") == (6, 9)
    assert structure.rigid_of(17 * 7 + 10, "a") is None
    assert structure.rigid_of(17 * 2 + 4, None) == (2, 4)


def test_sides_are_put_in_order_and_given_once():
    assert ModelStructure(lwr(), 2, sides=("joint", "motor")).sides == ("motor", "joint")
    with pytest.raises(ConfigurationError, match="not a choice of"):
        ModelStructure(lwr(), 2, sides=("joint", "joint"))
