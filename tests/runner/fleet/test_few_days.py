"""Few days and logs without a date are no sign of health."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lwr_driver.session import SessionWriter, session_metadata
from runner.commands.fleet import doubts
from runner.fleet.days import find_days
from runner.fleet.page import arm_html, fleet_html
from runner.fleet.store import ArmStore
from runner.fleet.trend import ArmTrend, FleetTrend, arm_trend

FEW = "too few to tell a change; 5 are needed"


def arm(name: str, *days: str) -> ArmTrend:
    return ArmTrend(name, days, {}, {}, (), (), {}, ())


def march(count: int) -> list[str]:
    return [f"2026-03-0{day}" for day in range(1, count + 1)]


@pytest.mark.parametrize(
    ("days", "said"),
    [
        (["undated"], "no day with a date"),
        (["undated", "2026-03-01"], "1 day"),
        (["2026-03-01", "2026-03-01_2"], "1 day"),
        (march(4), "4 days"),
    ],
)
def test_an_arm_of_few_days_is_not_told_to_be_without_a_change(days: list[str], said: str) -> None:
    one = arm("one", *days)
    assert f"{said}, {FEW}" in str(one)
    page = arm_html(one)
    assert f"{said}, {FEW}" in page
    for text in (str(one), page):
        assert "no change beyond" not in text.lower()
        assert "no change in" not in text


def test_a_fleet_counts_the_arms_that_can_tell_a_change() -> None:
    fleet = FleetTrend((arm("short", *march(2)), arm("long", *march(6))), ())
    assert "1 of 2 arms with too few days to tell a change: short" in str(fleet)
    assert "1 of 2 arms without a change: long" in str(fleet)
    assert "none of 1 arms changed; 1 of 2 arms have too few days, 5 are needed" in fleet_html(fleet)
    assert "no change can be told" in fleet_html(FleetTrend((arm("short", *march(2)),), ()))


def test_undated_logs_are_told_and_those_with_a_date_are_not() -> None:
    assert doubts([arm("long", *march(6))]) == []
    (line,) = doubts([arm("one", "undated"), arm("long", *march(6))])
    assert line.startswith("undated logs of one have no part in any course: put the date into their path")


def test_logs_of_a_clock_without_a_date_have_no_day(tmp_path: Path) -> None:
    for name, start in (("old", 0), ("older", 5 * 86_400_000_000_000), ("2026-03-01", 0)):
        (tmp_path / name).mkdir()
        stamps = np.arange(100) * 2_000_000 + start
        metadata = session_metadata(robot="LWR4+", uid=name, serial="7", utc_start="")
        with SessionWriter(tmp_path / name / "a.mcap", ("A1",), metadata, start_ns=start) as writer:
            writer.write_joint_states(stamps, np.zeros((100, 1)), np.zeros((100, 1)), publish_time=stamps)
    found = find_days([tmp_path])
    assert [(day.key, len(day.logs)) for day in found.days] == [("undated", 2), ("2026-03-01", 1)]


def test_a_course_is_without_the_undated_logs_and_the_table_has_no_day_of_them(tmp_path: Path) -> None:
    store = ArmStore(tmp_path / "one")
    for key, value in [("undated", 9.0), *((day, 1.0 + 1e-3 * k) for k, day in enumerate(march(6)))]:
        row = {"name": "Fcm1", "unit": "Nm", "value": value, "std": 1e-3}
        store.write(key, "parameters", [row])
        session = {"uid": key, "file": "a.mcap", "payload": "none", "status": "taken", "note": ""}
        store.write(key, "sessions", [session])
    assert store.days() == ("undated", *march(6))
    assert [row["day"] for row in store.read("parameters") if row["key"] == "undated"] == [None]
    found = arm_trend(store)
    assert found.changes == ()  # 9 Nm on a day that nobody knows is no step
    assert found.undated
