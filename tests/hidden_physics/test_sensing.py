"""The hidden sensor chain."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from sim_backend.plant import Reading
from tests.hidden_physics.sensing import SensorChain


def readings(chain: SensorChain, torque: np.ndarray, noise: float = 0.0, motor: np.ndarray | None = None):
    """What the chain reports of joint torques (n, 7) and motor torques (n, 7), a row a millisecond."""
    random = np.random.default_rng(5)
    chain.start(7, np.random.default_rng(1))
    reading = Reading(*np.zeros((4, 7)))
    out, late, positions = [], [], []
    for step, row in enumerate(torque):
        plant = SimpleNamespace(position=np.full(7, 1e-3 * step), joint_torque=row)
        reading.position[:] = plant.position
        reading.joint_torque[:] = row + noise * random.standard_normal(7)
        reading.motor_torque[:] = row if motor is None else motor[step]
        chain.sense(1e-3 * step, plant, reading)
        chain.sense_motor(1e-3 * step, plant, reading)
        out.append(reading.joint_torque.copy())
        late.append(reading.motor_torque.copy())
        positions.append(reading.position.copy())
    return np.array(out), np.array(late), np.array(positions)


@pytest.fixture
def swing() -> np.ndarray:
    time = np.arange(2000) * 1e-3
    return np.outer(np.sin(2.0 * np.pi * time), np.arange(1.0, 8.0))


def test_healthy_chain_changes_nothing(swing: np.ndarray) -> None:
    out, late, _ = readings(SensorChain(), swing)
    np.testing.assert_array_equal(out, swing)
    np.testing.assert_array_equal(late, swing)


def test_gain_leak_and_clip(swing: np.ndarray) -> None:
    chain = SensorChain({"gain": {2: 1.1}, "clip": {7: 3.0}}, leak={"3": {"7": 0.1}})
    out, _, _ = readings(chain, swing)
    np.testing.assert_allclose(out[:, 1], 1.1 * swing[:, 1])
    np.testing.assert_allclose(out[:, 2], swing[:, 2] + 0.1 * swing[:, 6])
    assert out[:, 6].max() == 3.0
    assert out[:, 6].min() == -3.0


def test_play_lags_by_its_width_whatever_the_noise(swing: np.ndarray) -> None:
    out, _, _ = readings(SensorChain({"play": {7: 0.5}}), swing, noise=0.3)
    error = out[:, 6] - swing[:, 6]
    rising = slice(1300, 1450)
    falling = slice(400, 700)
    assert error[falling].mean() == pytest.approx(0.5, abs=0.1)
    assert error[rising].std() == pytest.approx(0.3, abs=0.05)
    assert error[slice(900, 1200)].mean() == pytest.approx(-0.5, abs=0.25)


def test_lateness_is_exact_between_samples() -> None:
    ramp = np.outer(np.arange(100.0), np.ones(7))
    out, late, _ = readings(SensorChain({"late": {1: 3.25e-3}, "motor_late": {1: 0.5e-3}}), ramp)
    assert out[50, 0] == pytest.approx(46.75)
    assert late[50, 0] == pytest.approx(49.5)
    assert out[50, 1] == 50.0


def test_zero_drifts_and_creeps(swing: np.ndarray) -> None:
    chain = SensorChain({"zero": {1: 0.2}, "drift": {1: 0.1}, "creep": {2: 0.5}, "creep_time": {2: 0.1}})
    out, _, _ = readings(chain, swing)
    np.testing.assert_allclose(out[:, 0] - swing[:, 0], 0.2 + 0.1e-3 * np.arange(2000), atol=1e-12)
    assert (out - swing)[-1, 1] == pytest.approx(0.5, abs=1e-6)


def test_held_packets_repeat_bit_for_bit(swing: np.ndarray) -> None:
    chain = SensorChain(held={"every_s": 0.2, "length_s": 0.03, "what": "packet"})
    out, _, positions = readings(chain, swing, noise=0.1)
    same = (np.diff(out, axis=0) == 0.0).all(axis=1) & (np.diff(positions, axis=0) == 0.0).all(axis=1)
    assert 0.05 < same.mean() < 0.3


def test_small_currents_vanish(swing: np.ndarray) -> None:
    _, late, _ = readings(SensorChain({"motor_dead": {7: 2.0}}), swing)
    assert (np.abs(late[:, 6])[late[:, 6] != 0.0] >= 2.0).all()
    assert (late[:, 6] == 0.0).any()


def test_unknown_faults_and_too_much_lateness_are_refused() -> None:
    with pytest.raises(KeyError, match="does not exist"):
        SensorChain({"colour": {1: 1.0}})
    with pytest.raises(ValueError, match="late"):
        SensorChain({"late": {1: 0.2}})
