from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fri.errors import ConfigurationError, RefusedError
from ident.excitation import ExcitationPlan, Workspace, arm_limits, check_motion, feasible_fourier
from ident.excitation.arm_model import ArmEstimate, Mechanism, tip_path
from lwr_driver.arm import Arm
from lwr_driver.arm.cell import Cell, PayloadShape
from lwr_driver.arm.collision import CollisionChecker


@pytest.fixture(scope="module")
def plan(arm: Arm) -> ExcitationPlan:
    return feasible_fourier(arm, None, period_s=20.0, seed=3)


def test_feasible_motion_keeps_every_limit_on_a_fine_grid(
    arm: Arm, mechanism: Mechanism, plan: ExcitationPlan
) -> None:
    samples = plan.sample(np.arange(0.0, 20.0, 1e-3))
    assert plan.check.ok
    assert np.all((samples.q > arm.q_low) & (samples.q < arm.q_high))
    assert np.all(np.abs(samples.qd) < arm.v_max)
    assert np.all(np.abs(samples.qdd) < arm.a_max)
    points = tip_path(mechanism, samples.q)
    assert np.hypot(points[:, 0], points[:, 1]).min() >= 0.3
    assert points[:, 2].min() >= -0.2
    assert np.ptp(samples.q, axis=0).min() > 0.1, "every joint moves"


def test_same_seed_gives_the_same_motion_and_another_seed_another(arm: Arm, plan: ExcitationPlan) -> None:
    again = feasible_fourier(arm, None, period_s=20.0, seed=3)
    other = feasible_fourier(arm, None, period_s=20.0, seed=4)
    assert np.array_equal(again.sample(3.0).q, plan.sample(3.0).q)
    assert not np.allclose(other.sample(3.0).q, plan.sample(3.0).q)


def test_rows_cover_whole_periods_and_end_where_they_begin(plan: ExcitationPlan) -> None:
    rows = plan.rows(0.005, periods=2)
    assert rows.shape == (8001, 7)
    np.testing.assert_allclose(rows[0], rows[-1], atol=1e-12)
    np.testing.assert_array_equal(rows[10], rows[4010])
    np.testing.assert_allclose(rows[1234], plan.sample(1234 * 0.005).q[0], atol=1e-12)
    with pytest.raises(ConfigurationError, match="whole number of FRI cycles"):
        plan.rows(0.007)


def test_plan_file_round_trip_is_exact(plan: ExcitationPlan, tmp_path: Path) -> None:
    path = tmp_path / "plan.yaml"
    plan.save(path)
    read = ExcitationPlan.load(path)
    t = np.linspace(0.0, 20.0, 17)
    np.testing.assert_array_equal(read.sample(t).q, plan.sample(t).q)
    assert read.check == plan.check
    assert read.provenance == plan.provenance


def test_broken_plan_file_says_what_is_wrong(tmp_path: Path) -> None:
    path = tmp_path / "plan.yaml"
    path.write_text("schema_version: 1\nkind: excitation plan\nperiods: 1\n")
    with pytest.raises(ConfigurationError, match=r"plan\.yaml: key `joint_names` is missing"):
        ExcitationPlan.load(path)


def test_check_reports_the_violated_limit_with_value_and_time(
    arm: Arm, mechanism: Mechanism, plan: ExcitationPlan
) -> None:
    limits = arm_limits(arm)
    narrow = replace(limits, v_max=np.where(np.arange(7) == 3, 0.05, limits.v_max))
    result = check_motion(plan.motion, mechanism, narrow, workspace=Workspace(0.9, -0.2))
    kinds = {(margin.subject, margin.constraint) for margin in result.violations}
    assert not result.ok
    assert kinds == {("A3", "velocity"), ("flange", "distance from axis 1")}
    worst = next(margin for margin in result.violations if margin.constraint == "velocity")
    speed = np.abs(plan.sample(np.linspace(0, 20, 20001)).qd[:, 3]).max()
    assert abs(worst.value) == pytest.approx(speed, rel=1e-5)
    assert "A3 velocity" in str(worst)
    assert "violates" in str(worst)


def test_torque_limits_count_friction_and_uncertainty(
    arm: Arm, mechanism: Mechanism, plan: ExcitationPlan
) -> None:
    known = ArmEstimate.nominal(mechanism)
    drives = known.drives.copy()
    drives[:, 2] = 1.0
    with_friction = replace(known, drives=drives)
    uncertain = with_friction.with_relative_uncertainty(0.1)
    values = []
    for estimate in (known, with_friction, uncertain):
        result = check_motion(plan.motion, mechanism, arm_limits(arm), estimate=estimate)
        values.append([margin.value for margin in result.margins if margin.constraint == "joint torque"])
    np.testing.assert_allclose(np.subtract(values[1], values[0]), 1.0, atol=1e-9)
    assert np.all(np.subtract(values[2], values[1]) > 0.29)


def test_impossible_limits_are_refused_by_name(arm: Arm) -> None:
    with pytest.raises(RefusedError, match="flange distance from axis 1"):
        feasible_fourier(arm, None, workspace=Workspace(radius_m=3.0))


def test_the_collision_checker_decides(arm: Arm) -> None:
    class Blocked:
        def check_path(self, q: np.ndarray, *, period_s: float = 0.0):  # type: ignore[no-untyped-def]
            class Contact:
                distance, pair, row = -0.01, ("link_2", "table"), 0

            return Contact()

    with pytest.raises(RefusedError, match="link_2 and table clearance"):
        feasible_fourier(arm, Blocked(), seed=1)


@pytest.mark.parametrize(
    "shape",
    [
        PayloadShape("box", (0.10, 0.10, 0.12), (0.0, -0.05, 0.14)),
        PayloadShape("cylinder", (0.03, 0.10), (0.0, 0.0, 0.13)),
    ],
)
def test_a_payload_on_the_flange_leaves_a_motion(arm: Arm, shape: PayloadShape) -> None:
    checker = CollisionChecker(arm, Cell.load(), shape)
    plan = feasible_fourier(
        arm, checker, period_s=10.0, harmonics=3, speed_scale=0.3, seed=2, clearance_m=0.03
    )
    assert plan.check.ok
    nearest = min(checker.clearance(q).distance for q in plan.sample(np.arange(0.0, 10.0, 0.1)).q)
    assert nearest >= 0.03
