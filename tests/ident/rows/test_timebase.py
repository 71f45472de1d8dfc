"""Grids, bridges and outliers against plain implementations of their definitions."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from ident.rows.timebase import (
    _beyond,
    _displaced,
    _least_step,
    _medians_around,
    flag_outliers,
    stretches,
)

Array = np.ndarray


def displaced(series: Array) -> tuple[Array, Array]:
    """Distances from the median of five and from the cubic through the four neighbours; ends are repeated."""
    padded = np.concatenate([series[[0, 0]], series, series[[-1, -1]]])
    around = np.stack([padded[k : k + len(series)] for k in range(5)])
    cubic = (4.0 * (around[1] + around[3]) - around[0] - around[4]) / 6.0
    return np.abs(series - np.median(around, axis=0)), np.abs(series - cubic)


def outliers(series: Array, scale: float) -> Array:
    """Samples beyond the limits stated by `flag_outliers`, before the share of them is looked at."""
    distance, cubic = displaced(series)
    whole = len(series) // 50
    blocks = [np.median(cubic[50 * k : 50 * k + 50]) for k in range(whole)] + [np.median(cubic[-50:])]
    steps = np.abs(np.diff(series))
    grain = 5.0 * steps[steps > 0].min() if np.any(steps > 0) else 0.0
    least = max(
        0.01 * (np.percentile(series, 99.5) - np.percentile(series, 0.5)), min(grain, 0.5 * np.ptp(series))
    )
    far = []
    for k in range(len(series)):
        near = max(blocks[max(k // 50 - 1, 0) : k // 50 + 2])
        far.append(distance[k] > max(scale * 1.4826 * max(near, np.median(cubic)), least))
    return np.array(far)


@pytest.mark.parametrize("count", [5, 49, 50, 51, 99, 100, 260, 1234])
@pytest.mark.parametrize("seed", range(3))
def test_outliers_are_the_samples_beyond_the_stated_limits(count: int, seed: int) -> None:
    random = np.random.default_rng(seed)
    series = np.cumsum(random.standard_t(2.0, count)) * np.repeat(random.uniform(0.1, 5.0, 50), 25)[:count]
    np.testing.assert_allclose(_displaced(series), displaced(series), atol=1e-12)
    expected = outliers(series, 3.0)
    flags, crowded = flag_outliers(np.column_stack([series, np.zeros(count)]), 3.0)
    assert not flags[:, 1].any()
    if expected.mean() > 0.01:
        assert crowded == [0]
        assert not flags.any()
    else:
        assert crowded == []
        np.testing.assert_array_equal(flags[:, 0], expected)


@pytest.mark.parametrize("seed", range(4))
def test_rare_outliers_are_the_samples_beyond_the_stated_limits(seed: int) -> None:
    random = np.random.default_rng(seed)
    time = np.arange(3000) * 0.01
    series = np.sin(time) + 0.002 * random.standard_t(3.0, 3000)
    expected = outliers(series, 5.0)
    flags, crowded = flag_outliers(series[:, None], 5.0)
    assert crowded == []
    assert 0 < expected.sum() < 30
    np.testing.assert_array_equal(flags[:, 0], expected)


@pytest.mark.parametrize("count", [50, 99, 100, 149, 150, 151, 220])
def test_the_noise_around_is_the_largest_of_a_block_and_its_neighbours(count: int) -> None:
    values = np.random.default_rng(count).exponential(size=count)
    blocks = [np.median(values[50 * k : 50 * k + 50]) for k in range(count // 50)] + [np.median(values[-50:])]
    expected = [max(blocks[max(k - 1, 0) : k + 2]) for k in range(len(blocks))]
    np.testing.assert_allclose(_medians_around(values), expected)


@pytest.mark.parametrize(
    ("series", "step"),
    [
        ([1.0, 1.0, 1.0], 0.0),
        ([0.0, 3.0, 3.0, 1.0], 2.0),
        ([5.0, 4.0, 1.0], 1.0),
        ([2.0], 0.0),
        ([0.0, -0.25], 0.25),
    ],
)
def test_the_least_step_is_the_smallest_but_zero(series: list[float], step: float) -> None:
    assert _least_step(np.array(series)) == step


def test_a_sample_is_beyond_the_limit_of_its_block_and_the_common_one() -> None:
    distance = np.tile([1.0, 2.0], 50)
    found = _beyond(distance, np.array([1.5, 0.5]), 0.75)
    assert found[:50].tolist() == [False, True] * 25
    assert found[50:].all()
    # On the limit is not beyond it.
    assert not _beyond(distance, np.array([2.0, 2.0]), 0.0).any()
    assert not _beyond(distance, np.array([0.0, 0.0]), 2.0).any()


def time_of(count: int) -> Array:
    return 2.0 + 0.01 * np.arange(count)


@pytest.mark.parametrize(
    ("off", "resampled"), [(0.019, False), (-0.019, False), (0.021, True), (-0.021, True)]
)
def test_a_fiftieth_of_a_step_is_the_most_that_a_stamp_is_off(off: float, resampled: bool) -> None:
    time = time_of(101)
    time[50] += off * 0.01
    ((part,), lost) = stretches(time, time[:, None], np.zeros(101, dtype=bool), 0.01, 0.02)
    assert (part.resampled, lost, part.count) == (resampled, 0, 101)
    assert not part.bridged.any()


@pytest.mark.parametrize(("gap", "lost"), [(1.74, 0), (1.76, 1), (2.4, 1), (2.6, 2)])
def test_a_sample_is_lost_where_an_interval_is_long_enough(gap: float, lost: int) -> None:
    time = np.concatenate([time_of(40), time_of(40) + 0.01 * (39 + gap)])
    assert stretches(time, time[:, None], np.zeros(80, dtype=bool), 0.01, 1.0)[1] == lost


@pytest.mark.parametrize(("gap_s", "parts"), [(0.0674, 1), (0.0676, 2)])
def test_a_hole_is_longer_than_a_bridge_by_an_interval_that_loses_a_sample(gap_s: float, parts: int) -> None:
    time = np.concatenate([time_of(40), time_of(40) + 0.39 + gap_s])
    assert len(stretches(time, time[:, None], np.zeros(80, dtype=bool), 0.01, 0.05)[0]) == parts


def test_a_grid_of_irregular_samples_is_bridged_farther_than_a_step_from_all() -> None:
    time = 0.01 * np.array([*range(30), 31.95, *range(34, 60)]) + 2.0
    ((part,), _) = stretches(time, time[:, None], np.zeros(len(time), dtype=bool), 0.01, 0.1)
    assert part.resampled
    # Farther than a step from 2.29 s, 2.3195 s and 2.34 s: nothing; without the one between, 31 and 32.
    assert not part.bridged.any()
    ((part,), _) = stretches(
        np.delete(time, 30) + 1e-3 * (np.arange(56) == 5),
        np.zeros((56, 1)),
        np.zeros(56, dtype=bool),
        0.01,
        0.1,
    )
    assert part.resampled
    assert np.flatnonzero(part.bridged).tolist() == [31, 32]


@pytest.mark.parametrize("jitter", [0.0, 0.003])
def test_a_part_of_a_stretch_has_the_samples_of_the_whole(jitter: float) -> None:
    random = np.random.default_rng(2)
    time = time_of(900) + jitter * random.uniform(-1.0, 1.0, 900)
    bad = np.zeros(900, dtype=bool)
    bad[[3, 200, 201, 202, 400, 890]] = True
    columns = (np.sin(3.0 * time)[:, None], random.normal(size=(900, 2)))
    ((part,), _) = stretches(time, columns, bad, 0.01, 0.1)
    assert part.resampled == bool(jitter)
    whole = part.values
    assert whole.shape == (part.count, 3)
    for low, high in ((0, 5), (150, 320), (199, 204), (201, 202), (395, 396), (700, 899), (885, part.count)):
        np.testing.assert_allclose(part.part(low, high), whole[low:high], atol=1e-9)
    spline = CubicSpline(time[~bad], np.hstack(columns)[~bad])
    np.testing.assert_allclose(whole[200:203], spline(part.times[200:203]), atol=1e-6)
    if not jitter:
        np.testing.assert_array_equal(whole[~part.bridged], np.hstack(columns)[~bad])
        np.testing.assert_array_equal(np.flatnonzero(part.bridged), np.flatnonzero(bad))
    assert part.end == pytest.approx(part.times[-1])


def test_two_columns_of_one_array_stand_side_by_side() -> None:
    time = time_of(40)
    values = np.arange(80.0).reshape(40, 2)
    ((part,), _) = stretches(time, values, np.zeros(40, dtype=bool), 0.01, 0.02)
    np.testing.assert_array_equal(part.values, values)
    assert (part.start, part.dt, part.count) == (2.0, pytest.approx(0.01), 40)
