"""The largest error of a healthy day, from those of a few."""

from __future__ import annotations

import numpy as np

from ident.diagnosis.healthy.day_spread import largest_left


def test_a_further_healthy_day_stays_below_in_19_of_20() -> None:
    rng = np.random.default_rng(5)
    level = {"motor": np.array([2.0, 0.5, 0.1]), "joint": np.array([0.3, 0.02, np.nan])}
    within = 0
    for _ in range(400):
        *days, further = (
            {side: rows * np.exp(0.4 * rng.normal(size=3)) for side, rows in level.items()} for _ in range(3)
        )
        limit = largest_left(days)
        assert np.isnan(limit["joint"][2])
        within += all(np.all(~(further[side] > limit[side])) for side in limit)
    assert 365 <= within <= 392


def test_a_single_day_is_its_own_limit() -> None:
    found = largest_left([{"motor": np.array([2.0, 0.5])}])
    np.testing.assert_array_equal(found["motor"], [2.0, 0.5])
