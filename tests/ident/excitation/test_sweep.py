from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from ident.dynamics.parameters import from_pinocchio
from ident.excitation.arm_model import Mechanism
from ident.excitation.sweep import backward, forward
from lwr_driver.arm import Arm


@pytest.fixture
def columns() -> tuple[np.ndarray, np.ndarray]:
    return np.tile(np.arange(10), 7).astype(np.int64), np.arange(0, 71, 10).astype(np.int64)


def _run(
    mechanism: Mechanism, samples: list[np.ndarray], columns: tuple, chi: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    n = samples[0].shape[0]
    z, tau = np.zeros((7, n, 74)), np.zeros((chi.shape[0], n, 7))
    parameter, first = columns
    forward(mechanism.dynamics, tuple(samples), (first, parameter), chi, 0.05, z, tau)
    return z, tau


def test_regressor_and_torque_equal_pinocchio(
    arm: Arm, mechanism: Mechanism, columns: tuple, rng: np.random.Generator
) -> None:
    model = pin.buildModelFromXML(arm.urdf)
    data = model.createData()
    samples = [rng.normal(size=(20, 7)) for _ in range(3)]
    chi = np.stack([mechanism.bodies, rng.normal(size=(7, 10))])
    z, tau = _run(mechanism, samples, columns, chi)
    for row, (q, qd, qdd) in enumerate(zip(*samples, strict=True)):
        regressor = from_pinocchio(pin.computeJointTorqueRegressor(model, data, q, qd, qdd).reshape(7, 7, 10))
        for joint in range(7):
            np.testing.assert_allclose(
                z[joint, row, 10 * joint : 70], regressor[joint, joint:].ravel(), atol=1e-12
            )
        np.testing.assert_allclose(tau[0, row], pin.rnea(model, data, q, qd, qdd), atol=1e-12)
        np.testing.assert_allclose(tau[1, row], regressor.reshape(7, 70) @ chi[1].ravel(), atol=1e-12)


def test_reverse_sweep_is_the_derivative_of_the_forward_sweep(
    mechanism: Mechanism, columns: tuple, rng: np.random.Generator
) -> None:
    samples = [rng.normal(size=(6, 7)) for _ in range(3)]
    chi = rng.normal(size=(2, 7, 10))
    zbar, taubar = np.zeros((7, 6, 74)), rng.normal(size=(2, 6, 7))
    for joint in range(7):
        zbar[joint, :, 10 * joint :] = rng.normal(size=(6, 74 - 10 * joint))
    gradient = [np.zeros((6, 7)) for _ in range(3)]
    parameter, first = columns
    backward(mechanism.dynamics, tuple(samples), (first, parameter), chi, 0.05, zbar, taubar, tuple(gradient))

    def value(moved: list[np.ndarray]) -> float:
        z, tau = _run(mechanism, moved, columns, chi)
        return float(np.sum(z * zbar) + np.sum(tau * taubar))

    for which in range(3):
        for _ in range(5):
            step = [np.zeros((6, 7)) for _ in range(3)]
            step[which] = rng.normal(size=(6, 7))
            h = 1e-6
            up = value([s + h * d for s, d in zip(samples, step, strict=True)])
            down = value([s - h * d for s, d in zip(samples, step, strict=True)])
            assert np.sum(gradient[which] * step[which]) == pytest.approx(
                (up - down) / (2 * h), rel=2e-6, abs=1e-6
            )
