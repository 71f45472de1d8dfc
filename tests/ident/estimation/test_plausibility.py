"""Estimates that no arm can have are named; a little negative friction of a sensor is not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fri.errors import DataError
from ident.estimation.plausibility import check_estimate, require_plausible
from ident.estimators import Problem, RowGroup, WeightedLeastSquares

JOINTS = ("A1", "A2", "A3")
NAMES = tuple(f"{symbol}{k}" for k in (1, 2, 3) for symbol in ("Ia", "Fvm", "Fcm"))


def fitted(truth: np.ndarray, noise: float = 0.05) -> tuple[Problem, object]:
    """Model 3 of three joints: drive inertia and friction (3, 3)."""
    random = np.random.default_rng(3)
    time = np.arange(400) * 0.2
    groups = []
    for k, joint in enumerate(JOINTS):
        speed = np.sin(0.31 * (k + 1) * time) + 0.5 * np.cos(0.83 * time + k)
        matrix = np.zeros((len(time), 9))
        matrix[:, 3 * k : 3 * k + 3] = np.column_stack([np.gradient(speed, time), speed, np.sign(speed)])
        target = matrix[:, 3 * k : 3 * k + 3] @ truth[k] + noise * random.normal(size=len(time))
        groups.append(RowGroup(joint, "difference", 0, matrix, target, np.arange(len(time))))
    problem = Problem(NAMES, tuple(groups), 0.2)
    return problem, WeightedLeastSquares().fit(problem)


HEALTHY = np.array([[3.0, 10.0, 8.0], [2.0, 6.0, 5.0], [1.0, 3.0, 2.0]])


def test_a_healthy_arm_is_plausible() -> None:
    assert check_estimate(*fitted(HEALTHY), JOINTS) == []  # type: ignore[arg-type]


def test_a_narrow_exchange_of_viscous_and_coulomb_friction_is_plausible() -> None:
    exchanged = HEALTHY.copy()
    exchanged[1] = 2.0, -1.0, 8.0
    assert check_estimate(*fitted(exchanged), JOINTS) == []  # type: ignore[arg-type]


def test_friction_that_drives_one_joint_is_a_warning() -> None:
    wrong = HEALTHY.copy()
    wrong[1] *= [1.0, -1.0, -1.0]
    (found,) = check_estimate(*fitted(wrong), JOINTS)  # type: ignore[arg-type]
    assert (found.channel, found.joints, found.certain) == ("motor torque", ("A2",), False)
    assert "Fcm2 -5" in found.seen


def test_a_negative_drive_inertia_is_a_warning() -> None:
    wrong = HEALTHY.copy()
    wrong[2, 0] = -1.0
    (found,) = check_estimate(*fitted(wrong), JOINTS)  # type: ignore[arg-type]
    assert found.joints == ("A3",)
    assert "drive inertia" in found.seen


def test_most_joints_impossible_is_an_error() -> None:
    with pytest.raises(DataError, match="A1 motor torque"):
        require_plausible(*fitted(-HEALTHY), JOINTS)  # type: ignore[arg-type]


def test_an_invisible_share_of_the_torque_is_no_doubt() -> None:
    problem, estimate = fitted(HEALTHY * [1.0, -0.01, -0.01], noise=1e-4)
    assert check_estimate(problem, estimate, JOINTS)  # type: ignore[arg-type]
    heavy = replace(problem, groups=tuple(replace(g, target=g.target + 30.0) for g in problem.groups))
    assert check_estimate(heavy, estimate, JOINTS) == []  # type: ignore[arg-type]
