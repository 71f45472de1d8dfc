from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ident.excitation.arm_model import ArmEstimate, Mechanism, torque_bounds
from ident.excitation.check import Limits
from ident.excitation.clearance import space_of
from ident.excitation.information import Columns, Evaluator
from ident.excitation.motions import FourierBasis, Samples
from ident.excitation.program import Constraints, Program
from lwr_driver.arm import Arm
from lwr_driver.arm.cell import Cell
from lwr_driver.arm.collision import CollisionChecker


@pytest.fixture(scope="module")
def program(arm: Arm, mechanism: Mechanism, limits: Limits, estimate: ArmEstimate) -> Program:
    space, _ = space_of(mechanism, CollisionChecker(arm, Cell()).geometry)
    floor = np.full(space.rows, 0.02)
    floor[:2] = 0.3, -0.2
    tight = replace(limits, v_max=0.6 * limits.v_max, tau_max=0.5 * limits.tau_max)
    uncertain = estimate.with_relative_uncertainty(0.05)
    columns = Columns.of(7, ["ZZ2", "M8"])
    evaluator = Evaluator(mechanism, FourierBasis(10.0, 5), uncertain, columns, samples=40, refine=5)
    return Program(evaluator, Constraints(evaluator, tight, space, floor), None)


@pytest.fixture
def x(program: Program, rng: np.random.Generator) -> np.ndarray:
    x = 0.25 * rng.normal(size=63)
    program.anchor = np.zeros(63)
    program.constraints.refresh_deviation(program.signals(x))
    return x


def test_rows_are_never_more_optimistic_than_the_motion(program: Program, x: np.ndarray) -> None:
    _, c = program.values(x)
    motion = program.evaluator.basis.motion(x.reshape(7, -1))
    limits = program.constraints.limits
    middle, half = 0.5 * (limits.q_low + limits.q_high), 0.5 * (limits.q_high - limits.q_low)
    for order, bound in enumerate((half, limits.v_max, limits.a_max, limits.j_max)):
        extrema = motion.extrema(order)
        centre = middle if order == 0 else 0.0
        share = np.maximum(np.abs(extrema.low - centre), np.abs(extrema.high - centre)) / bound
        rows = c[7 * order : 7 * order + 7]
        assert np.all(rows <= 1.0 - share + 1e-12)
        assert np.all(rows >= 1.0 - share - 0.1 * np.maximum(share, 1.0))
    times = program.evaluator.times[:: program.evaluator.refine]
    samples = motion.sample(times)
    bounds = torque_bounds(program.evaluator.mechanism, samples, program.evaluator.estimate)
    share = np.maximum(bounds.joint, bounds.motor).max(axis=0) / limits.tau_max
    assert np.all(c[28:35] <= 1.0 - share + 1e-9)


def test_jacobian_agrees_with_differences(program: Program, x: np.ndarray, rng: np.random.Generator) -> None:
    step, h = rng.normal(size=63), 1e-6
    up, down = (program.values(x + s * h * step)[1] for s in (1, -1))
    _, c = program.values(x)
    _, jacobian = program.derivatives()
    given = np.any(jacobian != 0.0, axis=1)
    assert given[:28].all()
    assert given[28:35].any()
    assert given[35:].any()
    assert np.all(given[c < 0.1])
    np.testing.assert_allclose((jacobian @ step)[given], ((up - down) / (2 * h))[given], atol=2e-4, rtol=1e-4)


def test_deviation_of_torque_is_that_of_random_parameters(
    mechanism: Mechanism, estimate: ArmEstimate
) -> None:
    rng = np.random.default_rng(2)
    samples = Samples(*(rng.normal(size=(3, 7)) for _ in range(4)))
    known = torque_bounds(mechanism, samples, estimate)
    uncertain = estimate.with_relative_uncertainty(0.1)
    widened = torque_bounds(mechanism, samples, uncertain, coverage=1.0)
    draws = []
    for _ in range(2000):
        scale = [1.0 + 0.1 * rng.normal(size=part.shape) for part in (estimate.bodies, estimate.payload)]
        drives = estimate.drives * (1.0 + 0.1 * rng.normal(size=estimate.drives.shape))
        varied = ArmEstimate(estimate.bodies * scale[0], drives, estimate.payload * scale[1])
        loaded = varied.loads[1]
        from ident.excitation.arm_model import rigid_torque

        tau = rigid_torque(mechanism, samples, loaded[None])[0]
        draws.append(tau + samples.qd * drives[:, 1] + drives[:, 3] + drives[:, 2])
    # loaded joint torque; the bound takes the worst load case, so it is at least that
    spread = np.std(draws, axis=0)
    assert np.all(widened.joint - known.joint <= 1.1 * spread + 0.05)
    assert np.all(widened.joint >= known.joint)
