"""The step of the controller's set point, and what makes it unknown."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from lwr_driver.setpoint import SetpointHistory
from tests.lwr_driver.driver_rig import START, arm

NONE = np.zeros(7)


def history() -> SetpointHistory:
    made = SetpointHistory(arm().limits)
    made.set_period(1e-3)
    return made


def step_after(steps: list[NDArray[np.float64]]) -> NDArray[np.float64] | None:
    """The step found after a set point has moved by these [rad]."""
    setpoints, q = history(), START.astype(np.float64)
    for step in steps:
        q = q + step
        setpoints.add(q.astype(np.float32), 1)
    return setpoints.step()


def test_a_set_point_is_unknown_until_the_third_packet() -> None:
    assert step_after([NONE]) is None
    # At rest two packets say enough.
    assert step_after([NONE, NONE]) is not None
    moved = np.full(7, 1e-4)
    assert step_after([NONE, moved]) is None
    assert step_after([NONE, moved, moved]) is not None


def test_a_set_point_that_changes_its_step_beyond_the_acceleration_limit_is_unknown() -> None:
    a, t = arm().limits.a_max, 1e-3
    room = a * t**2 + 1e-5
    steady = 0.2 * arm().limits.v_max * t
    assert step_after([NONE, steady, steady]) == pytest.approx(steady, abs=1e-6)
    # Float32 adds a few 1e-7 rad.
    assert step_after([NONE, steady, steady + 0.9 * room]) is not None
    assert step_after([NONE, steady, steady + 1.1 * room]) is None
    assert step_after([NONE, steady, steady - 1.1 * room]) is None
    assert step_after([NONE, steady, np.full(7, np.nan)]) is None


def test_a_set_point_faster_than_the_arm_is_unknown() -> None:
    fast = arm().limits.v_max * 1e-3
    assert step_after([NONE, 0.99 * fast, 0.99 * fast]) is not None
    assert step_after([NONE, 1.01 * fast, 1.01 * fast]) is None


def test_a_set_point_that_hardly_moves_is_at_rest() -> None:
    still = step_after([NONE, NONE, np.full(7, 0.8e-5)])
    assert still is not None
    np.testing.assert_array_equal(still, NONE)
    moving = step_after([NONE, NONE, np.full(7, 1.2e-5)])
    assert moving is not None
    assert moving.any()


def test_over_lost_packets_a_step_is_counted_by_cycle() -> None:
    setpoints = history()
    steady = 0.2 * arm().limits.v_max * 1e-3
    for cycles, since in ((0, 1), (2, 2), (6, 4)):
        setpoints.add((START + cycles * steady).astype(np.float32), since)
    np.testing.assert_allclose(setpoints.step(), steady, atol=1e-6)
