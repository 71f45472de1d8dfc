from __future__ import annotations

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
        (lambda c: c["joints"][2].update(velocity_deg_s=0.0), "E1: velocity_deg_s is 0.0"),
        (lambda c: c["joints"][2].update(jerk_rad_s3=-1.0), "E1: jerk_rad_s3"),
        (lambda c: c["joints"][0].update(position_deg=[170, -170]), "A1: position_deg"),
        (lambda c: c["joints"][0].update(position_deg=[-175, 175]), "A1 may move .* narrow"),
        (lambda c: c["joints"].pop(), "6 joints listed"),
        (lambda c: c["joints"].reverse(), "kinematic order"),
        (lambda c: c.update(position_margin_deg=21.0), "position_margin_deg"),
        (lambda c: c.update(schema_version=2), "schema_version 2"),
        (lambda c: c.update(urdf="missing.urdf"), "missing.urdf"),
        (lambda c: c.update(resonance=3), "unknown key"),
        (lambda c: c["joints"][1].update(position_deg=[-1, 1]), "leaves no range"),
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
