"""The parts of the way to rows by themselves: reversals, filters, grids, bins, averages, arguments."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import butter

from fri.errors import ConfigurationError, DataError
from ident.dynamics.structure import ModelStructure
from ident.rows import filters
from ident.rows.binned import bins
from ident.rows.filters import (
    Excitation,
    ParallelFilter,
    SignalSettings,
    advice,
    block_means,
    excitation_frequency,
    half_width,
    interpolate_uniform,
    low_pass,
    median_step,
    moving,
    settling,
    thinning,
)
from ident.rows.observation import commanded, observe, stack
from ident.rows.prepare import prepare
from ident.rows.reversals import RINGING_S, away_from_reversals, away_of_drives, turning_reach
from ident.rows.sessions import payload_name, require, stated_mass
from ident.rows.timebase import flag_outliers, sample_period, stretches
from lwr_driver.session import Phase, Session
from tests.ident import estimation_arm as arm

# ---- reversals ----


def test_samples_within_the_window_of_a_reversal_and_at_standstill_are_left_out():
    speed = np.where(np.arange(40) < 20, -1.0, 1.0)[:, None]
    away = away_from_reversals(speed, 0.01, 0.03, 0.002, 1e-3)[:, 0]
    assert np.flatnonzero(~away).tolist() == [17, 18, 19, 20, 21, 22]
    assert away_from_reversals(speed, 0.01, 0.0, 0.002, 0.0).all()
    for rate, rests in ((0.002, True), (0.0021, False)):
        for sign in (1.0, -1.0):
            slow = np.full((5, 1), sign * rate)
            assert away_from_reversals(slow, 0.01, 0.0, 0.002, 0.0).any() != rests


def test_a_slow_joint_has_to_go_on_for_the_path_on_which_friction_turns():
    speed = np.concatenate([np.zeros(10), np.full(50, 0.01), np.full(50, -0.1)])[:, None]
    away = away_from_reversals(speed, 0.01, 0.02, 0.002, 1e-3)[:, 0]
    # 0.1 mrad a sample forwards, so the tenth counts again; backwards 1 mrad, so the window alone.
    assert np.flatnonzero(away).tolist() == [*range(19, 58), *range(62, 110)]
    assert away_from_reversals(speed, 0.01, 0.0, 0.002, 0.0)[10:].all()
    assert turning_reach(0.02, 0.002, 1e-3) == pytest.approx(0.52)
    assert turning_reach(0.0, 0.002, 0.0) == RINGING_S


def test_two_joints_are_left_out_where_the_drive_that_they_share_turns():
    speed = np.column_stack([np.full(60, 1.0), np.linspace(-2.0, -0.5, 60), np.full(60, 0.4)])
    both = away_from_reversals((speed[:, 0] + speed[:, 1])[:, None], 0.01, 0.03, 0.002, 1e-3)[:, 0]
    assert 0 < np.sum(~both) < 20
    away = away_of_drives(speed, 0.01, 0.03, 0.002, 1e-3, coupled=[(0, 1)])
    np.testing.assert_array_equal(away[3:-3, :2], np.column_stack([both, both])[3:-3])
    assert away[3:-3, 2].all()
    # Nor where it is slow; a joint alone is judged by its own speed.
    slow = away_of_drives(speed, 0.01, 0.0, 0.002, 0.0, slow_rad_s=0.45, coupled=[(0, 1)])
    np.testing.assert_array_equal(slow[:, 0], np.abs(speed[:, 0] + speed[:, 1]) > 0.45)
    assert not slow[:, 2].any()
    assert away_of_drives(speed, 0.01, 0.0, 0.002, 0.0, slow_rad_s=0.45)[:, 0].all()


def test_rows_of_coupled_joints_are_left_out_beside_a_reversal_of_their_sum():
    session = arm.session()
    plain = prepare(session)
    names = session.joint_names
    pair = prepare(session, SignalSettings(coupled=((names[0], names[1]),)))
    for one, other in zip(plain.passages, pair.passages, strict=True):
        fewer = one.joint.known.sum(axis=0) - other.joint.known.sum(axis=0)
        assert min(fewer[:2]) > 0
        assert not fewer[2:].any()
    assert SignalSettings(coupled=(("a", "b"), ("b", "z"))).coupled_places(["b", "a"]) == ((1, 0),)


def test_a_link_that_rings_after_a_move_tells_nothing_of_its_drive():
    t = 0.002 * np.arange(1000)
    move, ring = 0.5 * np.sin(np.pi * t), -0.05 * np.sin(2.0 * np.pi * 7.0 * (t - 1.0))
    speed = np.where(t < 1.0, move, ring)
    away = away_from_reversals(speed[:, None], 0.002, 0.0, 0.002, 0.0)[:, 0]
    assert away[5:480].all()
    # The last swing has no end yet.
    assert not away[500:920].any()
    slow = away_from_reversals(
        np.where(t < 1.0, move, np.sin(2.0 * np.pi * 3.0 * t))[:, None], 0.002, 0.0, 0.002, 0.0
    )
    assert np.mean(slow[500:]) > 0.95


# ---- settings and filters ----


def test_unset_settings_are_those_of_the_paper_as_far_as_the_rate_carries_them():
    plain = SignalSettings()
    assert (plain.cutoff, plain.decimate, plain.reversal, plain.order) == (10.0, 2.0, 0.05, 4)
    assert (plain.slow, plain.settled(1000.0).slow_rad_s) == (0.0, 0.0)
    assert (plain.turning, plain.settled(1000.0).turning_rad) == (1e-3, 1e-3)
    assert SignalSettings(reversal_s=0.0).turning == 0.0
    assert (plain.row_rate_hz, plain.edge) == (5.0, 0.2)
    at_1khz, at_40hz, at_10hz = (plain.settled(rate) for rate in (1000.0, 40.0, 10.0))
    assert (at_1khz.cutoff_hz, at_1khz.decimate_hz, at_1khz.reversal_s) == (10.0, 2.0, 0.05)
    assert (at_40hz.cutoff_hz, at_40hz.decimate_hz) == (8.0, 2.0)
    assert (at_10hz.cutoff_hz, at_10hz.decimate_hz) == (2.0, pytest.approx(2.0 / 1.5))
    stated = SignalSettings(
        cutoff_hz=4.0,
        decimate_hz=3.0,
        reversal_s=0.01,
        turning_rad=0.003,
        slow_rad_s=0.02,
        rate_hz=7.0,
        edge_s=0.3,
    )
    assert stated.settled(1000.0) == stated
    assert (stated.row_rate_hz, stated.edge) == (7.0, 0.3)
    assert SignalSettings(decimate_hz=30.0).settled(100.0).cutoff_hz == 30.0


@pytest.mark.parametrize(
    "bad",
    [{"reversal_s": -0.01}, {"stiffness_nm_rad": (1.0, 0.0)}, {"order": 0}, {"outlier_scale": 0.0}],
)
def test_impossible_values_are_refused(bad):
    with pytest.raises(ConfigurationError, match=next(iter(bad))):
        SignalSettings(**bad)
    assert SignalSettings(reversal_s=0.0, cutoff_hz=2.0, decimate_hz=2.0).reversal == 0.0


def test_a_low_pass_of_a_short_series_is_padded_by_what_there_is():
    assert low_pass(np.ones((5, 2)), 0.01, 10.0) == pytest.approx(np.ones((5, 2)), abs=1e-9)
    with pytest.raises(ConfigurationError):
        low_pass(np.ones((50, 1)), 0.01, 50.0)
    low_pass(np.ones((500, 1)), 0.01, 49.9)


@pytest.mark.parametrize("order", [1, 2, 4, 7])
def test_a_low_pass_has_settled_when_its_slowest_pole_has_decayed(order: int):
    _, poles, _ = butter(order, 2 * np.pi * 5.0, analog=True, output="zpk")
    slowest = -poles.real.max()
    assert np.exp(-slowest * settling(5.0, order)) == pytest.approx(np.exp(-40.0), rel=1e-6)
    assert settling(5.0) == settling(5.0, 4)


def test_thinning_leaves_forty_samples_a_period():
    assert thinning(median_step(np.arange(100) * 0.001), 2.0) == 12
    assert thinning(median_step(np.arange(100) * 0.1), 2.0) == 1
    assert (thinning(median_step(np.zeros(1)), 2.0), thinning(0.001, 2.0)) == (1, 12)


def test_means_of_blocks_and_bins_leave_the_rest_out():
    values = np.arange(14.0).reshape(7, 2)
    np.testing.assert_array_equal(block_means(values, 3), [[2.0, 3.0], [8.0, 9.0]])
    np.testing.assert_array_equal(bins(values, 3), [[2.0, 3.0], [8.0, 9.0]])
    np.testing.assert_array_equal(bins(values, 1), values)
    np.testing.assert_array_equal(block_means(values[:, 0], 2), [1.0, 5.0, 9.0])


def test_samples_of_an_even_grid_are_taken_as_they_are():
    values = np.arange(20.0)[:, None] ** 2
    np.testing.assert_array_equal(
        interpolate_uniform(values, 1.0, 0.5, np.array([1.5, 2.0, 2.5]))[:, 0], [1, 4, 9]
    )
    np.testing.assert_array_equal(interpolate_uniform(values, 1.0, 0.5, np.array([2.5, 1.5]))[:, 0], [9, 1])
    np.testing.assert_allclose(
        interpolate_uniform(values, 1.0, 0.5, np.array([1.1, 10.3]))[:, 0], [0.04, 18.6**2]
    )


def test_the_kernel_is_as_wide_as_kaiser_says():
    assert half_width(2.0, 40.0) == pytest.approx((40.0 - 7.95) / (2.285 * 2 * np.pi) / 2.0)
    assert half_width(4.0, 40.0) == pytest.approx(0.5 * half_width(2.0, 40.0))


@pytest.mark.parametrize(("attenuation_db", "worst"), [(25.0, -21.0), (40.0, -36.0), (60.0, -54.0)])
def test_the_stop_band_is_as_deep_as_asked_for(attenuation_db: float, worst: float):
    times, outputs = np.arange(0.0, 30.0, 0.005), np.array([15.0])
    parallel = ParallelFilter(times, outputs, 2.0, attenuation_db)
    ((_, samples, weights),) = parallel.blocks()
    response = np.abs(np.exp(-2j * np.pi * np.arange(2.6, 12.0, 0.02)[:, None] * times[samples]) @ weights[0])
    depth = 20.0 * np.log10(response.max())
    assert worst - 12.0 < depth < worst


def test_samples_at_a_gap_and_at_the_ends_count_for_their_time_alone():
    times = 0.5 * np.array([0.0, 1.0, 2.0, 3.0, 9.0, 10.0])
    np.testing.assert_allclose(
        ParallelFilter(times, times, 1.0).sample_weights, [0.5, 0.5, 0.5, 0.75, 0.75, 0.5]
    )
    assert ParallelFilter(times[:1], times, 1.0).sample_weights.tolist() == [0.0]
    assert ParallelFilter(times[:0], times, 1.0).sample_weights.tolist() == []


def test_irregular_and_regular_times_have_the_same_filter():
    outputs = np.arange(3.0, 17.0, 0.2)
    even = np.arange(0.0, 20.0, 0.01)
    uneven = even + 1e-8 * np.sin(np.arange(len(even)))
    wave = np.sin(2 * np.pi * 0.7 * even)
    np.testing.assert_allclose(
        ParallelFilter(even, outputs, 2.0).apply(wave),
        ParallelFilter(uneven, outputs, 2.0).apply(wave),
        atol=1e-6,
    )


@pytest.mark.parametrize(("cutoff_hz", "attenuation_db"), [(2.0, 40.0), (9.3, 60.0), (2.0, 5.0)])
def test_weights_are_those_of_the_table_between_its_values(cutoff_hz: float, attenuation_db: float) -> None:
    distance, value = filters._sinc(cutoff_hz, attenuation_db)
    random = np.random.default_rng(4)
    outputs, times = np.array([0.7, 1.0]), np.sort(random.uniform(0.0, 2.0, 500))
    # On values of the table, at its end, and one rounding beyond.
    times[:4] = 0.7, 1.0 - distance[7], 0.7 + distance[-1], np.nextafter(0.7 + distance[-1], 9.0)
    weights = random.uniform(0.0, 1.0, len(times))
    found = filters._kernel(outputs, times, weights, distance, value)
    apart = np.abs(outputs[:, None] - times)
    inside = distance[-1] > 0.0
    expected = np.interp(apart, distance, value, right=0.0) * weights if inside else np.zeros_like(apart)
    np.testing.assert_array_equal(found, expected)


def test_the_share_of_flagged_samples_is_that_of_their_weight():
    times = np.arange(0.0, 20.0, 0.01)
    parallel = ParallelFilter(times, np.array([5.0, 10.0, 15.0]), 2.0)
    flagged = np.column_stack([times > 10.0, times < -1.0, times > -1.0])
    np.testing.assert_allclose(parallel.share(flagged), [[0, 0, 1], [0.5, 0, 1], [1, 0, 1]], atol=0.03)
    assert not parallel.share(np.zeros(len(times), dtype=bool)).any()
    nowhere = ParallelFilter(times, np.array([90.0]), 2.0)
    assert (nowhere.share(flagged).tolist(), nowhere.coverage().tolist()) == ([[0.0, 0.0, 0.0]], [0.0])


def test_the_excitation_is_that_of_the_joint_that_moves_also_block_by_block():
    time = np.arange(12_000) / 200.0
    # The weak joint creeps, so that the means of its blocks differ.
    fast, weak = np.sin(2 * np.pi * time), 1e-3 * np.sin(14 * np.pi * time) + 1e-3 * np.floor(time / 10.0)
    velocity = np.column_stack([fast, weak])
    whole = excitation_frequency(velocity, 1 / 200.0)
    parts = Excitation(len(velocity), 1 / 200.0)
    for first in range(0, len(velocity), 2000):
        parts.add(velocity[first : first + 2000])
    assert parts.frequency() == pytest.approx(whole)
    assert whole == pytest.approx(1.0, abs=0.1)


def test_a_joint_that_hardly_moves_has_no_part_in_the_excitation():
    time = np.arange(0.0, 60.0, 0.01)
    slow, fast = np.sin(2 * np.pi * 0.2 * time), np.sin(2 * np.pi * 2.0 * time)
    assert excitation_frequency(np.column_stack([slow, 1e-3 * fast]), 0.01) < 0.4
    assert excitation_frequency(np.column_stack([slow, 0.1 * fast]), 0.01) > 1.9
    assert excitation_frequency(np.zeros((1000, 2)), 0.01) == 0.0
    assert moving(np.column_stack([0.011 * np.sin(time) / 2.0, 0.009 * np.sin(time) / 2.0]), ("a", "b")) == (
        "a",
    )


@pytest.mark.parametrize(
    ("changes", "facts", "said"),
    [
        ({"decimate_hz": 2.0}, {"excitation_hz": 1.0}, 0),
        ({"decimate_hz": 2.0}, {"excitation_hz": 1.01}, 1),
        ({"cutoff_hz": 5.0}, {"excitation_hz": 1.0}, 0),
        ({"cutoff_hz": 5.0}, {"excitation_hz": 1.0 + 1e-3}, 2),
        ({}, {"joint_rate_hz": 50.0}, 0),
        ({}, {"joint_rate_hz": 49.0}, 1),
        ({}, {"motor_rate_hz": 5.0}, 0),
        ({}, {"motor_rate_hz": 4.9}, 1),
        ({}, {"resonance_hz": 4.0}, 0),
        ({}, {"resonance_hz": 3.9}, 1),
        ({}, {"resonance_hz": 1.9}, 2),
    ],
)  # fmt: skip
def test_advice_begins_where_accuracy_ends(changes, facts, said):
    found = advice(SignalSettings(**changes), **({"excitation_hz": 1.0, "joint_rate_hz": 1000.0} | facts))
    assert len(found) == said


# ---- times ----


def test_the_sample_time_is_counted_by_the_sequence():
    time = np.arange(40) * 0.01
    assert sample_period(time[::2], np.arange(0, 40, 2), "a") == pytest.approx(0.01)
    assert sample_period(time[::2], np.zeros(20, dtype=np.int64), "a") == pytest.approx(0.02)
    assert sample_period(time[::2], np.arange(5), "a") == pytest.approx(0.02)
    assert sample_period(time[:16], None, "a") == pytest.approx(0.01)
    with pytest.raises(DataError, match="15 samples are too few"):
        sample_period(time[:15], None, "a")
    time[20] = time[19]
    with pytest.raises(DataError, match=r"after t = 0\.190000 s"):
        sample_period(time, None, "a")


def test_sixteen_good_samples_make_a_stretch():
    time = np.arange(40) * 0.01
    values, none = np.sin(time)[:, None], np.zeros(40, dtype=bool)
    assert len(stretches(time[:16], values[:16], none[:16], 0.01, 0.02)[0]) == 1
    assert stretches(time[:15], values[:15], none[:15], 0.01, 0.02) == ([], 0)
    gap = np.concatenate([time[:16], time[:15] + 0.5, time[:16] + 1.0])
    parts, lost = stretches(gap, gap[:, None], np.zeros(47, dtype=bool), 0.01, 0.02)
    assert [len(part.values) for part in parts] == [16, 16]
    assert (parts[1].start, parts[1].end) == (pytest.approx(1.0), pytest.approx(1.15))
    assert lost == 34 + 35


@pytest.mark.parametrize(("missing", "parts"), [(3, 1), (4, 2)])
def test_a_hole_longer_than_the_longest_bridge_ends_a_stretch(missing: int, parts: int):
    time = np.delete(np.arange(100) * 0.01, range(50, 50 + missing))
    found, lost = stretches(time, time[:, None], np.zeros(len(time), dtype=bool), 0.01, 0.025)
    assert (len(found), lost) == (parts, missing)


def test_the_step_of_a_stretch_is_that_of_its_own_clock():
    time = 3.0 + np.arange(500) * 0.010001
    ((part,), lost) = stretches(time, time[:, None], np.zeros(500, dtype=bool), 0.01, 0.02)
    assert (part.dt, part.end, lost) == (pytest.approx(0.010001, abs=1e-9), pytest.approx(time[-1]), 0)
    assert not part.resampled
    np.testing.assert_allclose(part.times, time, atol=1e-9)


def test_flagged_samples_are_bridged_like_lost_ones():
    time = np.arange(100) * 0.01
    values = np.sin(3.0 * time)[:, None]
    bad = np.zeros(100, dtype=bool)
    bad[[40, 41]], values[[40, 41]] = True, 99.0
    ((part,), lost) = stretches(time, values, bad, 0.01, 0.025)
    assert (np.flatnonzero(part.bridged).tolist(), lost) == ([40, 41], 0)
    np.testing.assert_allclose(part.values[:, 0], np.sin(3.0 * time), atol=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_irregular_times_are_sampled_from_the_first_to_the_last(seed: int):
    random = np.random.default_rng(seed)
    times = np.cumsum(random.uniform(0.006, 0.014, 300))
    ((part,), lost) = stretches(times, np.sin(times)[:, None], np.zeros(300, dtype=bool), 0.01, 0.1)
    assert part.resampled
    assert lost == 0
    assert part.times[0] == times[0]
    assert times[-1] - 0.01 < part.end <= times[-1]
    np.testing.assert_allclose(part.values[:, 0], np.sin(part.times), atol=1e-7)


def test_irregular_times_are_bridged_where_no_sample_is_near():
    random = np.random.default_rng(0)
    time = np.arange(300) * 0.01 + random.uniform(-0.002, 0.002, 300)
    kept = np.delete(time, [100, 101])
    ((part,), lost) = stretches(kept, np.sin(kept)[:, None], np.zeros(298, dtype=bool), 0.01, 0.03)
    assert part.resampled
    assert lost == 2
    assert set(np.flatnonzero(part.bridged).tolist()) <= {99, 100, 101, 102}
    assert part.bridged.any()


@pytest.mark.parametrize(("steps", "found"), [(1, []), (5, []), (6, [1000, 1100, 1200])])
def test_an_encoder_at_rest_jumps_by_five_steps_at_most(steps: int, found: list[int]):
    resolution = 2.0**-10
    position = np.zeros(4000)
    # A motion of fifty steps, later.
    position[2000:2500] = np.arange(500) // 10
    position[2500:] = 50
    position[[1000, 1100, 1200]] += steps
    flags, crowded = flag_outliers(resolution * position[:, None], 8.0)
    assert (np.flatnonzero(flags).tolist(), crowded) == (found, [])


def test_a_few_steps_of_the_encoder_are_no_outlier():
    steps = np.zeros((400, 1))
    steps[::40] = 1.0
    assert not flag_outliers(steps, 8.0)[0].any()
    spike = np.cumsum(np.full(400, 0.01))[:, None]
    spike[200] += 0.2
    assert np.flatnonzero(flag_outliers(spike, 8.0)[0]).tolist() == [200]


@pytest.mark.parametrize("size", [1e-6, 1.0])
def test_a_lone_spike_of_a_still_channel_is_an_outlier(size: float):
    values = np.zeros((400, 1))
    values[200] = size
    assert np.flatnonzero(flag_outliers(values, 8.0)[0]).tolist() == [200]


@pytest.mark.parametrize("noisy", [slice(0, 45), slice(205, 250), slice(-45, None)])
def test_a_noisy_part_has_no_outliers_wherever_it_lies(noisy: slice):
    random = np.random.default_rng(3)
    values = 0.001 * random.normal(size=(6030, 1))
    values[noisy] *= 30.0
    assert not flag_outliers(values, 8.0)[0].any()
    values[1000] += 0.5
    assert np.flatnonzero(flag_outliers(values, 8.0)[0]).tolist() == [1000]


@pytest.mark.parametrize(("count", "crowded"), [(20, []), (21, [0])])
def test_one_sample_in_a_hundred_is_the_most_for_outliers(count: int, crowded: list[int]):
    values = 0.01 * np.random.default_rng(0).normal(size=(2000, 1))
    values[50 : 50 + 90 * count : 90] += 5.0
    flags, found = flag_outliers(values, 8.0)
    assert found == crowded
    assert int(flags.sum()) == (0 if crowded else count)


# ---- rows ----


def chi(problem) -> np.ndarray:
    return np.array([arm.truth()[name] for name in problem.names])


def test_averaged_periods_have_the_mean_torque_and_the_mean_regressor():
    session = arm.session(periods=3, sensors=arm.Sensors(joint=0.05, motor=0.1, motor_delay_s=0.0))
    structure = ModelStructure(arm.chain())
    settings = SignalSettings(motor_delay_s=0.002)
    single = observe([prepare(session, settings)], [None], structure)
    mean = observe([prepare(session, replace(settings, average_periods=True))], [None], structure)
    for one, averaged in zip(single.groups, mean.groups, strict=True):
        phase = one.time_index % 50
        for k, place in enumerate(averaged.time_index):
            rows = phase == place
            assert rows.sum() == 3
            np.testing.assert_allclose(averaged.target[k], one.target[rows].mean(), atol=1e-9)
            np.testing.assert_allclose(averaged.matrix[k], one.matrix[rows].mean(axis=0), atol=1e-9)
    slopes, averages = (next(iter(problem.nuisances)).columns for problem in (single, mean))
    for place, column in averages.items():
        phase = single.groups[place].time_index % 50
        rows = phase == mean.groups[place].time_index[0]
        np.testing.assert_allclose(column[0], slopes[place][rows].mean(), atol=1e-9)
        assert np.std(column) > 0.0


def test_a_problem_knows_the_period_of_each_record():
    structure = ModelStructure(arm.chain(), 1)
    made = [prepare(arm.session(motor=False, periods=count, period_s=6.0)) for count in (1, 2)]
    found = observe([*made, replace(made[1], period_rows=None)], [None] * 3, structure)
    assert found.periods == (None, 30, None)
    assert found.record_names == ("unloaded.mcap",) * 3
    assert found.sample_time_s == pytest.approx(0.2)


@pytest.mark.parametrize("period_s", [9.9, 10.0])
def test_rows_divide_a_period_evenly(period_s: float):
    prepared = prepare(arm.session(motor=False, period_s=period_s, periods=2))
    assert prepared.period_rows == 50
    assert prepared.row_time_s == pytest.approx(period_s / 50)
    (passage,) = prepared.passages
    np.testing.assert_allclose(np.diff(passage.rows), period_s / 50, atol=1e-9)


def test_one_period_is_not_averaged():
    settings = SignalSettings(average_periods=True)
    session = arm.session(periods=1, period_s=12.0, motor=False)
    rows = [
        observe([prepare(session, chosen)], [None], ModelStructure(arm.chain(), 1)).rows
        for chosen in (settings, replace(settings, average_periods=False))
    ]
    assert rows[0] == rows[1] > 300


def test_the_slope_of_a_motor_row_is_the_error_of_a_wrong_delay():
    sensors = arm.Sensors(motor_delay_s=0.004)
    session = arm.session(sensors=sensors)
    structure = ModelStructure(arm.chain(), sides=("motor",))
    right, wrong = (
        observe([prepare(session, SignalSettings(motor_delay_s=delay))], [None], structure)
        for delay in (0.004, 0.006)
    )
    (nuisance,) = right.nuisances
    for place, (one, other) in enumerate(zip(right.groups, wrong.groups, strict=True)):
        same, first, second = np.intersect1d(one.time_index, other.time_index, return_indices=True)
        error = other.target[second] - other.matrix[second] @ chi(wrong)
        expected = -0.002 * nuisance.columns[place][first]
        assert len(same) > 50
        assert np.corrcoef(error, expected)[0, 1] ** 2 > 0.5


def test_stacked_problems_keep_records_nuisances_and_periods():
    structure = ModelStructure(arm.chain())
    one = observe([prepare(arm.session(sensors=arm.Sensors(motor=0.1)))], [None], structure)
    two = stack([one, one, one])
    assert (two.rows, two.periods) == (3 * one.rows, one.periods * 3)
    assert [group.record for group in two.groups] == [k for k in range(3) for _ in one.groups]
    assert two.record_names == one.record_names * 3
    count = len(one.groups)
    assert len(one.nuisances) == 2
    for k, nuisance in enumerate(two.nuisances):
        record, side = divmod(k, 2)
        assert set(nuisance.columns) == {place + record * count for place in one.nuisances[side].columns}
    with pytest.raises(DataError, match="at least one"):
        stack([])
    with pytest.raises(DataError, match="different parameters"):
        stack([one, replace(one, names=tuple(reversed(one.names)))])


def test_the_last_row_of_a_whole_recording_is_at_its_end():
    session = arm.session(phases=False, motor=False, run_in_s=0.0, period_s=4.0, periods=1)
    settings = SignalSettings(edge_s=0.0)
    rows = np.concatenate([p.rows for p in prepare(session, settings).passages])
    assert (rows[0], rows[-1], len(rows)) == (0.0, pytest.approx(4.0), 21)


def test_unequal_or_separate_periods_have_no_common_phase():
    whole = arm.session(motor=False, periods=3, period_s=6.0)
    assert prepare(whole).period_rows == 30

    def moved(name: str, by_s: float) -> Session:
        marks = [
            m._replace(log_time=m.log_time + round(by_s * 1e9)) if m.name == name else m for m in whole.phases
        ]
        return replace(whole, phases=tuple(sorted(marks, key=lambda mark: mark.log_time)))

    assert prepare(moved("brake", 0.01)).period_rows == 30
    assert prepare(moved("brake", 0.06)).period_rows is None
    apart = tuple(m._replace(name="pause") if m.name == "period 2" else m for m in whole.phases)
    assert prepare(replace(whole, phases=apart)).period_rows is None
    shorter = Phase(whole.phases[2].log_time - 60_000_000, "pause")
    assert prepare(replace(whole, phases=(*whole.phases[:2], shorter, *whole.phases[2:]))).period_rows is None


def test_a_jumping_channel_is_named_with_its_joint():
    session = arm.session(sensors=arm.Sensors(position=1e-5, joint=0.02, motor=0.02))
    random = np.random.default_rng(0)

    def jumping(values: np.ndarray, joint: int) -> np.ndarray:
        jumps = values.copy()
        jumps[random.choice(len(values), len(values) // 20, replace=False), joint] += 20.0
        return jumps

    bad = replace(session, motor=replace(session.motor, effort=jumping(session.motor.effort, 4)))
    (said,) = prepare(bad, SignalSettings(motor_delay_s=0.0), advise=False).warnings
    assert "A4 motor torque jumps too often" in said
    bad = replace(session, joint=replace(session.joint, effort=jumping(session.joint.effort, 2)))
    (said,) = prepare(bad, SignalSettings(motor_delay_s=0.0), advise=False).warnings
    assert "E1 joint torque jumps too often" in said


@pytest.mark.parametrize(("shift_s", "aligned"), [(12.0, False), (14.0, True), (20.0, True), (-14.0, True)])
def test_clocks_that_share_less_than_half_their_time_are_aligned_by_the_host(shift_s: float, aligned: bool):
    session = arm.session()
    late = session.motor.publish_time + round(1e9 * shift_s)
    shifted = replace(session, motor=replace(session.motor, publish_time=late))
    prepared = prepare(shifted, SignalSettings(motor_delay_s=0.0), advise=False)
    assert len(prepared.warnings) == int(aligned)
    if aligned:
        assert f"differs from the joint channel's by {-shift_s:.3f} s" in prepared.warnings[0]
        assert prepared.passages[0].motor.times[0] < 1.0


def test_advice_is_given_on_request_alone():
    settings = SignalSettings(cutoff_hz=2.0, decimate_hz=1.0)
    session = arm.session(motor=False)
    assert any("cutoff_hz" in warning for warning in prepare(session, settings).warnings)
    assert prepare(session, settings, advise=False).warnings == ()


def test_the_torque_of_an_outlier_is_bridged_in_the_motor_channel():
    session = arm.session(sensors=arm.Sensors(motor=1e-3))
    effort = session.motor.effort.copy()
    effort[3000, 1] += 50.0
    bad = replace(session, motor=replace(session.motor, effort=effort))
    clean, mended = (prepare(one, SignalSettings(motor_delay_s=0.0)) for one in (session, bad))
    assert (clean.counts["motor_torque_outliers"], mended.counts["motor_torque_outliers"]) == (0, 1)
    torque = [np.concatenate([p.motor.torque for p in one.passages]) for one in (clean, mended)]
    np.testing.assert_allclose(torque[0], torque[1], atol=0.5)
    assert np.concatenate([p.motor.flagged for p in mended.passages])[:, 1].sum() == 1


def test_between_irregular_times_both_neighbours_of_an_outlier_are_unknown():
    session = arm.session(motor=False)
    kept = np.cumsum(np.random.default_rng(0).integers(2, 5, 2000))
    kept = kept[kept < len(session.joint)]
    fields = ("log_time", "publish_time", "sequence", "position", "velocity", "effort")
    part = {name: getattr(session.joint, name)[kept] for name in fields}
    part["sequence"] = np.arange(len(kept))
    hit = np.arange(400, len(kept) - 200, 150)
    part["effort"][hit, 3] += 400.0
    uneven = replace(session, joint=replace(session.joint, **part))
    stamps = part["publish_time"]
    prepared = prepare(uneven, advise=False)
    assert prepared.counts["resampled"]
    (passage,) = prepared.passages
    times, flagged = passage.joint.times, passage.joint.flagged[:, 3]
    for time in (stamps[hit] - stamps[0]) * 1e-9:
        # The samples of the grid on either side are interpolated through the outlier.
        beside = np.flatnonzero(np.abs(times - time) < passage.joint.period_s)
        assert flagged[beside].all()
    assert np.abs(passage.joint.torque[:, 3]).max() < 200.0


@pytest.mark.parametrize(("first", "last", "whole"), [(0, None, True), (0, -900, False), (900, None, False)])
def test_a_commanded_motion_must_cover_the_measured_one(first: int, last: int | None, whole: bool):
    session = arm.session(motor=False, command=True)
    fields = ("log_time", "publish_time", "sequence", "position", "velocity", "effort")
    part = {name: getattr(session.command, name)[first:last] for name in fields}
    cut = replace(session, command=replace(session.command, **part))
    assert (commanded(cut, prepare(cut, advise=False)) is not None) == whole


def test_the_mean_torque_is_that_of_the_rows_span():
    prepared = prepare(arm.session(motor=False, still=()))
    (passage,) = prepared.passages
    span = (passage.joint.times >= passage.rows[0]) & (passage.joint.times <= passage.rows[-1])
    np.testing.assert_allclose(prepared.mean_torque, np.abs(passage.joint.torque[span]).mean(axis=0))


def test_a_motor_of_an_elastic_joint_moves_by_its_twist():
    session = arm.session()
    soft = prepare(session, SignalSettings(stiffness_nm_rad=(1e3,) * 7, motor_delay_s=0.0))
    (passage,) = soft.passages
    drive, motor = passage.motor.drive, passage.motor
    dt = float(np.median(np.diff(motor.times)))
    joint = np.column_stack([np.interp(motor.times, passage.joint.times, c) for c in passage.joint.torque.T])
    rate = np.gradient(low_pass(joint, dt, soft.cutoff_hz) / 1e3, dt, axis=0)
    inner = slice(200, -200)
    np.testing.assert_allclose((drive.speed - motor.qd)[inner], rate[inner], atol=5e-3)
    assert np.abs(rate[inner]).max() > 0.02
    with pytest.raises(ConfigurationError, match="2 values for 7 joints"):
        prepare(session, SignalSettings(stiffness_nm_rad=(1e3, 1e3)))


def test_friction_that_turns_late_in_all_joints_does_not_move_the_delay():
    session = arm.session(sensors=arm.Sensors(position=1e-6, joint=0.02, motor=0.05, motor_delay_s=0.004))
    time = session.motor.publish_time * 1e-9 - 0.004 - 3.0
    then, now = (np.sign(arm.fourier(at, 10.0, 5)[1]) for at in (time - 0.03, time))
    motor = replace(session.motor, effort=session.motor.effort + arm.drive("Fcm") * (then - now))
    late = replace(session, motor=motor)
    away, near = (prepare(late, SignalSettings(reversal_s=some)).delay for some in (0.05, 0.0))
    assert away.estimate == pytest.approx(0.004, abs=3e-4)
    assert near.estimate > 0.006


def test_the_delay_is_the_mean_of_the_joints_and_its_deviation_grows_with_their_scatter():
    session = arm.session(sensors=arm.Sensors(position=1e-6, joint=0.02, motor=0.05))
    found = prepare(session).delay
    values, stds = np.array(list(found.by_joint.values())).T
    weights = 1.0 / stds**2
    assert found.estimate == pytest.approx(float(values @ weights / weights.sum()), abs=2e-5)
    assert found.how == "from the torque difference"
    assert set(found.by_joint) == set(arm.chain().joint_names)
    effort, dt = session.motor.effort.copy(), 0.004
    for joint in (0, 2, 4):
        effort[:, joint] = np.interp(
            np.arange(len(effort)) * dt - 0.01, np.arange(len(effort)) * dt, effort[:, joint]
        )
    scattered = prepare(replace(session, motor=replace(session.motor, effort=effort))).delay
    assert scattered.disagreement > 3.0
    assert scattered.std > 3.0 * found.std
    assert scattered.by_joint["A1"][0] == pytest.approx(0.01, abs=1e-3)
    assert scattered.by_joint["A2"][0] == pytest.approx(0.0, abs=1e-3)


# ---- arguments ----


def test_payload_and_mass_are_read_from_the_metadata():
    def of(**metadata: str) -> Session:
        return Session(Path("a.mcap"), metadata, {}, (), None, None, None, ())  # type: ignore[arg-type]

    assert [payload_name(of(**m)) for m in ({}, {"payload": ""}, {"payload": " none "}, {"payload": " box "})] == [
        None, None, None, "box",
    ]  # fmt: skip
    assert (stated_mass(of()), stated_mass(of(payload_mass="3.5"))) == (None, 3.5)
    with pytest.raises(DataError, match="heavy"):
        stated_mass(of(payload_mass="heavy"))
    require(1, int, "n", "count")
    with pytest.raises(ConfigurationError, match="`n` must be of type int, not str 'one'; count"):
        require("one", int, "n", "count")


@pytest.mark.parametrize("step_s", [0.0, 1e-5], ids=["even", "uneven"])
@pytest.mark.parametrize("most", [0, 2**20], ids=["made anew", "kept"])
def test_a_filter_gives_the_same_on_each_use_whether_its_weights_are_kept(
    monkeypatch: pytest.MonkeyPatch, step_s: float, most: int
):
    monkeypatch.setattr(filters, "_MOST_KEPT", most)
    times = np.arange(2000) * 0.004 + step_s * np.sin(np.arange(2000))
    parallel = ParallelFilter(times, np.arange(1.0, 7.0, 0.1), 2.0)
    for values in (np.sin(times)[:, None], np.cos(3.0 * times)[:, None]):
        rows = [weights @ values[samples] for _, samples, weights in parallel.blocks()]
        assert np.array_equal(parallel.apply(values), np.concatenate(rows))


def test_a_commanded_motion_that_jumps_is_no_motion() -> None:
    session = arm.session(motor=False, command=True)
    position = session.command.position.copy()
    position[1500:, 2] -= 2.0 * np.pi
    jumping = replace(session, command=replace(session.command, position=position))
    assert commanded(jumping, prepare(jumping, advise=False)) is None


@pytest.mark.parametrize("means", [bins, block_means])
def test_too_few_samples_for_a_mean_are_none(means: Callable[[np.ndarray, int], np.ndarray]):
    assert means(np.ones((3, 2)), 8).shape == (0, 2)
