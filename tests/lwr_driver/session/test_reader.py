from __future__ import annotations

import io
import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType
from mcap.writer import Writer as OfficialWriter
from mcap_ros2.writer import Writer as RosWriter

from fri.errors import DataError
from lwr_driver.session import SessionWriter, describe, read_session
from lwr_driver.session.messages import JOINT_STATE, STRING
from lwr_driver.session.scan import Scan
from tests.lwr_driver.session.session_samples import (
    EPOCH,
    JOINTS,
    METADATA,
    joint_state,
    plain_messages,
    ros_session,
    signals,
    write_session,
)


def test_what_was_written_is_read(tmp_path):
    path = tmp_path / "a.mcap"
    log_time, position, torque = write_session(path, attachments={"experiment.yaml": b"name: x\n"})
    session = read_session(path)
    assert session.joint_names == JOINTS
    np.testing.assert_array_equal(session.joint.log_time, log_time)
    np.testing.assert_array_equal(session.joint.publish_time, (50 + np.arange(2000)) * 1_000_000)
    np.testing.assert_array_equal(session.joint.sequence, 50 + np.arange(2000))
    np.testing.assert_array_equal(session.joint.position, position)
    np.testing.assert_array_equal(session.joint.effort, torque)
    assert session.joint.velocity.shape == (2000, 0)
    np.testing.assert_array_equal(session.motor.effort, torque[::4] * 1.5)
    np.testing.assert_array_equal(session.motor.log_time, log_time[::4])
    np.testing.assert_array_equal(session.command.position, position + 0.5)
    assert session.metadata == METADATA
    assert session.end["exit_status"] == "success"
    assert session.attachments == {"experiment.yaml": b"name: x\n"}
    assert not session.missing
    assert str(session.missing) == "nothing"
    assert [name for _, name in session.phases] == ["settle", "period 1", "period 2"]
    assert session.spans("period") == (
        (EPOCH + 500 * 10**6, EPOCH + 1000 * 10**6),
        (EPOCH + 1000 * 10**6, EPOCH + 1999 * 10**6 + 1),
    )
    assert session.joint.period_s == pytest.approx(1e-3)


@pytest.mark.parametrize("content", [b"/etc/hostname", b"robot.urdf", b"\xff<robot/>"])
def test_robot_description_that_is_no_xml_is_refused_and_never_taken_for_a_file(tmp_path, content):
    path = tmp_path / "a.mcap"
    write_session(path, attachments={"robot.urdf": content})
    with pytest.raises(DataError, match=r"no XML|not UTF-8"):
        read_session(path)


def test_description_in_words_and_as_data(tmp_path):
    path = tmp_path / "a.mcap"
    write_session(path)
    summary = describe(path)
    data = json.loads(json.dumps(summary.as_dict()))
    assert data["channels"][0]["samples"] == 2000
    assert data["channels"][0]["rate_hz"] == pytest.approx(1000.0)
    assert data["duration_s"] == pytest.approx(1.999)
    assert [phase["name"] for phase in data["phases"]] == ["settle", "period 1", "period 2"]
    text = str(summary)
    for word in (
        "LWR4+",
        "success",
        "/joint_states",
        "period 2",
        "missing      nothing",
        "2023-11-14 22:13:20",
    ):
        assert word in text


def test_the_clock_of_an_emulator_is_no_date(tmp_path):
    path = tmp_path / "a.mcap"
    start = 1_577_836_800 * 10**9
    write_session(path, metadata={**METADATA, "utc_start": "2020-01-01T00:00:00+00:00"}, start=start)
    for text in (str(describe(path)), repr(read_session(path))):
        assert "emulated clock, 1.999 s" in text
        assert "2020" not in text


@pytest.mark.parametrize("compression", list(CompressionType))
@pytest.mark.parametrize("chunk_size", [2000, 1 << 20])
def test_logs_of_another_writer(tmp_path, compression, chunk_size):
    path = tmp_path / "a.mcap"
    messages, position, torque = plain_messages(300)
    ros_session(path, messages, chunk_size=chunk_size, compression=compression)
    session = read_session(path)
    np.testing.assert_array_equal(session.joint.position, position)
    np.testing.assert_array_equal(session.joint.effort, torque)
    assert session.joint.names == ("a", "b", "c")
    assert session.metadata == {}
    # Nobody's recorder died.
    assert session.missing.ended
    assert "recorder died" not in str(session.missing)
    assert describe(session).ended == "recorded by another program"
    assert "there is no metadata record `session`" in session.missing.notes


@pytest.mark.parametrize("chunked", [True, False])
@pytest.mark.parametrize("indexes", [IndexType.NONE, IndexType.ALL])
def test_logs_without_chunks_or_indexes(tmp_path, chunked, indexes):
    rich, plain = tmp_path / "rich.mcap", tmp_path / "plain.mcap"
    log_time, position, _ = write_session(rich, 700)
    scan = Scan(rich)
    with open(plain, "wb") as file:
        writer = OfficialWriter(file, index_types=indexes, use_chunking=chunked, use_statistics=False)
        writer.start("ros2", "elsewhere")
        channels = {}
        for block in scan.blocks():
            for row in range(len(block.channel)):
                channel = scan.channels[int(block.channel[row])]
                if channel.topic not in channels:
                    schema = writer.register_schema(
                        channel.schema.name, channel.schema.encoding, channel.schema.data
                    )
                    channels[channel.topic] = writer.register_channel(channel.topic, "cdr", schema)
                writer.add_message(
                    channels[channel.topic],
                    int(block.log_time[row]),
                    block.message(row),
                    int(block.publish_time[row]),
                    int(block.sequence[row]),
                )
        writer.finish()
    session = read_session(plain)
    np.testing.assert_array_equal(session.joint.position, position)
    np.testing.assert_array_equal(session.joint.log_time, log_time)
    assert [name for _, name in session.phases] == ["settle", "period 1", "period 2"]


def test_joint_order_may_change_from_message_to_message(tmp_path):
    path = tmp_path / "a.mcap"
    rng = np.random.default_rng(0)
    names = np.array(["A", "Bee", "C3"])
    messages = []
    for row in range(200):
        order = rng.permutation(3)
        time = EPOCH + row * 1000
        messages.append((time, joint_state(time, names[order], row + order, 10 * (row + order), order / 8)))
    ros_session(path, messages)
    session = read_session(path, ("C3", "A"))
    np.testing.assert_array_equal(session.joint.position, np.arange(200)[:, None] + [2, 0])
    np.testing.assert_array_equal(session.joint.effort, 10 * (np.arange(200)[:, None] + [2, 0]))
    np.testing.assert_array_equal(session.joint.velocity, np.tile([2 / 8, 0], (200, 1)))


def test_messages_of_many_sizes_are_read_one_by_one(tmp_path):
    path = tmp_path / "a.mcap"
    messages, position, torque = plain_messages(120)
    for row, (_, message) in enumerate(messages):
        message["header"]["frame_id"] = f"{row * 7919:x}" * (row % 5)
    ros_session(path, messages)
    session = read_session(path)
    np.testing.assert_array_equal(session.joint.position, position)
    np.testing.assert_array_equal(session.joint.effort, torque)


def test_select_maps_by_name_in_all_channels(tmp_path):
    path = tmp_path / "a.mcap"
    _, position, torque = write_session(path, 100)
    session = read_session(path).select(("E1", "A6", "A1"))
    np.testing.assert_array_equal(session.joint.position, position[:, [2, 6, 0]])
    np.testing.assert_array_equal(session.motor.effort, 1.5 * torque[::4][:, [2, 6, 0]])
    np.testing.assert_array_equal(session.command.position, position[:, [2, 6, 0]] + 0.5)
    assert session.joint_names == session.joint.names == session.motor.names == ("E1", "A6", "A1")


def test_unknown_joint_is_named_with_file_topic_and_time(tmp_path):
    path = tmp_path / "a.mcap"
    write_session(path, 100)
    with pytest.raises(
        DataError, match=r"a\.mcap: /joint_states at t = 1700000000\.000000000 s has no joint 'A7'"
    ):
        read_session(path, ("A1", "A7"))
    with pytest.raises(DataError, match="each once"):
        read_session(path).select(("A1", "A1"))


def test_joint_known_to_another_topic_only(tmp_path):
    path = tmp_path / "a.mcap"
    messages, _, _ = plain_messages(3)
    with open(path, "wb") as file:
        writer = RosWriter(file)
        schema = writer.register_msgdef(JOINT_STATE.name, JOINT_STATE.text)
        for number, (time, message) in enumerate(messages):
            writer.write_message("/joint_states", schema, message, time, time, number)
            other = joint_state(time, ("a", "x"), (), (1.0, 2.0))
            writer.write_message("/motor_states", schema, other, time, time, number)
        writer.finish()
    with pytest.raises(
        DataError, match=r"/motor_states at t = .* has the joint 'x', unknown to /joint_states"
    ):
        read_session(path)


def test_lost_samples_are_seen(tmp_path):
    path = tmp_path / "a.mcap"
    position, _ = signals(10)
    sequence = np.array([5, 6, 7, 11, 12, 13, 14, 15, 40, 41])
    times = EPOCH + sequence * 1_000_000
    with SessionWriter(path, JOINTS, METADATA) as writer:
        writer.write_joint_states(times, position, sequence=sequence)
    session = read_session(path)
    assert [(gap.row, gap.lost) for gap in session.joint.gaps] == [(3, 3), (8, 24)]
    assert session.joint.gaps[0].before == times[2]
    assert session.joint.gaps[0].after == times[3]
    assert session.joint.lost == 27
    assert session.missing
    assert "/joint_states: 27 samples lost" in session.missing.lines
    assert session.end["missed"] == "27"


def test_a_log_of_every_kth_sample_has_lost_none_of_the_others(tmp_path):
    path = tmp_path / "a.mcap"
    position, _ = signals(20)
    sequence = 7 + 4 * np.delete(np.arange(22), [9, 10])
    with SessionWriter(path, JOINTS, METADATA) as writer:
        writer.write_joint_states(EPOCH + sequence * 1_000_000, position, sequence=sequence)
    joint = read_session(path).joint
    assert [(gap.row, gap.lost) for gap in joint.gaps] == [(9, 2)]
    assert np.diff(joint.counts).tolist() == [1] * 8 + [3] + [1] * 10


def test_samples_without_numbers_are_said_to_be(tmp_path):
    path = tmp_path / "a.mcap"
    position, _ = signals(5)
    with SessionWriter(path, JOINTS, METADATA) as writer:
        writer.write_joint_states(EPOCH + np.arange(5), position, sequence=np.zeros(5))
    session = read_session(path)
    assert session.joint.gaps == ()
    assert any("carry no counter" in note for note in session.missing.notes)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("field", ["position", "effort"])
def test_values_that_are_not_finite(tmp_path, value, field):
    path = tmp_path / "a.mcap"
    arrays = dict(zip(("position", "effort"), signals(700), strict=True))
    arrays[field][612, 2] = value
    with SessionWriter(path, JOINTS, METADATA) as writer:
        writer.write_joint_states(EPOCH + np.arange(700) * 10**6, arrays["position"], arrays["effort"])
    message = rf"/joint_states at t = 1700000000\.612000000 s: `{field}` of joint E1 is {value}"
    with pytest.raises(DataError, match=message):
        read_session(path)


def test_auxiliary_values_that_are_not_finite_are_a_note(tmp_path):
    path = tmp_path / "a.mcap"
    gravity = np.zeros((4, 7))
    gravity[2, 1] = np.nan
    times = EPOCH + np.arange(4)
    with SessionWriter(path, JOINTS, METADATA) as writer:
        writer.write_joint_states(times, np.zeros((4, 7)))
        writer.write_controller_model(
            times,
            mass_matrix=np.zeros((4, 49)),
            gravity=gravity,
            jacobian=np.zeros((4, 42)),
            estimated_external_torque=gravity * 0,
        )
    notes = " ".join(read_session(path).missing.notes)
    assert (
        "/fri/controller_model: `gravity` is not finite in 1 samples, first at t = 1700000000.000000002 s"
        in notes
    )


@pytest.mark.parametrize(
    ("times", "verb"), [((0, 1000, 500, 2000), "runs backwards"), ((0, 1000, 1000, 2000), "repeats")]
)
def test_time_that_does_not_rise(tmp_path, times, verb):
    path = tmp_path / "a.mcap"
    ros_session(
        path,
        [(EPOCH + time, joint_state(EPOCH + time, ("a",), (1.0,), (2.0,))) for time in times],
        compression=CompressionType.NONE,
    )
    with pytest.raises(
        DataError, match=rf"a\.mcap: /joint_states at t = .* s: log time {verb}, from \d+ ns to"
    ):
        read_session(path)


def test_counter_that_runs_backwards(tmp_path):
    path = tmp_path / "a.mcap"
    with SessionWriter(path, JOINTS, METADATA) as writer:
        writer.write_joint_states(EPOCH + np.arange(3), np.zeros((3, 7)), sequence=[65534, 65535, 0])
    with pytest.raises(DataError, match=r"sequence runs backwards, from 65535 to 0; it must rise"):
        read_session(path)


@pytest.mark.parametrize(
    ("encoding", "schema", "text", "message"),
    [
        ("json", JOINT_STATE.name, JOINT_STATE.text, "message encoding 'json' instead of 'cdr'"),
        (
            "cdr",
            STRING.name,
            STRING.text,
            "messages of type std_msgs/msg/String instead of sensor_msgs/msg/JointState",
        ),
        (
            "cdr",
            JOINT_STATE.name,
            "float64[] q\nstring[] name\n",
            "another definition of sensor_msgs/msg/JointState",
        ),
        ("cdr", JOINT_STATE.name, JOINT_STATE.text, "not a sensor_msgs/msg/JointState: "),
    ],
)
def test_wrong_types(tmp_path, encoding, schema, text, message):
    path = tmp_path / "a.mcap"
    with open(path, "wb") as file:
        writer = OfficialWriter(file)
        writer.start("ros2", "elsewhere")
        number = writer.register_schema(schema, "ros2msg", text.encode())
        channel = writer.register_channel("/joint_states", encoding, number)
        writer.add_message(channel, EPOCH, b"\0\1\0\0" + b"\xff" * 30, EPOCH, 0)
        writer.finish()
    with pytest.raises(DataError, match=f"/joint_states at t = 1700000000.000000000 s.*{message}"):
        read_session(path)


def test_definition_with_comments_and_short_names_is_the_same(tmp_path):
    text = (
        "# a comment\nstd_msgs/msg/Header header  # when\n\nint8 GOOD=1\nstring[] name\nfloat64[] position\n"
    )
    text += "float64[]   velocity\nfloat64[] effort\n" + JOINT_STATE.text[JOINT_STATE.text.index("====") :]
    source, path = tmp_path / "b.mcap", tmp_path / "a.mcap"
    messages, position, _ = plain_messages(3)
    ros_session(source, messages)
    (block,) = Scan(source).blocks()
    with open(path, "wb") as file:
        writer = OfficialWriter(file)
        writer.start("ros2", "elsewhere")
        schema = writer.register_schema("sensor_msgs/JointState", "ros2msg", text.encode())
        channel = writer.register_channel("/joint_states", "cdr", schema)
        for row in range(3):
            writer.add_message(channel, int(block.log_time[row]), block.message(row), 0, row)
        writer.finish()
    np.testing.assert_array_equal(read_session(path).joint.position, position)


def test_joints_that_change(tmp_path):
    path = tmp_path / "a.mcap"
    first = joint_state(EPOCH, ("a", "b"), (1, 2), (3, 4))
    second = joint_state(EPOCH + 1, ("a", "c"), (1, 2), (3, 4))
    ros_session(path, [(EPOCH, first), (EPOCH + 1, second)])
    with pytest.raises(DataError, match=r"000000001 s: joint names change from a, b to a, c"):
        read_session(path)


def test_arrays_that_come_and_go(tmp_path):
    path = tmp_path / "a.mcap"
    first = joint_state(EPOCH, ("a", "b"), (1, 2), (3, 4))
    second = joint_state(EPOCH + 1, ("a", "b"), (1, 2), ())
    ros_session(path, [(EPOCH, first), (EPOCH + 1, second)])
    with pytest.raises(DataError, match=r"000000001 s: position given, position and effort before"):
        read_session(path)


def test_header_stamp_that_differs_is_said(tmp_path):
    path = tmp_path / "a.mcap"
    messages = [(EPOCH + row, joint_state(EPOCH + row + 5_000_000, ("a",), (1,), (2,))) for row in range(3)]
    ros_session(path, messages)
    session = read_session(path)
    assert session.joint.log_time.tolist() == [EPOCH, EPOCH + 1, EPOCH + 2]
    assert any(
        "header.stamp differs from the log time" in note and "0.005000 s" in note
        for note in session.missing.notes
    )


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "is empty"),
        (b"time,q\n0,1\n", "is not an MCAP file"),
        (b"\x89MCAP0\r\n", "no message on /joint_states"),
    ],
)
def test_no_session_at_all(tmp_path, content, message):
    path = tmp_path / "a.mcap"
    path.write_bytes(content)
    with pytest.raises(DataError, match=message):
        read_session(path)


def test_file_that_is_not_there(tmp_path):
    with pytest.raises(DataError, match=r"gone\.mcap: cannot be read: No such file"):
        read_session(tmp_path / "gone.mcap")


def test_a_folder_names_the_logs_in_it(tmp_path):
    with pytest.raises(DataError, match=r"is a folder; give a session log \(\.mcap\); it holds none$"):
        read_session(tmp_path)
    for name in ("b.mcap", "a.mcap", "notes.txt"):
        (tmp_path / name).touch()
    with pytest.raises(DataError, match=r"is a folder; give its session logs by name: a\.mcap, b\.mcap$"):
        read_session(tmp_path)


def test_session_without_joint_states_names_its_topics(tmp_path):
    path = tmp_path / "a.mcap"
    messages, _, _ = plain_messages(3)
    ros_session(path, messages, topic="/arm/joint_states")
    with pytest.raises(DataError, match=r"no message on /joint_states; topics: /arm/joint_states"):
        read_session(path)


def test_future_schema_version(tmp_path):
    path = tmp_path / "a.mcap"
    write_session(path, 10, metadata={**METADATA, "schema_version": "2"})
    with pytest.raises(DataError, match="schema version '2'; this software reads '1'"):
        read_session(path)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    path = tmp_path_factory.mktemp("whole") / "a.mcap"
    return write_session(path, 1600), path.read_bytes()


def first_chunk_ends(content):
    summary = make_reader(io.BytesIO(content)).get_summary()
    index = min(summary.chunk_indexes, key=lambda index: index.chunk_start_offset)
    return index.chunk_start_offset + index.chunk_length


@settings(max_examples=120, deadline=None)
@given(data=st.data())
def test_cut_anywhere(tmp_path_factory, whole, data):
    (log_time, position, _), content = whole
    size = data.draw(st.integers(0, len(content) - 1))
    path = tmp_path_factory.mktemp("cut") / "a.mcap"
    path.write_bytes(content[:size])
    if size < first_chunk_ends(content):
        with pytest.raises(DataError, match=r"a\.mcap"):
            read_session(path)
        return
    session = read_session(path)
    count = len(session.joint)
    assert count in (500, 1000, 1500, 1600)
    np.testing.assert_array_equal(session.joint.log_time, log_time[:count])
    np.testing.assert_array_equal(session.joint.position, position[:count])
    assert session.missing
    assert not session.missing.closed
    if session.missing.bytes_unread > 50 and count < 1600 and session.missing.lost_from is not None:
        assert session.missing.lost_from == log_time[count]


@settings(max_examples=150, deadline=None)
@given(data=st.data())
def test_flipped_bits_never_change_values(tmp_path_factory, whole, data):
    (log_time, position, torque), content = whole
    damaged = bytearray(content)
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(content) - 1))
        damaged[at] ^= 1 << data.draw(st.integers(0, 7))
    path = tmp_path_factory.mktemp("flip") / "a.mcap"
    path.write_bytes(bytes(damaged))
    try:
        session = read_session(path)
    except DataError:
        return
    count = len(session.joint)
    np.testing.assert_array_equal(session.joint.log_time, log_time[:count])
    np.testing.assert_array_equal(session.joint.position, position[:count])
    np.testing.assert_array_equal(session.joint.effort, torque[:count])
    assert count == 1600 or session.missing


def test_damage_between_good_chunks_is_an_error(whole, tmp_path):
    _, content = whole
    damaged = bytearray(content)
    damaged[first_chunk_ends(content) - 1000] ^= 0xFF
    path = tmp_path / "a.mcap"
    path.write_bytes(bytes(damaged))
    with pytest.raises(
        DataError, match=r"the chunk at byte \d+ is damaged: .* \(log time 1700000000\.\d+ s to .*recover"
    ):
        read_session(path)


def test_zeros_after_a_power_cut(whole, tmp_path):
    (_, position, _), content = whole
    path = tmp_path / "a.mcap"
    path.write_bytes(content[: len(content) // 2] + bytes(100_000))
    session = read_session(path)
    assert len(session.joint) in (500, 1000)
    np.testing.assert_array_equal(session.joint.position, position[: len(session.joint)])
    assert session.missing.bytes_unread >= 100_000
