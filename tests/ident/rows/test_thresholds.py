"""The thresholds of lost, stale and held samples, each from both sides."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ident.rows.data_quality import (
    SampleLoss,
    _behind,
    _flat,
    _jolts,
    _repeated,
    _same,
    held,
    passed_band,
    sample_loss,
    stale,
    stuck_at,
)
from tests.ident.rows.noisy_channels import RATE, columns, noisy, session

STEP = 1e-3


def even(count: int = 60) -> np.ndarray:
    """Two joints at one step of the encoder a sample, in opposite directions."""
    return STEP * np.column_stack([np.arange(count), -np.arange(count)]).astype(float)


@pytest.mark.parametrize(("back", "found"), [(21.2, []), (21.5, [30, 31])])
def test_a_jolt_is_sixteen_times_four_steps_of_the_encoder(back: float, found: list[int]) -> None:
    position = even()
    # A sample that lies back has third differences of one and of three times its displacement.
    position[30] -= back * STEP * np.array([1.0, -1.0])
    assert np.flatnonzero(_jolts(position)).tolist() == found


@pytest.mark.parametrize(("back", "found"), [(4.9, False), (5.2, True)])
def test_a_jolt_is_sixteen_times_the_usual_third_difference(back: float, found: bool) -> None:
    place = np.arange(61) - 20.0
    position = np.column_stack([place**3, 2.0 * place**3]) / 6.0
    # The steps at its turning point are small. A displacement back adds three of itself at most.
    position[25] -= back * np.array([1.0, 2.0])
    assert _jolts(position).any() == found


def test_most_of_the_moving_joints_jolt_in_a_stale_sample() -> None:
    path = STEP * np.outer(np.arange(60.0), [1.0, -1.0, 2.0, 3.0])
    for joints, seen in ((2, False), (3, True)):
        position = path.copy()
        position[30, :joints] -= 70.0 * (path[30] - path[29])[:joints]
        assert (_jolts(np.hstack([position, np.zeros((60, 3))]))).any() == (seen and joints == 3)
    assert not _jolts(path[:, :1]).any()
    assert not _jolts(path[:3]).any()
    assert not _jolts(np.zeros((0, 2))).any()


@pytest.mark.parametrize(("age", "found"), [(0.14, False), (0.16, True), (1.0, True)])
def test_a_stale_sample_lies_back_by_a_share_of_its_progress(age: float, found: bool) -> None:
    position = even()
    position[30] -= age * STEP * np.array([1.0, -1.0])
    seen = np.flatnonzero(_behind(position, np.ones(2, dtype=bool)))
    assert set(seen.tolist()) >= ({29, 30, 31} if found else set())
    assert (30 in seen) == found


@pytest.mark.parametrize(("across", "found"), [(0.56, True), (0.60, False)])
def test_a_stale_sample_lies_back_along_the_motion(across: float, found: bool) -> None:
    position = even()
    # Sixty degrees off the motion the distance across is sqrt(3)/2 of the whole, thirty degrees off a half.
    position[30] -= STEP * (np.array([1.0, -1.0]) + across * np.array([1.0, 1.0]))
    assert _behind(position, np.ones(2, dtype=bool))[30] == found


def test_three_or_four_samples_have_no_path_to_lie_behind() -> None:
    assert _behind(even(4), np.ones(2, dtype=bool)).tolist() == [False] * 4
    position = even(5)
    position[2] = position[1]
    assert _behind(position, np.ones(2, dtype=bool)).tolist() == [False, True, True, True, False]


@pytest.mark.parametrize("before", [0, 3, 4, 5])
def test_positions_within_four_samples_of_a_gap_are_not_stale(before: int) -> None:
    position, effort = even(120), noisy(count=120)
    position[60] -= 40.0 * STEP * np.array([1.0, -1.0])
    for gap in (61 + before + 1, 60 - before - 1):
        stamps = np.arange(120) * 4_000_000
        stamps[gap:] += 4_000_000
        found = np.flatnonzero(stale(replace(columns(effort, position), publish_time=stamps))).tolist()
        far = [k for k in (60, 61) if abs(k - gap) > 4]
        assert found == far


@pytest.mark.parametrize(("late", "gap"), [(0.49, False), (0.51, True), (-0.49, False), (-0.51, True)])
def test_an_interval_off_by_half_of_the_usual_one_is_a_gap(late: float, gap: bool) -> None:
    position, effort = even(120), noisy(count=120)
    position[60] -= 40.0 * STEP * np.array([1.0, -1.0])
    stamps = np.arange(120) * 4_000_000
    stamps[61:] += round(late * 4e6)
    assert stale(replace(columns(effort, position), publish_time=stamps)).any() != gap


@pytest.mark.parametrize(("length", "found"), [(4, False), (5, True)])
def test_held_torques_last_five_times_the_usual_interval(length: int, found: bool) -> None:
    effort = noisy(count=400)
    times, path = np.arange(400) * 1e-3, np.outer(np.arange(400) * 1e-3, [0.2, 0.0])
    effort[100 : 100 + length] = effort[99]
    expected = list(range(100, 100 + length)) if found else []
    assert np.flatnonzero(held(effort, times, times, path)).tolist() == expected
    # A channel with every third stamp new: three times as long.
    slow = np.repeat(noisy(count=140), 3, axis=0)[:400]
    slow[99 : 99 + 3 * length] = slow[98]
    assert held(slow, times, times, path).any() == found


@pytest.mark.parametrize(("speed", "found"), [(0.0099, False), (0.0101, True), (-0.0101, True)])
def test_torques_are_held_while_one_joint_moves(speed: float, found: bool) -> None:
    effort = noisy(count=400)
    times = np.arange(400) * 1e-3
    effort[100:140] = effort[99]
    path = np.outer(times, [0.0, speed])
    assert held(effort, times, times, path).any() == found
    # The motion counts while they are held, not before.
    still = np.outer(np.minimum(times, 0.099), [0.0, 1.0])
    assert not held(effort, times, times, still).any()


def test_a_value_is_flat_from_eleven_times_its_neighbours_on() -> None:
    others = np.arange(5.0)
    for count, found in ((10, []), (11, [(2.0, 11)])):
        assert _flat(np.concatenate([others, np.full(count - 1, 2.0)])) == found
    # Ten are needed, even beside values of a single count less than one.
    twice = np.repeat([0.0, 1.0, 3.0, 4.0], 2)
    for count, found in ((20, []), (21, [(2.0, 21)])):
        assert _flat(np.concatenate([twice, np.full(count, 2.0)])) == found
    assert _flat(np.concatenate([np.full(30, 1.0), [2.0]])) == []


def test_samples_with_the_torques_of_the_one_before_are_the_same() -> None:
    effort = np.array([[1.0, 2.0], [1.0, 2.0], [1.0, 3.0], [1.0, 3.0], [2.0, 3.0]])
    assert _same(effort).tolist() == [False, True, False, True, False]
    assert not _same(effort[:, :1]).any()
    assert (_repeated(effort[:, :1]), _repeated(effort[:2])) == (0, 0)


def test_repeats_beyond_those_of_coarse_values_are_counted() -> None:
    effort = noisy(count=4000)
    assert _repeated(effort) == 0
    rows = np.arange(100, 3900, 50)
    effort[rows] = effort[rows - 1]
    assert _repeated(effort) == len(rows)
    # Each joint of a coarse channel stays in half of its samples, both in a quarter by chance.
    coarse = np.random.default_rng(0).integers(0, 2, (4000, 2)).astype(float)
    assert _repeated(coarse) == 0
    held_rows = np.arange(100, 3900, 4)
    coarse[held_rows] = coarse[held_rows - 1]
    # Three quarters of those repeated on purpose are more than chance; three deviations of it are kept back.
    assert 0.55 * len(held_rows) < _repeated(coarse) < len(held_rows)


def test_old_samples_are_counted_once_with_those_lost() -> None:
    effort, position = noisy(count=400), STEP * np.outer(np.arange(400.0), [1.0, -2.0])
    for row in (100, 200, 300):
        position[row] = position[row] - 30.0 * (position[row] - position[row - 1])
    (found,) = sample_loss([session(columns(effort, position))])
    assert (found.session, found.channel) == ("run.mcap", "joint")
    assert (found.lost, found.repeated, found.stale, found.samples) == (0, 0, 3, 400)


@pytest.mark.parametrize(
    ("lost", "usual", "beyond"),
    [(20, 0.0, True), (20, 0.01, False), (33, 0.01, False), (34, 0.01, True), (40, 0.02, False)],
)
def test_losses_are_told_beyond_twice_the_usual_share_and_chance(
    lost: int, usual: float, beyond: bool
) -> None:
    """Of 1000 samples; twice a hundredth are 20, and three standard deviations of them 13.4."""
    assert SampleLoss("run.mcap", "joint", lost, 0, 0, 1000 - lost).beyond(usual) is beyond


@pytest.mark.parametrize(("share", "silent"), [(3e-6, True), (1e-4, False)])
def test_a_sensor_has_a_ten_billionth_of_its_power_in_the_upper_half(share: float, silent: bool) -> None:
    time = np.arange(2048) / RATE
    signal = np.sin(2 * np.pi * 5.0 * time) + share * np.sin(2 * np.pi * 100.0 * time)
    assert (passed_band(signal[:, None], 1.0 / RATE) is not None) == silent
    quarter = np.sin(2 * np.pi * 5.0 * time) + 1e-2 * np.sin(2 * np.pi * 40.0 * time)
    assert passed_band(quarter[:, None], 1.0 / RATE) == pytest.approx(40.0, abs=0.5)


@pytest.mark.parametrize(("share", "edge_hz"), [(5e-4, 5.0), (3e-3, 30.0)])
def test_the_edge_of_a_filter_leaves_a_millionth_of_the_power(share: float, edge_hz: float) -> None:
    time = np.arange(2048) / RATE
    signal = np.sin(2 * np.pi * 5.0 * time) + share * np.sin(2 * np.pi * 30.0 * time)
    assert passed_band(signal[:, None], 1.0 / RATE) == pytest.approx(edge_hz, abs=0.6)


def test_sixty_four_samples_are_enough_for_a_band() -> None:
    place = np.arange(64) - 31.5
    window = (np.sin(0.3 * place) * np.exp(-((place / 7.0) ** 2)))[:, None]
    assert passed_band(window, 0.004) is not None
    assert passed_band(window[:63], 0.004) is None


def test_stuck_torques_are_those_of_moving_joints() -> None:
    effort = noisy(count=600)
    effort[100:140, 1] = 0.5
    time = np.arange(600) / RATE
    position = np.column_stack([0.1 * time, 0.1 * time])
    (found,) = stuck_at(columns(effort), columns(noisy(count=600), position))
    # The first sample has no speed.
    assert (found.joint, found.value, found.count, found.samples) == (1, 0.5, 40, 599)


def test_two_fresh_samples_already_tell_the_usual_interval() -> None:
    effort = np.repeat(noisy(count=2), [20, 180], axis=0)
    times = np.arange(200) * 1e-3
    # The first is kept for 20 samples, the second for nine times as long.
    assert np.flatnonzero(held(effort, times, times, times[:, None])).tolist() == list(range(21, 200))
