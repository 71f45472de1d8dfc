from __future__ import annotations

import copy

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fri.errors import ConfigurationError
from fri.policy import KrcLimits, KrcPolicy
from fri.states import Quality
from fri.timing import AnswerStatistics, classify


@given(st.lists(st.one_of(st.none(), st.integers(0, 10**8)), min_size=1, max_size=60), st.integers(2, 12))
def test_statistics_are_those_of_the_last_window(latencies, window):
    statistics = AnswerStatistics(window)
    for count, latency in enumerate(latencies, 1):
        statistics.close(latency)
        last = latencies[max(0, count - window) : count]
        times = np.array([value for value in last if value is not None], dtype=float) * 1e-9
        assert statistics.packets == len(last)
        assert statistics.answer_rate == pytest.approx(len(times) / len(last))
        assert statistics.miss_rate == pytest.approx(1 - len(times) / len(last))
        assert statistics.latency == pytest.approx(times.mean() if len(times) else 0.0, abs=1e-12)
        assert statistics.jitter == pytest.approx(times.std() if len(times) else 0.0, abs=1e-9)
    assert statistics.miss_counter == latencies.count(None)


def test_late_answer_counts_for_the_latency_and_stays_a_miss():
    statistics = AnswerStatistics(100)
    statistics.close(1_000_000)
    statistics.close(None)
    statistics.close(1_000_000)
    statistics.late(2, 4_000_000)
    assert statistics.latency == pytest.approx(0.002)
    assert statistics.answer_rate == pytest.approx(2 / 3)
    statistics.late(2, 9_000_000)
    statistics.late(50, 9_000_000)
    assert statistics.latency == pytest.approx(0.002)


@pytest.mark.parametrize(
    ("packets", "rate", "latency", "quality"),
    [
        (99, 1.0, 0.0, Quality.UNACCEPTABLE),
        (100, 1.0, 0.0, Quality.PERFECT),
        (100, 0.99, 0.0004, Quality.PERFECT),
        (100, 0.99, 0.0005, Quality.OK),
        (100, 0.98, 0.0, Quality.OK),
        (100, 0.95, 0.0, Quality.OK),
        (100, 0.94, 0.0, Quality.BAD),
        (100, 0.80, 0.0, Quality.BAD),
        (100, 0.79, 0.0, Quality.UNACCEPTABLE),
    ],
)
def test_quality_thresholds(packets, rate, latency, quality):
    assert classify(packets, rate, latency, 0.001, KrcPolicy()) is quality


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("window", 1),
        ("minimum_packets", 101),
        ("ok_rate", 0.999),
        ("bridged_cycles", -1),
        ("mirror_tolerance", 0.0),
        ("stop_jerk_time_s", float("inf")),
        ("acceleration_factor", -1.0),
        ("limit_tolerance", 0.1),
        ("start_dwell", -1),
    ],
)
def test_impossible_policies_are_refused_by_name(setting, value):
    with pytest.raises(ConfigurationError, match=setting):
        KrcPolicy(**{setting: value})


def test_impossible_limits_are_refused_by_joint():
    ones = np.ones(7)
    with pytest.raises(ConfigurationError, match="q_min"):
        KrcLimits(np.full(6, -1.0), ones, ones, ones)
    with pytest.raises(ConfigurationError, match="E1 q_min"):
        KrcLimits(np.array([-1.0, -1, 2, -1, -1, -1, -1]), ones, ones, ones)
    with pytest.raises(ConfigurationError, match="A6 v_max"):
        KrcLimits(-ones, ones, np.array([1.0, 1, 1, 1, 1, 1, 0]), ones)
    with pytest.raises(ConfigurationError, match="finite"):
        KrcLimits(-ones, ones, ones, np.full(7, np.nan))


def test_an_answer_older_than_the_window_or_the_session_is_not_counted():
    statistics = AnswerStatistics(4)
    for _ in range(3):
        statistics.close(None)
    statistics.late(4, 1_000_000)
    statistics.late(0, 1_000_000)
    assert statistics.latency == 0.0
    statistics.late(3, 3_000_000)
    assert statistics.latency == pytest.approx(0.003)
    statistics.late(1, 1_000_000)
    assert (statistics.latency, statistics.jitter) == pytest.approx((0.002, 0.001))
    assert (statistics.answer_rate, statistics.miss_counter) == (0.0, 3)
    # It leaves the window with its packet.
    for _ in range(2):
        statistics.close(None)
    assert (statistics.latency, statistics.jitter) == pytest.approx((0.001, 0.0))


@pytest.mark.parametrize(
    "settings",
    [
        {"window": 2, "minimum_packets": 1},
        {"window": 100, "minimum_packets": 100},
        {"bad_rate": 0.0, "ok_rate": 0.0, "perfect_rate": 0.0},
        {"bad_rate": 1.0, "ok_rate": 1.0, "perfect_rate": 1.0},
        {"start_dwell": 0},
        {"bridged_cycles": 0},
        {"limit_tolerance": 0.0},
        {"acceleration_factor": 0.1},
    ],
)
def test_extreme_policies_are_possible(settings):
    policy = KrcPolicy(**settings)
    assert all(getattr(policy, name) == value for name, value in settings.items())


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("minimum_packets", 0),
        ("bad_rate", -0.1),
        ("perfect_rate", 1.1),
        ("bad_rate", 0.96),
        ("perfect_latency", 0.0),
        ("perfect_latency", float("nan")),
        ("t1_velocity_factor", 0.0),
        ("stop_acceleration_factor", -1.0),
        ("stop_jerk_time_s", 0.0),
        ("acceleration_factor", 0.0),
        ("limit_tolerance", 1e-3),
        ("limit_tolerance", -1e-9),
    ],
)
def test_policies_just_beyond_the_possible_are_refused(setting, value):
    with pytest.raises(ConfigurationError, match=setting):
        KrcPolicy(**{setting: value})


def test_limits_are_copies_that_cannot_be_changed():
    high = np.ones(7)
    limits = KrcLimits(-high, high, high, high)
    high[0] = 5.0
    assert limits.q_max[0] == 1.0
    with pytest.raises(ValueError, match="read-only"):
        limits.v_max[0] = 2.0
    with pytest.raises(ConfigurationError, match=r"A1 v_max 1\.0 rad/s and a_max 0\.0"):
        KrcLimits(-limits.q_max, limits.q_max, limits.v_max, np.zeros(7))
    with pytest.raises(ConfigurationError, match="A1 q_min"):
        KrcLimits(limits.q_max, limits.q_max, limits.v_max, limits.v_max)


def test_a_steady_window_stays_as_it_is():
    statistics = AnswerStatistics(4)
    for latency in (100, 200, 200, 200):
        statistics.close(latency)
        assert not statistics.steady(200)
    statistics.close(200)
    assert statistics.steady(200)
    assert not statistics.steady(100)
    twin = copy.deepcopy(statistics)
    statistics.repeat(6)
    for _ in range(6):
        twin.close(200)
    assert vars(statistics) == vars(twin)
    statistics.close(None)
    assert not statistics.steady(200)
