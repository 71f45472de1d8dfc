from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from ident.excitation.arm_model import Mechanism, tip_path
from ident.excitation.clearance import Space, distances, row_gradient, space_of
from lwr_driver.arm import Arm
from lwr_driver.arm.cell import Box, Cell, PayloadShape
from lwr_driver.arm.collision import CollisionChecker


@pytest.fixture(scope="module")
def checker(arm: Arm) -> CollisionChecker:
    table = Box("table", (0.8, 1.2, 0.05), (0.9, 0.0, 0.3), (0.0, 10.0, 30.0))
    return CollisionChecker(
        arm, Cell(boxes=(table,)), PayloadShape("box", (0.1, 0.12, 0.2), (0.0, 0.05, 0.15))
    )


@pytest.fixture(scope="module")
def space(mechanism: Mechanism, checker: CollisionChecker) -> tuple[Space, tuple[str, ...]]:
    return space_of(mechanism, checker.geometry)


def test_capsules_never_promise_more_room_than_the_shapes_have(
    arm: Arm, mechanism: Mechanism, checker: CollisionChecker, space: tuple[Space, tuple[str, ...]]
) -> None:
    rng = np.random.default_rng(3)
    postures = rng.uniform(arm.q_low, arm.q_high, (60, 7))
    found = distances(mechanism, space[0], postures)
    model = pin.buildModelFromXML(arm.urdf)
    data, results = model.createData(), checker.geometry.createData()
    objects = checker.geometry.geometryObjects
    names = [
        f"{objects[pair.first].name} to {objects[pair.second].name}"
        for pair in checker.geometry.collisionPairs
    ]
    assert sorted(names) == sorted(space[1][2:])
    column = [space[1].index(name) for name in names]
    for row, q in enumerate(postures):
        pin.computeDistances(model, data, checker.geometry, results, q)
        true = np.array([result.min_distance for result in results.distanceResults])
        apart = true > 0.0
        assert np.all(found[row, column][apart] <= true[apart] + 1e-6)


def test_flange_rows_are_the_flange(
    arm: Arm, mechanism: Mechanism, space: tuple[Space, tuple[str, ...]]
) -> None:
    model = pin.buildModelFromXML(arm.urdf)
    data = model.createData()
    q = np.random.default_rng(1).uniform(arm.q_low, arm.q_high)
    pin.framesForwardKinematics(model, data, q)
    flange = data.oMf[model.getFrameId("flange")].translation - np.array([0.0, 0.0, 0.3105])
    np.testing.assert_allclose(tip_path(mechanism, q[None])[0], flange, atol=1e-12)
    row = distances(mechanism, space[0], q[None])[0]
    np.testing.assert_allclose(row[:2], [np.hypot(flange[0], flange[1]), flange[2]], atol=1e-12)


def test_gradient_of_every_row_agrees_with_differences(
    arm: Arm, mechanism: Mechanism, space: tuple[Space, tuple[str, ...]]
) -> None:
    rng = np.random.default_rng(5)
    postures = rng.uniform(0.8 * arm.q_low, 0.8 * arm.q_high, (40, 7))
    h, step = 1e-6, rng.normal(size=(40, 7))
    up, down = (distances(mechanism, space[0], postures + s * h * step) for s in (1, -1))
    base = distances(mechanism, space[0], postures)
    checked = 0
    for row in range(space[0].rows):
        slope = (up[:, row] - down[:, row]) / (2 * h)
        qbar = np.empty((40, 7))
        row_gradient(mechanism.geometry, postures, row, np.ones(40), qbar, space[0].shapes)
        near = (np.abs(base[:, row]) < 0.14) if row > 1 else np.ones(40, dtype=bool)
        error = np.abs(slope - np.sum(qbar * step, axis=1))[near]
        # nearest points may jump at a few postures; everywhere else the envelope theorem is exact
        assert np.count_nonzero(error > 1e-4) <= 0.1 * max(near.sum(), 10)
        checked += int(near.sum())
    assert checked > 150
