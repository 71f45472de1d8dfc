"""The first screen's verdicts from a summary alone."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from runner.report.folder import ResultFolder
from runner.report.verdicts import Verdict, estimate_lines, headline, verdicts
from runner.results import coverage, interval_holds, within

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
    found = coverage([*entries, {"name": "offl1"}], 7, interval_holds)
    assert {kind: (one["inside"], one["count"]) for kind, one in found.items()} == {
        "Ia": (1, 2),
        "Fcm": (1, 1),
        "inertias": (1, 1),
        "first moments": (2, 2),
        "payload": (1, 2),
    }


def test_estimates_within_3_sigma_are_counted_by_kind_and_a_kind_with_too_few_is_named() -> None:
    entries = [
        {"name": f"Fcm{k}", "truth": 1.0, "estimate": 1.0 + (0.31 if k < 3 else 0.29), "std": 0.1}
        for k in range(1, 8)
    ]
    entries += [{"name": f"XX{k}", "truth": 1.0, "estimate": 1.0, "std": 0.1} for k in range(1, 201)]
    near = coverage(entries, 300, within)
    assert near == {"Fcm": {"inside": 5, "count": 7}, "inertias": {"inside": 200, "count": 200}}
    told = verdict("truth of the emulated arm", within_3_sigma=0.9903, within_3_sigma_by_kind=near)
    assert told.level == "look"
    assert "99.0 % of the estimates within 3 standard deviations (too few: Fcm 5 of 7)" in told.found
    near["Fcm"]["inside"] = 6
    # One of seven is by chance.
    good = verdict("truth of the emulated arm", within_3_sigma=0.995, within_3_sigma_by_kind=near)
    assert (good.level, "too few" in good.found) == ("good", False)


def candidate(title: str, error: float | None) -> dict[str, Any]:
    return {"title": title, "held_back_percent": error}


LEANING = "physical, base leaning, sensor gain of A5"
CHOICE: dict[str, Any] = {
    "chosen": LEANING,
    "used": LEANING,
    "candidates": [candidate("physical", 1.346), candidate(LEANING, 1.177), candidate("wls", 1.39)],
    "sensor_gains": {"A5": {"error": 0.097, "std": 0.009}},
    "mounting": {"tilt_rad": [0.03, 0.04], "std_rad": [0.001, 0.002]},
    "urdf_doubt": "the URDF gives every link the same mass (1 kg)",
}


@pytest.mark.parametrize(("inside", "level"), [(100, "good"), (95, "look")])
def test_two_of_a_hundred_estimates_beyond_3_sigma_are_chance_and_seven_are_not(
    inside: int, level: str
) -> None:
    near = {"inertias": {"inside": inside, "count": 102}}
    found = verdict("truth of the emulated arm", within_3_sigma=inside / 102, within_3_sigma_by_kind=near)
    assert found.level == level


def test_departures_without_consequence_and_missing_tests_are_told_apart_from_what_holds() -> None:
    words = {"zero mean": "holds", "normality": "harmless", "exogeneity": "not tested"}
    found = verdict("assumptions", assumptions={name: {"verdict": word} for name, word in words.items()})
    assert (found.level, found.found) == ("good", "1 of 3 hold, 1 with harmless departures, 1 not tested")


@pytest.mark.parametrize(("real", "possible", "rows"), [(True, True, 0), (False, True, 1), (False, False, 0)])
def test_bodies_that_may_be_unreal_by_chance_have_a_line(real: bool, possible: bool, rows: int) -> None:
    content = {"feasibility": {"real": real, "possible": possible, "text": "no real bodies, p 0.3"}}
    lines = verdicts(ResultFolder(Path("nowhere"), SUMMARY | content))
    assert len([line for line in lines if line.subject == "real bodies"]) == rows


def choice_of(used: str, **errors: float) -> dict[str, Any]:
    best = min(errors, key=lambda name: errors[name])
    candidates = [{"title": name, "held_back_percent": error} for name, error in errors.items()]
    return {"candidates": candidates, "chosen": best, "used": used}


def test_an_estimate_that_does_not_predict_its_own_motion_is_not_called_usable() -> None:
    found = verdict("estimate", choice=choice_of("wls", physical=0.74, wls=50.31))
    assert found.level == "look"
    assert found.wanted == (
        "below 5 % on parts of the motion held back; the estimator `auto`, or a longer or richer motion"
    )
    assert headline([found]) == ("look", "A doubtful run, with one thing to look at: estimate")
    assert "auto" not in verdict("estimate", choice=choice_of("wls", physical=15.0, wls=50.0)).wanted
    assert verdict("estimate", choice=choice_of("wls", physical=0.3, wls=0.4)).level == "good"
    assert headline([verdict("warning", warnings=["weak"])])[1].startswith("A usable run")


def test_the_estimate_is_named_with_its_error_beside_the_plain_ones_its_gains_and_its_tilt() -> None:
    assert estimate_lines({"choice": CHOICE, "prior_only": ["XX1", "YY1", "ZZ1", "MX1"]}) == [
        ("estimator", "physical, base leaning, gain of A5: 1.18 % held back (wls 1.39, physical 1.35)"),
        ("sensor gains", "too much by A5 +9.7 ± 0.9 %, stated as effects of the model"),
        ("tilt of the base", "2.86 ± 0.11 deg"),
        ("prior alone", "tells 4 parameters: XX1, YY1, ZZ1 and 1 more"),
        ("URDF", "gives every link the same mass (1 kg)"),
    ]
    row = verdict("estimate", choice=CHOICE)
    assert row.level == "good"
    for text in ("physical, base leaning, gain of A5: 1.18 %", "A5 +9.7", "tilt of the base 2.86 ± 0.11 deg"):
        assert text in row.found


def test_an_estimator_that_stays_is_told_beside_the_best_and_one_without_competitors_so() -> None:
    (stays, *_) = estimate_lines({"choice": CHOICE | {"used": "wls"}})
    assert stays[1] == "wls: 1.39 % held back (best: physical, base leaning, gain of A5 1.18, physical 1.35)"
    alone = {"chosen": "physical", "used": "physical", "candidates": [candidate("physical", None)]}
    assert estimate_lines({"choice": alone}) == [
        ("estimator", "physical, not compared: the motion is too short")
    ]
    assert estimate_lines({"choice": None, "prior_only": []}) == []


def test_sessions_without_a_torque_error_are_looked_at() -> None:
    line = verdict("sessions without torque error", unscored=[{"session": "a.mcap", "reason": "too short"}])
    assert (line.level, line.found) == ("look", "a.mcap: too short")


def test_each_warning_of_the_estimate_is_a_line_to_look_at() -> None:
    lines = verdicts(ResultFolder(Path("nowhere"), SUMMARY | {"warnings": ["A2 is swapped", "A3 is dead"]}))
    assert [(line.found, line.level) for line in lines if line.subject == "warning"] == [
        ("A2 is swapped", "look"),
        ("A3 is dead", "look"),
    ]
