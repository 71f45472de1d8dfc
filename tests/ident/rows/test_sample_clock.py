"""Times behind stamps that jitter, counted by the motion."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from ident.rows.sample_clock import sample_clock

Floats = NDArray[np.float64]


def _motion(times: Floats) -> Floats:
    """Positions (N, 5) [rad] with a pause, read by an encoder of 2 microradians."""
    phase = np.arange(5) + times[:, None] * (1.0 + 0.2 * np.arange(5))
    share = np.clip(np.abs(times - 10.0) - 0.5, 0.0, 1.0)[:, None]
    moving = share**3 * (10.0 - 15.0 * share + 6.0 * share**2) * np.sin(phase)
    return np.asarray(2e-6 * np.rint(moving / 2e-6))


def _late(times: Floats, jitter_s: float) -> Floats:
    """Stamps on arrival, in order."""
    late = np.abs(np.random.default_rng(4).normal(0.0, jitter_s, len(times)))
    return np.sort(times + late) + 1e-9 * np.arange(len(times))


@pytest.mark.parametrize(("rate", "jitter_s"), [(1000.0, 3e-4), (200.0, 1e-3), (50.0, 4e-3)])
def test_jittering_stamps_become_even_times(rate: float, jitter_s: float) -> None:
    true = np.arange(20.0 * rate) / rate
    kept = np.random.default_rng(1).random(len(true)) > 0.05
    stamps = _late(true, jitter_s)[kept]
    clock = sample_clock(stamps, _motion(true[kept]))
    assert clock is not None
    error = (clock.times - true[kept])[np.abs(true[kept] - 10.0) > 1.0]
    assert np.std(error) < 0.2 * np.std(stamps - true[kept])
    assert clock.period_s * rate == pytest.approx(1.0, abs=1e-3)
    assert clock.times[0] == stamps[0]


def test_a_repeated_sample_is_told_and_the_one_after_a_lost_one_keeps_its_place() -> None:
    true = np.arange(4000) / 1000.0
    source = np.arange(4000)
    source[1000::50] -= 1
    clock = sample_clock(_late(true, 2e-4), _motion(true[source] + 2.0))
    assert clock is not None
    assert np.array_equal(np.flatnonzero(clock.repeated), np.arange(1000, 4000, 50))
    fresh = ~clock.repeated
    assert np.std(clock.times[fresh] - true[source][fresh]) < 2e-5
    assert np.all(np.diff(clock.times) > 0.0)


def test_stamps_that_tell_the_true_times_of_uneven_samples_stand() -> None:
    true = np.sort(np.arange(4000) / 1000.0 + np.random.default_rng(2).normal(0.0, 3e-4, 4000))
    assert sample_clock(true, _motion(true)) is None


def test_even_stamps_and_an_arm_at_rest_stand() -> None:
    true = np.arange(4000) / 1000.0
    assert sample_clock(true, _motion(true)) is None
    assert sample_clock(_late(true, 3e-4), np.zeros((4000, 5))) is None


def test_another_channel_follows_the_same_clock() -> None:
    true = np.arange(4000) / 1000.0
    stamps = _late(true, 3e-4)
    clock = sample_clock(stamps, _motion(true + 1.0))
    assert clock is not None
    assert clock.at(stamps[::3], stamps) == pytest.approx(clock.times[::3])


def _wandering(late: Floats) -> Floats:
    """Stamps [periods of 1 ms] that are late by `late` and jitter by a fifth of a period."""
    jitter = 0.2 * np.random.default_rng(5).random(len(late))
    return 1e-3 * (np.arange(len(late)) + late + jitter)


@pytest.mark.parametrize(("most", "followed"), [(33.0, True), (42.0, False)])
def test_stamps_wander_by_five_times_their_usual_distance_at_most(most: float, followed: bool) -> None:
    samples = np.arange(6000)
    # Usually 5 periods early or late, in robust terms a standard deviation of 7.4.
    late = 5.0 * np.tanh(20.0 * np.sin(2 * np.pi * samples / 2000.0))
    late = late + (most - 5.0) * np.exp(-(((samples - 2500) / 100.0) ** 2))
    clock = sample_clock(_wandering(late), _motion(1e-3 * samples + 11.0))
    assert (clock is not None) == followed


@pytest.mark.parametrize(("count", "followed"), [(60, False), (61, True)])
def test_a_short_recording_keeps_its_stamps(count: int, followed: bool) -> None:
    true = np.arange(count) / 1000.0
    clock = sample_clock(_wandering(np.zeros(count)), _motion(true + 11.5))
    assert (clock is not None) == followed
