"""The motion of a session from wherever the arm is."""

from __future__ import annotations

import numpy as np

from lwr_driver.arm import Arm
from lwr_driver.cell import Cell
from lwr_driver.motion import Motion
from runner.experiment_file import DEFAULT, Experiment
from runner.preflight import Preflight
from runner.preparation import session_motion
from runner.route import dwell

HOME = np.array([0.0, 0.5, 0.0, -1.3, 0.0, 0.8, 0.0])


def turned(joint: int, angle: float) -> np.ndarray:
    pose = HOME.copy()
    pose[joint] = angle
    return pose


def prepared(start: np.ndarray, first: np.ndarray) -> tuple[Motion, Preflight]:
    experiment = Experiment.load(DEFAULT)
    excitation = dwell(first, 0.5, 0.004, "excite")
    cell = Cell.load(experiment.cell)
    return session_motion(experiment, Arm.load(), cell, experiment.sessions[0], excitation, start)


def distance(preflight: Preflight) -> tuple[str, bool]:
    item = next(item for item in preflight.items if item.subject == "distance to the start")
    return item.value, item.ok


def test_a_start_too_far_for_one_move_is_reached_over_home() -> None:
    motion, preflight = prepared(turned(2, 0.8), turned(2, -2.5))
    assert preflight.ok, [item for item in preflight.items if not item.ok]
    assert distance(preflight) == ("E1 0.80 rad", True)
    approach = motion.q[: np.argmin(np.abs(motion.q[:, 2] + 2.5))]
    assert np.any(np.all(np.abs(approach - HOME) < 1e-9, axis=1))


def test_a_start_within_one_move_is_reached_straight() -> None:
    motion, preflight = prepared(turned(2, 0.8), turned(2, -1.5))
    assert preflight.ok
    assert distance(preflight) == ("E1 2.30 rad", True)
    approach = motion.q[: np.argmin(np.abs(motion.q[:, 2] + 1.5)), 2]
    assert np.all(np.diff(approach) <= 1e-12)


def test_from_home_every_start_may_be_reached() -> None:
    _, preflight = prepared(HOME, turned(3, 1.9))
    assert distance(preflight) == ("A1 0.00 rad", True)


def test_an_arm_far_from_home_and_from_the_start_is_refused() -> None:
    _, preflight = prepared(turned(3, 2.0), turned(3, -1.5))
    assert distance(preflight) == ("A3 3.50 rad", False)
