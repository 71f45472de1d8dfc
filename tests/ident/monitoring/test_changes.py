from __future__ import annotations

import numpy as np
import pytest

from fri.errors import DataError
from ident.monitoring import Series, changes, day_scatter, unlike


def series(values: np.ndarray, std: float = 0.01, usual: float | None = None) -> Series:
    return Series("Fcm2", np.arange(len(values), dtype=float), values, np.full(len(values), std), usual)


def test_a_step_is_found_on_its_day_with_its_size() -> None:
    random = np.random.default_rng(1)
    values = 3.0 + 0.05 * random.normal(size=30)
    values[17:] += 0.4
    (found,) = changes(series(values))
    assert (found.course, found.time) == ("step", 17.0)
    assert found.earliest <= 17.0 <= found.latest <= 19.0
    assert abs(found.difference - 0.4) < 3.0 * np.hypot(found.before_std, found.after_std)
    assert found.percent == pytest.approx(13.3, abs=2.0)


def test_a_drift_is_told_from_a_step_and_its_beginning_has_an_interval() -> None:
    random = np.random.default_rng(2)
    time = np.arange(30.0)
    values = 3.0 + 0.05 * random.normal(size=30) + 0.03 * np.maximum(time - 12.0, 0.0)
    (found,) = changes(series(values))
    assert found.course == "drift"
    assert found.earliest <= 12.0 <= found.latest
    assert abs(found.difference - 0.51) < 4.0 * found.after_std


def test_two_steps_are_two_changes() -> None:
    random = np.random.default_rng(3)
    values = 3.0 + 0.05 * random.normal(size=40)
    values[10:] += 0.5
    values[28:] -= 0.8
    assert [found.time for found in changes(series(values))] == [10.0, 28.0]


@pytest.mark.parametrize("days", [5, 8, 30])
def test_a_healthy_series_seldom_changes(days: int) -> None:
    random = np.random.default_rng(4)
    count, level = 400, 0.01
    found = sum(
        bool(changes(series(3.0 + 0.05 * random.normal(size=days), usual=0.05), level)) for _ in range(count)
    )
    # The scatter is estimated from the same days; twice the level is tolerated.
    assert found <= 2.0 * level * count + 2.0


def test_the_scatter_is_the_habit_beyond_the_stated_one_and_a_step_hardly_enters_it() -> None:
    random = np.random.default_rng(5)
    values = 0.05 * random.normal(size=200)
    assert day_scatter(series(values)) == pytest.approx(0.05, rel=0.2)
    values[100:] += 5.0
    assert day_scatter(series(values)) == pytest.approx(0.05, rel=0.2)
    assert day_scatter(series(values[:2], usual=0.2)) > 0.15


def test_one_strange_day_is_no_change() -> None:
    random = np.random.default_rng(6)
    values = 3.0 + 0.05 * random.normal(size=30)
    values[29] += 1.0
    assert changes(series(values)) == ()


def test_days_must_rise() -> None:
    with pytest.raises(DataError, match="do not rise"):
        Series("Ia1", np.array([1.0, 1.0]), np.zeros(2), np.zeros(2))


def test_the_arm_unlike_the_others_is_named_and_no_other() -> None:
    random = np.random.default_rng(7)
    arms = {f"arm {k}": (3.0 + 0.1 * random.normal(), 0.02) for k in range(20)}
    arms["arm 5"] = (4.5, 0.02)
    found = unlike({"Fcm2": arms, "Ia1": {name: (1.0 + 0.05 * random.normal(), 0.01) for name in arms}})
    assert [(one.arm, one.name) for one in found] == [("arm 5", "Fcm2")]
    assert unlike({"Fcm2": dict(list(arms.items())[3:7])}) == ()
