"""What the dynamics refuse, each with its value and its limit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fri.errors import ConfigurationError
from ident.dynamics import regressor
from ident.dynamics.base_set import numeric_base
from ident.dynamics.kinematics import Chain, _perpendicular
from ident.dynamics.physical import project
from ident.dynamics.structure import Coulomb, ModelStructure
from ident.dynamics.urdf import read_urdf
from tests.ident.dynamics.core_arms import RIGHT, bodies, states


def chain() -> Chain:
    return Chain.from_table([{}, {"alpha": RIGHT, "d": 0.2}])


def urdf(*joints: str, links: str = "abc") -> str:
    inertial = (
        '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
    )
    return (
        '<robot name="r">'
        + "".join(f'<link name="{link}">{inertial}</link>' for link in links)
        + "".join(joints)
        + "</robot>"
    )


def joint(name: str, parent: str, child: str, inside: str = "") -> str:
    return (
        f'<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/>{inside}'
        '<limit lower="-1" upper="1" effort="1" velocity="1"/></joint>'
    )


def test_parameters_have_the_size_of_the_model() -> None:
    base = numeric_base(ModelStructure(chain(), 2))
    count = base.structure.n_columns
    with pytest.raises(ConfigurationError, match=rf"shape \({count - 1},\); expected \({count},\)"):
        base.reduce(np.zeros(count - 1))
    with pytest.raises(ConfigurationError, match=rf"expected \({len(base.columns)},\)"):
        base.expand(np.zeros(len(base.columns) + 1))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"joint_names": ()}, "no movable joint"),
        ({"joint_names": ("a", "a")}, "joint names a, a repeat"),
        ({"alpha": np.zeros(3)}, "`alpha` of shape"),
        ({"d": np.array([0.0, np.nan])}, "`d` of shape"),
        ({"gravity": np.zeros(2)}, "`gravity` of shape"),
        ({"base_placement": np.eye(3)}, "`base_placement` of shape"),
        ({"link_names": ("a",)}, "2 joints need 2 link names"),
        ({"link_placements": np.zeros((2, 3, 3))}, "2 joints need 2 link names and link placements"),
    ],
)
def test_a_chain_has_its_numbers_for_every_joint(changes: dict, message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        replace(chain(), **changes)


def test_a_table_has_no_bodies_and_a_position_for_each_joint() -> None:
    with pytest.raises(ConfigurationError, match="comes from a table"):
        chain().urdf_inertials()
    with pytest.raises(ConfigurationError, match=r"shape \(3,\); the chain has 2 joints"):
        chain().forward(np.zeros(3))


def test_a_link_frame_has_an_axis_across_that_of_its_joint() -> None:
    up = np.array([0.0, 0.0, 1.0])
    np.testing.assert_allclose(_perpendicular(np.eye(4), up), [1.0, 0.0, 0.0])
    # Its x axis along the joint: y is taken.
    np.testing.assert_allclose(_perpendicular(np.roll(np.eye(4), 2, axis=1), up)[2], 0.0, atol=1e-12)
    with pytest.raises(ConfigurationError, match="is not a rotation"):
        _perpendicular(np.zeros((4, 4)), up)


def test_a_column_map_has_ten_columns_a_link() -> None:
    q, qd, qdd = states(chain(), 3)
    with pytest.raises(ConfigurationError, match=r"column map has shape \(2, 9\); expected \(2, 10\)"):
        regressor.rigid_regressor(chain(), q, qd, qdd, columns=np.zeros((2, 9), dtype=np.int64))


def test_one_state_has_the_regressor_of_many() -> None:
    q, qd, qdd = states(chain(), 1)
    many = regressor.rigid_regressor(chain(), *(np.repeat(s, 3, axis=0) for s in (q, qd, qdd)))
    one = regressor.rigid_regressor(chain(), q, qd, qdd)
    assert one.shape == (2, 1, 20)
    np.testing.assert_allclose(one[:, 0], many[:, 1], atol=1e-12)
    # Of the first link the mass alone, behind all parameters of the second.
    some = np.full((2, 10), -1, dtype=np.int64)
    some[1], some[0, 9] = np.arange(10), 10
    few = regressor.rigid_regressor(chain(), q, qd, qdd, columns=some)
    np.testing.assert_allclose(few[:, 0], many[:, 1][:, [*range(10, 20), 9]], atol=1e-12)


@pytest.mark.parametrize(
    ("kind", "width", "message"),
    [
        ("step", 1.0, "'step' is not one of"),
        ("tanh", 0.0, "width 0.0 must be"),
        ("deadband", -1.0, "must be positive"),
    ],
)
def test_a_friction_law_has_a_kind_and_a_width(kind: str, width: float, message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        Coulomb(kind, width)  # type: ignore[arg-type]
    assert Coulomb()(np.array([-0.1, 0.0, 3.0])).tolist() == [-1.0, 0.0, 1.0]
    assert Coulomb("deadband", 0.5)(np.array([-0.6, -0.5, 0.5, 0.6])).tolist() == [-1.0, 0.0, 0.0, 1.0]
    np.testing.assert_allclose(Coulomb("tanh", 0.5)(np.array([0.25])), np.tanh(0.5))


def test_a_projection_has_the_shapes_of_its_bodies() -> None:
    reference = bodies(2)
    with pytest.raises(ConfigurationError, match=r"matrix has shape \(5, 20\); expected \(4, 20\)"):
        project(np.zeros((5, 20)), np.zeros(4), reference)
    with pytest.raises(ConfigurationError, match=r"covariance has shape \(3, 3\); expected \(4, 4\)"):
        project(np.zeros((4, 20)), np.zeros(4), reference, covariance=np.eye(3))


def test_a_robot_is_one_tree() -> None:
    two = read_urdf(urdf(joint("j", "a", "b")))
    with pytest.raises(ConfigurationError, match="2 root links; a tree has exactly one"):
        _ = two.root
    with pytest.raises(ConfigurationError, match="link 'c' does not hang on link 'a'"):
        two.chain("a", "c")
    whole = read_urdf(urdf(joint("j", "a", "b"), joint("k", "b", "c")))
    assert whole.root == "a"
    assert [one.name for one in whole.chain("a", "c")] == ["j", "k"]


@pytest.mark.parametrize(
    ("inside", "message"),
    [
        ('<origin xyz="1 two 3"/>', "`xyz=.*is not a list of numbers"),
        ('<origin xyz="1 2"/>', "xyz"),
        ('<axis xyz="0 0 inf"/>', "xyz"),
    ],
)
def test_numbers_of_a_urdf_are_three(inside: str, message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        read_urdf(urdf(joint("j", "a", "b", inside), joint("k", "b", "c")))


@pytest.mark.parametrize("missing", ['<parent link="a"/>', '<child link="b"/>'])
def test_a_joint_of_a_urdf_has_two_links(missing: str) -> None:
    text = urdf(joint("j", "a", "b"), joint("k", "b", "c")).replace(missing, "", 1)
    with pytest.raises(ConfigurationError, match="<parent> and <child> are needed"):
        read_urdf(text)
