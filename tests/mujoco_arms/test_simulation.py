"""The arm in MuJoCo against the equations of motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio
import pytest

pytest.importorskip("mujoco", reason="needs the extra `generator`")

from benchmarks.mujoco_arms.cases import draw
from benchmarks.mujoco_arms.friction import DRIVE, ELEMENTS, drive_torques
from benchmarks.mujoco_arms.simulation import RECORD_S, Plant, simulate
from fri.errors import ConfigurationError
from tests.mujoco_arms.motions import shortened


def bare(plant: Plant) -> Plant:
    """Without hoses and friction of the joints' bearings."""
    drive = plant.drive.copy()
    drive["bearing"] = 0.0
    return replace(plant, drive=drive, body=replace(plant.body, hoses=()))


@pytest.mark.parametrize("arm", ["lwr4plus", "ur5"])
def test_joint_torques_are_those_of_the_newton_euler_equations(arm: str) -> None:
    try:
        case = shortened(draw(11, "healthy", arm=arm), 6.0)
    except ConfigurationError as missing:
        pytest.skip(str(missing))
    setup = case.healthy[1]
    plant = bare(setup.plant)
    truth = simulate(plant, setup.q, setup.qd)
    model = pinocchio.buildModelFromXML(case.arm.kind.urdf)
    load = plant.body.payload
    turned = load.mass * np.diag(np.square(load.gyration))
    model.inertias[model.njoints - 1] += pinocchio.Inertia(load.mass, np.array(load.centre), turned)
    data = model.createData()
    speed = np.gradient(truth.link, RECORD_S, axis=0)
    rates = np.diff(truth.link, 2, axis=0) / RECORD_S**2
    error = [
        pinocchio.rnea(model, data, truth.link[k], speed[k], rates[k - 1]) - truth.joint[k]
        for k in range(100, len(truth) - 100, 50)
    ]
    assert np.abs(error).max() < 0.03
    assert np.abs(truth.joint).max() > 20.0


def test_drives_only_take_energy(lwr, bench) -> None:
    setup, truth = lwr.healthy[0], bench.healthy[0]
    speed = np.gradient(truth.motor, RECORD_S, axis=0)
    rotor = lwr.arm.inertia * np.gradient(speed, RECORD_S, axis=0)
    friction = truth.drive - truth.joint - rotor
    power = (friction * speed)[200:-200].mean(axis=0)
    expected = (setup.plant.drive["coulomb"] * np.abs(speed) + setup.plant.drive["viscous"] * speed**2)[
        200:-200
    ]
    assert power == pytest.approx(expected.mean(axis=0), rel=0.2)


def one_drive(**values: float) -> np.ndarray:
    drive = np.zeros(1, dtype=DRIVE)
    plain = {
        "coulomb": 10.0,
        "viscous": 5.0,
        "presliding": 3e-4,
        "speed": 1.0,
        "stribeck_speed": 0.05,
        "cooling": 1e3,
    }
    for name, value in {**plain, **values}.items():
        drive[name] = value
    return drive


def moved(drive: np.ndarray, speeds: np.ndarray, dt: float = 1e-4) -> np.ndarray:
    """Friction torque along speeds [rad/s]."""
    angle, out = np.zeros(1), np.empty(len(speeds))
    state = [np.zeros((1, ELEMENTS)), np.zeros((1, ELEMENTS)), np.zeros(1), np.zeros(1), np.zeros(1)]
    f, g, s, none = np.zeros(1), np.zeros(1), np.zeros(1), np.zeros(1)
    for k, speed in enumerate(speeds):
        om = np.array([speed])
        drive_torques(drive, angle, om, angle, om, none, *state, dt, f, g, s)
        angle = angle + om * dt
        out[k] = f[0]
    return out


def test_sliding_friction_is_coulomb_and_viscous() -> None:
    for speed in (0.2, -0.6):
        force = moved(one_drive(), np.full(5000, speed))[-1]
        assert force == pytest.approx(10.0 * np.sign(speed) + 5.0 * speed, rel=1e-3)


def test_friction_falls_with_speed_where_there_is_a_stribeck_effect() -> None:
    slow, fast = (moved(one_drive(stribeck=0.5, viscous=0.0), np.full(40000, v))[-1] for v in (0.005, 0.5))
    assert slow == pytest.approx(15.0, rel=0.02)
    assert fast == pytest.approx(10.0, rel=0.02)


def test_small_motion_turns_the_friction_gradually_and_loses_energy() -> None:
    time = np.arange(20000) * 1e-4
    amplitude = 1e-4
    speed = amplitude * 2.0 * np.pi * np.cos(2.0 * np.pi * time)
    force = moved(one_drive(viscous=0.0), speed)
    loop = slice(10000, 20000)
    assert np.abs(force[loop]).max() < 10.0
    assert np.sum(force[loop] * speed[loop]) * 1e-4 > 1e-5
