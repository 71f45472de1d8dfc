"""A session in a notebook or a script: its short text, its table, and paths in place of sessions."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from fri.errors import ConfigurationError, DataError
from lwr_driver.session import Session, SessionWriter, as_sessions, describe, read_session, recover
from lwr_driver.session.trace import import_trace, read_trace
from tests.lwr_driver.session.session_samples import JOINTS, METADATA, write_session


@pytest.fixture
def path(tmp_path):
    write_session(tmp_path / "a.mcap", attachments={"big.bin": bytes(10**6)})
    return tmp_path / "a.mcap"


def test_text_names_robot_payload_channels_rates_and_duration(path):
    text = repr(read_session(path))
    assert len(text.splitlines()) <= 10
    assert len(text) < 1500
    for word in ("LWR4+", METADATA["payload"], "/joint_states", "/motor_states", "1000.0 Hz", "1.999 s"):
        assert word in text
    assert "missing   nothing" in text


def test_text_of_a_session_without_samples(path):
    session = read_session(path)
    empty = dataclasses.replace(
        session, joint=session.joint.rows(0, 1), motor=None, command=None, metadata={}
    )
    assert "0 samples" in repr(empty)
    assert "unknown" in repr(empty)


def test_table_is_escaped(path):
    session = dataclasses.replace(read_session(path), metadata={"robot": "<script>alert(1)</script>"})
    table = session._repr_html_()
    assert "<script>" not in table
    assert "&lt;script&gt;" in table


def test_data_frame_of_a_channel(path, monkeypatch):
    made = SimpleNamespace(
        Index=lambda values, name: (name, values), DataFrame=lambda columns, index: (columns, index)
    )
    monkeypatch.setitem(sys.modules, "pandas", made)
    session = read_session(path)
    columns, (name, time) = session.to_dataframe()
    assert name == "time_s"
    assert time[0] == 0.0
    assert time[-1] == pytest.approx(session.duration_s)
    assert list(columns) == [f"{field}_{joint}" for field in ("position", "effort") for joint in JOINTS]
    np.testing.assert_array_equal(columns[f"effort_{JOINTS[1]}"], session.joint.effort[:, 1])
    motor, _ = session.to_dataframe("/motor_states")
    assert len(motor[f"effort_{JOINTS[0]}"]) == len(session.motor)
    with pytest.raises(ConfigurationError, match=r"no channel '/tf'; choose one of /joint_states"):
        session.to_dataframe("/tf")


def test_data_frame_without_pandas_is_refused_with_advice(path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(
        ConfigurationError, match=r"needs pandas, .*pip install .lwr-identification\[notebook\]"
    ):
        read_session(path).to_dataframe()


def test_paths_are_accepted_in_place_of_sessions(path):
    session = read_session(path)
    assert as_sessions(session) == [session]
    for value in (path, str(path)):
        assert [found.path for found in as_sessions(value)] == [path]
    assert [found.path for found in as_sessions([session, path, str(path)])] == [path] * 3
    assert len(as_sessions(item for item in (path, session))) == 2
    assert as_sessions([]) == []


@pytest.mark.parametrize("value", [3, None, b"a.mcap", [3], {"a": 1}, [["a.mcap"]], np.zeros(10**5)])
def test_neither_session_nor_path_is_refused_with_advice(value):
    with pytest.raises(ConfigurationError, match=r"is neither a session nor a path; give") as caught:
        as_sessions(value)
    assert len(str(caught.value)) < 300


def test_absent_file_is_a_data_error():
    with pytest.raises(DataError, match="cannot be read"):
        as_sessions("no_such.mcap")


@pytest.mark.parametrize(
    "call",
    [
        lambda path: read_session(3),
        lambda path: describe(3),
        lambda path: recover(3),
        lambda path: recover(path, 3),
        lambda path: read_trace(3, JOINTS),
        lambda path: import_trace(3, "trace.csv"),
        lambda path: SessionWriter(3, JOINTS, METADATA),
    ],
)
def test_number_in_place_of_a_path_is_refused_with_advice(path, call):
    with pytest.raises(ConfigurationError, match="give"):
        call(path)


def test_path_like_object_is_a_path(path):
    class Like:
        def __fspath__(self) -> str:
            return str(path)

    assert isinstance(read_session(Like()), Session)
    assert read_session(Like()).path == Path(path)
