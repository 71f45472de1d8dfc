"""A joint that slides has forces in N, not torques in Nm, wherever a size is told."""

from __future__ import annotations

import dataclasses

import numpy as np

from ident.dynamics.kinematics import Chain
from ident.estimation.forward_simulation import simulate_session
from ident.estimation.identification import IdentificationSettings
from ident.estimation.identify import identify
from ident.estimation.validate import validate
from ident.screening.channels import check_channels
from lwr_driver.listing import text_of
from tests.ident.screening.torque_sessions import TIMES, of_joints


def recorded(phase: float):
    """A spindle along a vertical axis, and a column that turns about it."""
    time, phases = TIMES[:, None], phase + np.array([0.0, 2.0])
    q = np.sin(1.1 * time + phases) + 0.4 * np.sin(2.3 * time + phases)
    qd = np.gradient(q, 0.004, axis=0)
    effort = np.array([5.0, 8.0]) * np.gradient(qd, 0.004, axis=0) + [0.0, 8.0 * 9.81]
    return of_joints(q, effort + 3.0 * np.sign(qd))


def test_rows_scores_and_checks_of_a_sliding_joint_are_in_newtons() -> None:
    arm = Chain.from_table([{"name": "J1"}, {"name": "J2", "kind": "prismatic"}], gravity=(0.0, 0.0, -9.81))
    assert arm.torque_units == ("Nm", "N")
    found = identify([recorded(0.0)], arm, IdentificationSettings(model=1, estimator="wls"))
    units = {one.label: one.unit for one in found.estimate.classes}
    assert units == {"J1 joint": "Nm", "J2 joint": "N"}
    held = recorded(0.7)
    score = validate(found.model, [held], allow_seen=True).scores[0]
    assert [one.unit for one in score.scores] == ["Nm", "N"]
    rows = [line.split() for line in text_of(score.pieces()).splitlines() if " joint  " in line]
    assert [row[-1] for row in rows] == ["Nm", "N"]
    silent = np.array(held.joint.effort)
    silent[:, 1] = 0.0
    dead = dataclasses.replace(held, joint=dataclasses.replace(held.joint, effort=silent))
    seen = [doubt.seen for doubt in check_channels([dead], arm) if doubt.joints == ("J2",)]
    assert "reads 0 N in every sample" in seen
    (line,) = [
        line for line in text_of(simulate_session(found.model, held).pieces()).splitlines() if " J2 " in line
    ]
    assert line.split()[2::2] == ["N", "mm"]
