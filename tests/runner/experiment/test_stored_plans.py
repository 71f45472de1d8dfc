"""The default experiment drives stored motions: nothing is searched, everything is checked."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest

from lwr_driver.arm import Arm
from lwr_driver.arm.cell import Cell
from lwr_driver.motion import Motion
from runner import planning
from runner.experiment_file import Experiment


def test_the_default_experiment_plans_nothing_and_its_motions_pass(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(planning, "feasible_fourier", lambda *_, **__: pytest.fail("a motion was searched"))
    experiment = Experiment.load()
    arm = Arm.load(experiment.arm, beside=experiment.folder)
    cell = Cell.load(experiment.cell, beside=experiment.folder)
    motions = planning.Excitations.of(experiment, arm, cell)
    home = experiment.home(len(arm.joint_names))
    plans = []
    for session in experiment.sessions[1:]:
        rows = motions.rows(session, 0.005)
        _, preflight = planning.session_motion(experiment, arm, cell, session, rows, home)
        assert preflight.ok, str(preflight)
        plans.append(rows)
    assert len(plans[0]) != len(plans[1])


@pytest.mark.parametrize("period_s", [0.001, 0.002, 0.007, 0.01, 0.05])
def test_an_attached_plan_has_its_ends_and_a_hundred_rows_a_second_at_most(
    period_s: float, tmp_path: Path
) -> None:
    time = np.arange(round(2.0 / period_s) + 2) * period_s
    motion = Motion(np.sin(time)[:, None] * np.ones(7), period_s, ((0, "period 1"),))
    with np.load(io.BytesIO(planning.attached_plan(motion))) as plan:
        assert plan["time"][[0, -1]] == pytest.approx(time[[0, -1]])
        assert np.diff(plan["time"])[:-1].min() >= min(0.0069, period_s)
        assert plan["q"] == pytest.approx(np.sin(plan["time"])[:, None] * np.ones(7), abs=1e-12)
        assert plan["qd"].shape == plan["qdd"].shape == plan["q"].shape
        assert len(plan["time"]) <= 2.2 / max(period_s, 0.01) * 1.5 + 2
