from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lwr_driver.session import read_session
from lwr_driver.session.motor_torque import KrlMotorTorque
from lwr_driver.session.recording import Recording, SessionRequest, utc_offset_ns
from tests.lwr_driver.session.session_samples import EPOCH, JOINTS, METADATA, URDF, rows

COUNT = 1300
PHASES = ("hold", "brake", "settle", "excitation")


def record(path: Path, data, cuts=(), **options):
    request = SessionRequest(
        path,
        JOINTS,
        METADATA,
        **{"virtual_epoch_ns": EPOCH, "phase_names": PHASES, "motor_torque": KrlMotorTorque(), **options},
    )
    recording = Recording(request, utc_offset=EPOCH)
    for first, stop in itertools.pairwise([0, *cuts, len(data)]):
        recording.write(data[first:stop])
    return recording.close("success", "")


def test_every_cycle_is_in_the_log(tmp_path):
    data = rows(COUNT)
    recorded = record(tmp_path / "a.mcap", data, robot_description=URDF)
    session = read_session(tmp_path / "a.mcap")
    assert recorded.samples == COUNT
    assert recorded.error == ""
    np.testing.assert_array_equal(session.joint.position, data["msr"]["msr_jnt_pos"])
    np.testing.assert_array_equal(session.joint.effort, data["msr"]["msr_jnt_trq"])
    np.testing.assert_array_equal(session.joint.sequence, data["sequence"])
    np.testing.assert_array_equal(session.joint.publish_time, data["sequence"] * 1_000_000)
    np.testing.assert_array_equal(session.status.sequence, data["sequence"])
    np.testing.assert_array_equal(session.status.sample_time, 0.001)
    np.testing.assert_array_equal(session.status.power, 0x7F)
    assert session.robot_description == URDF
    assert not session.missing.samples.get("/joint_states")


def test_only_answers_that_were_sent_are_commands(tmp_path):
    data = rows(COUNT)
    record(tmp_path / "a.mcap", data)
    command = read_session(tmp_path / "a.mcap").command
    sent = data["answered"] == 1
    np.testing.assert_array_equal(command.position, data["cmd"]["jnt_pos"][sent])
    np.testing.assert_array_equal(command.sequence, data["sequence"][sent])


def test_lock_step_counts_packets_from_the_epoch(tmp_path):
    data = rows(COUNT)
    record(tmp_path / "a.mcap", data)
    np.testing.assert_array_equal(
        read_session(tmp_path / "a.mcap").joint.log_time, EPOCH + data["sequence"] * 1_000_000
    )


def test_host_time_is_the_receive_time_in_utc(tmp_path):
    data = rows(COUNT)
    record(tmp_path / "a.mcap", data, virtual_epoch_ns=None)
    np.testing.assert_array_equal(read_session(tmp_path / "a.mcap").joint.log_time, EPOCH + data["t_recv"])


def test_packets_of_one_instant_get_times_that_rise(tmp_path):
    data = rows(6)
    data["t_recv"] = [10, 20, 20, 20, 15, 40]
    record(tmp_path / "a.mcap", data, cuts=(2, 5), virtual_epoch_ns=None)
    assert (read_session(tmp_path / "a.mcap").joint.log_time - EPOCH).tolist() == [10, 20, 21, 22, 23, 40]


@settings(max_examples=15, deadline=None)
@given(cuts=st.lists(st.integers(1, COUNT - 1), max_size=12, unique=True).map(sorted))
def test_equal_rows_give_equal_bytes(tmp_path_factory, cuts):
    folder = tmp_path_factory.mktemp("cuts")
    data = rows(COUNT)
    record(folder / "one", data, robot_description=URDF)
    record(folder / "other", data, cuts=cuts, robot_description=URDF)
    assert (folder / "one").read_bytes() == (folder / "other").read_bytes()


def test_phases_are_written_when_they_change(tmp_path):
    record(tmp_path / "a.mcap", rows(COUNT), cuts=(100, 200, 201, 650))
    phases = read_session(tmp_path / "a.mcap").phases
    begins = [(phase.log_time - EPOCH) // 1_000_000 - 100 for phase in phases]
    assert list(zip(begins, [phase.name for phase in phases], strict=True)) == [
        (30, "settle"),
        (200, "excitation"),
        (700, "monitor"),
    ]


def test_phases_can_be_named_later(tmp_path):
    data = rows(20)
    request = SessionRequest(
        tmp_path / "a.mcap", JOINTS, METADATA, phase_names=PHASES, virtual_epoch_ns=EPOCH
    )
    recording = Recording(request, 0)
    assert recording.add_phases(("period 1", "period 2")) == 4
    data["phase"] = 5
    data["phase"][10:] = 9
    recording.write(data)
    recording.close("success", "")
    assert [phase.name for phase in read_session(tmp_path / "a.mcap").phases] == ["period 2", "phase 9"]


@pytest.mark.parametrize(("sample_time", "step"), [(0.001, 20), (0.005, 4), (0.012, None), (0.1, 1)])
def test_slow_channels_come_at_fifty_hertz(tmp_path, sample_time, step):
    data = rows(400)
    data["msr"]["msr_sample_time"] = sample_time
    record(tmp_path / "a.mcap", data, robot_description=URDF)
    session = read_session(tmp_path / "a.mcap")
    times = session.controller_model.publish_time
    gravity = session.controller_model.gravity
    np.testing.assert_array_equal(gravity, np.tile(np.arange(7.0), (len(times), 1)))
    if step is not None:
        np.testing.assert_array_equal(np.diff(times), step * round(sample_time * 1e9))
    assert np.unique(times // 20_000_000).size == len(times)


def test_lost_packets_and_repeated_ones_are_counted(tmp_path):
    data = np.delete(rows(1000), [10, 11, 12, 500])
    data["sequence"][600] = data["sequence"][599]
    data["sequence"][700] = data["sequence"][200]
    recorded = record(tmp_path / "a.mcap", data, cuts=(11, 600, 601, 700, 701))
    session = read_session(tmp_path / "a.mcap")
    assert recorded.rejected == 2
    assert recorded.missed == session.joint.lost == 6
    assert recorded.samples == len(session.joint) == 994
    assert session.end["rejected"] == "2"


def test_fresh_motor_torques_only(tmp_path):
    data = rows(COUNT)
    recorded = record(
        tmp_path / "a.mcap", data, motor_torque=KrlMotorTorque(scale=(0.5,) * 7, sign=(1, -1, 1, 1, 1, 1, -1))
    )
    motor = read_session(tmp_path / "a.mcap").motor
    fresh = np.arange(12, COUNT, 12)
    sign = np.array([1, -1, 1, 1, 1, 1, -1])
    np.testing.assert_array_equal(motor.effort, data["msr"]["msr_jnt_trq"][fresh] * sign)
    np.testing.assert_array_equal(motor.sequence, fresh // 12)
    np.testing.assert_array_equal(motor.log_time, EPOCH + data["sequence"][fresh] * 1_000_000)
    assert recorded.motor_samples == len(fresh)


def test_session_without_motor_torques(tmp_path):
    record(tmp_path / "a.mcap", rows(100), motor_torque=None)
    assert read_session(tmp_path / "a.mcap").motor is None


def test_clock_offset_is_that_of_the_two_clocks():
    import time

    offset = utc_offset_ns()
    assert abs(time.time_ns() - time.monotonic_ns() - offset) < 10**9


def test_one_motor_torque_that_is_not_finite_costs_its_own_sample_alone(tmp_path):
    data = rows(COUNT)
    whole = record(tmp_path / "whole.mcap", data)
    counter = data["msr"]["krl_int"][:, 0]
    fresh = np.flatnonzero(np.diff(counter))[5] + 1
    data["msr"]["krl_real"][counter == counter[fresh], 2] = np.nan
    recorded = record(tmp_path / "a.mcap", data)
    session = read_session(tmp_path / "a.mcap")
    assert len(session.motor) == recorded.motor_samples == whole.motor_samples - 1
    assert recorded.motor_rejected == 1
    assert session.end["motor_rejected"] == "1"


def test_restarts_of_the_controller_are_in_the_closing_record(tmp_path):
    recording = Recording(SessionRequest(tmp_path / "a.mcap", JOINTS, METADATA), utc_offset=EPOCH)
    recording.write(rows(10))
    recording.close("success", "", restarts=2)
    assert read_session(tmp_path / "a.mcap").end["restarts"] == "2"
