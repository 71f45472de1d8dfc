from __future__ import annotations

import dataclasses
import re

import numpy as np
import pytest

from fri.errors import ConfigurationError
from lwr_driver.arm.cell import Box, Cell, PayloadShape
from lwr_driver.arm.collision import CollisionChecker
from tests.lwr_driver.driver_rig import arm

BENT = np.array([0.0, 0.5, 0.0, -1.3, 0.0, 0.8, 0.0])


@pytest.fixture(scope="module")
def checker() -> CollisionChecker:
    return CollisionChecker(arm(), Cell())


def at(**joints: float) -> np.ndarray:
    q = np.zeros(7)
    for name, value in joints.items():
        q[arm().joint_names.index(name)] = value
    return q


def test_zero_pose_is_clear(checker):
    assert checker.clearance(np.zeros(7)).distance > 0.05


def test_arm_that_lies_down_hits_the_ground(checker):
    clearance = checker.clearance(at(A2=2.0))
    assert clearance.distance < 0.0
    assert clearance.pair[1] == "ground"


def test_distance_of_the_stretched_arm_to_the_ground_is_geometry():
    # Horizontal at the height of the shoulder, 0.3105 m; the thickest shape in reach has a radius of 0.08 m.
    clearance = CollisionChecker(arm(), Cell(ground_z_m=0.2)).clearance(at(A2=np.pi / 2))
    assert clearance.pair[1] == "ground"
    assert clearance.distance == pytest.approx(0.3105 - 0.08 - 0.2, abs=1e-6)
    assert clearance.points[0][2] == pytest.approx(0.3105 - 0.08, abs=1e-6)


def test_folded_arm_comes_near_itself_and_says_which_links(checker):
    # The elbow at its limit brings the forearm to the upper arm.
    clearance = checker.clearance(at(A3=2.09, A5=2.09))
    assert clearance.pair == ("link_2", "link_5")
    assert 0.0 < clearance.distance < checker.clearance(np.zeros(7)).distance


def test_box_in_the_way_is_seen_and_named():
    wall = Box("wall", (0.1, 2.0, 2.0), (-0.6, 0.0, 1.0))
    clearance = CollisionChecker(arm(), Cell(boxes=(wall,))).clearance(at(A2=1.0))
    assert clearance.distance < 0.0
    assert "wall" in clearance.pair


def test_turned_box_is_turned():
    slab = Box("slab", (2.0, 0.02, 0.02), (0.0, 0.0, 1.5))
    turned = dataclasses.replace(slab, rpy_deg=(0.0, 90.0, 0.0))
    flat = CollisionChecker(arm(), Cell(boxes=(slab,))).clearance(np.zeros(7)).distance
    upright = CollisionChecker(arm(), Cell(boxes=(turned,))).clearance(np.zeros(7)).distance
    assert flat > 0.0 > upright


def test_payload_reaches_further_than_the_flange():
    load = PayloadShape("cylinder", (0.05, 0.3), (0.0, 0.0, 0.228))
    q = at(A2=1.95)
    bare = CollisionChecker(arm(), Cell(), None).clearance(q).distance
    assert CollisionChecker(arm(), Cell(), load).clearance(q).distance < bare


@pytest.mark.parametrize(("shape", "size"), [("sphere", (0.1,)), ("box", (0.1, 0.1, 0.1))])
def test_every_payload_shape_is_checked(shape, size):
    load = PayloadShape(shape, size, (0.0, 0.0, 0.2))
    assert CollisionChecker(arm(), Cell(), load).clearance(at(A2=2.0)).distance < 0.0


def test_no_ground_means_no_ground():
    checker = CollisionChecker(arm(), Cell(ground_z_m=None))
    assert "ground" not in checker.clearance(at(A2=2.0)).pair


def test_path_reports_its_tightest_moment(checker):
    # Down to 1.8 rad and up again: the middle is tightest.
    sweep = 0.9 * (1.0 - np.cos(np.linspace(0.0, 2.0 * np.pi, 2001)))
    path = np.zeros((2001, 7))
    path[:, 1] = sweep
    tightest = checker.check_path(path, period_s=0.002)
    assert tightest.row == pytest.approx(1000, abs=1)
    assert tightest.time_s == pytest.approx(2.0, abs=0.003)
    assert tightest.distance == pytest.approx(checker.clearance(path[1000]).distance, abs=1e-6)


def test_wide_step_between_rows_is_not_jumped_over():
    # The wall stands between the two rows and touches neither.
    wall = Box("wall", (0.4, 0.02, 1.0), (-0.7, 0.0, 0.6))
    checker = CollisionChecker(arm(), Cell(boxes=(wall,)))
    path = np.array([at(A1=-0.5, A2=1.2), at(A1=0.5, A2=1.2)])
    assert min(checker.clearance(q).distance for q in path) > 0.1
    assert checker.check_path(path).distance < 0.0


def test_path_at_rest_and_path_of_one_row(checker):
    alone = checker.clearance(BENT).distance
    assert checker.check_path(BENT[None]).distance == pytest.approx(alone)
    assert checker.check_path(np.tile(BENT, (50, 1))).distance == pytest.approx(alone)


def test_rest_within_a_path_does_not_shift_its_moments(checker):
    still = np.zeros((500, 7))
    down = np.zeros((1001, 7))
    down[:, 1] = np.linspace(0.0, 1.8, 1001)
    tightest = checker.check_path(np.vstack([still, down]), period_s=0.001)
    assert tightest.row == pytest.approx(1500, abs=2)


@pytest.mark.parametrize("path", [np.zeros((0, 7)), np.zeros((3, 6)), np.full((3, 7), np.nan)])
def test_malformed_path_is_refused(checker, path):
    with pytest.raises(ConfigurationError, match="path of shape"):
        checker.check_path(path)


def test_geometry_that_cannot_be_read_is_an_error_not_a_free_pass():
    text = re.sub(r"<sphere radius=\"0.07\"/>", '<mesh filename="missing.stl"/>', arm().urdf)
    broken = dataclasses.replace(arm(), urdf=text)
    with pytest.raises((ConfigurationError, ValueError)):
        CollisionChecker(broken, Cell())


def test_urdf_without_geometry_is_an_error():
    text = re.sub(r"<collision>.*?</collision>", "", arm().urdf, flags=re.S)
    with pytest.raises(ConfigurationError, match="0 of 0 collision shapes"):
        CollisionChecker(dataclasses.replace(arm(), urdf=text), Cell())


def test_box_cannot_take_the_name_of_a_link():
    with pytest.raises(ConfigurationError, match="ground"):
        CollisionChecker(arm(), Cell(boxes=(Box("ground", (1, 1, 1), (5, 5, 5)),)))


def test_cell_file_is_read_and_checked(tmp_path):
    assert Cell.load().ground_z_m == 0.0
    path = tmp_path / "cell.yaml"
    path.write_text("boxes: [{name: t, size_m: [1, 1, 0], centre_m: [0, 0, 0]}]")
    with pytest.raises(ConfigurationError, match="size_m"):
        Cell.load(path)
    path.write_text("boxes: [{name: t, size_m: [1, 1, 1], center_m: [0, 0, 0]}]")
    with pytest.raises(ConfigurationError, match="did you mean `centre_m`"):
        Cell.load(path)


@pytest.mark.parametrize("shape", [("sphere", (0.1, 0.2)), ("cylinder", (0.1,)), ("box", (0.1, 0.1, 0.0))])
def test_payload_sizes_must_fit_the_shape(shape):
    with pytest.raises(ConfigurationError, match=r"payload shape|`size_m`"):
        PayloadShape(*shape, (0.0, 0.0, 0.1))
