from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ident.excitation import (
    Check,
    ExcitationPlan,
    FourierBasis,
    Margin,
    Mechanism,
    PlanProblem,
    PointToPoint,
    SplineBasis,
    TableRow,
)
from ident.excitation.arm_model import ArmEstimate
from ident.excitation.check import Limits
from lwr_driver.configuration import CONFIGS


@pytest.fixture(scope="module")
def default() -> ExcitationPlan:
    return ExcitationPlan.load(CONFIGS / "plans/default.plan.yaml")


def test_a_plan_shows_motion_criteria_and_tightest_limits_in_ten_lines(default: ExcitationPlan) -> None:
    lines = repr(default).splitlines()
    assert len(lines) <= 10
    assert lines[0] == "ExcitationPlan: FourierSeries(7 joints, n_f = 5, T0 = 20 s), 2 period(s), 40 s"
    assert "condition number, essential 49, unscaled 34.3" in lines[1]
    assert lines[-4] == "Check: 45 limits, all kept"
    assert "A5 velocity" in lines[-3]


def test_a_check_shows_violations_first(default: ExcitationPlan) -> None:
    broken = replace(default.check.margins[3], slack=-0.5)
    lines = repr(Check((*default.check.margins, broken))).splitlines()
    assert lines[0] == "Check: 46 limits, 1 violated"
    assert len(lines) == 2
    assert "violates" in lines[1]


def test_other_public_objects_are_shown_without_arrays(
    mechanism: Mechanism, estimate: ArmEstimate, limits: Limits
) -> None:
    postures = np.zeros((2, 7)) + np.array([[0.0], [0.5]])
    shown = {
        repr(FourierBasis(20.0).motion(np.zeros((7, 9)))): "FourierSeries(7 joints, n_f = 5, T0 = 20 s)",
        repr(SplineBasis(10.0).motion(np.zeros((7, 12)))): "SplineMotion(7 joints, 17 control points, 10 s)",
        repr(
            PointToPoint(postures, limits.v_max, limits.a_max, limits.j_max)
        ): "PointToPoint(7 joints, 2 postures, ",
        repr(mechanism): "Mechanism(7 joints: A1, ",
        repr(estimate): "ArmEstimate(7 joints, payload ",
        repr(Margin("height", "flange", 0.3, 0.2, 0.1, "m", 1.0)): "Margin(constraint='height'",
        repr(PlanProblem.load("plans/default.yaml")): "PlanProblem default: lwr4plus.yaml, ",
        repr(TableRow("random", False, 20.0, 40.0, 3.0, 9.0, np.ones(7))): "trajectory  limits",
    }
    for text, start in shown.items():
        assert text.startswith(start)
        assert len(text.splitlines()) <= 10
        assert "array(" not in text
