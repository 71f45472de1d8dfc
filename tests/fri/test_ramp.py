from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from fri.krc import KrcPolicy
from fri.track import SetpointTrack, StopRamp
from tests.fri.fri_rig import A_MAX, LIMITS, Q_MAX, Q_START, V_MAX

JERK = A_MAX / 0.02
DT = 1e-4


def sampled(q: np.ndarray, v: np.ndarray) -> tuple[StopRamp, np.ndarray]:
    ramp = StopRamp(q, v, A_MAX, JERK, -Q_MAX, Q_MAX)
    times = np.arange(0, int(ramp.duration_s / DT) + 30) * DT
    return ramp, ramp.position(times)


@given(st.lists(st.floats(-1.0, 1.0), min_size=7, max_size=7))
def test_ramp_goes_on_with_the_velocity_and_comes_to_rest_within_its_bounds(fractions):
    v = np.array(fractions) * V_MAX
    _, positions = sampled(np.zeros(7), v)
    velocity = np.diff(positions, axis=0) / DT
    acceleration = np.diff(velocity, axis=0) / DT
    jerk = np.diff(acceleration, axis=0) / DT
    assert np.allclose(velocity[0], v, atol=JERK.max() * DT**2)
    assert np.allclose(positions[-20:], positions[-1], atol=1e-12)
    assert (np.abs(acceleration) <= A_MAX * 1.0001 + 1e-6).all()
    assert (np.abs(jerk) <= JERK * 1.001 + 1e-2).all()
    assert (np.abs(velocity) <= np.abs(v) + 1e-9).all()


def test_stopping_distance_is_that_of_the_closed_form():
    # v above a^2/j: mean speed v/2 over v/a + a/j.
    v = np.full(7, 1.0)
    a, j = np.full(7, 10.0), np.full(7, 500.0)
    ramp = StopRamp(np.zeros(7), v, a, j, -Q_MAX, Q_MAX)
    assert np.isclose(ramp.duration_s, 1.0 / 10.0 + 10.0 / 500.0)
    assert np.allclose(ramp.position(np.array([1.0])), 0.5 * ramp.duration_s)


def test_ramp_does_not_leave_the_ends_of_travel():
    _, positions = sampled(Q_MAX - 1e-3, V_MAX)
    assert (positions <= Q_MAX).all()
    assert np.allclose(positions[-1], Q_MAX)


def test_ramp_that_begins_outside_goes_no_further():
    _, positions = sampled(Q_MAX + 0.01, V_MAX)
    assert np.allclose(positions, Q_MAX + 0.01)


def test_missing_commands_are_bridged_at_the_pace_of_the_last_ones():
    track = SetpointTrack(LIMITS, KrcPolicy(), Q_START)
    step = np.linspace(-1e-3, 1e-3, 7)
    for begin in (Q_START, Q_START + 0.1):
        track.place(begin)
        track.command(begin + step)
        # From rest the first command is a step of one cycle.
        np.testing.assert_allclose(track.extrapolated(), begin + 2 * step, atol=1e-12)
        np.testing.assert_allclose(track.bridge()[-1], begin + 2 * step, atol=1e-12)
        # After two cycles without a command the next one is a step of three.
        track.bridge()
        change, span = track.change_of_step(begin + 4 * step)
        np.testing.assert_allclose(change, 0.0, atol=1e-12)
        assert span == 2.0
        track.command(begin + 4 * step)
        np.testing.assert_allclose(track.extrapolated(), begin + 5 * step, atol=1e-12)


def test_a_step_is_counted_over_the_cycles_since_the_command_before():
    track = SetpointTrack(LIMITS, KrcPolicy(), Q_START)
    step = np.full(7, 1e-3)
    # From rest, over one cycle.
    change, cycles = track.change_of_step(Q_START + step)
    np.testing.assert_allclose(change, step)
    assert cycles == 1.0
    track.command(Q_START + step)
    np.testing.assert_allclose(track.extrapolated(), Q_START + 2.0 * step)
    change, cycles = track.change_of_step(Q_START + 2.5 * step)
    np.testing.assert_allclose(change, 0.5 * step)
    assert cycles == 1.0
    track.bridge()
    track.bridge()
    assert track.missed == 2
    # Three cycles after the last command, in the mean two from the middle of one step to that of the other.
    change, cycles = track.change_of_step(Q_START + 7.0 * step)
    np.testing.assert_allclose(change, step)
    assert cycles == 2.0
    track.command(Q_START + 7.0 * step)
    assert track.missed == 0
    np.testing.assert_allclose(track.extrapolated(), Q_START + 9.0 * step)
    assert track.change_of_step(Q_START + 9.0 * step)[1] == 2.0
    track.rest()
    np.testing.assert_allclose(track.extrapolated(), Q_START + 7.0 * step)
    assert track.change_of_step(Q_START)[1] == 1.0
