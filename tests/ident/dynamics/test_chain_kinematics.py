"""Chains from tables and from URDFs, with modified-DH frames or others."""

import numpy as np
import pinocchio as pin
import pytest

from fri.errors import ConfigurationError
from ident.dynamics import regressor
from ident.dynamics.kinematics import Chain, _snap
from tests.ident.dynamics.core_arms import RIGHT, bodies, lwr, shared, states

INERTIAL = (
    '<inertial><mass value="{m}"/><origin xyz="{x} 0.02 0.05" rpy="0.1 0.2 0.3"/>'
    '<inertia ixx="0.05" ixy="0.001" ixz="0.002" iyy="0.06" iyz="-0.001" izz="0.04"/></inertial>'
)


def urdf(joints: list[dict[str, str]], extra: str = "") -> str:
    """A URDF of a chain with a body for each moving link."""
    links = ['<link name="l0"/>']
    for number, joint in enumerate(joints, start=1):
        body = INERTIAL.format(m=1.0 + 0.3 * number, x=0.01 * number)
        links.append(f'<link name="l{number}">{body}</link>')
        links.append(
            f'<joint name="j{number}" type="{joint.get("type", "revolute")}">'
            f'<origin xyz="{joint.get("xyz", "0 0 0")}" rpy="{joint.get("rpy", "0 0 0")}"/>'
            f'<parent link="l{number - 1}"/><child link="l{number}"/>'
            f'<axis xyz="{joint.get("axis", "0 0 1")}"/>'
            '<limit effort="10" lower="-3" upper="3" velocity="2"/></joint>'
        )
    return f'<robot name="arm">{"".join(links)}{extra}</robot>'


UPRIGHT = [
    {"xyz": "0 0 0.11"},
    {"xyz": "0 0 0.2", "axis": "0 -1 0"},
    {"xyz": "0 0 0.2"},
    {"xyz": "0 0 0.2", "axis": "0 1 0"},
    {"xyz": "0 0 0.2"},
    {"xyz": "0 0 0.19", "axis": "0 -1 0"},
    {"xyz": "0 0 0.078"},
]
SKEW = [
    {"xyz": "0.1 0.2 0.3", "rpy": "0.3 -0.2 0.5", "axis": "1 0.5 -0.2"},
    {"xyz": "0.2 0 0.1", "rpy": "0.1 0.4 0", "axis": "0 1 0.3"},
    {"xyz": "0 0.3 0.1", "axis": "0.2 0.1 1", "type": "prismatic"},
    {"xyz": "0.1 0.1 0.4", "rpy": "1 0 0.2", "axis": "1 0 0"},
]
PARALLEL = [
    {"axis": "0 1 0"},
    {"xyz": "0.4 0.1 0.1", "axis": "0 1 0"},
    {"xyz": "0.3 0 0", "axis": "0 -1 0"},
    {"xyz": "0.1 0 0", "axis": "0 0 1", "type": "prismatic"},
    {"xyz": "0.1 0 0", "axis": "0 0 1"},
    {"xyz": "0 0 0.2", "axis": "0 0 1", "type": "continuous"},
]
# Intersecting axes with common normals along each axis of the link frames.
CARDAN = [{"axis": axis} for axis in ("1 0 0", "0 1 0", "0 0 1", "-1 0 0", "0 0 1", "0 -1 0", "1 0 0")]


def test_the_lwr_urdf_has_the_published_table():
    chain = lwr()
    assert chain.joint_names == ("A1", "A2", "E1", "A3", "A4", "A5", "A6")
    assert chain.alpha == pytest.approx([0, RIGHT, -RIGHT, -RIGHT, RIGHT, RIGHT, -RIGHT], abs=1e-15)
    assert chain.d.tolist() == [0] * 7
    assert chain.r.tolist() == [0.3105, 0, 0.4, 0, 0.39, 0, 0]
    assert chain.theta.tolist() == [0] * 7
    assert np.array_equal(chain.link_placements, np.tile(np.eye(4), (7, 1, 1)))


def test_a_urdf_without_mdh_frames_gets_the_same_table():
    chain = Chain.from_urdf(urdf(UPRIGHT))
    assert chain.alpha == pytest.approx(lwr().alpha, abs=1e-15)
    assert chain.r == pytest.approx([0, 0, 0.4, 0, 0.39, 0, 0.078], abs=1e-12)
    assert chain.d == pytest.approx(np.zeros(7), abs=1e-12)


@pytest.mark.parametrize(
    "joints", [UPRIGHT, SKEW, PARALLEL, CARDAN], ids=["upright", "skew", "parallel", "cardan"]
)
def test_dynamics_of_any_urdf_equal_pinocchios(joints):
    text = urdf(joints)
    chain = Chain.from_urdf(text, snap_rad=0.0)
    model = pin.buildModelFromXML(text)
    data = model.createData()
    q, qd, qdd = states(chain, 20)
    expected = []
    for row in zip(q, qd, qdd, strict=True):
        position = pin.neutral(model)
        for joint in range(chain.n):
            start, size = model.idx_qs[joint + 1], model.nqs[joint + 1]
            angle = row[0][joint]
            position[start : start + size] = [np.cos(angle), np.sin(angle)] if size == 2 else angle
        expected.append(pin.rnea(model, data, position, row[1], row[2]))
    found = regressor.torque(chain, q, qd, qdd, chain.urdf_inertials())
    assert found == pytest.approx(np.array(expected), abs=1e-11)


@pytest.mark.parametrize(
    "joints", [UPRIGHT, SKEW, PARALLEL[:5], CARDAN], ids=["upright", "skew", "parallel", "cardan"]
)
def test_link_frames_are_where_the_urdf_has_them(joints):
    text = urdf(joints)
    chain = Chain.from_urdf(text, snap_rad=0.0)
    model = pin.buildModelFromXML(text)
    data = model.createData()
    q = states(chain, 1)[0][0]
    pin.forwardKinematics(model, data, q)
    poses = chain.forward(q) @ chain.link_placements
    for joint in range(chain.n):
        assert poses[joint] == pytest.approx(data.oMi[joint + 1].homogeneous, abs=1e-12)


def test_inertials_go_to_the_urdf_frames_and_back():
    chain = Chain.from_urdf(urdf(SKEW))
    rows = bodies(chain.n)
    assert chain.inertial_from_links(chain.inertial_to_links(rows)) == pytest.approx(rows, abs=1e-12)


def test_the_frames_built_are_mdh_frames_about_the_joint_axes():
    chain = Chain.from_urdf(urdf(SKEW), snap_rad=0.0)
    assert not np.array_equal(chain.base_placement, np.eye(4))
    for axis, placement in zip(
        [[1, 0.5, -0.2], [0, 1, 0.3], [0.2, 0.1, 1], [1, 0, 0]], chain.link_placements, strict=True
    ):
        unit = np.array(axis) / np.linalg.norm(axis)
        assert placement[:3, :3] @ unit == pytest.approx([0, 0, 1], abs=1e-12)


def test_bodies_fixed_to_a_link_are_added_to_it():
    tool = (
        f'<link name="tool">{INERTIAL.format(m=2.0, x=0.1)}</link>'
        '<joint name="weld" type="fixed"><origin xyz="0 0.1 0.2" rpy="0.5 0 0"/><parent link="l7"/>'
        '<child link="tool"/></joint>'
    )
    text = urdf(UPRIGHT, tool)
    chain = Chain.from_urdf(text)
    model = pin.buildModelFromXML(text)
    data = model.createData()
    q, qd, qdd = states(chain, 1)
    expected = pin.rnea(model, data, q[0], qd[0], qdd[0])
    assert regressor.torque(chain, q, qd, qdd, chain.urdf_inertials())[0] == pytest.approx(
        expected, abs=1e-11
    )


def test_angles_written_with_few_digits_are_taken_as_right_angles():
    text = urdf([{}, {"rpy": "1.5708 0 0"}])
    assert Chain.from_urdf(text).alpha[1] == np.pi / 2
    assert Chain.from_urdf(text, snap_rad=0.0).alpha[1] == pytest.approx(1.5708, abs=1e-15)


def test_a_chain_survives_its_dictionary():
    chain = Chain.from_urdf(urdf(SKEW))
    again = Chain.from_dict(chain.to_dict())
    q, qd, qdd = states(chain, 3)
    rows = bodies(chain.n)
    assert np.array_equal(
        regressor.torque(again, q, qd, qdd, rows), regressor.torque(chain, q, qd, qdd, rows)
    )
    assert np.array_equal(again.forward(q[0]), chain.forward(q[0]))
    assert again.link_names == chain.link_names


def test_part_of_a_tree_is_chosen_by_its_tip():
    branch = (
        '<link name="finger"/><joint name="jf" type="prismatic"><parent link="l1"/><child link="finger"/>'
        '<axis xyz="1 0 0"/><limit effort="1" lower="0" upper="1" velocity="1"/></joint>'
    )
    text = urdf(UPRIGHT[:3], branch)
    with pytest.raises(ConfigurationError, match=r"branches at link 'l1'.*tip"):
        Chain.from_urdf(text)
    assert Chain.from_urdf(text, tip="l3").joint_names == ("j1", "j2", "j3")
    assert Chain.from_urdf(text, tip="finger").joint_names == ("j1", "jf")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<robot name='a'><link name='l'/>", "not well-formed"),
        ("<sdf/>", "begins with <robot>"),
        ("<robot name='a'><link name='l'/></robot>", "no movable joint"),
        (urdf([{"type": "ball"}]), "'ball' is not supported"),
        (urdf([{"axis": "0 0 0"}]), "axis has no length"),
        (urdf([{"xyz": "0 0"}]), "must hold 3 finite numbers"),
        (urdf([{}]).replace('parent link="l0"', 'parent link="nowhere"'), "'nowhere', missing in the file"),
    ],
)
def test_unusable_urdfs_are_refused_with_the_reason(text, message):
    with pytest.raises(ConfigurationError, match=message):
        Chain.from_urdf(text)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(ConfigurationError, match=r"absent\.urdf: cannot be read"):
        Chain.from_urdf(tmp_path / "absent.urdf")


def test_tables_are_read_strictly():
    with pytest.raises(ConfigurationError, match="unknown key `beta`"):
        Chain.from_table([{"beta": 1.0}])
    with pytest.raises(ConfigurationError, match="neither `revolute` nor `prismatic`"):
        Chain.from_table([{"kind": "screw"}])
    with pytest.raises(ConfigurationError, match="no movable joint"):
        Chain.from_table([])


@pytest.mark.parametrize(
    "file",
    [
        "lwr4_flobaroid/kuka_lwr4_2016-04-11.urdf",
        "lwr4_flobaroid/kuka_lwr4_gaz.urdf",
        "iiwa14/iiwa14.urdf",
        "tx40/tx40_mdh_modified.urdf",
    ],
)
def test_published_urdfs_have_pinocchios_torques(file):
    path = shared(file)
    chain = Chain.from_urdf(path)
    model = pin.buildModelFromUrdf(str(path))
    data = model.createData()
    q, qd, qdd = states(chain, 5)
    expected = [pin.rnea(model, data, *row) for row in zip(q, qd, qdd, strict=True)]
    found = regressor.torque(chain, q, qd, qdd, chain.urdf_inertials())
    # The files write right angles with eleven digits; ours are exact.
    assert found == pytest.approx(np.array(expected), abs=1e-9)


def test_a_urdf_without_an_axis_turns_about_x():
    text = urdf([{"axis": "1 0 0"}, {"xyz": "0 0.1 0.2", "axis": "1 0 0"}])
    bare = text.replace('<axis xyz="1 0 0"/>', "")
    assert "axis" not in bare
    one, other = Chain.from_urdf(text), Chain.from_urdf(bare)
    assert other.to_dict() == one.to_dict()


def test_an_origin_without_place_or_angles_has_zeros():
    text = urdf([{}, {"xyz": "0 0.1 0.2", "axis": "1 0 0"}, {"rpy": "0.2 0 0", "axis": "0 1 0"}])
    bare = text.replace(' xyz="0 0 0"', "").replace(' rpy="0 0 0"', "").replace("xyz='0 0 0'", "")
    assert bare.count("xyz") < text.count("xyz")
    one, other = Chain.from_urdf(text), Chain.from_urdf(bare)
    assert other.to_dict() == one.to_dict()


def test_frames_have_no_rounding_about_zero():
    for joints in (UPRIGHT, PARALLEL):
        chain = Chain.from_urdf(urdf(joints))
        for values in (
            chain.link_placements,
            chain.base_placement,
            chain.d,
            chain.r,
            chain.alpha,
            chain.theta,
        ):
            size = np.abs(values)
            assert not np.any((size > 0.0) & (size < 1e-12))


def test_a_dictionary_without_names_of_links_numbers_them():
    content = lwr().to_dict()
    for row in content["joints"]:
        del row["link"]
    assert Chain.from_dict(content).link_names == tuple(f"link_{k}" for k in range(1, 8))


@pytest.mark.parametrize(
    ("change", "message"),
    [({"mass": 1}, "unknown key `mass`"), ({"gravity": None}, "`joints` and `gravity` are needed")],
)
def test_a_dictionary_that_is_no_chain_is_refused(change, message):
    content = {**lwr().to_dict(), **change}
    if change.get("gravity", 1) is None:
        del content["gravity"]
    with pytest.raises(ConfigurationError, match=message):
        Chain.from_dict(content)


@pytest.mark.parametrize(
    ("angle", "snapped"),
    [
        (0.0009, 0.0),
        (0.0011, 0.0011),
        (-RIGHT + 0.0009, -RIGHT),
        (RIGHT - 0.0011, RIGHT - 0.0011),
        (np.pi - 0.0005, np.pi),
        (-np.pi + 0.0005, np.pi),
        (-np.pi + 0.0011, -np.pi + 0.0011),
    ],
)
def test_an_angle_near_a_quarter_turn_is_one_and_half_a_turn_is_positive(
    angle: float, snapped: float
) -> None:
    assert _snap(angle, 0.001) == snapped


@pytest.mark.parametrize("unknown", ['effort="0"', 'effort="inf"', 'effort="much"', ""])
def test_largest_torques_are_known_of_all_joints_or_of_none(unknown: str) -> None:
    text = urdf(UPRIGHT)
    np.testing.assert_array_equal(Chain.from_urdf(text).efforts(), np.full(7, 10.0))
    assert Chain.from_urdf(text.replace('effort="10"', unknown, 1)).efforts() is None
