"""The way from raw channels to rows: filters, clocks, gaps, outliers, delay, advice."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fri.errors import ConfigurationError, DataError
from ident.dynamics.structure import ModelStructure
from ident.rows import (
    ParallelFilter,
    SignalSettings,
    advice,
    differentiate,
    excitation_frequency,
    low_pass,
    prepare,
)
from ident.rows.filters import interpolate_uniform
from ident.rows.observation import observe
from ident.rows.timebase import flag_outliers, sample_period, stretches
from tests.ident import estimation_arm as arm


def test_low_pass_has_no_phase_and_the_squared_gain_of_its_order():
    dt, cutoff = 0.002, 10.0
    time = np.arange(0, 20, dt)
    middle = slice(len(time) // 4, 3 * len(time) // 4)
    for frequency in (0.5, 5.0, 10.0, 20.0):
        wave = np.sin(2 * np.pi * frequency * time)
        expected = 1.0 / (1.0 + (np.tan(np.pi * frequency * dt) / np.tan(np.pi * cutoff * dt)) ** 8)
        filtered = low_pass(wave[:, None], dt, cutoff)[:, 0]
        np.testing.assert_allclose(filtered[middle], expected * wave[middle], atol=1e-6)


def test_cutoff_above_the_nyquist_frequency_is_refused():
    with pytest.raises(ConfigurationError, match="half the sampling rate"):
        low_pass(np.zeros((100, 1)), 0.1, 10.0)


def test_derivatives_are_exact_to_sixth_order_and_in_phase():
    dt, w = 0.004, 2 * np.pi * 1.0
    time = np.arange(0, 5, dt)
    first, second = differentiate(np.sin(w * time)[:, None], dt)
    inner = slice(5, -5)
    np.testing.assert_allclose(first[inner, 0], w * np.cos(w * time)[inner], atol=2 * w * (w * dt) ** 6 / 140)
    np.testing.assert_allclose(second[inner, 0], -(w**2) * np.sin(w * time)[inner], atol=1e-7 * w**2)


def test_interpolation_between_samples_of_a_slow_wave():
    dt = 0.01
    time = np.arange(0, 3, dt)
    at = np.linspace(0.1, 2.8, 77)
    values = interpolate_uniform(np.sin(5 * time)[:, None], 0.0, dt, at)
    np.testing.assert_allclose(values[:, 0], np.sin(5 * at), atol=1e-10)


@settings(max_examples=30, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    jitter=st.floats(0.0, 0.45),
    cutoff=st.floats(0.5, 4.0),
)
def test_one_filter_for_both_sides_keeps_the_equation_on_any_sample_times(seed, jitter, cutoff):
    random = np.random.default_rng(seed)
    times = np.arange(400) * 0.02 + 0.02 * jitter * random.uniform(-1, 1, 400)
    matrix, chi = np.sign(random.normal(size=(400, 3))), random.normal(size=3)
    parallel = ParallelFilter(times, np.linspace(3.0, 5.0, 9), cutoff)
    np.testing.assert_allclose(parallel.apply(matrix @ chi), parallel.apply(matrix) @ chi, atol=1e-9)
    np.testing.assert_allclose(parallel.apply(np.ones(400)), 1.0, atol=1e-12)


def test_parallel_filter_passes_the_band_and_stops_the_rest():
    times = np.arange(0, 20, 0.004)
    outputs = np.arange(5, 15, 0.2)
    parallel = ParallelFilter(times, outputs, 2.0)
    for frequency, gain in ((0.25, 1.0), (1.4, 1.0), (2.0, 0.5), (2.6, 0.0), (9.0, 0.0)):
        wave = parallel.apply(np.sin(2 * np.pi * frequency * times))
        np.testing.assert_allclose(wave, gain * np.sin(2 * np.pi * frequency * outputs), atol=0.02)


def test_coverage_falls_where_samples_are_missing():
    times = np.arange(0, 20, 0.01)
    holed = times[(times < 9.8) | (times > 10.2)]
    coverage = ParallelFilter(holed, np.array([5.0, 10.0, 15.0]), 2.0).coverage()
    assert coverage[0] == pytest.approx(1.0, abs=0.01)
    assert coverage[2] == pytest.approx(1.0, abs=0.01)
    assert coverage[1] < 0.7


def test_lost_samples_are_bridged_and_flagged_and_long_gaps_split():
    time = np.arange(1000) * 0.001
    values = np.sin(8 * time)[:, None]
    keep = np.ones(1000, dtype=bool)
    keep[[100, 101, 300]] = False
    keep[600:650] = False
    parts, lost = stretches(time[keep], values[keep], np.zeros(keep.sum(), bool), 0.001, 0.02)
    assert lost == 53
    assert [len(part.values) for part in parts] == [600, 350]
    assert list(np.flatnonzero(parts[0].bridged)) == [100, 101, 300]
    np.testing.assert_allclose(parts[0].values, values[:600], atol=1e-9)
    assert not parts[0].resampled


def test_irregular_times_are_resampled_and_said_to_be():
    random = np.random.default_rng(3)
    time = np.arange(2000) * 0.005 + random.uniform(-0.0015, 0.0015, 2000)
    parts, lost = stretches(time, np.sin(3 * time)[:, None], np.zeros(2000, bool), 0.005, 0.02)
    assert lost == 0
    assert len(parts) == 1
    assert parts[0].resampled
    np.testing.assert_allclose(parts[0].values[:, 0], np.sin(3 * parts[0].times), atol=1e-6)


def test_time_running_backwards_is_refused():
    time = np.arange(100) * 0.01
    time[50] = time[48]
    with pytest.raises(DataError, match="does not increase"):
        sample_period(time, None, "run.mcap")


def test_spikes_are_outliers_and_reversals_are_not():
    random = np.random.default_rng(1)
    time = np.arange(4000) * 0.002
    torque = np.column_stack([10 * np.sin(time) + 15 * np.sign(np.cos(time)), 5 * time])
    torque += 0.05 * random.normal(size=torque.shape)
    torque[1234, 0] += 3.0
    torque[2000, 1] -= 4.0
    flags, crowded = flag_outliers(torque, 8.0)
    assert [tuple(hit) for hit in np.argwhere(flags)] == [(1234, 0), (2000, 1)]
    assert crowded == []


def test_a_drive_that_is_noisier_in_motion_has_no_outliers_and_spikes_in_both_parts_are_found():
    random = np.random.default_rng(5)
    size = np.where((np.arange(9000) // 1500) % 2 == 0, 0.01, 0.8)
    torque = (20 * np.sin(np.arange(9000) * 2e-3) + size * random.laplace(size=9000))[:, None]
    flags, crowded = flag_outliers(torque, 8.0)
    assert not flags.any()
    assert crowded == []
    torque[[700, 2200, 8990]] += np.array([[3.0], [-30.0], [30.0]])
    flags, _ = flag_outliers(torque, 8.0)
    assert np.flatnonzero(flags).tolist() == [700, 2200, 8990]


def test_a_channel_full_of_jumps_is_left_alone_and_named():
    random = np.random.default_rng(2)
    values = 0.01 * random.normal(size=(3000, 1))
    values[random.choice(3000, 150, replace=False)] += 5.0
    flags, crowded = flag_outliers(values, 8.0)
    assert crowded == [0]
    assert not flags.any()


@pytest.mark.parametrize(
    ("side", "largest", "typical"),
    [("joint", 2e-7, 1e-7), ("motor", 0.2, 1e-5), ("difference", 0.2, 1e-3)],
)
def test_without_noise_the_rows_hold_to_numerical_accuracy(side, largest, typical):
    session = arm.session(sensors=arm.Sensors(motor_step_s=0.006, motor_delay_s=0.0))
    prepared = prepare(session, SignalSettings(motor_delay_s=0.0))
    structure = ModelStructure(arm.chain(), 2, sides=(side,))
    problem = observe([prepared], [None], structure)
    chi = np.array([arm.truth()[name] for name in problem.names])
    for group in problem.groups:
        error = np.abs(group.target - group.matrix @ chi)
        assert error.max() < largest
        assert np.median(error) < typical


def test_raw_data_stay_as_they_are():
    session = arm.session(sensors=arm.Sensors(joint=0.05, lost=(700, 701), joint_outliers=((900, 2, 9.0),)))
    before = (session.joint.position.copy(), session.joint.effort.copy(), session.motor.effort.copy())
    prepare(session)
    for old, new in zip(
        before, (session.joint.position, session.joint.effort, session.motor.effort), strict=True
    ):
        np.testing.assert_array_equal(old, new)


def test_rows_come_from_the_periods_only():
    prepared = prepare(arm.session(periods=3, period_s=8.0, run_in_s=4.0, motor=False))
    rows = np.concatenate([passage.rows for passage in prepared.passages])
    assert rows.min() == pytest.approx(4.0)
    assert rows.max() == pytest.approx(4.0 + 24.0 - 0.2)
    assert (prepared.period_rows, prepared.periods) == (40, 3)


def test_a_session_without_phases_is_used_whole():
    prepared = prepare(arm.session(phases=False, motor=False))
    assert prepared.period_rows is None
    rows = np.concatenate([passage.rows for passage in prepared.passages])
    assert rows.max() - rows.min() > 20.0


def test_lost_samples_and_outliers_are_counted_and_do_not_bend_the_rows():
    lost = (1500, 1501, 1502, 2000, 2500)
    session = arm.session(
        motor=False,
        sensors=arm.Sensors(
            lost=lost, joint=1e-3, joint_outliers=((3000, 1, 40.0),), position_outliers=((3300, 4, 0.3),)
        ),
    )
    prepared = prepare(session)
    assert prepared.counts["lost"] == 5
    assert prepared.counts["joint_torque_outliers"] == 1
    assert prepared.counts["position_outliers"] == 1
    problem = observe([prepared], [None], ModelStructure(arm.chain(), 1))
    chi = np.array([arm.truth()[name] for name in problem.names])
    for group in problem.groups:
        assert np.abs(group.target - group.matrix @ chi).max() < 5e-3


def test_held_torques_of_either_channel_make_no_row():
    whole = arm.session()
    effort, motor = whole.joint.effort.copy(), whole.motor.effort.copy()
    late = (whole.motor.log_time - whole.joint.log_time[0]) * 1e-9
    hold, hold_motor = slice(3001, 3081), slice(*np.searchsorted(late, [4.0, 4.1]).tolist())
    effort[hold], motor[hold_motor] = effort[3000], motor[hold_motor.start - 1]
    session = dataclasses.replace(
        whole,
        joint=dataclasses.replace(whole.joint, effort=effort),
        motor=dataclasses.replace(whole.motor, effort=motor),
    )
    prepared = prepare(session)
    assert prepared.counts["joint_torque_held"] == 80
    assert prepared.counts["motor_torque_outliers"] >= 7 * (hold_motor.stop - hold_motor.start)
    assert len(prepared.passages) == len(prepare(whole).passages)
    assert sum(passage.joint.flagged.any(axis=1).sum() for passage in prepared.passages) == 80


def test_a_long_gap_costs_its_rows_and_nothing_else():
    whole = prepare(arm.session(motor=False))
    holed = prepare(arm.session(motor=False, sensors=arm.Sensors(lost=tuple(range(3000, 3050)))))
    assert len(holed.passages) == 2
    lost = whole.counts["rows"] - holed.counts["rows"]
    assert 1 < lost < 25
    index = np.concatenate([passage.index for passage in holed.passages])
    assert np.all(np.diff(index) > 0)
    assert np.diff(index).max() == lost + 1


def test_rows_of_a_joint_at_rest_are_dropped():
    prepared = prepare(arm.session(motor=False, still=(2,)))
    for passage in prepared.passages:
        assert not passage.joint_valid[:, 2].any()
        assert passage.joint_valid[:, 0].mean() > 0.9
    assert arm.chain().joint_names[2] not in prepared.moving


@pytest.mark.parametrize("delay", [0.0, 0.0073])
def test_the_delay_of_the_motor_channel_is_found_with_its_uncertainty(delay):
    errors, stds = [], []
    for seed in range(3):
        sensors = arm.Sensors(position=1e-5, joint=0.05, motor=0.3, motor_delay_s=delay)
        found = prepare(arm.session(seed=seed, sensors=sensors, motion_seed=seed)).delay
        errors.append(found.seconds - delay)
        stds.append(found.std)
    assert np.all(np.abs(errors) < 4 * np.array(stds))
    assert max(np.abs(errors)) < 3e-4
    assert max(stds) < 3e-4


def test_no_channel_is_early_and_one_that_looks_so_is_named():
    sensors = arm.Sensors(position=1e-5, joint=0.05, motor=0.3, motor_delay_s=-0.004)
    prepared = prepare(arm.session(sensors=sensors))
    assert prepared.delay.seconds == 0.0
    assert prepared.delay.interval[0] == 0.0
    assert prepared.delay.estimate == pytest.approx(-0.004, abs=4e-4)
    assert any(
        "looks early by 4." in warning or "looks early by 3.9" in warning for warning in prepared.warnings
    )


def test_a_slow_motor_channel_is_aligned_within_a_fraction_of_its_sample_time():
    sensors = arm.Sensors(position=1e-5, joint=0.05, motor=0.2, motor_step_s=0.012, motor_delay_s=0.0185)
    found = prepare(arm.session(sensors=sensors)).delay
    assert abs(found.seconds - 0.0185) < 3 * found.std
    assert found.std < 1e-3


@pytest.mark.parametrize("delay", [0.15, -0.15])
def test_a_delay_beyond_the_search_is_refused_with_advice(delay):
    session = arm.session(sensors=arm.Sensors(motor_delay_s=delay))
    with pytest.raises(DataError, match="delay_search_s"):
        prepare(session)


def test_a_foreign_motor_clock_is_aligned_by_the_host_first():
    session = arm.session(sensors=arm.Sensors(motor_delay_s=0.005))
    motor = dataclasses.replace(session.motor, publish_time=session.motor.publish_time + 5_000_000_000_000)
    prepared = prepare(dataclasses.replace(session, motor=motor))
    assert abs(prepared.delay.seconds - 0.005) < 1e-3
    assert any("clock differs" in warning for warning in prepared.warnings)


def test_excitation_frequency_is_the_highest_harmonic():
    time = np.arange(0, 60, 0.004)
    _, qd, _ = arm.fourier(time, 10.0, 3)
    assert 0.4 < excitation_frequency(qd, 0.004) < 0.62


@pytest.mark.parametrize(
    ("changes", "facts", "word"),
    [
        ({"decimate_hz": 0.4}, {"excitation_hz": 0.25}, "decimate_hz"),
        ({"cutoff_hz": 3.0}, {"excitation_hz": 0.7}, "cutoff_hz"),
        ({}, {"excitation_hz": 3.0, "resonance_hz": 5.0}, "resonance"),
        ({"cutoff_hz": 10.0}, {"excitation_hz": 0.25, "joint_rate_hz": 40.0}, "sampling rate"),
        ({"decimate_hz": 5.0}, {"excitation_hz": 0.25, "motor_rate_hz": 10.0}, "motor"),
    ],
)
def test_advice_names_the_setting(changes, facts, word):
    settings_ = SignalSettings(**changes)
    found = advice(settings_, **({"joint_rate_hz": 1000.0} | facts))
    assert any(word in sentence for sentence in found)


def test_no_advice_for_the_settings_of_the_paper():
    found = advice(
        SignalSettings(), excitation_hz=0.25, joint_rate_hz=1000.0, motor_rate_hz=80.0, resonance_hz=4.6
    )
    assert found == ()


@pytest.mark.parametrize(
    "bad", [{"cutoff_hz": 0.0}, {"cutoff_hz": 10.0, "decimate_hz": 20.0}, {"rate_hz": -1.0}]
)
def test_impossible_settings_are_refused(bad):
    with pytest.raises(ConfigurationError):
        SignalSettings(**bad)


def test_not_a_number_is_located():
    session = arm.session(motor=False)
    session.joint.effort[77, 3] = np.nan
    with pytest.raises(DataError, match=r"effort of .*A3.* at sample 77"):
        prepare(session)


def test_a_short_motion_has_rows_and_an_unknown_delay():
    session = arm.session(phases=False, run_in_s=0.5, period_s=1.0, periods=1)
    prepared = prepare(session)
    assert prepared.counts["rows"] > 5
    assert prepared.delay.seconds == 0.0
    assert prepared.delay.std >= 1e-3


def test_too_short_a_motion_is_refused():
    session = arm.session(motor=False, phases=False, run_in_s=0.0, period_s=0.3, periods=1)
    with pytest.raises(DataError, match="record a longer motion"):
        prepare(session)


def test_no_motion_is_refused():
    session = arm.session(motor=False, still=tuple(range(7)))
    with pytest.raises(DataError, match="no joint moves"):
        prepare(session)


def test_one_lost_sample_in_twenty_costs_no_rows():
    random = np.random.default_rng(0)
    lost = tuple(np.sort(random.choice(np.arange(10, 6490), 320, replace=False)).tolist())
    sensors = arm.Sensors(joint=1e-3, motor_step_s=0.012, lost=lost)
    prepared = prepare(arm.session(sensors=sensors))
    assert prepared.counts["lost"] == 320
    whole = prepare(arm.session(sensors=dataclasses.replace(sensors, lost=())))
    for kind in ("joint_rows_dropped", "motor_rows_dropped"):
        assert prepared.counts[kind] <= whole.counts[kind] + 5
    problem = observe([prepared], [None], ModelStructure(arm.chain(), 1))
    chi = np.array([arm.truth()[name] for name in problem.names])
    for group in problem.groups:
        assert np.abs(group.target - group.matrix @ chi).max() < 0.05


def test_a_drive_that_reverses_late_is_not_taken_for_a_delay():
    session = arm.session(sensors=arm.Sensors(position=1e-6, joint=0.02, motor=0.05, motor_delay_s=0.004))
    effort = session.motor.effort.copy()
    time = session.motor.publish_time * 1e-9 - 0.004 - 3.0
    for joint, late in ((1, 0.05), (4, -0.04), (6, 0.06)):
        friction = arm.drive("Fcm")[joint]
        now = np.sign(arm.fourier(time, 10.0, 5)[1][:, joint])
        then = np.sign(arm.fourier(time - late, 10.0, 5)[1][:, joint])
        effort[:, joint] += friction * (then - now)
    motor = dataclasses.replace(session.motor, effort=effort)
    prepared = prepare(dataclasses.replace(session, motor=motor))
    assert abs(prepared.delay.seconds - 0.004) < max(3 * prepared.delay.std, 5e-4)
    assert prepared.delay.std < 2e-3
