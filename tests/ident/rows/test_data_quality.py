"""Lost, repeated, stale, clipped and stuck samples, and the work of an earlier filter, in small made channels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ident.rows.data_quality import (
    SampleLoss,
    clipped_at,
    held,
    jumps,
    passed_band,
    sample_loss,
    stale,
    stuck_at,
)
from lwr_driver.session import JointColumns
from tests.ident.rows.noisy_channels import COUNT, RATE, columns, noisy, session


def test_without_a_counter_samples_missing_in_an_even_clock_are_lost():
    kept = np.ones(COUNT, dtype=bool)
    for row, lost in ((300, 1), (700, 4), (1100, 9)):
        kept[row : row + lost] = False
    whole = columns(noisy())

    def left(
        kept: np.ndarray, stamps: np.ndarray = whole.publish_time, numbered: bool = True
    ) -> JointColumns:
        values = {name: getattr(whole, name)[kept] for name in ("position", "velocity", "effort")}
        rows = np.arange(kept.sum()) if numbered else np.zeros(kept.sum(), dtype=np.int64)
        return replace(
            whole, log_time=stamps[kept] + 10**15, publish_time=stamps[kept], sequence=rows, **values
        )

    for numbered in (True, False):
        # The number of the row is no counter of the source.
        (loss,) = sample_loss([session(left(kept, numbered=numbered))])
        # Positions jolt beside a gap, too, and are not stale.
        assert (loss.lost, loss.repeated, loss.stale, loss.samples) == (14, 0, 0, COUNT - 14)
    late = whole.publish_time.copy()
    late[500:1500:100] += round(0.99e9 / RATE)
    assert sample_loss([session(left(np.ones(COUNT, dtype=bool), late))]) == ()
    # A pause of the recording loses nothing, and a clock without a period tells of no loss.
    pause = np.ones(COUNT, dtype=bool)
    pause[500:1000] = False
    uneven = np.cumsum(np.random.default_rng(1).uniform(0.5, 3.0, COUNT) / RATE * 1e9).astype(np.int64)
    assert sample_loss([session(left(pause)), session(left(pause | True, uneven))]) == ()


def test_a_loss_is_counted_by_kind_with_session_and_channel():
    effort = noisy()
    position = columns(effort).position.copy()
    rows = [300, 700, 1100, 1500]
    for values in (effort, position):
        for row in rows:
            values[row] = values[row - 1]
    sequence = np.arange(1, COUNT + 1)
    sequence[1000:] += 6
    (found,) = sample_loss([session(columns(effort, position, sequence), columns(noisy(1)))])
    assert found == SampleLoss("run.mcap", "joint", 6, 4, 0, COUNT)
    assert (found.amiss, found.share) == (10, pytest.approx(10 / (COUNT + 6)))


def test_a_few_samples_or_a_small_share_are_no_finding():
    def matters(repeated: int, samples: int) -> bool:
        return SampleLoss("a", "joint", 0, repeated, 0, samples).matters

    assert [matters(2, 100), matters(3, 100)] == [False, True]
    assert [matters(4, 8000), matters(5, 8000)] == [False, True]
    assert sample_loss([session(columns(noisy()))]) == ()


def test_the_worst_channel_comes_first():
    effort, held = noisy(), noisy(1)
    for row in range(100, 200, 10):
        effort[row] = effort[row - 1]
    for row in range(100, 300, 10):
        held[row] = held[row - 1]
    found = sample_loss([session(columns(effort), columns(held))])
    assert [(one.channel, one.repeated) for one in found] == [("motor", 20), ("joint", 10)]


def test_repeats_of_one_joint_or_of_coarse_sensors_prove_nothing():
    effort = noisy()
    effort[:, 0] = np.repeat(effort[::10, 0], 10)
    assert sample_loss([session(columns(effort))]) == ()
    coarse = np.round(noisy() / 2.0)
    assert np.mean(np.all(np.diff(coarse, axis=0) == 0.0, axis=1)) > 0.5
    assert sample_loss([session(columns(coarse))]) == ()
    one = JointColumns(
        "/j", ("a",), *[np.arange(50)] * 3, np.zeros((50, 1)), np.zeros((50, 0)), np.ones((50, 1))
    )
    assert sample_loss([session(one)]) == ()


def test_stale_samples_are_the_repeated_ones_and_those_of_jolting_positions():
    effort, position = noisy(), columns(noisy()).position.copy()
    assert not stale(columns(effort, position)).any()
    position[800] = position[799]
    effort[800] = effort[799]
    position[1200] += [0.004, 0.004]
    found = np.flatnonzero(stale(columns(effort, position)))
    assert 800 in found
    assert 1200 in found
    assert found.min() >= 798
    assert set(found) <= {*range(798, 804), *range(1198, 1204)}


def test_held_torques_of_a_moving_arm_are_found_and_a_slower_channel_or_a_resting_arm_is_none():
    effort, whole = noisy(), columns(noisy())
    times, path = np.arange(COUNT) * 1e-3, np.outer(np.arange(COUNT) * 1e-3, [0.2, 0.0])
    stopped = effort.copy()
    stopped[900:930] = stopped[899]
    # One repeated sample is no matter, and torques of one joint alone may stay.
    stopped[400] = stopped[399]
    stopped[500:530, 0] = stopped[499, 0]
    assert np.flatnonzero(held(stopped, times, times, path)).tolist() == list(range(900, 930))
    assert not held(stopped, times, times, np.zeros_like(path)).any()
    slower = np.repeat(effort[: COUNT // 8], 8, axis=0)
    assert not held(slower, times[: len(slower)], times, path).any()
    assert not held(whole.effort[:, :1] * 0.0, times, times, path).any()


def test_a_jolt_of_one_joint_of_two_or_beside_a_gap_is_not_stale():
    effort, position = noisy(), columns(noisy()).position.copy()
    position[1200, 0] += 0.004
    assert not stale(columns(effort, position)).any()
    position[1200, 1] += 0.004
    whole = columns(effort, position)
    assert stale(whole).any()
    late = whole.publish_time + np.where(np.arange(COUNT) > 1200, 4_000_000, 0)
    assert not stale(replace(whole, publish_time=late)).any()
    # Without stamps of the source those of the host tell.
    unstamped = replace(whole, publish_time=np.zeros_like(late))
    assert stale(unstamped).any()
    assert not stale(replace(unstamped, log_time=late)).any()


def test_a_clipped_joint_has_its_limit_and_the_others_none():
    effort = noisy()
    effort[:, 0] = np.clip(effort[:, 0], -np.inf, 8.0)
    effort[:, 1] = np.clip(effort[:, 1], -4.5, 4.0)
    assert clipped_at(columns(effort)).tolist() == [8.0, 4.5]
    assert np.isnan(clipped_at(columns(noisy()))).all()
    assert np.isnan(clipped_at(columns(noisy(count=1)))).all()


@pytest.mark.parametrize(("count", "seen"), [(10, False), (11, True)])
def test_a_limit_needs_over_ten_samples_at_it(count: int, seen: bool):
    effort = noisy()
    effort[np.argsort(effort[:, 0])[-count:], 0] = 20.0
    assert np.isfinite(clipped_at(columns(effort))[0]) == seen


@pytest.mark.parametrize(("count", "seen"), [(20, False), (21, True)])
def test_a_limit_has_over_ten_times_the_samples_of_the_values_beside(count: int, seen: bool):
    effort = noisy()
    effort[:, 0] += np.linspace(0.0, 1e-3, COUNT)
    order = np.argsort(effort[:, 0])
    effort[order[-count:], 0] = 20.0
    effort[order[-count - 2 : -count], 0] = 15.0
    assert np.isfinite(clipped_at(columns(effort))[0]) == seen


def test_the_two_next_values_alone_tell_whether_a_limit_is_chance():
    effort = noisy()
    effort[:, 0] += np.linspace(0.0, 1e-3, COUNT)
    order = np.argsort(effort[:, 0])
    effort[order[:12], 0] = -20.0
    # The third next value is frequent, too.
    effort[order[14:18], 0] = effort[order[14], 0]
    assert clipped_at(columns(effort))[0] == 20.0


def test_a_dead_zone_is_counted_in_the_motion_alone():
    effort = noisy()
    effort[np.abs(effort[:, 0]) < 1.0, 0] = 0.0
    position = columns(effort).position.copy()
    (found,) = stuck_at(columns(effort), columns(noisy(), position))
    assert (found.joint, found.value, found.count) == (0, 0.0, int(np.sum(effort[1:, 0] == 0.0)))
    # Every sample but the first, which has no speed, and a few at the turning points.
    assert COUNT - 20 < found.samples < COUNT
    position[:, 0] = 0.3
    assert stuck_at(columns(effort), columns(noisy(), position)) == ()


def test_a_joint_slower_than_a_hundredth_rests():
    effort = noisy()
    effort[np.abs(effort[:, 0]) < 1.0, 0] = 0.0
    time = np.arange(COUNT) / RATE
    for speed, found in ((0.009, 0), (0.011, 1)):
        position = np.column_stack([speed * time, time])
        assert len(stuck_at(columns(effort), columns(noisy(), position))) == found


def test_the_motor_channel_is_compared_at_the_times_of_the_host():
    effort = noisy()
    effort[400:500, 0] = 1.25
    time = np.arange(COUNT) / RATE
    position = np.column_stack([np.where((time > 1.6) & (time < 2.0), 0.0, 0.5 * time), time])
    joint = columns(noisy(), position)
    motor = columns(effort)
    assert stuck_at(motor, joint) == ()
    shifted = replace(motor, log_time=motor.log_time + 2_000_000_000, publish_time=motor.publish_time)
    assert [one.value for one in stuck_at(shifted, joint)] == [1.25]
    assert stuck_at(columns(noisy(count=1)), joint) == ()
    assert stuck_at(motor, columns(noisy(count=1))) == ()


def test_noise_up_to_the_highest_frequency_shows_no_earlier_filter():
    assert passed_band(noisy(), 1.0 / RATE) is None


@pytest.mark.parametrize("edge_hz", [5.0, 20.0])
def test_the_edge_of_an_earlier_filter_is_found(edge_hz: float):
    spectrum = np.fft.rfft(np.random.default_rng(3).normal(size=(4000, 2)), axis=0)
    spectrum[np.fft.rfftfreq(4000, 1.0 / RATE) > edge_hz] = 0.0
    signal = np.fft.irfft(spectrum, axis=0)
    assert passed_band(signal, 1.0 / RATE) == pytest.approx(edge_hz, rel=0.05)
    assert passed_band(np.column_stack([signal, np.ones(4000)]), 1.0 / RATE) == pytest.approx(
        edge_hz, rel=0.05
    )
    assert passed_band(np.column_stack([signal[:, :1], noisy(count=4000)[:, :1]]), 1.0 / RATE) is None


def test_short_or_constant_channels_show_nothing():
    smooth = np.sin(0.05 * np.arange(200))[:, None]
    assert passed_band(np.ones((200, 2)), 0.004) is None
    assert passed_band(smooth[:63], 0.004) is None


def test_samples_of_an_older_moment_are_counted_once_each():
    effort, position = noisy(), columns(noisy()).position.copy()
    time = np.arange(COUNT) / RATE
    for row in (400, 900, 1300, 1700):
        position[row] = [np.sin(time[row] - 0.5 / RATE), np.cos(1.3 * (time[row] - 0.5 / RATE))]
    (found,) = sample_loss([session(columns(effort, position))])
    assert (found.lost, found.repeated, found.stale) == (0, 0, 4)


def test_the_limit_of_a_single_joint_is_found():
    whole = columns(np.clip(noisy(), -np.inf, 8.0))
    one = replace(whole, names=("a",), position=whole.position[:, :1], effort=whole.effort[:, :1])
    assert clipped_at(one).tolist() == [8.0]


def swings(count: int = COUNT) -> tuple[np.ndarray, np.ndarray]:
    """Times (n,) and positions (n, 2) with the noise of an encoder."""
    time = np.arange(count) / RATE
    noise = 2e-5 * np.random.default_rng(3).normal(size=(count, 2))
    return time, np.column_stack([np.sin(time), 0.5 * np.cos(1.3 * time)]) + noise


@pytest.mark.parametrize("size", [-2.0 * np.pi, 0.3])
def test_a_position_elsewhere_in_the_next_sample_is_a_jump(size: float) -> None:
    time, position = swings()
    position[900:, 1] += size
    (found,) = jumps(time, position)
    assert (found.joint, found.behind) == (1, 900)
    assert found.size == pytest.approx(size, abs=0.01)


def test_samples_left_out_are_a_jump_unless_the_stamps_say_so() -> None:
    time, position = swings()
    kept = np.delete(np.arange(COUNT), np.arange(700, 1000))
    closed = jumps(time[: len(kept)], position[kept])
    assert {jump.behind for jump in closed} == {700}
    assert jumps(time[kept], position[kept]) == ()


def test_wrong_samples_noise_steps_and_sudden_motion_are_no_jumps() -> None:
    time, position = swings()
    spikes = position.copy()
    spikes[[300, 800], 0] += 1.0
    spikes[1200:1203, 1] -= 0.7
    held = position[np.arange(COUNT) // 7 * 7]
    coarse = np.round(position / 0.0015) * 0.0015
    starting = np.where(
        time[:, None] < 4.0, position[:1], position[:1] + np.maximum(time - 4.0, 0.0)[:, None]
    )
    late = position.copy()
    for row in range(100, COUNT - 10, 97):
        late[row : row + 4] = late[row - 1]
    noise = 1e-3 * np.random.default_rng(5).normal(size=position.shape)
    for healthy in (position, spikes, held, coarse, starting, late, noise, position[:9], 0.0 * position):
        assert jumps(time[: len(healthy)], healthy) == ()
