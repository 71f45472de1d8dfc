"""Verdicts on what a diagnosis says."""

from __future__ import annotations

from typing import Any

import pytest

from benchmarks.mujoco_arms.judging import judge
from benchmarks.mujoco_arms.tally import table


def finding(cause: str, joint: int, confidence: float, **more: Any) -> dict[str, Any]:
    return {"cause": cause, "joints": [joint], "confidence": confidence, "parameters": {}, **more}


def truth(cause: str = "stribeck", joint: int = 2, listed: bool = True) -> dict[str, Any]:
    hidden = {
        "cause": cause,
        "joints": [joint],
        "also": [],
        "listed": listed,
        "absorbed": False,
        "parameters": {"amplitude": {"value": 2.0, "unit": "Nm"}},
    }
    traits = {"gear_ripple": {"3": {"amplitude": 0.1}}}
    kind = "single" if listed else "outside"
    return {
        "kind": kind,
        "seed": 1,
        "rho": 1.2,
        "rho_reference": 1.0,
        "hidden": [hidden],
        "traits": traits,
        "affected": [joint],
    }


def said(*findings: dict[str, Any], **more: Any) -> dict[str, Any]:
    before, after = {"motor": [1.0, 1.5]}, {"motor": [1.0, 1.1]}
    gain = {
        "rows_base": before,
        "rows_extended": after,
        "test_rms_base": before,
        "test_rms_extended": after,
    }
    return {"findings": list(findings), "unexplained": [], "gain": gain, **more}


def test_a_sure_first_finding_with_name_and_joint_is_right() -> None:
    verdict = judge(said(finding("stribeck", 2, 0.95), finding("backlash", 1, 0.9)), truth())
    assert verdict["sure"] == [True]
    assert verdict["right"]
    assert verdict["false"] == ["backlash(1) 0.90"]


def test_a_sure_finding_is_not_right_by_its_alternatives() -> None:
    other = finding("backlash", 2, 0.95, alternatives=[{"cause": "stribeck"}])
    assert not judge(said(other), truth())["right"]
    assert judge(said({**other, "confidence": 0.6}), truth())["listed"] == [True]


def test_another_joint_or_a_second_place_is_not_right() -> None:
    assert not judge(said(finding("stribeck", 3, 0.95)), truth())["right"]
    verdict = judge(said(finding("backlash", 1, 0.95), finding("stribeck", 2, 0.95)), truth())
    assert not verdict["right"]
    assert verdict["anywhere"] == [True]


def test_a_habit_of_the_arm_is_character_and_only_of_its_size() -> None:
    small = finding("gear_ripple", 3, 0.9, parameters={"amplitude": {"value": 0.12, "std": 0.01}})
    large = finding("gear_ripple", 3, 0.9, parameters={"amplitude": {"value": 3.0, "std": 0.1}})
    assert judge(said(small), truth())["character"] == ["gear_ripple(3) 0.90"]
    assert judge(said(large), truth())["false"] == ["gear_ripple(3) 0.90"]


def test_parameters_are_compared_in_their_sigmas() -> None:
    stated = {"amplitude": {"value": 2.4, "std": 0.1}, "velocity": {"value": 1.0, "std": 0.1}}
    verdict = judge(said(finding("stribeck", 2, 0.95, parameters=stated)), truth())
    assert verdict["deviations"]["stribeck.amplitude"] == pytest.approx(4.0)
    assert verdict["deviations"]["stribeck.velocity"] is None


def test_what_the_healthy_twin_has_too_is_not_flagged() -> None:
    entry = {"side": "motor", "joint": 2, "depends_on": ["q2"]}
    with_it, without = said(unexplained=[entry]), said()
    outside = truth("brake_disc", 2, listed=False)
    assert judge(with_it, outside, without)["flagged"]
    assert not judge(with_it, outside, with_it)["flagged"]


def test_the_gain_is_held_against_what_the_fault_brought() -> None:
    healthy = {"rows_base": {"motor": [1.0, 1.0]}, "rows_extended": {"motor": [1.0, 1.0]}}
    verdict = judge(said(finding("stribeck", 2, 0.95)), truth(), said(gain=healthy))
    assert verdict["efficiency"] == pytest.approx(0.8)
    assert verdict["worse"] == []


def test_the_table_has_rates_calibration_and_crashes() -> None:
    right = {"truth": truth(), "verdict": judge(said(finding("stribeck", 2, 0.95)), truth()), "seconds": 1.0}
    crash = {"truth": {**truth(), "seed": 2}, "crash": "Traceback\nZeroDivisionError: x"}
    text = table([right, crash])
    assert "1 crashes" in text
    assert "single: first and sure" in text
    assert "expected calibration error 0.050" in text
    assert "ZeroDivisionError" in text
