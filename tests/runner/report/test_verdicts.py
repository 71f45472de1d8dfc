"""The first screen's verdicts from a summary alone."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from runner.report.folder import ResultFolder
from runner.report.verdicts import Verdict, verdicts
from runner.results import coverage

SUMMARY: dict[str, Any] = {"exit_status": "success", "sessions": [], "from_logs": True}


def verdict(subject: str, **content: Any) -> Verdict:
    lines = verdicts(ResultFolder(Path("nowhere"), SUMMARY | content))
    return next(line for line in lines if line.subject == subject)


def truth(within: float, **inside: int) -> Verdict:
    held = {kind: {"inside": count, "count": 7} for kind, count in inside.items()}
    return verdict("truth of the emulated arm", within_3_sigma=within, intervals_95_hold=held)


@pytest.mark.parametrize(
    ("within", "inside", "level"),
    [
        (1.0, {"Ia": 7, "Fvm": 6, "Fcm": 7}, "good"),
        (0.99, {"Ia": 6, "Fvm": 6, "Fcm": 6}, "good"),
        (0.961, {"Ia": 7, "Fvm": 7, "Fcm": 7}, "look"),
        (0.9999, {"Ia": 3, "Fvm": 7, "Fcm": 7}, "look"),
    ],
)
def test_3_sigma_is_held_against_99_percent_and_intervals_against_95_by_kind(
    within: float, inside: dict[str, int], level: str
) -> None:
    assert truth(within, **inside).level == level


def test_a_kind_with_too_few_intervals_is_named() -> None:
    found = truth(0.995, Ia=2, Fvm=7, offm=7).found
    assert "99.5 % of the estimates within 3 standard deviations" in found
    assert "76 % of the 95 % intervals hold (too few: Ia 2 of 7)" in found


def test_intervals_are_counted_by_kind() -> None:
    def entry(name: str, truth: float) -> dict[str, Any]:
        return {"name": name, "truth": truth, "interval_95": [0.0, 1.0]}

    names = ("Ia1", "Ia2", "Fcm3", "XX2R", "MY4R", "M3R", "ZZ8", "M8")
    entries = [entry(name, 2.0 if name in ("Ia2", "ZZ8") else 0.5) for name in names]
    found = coverage([*entries, {"name": "offl1"}], joints=7)
    assert {kind: (one["inside"], one["count"]) for kind, one in found.items()} == {
        "Ia": (1, 2),
        "Fcm": (1, 1),
        "inertias": (1, 1),
        "first moments": (2, 2),
        "payload": (1, 2),
    }


def test_sessions_without_a_torque_error_are_looked_at() -> None:
    line = verdict("sessions without torque error", unscored=[{"session": "a.mcap", "reason": "too short"}])
    assert (line.level, line.found) == ("look", "a.mcap: too short")


def test_each_warning_of_the_estimate_is_a_line_to_look_at() -> None:
    lines = verdicts(ResultFolder(Path("nowhere"), SUMMARY | {"warnings": ["A2 is swapped", "A3 is dead"]}))
    assert [(line.found, line.level) for line in lines if line.subject == "warning"] == [
        ("A2 is swapped", "look"),
        ("A3 is dead", "look"),
    ]
