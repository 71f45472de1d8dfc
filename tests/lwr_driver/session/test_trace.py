from __future__ import annotations

import hashlib

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from fri.errors import DataError
from lwr_driver.session import SessionWriter, read_session
from lwr_driver.session.trace import import_trace, read_trace
from tests.lwr_driver.session.motions import excitation, loads
from tests.lwr_driver.session.session_samples import EPOCH, JOINTS, METADATA

OFFSET, RATE = 812.4375, 1.5e-5
HEADER = ["time_s", *(f"tau_m_{name}" for name in JOINTS), *(f"q_{name}" for name in JOINTS)]


@pytest.fixture
def session_path(tmp_path):
    """A session at 500 Hz whose packets are read late now and then."""
    path = tmp_path / "unloaded.mcap"
    time = np.arange(0.0, 23.0, 0.002)
    rng = np.random.default_rng(2)
    late = rng.exponential(3e-5, size=len(time)) + (rng.random(len(time)) < 0.02) * 1.5e-3
    nanoseconds = np.rint(time * 1e9).astype(np.int64)
    position = excitation(time)
    with SessionWriter(path, JOINTS, METADATA, attachments={"plan.npz": b"12"}) as writer:
        writer.write_joint_states(
            EPOCH + nanoseconds + np.rint(late * 1e9).astype(np.int64),
            position,
            loads(position),
            publish_time=nanoseconds + 7_000_000_000,
            sequence=3500 + np.arange(len(time)),
        )
        writer.write_phase(EPOCH + 4 * 10**9, "excitation")
    return path


def trace_file(path, *, change=None, header=HEADER, span=(-1.0, 24.0), comment=""):
    """A trace at 1 kHz; returns true times, clock and torques as they stand in the file."""
    time = np.arange(*span, 0.001)
    position = excitation(time)
    torque = loads(position) + 4.0 * np.tanh(200 * np.gradient(position, 0.001, axis=0))
    values = np.concatenate([(OFFSET + time * (1 + RATE))[:, None], torque, position], axis=1)
    if change is not None:
        values = change(values)
    np.savetxt(path, values, fmt="%.9f", delimiter=",", header=comment + ",".join(header), comments="")
    written = np.loadtxt(path, delimiter=",", skiprows=1 + comment.count("\n"))
    return time, written


def test_motor_torques_get_their_log_times(tmp_path, session_path):
    trace = tmp_path / "trace.csv"
    time, values = trace_file(trace)
    before = read_session(session_path)
    result = import_trace(session_path, trace, tmp_path / "with_motor.mcap")
    session = read_session(tmp_path / "with_motor.mcap")
    inside = (time > 0.001) & (time < 22.99)
    found = np.isin(time, time[session.motor.sequence])
    assert found[inside].all()
    truth = EPOCH + np.rint(time[session.motor.sequence] * 1e9)
    # packets are read 30 us late on average, which log times share
    error = (session.motor.log_time - truth) * 1e-9
    assert np.abs(error - 3e-5).max() < 3e-5
    np.testing.assert_array_equal(session.motor.effort, values[session.motor.sequence, 1:8])
    clock = np.rint(values[session.motor.sequence, 0] * 1e9).astype(np.int64)
    np.testing.assert_array_equal(session.motor.publish_time, clock)
    assert session.motor.position.shape[1] == 0
    np.testing.assert_array_equal(session.joint.position, before.joint.position)
    np.testing.assert_array_equal(session.joint.log_time, before.joint.log_time)
    assert session.phases == before.phases
    assert session.attachments == before.attachments
    assert session.end == before.end
    assert not session.missing
    assert result.samples == len(session.motor)
    assert result.outside == len(time) - result.samples
    assert read_session(session_path).motor is None


def test_provenance_is_in_the_metadata(tmp_path, session_path):
    trace = tmp_path / "trace.csv"
    trace_file(trace)
    import_trace(session_path, trace)
    metadata = read_session(session_path).metadata
    assert metadata["uid"] == METADATA["uid"]
    assert metadata["motor_torque_source"] == "trace_file"
    assert metadata["trace_file"] == "trace.csv"
    assert metadata["trace_sha256"] == hashlib.sha256(trace.read_bytes()).hexdigest()
    middle = float(metadata["trace_middle_s"])
    delay = (middle - OFFSET) / (1 + RATE) - middle
    assert float(metadata["trace_delay_s"]) == pytest.approx(delay, abs=5e-6)
    assert 0 < float(metadata["trace_delay_std_s"]) < 1e-5
    assert float(metadata["trace_rate_error"]) == pytest.approx(-RATE, abs=1e-7)


def test_result_is_read_elsewhere_in_order_of_time(tmp_path, session_path):
    trace_file(tmp_path / "trace.csv")
    import_trace(session_path, tmp_path / "trace.csv")
    last, count = 0, 0
    with open(session_path, "rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for _, channel, message, ros in reader.iter_decoded_messages(log_time_order=False):
            assert message.log_time >= last
            last = message.log_time
            if channel.topic == "/motor_states":
                count += 1
                assert tuple(ros.name) == JOINTS
                assert len(ros.effort) == 7
    assert count == len(read_session(session_path).motor)


def test_import_replaces_the_session_in_one_step(tmp_path, session_path):
    trace_file(tmp_path / "trace.csv")
    import_trace(session_path, tmp_path / "trace.csv")
    assert sorted(item.name for item in tmp_path.iterdir()) == ["trace.csv", "unloaded.mcap"]
    with pytest.raises(DataError, match=r"has /motor_states already \(trace_file\)"):
        import_trace(session_path, tmp_path / "trace.csv")


def test_failed_import_leaves_the_session_as_it_was(tmp_path, session_path):
    content = session_path.read_bytes()

    def exchange(values):
        values[:, [8, 9]] = values[:, [9, 8]]
        return values

    trace_file(tmp_path / "trace.csv", change=exchange)
    with pytest.raises(DataError, match="A1 of it follows A2"):
        import_trace(session_path, tmp_path / "trace.csv")
    assert session_path.read_bytes() == content
    assert sorted(item.name for item in tmp_path.iterdir()) == ["trace.csv", "unloaded.mcap"]


def test_torque_columns_of_other_joints_are_refused(tmp_path, session_path):
    def exchange(values):
        values[:, [2, 4]] = values[:, [4, 2]]
        return values

    trace_file(tmp_path / "trace.csv", change=exchange)
    with pytest.raises(DataError, match="motor torque of A3 follows the torque sensor of A2"):
        import_trace(session_path, tmp_path / "trace.csv")


def test_crashed_session_must_be_recovered_first(tmp_path, session_path):
    trace_file(tmp_path / "trace.csv")
    session_path.write_bytes(session_path.read_bytes()[:-2000])
    with pytest.raises(DataError, match="make it whole with `lwr-run recover` first"):
        import_trace(session_path, tmp_path / "trace.csv")


def test_report_in_words(tmp_path, session_path):
    trace_file(tmp_path / "trace.csv", change=lambda values: values * [1, *[1] * 3, 100, *[1] * 3, *[1] * 7])
    text = str(import_trace(session_path, tmp_path / "trace.csv"))
    assert "trace.csv aligned: delay -812.4" in text
    assert "µs, clock rate error -15.0" in text
    assert "motor torque of A3 is" in text


def test_columns_in_any_order_and_comments(tmp_path):
    path = tmp_path / "trace.csv"
    order = np.random.default_rng(0).permutation(15)
    _, values = trace_file(
        path,
        change=lambda v: v[:, order],
        header=[HEADER[i] for i in order],
        span=(0, 0.01),
        comment="# scope\n",
    )
    trace = read_trace(path, JOINTS)
    np.testing.assert_array_equal(trace.time, values[:, list(order).index(0)])
    np.testing.assert_array_equal(trace.position[:, 2], values[:, list(order).index(HEADER.index("q_E1"))])
    np.testing.assert_array_equal(trace.torque[:, 6], values[:, list(order).index(HEADER.index("tau_m_A6"))])


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda text: "", "is empty"),
        (lambda text: text.replace("q_A6", "q_A7"), "column `q_A6` is missing"),
        (
            lambda text: text.replace("\n", ",1\n").replace("q_A6,1", "q_A6,gripper"),
            "column `gripper` is unknown",
        ),
        (lambda text: text.replace("q_A6", "q_A5"), "column `q_A5` is there twice"),
        (lambda text: text + "1,2,3\n", "cannot be read"),
        (lambda text: text + "abc" + ",1" * 14 + "\n", "cannot be read"),
        (lambda text: text + "nan" + ",1" * 14 + "\n", "`time_s` of sample 10 is nan"),
        (
            lambda text: text + "1.0" + ",1" * 14 + "\n",
            r"time runs from 812\.\d+ s to 1\.000000 s at sample 10",
        ),
        (lambda text: text.split("\n")[0] + "\n", "cannot be read"),
    ],
)
def test_trace_files_that_are_no_traces(tmp_path, edit, message):
    path = tmp_path / "trace.csv"
    trace_file(path, span=(0, 0.0095))
    path.write_text(edit(path.read_text()))
    with pytest.raises(DataError, match=rf"trace\.csv: .*{message}"):
        read_trace(path, JOINTS)


def test_trace_that_is_not_there(tmp_path):
    with pytest.raises(DataError, match="cannot be read"):
        read_trace(tmp_path / "trace.csv", JOINTS)
