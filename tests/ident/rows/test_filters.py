"""Filters, derivatives and interpolation against their definitions, with every coefficient."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest
from scipy.signal import butter, firwin, kaiser_beta, sosfiltfilt

from fri.errors import ConfigurationError
from ident.rows.filters import (
    Excitation,
    ParallelFilter,
    SignalSettings,
    advice,
    differentiate,
    half_width,
    interpolate_uniform,
    low_pass,
    median_step,
    moving,
    thinning,
)


def test_the_settings_begin_as_documented() -> None:
    found = {field.name: getattr(SignalSettings(), field.name) for field in fields(SignalSettings)}
    assert found == {
        "cutoff_hz": None, "order": 4, "decimate_hz": None, "rate_hz": None, "attenuation_db": 40.0,
        "average_periods": False, "edge_s": None, "longest_bridge_s": 0.02, "reversal_s": None, "turning_rad": None,
        "slow_rad_s": None,
        "standstill_rad_s": 2e-3, "known_share": 0.4, "outlier_scale": 8.0, "motor_delay_s": "estimate",
        "joint_delay_s": "estimate", "delay_search_s": 0.1, "stiffness_nm_rad": None, "encoder": None,
        "coupled": (),
    }  # fmt: skip


@pytest.mark.parametrize(
    "name",
    ["cutoff_hz", "order", "decimate_hz", "rate_hz", "attenuation_db", "outlier_scale", "delay_search_s"],
)
def test_a_setting_of_zero_or_less_is_refused(name: str) -> None:
    for value in (0, -1):
        with pytest.raises(ConfigurationError, match=f"`{name}` is {value}"):
            SignalSettings(**{name: value})
    SignalSettings(**{name: 1})


def test_the_parallel_filter_is_as_wide_as_the_position_filter_at_most() -> None:
    SignalSettings(cutoff_hz=3.0, decimate_hz=3.0)
    with pytest.raises(ConfigurationError, match="exceeds `cutoff_hz`"):
        SignalSettings(cutoff_hz=3.0, decimate_hz=3.01)
    # Without figures of its own it is settled later.
    SignalSettings(cutoff_hz=1.0)
    SignalSettings(decimate_hz=30.0)


@pytest.mark.parametrize("power", range(7))
def test_differences_are_exact_for_polynomials_of_their_order(power: int) -> None:
    dt, center = 0.5, 6
    time = dt * np.arange(13) - 2.5
    first, second = differentiate((time**power)[:, None], dt)
    at = time[center]
    assert first[center, 0] == pytest.approx(power * at ** max(power - 1, 0) if power else 0.0, abs=1e-9)
    slope = power * (power - 1) * at ** (power - 2) if power > 1 else 0.0
    assert second[center, 0] == pytest.approx(slope, abs=1e-9)


def test_differences_look_three_samples_far() -> None:
    unit = np.zeros((15, 1))
    unit[7] = 1.0
    first, second = differentiate(unit, 0.1)
    np.testing.assert_allclose(
        first[:, 0] * 0.1 * 60.0, [0] * 4 + [1, -9, 45, 0, -45, 9, -1] + [0] * 4, atol=1e-12
    )
    np.testing.assert_allclose(
        second[:, 0] * 0.01 * 180.0, [0] * 4 + [2, -27, 270, -490, 270, -27, 2] + [0] * 4, atol=1e-10
    )


@pytest.mark.parametrize("place", [0.3, 1.5, 2.0, 2.7, 7.4, 8.99, 10.2, 11.6])
def test_values_between_samples_are_those_of_the_polynomial_through_the_six_around(place: float) -> None:
    values = np.random.default_rng(0).normal(size=(13, 2))
    first = min(max(int(np.floor(place)) - 2, 0), 13 - 6)
    nodes = np.arange(first, first + 6)
    # A second time, so that none of them is a sample.
    found = interpolate_uniform(values, 4.0, 0.25, 4.0 + 0.25 * np.array([place, 5.5]))
    for column in range(2):
        expected = np.polyval(np.polyfit(nodes - place, values[nodes, column], 5), 0.0)
        assert found[0, column] == pytest.approx(expected, abs=1e-9)


def test_beyond_the_last_samples_a_time_of_the_grid_has_the_last_value() -> None:
    values = np.arange(8.0)[:, None]
    found = interpolate_uniform(values, 0.0, 0.1, np.array([-0.1, 0.2, 0.9]))
    assert found[:, 0].tolist() == [0.0, 2.0, 7.0]
    assert interpolate_uniform(values, 0.0, 0.1, np.zeros(0)).shape == (0, 1)


def test_a_time_off_the_grid_by_a_millionth_of_a_step_is_on_it() -> None:
    values = np.random.default_rng(0).normal(size=(12, 1))
    for off, same in ((0.9e-6, True), (1.1e-6, False)):
        found = interpolate_uniform(values, 0.0, 1.0, np.array([5.0 + off]))[0, 0]
        assert (found == values[5, 0]) == same


@pytest.mark.parametrize("attenuation_db", [15.0, 30.0, 45.0, 70.0])
def test_the_kernel_is_kaisers_window_times_a_sinc(attenuation_db: float) -> None:
    cutoff, dt = 2.0, 0.01
    half = half_width(cutoff, attenuation_db)
    count = int(half / dt)
    times = np.arange(1001) * dt
    ((_, samples, weights),) = ParallelFilter(times, times[[500]], cutoff, attenuation_db).blocks()
    lag = times[samples] - 5.0
    beta = kaiser_beta(attenuation_db)
    window = np.i0(beta * np.sqrt(np.maximum(1.0 - (lag / half) ** 2, 0.0)))
    expected = window * np.sinc(2.0 * cutoff * lag)
    assert len(lag) == 2 * count + 1
    np.testing.assert_allclose(weights[0], expected / expected.sum(), atol=2e-6)
    # The same as the usual design, but for the share of a sample at its ends.
    usual = firwin(2 * count + 1, cutoff, window=("kaiser", beta), fs=1.0 / dt)
    np.testing.assert_allclose(weights[0], usual, atol=0.02 * usual.max())


@pytest.mark.parametrize("shift", [0.0, 3e-3])
def test_rows_in_blocks_are_weighted_means_of_the_samples_around_each(shift: float) -> None:
    random = np.random.default_rng(1)
    times = np.cumsum(random.uniform(0.008, 0.012, 900)) if shift else np.arange(900) * 0.01
    outputs = np.arange(1.0, 8.0, 0.2) + shift
    parallel, values = ParallelFilter(times, outputs, 2.0), random.normal(size=(900, 2, 3))
    found = parallel.apply(values)
    assert found.shape == (len(outputs), 2, 3)
    step = np.minimum(np.diff(times), 2.0 * np.median(np.diff(times)))
    own = 0.5 * (np.append(step, step[-1]) + np.append(step[0], step))
    half, beta = half_width(2.0, 40.0), kaiser_beta(40.0)
    for row in (0, 8, len(outputs) - 1):
        lag = times - outputs[row]
        kernel = np.where(
            np.abs(lag) <= half,
            np.i0(beta * np.sqrt(np.maximum(1.0 - (lag / half) ** 2, 0.0))) * np.sinc(4.0 * lag),
            0.0,
        )
        weight = kernel * own
        np.testing.assert_allclose(found[row], np.tensordot(weight, values, axes=1) / weight.sum(), atol=1e-5)
        ends = np.linspace(-half, half, 20_001)
        whole = np.abs(np.i0(beta * np.sqrt(np.maximum(1.0 - (ends / half) ** 2, 0.0))) * np.sinc(4.0 * ends))
        area = whole.mean() * 2.0 * half
        assert parallel.coverage()[row] == pytest.approx(np.abs(weight).sum() / area, rel=2e-3)
        flagged = times > outputs[row] + 0.05
        assert parallel.share(flagged)[row] == pytest.approx(
            np.abs(weight[flagged]).sum() / np.abs(weight).sum(), abs=1e-4
        )


@pytest.mark.parametrize(
    ("period_s", "cutoff_hz", "count"),
    [
        (0.001, 2.0, 12),
        (0.001, 2.5, 10),
        (0.0126, 2.0, 1),
        (0.00624, 2.0, 2),
        (0.00626, 2.0, 1),
        (-1.0, 2.0, 1),
    ],
)
def test_so_many_neighbours_leave_forty_samples_a_period(
    period_s: float, cutoff_hz: float, count: int
) -> None:
    assert thinning(period_s, cutoff_hz) == count


def test_the_excitation_takes_half_overlapping_segments_of_thirty_seconds() -> None:
    assert Excitation(100_000, 0.01)._segment == 3000
    assert Excitation(100_000, 0.2)._segment == 256
    assert Excitation(100, 0.01)._segment == 100
    time = np.arange(6000) * 0.01
    # The first half turns slowly, the second fast: the spectrum has both.
    speed = np.where(time < 30.0, np.sin(2 * np.pi * 0.5 * time), np.sin(2 * np.pi * 3.0 * time))
    found = Excitation(6000, 0.01)
    found.add(speed[:, None])
    both = found.frequency()
    assert 3.0 < both < 3.8
    assert found.frequency(0.2) == pytest.approx(0.5, abs=0.15)
    # Too short for another segment: the rest waits for more.
    found.add(np.sin(2 * np.pi * 9.0 * np.arange(1000) * 0.01)[:, None])
    assert found.frequency() == both
    found.add(np.sin(2 * np.pi * 9.0 * np.arange(3000) * 0.01)[:, None])
    assert found.frequency() > 8.8


def test_the_steps_of_a_coarse_encoder_are_no_excitation() -> None:
    time = np.arange(30_000) * 0.002
    position = sum(0.15 / k * np.sin(2 * np.pi * k * time + k**2) for k in (0.127, 0.211, 0.377, 0.6))
    steps = np.round(np.asarray(position) / 0.01) * 0.01
    for cutoff_hz in (20.0, 60.0):
        speed = low_pass(np.gradient(steps, 0.002)[:, None], 0.002, cutoff_hz)
        found = Excitation(len(speed), 0.002)
        found.add(speed)
        assert found.frequency() > 0.3 * cutoff_hz
        assert found.frequency(cutoff_hz=cutoff_hz) == pytest.approx(0.6, abs=0.15)


def test_fast_motion_is_no_noise() -> None:
    time = np.arange(30_000) * 0.002
    speed = sum(np.sin(2 * np.pi * f * time + f) for f in (0.5, 1.0, 2.0, 4.0, 7.0))
    found = Excitation(len(time), 0.002)
    found.add(np.asarray(speed)[:, None])
    assert found.frequency(cutoff_hz=10.0) == pytest.approx(7.0, abs=0.2)


def test_a_joint_of_a_hundredth_of_the_speed_is_the_slowest_that_counts() -> None:
    time = np.arange(6000) * 0.01
    slow, fast = np.sin(2 * np.pi * 0.5 * time), np.sin(2 * np.pi * 4.0 * time)
    for share, seen in ((0.0099, False), (0.0101, True)):
        found = Excitation(6000, 0.01)
        for part in (slice(0, 2500), slice(2500, None)):
            found.add(np.column_stack([slow[part], share * fast[part]]))
        assert (found.frequency() > 3.0) == seen


@pytest.mark.parametrize(("range_rad", "moves"), [(0.01, False), (0.0101, True)])
def test_a_joint_moves_beyond_a_hundredth_of_a_radian(range_rad: float, moves: bool) -> None:
    position = np.array([[0.0, 1.0], [range_rad, 1.0]])
    assert moving(position, ("a", "b")) == (("a",) if moves else ())
    assert moving(position, ("a", "b"), 0.02) == ()


@pytest.mark.parametrize(
    ("facts", "named"),
    [
        ({"motor_rate_hz": 4.0}, "motor channel's 4.0 Hz"),
        ({"joint_rate_hz": 4.0}, "joint channel's 4.0 Hz"),
        ({"excitation_hz": 1.5}, "1.50 Hz; Coriolis"),
    ],
)
def test_advice_names_the_channel_and_its_figure(facts: dict[str, float], named: str) -> None:
    usual = {"excitation_hz": 0.5, "joint_rate_hz": 1000.0, "motor_rate_hz": 250.0}
    assert advice(SignalSettings(), **usual) == ()  # type: ignore[arg-type]
    assert any(named in sentence for sentence in advice(SignalSettings(), **{**usual, **facts}))  # type: ignore[arg-type]


@pytest.mark.parametrize(("count", "pad"), [(5, 4), (30, 29), (31, 30), (400, 30)])
def test_a_low_pass_is_extended_by_three_periods_of_its_cut_off_or_all_there_is(count: int, pad: int) -> None:
    values = np.random.default_rng(count).normal(size=(count, 2)).cumsum(axis=0)
    expected = sosfiltfilt(butter(4, 0.2, output="sos"), values, axis=0, padlen=pad)
    np.testing.assert_allclose(low_pass(values, 0.01, 10.0), expected, atol=1e-9)


def test_two_samples_have_a_step_and_one_has_none() -> None:
    assert median_step(np.array([1.0, 1.25])) == 0.25
    assert median_step(np.array([0.0, 0.1, 0.3, 0.6])) == pytest.approx(0.2)
    assert np.isnan(median_step(np.array([1.0])))
