from __future__ import annotations

import errno
import itertools
import os
import stat

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from mcap_ros2.decoder import DecoderFactory

from fri.errors import ConfigurationError, DataError
from lwr_driver.session import LinkFrames, SessionWriter, read_session
from tests.lwr_driver.session.session_samples import EPOCH, JOINTS, METADATA, URDF, signals, write_session


def decoded(path):
    with open(path, "rb") as file:
        official = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        yield from official.iter_decoded_messages(log_time_order=False)


def test_everything_written_is_found_by_the_official_reader(tmp_path):
    path = tmp_path / "a.mcap"
    log_time, position, torque = write_session(
        path, 1200, robot_description=URDF, attachments={"experiment.yaml": b"name: x\n"}
    )
    found: dict[str, list] = {}
    last = 0
    for schema, channel, message, ros in decoded(path):
        assert channel.message_encoding == "cdr"
        assert schema.encoding == "ros2msg"
        assert message.log_time >= last
        last = message.log_time
        if hasattr(ros, "header"):
            assert ros.header.stamp.sec * 10**9 + ros.header.stamp.nanosec == message.log_time
        found.setdefault(channel.topic, []).append((message, ros))
    states = found["/joint_states"]
    assert [item.log_time for item, _ in states] == log_time.tolist()
    assert [item.sequence for item, _ in states] == list(range(50, 1250))
    assert [item.publish_time for item, _ in states] == [number * 1_000_000 for number in range(50, 1250)]
    assert all(tuple(ros.name) == JOINTS and list(ros.velocity) == [] for _, ros in states)
    np.testing.assert_array_equal([ros.position for _, ros in states], position)
    np.testing.assert_array_equal([ros.effort for _, ros in states], torque)
    np.testing.assert_array_equal([ros.position for _, ros in found["/joint_command"]], position + 0.5)
    np.testing.assert_array_equal([ros.effort for _, ros in found["/motor_states"]], torque[::4] * 1.5)
    assert [ros.data for _, ros in found["/experiment/phase"]] == ["settle", "period 1", "period 2"]
    assert [ros.data for _, ros in found["/robot_description"]] == [URDF]


def test_order_in_the_file_survives_a_crash(tmp_path):
    path = tmp_path / "a.mcap"
    write_session(path, 600, attachments={"plan.npz": b"\x00\x01", "experiment.yaml": b"a: 1"})
    kinds = [item for item in records(path) if item[0] in ("Metadata", "Attachment", "Message")]
    assert kinds[0] == ("Metadata", "session")
    assert kinds[1:3] == [("Attachment", "plan.npz"), ("Attachment", "experiment.yaml")]
    assert kinds[-1] == ("Metadata", "session_end")
    assert {name for name, _ in kinds[3:-1]} == {"Message"}


def records(path):
    with open(path, "rb") as file:
        return [
            (type(item).__name__, getattr(item, "name", ""))
            for item in StreamReader(file, validate_crcs=True).records
        ]


def test_summary_is_that_of_the_content(tmp_path):
    path = tmp_path / "a.mcap"
    write_session(path, 1200, attachments={"plan.npz": b"1234"})
    with open(path, "rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        header = reader.get_header()
        attachments = [(item.name, item.data) for item in reader.iter_attachments()]
        metadata = {item.name: item.metadata for item in reader.iter_metadata()}
    assert header.profile == "ros2"
    assert attachments == [("plan.npz", b"1234")]
    assert metadata["session"] == METADATA
    assert metadata["session_end"] == {
        "exit_status": "success",
        "reason": "",
        "samples": "1200",
        "missed": "0",
    }
    statistics = summary.statistics
    assert statistics.message_count == 1200 * 2 + 300 + 3
    assert statistics.chunk_count == 3
    assert (statistics.message_start_time, statistics.message_end_time) == (EPOCH, EPOCH + 1199 * 10**6)
    for index in summary.chunk_indexes:
        assert index.compression == "zstd"
        assert index.message_start_time // 500_000_000 == index.message_end_time // 500_000_000


def test_link_frames_are_those_of_the_urdf(tmp_path):
    rng = np.random.default_rng(1)
    q = rng.uniform(-3, 3, size=(4, 2))
    frames = LinkFrames(URDF)
    assert frames.pairs == (("base", "one"), ("one", "two"), ("two", "tip"))
    poses = frames.poses(("A1", "A2"), q)
    model = pin.buildModelFromXML(URDF)
    data = model.createData()
    for row in range(4):
        pin.forwardKinematics(model, data, q[row])
        pin.updateFramePlacements(model, data)
        placed = pin.SE3.Identity()
        for link, pose in zip(("one", "two", "tip"), poses[row], strict=True):
            placed = placed * pin.XYZQUATToSE3(pose)
            np.testing.assert_allclose(
                placed.homogeneous, data.oMf[model.getFrameId(link)].homogeneous, atol=1e-12
            )


def test_tf_decodes_to_the_poses(tmp_path):
    path = tmp_path / "a.mcap"
    q = np.linspace(-1, 1, 20)[:, None] * [1.0, 2.0]
    times = EPOCH + np.arange(20) * 20_000_000
    with SessionWriter(path, ("A1", "A2"), METADATA, robot_description=URDF) as writer:
        writer.write_joint_states(times, q)
        writer.write_link_frames(times, q)
    poses = LinkFrames(URDF).poses(("A1", "A2"), q)
    messages = [ros for _, channel, _, ros in decoded(path) if channel.topic == "/tf"]
    assert len(messages) == 20
    for row, ros in enumerate(messages):
        assert [item.header.frame_id for item in ros.transforms] == ["base", "one", "two"]
        assert [item.child_frame_id for item in ros.transforms] == ["one", "two", "tip"]
        for item, pose in zip(ros.transforms, poses[row], strict=True):
            p, r = item.transform.translation, item.transform.rotation
            np.testing.assert_array_equal([p.x, p.y, p.z, r.x, r.y, r.z, r.w], pose)


def test_status_and_controller_model_decode(tmp_path):
    path = tmp_path / "a.mcap"
    rng = np.random.default_rng(4)
    times = EPOCH + np.arange(5) * 10**6
    status = {
        "state": np.full(5, 2), "quality": np.full(5, 3), "sequence": np.arange(5),
        "sample_time": np.full(5, 0.001), "answer_rate": np.ones(5), "latency": np.full(5, 2e-4),
        "jitter": np.full(5, 1e-5), "miss_rate": np.zeros(5), "miss_counter": np.arange(5) + 70_000,
        "power": np.full(5, 127), "control": np.ones(5), "error": np.full(5, 3),
        "warning": np.full(5, 65535), "temperature": rng.normal(size=(5, 7)),
    }  # fmt: skip
    model = {
        "mass_matrix": rng.normal(size=(5, 7, 7)), "gravity": rng.normal(size=(5, 7)),
        "jacobian": rng.normal(size=(5, 6, 7)), "estimated_external_torque": rng.normal(size=(5, 7)),
    }  # fmt: skip
    with SessionWriter(path, JOINTS, METADATA) as writer:
        writer.write_joint_states(times, signals(5)[0])
        writer.write_status(times, status)
        writer.write_controller_model(times, **model)
    by_topic: dict[str, list] = {}
    for _, channel, _, ros in decoded(path):
        by_topic.setdefault(channel.topic, []).append(ros)
    session = read_session(path)
    for name, values in status.items():
        wanted = np.asarray(values, dtype=np.float64 if name == "sample_time" else np.float32)
        np.testing.assert_array_equal([getattr(ros, name) for ros in by_topic["/fri/status"]], wanted)
        np.testing.assert_array_equal(getattr(session.status, name), wanted)
    for name, values in model.items():
        flat = values.astype(np.float32).reshape(5, -1)
        np.testing.assert_array_equal([getattr(ros, name) for ros in by_topic["/fri/controller_model"]], flat)
        np.testing.assert_array_equal(getattr(session.controller_model, name), flat.reshape(values.shape))


@settings(max_examples=25, deadline=None)
@given(
    joints=st.integers(1, 9),
    count=st.integers(1, 40),
    velocity=st.booleans(),
    steps=st.lists(st.integers(1, 400_000_000), min_size=40, max_size=40),
    seed=st.integers(0, 2**32 - 1),
)
def test_round_trip(tmp_path_factory, joints, count, velocity, steps, seed):
    rng = np.random.default_rng(seed)
    path = tmp_path_factory.mktemp("round") / "a.mcap"
    names = tuple(f"joint {index}" for index in range(joints))
    log_time = EPOCH + np.cumsum(steps[:count])
    sequence = np.cumsum(rng.integers(1, 4, size=count))
    arrays = rng.normal(size=(3, count, joints))
    with SessionWriter(path, names, METADATA) as writer:
        writer.write_joint_states(
            log_time, arrays[0], arrays[1], velocity=arrays[2] if velocity else None, sequence=sequence
        )
    session = read_session(path)
    np.testing.assert_array_equal(session.joint.log_time, log_time)
    np.testing.assert_array_equal(session.joint.sequence, sequence)
    np.testing.assert_array_equal(session.joint.position, arrays[0])
    np.testing.assert_array_equal(session.joint.effort, arrays[1])
    np.testing.assert_array_equal(session.joint.velocity, arrays[2] if velocity else np.empty((count, 0)))
    assert session.joint.lost == int(np.diff(sequence, prepend=sequence[0] - 1).sum()) - count
    assert session.end["missed"] == str(session.joint.lost)


def test_bytes_do_not_depend_on_the_batches(tmp_path):
    position, torque = signals(1500)
    log_time = EPOCH + np.arange(1500) * 1_000_000
    contents = []
    for name, cuts in (("one", [0, 1500]), ("many", [0, 1, 2, 499, 500, 501, 777, 1499, 1500])):
        path = tmp_path / name
        with SessionWriter(path, JOINTS, METADATA, robot_description=URDF) as writer:
            for first, stop in itertools.pairwise(cuts):
                part = slice(first, stop)
                writer.write_joint_states(log_time[part], position[part], torque[part])
                writer.write_joint_command(log_time[part], position[part])
                writer.advance(int(log_time[stop - 1]))
        contents.append(path.read_bytes())
    assert contents[0] == contents[1]


def test_a_log_is_never_overwritten(tmp_path):
    path = tmp_path / "a.mcap"
    path.write_bytes(b"precious")
    with pytest.raises(ConfigurationError, match="exists already"):
        SessionWriter(path, JOINTS, METADATA)
    assert path.read_bytes() == b"precious"


def test_folder_that_cannot_be_written(tmp_path):
    with pytest.raises(ConfigurationError, match="cannot be created"):
        SessionWriter(tmp_path / "nowhere" / "a.mcap", JOINTS, METADATA)


def test_metadata_are_texts(tmp_path):
    with pytest.raises(ConfigurationError, match=r"metadata 'payload_mass' is 4\.5; it must be a text"):
        SessionWriter(tmp_path / "a.mcap", JOINTS, {**METADATA, "payload_mass": 4.5})
    assert not (tmp_path / "a.mcap").exists()


def test_log_time_must_rise_within_and_across_batches(tmp_path):
    position, _ = signals(3)
    with SessionWriter(tmp_path / "a.mcap", JOINTS, METADATA) as writer:
        with pytest.raises(
            DataError, match=r"/joint_states at t = 1700000000.000000005 s follows .*strictly increasing"
        ):
            writer.write_joint_states([EPOCH, EPOCH + 5, EPOCH + 5], position)
        writer.write_joint_states([EPOCH, EPOCH + 5, EPOCH + 6], position)
        with pytest.raises(DataError, match="strictly increasing"):
            writer.write_joint_states([EPOCH + 6], position[:1])


def test_columns_must_fit_the_joints(tmp_path):
    with SessionWriter(tmp_path / "a.mcap", JOINTS, METADATA) as writer:
        with pytest.raises(DataError, match=r"`position` has shape \(2, 6\).*\(n, 7\)"):
            writer.write_joint_states([EPOCH, EPOCH + 1], np.zeros((2, 6)))
        with pytest.raises(DataError, match="has 3 rows for 2 log times"):
            writer.write_joint_states([EPOCH, EPOCH + 1], np.zeros((3, 7)))
        writer.write_joint_states([EPOCH], np.zeros((1, 7)))


def record_until_the_arm_falls_over(path):
    with SessionWriter(path, JOINTS, METADATA) as writer:
        writer.write_joint_states([EPOCH], np.zeros((1, 7)))
        raise RuntimeError("the arm fell over")


def test_exception_within_ends_the_session_as_failed(tmp_path):
    path = tmp_path / "a.mcap"
    with pytest.raises(RuntimeError, match="the arm fell over"):
        record_until_the_arm_falls_over(path)
    session = read_session(path)
    assert session.end["exit_status"] == "fail"
    assert session.end["reason"] == "the arm fell over"
    assert len(session.joint) == 1


class FullDisk:
    """A file on a disk with `room` bytes left."""

    def __init__(self, file, room):
        self._file, self.room = file, room

    def write(self, data):
        if self.room <= 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        count = self._file.write(bytes(data[: self.room]))
        self.room -= count
        return count

    def truncate(self, size):
        self.room += max(0, os.fstat(self._file.fileno()).st_size - size)
        return self._file.truncate(size)

    def __getattr__(self, name):
        return getattr(self._file, name)


def record_all(writer, log_time, position, torque):
    for first in range(0, len(log_time), 100):
        part = slice(first, first + 100)
        writer.write_joint_states(log_time[part], position[part], torque[part])
        writer.advance(int(log_time[first + 99]))
    writer.close()


@pytest.mark.parametrize("room", [60_000, 140_000, 200_000])
def test_full_disk_keeps_what_was_written_and_says_so(tmp_path, room):
    path = tmp_path / "a.mcap"
    position, torque = signals(3000)
    log_time = EPOCH + np.arange(3000) * 1_000_000
    writer = SessionWriter(path, JOINTS, METADATA)
    writer._container._file = FullDisk(writer._container._file, room)
    with pytest.raises(DataError, match=r"cannot be written beyond byte \d+: No space left on device"):
        record_all(writer, log_time, position, torque)
    with pytest.raises(DataError, match="No space left"):
        writer.write_phase(int(log_time[-1]), "brake")
    writer.close("success")
    session = read_session(path)
    count = len(session.joint)
    assert count % 500 == 0
    assert room - 60_000 < path.stat().st_size <= room + 1000
    np.testing.assert_array_equal(session.joint.position, position[:count])
    assert session.missing.closed
    assert session.end["exit_status"] == "fail"
    assert "No space left" in session.end["reason"]
    assert session.end["samples"] == str(count)


def test_disk_too_full_even_for_the_end(tmp_path):
    writer = SessionWriter(tmp_path / "a.mcap", JOINTS, METADATA)
    writer._container._file = FullDisk(writer._container._file, 10)
    writer.write_joint_states([EPOCH], np.zeros((1, 7)))
    with pytest.raises(DataError, match="No space left"):
        writer.close()


def test_fsync_is_asked_for_each_chunk(tmp_path, monkeypatch):
    calls = []
    monkeypatch.setattr(
        os, "fsync", lambda descriptor: calls.append(stat.S_ISREG(os.fstat(descriptor).st_mode))
    )
    write_session(tmp_path / "a.mcap", 1200, fsync=True)
    assert len(calls) >= 4
    calls.clear()
    write_session(tmp_path / "b.mcap", 1200)
    assert len(calls) == 1
