"""Pushes on the emulated arm in motion: noticed in time."""

from __future__ import annotations

import pytest

from benchmarks.trust.contact import PROMISED, push


@pytest.mark.parametrize("ahead", [False, True], ids=["answered by the loop", "answered ahead"])
@pytest.mark.parametrize(("joint", "torque", "seed"), [(1, 30.0, 99), (1, -30.0, 99), (5, 8.0, 126)])
def test_a_push_is_decided_on_in_time_and_ends_the_motion(ring, joint, torque, seed, ahead):
    run = push(joint, torque, 5, seed, ring, ahead=ahead)
    assert run.bad == []
    assert run.decided is not None
    assert run.decided <= PROMISED
    assert run.rest is not None


@pytest.mark.slow
def test_an_obstacle_is_left_again(ring):
    run = push(3, 0.0, 5, 4, ring, spring=True)
    assert run.bad == []
    assert run.left < 0.1 * run.peak
    assert "went back" in run.reason
