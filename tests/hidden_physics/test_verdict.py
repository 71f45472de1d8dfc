"""Judging a diagnosis."""

from __future__ import annotations

import numpy as np
import pytest

from tests.hidden_physics.causes import CAUSES
from tests.hidden_physics.hidden import Hidden, Scene
from tests.hidden_physics.outside import OUTSIDE
from tests.hidden_physics.verdict import judge

PEAKS = (20.0, 60.0, 15.0, 40.0, 5.0, 12.0, 9.0)
SCENE = Scene(PEAKS, PEAKS, 1.0)


def hide(name: str, joint: int) -> Hidden:
    cause = CAUSES.get(name) or OUTSIDE[name]
    return cause.draw(np.random.default_rng(1), joint, SCENE)(1.0)


def found(cause: str, *joints: int, confidence: float = 0.95, alternatives=(), parameters=None):
    return {
        "cause": cause,
        "joints": list(joints),
        "confidence": confidence,
        "alternatives": [dict(cause=name, **more) for name, more in alternatives],
        "parameters": parameters or {},
    }


def diagnosis(*findings, unexplained=(), base=(1.0,) * 14, extended=(1.0,) * 14):
    return {
        "findings": list(findings),
        "unexplained": [
            {"side": "motor", "joint": joint, "depends_on": list(names)} for joint, names in unexplained
        ],
        "gain": {
            "rows_base": {"motor": list(base[:7]), "joint": list(base[7:])},
            "rows_extended": {"motor": list(extended[:7]), "joint": list(extended[7:])},
        },
    }


def test_name_and_joint_must_both_be_right() -> None:
    hidden = [hide("stribeck", 2)]
    right = judge(diagnosis(found("stribeck", 2)), hidden)
    assert right.named == (True,)
    assert right.first
    assert right.outright
    assert right.exact
    assert not right.false
    for wrong in (found("stribeck", 3), found("friction_load", 2), found("stribeck", 2, 3)):
        verdict = judge(diagnosis(wrong), hidden)
        assert verdict.named == (False,)
        assert len(verdict.false) == len(verdict.sure_wrong) == 1


def test_a_look_alike_counts_only_without_certainty() -> None:
    hidden = [hide("stribeck", 2)]
    alike = [("stribeck", {})]
    unsure = judge(diagnosis(found("presliding_hysteresis", 2, confidence=0.6, alternatives=alike)), hidden)
    assert unsure.exact
    assert not unsure.outright
    sure = judge(diagnosis(found("presliding_hysteresis", 2, confidence=0.9, alternatives=alike)), hidden)
    assert not sure.named[0]
    assert sure.sure_wrong
    elsewhere = found("stribeck", 5, confidence=0.6, alternatives=[("stribeck", {"joints": [2]})])
    assert judge(diagnosis(elsewhere), hidden).exact


def test_findings_beyond_the_truth_are_false() -> None:
    verdict = judge(diagnosis(found("stribeck", 2), found("cable_spring", 6)), [hide("stribeck", 2)])
    assert verdict.named == (True,)
    assert verdict.first
    assert not verdict.exact
    assert verdict.false == ("cable_spring(6) 0.95",)


def test_silence_about_nothing_is_right() -> None:
    assert judge(diagnosis(), []).silent
    assert not judge(diagnosis(found("stribeck", 2)), []).silent


def test_causes_of_the_whole_arm_have_no_joint_to_be_right_about() -> None:
    assert judge(diagnosis(found("contact", 4, 5)), [hide("contact", 0)]).exact


def test_pairs_are_judged_one_by_one() -> None:
    hidden = [hide("stribeck", 2), hide("cable_spring", 6)]
    assert judge(diagnosis(found("cable_spring", 6)), hidden).named == (False, True)
    assert judge(diagnosis(found("cable_spring", 6), found("stribeck", 2)), hidden).exact


def test_what_is_in_no_catalogue_must_be_flagged_and_not_named() -> None:
    hidden = [hide("friction by a neighbour's angle", 4)]
    neighbour = next(name for name in hidden[0].depends_on if name != "qd4")
    verdict = judge(diagnosis(unexplained=[(4, (neighbour,))]), hidden)
    assert verdict.flagged
    assert verdict.depends == 0.5
    assert not judge(diagnosis(unexplained=[(3, (neighbour,))]), hidden).flagged
    named = judge(diagnosis(found("friction_position", 4), unexplained=[(4, ("q4",))]), hidden)
    assert not named.flagged
    assert named.sure_wrong


def test_parameters_are_compared_in_standard_deviations() -> None:
    hidden = hide("sensor_gain", 3)
    value = hidden.parameters["error"] + 0.02
    finding = found("sensor_gain", 3, parameters={"error": {"value": value, "std": 0.01, "unit": ""}})
    assert judge(diagnosis(finding), [hidden]).deviations == {"sensor_gain.error": pytest.approx(2.0)}


def test_efficiency_is_the_share_of_the_removable_error() -> None:
    twin = np.ones(14)
    base = (2.0, *[1.0] * 13)
    extended = (1.25, *[1.0] * 13)
    verdict = judge(diagnosis(base=base, extended=extended), [hide("stribeck", 1)], twin)
    assert verdict.efficiency == pytest.approx(0.75)
    assert np.isnan(judge(diagnosis(), [], twin).efficiency)
