"""The command monitor: finds what breaks a limit, and nothing else."""

import numpy as np
import pytest

from lwr_driver.arm import Arm
from sim_backend.monitor import QUANTITIES, CommandMonitor

ARM = Arm.load("lwr4plus.yaml")
PERIOD = 1e-3


def judged(commands, cycles=None, start=None):
    monitor = CommandMonitor(ARM, PERIOD)
    monitor.rest(commands[0] if start is None else start, 0)
    for cycle, command in zip(cycles or range(1, len(commands) + 1), commands, strict=True):
        monitor.take(np.asarray(command, np.float32), cycle)
    return monitor


def smooth(amplitude, seconds=2.0, offset=0.0):
    """Rest to rest, minimum-jerk polynomial of all joints."""
    s = np.linspace(0.0, 1.0, round(seconds / PERIOD) + 1)
    path = s**3 * (10 - 15 * s + 6 * s**2)
    return offset + amplitude * path[:, None] * np.ones(7)


@pytest.mark.parametrize("offset", [0.0, 0.9, 1.5])
def test_a_motion_within_limits_has_no_violation_although_float32_makes_it_rough(offset):
    # Peak jerk 60 A / T^3 = 4 rad/s^3; the third difference of float32 at 1 ms alone shows several hundred.
    monitor = judged(smooth(0.53, offset=offset))
    assert monitor.violations.sum() == 0
    assert np.abs(monitor.worst[3]).max() > 60.0
    assert monitor.ratio[1].max() == pytest.approx(1.875 * 0.53 / 2.0 / ARM.v_max.min(), rel=0.02)


@pytest.mark.parametrize(
    ("row", "commands"),
    [
        (0, smooth(0.01, offset=2.0900)),
        (1, smooth(1.9, seconds=1.0)),
        (2, np.concatenate([np.zeros((5, 7)), np.cumsum(np.full((300, 7), 9e-6), 0).cumsum(0) * 1.0])),
        (3, np.concatenate([np.zeros((5, 7)), np.full((1, 7), 1e-6), np.full((4, 7), 4e-6)])),
    ],
    ids=QUANTITIES,
)
def test_each_quantity_is_found_when_it_breaks_its_limit(row, commands):
    monitor = judged(commands)
    assert monitor.violations[row].sum() > 0
    assert monitor.first_violation is not None


def test_a_jump_from_the_setpoint_at_the_start_is_seen():
    monitor = judged([np.full(7, 0.3)], start=np.zeros(7))
    assert monitor.violations[1].sum() == 7
    assert "velocity" in monitor.first_violation or "jerk" in monitor.first_violation


def test_missing_commands_do_not_count_against_a_good_motion():
    commands = smooth(0.53)
    keep = np.flatnonzero(np.random.default_rng(4).random(len(commands)) > 0.2)
    monitor = judged(commands[keep], cycles=[int(k) + 1 for k in keep], start=commands[0])
    assert monitor.violations.sum() == 0


def test_not_a_number_is_a_violation():
    monitor = judged([np.zeros(7), np.full(7, np.nan)])
    assert monitor.violations.sum() > 0


def test_reset_forgets_the_extremes_but_not_the_motion():
    monitor = judged(smooth(1.9, seconds=1.0)[:400])
    monitor.reset()
    assert monitor.summary()["violations"] == 0
    monitor.take(np.full(7, -1.0, np.float32), 401)
    assert monitor.summary()["violations"] > 0
