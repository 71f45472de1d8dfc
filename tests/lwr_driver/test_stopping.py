"""Stops of a motion computed beforehand, against the rows that the guard's stop commands and every posture of them."""

from __future__ import annotations

import numpy as np
import pytest

from lwr_driver.arm.cell import Box, Cell
from lwr_driver.arm.collision import CollisionChecker
from lwr_driver.commander import BEFORE_CONTACT_S
from lwr_driver.guard import Stop
from lwr_driver.motion import Motion, move_to
from lwr_driver.stopping import around, begins, nearest_stop
from tests.lwr_driver.driver_rig import START, arm

T = 0.01


@pytest.fixture(scope="module")
def curve() -> Motion:
    """Fast joints out of step, so that a stop leaves the path."""
    t = np.linspace(0.0, 1.0, 301)[:, None]
    bump = (t * (1.0 - t)) ** 3 * 64.0
    q = START + bump * np.array([0.9, -0.5, 0.4, 0.5, 0.3, 0.4, 0.2]) * np.sin(2.0 * np.pi * t + np.arange(7))
    return Motion(q, T)


def driven(motion: Motion, row: int) -> np.ndarray:
    stop = Stop(arm().limits, motion.period_s)
    stop.begin(*motion.q[np.maximum(row - np.arange(3), 0)])
    rows = [motion.q[row]]
    while not stop.finished:
        rows.append(stop.advance(1))
    return np.array(rows)


def way_back(motion: Motion, row: int) -> np.ndarray:
    end, origin = driven(motion, row)[-1], motion.q[max(row - round(BEFORE_CONTACT_S / motion.period_s), 0)]
    return end + np.linspace(0.0, 1.0, 20)[:, None] * (origin - end)


def post(at: np.ndarray) -> CollisionChecker:
    return CollisionChecker(arm(), Cell(ground_z_m=None, boxes=(Box("post", (0.01,) * 3, tuple(at)),)))


def tip(q: np.ndarray) -> np.ndarray:
    """The point of the flange farthest along its axis."""
    import pinocchio as pin

    model = pin.buildModelFromXML(arm().urdf)
    data = model.createData()
    pin.framesForwardKinematics(model, data, q)
    return data.oMf[model.getFrameId("flange")].translation.copy()


def test_stop_reaches_what_the_motion_passes(curve):
    # A post beyond the end of the stop that leaves the path of the flange furthest.
    path = np.array([tip(q) for q in curve.q])
    ends = np.array([tip(driven(curve, row)[-1]) for row in range(len(curve))])
    aside = np.linalg.norm(path[None] - ends[:, None], axis=2)
    row = int(np.argmax(aside.min(axis=1)))
    away = ends[row] - path[int(np.argmin(aside[row]))]
    checker = post(ends[row] + 0.08 * away / np.linalg.norm(away))
    passed = checker.check_path(curve.q)
    found = nearest_stop(checker, curve, 0.03)
    assert passed.distance > 0.01
    assert found.clearance.distance < passed.distance - 0.005
    assert "post" in found.clearance.pair
    assert found.clearance.time_s == found.clearance.row * T


@pytest.mark.parametrize(
    ("seed", "limit", "spread"), [(0, 0.5, 0.1), (1, 0.5, 0.1), (2, 0.06, 0.08), (4, 0.06, 0.08)]
)
def test_nothing_nearer_is_found_in_every_posture_of_every_stop(curve, seed, limit, spread):
    rng = np.random.default_rng(seed)
    row = int(rng.integers(40, 260))
    checker = post(tip(driven(curve, row)[-1]) + rng.normal(0.0, spread, 3))
    found = nearest_stop(checker, curve, limit)
    every = np.vstack([[*driven(curve, row), *way_back(curve, row)] for row in range(len(curve))])
    least = min(checker.distance(q) for q in every)
    assert least < limit
    # The steps of the search are 1 cm of reach, far less of movement.
    assert least - 1e-3 <= found.clearance.distance <= least + 2e-3
    again = checker.clearance(found.clearance.q).distance
    assert again == pytest.approx(found.clearance.distance, abs=1e-5)


def test_no_distance_changes_faster_than_the_reach_tells():
    rng = np.random.default_rng(0)
    checker = CollisionChecker(arm(), Cell(boxes=(Box("post", (0.1,) * 3, (-0.5, 0.2, 0.6)),)))
    for _ in range(200):
        q = rng.uniform(-1.5, 1.5, 7)
        step = rng.normal(0.0, 0.05, 7)
        change = checker.distance(q + step) - checker.distance(q)
        if checker.distance(q) > 0.0 and checker.distance(q + step) > 0.0:
            assert abs(change) <= checker.reach @ np.abs(step) + 1e-6


def test_stop_at_rest_is_the_posture_itself():
    checker = CollisionChecker(arm(), Cell())
    found = nearest_stop(checker, Motion(np.tile(START, (50, 1)), T), 0.03)
    assert found.clearance.distance == pytest.approx(checker.clearance(START).distance, abs=1e-5)
    assert found.clearance.row == 0


def test_stops_begin_wherever_the_motion_moves_and_one_row_later():
    way = move_to(arm(), START, START + 0.2, T)
    rest = Motion(np.tile(START, (30, 1)), T)
    motion = rest.join(way).join(Motion(np.tile(way.q[-1], (30, 1)), T))
    rows = begins(motion, T)
    assert rows[0] == 0
    assert rows[1] == 30
    assert rows[-1] == 29 + len(way)
    assert len(begins(motion, 0.04)) == pytest.approx(len(rows) / 4, abs=2)


def test_rows_around_others_leave_these_out_and_stay_in_the_motion():
    motion = Motion(np.tile(START, (30, 1)), T)
    assert around(motion, np.array([10]), 0.04, T).tolist() == [7, 8, 9, 11, 12, 13]
    assert around(motion, np.array([0, 29]), 0.03, T).tolist() == [1, 2, 27, 28]
