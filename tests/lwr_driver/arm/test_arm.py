from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest
import yaml

from fri.errors import ConfigurationError
from lwr_driver.arm import Arm, LinkInertia, link_inertias
from lwr_driver.configuration import CONFIGS
from tests.lwr_driver.driver_rig import arm

DEG = np.pi / 180.0


@pytest.fixture
def files(tmp_path: Path):
    """Writes an arm file and a URDF with changes; returns a function that loads them."""
    content = yaml.safe_load((CONFIGS / "lwr4plus.yaml").read_text())
    urdf = (CONFIGS / "lwr4plus.urdf").read_text()

    def load(change=None, replace: tuple[str, str] | None = None) -> Arm:
        text = urdf if replace is None else re.sub(*replace, urdf, count=1, flags=re.S)
        assert replace is None or text != urdf
        if change is not None:
            change(content)
        (tmp_path / "lwr4plus.urdf").write_text(text)
        (tmp_path / "arm.yaml").write_text(yaml.safe_dump(content))
        return Arm.load(tmp_path / "arm.yaml")

    return load


def test_default_arm_has_the_published_limits():
    lwr = arm()
    assert lwr.joint_names == ("A1", "A2", "E1", "A3", "A4", "A5", "A6")
    assert np.allclose(lwr.q_max / DEG, [170, 120, 170, 120, 170, 120, 170])
    assert np.allclose(lwr.q_min, -lwr.q_max)
    assert np.allclose(lwr.v_max / DEG, [110, 110, 112.5, 112.5, 112.5, 112.5, 112.5])
    assert np.allclose(lwr.tau_max, [176, 176, 100, 100, 100, 38, 38])
    assert np.allclose(lwr.gear_ratio, [100, 100, 100, 100, 160, 100, 100])
    assert np.allclose((lwr.q_max - lwr.q_high) / DEG, 1.0)


def test_arrays_cannot_be_changed():
    with pytest.raises(ValueError, match="read-only"):
        arm().v_max[0] = 10.0


def test_file_with_changes_is_read(files):
    assert np.isclose(files(lambda c: c["joints"][4].update(velocity_deg_s=90.0)).v_max[4] / DEG, 90.0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda c: c["joints"][2].update(velocity_deg_s=0.0),
            r"\[E1\]: `velocity_deg_s`: 0.0 deg/s is outside 5 to 720",
        ),
        (lambda c: c["joints"][2].update(jerk_rad_s3=-1.0), r"\[E1\]: `jerk_rad_s3`"),
        (lambda c: c["joints"][0].update(position_deg=[170, -170]), "A1: position_deg"),
        (
            lambda c: c["joints"][0].update(position_deg=[-175, 175]),
            "A1: position_deg 175 deg is beyond 170 deg, .* narrow",
        ),
        (lambda c: c["joints"].pop(), "6 joints listed"),
        (lambda c: c["joints"].reverse(), "joints A6 .* are not those of KUKA LWR4"),
        (lambda c: c.update(position_margin_deg=21.0), "position_margin_deg"),
        (lambda c: c.update(schema_version=2), "`schema_version`: 2 is outside 1 .this software reads 1"),
        (lambda c: c.update(urdf="missing.urdf"), "missing.urdf"),
        (lambda c: c.update(resonance=3), "unknown key"),
        (
            lambda c: c["joints"][1].update(position_deg=[-1, 1]),
            "less than 10 deg; it looks like rad; .*-57.3, 57.3",
        ),
    ],
)
def test_limits_that_are_not_sane_are_refused(files, change, message):
    with pytest.raises(ConfigurationError, match=message):
        files(change)


@pytest.mark.parametrize(
    ("replace", "message"),
    [
        ((r'<mass value="4.28182"/>', '<mass value="0"/>'), "link_1: mass 0.0"),
        ((r'ixx="0.012444817"', 'ixx="0.1"'), "link_1: principal moments .* break"),
        ((r'ixx="0.012444817"', 'ixx="-0.1"'), "link_1: principal moment"),
        ((r'ixx="0.012444817"', 'ixx="inf"'), "link_1: ixx: expected 1 finite"),
        ((r'<mass value="4.28182"/>', ""), "`mass` and `inertia` are both needed"),
        ((r"<inertial>.*?</inertial>", ""), "link_1 is moved by A1 but has no inertial"),
        ((r'name="E1"', 'name="E2"'), "moving joints are A1 A2 E2"),
        ((r"</robot>", ""), "not valid XML"),
        ((r"<robot", '<!DOCTYPE x [<!ENTITY a "b">]><robot'), "document type"),
    ],
)
def test_urdf_that_no_arm_can_have_is_refused(files, replace, message):
    with pytest.raises(ConfigurationError, match=message):
        files(replace=replace)


def test_urdf_without_collision_geometry_is_refused(tmp_path):
    urdf = re.sub(r"<collision>.*?</collision>", "", (CONFIGS / "lwr4plus.urdf").read_text(), flags=re.S)
    (tmp_path / "lwr4plus.urdf").write_text(urdf)
    (tmp_path / "arm.yaml").write_text((CONFIGS / "lwr4plus.yaml").read_text())
    with pytest.raises(ConfigurationError, match="no link has collision geometry"):
        Arm.load(tmp_path / "arm.yaml")


def test_inertia_is_turned_by_its_origin():
    urdf = """<robot name="x"><link name="a"><inertial><origin xyz="1 2 3" rpy="0 0 1.5707963267949"/>
    <mass value="2"/><inertia ixx="1" ixy="0" ixz="0" iyy="2" iyz="0" izz="2.5"/></inertial></link></robot>"""
    inertia = link_inertias(urdf)["a"]
    assert np.allclose(inertia.inertia, np.diag([2.0, 1.0, 2.5]))
    assert np.allclose(inertia.centre, [1, 2, 3])
    assert inertia.defect() is None


def test_thin_rod_is_a_body_and_a_thinner_one_is_not():
    assert LinkInertia("rod", 1.0, np.zeros(3), np.diag([1e-9, 1.0, 1.0])).defect() is None
    assert "break" in (LinkInertia("rod", 1.0, np.zeros(3), np.diag([1e-9, 1.0, 1.1])).defect() or "")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda c: c["joints"][0].update(acceleration_rad_s2=60.0),
            "A1: acceleration_rad_s2 60 rad/s² is beyond 8",
        ),
        (
            lambda c: c["joints"][0].update(acceleration_rad_s2=458.0),
            "looks like deg/s²; write it in rad/s²: 7.99",
        ),
        (lambda c: c["joints"][3].update(jerk_rad_s3=5729.0), "looks like deg/s³; write it in rad/s³: 99.99"),
        (lambda c: c["joints"][1].update(velocity_deg_s=187.0), "A2: velocity_deg_s 187 deg/s is beyond 110"),
        (lambda c: c["joints"][1].update(velocity_deg_s=1.92), "looks like rad/s; write it in deg/s: 110"),
        (lambda c: c["joints"][6].update(torque_nm=100.0), "A6: torque_nm 100 Nm is beyond 38 Nm"),
        (
            lambda c: c.update(
                model="big arm", joints=[{**c["joints"][0], "jerk_rad_s3": 900.0}, *c["joints"][1:]]
            ),
            "jerk",
        ),
    ],
)
def test_a_file_cannot_widen_what_the_arm_can_stand(files, change, message):
    with pytest.raises(ConfigurationError, match=message):
        files(change)


def test_neither_can_a_changed_description():
    with pytest.raises(ConfigurationError, match="beyond 8 rad/s²"):
        dataclasses.replace(arm(), a_max=2.0 * arm().a_max)
    narrow = dataclasses.replace(arm(), a_max=0.5 * arm().a_max)
    assert np.all(narrow.a_max == 4.0)


def test_another_arm_names_itself_and_has_limits_of_its_own(files):
    names = [f"iiwa_{number}" for number in range(1, 8)]
    urdf = (CONFIGS / "lwr4plus.urdf").read_text()

    def change(content):
        content.update(name="lab 3", model="KUKA iiwa 14")
        for joint, name in zip(content["joints"], names, strict=True):
            joint.update(name=name, torque_nm=320.0)

    with pytest.raises(ConfigurationError, match="moving joints are A1"):
        files(change)
    for old, new in zip(arm().joint_names, names, strict=True):
        urdf = urdf.replace(f'<joint name="{old}"', f'<joint name="{new}"')
    other = files(change, replace=(".*", urdf))
    assert np.all(other.tau_max == 320.0)


@pytest.mark.parametrize("size", ["0", "-0.1", "nan", "88"])
def test_collision_shapes_have_sizes_of_a_body(files, size):
    with pytest.raises(
        ConfigurationError, match=r"collision shape of link .*(outside 0.001 to 2 m|expected)"
    ):
        files(replace=(r'(<collision>.*?radius=")[^"]*', rf"\g<1>{size}"))
