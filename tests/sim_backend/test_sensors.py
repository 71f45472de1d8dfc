"""Sensors, controller and the ways of the motor torque out of the controller."""

import csv

import numpy as np
import pytest
from scipy.signal import butter, filtfilt

from fri.errors import ConfigurationError
from lwr_driver.configuration import CONFIGS
from sim_backend.cabinet import Cabinet
from sim_backend.configuration import (
    KrlRealsConfig,
    SensorConfig,
    TraceConfig,
    load_configuration,
)
from sim_backend.controller import ControllerModel
from sim_backend.robot import chain
from sim_backend.sensors import ControllerTrace, KrlReals, Sensors
from tests.sim_backend import arms

NAMES = ("A1", "A2", "E1", "A3", "A4", "A5", "A6")
FLOOR = np.array([0.05, 0.05, 0.03, 0.03, 0.03, 0.011, 0.011])


def sensors(seed=1, **changes):
    return Sensors(SensorConfig(**changes), 7, np.random.SeedSequence(seed))


def rows(device, arm, count):
    values = {"position": [], "joint_torque": [], "motor_torque": []}
    for _ in range(count):
        device.read(arm)
        device.read_motor(arm.motor_torque, arm.motor_torque)
        for name, column in values.items():
            column.append(getattr(device.reading, name).copy())
    return {name: np.array(column) for name, column in values.items()}


def test_joint_torque_noise_has_the_measured_floor_after_an_8_hz_filter():
    noise = rows(sensors(), arms.lwr(), 20_000)["joint_torque"]
    filtered = filtfilt(*butter(4, 8.0, fs=1000.0), noise - noise.mean(axis=0), axis=0)
    assert np.allclose(filtered.std(axis=0), FLOOR, rtol=0.15)


def test_positions_are_multiples_of_the_resolution_and_quiet_at_rest():
    arm = arms.lwr()
    arm.reset(np.linspace(-1.0, 1.0, 7))
    found = rows(sensors(), arm, 50)["position"]
    assert np.ptp(found, axis=0).max() == 0.0
    assert np.allclose(np.rint(found / 6e-6) * 6e-6, found, atol=1e-15)
    assert np.abs(found[0] - arm.position).max() <= 3e-6


def test_position_sensor_on_the_motor_side_sees_the_torsion():
    arm = arms.lwr("paper_load")
    arm.reset(np.array([0.0, 1.2, 0.0, -0.5, 0.0, 0.3, 0.0]))
    link, motor = (rows(sensors(position_sensor=side), arm, 1)["position"][0] for side in ("link", "motor"))
    assert np.allclose(motor - link, arm.joint_torque / arm.drive.stiffness, atol=1e-5)
    assert abs(motor[1] - link[1]) > 2e-3


def test_streams_are_independent_and_repeat_with_the_seed():
    arm = arms.lwr()
    first, again = rows(sensors(3), arm, 3000), rows(sensors(3), arm, 3000)
    other = rows(sensors(4), arm, 3000)
    quiet = rows(sensors(3, motor_torque_noise=(0.0,) * 7), arm, 3000)
    assert np.array_equal(first["joint_torque"], again["joint_torque"])
    assert np.array_equal(first["joint_torque"], quiet["joint_torque"])
    assert not np.array_equal(first["joint_torque"], other["joint_torque"])
    mixed = np.corrcoef(np.hstack([first["joint_torque"], first["motor_torque"]]).T) - np.eye(14)
    assert np.abs(mixed).max() < 0.08


def test_joint_torque_offset_is_added():
    arm = arms.lwr()
    offset = (1.0, -2.0, 3.0, 0.0, 0.5, -0.5, 0.25)
    change = (
        rows(sensors(joint_torque_offset=offset), arm, 1)["joint_torque"]
        - rows(sensors(), arm, 1)["joint_torque"]
    )
    assert np.allclose(change, offset, atol=0.021)


def test_motor_torque_belongs_to_the_instant_between_two_milliseconds():
    device = sensors(motor_torque_noise=(0.0,) * 7, motor_torque_resolution=(0.0,) * 7)
    device.read(arms.lwr())
    device.read_motor(np.full(7, 2.0), np.full(7, 5.0))
    assert np.allclose(device.reading.motor_torque, 3.5)


def test_krl_reals_hold_between_ticks_and_count_them():
    channel = KrlReals(KrlRealsConfig(tick_ms=12, reals=(2, 3, 4, 5, 6, 7, 8), counter_int=5), 7)
    real, integer = np.zeros(16, np.float32), np.zeros(16, np.int32)
    history = []
    for ms in range(1, 61):
        channel.millisecond(np.full(7, float(ms)), real, integer)
        history.append((int(integer[4]), float(real[1]), float(real[7])))
    assert history[10] == (0, 0.0, 0.0)
    assert history[11] == (1, 12.0, 12.0)
    assert history[22] == (1, 12.0, 12.0)
    assert history[59] == (5, 60.0, 60.0)
    assert real[0] == 0.0
    assert set(np.flatnonzero(integer)) == {4}


def test_krl_reals_can_be_late():
    channel = KrlReals(KrlRealsConfig(tick_ms=10, delay_ms=7), 7)
    real, integer = np.zeros(16, np.float32), np.zeros(16, np.int32)
    for ms in range(1, 31):
        channel.millisecond(np.full(7, float(ms)), real, integer)
    assert real[0] == 30.0 - 7.0


def test_trace_file_has_its_own_clock_and_both_signals(tmp_path):
    trace = ControllerTrace(TraceConfig(clock_offset=100.0, clock_rate_error=1e-3, delay_ms=2), NAMES)
    trace.start()
    for ms in range(500):
        trace.millisecond(ms * 1e-3, np.arange(7) + ms, 1e-3 * ms + np.arange(7))
    path = tmp_path / "trace.csv"
    assert trace.save(path) == 500
    while trace.saving():
        pass
    with path.open() as file:
        header = next(csv.reader(file))
    assert header == ["time_s", *(f"tau_m_{n}" for n in NAMES), *(f"q_{n}" for n in NAMES)]
    table = np.loadtxt(path, delimiter=",", skiprows=1)
    assert table.shape == (500, 15)
    assert np.allclose(table[:, 0], 100.0 + np.arange(500) * 1e-3 * 1.001, atol=1e-6)
    assert np.allclose(table[2:, 1], np.arange(498))
    assert np.allclose(table[:, 9], 1e-3 * np.arange(500) + 1.0, atol=1e-8)
    assert not list(tmp_path.glob("*.part"))


def test_trace_keeps_the_newest_samples():
    trace = ControllerTrace(TraceConfig(clock_offset=0.0, clock_rate_error=0.0, longest_s=70.0), NAMES)
    trace.start()
    for ms in range(190_000):
        trace.millisecond(ms * 1e-3, np.zeros(7), np.zeros(7))
    samples = trace.samples()
    assert len(samples) == 70_000
    assert samples[-1, 0] == pytest.approx(189.999)


def quintic(seconds):
    s = np.linspace(0.0, 1.0, round(seconds * 1e3) + 1)
    return s**3 * (10 - 15 * s + 6 * s**2)


def test_controller_tracks_within_a_few_milliradians():
    cabinet = Cabinet(load_configuration())
    start = np.array(cabinet.config.robot.start_position)
    move = np.array([0.8, -0.5, 0.8, 0.6, -0.9, 0.7, 1.2])
    worst = np.zeros(7)
    for share in quintic(1.5):
        setpoint = start + move * share
        cabinet._millisecond(setpoint)
        worst = np.maximum(worst, np.abs(cabinet.reading.position - setpoint))
    assert worst.max() < 8e-3
    for _ in range(1000):
        cabinet._millisecond(start + move)
    rest = np.abs(cabinet.reading.position - start - move)
    assert rest.max() < 3e-3
    assert np.abs(cabinet.plant.velocity).max() < 1e-3


def test_wrong_load_data_makes_the_arm_sag_and_right_data_lifts_it():
    load = {"mass": 3.34, "com": [0.0, -0.0659, 0.1437]}
    sag = []
    for controller in ({"mass": 0.0}, load):
        settings = {"robot.payload": "paper_load", "controller.load": controller, "controller.settle_s": 2.0}
        cabinet = Cabinet(load_configuration(overrides=settings))
        sag.append(np.abs(cabinet.reading.position - cabinet.config.robot.start_position).max())
    assert sag[0] > 2.0 * sag[1]


def test_estimated_external_torque_is_what_the_controller_does_not_know_of():
    settings = {"robot.payload": "paper_load"}
    cabinet = Cabinet(load_configuration(overrides=settings))
    for _ in range(1000):
        cabinet.close()
    gravity = cabinet.model.update_gravity(cabinet.reading.position)
    expected = cabinet.plant.joint_torque - gravity
    assert np.allclose(cabinet.model.external_torque, expected, atol=0.5)
    assert abs(expected[1]) > 5.0


def test_jacobian_rows_end_with_z_y_x_rotations_and_pose_is_row_major():
    config = load_configuration()
    model = ControllerModel(chain(config.beside("lwr4plus.urdf")), config.controller.load, 10.0)
    model.update_model(np.zeros(7))
    # Stretched upright: axes 1, 3, 5, 7 turn about z, which is row 3; 2, 4, 6 about y or -y, row 4; none
    # about x.
    assert np.allclose(np.abs(model.jacobian[3]), [1, 0, 1, 0, 1, 0, 1], atol=1e-12)
    assert np.allclose(np.abs(model.jacobian[4]), [0, 1, 0, 1, 0, 1, 0], atol=1e-12)
    assert np.allclose(model.jacobian[5], 0.0, atol=1e-12)
    pose = np.zeros(12)
    model.flange(np.zeros(7), pose)
    assert pose[[3, 7, 11]] == pytest.approx([0.0, 0.0, 0.3105 + 0.4 + 0.39 + 0.078])


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("fri.period_ms", 0, "period_ms"),
        ("robot.payload", "piano", "piano"),
        ("robot.stifness", [1.0], "stiffness"),
        ("krl_reals.reals", [1, 1, 2, 3, 4, 5, 6], "twice"),
        ("krl_reals.counter_int", 17, "outside 1 to 16"),
        ("sensors.joint_torque_noise", [-1, 0, 0, 0, 0, 0, 0], r"-1.0 Nm is outside 0 to"),
        ("robot.effects", [{"type": "nowhere"}], "package.module:Class"),
        ("robot.effects", [{"type": "nowhere.at:All"}], "cannot be imported"),
        ("seed", -1, "-1 is outside 0 to"),
    ],
)
def test_wrong_configurations_say_what_is_wrong(key, value, message):
    with pytest.raises(ConfigurationError, match=message):
        Cabinet(load_configuration(overrides={key: value}))


@pytest.mark.parametrize("name", ["default", "cold_start", "poor_link", "late_motor_torque", "emergency"])
def test_shipped_configurations_load(name):
    config = load_configuration(f"emulator/{name}.yaml")
    assert config.robot.parameters.endswith("table2.yaml")


@pytest.mark.parametrize("name", ["default", "poor_link"])
def test_a_base_in_another_folder_finds_its_files(name, tmp_path):
    own = tmp_path / "own.yaml"
    own.write_text(f"base: emulator/{name}.yaml\nseed: 7\n")
    config = load_configuration(own)
    assert config.seed == 7
    assert config.beside(config.robot.parameters) == CONFIGS / "emulator/table2.yaml"
    assert config.beside(config.limits) == CONFIGS / "lwr4plus.yaml"


def test_a_base_names_files_beside_itself(tmp_path):
    (tmp_path / "cell").mkdir()
    for name in ("arm.urdf", "truth.yaml", "limits.yaml", "cell.src"):
        (tmp_path / "cell" / name).touch()
    (tmp_path / "cell/base.yaml").write_text(
        "robot: {urdf: arm.urdf, parameters: truth.yaml}\nlimits: limits.yaml\nfri: {program: cell.src}\n"
    )
    (tmp_path / "own.yaml").write_text("base: cell/base.yaml\nrobot: {payload: none}\n")
    config = load_configuration(tmp_path / "own.yaml")
    named = (config.robot.urdf, config.robot.parameters, config.limits, config.fri.program)
    assert named == tuple(
        str(tmp_path / "cell" / n) for n in ("arm.urdf", "truth.yaml", "limits.yaml", "cell.src")
    )
