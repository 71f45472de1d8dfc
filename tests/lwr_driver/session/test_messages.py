from __future__ import annotations

import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap_ros2._dynamic import generate_dynamic, serialize_dynamic

from lwr_driver.session import messages

NAMES = st.lists(
    st.text(min_size=1, max_size=12).filter(lambda s: "\0" not in s and s.isprintable()),
    min_size=1,
    max_size=9,
    unique=True,
)
DECODE = generate_dynamic(messages.JOINT_STATE.name, messages.JOINT_STATE.text)[messages.JOINT_STATE.name]


@settings(max_examples=60, deadline=None)
@given(
    names=NAMES,
    present=st.tuples(st.booleans(), st.booleans(), st.booleans()),
    seed=st.integers(0, 2**32 - 1),
)
def test_packed_joint_states_decode_elsewhere(names, present, seed):
    rng = np.random.default_rng(seed)
    arrays = {
        field: rng.normal(size=(3, len(names)))
        for field, there in zip(("position", "velocity", "effort"), present, strict=True)
        if there
    }
    flags = {field: field in arrays for field in ("position", "velocity", "effort")}
    layout = messages.joint_state_layout(names, **flags)
    packed = layout.pack({"sec": [7, 8, 9], "nanosec": [1, 2, 3], **arrays}, 3)
    for row in range(3):
        message = DECODE(packed[row].tobytes())
        assert message.name == names
        assert (message.header.stamp.sec, message.header.stamp.nanosec) == (7 + row, 1 + row)
        for field in ("position", "velocity", "effort"):
            assert list(getattr(message, field)) == (arrays[field][row].tolist() if field in arrays else [])


@settings(max_examples=60, deadline=None)
@given(names=NAMES, frame=st.text(max_size=9).filter(lambda s: "\0" not in s), velocity=st.booleans())
def test_messages_of_another_serializer_are_laid_out_right(names, frame, velocity):
    encode = serialize_dynamic(messages.JOINT_STATE.name, messages.JOINT_STATE.text)[
        messages.JOINT_STATE.name
    ]
    values = [0.5 + index for index in range(len(names))]
    message = {
        "header": {"stamp": {"sec": 3, "nanosec": 4}, "frame_id": frame},
        "name": names,
        "position": values,
        "velocity": [2 * value for value in values] if velocity else [],
        "effort": [-value for value in values],
    }
    data = encode(message)
    layout, found = messages.read_joint_state_layout(data)
    records = layout.view(np.frombuffer(data, dtype=np.uint8)[None])
    assert found == tuple(names)
    assert records["effort"][0].tolist() == [-value for value in values]
    assert records["position"][0].tolist() == values
    assert ("velocity" in layout.fields) == velocity
    assert layout.matches(np.frombuffer(data, dtype=np.uint8)[None]).all()


def by_hand(order: str, kind: bytes, widest: int) -> bytes:
    """A JointState of two joints in any plain CDR, packed step by step."""
    data = bytearray(kind + b"\0\0")

    def put(code: str, *values: float) -> None:
        for value in values:
            size = min(struct.calcsize(code), widest)
            data.extend(bytes(-(len(data) - 4) % size))
            data.extend(struct.pack(order + code, value))

    put("i", 11)
    put("I", 22)
    put("I", 4)
    data.extend(b"abc\0")
    put("I", 2)
    for name in (b"left\0", b"right\0"):
        put("I", len(name))
        data.extend(name)
    put("I", 2)
    put("d", 1.5, -2.5)
    put("I", 0)
    put("I", 2)
    put("d", 30.25, 40.75)
    return bytes(data)


@pytest.mark.parametrize(
    ("order", "kind", "widest"),
    [
        (">", b"\0\0", 8),
        ("<", b"\0\1", 8),
        (">", b"\0\6", 4),
        ("<", b"\0\7", 4),
        (">", b"\0\x10", 4),
        ("<", b"\0\x11", 4),
    ],
)
def test_every_plain_encapsulation_is_read(order, kind, widest):
    data = by_hand(order, kind, widest)
    layout, names = messages.read_joint_state_layout(data)
    record = layout.view(np.frombuffer(data, dtype=np.uint8)[None])[0]
    assert names == ("left", "right")
    assert (record["sec"], record["nanosec"]) == (11, 22)
    assert record["position"].tolist() == [1.5, -2.5]
    assert record["effort"].tolist() == [30.25, 40.75]
    assert "velocity" not in layout.fields


def test_parameter_lists_are_refused():
    with pytest.raises(messages.CdrError, match="0x0003 is not plain CDR"):
        messages.read_joint_state_layout(b"\0\3\0\0" + bytes(40))


def test_array_longer_than_names_is_refused():
    data = bytearray(by_hand("<", b"\0\1", 8))
    at = data.index(struct.pack("<d", 1.5)) - 8
    assert data[at : at + 4] == struct.pack("<I", 2) or data[at + 4 : at + 8] == struct.pack("<I", 2)
    place = at if data[at : at + 4] == struct.pack("<I", 2) else at + 4
    data[place : place + 4] = struct.pack("<I", 3)
    with pytest.raises(messages.CdrError):
        messages.read_joint_state_layout(bytes(data))


@settings(max_examples=300, deadline=None)
@given(data=st.binary(max_size=200))
def test_random_bytes_are_an_error_of_ours_or_a_message(data):
    for start in (b"", b"\0\1\0\0", b"\0\0\0\0"):
        try:
            layout, names = messages.read_joint_state_layout(start + data)
        except messages.CdrError:
            continue
        assert layout.size == len(start + data)
        assert all(isinstance(name, str) for name in names)


def test_pack_keeps_the_bytes_between_fields():
    # A structured array with gaps loses these bytes in a copy; the names stand there.
    layout = messages.joint_state_layout(("A1", "A2"), position=True, velocity=False, effort=False)
    packed = layout.pack({"sec": [1] * 5, "nanosec": [2] * 5, "position": np.ones((5, 2))}, 5)
    assert layout.matches(packed).all()
    assert all(b"A1\0" in row.tobytes() and b"A2\0" in row.tobytes() for row in packed)
