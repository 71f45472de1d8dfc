"""A loop with a processor of its own looks out for the packet that is due; nothing else changes by it."""

from __future__ import annotations

import copy

import numpy as np
import pytest
from driver_rig import START, Rig, arm

from lwr_driver.control import Mode
from lwr_driver.guard import Guard
from lwr_driver.motion import move_to


@pytest.fixture
def rig():
    rig = Rig(period_ms=2, lock_step=False)
    yield rig
    rig.close()


# Constant, or computed anew by every check.
BESIDE = ("_control", "_plan", "_stop", "_limits", "_guard", "_values", "_errors", "_excess")


def state(commander):
    both = {**vars(commander), **{f"guard{name}": value for name, value in vars(commander._guard).items()}}
    return copy.deepcopy({k: v for k, v in both.items() if k.removeprefix("guard") not in BESIDE})


def test_rehearsal_has_no_effect_on_what_is_sent(rig):
    rig.enter()
    rig.start(move_to(arm(), rig.target.astype(float), START + 0.1, rig.period_s))
    rig.cycles(30)
    loop = rig.loop
    assert loop.mode is Mode.MOTION
    before = state(loop._commander)
    tracking = rig.control.tracking.copy()
    loop._commander.rehearse(loop._krl + loop._offset, loop._q)
    np.testing.assert_equal(state(loop._commander), before)
    np.testing.assert_array_equal(rig.control.tracking, tracking)


def test_a_check_that_is_not_remembered_finds_the_same_and_leaves_no_trace():
    guard = Guard(arm().limits, 1e-3)
    q = START.astype(np.float32)
    guard.reset(q)
    far = q + np.float32(0.01)
    assert guard.check(far, 1, remember=False) is not None
    assert guard.check(q, 1, remember=False) is None
    assert guard.check(q, 1) is None


def test_looking_out_ends_when_the_packet_is_there_and_when_it_does_not_come(rig):
    rig.enter()
    rig.loop.looks_out = True
    for _ in range(5):
        rig.loop._look_out()
        rig.cycle()
    # None is sent now.
    rig.loop._look_out()
    assert not rig.loop.remote.pending()
    assert rig.loop.mode is Mode.HOLD
