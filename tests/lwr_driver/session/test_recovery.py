from __future__ import annotations

import os
import signal
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from fri.errors import ConfigurationError, DataError
from lwr_driver.session import read_session, recover
from tests.lwr_driver.session.session_samples import EPOCH, JOINTS, signals, write_session

WRITE_FOREVER = """
import sys
import numpy as np
from tests.lwr_driver.session.session_samples import EPOCH, JOINTS, METADATA, signals
from lwr_driver.session import SessionWriter
position, torque = signals(20_000)
log_time = EPOCH + np.arange(20_000) * 1_000_000
writer = SessionWriter({path!r}, JOINTS, METADATA, attachments={{"experiment.yaml": b"a: 1"}})
for first in range(0, 20_000, 20):
    part = slice(first, first + 20)
    writer.write_joint_states(log_time[part], position[part], torque[part])
    writer.write_joint_command(log_time[part], position[part])
    writer.advance(int(log_time[first + 19]))
    print(first + 20, flush=True)
sys.stdin.read()
"""


@pytest.mark.parametrize("rows", [520, 3260, 6980])
def test_kill_loses_half_a_second_at_most(tmp_path, rows):
    path = tmp_path / "a.mcap"
    code = WRITE_FOREVER.format(path=str(path))
    process = subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    while int(process.stdout.readline()) < rows:
        pass
    os.kill(process.pid, signal.SIGKILL)
    process.communicate()
    session = read_session(path)
    position, torque = signals(20_000)
    count = len(session.joint)
    assert count >= rows - 500
    np.testing.assert_array_equal(session.joint.position, position[:count])
    np.testing.assert_array_equal(session.joint.effort, torque[:count])
    assert session.attachments == {"experiment.yaml": b"a: 1"}
    assert session.end is None
    assert "the recorder died" in str(session.missing)

    result = recover(path)
    whole = read_session(result.out)
    assert result.needed
    assert result.out == tmp_path / "a.recovered.mcap"
    np.testing.assert_array_equal(whole.joint.position, position[:count])
    np.testing.assert_array_equal(whole.joint.log_time, EPOCH + np.arange(count) * 1_000_000)
    assert whole.attachments == session.attachments
    assert whole.metadata == session.metadata
    assert whole.end["exit_status"] == "fail"
    assert whole.end["samples"] == str(count)
    assert "recovered" in whole.end["reason"]
    assert whole.missing.closed
    with open(result.out, "rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        states = [
            ros for _, channel, _, ros in reader.iter_decoded_messages() if channel.topic == "/joint_states"
        ]
    np.testing.assert_array_equal([ros.position for ros in states], position[:count])
    assert all(tuple(ros.name) == JOINTS for ros in states)


@pytest.fixture(scope="module")
def content(tmp_path_factory):
    path = tmp_path_factory.mktemp("whole") / "a.mcap"
    write_session(path, 1600)
    return path.read_bytes()


@settings(max_examples=40, deadline=None)
@given(data=st.data())
def test_recovered_is_what_can_be_read(tmp_path_factory, content, data):
    folder = tmp_path_factory.mktemp("cut")
    path = folder / "a.mcap"
    path.write_bytes(content[: data.draw(st.integers(0, len(content) - 1))])
    try:
        before = read_session(path)
    except DataError:
        with pytest.raises(DataError):
            recover(path)
        assert [item.name for item in folder.iterdir()] == ["a.mcap"]
        return
    result = recover(path)
    after = read_session(result.out)
    np.testing.assert_array_equal(after.joint.position, before.joint.position)
    np.testing.assert_array_equal(after.motor.log_time, before.motor.log_time)
    assert after.phases == before.phases
    assert after.missing.closed
    assert after.missing.ended
    assert result.messages["/joint_states"] == len(before.joint)


def test_damaged_chunk_is_left_out_and_named(tmp_path, content):
    damaged = bytearray(content)
    with open(tmp_path / "b.mcap", "wb") as file:
        file.write(content)
    with open(tmp_path / "b.mcap", "rb") as file:
        second = sorted(
            make_reader(file).get_summary().chunk_indexes, key=lambda item: item.chunk_start_offset
        )[1]
    damaged[second.chunk_start_offset + second.chunk_length - 100] ^= 0xFF
    path = tmp_path / "a.mcap"
    path.write_bytes(bytes(damaged))
    result = recover(path)
    assert result.needed
    assert len(result.lost) == 1
    assert result.lost[0].startswith(
        f"chunk at byte {second.chunk_start_offset} (log time 1700000000.500 s to"
    )
    session = read_session(result.out)
    assert len(session.joint) == 1100
    assert session.joint.lost == 500
    assert session.end["exit_status"] == "success"


def test_damaged_attachment_is_left_out_and_named(tmp_path):
    path = tmp_path / "a.mcap"
    write_session(path, 600, attachments={"plan.npz": b"0123456789", "experiment.yaml": b"a: 1"})
    path.write_bytes(path.read_bytes().replace(b"0123456789", b"0123456780"))
    with pytest.raises(DataError, match=r"attachment 'plan\.npz' at byte \d+ is damaged"):
        read_session(path)
    result = recover(path)
    assert len(result.lost) == 1
    assert result.lost[0].startswith("attachment 'plan.npz'")
    assert read_session(result.out).attachments == {"experiment.yaml": b"a: 1"}


def test_whole_file_needs_nothing(tmp_path, content):
    path = tmp_path / "a.mcap"
    path.write_bytes(content)
    result = recover(path, tmp_path / "copy.mcap")
    assert not result.needed
    assert result.lost == ()
    np.testing.assert_array_equal(
        read_session(tmp_path / "copy.mcap").joint.effort, read_session(path).joint.effort
    )


def test_nothing_is_overwritten(tmp_path, content):
    path = tmp_path / "a.mcap"
    path.write_bytes(content[:-100])
    with pytest.raises(ConfigurationError, match="exists already"):
        recover(path, path)
    assert path.read_bytes() == content[:-100]
