"""Names, units and the algebra of a body's ten inertial parameters."""

import numpy as np
import pinocchio as pin
import pytest

from fri.errors import ConfigurationError
from ident.dynamics import parameters
from tests.ident.dynamics.core_arms import bodies


def pose(seed: int) -> np.ndarray:
    return pin.SE3.Random().homogeneous if seed is None else _pose(np.random.default_rng(seed))


def _pose(rng: np.random.Generator) -> np.ndarray:
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    rotation *= np.sign(np.linalg.det(rotation))
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, rng.normal(size=3)
    return matrix


def test_names_are_seventeen_a_link_in_the_literatures_order():
    names = parameters.parameter_names(8)
    assert len(names) == 136
    assert names[:11] == ("XX1", "XY1", "XZ1", "YY1", "YZ1", "ZZ1", "MX1", "MY1", "MZ1", "M1", "Ia1")
    assert names[-7:] == ("Ia8", "Fvl8", "Fcl8", "offl8", "Fvm8", "Fcm8", "offm8")


def test_split_name_tells_symbol_link_and_regrouping():
    assert parameters.split_name("ZZ2R") == ("ZZ", 2, True)
    assert parameters.split_name("offl12") == ("offl", 12, False)
    with pytest.raises(ConfigurationError, match="ZZ2R"):
        parameters.split_name("2ZZ")


def test_units_follow_the_kind_of_the_joint():
    assert parameters.unit("XX1") == "kg m^2"
    assert parameters.unit("Fvm3") == "Nm s/rad"
    assert parameters.unit("fcm6") == "Nm"
    assert parameters.unit("offl3", prismatic=True) == "N"
    assert parameters.unit("Iam6") == "kg m^2"
    assert parameters.unit("Ia2", prismatic=True) == "kg"


def test_centre_of_mass_form_goes_both_ways():
    body = bodies(5)
    assert parameters.from_com(*parameters.to_com(body)) == pytest.approx(body, abs=1e-13)


def test_first_moments_without_mass_have_no_centre():
    with pytest.raises(ConfigurationError, match="no mass"):
        parameters.to_com([0, 0, 0, 0, 0, 0, 1.0, 0, 0, 0])


@pytest.mark.parametrize("seed", range(4))
def test_change_of_frame_equals_pinocchio(seed):
    body, placement = bodies(1, seed)[0], pose(seed)
    mass, com, inertia = parameters.to_com(body)
    moved = pin.SE3(placement).act(pin.Inertia(float(mass), com, inertia))
    expected = parameters.from_pinocchio(moved.toDynamicParameters())
    assert parameters.transform(body, placement) == pytest.approx(expected, abs=1e-12)
    assert parameters.frame_change(placement) @ body == pytest.approx(expected, abs=1e-12)


def test_change_of_frame_and_back_is_the_identity():
    placement = pose(3)
    there = parameters.transform(bodies(3), placement)
    assert parameters.transform(there, np.linalg.inv(placement)) == pytest.approx(bodies(3), abs=1e-12)


def test_pseudo_inertia_goes_both_ways_and_equals_pinocchio():
    body = bodies(1, 7)[0]
    matrix = parameters.pseudo_inertia(body)
    mass, com, inertia = parameters.to_com(body)
    expected = pin.PseudoInertia.FromInertia(pin.Inertia(float(mass), com, inertia)).toMatrix()
    assert matrix == pytest.approx(expected, abs=1e-12)
    assert parameters.from_pseudo_inertia(matrix) == pytest.approx(body, abs=1e-13)


def test_pinocchio_order_goes_both_ways():
    body = np.arange(10.0)
    assert parameters.to_pinocchio(body).tolist() == [9, 6, 7, 8, 0, 1, 3, 2, 4, 5]
    assert parameters.from_pinocchio(parameters.to_pinocchio(body)).tolist() == body.tolist()


def test_real_bodies_are_consistent():
    assert all(verdict.consistent for verdict in parameters.consistency(bodies(6)))


@pytest.mark.parametrize(
    ("body", "reason"),
    [
        ([1, 0, 0, 1, 0, 1, 0, 0, 0, 0.0], "mass"),
        ([1, 0, 0, -1, 0, 1, 0, 0, 0, 1.0], "negative"),
        ([1, 0, 0, 1, 0, 3, 0, 0, 0, 1.0], "triangle"),
        ([1, 0, 0, 1, 0, 1, 5, 0, 0, 1.0], "negative"),
    ],
)
def test_impossible_bodies_are_named_with_the_reason(body, reason):
    (verdict,) = parameters.consistency(np.array(body), ["link 4"])
    assert not verdict.consistent
    assert reason in verdict.reason
    assert verdict.reason.startswith("link 4")


def test_wrong_shape_names_the_ten():
    with pytest.raises(ConfigurationError, match="XX XY XZ"):
        parameters.transform(np.zeros(9), np.eye(4))


def test_a_verdict_has_mass_principal_moments_and_the_smallest_eigenvalue():
    rotation = _pose(np.random.default_rng(5))[:3, :3]
    moments = np.array([0.01, 0.02, 0.025])
    body = parameters.from_com(2.0, [0.1, -0.2, 0.3], rotation @ np.diag(moments) @ rotation.T)
    (verdict,) = parameters.consistency(body)
    assert verdict.consistent
    assert (verdict.link, verdict.mass, verdict.reason) == ("link 1", 2.0, "")
    assert verdict.principal == pytest.approx(moments, abs=1e-12)
    smallest = np.linalg.eigvalsh(parameters.pseudo_inertia(body))[0]
    assert verdict.smallest_eigenvalue == pytest.approx(smallest, abs=1e-12)
    (nothing,) = parameters.consistency(np.zeros(10))
    assert np.isnan(nothing.principal).all()
    assert "mass 0 kg is not positive" in nothing.reason


def test_a_flat_body_at_the_edge_of_the_possible_is_consistent():
    # A disc: the two moments in its plane add up to the third.
    edge = parameters.from_com(1.0, [0.0, 0.0, 0.0], np.diag([0.01, 0.01, 0.02]))
    assert parameters.consistency(edge)[0].consistent
    beyond = edge.copy()
    beyond[5] *= 1.0 + 1e-6
    assert not parameters.consistency(beyond)[0].consistent
    assert parameters.consistency(beyond, tolerance=1e-3)[0].consistent


def test_units_of_all_symbols():
    revolute = [parameters.unit(f"{symbol}1") for symbol in parameters.PER_LINK]
    prismatic = [parameters.unit(f"{symbol}1", prismatic=True) for symbol in parameters.PER_LINK]
    bodies_ = ["kg m^2"] * 6 + ["kg m"] * 3 + ["kg"]
    assert revolute == [*bodies_, "kg m^2", "Nm s/rad", "Nm", "Nm", "Nm s/rad", "Nm", "Nm"]
    assert prismatic == [*bodies_, "kg", "N s/m", "N", "N", "N s/m", "N", "N"]
