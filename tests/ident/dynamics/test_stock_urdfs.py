"""URDFs as makers ship them: grippers, mimic joints, fingers, floating roots and joints besides the arm's."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from fri.errors import ConfigurationError
from ident.dynamics.kinematics import Chain
from ident.dynamics.session_chain import session_chain
from ident.dynamics.urdf import held, read_urdf
from lwr_driver.session import SessionWriter, read_session, session_metadata
from tests.ident.stock_panda import JOINTS, joint, link, stock_panda

VARIANTS = {
    "hand": stock_panda(),
    "floating": stock_panda(floating=True),
    "head": stock_panda(head=True),
    "both": stock_panda(floating=True, head=True),
}


@pytest.mark.parametrize("name", VARIANTS)
def test_the_joints_of_the_log_choose_the_chain_and_all_bodies_count(name: str) -> None:
    chain = Chain.from_urdf(VARIANTS[name], joints=JOINTS)
    assert chain.joint_names == JOINTS
    full = pin.buildModelFromXML(stock_panda())
    fingers = [full.getJointId(f"panda_finger_joint{k}") for k in (1, 2)]
    reduced = pin.buildReducedModel(full, fingers, pin.neutral(full))
    ours = chain.to_pinocchio(chain.urdf_inertials())
    q, qd, qdd = np.random.default_rng(3).normal(size=(3, 7))
    expected = pin.rnea(reduced, reduced.createData(), q, qd, qdd)
    np.testing.assert_allclose(pin.rnea(ours, ours.createData(), q, qd, qdd), expected, atol=2e-6)


@pytest.mark.parametrize("name", VARIANTS)
def test_seven_columns_are_the_arm_before_the_fingers(name: str) -> None:
    read = read_urdf(VARIANTS[name])
    assert read.arm(count=7) == JOINTS
    assert read.arm(names=[entry.name for entry in read.joints]) == JOINTS
    assert read.arm(names=JOINTS) == JOINTS
    with pytest.raises(ConfigurationError, match="no serial arms"):
        read.arm(names=JOINTS[1:])


def test_a_finger_in_the_log_belongs_to_the_chain() -> None:
    chain = Chain.from_urdf(stock_panda(), joints=("panda_finger_joint1", *JOINTS))
    assert chain.joint_names == (*JOINTS, "panda_finger_joint1")
    assert chain.prismatic.tolist() == [False] * 7 + [True]


def test_a_joint_amid_the_chain_without_measurement_is_held_at_zero() -> None:
    chain = Chain.from_urdf(stock_panda(), joints=[name for name in JOINTS if name != "panda_joint3"])
    whole = Chain.from_urdf(stock_panda(), joints=JOINTS)
    q = np.array([0.3, -0.5, 0.0, -1.2, 0.4, 0.9, -0.2])
    last = chain.forward(np.delete(q, 2))[-1] @ chain.link_placements[-1]
    np.testing.assert_allclose(last, whole.forward(q)[-1] @ whole.link_placements[-1], atol=1e-6)


@pytest.mark.parametrize(
    ("joints", "message"),
    [
        (("panda_jiont4",), r"no joint 'panda_jiont4'; did you mean 'panda_joint4'\?"),
        (("panda_joint8",), "'panda_joint8' of robot 'panda' is fixed"),
        (("free",), "'free' of robot 'panda' is fixed"),
        ((*JOINTS, "head_pan"), "'head_pan' is not on the chain.*leave it out of `joints`"),
        ((*JOINTS, "panda_finger_joint2", "panda_finger_joint1"), "is not on the chain"),
    ],
)
def test_names_that_cannot_be_a_chain_are_refused(joints: tuple[str, ...], message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        Chain.from_urdf(VARIANTS["both"], joints=joints)


def test_a_mimic_joint_that_follows_a_measured_one_before_it_is_no_rigid_link() -> None:
    text = (
        f'<robot name="a"><link name="l0"/>{link("l1", 1.0)}{link("l2", 1.0)}{link("l3", 1.0)}'
        + joint("j1", "revolute", "l0", "l1", ("0 0 0", "0 0 0"))
        + joint("j2", "revolute", "l1", "l2", ("0 0 1", "1.57 0 0"), '<mimic joint="j1" multiplier="-1"/>')
        + joint("j3", "revolute", "l2", "l3", ("0 0 1", "0 0 0"))
        + "</robot>"
    )
    with pytest.raises(ConfigurationError, match=r"'j2' on the chain follows 'j1' \(mimic\)"):
        Chain.from_urdf(text, joints=("j1", "j3"))
    assert Chain.from_urdf(text, joints=("j1", "j2", "j3")).n == 3


def test_two_arms_of_one_length_are_a_question() -> None:
    text = stock_panda().removesuffix("</robot>") + stock_panda().replace("panda_", "other_").removeprefix(
        '<robot name="panda">'
    ).replace('<link name="other_link0">', '<link name="unused">')
    text = text.replace('parent link="other_link0"', 'parent link="panda_link0"').replace(
        '<link name="unused">', '<link name="panda_link9">'
    )
    text = text.replace(
        "</robot>", joint("mount", "fixed", "panda_link0", "panda_link9", ("0 0 0", "0 0 0")) + "</robot>"
    )
    with pytest.raises(ConfigurationError, match=r"2 serial arms with 7 joints .*name the `joints`"):
        read_urdf(text).arm(count=7)


def test_gravity_points_down_in_the_axes_of_the_base() -> None:
    turned = (
        stock_panda()
        .replace('<robot name="panda">', '<robot name="panda"><link name="room"/>')
        .replace(
            "</robot>",
            joint("wall", "fixed", "room", "panda_link0", ("0 0 0", "1.5707963267948966 0 0")) + "</robot>",
        )
    )
    upright = Chain.from_urdf(turned, root="panda_link0", tip="panda_link8", joints=JOINTS)
    on_wall = Chain.from_urdf(turned, joints=JOINTS)

    def along_first_axis(chain: Chain) -> float:
        return float(chain.base_placement[:3, :3] @ chain.gravity @ chain.forward(np.zeros(7))[0][:3, 2])

    assert along_first_axis(upright) == pytest.approx(-9.81)
    assert along_first_axis(on_wall) == pytest.approx(0.0, abs=1e-9)


def session_of(path: Path, names: tuple[str, ...], **metadata: str):
    with SessionWriter(
        path,
        names,
        {**session_metadata(robot="panda"), **metadata},
        attachments={"robot.urdf": stock_panda().encode()},
    ) as writer:
        writer.write_joint_states(np.array([10, 20]), np.zeros((2, len(names))), np.zeros((2, len(names))))
    return read_session(path)


def test_the_chain_of_a_session_has_its_joints(tmp_path: Path) -> None:
    session = session_of(tmp_path / "a.mcap", JOINTS[::-1])
    assert session_chain(session).joint_names == JOINTS
    with pytest.raises(ConfigurationError, match="did you mean 'panda_joint1'"):
        session_chain(session_of(tmp_path / "b.mcap", ("panda_jont1", *JOINTS[1:])))
    with pytest.raises(ConfigurationError, match="has no link 'panda_lnk8'; did you mean 'panda_link8'"):
        session_chain(session, tip="panda_lnk8")
    with pytest.raises(ConfigurationError, match="no robot description; name the URDF with --urdf"):
        session_chain(replace(session, robot_description=None))


def test_the_metadata_of_a_session_name_base_and_tip(tmp_path: Path) -> None:
    session = session_of(tmp_path / "a.mcap", (*JOINTS, "gripper_of_another_file"), tip="panda_link7")
    assert session_chain(session).joint_names == JOINTS


def test_joints_held_where_they_rest_leave_the_same_arm() -> None:
    rests = {"panda_joint2": 0.4, "panda_joint4": -1.3, "panda_joint6": 1.1, "panda_finger_joint1": 0.03}
    kept = ("panda_joint1", "panda_joint3", "panda_joint5", "panda_joint7")
    chain = Chain.from_urdf(held(stock_panda(), rests), joints=kept)
    full = pin.buildModelFromXML(stock_panda())
    q0 = pin.neutral(full)
    for name, value in rests.items():
        q0[full.joints[full.getJointId(name)].idx_q] = value
    away = [full.getJointId(name) for name in (*rests, "panda_finger_joint2")]
    reduced = pin.buildReducedModel(full, away, q0)
    ours = chain.to_pinocchio(chain.urdf_inertials())
    q, qd, qdd = np.random.default_rng(4).normal(size=(3, 4))
    expected = pin.rnea(reduced, reduced.createData(), q, qd, qdd)
    np.testing.assert_allclose(pin.rnea(ours, ours.createData(), q, qd, qdd), expected, atol=2e-6)
    with pytest.raises(ConfigurationError, match="has no joint 'panda_joint9'"):
        held(stock_panda(), {"panda_joint9": 0.0})
