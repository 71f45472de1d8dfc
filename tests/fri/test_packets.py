from __future__ import annotations

import math
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fri.packets import (
    CMD,
    CMD_ID,
    CMD_SIZE,
    MSR,
    MSR_ID,
    MSR_SIZE,
    CmdBuffer,
    Fault,
    MsrBuffer,
    new_cmd,
    new_msr,
)

# The same layouts in the notation of `struct`, from the protocol's description.
MSR_FORMAT = "<4H16f16i2Hf2H3f4fI4H7f175f"
CMD_FORMAT = "<4H16f16i2HI58f"

# Offset, size and type of every field as the protocol's table gives them.
MSR_TABLE = """
0 2 u2 send_seq|2 2 u2 refl_seq|4 2 u2 packet_size|6 2 u2 datagram_id|8 64 f4 krl_real|72 64 i4 krl_int
136 2 u2 krl_bool|138 2 u2 krl_fill|140 4 f4 timestamp|144 2 u2 state|146 2 u2 quality
148 4 f4 msr_sample_time|152 4 f4 cmd_sample_time|156 4 f4 safety_limits|160 4 f4 answer_rate
164 4 f4 latency|168 4 f4 jitter|172 4 f4 miss_rate|176 4 u4 miss_counter|180 2 u2 power|182 2 u2 control
184 2 u2 error|186 2 u2 warning|188 28 f4 temperature|216 28 f4 msr_jnt_pos|244 48 f4 msr_cart_pos
292 28 f4 cmd_jnt_pos|320 28 f4 cmd_jnt_pos_fri_offset|348 48 f4 cmd_cart_pos
396 48 f4 cmd_cart_pos_fri_offset|444 28 f4 msr_jnt_trq|472 28 f4 est_ext_jnt_trq
500 24 f4 est_ext_tcp_ft|524 168 f4 jacobian|692 196 f4 mass_matrix|888 28 f4 gravity
"""
CMD_TABLE = """
0 2 u2 send_seq|2 2 u2 refl_seq|4 2 u2 packet_size|6 2 u2 datagram_id|8 64 f4 krl_real|72 64 i4 krl_int
136 2 u2 krl_bool|138 2 u2 krl_fill|140 4 u4 cmd_flags|144 28 f4 jnt_pos|172 48 f4 cart_pos
220 28 f4 add_jnt_trq|248 24 f4 add_tcp_ft|272 28 f4 jnt_stiffness|300 28 f4 jnt_damping
328 24 f4 cart_stiffness|352 24 f4 cart_damping
"""


def rows(table: str) -> list[list[str]]:
    return [entry.split() for line in table.split("\n") for entry in line.split("|") if entry]


@pytest.mark.parametrize(("dtype", "table"), [(MSR, MSR_TABLE), (CMD, CMD_TABLE)], ids=["msr", "cmd"])
def test_every_field_lies_where_the_protocol_puts_it(dtype, table):
    expected = rows(table)
    assert list(dtype.names) == [name for *_, name in expected]
    for offset, size, kind, name in expected:
        field, position = dtype.fields[name][:2]
        assert (position, field.itemsize, field.base.str) == (int(offset), int(size), f"<{kind}"), name


def test_sizes_and_ids():
    assert MSR.itemsize == MSR_SIZE == struct.calcsize(MSR_FORMAT) == 916
    assert CMD.itemsize == CMD_SIZE == struct.calcsize(CMD_FORMAT) == 376
    assert (MSR_ID, CMD_ID) == (0x2006, 0x1005)
    assert new_msr().tobytes()[:8] == bytes.fromhex("0000000094030620")
    assert new_cmd().tobytes()[:8] == bytes.fromhex("0000000078010510")


def flat(record: np.ndarray) -> list:
    return [value for name in record.dtype.names for value in np.ravel(record[name]).tolist()]


@given(st.binary(min_size=MSR_SIZE, max_size=MSR_SIZE))
def test_measurement_reads_as_struct_does(data):
    values = struct.unpack(MSR_FORMAT, data)
    read = flat(np.frombuffer(data, MSR)[0])
    assert all(a == b or (math.isnan(a) and math.isnan(b)) for a, b in zip(values, read, strict=True))


@given(
    st.lists(st.integers(0, 0xFFFF), min_size=4, max_size=4),
    st.lists(st.floats(width=32, allow_nan=False), min_size=16, max_size=16),
    st.lists(st.integers(-(2**31), 2**31 - 1), min_size=16, max_size=16),
    st.integers(0, 0xFFFF),
    st.integers(0, 2**32 - 1),
    st.lists(st.floats(width=32, allow_nan=False), min_size=58, max_size=58),
)
def test_command_writes_as_struct_does(head, reals, ints, bools, flags, floats):
    record = np.zeros((), CMD)
    for name, value in zip(("send_seq", "refl_seq", "packet_size", "datagram_id"), head, strict=True):
        record[name] = value
    record["krl_real"], record["krl_int"], record["krl_bool"], record["cmd_flags"] = reals, ints, bools, flags
    start = 0
    for name in CMD.names[CMD.names.index("jnt_pos") :]:
        count = record[name].size
        record[name] = floats[start : start + count]
        start += count
    assert start == 58
    assert record.tobytes() == struct.pack(CMD_FORMAT, *head, *reals, *ints, bools, 0, flags, *floats)


def valid_msr() -> np.ndarray:
    record = new_msr()
    record["state"], record["quality"], record["control"] = 1, 3, 1
    record["msr_sample_time"] = record["cmd_sample_time"] = 0.001
    return record


def judge(data: bytes) -> Fault | None:
    buffer = MsrBuffer()
    buffer.buffer[: len(data)] = data
    return buffer.fault(len(data))


def test_valid_measurement_updates_the_header_attributes():
    record = valid_msr()
    record["send_seq"], record["refl_seq"], record["power"], record["error"] = 7, 9, 0x7F, 2
    record["timestamp"], record["cmd_jnt_pos"] = 12.5, np.arange(7) / 4
    buffer = MsrBuffer()
    buffer.buffer[:MSR_SIZE] = record.tobytes()
    assert buffer.fault(MSR_SIZE) is None
    found = (buffer.send_seq, buffer.refl_seq, buffer.power, buffer.error, buffer.state, buffer.quality)
    assert found == (7, 9, 0x7F, 2, 1, 3)
    assert buffer.timestamp == 12.5
    assert buffer.cmd_jnt_pos.tolist() == (np.arange(7) / 4).tolist()


@pytest.mark.parametrize("length", [0, 1, 915, 917, 2048])
def test_wrong_length_is_named(length):
    assert judge(valid_msr().tobytes().ljust(2048, b"\0")[:length]) is Fault.LENGTH


@pytest.mark.parametrize(
    ("field", "value", "fault"),
    [
        ("datagram_id", 0x2007, Fault.ID),
        ("datagram_id", CMD_ID, Fault.ID),
        ("packet_size", 912, Fault.SIZE),
        ("state", 3, Fault.FIELD),
        ("state", 0xFFFF, Fault.FIELD),
        ("quality", 4, Fault.FIELD),
        ("control", 4, Fault.FIELD),
        ("cmd_sample_time", 0.0, Fault.FIELD),
        ("cmd_sample_time", 0.2, Fault.FIELD),
        ("cmd_sample_time", np.nan, Fault.FIELD),
        ("msr_sample_time", 0.0, Fault.FIELD),
        ("msr_sample_time", 0.0008, Fault.FIELD),
        ("msr_sample_time", 0.11, Fault.FIELD),
        ("msr_sample_time", -0.001, Fault.FIELD),
        ("msr_sample_time", np.nan, Fault.FIELD),
        ("cmd_sample_time", 0.0008, Fault.FIELD),
        ("cmd_sample_time", 0.11, Fault.FIELD),
        ("timestamp", np.inf, Fault.FIELD),
        ("timestamp", 1.1e9, Fault.FIELD),
        ("timestamp", -1.1e9, Fault.FIELD),
        ("timestamp", np.nan, Fault.FIELD),
    ],
)
def test_damaged_field_is_named(field, value, fault):
    record = valid_msr()
    record[field] = value
    assert judge(record.tobytes()) is fault


@pytest.mark.parametrize("field", ["msr_jnt_pos", "cmd_jnt_pos", "cmd_jnt_pos_fri_offset", "msr_jnt_trq"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 3e38, -3e38, 1e6])
@pytest.mark.parametrize("joint", [0, 6])
def test_joint_values_that_cannot_be_are_refused(field, value, joint):
    record = valid_msr()
    record[field][joint] = value
    assert judge(record.tobytes()) is Fault.VALUE


@pytest.mark.parametrize("field", ["msr_jnt_pos", "cmd_jnt_pos", "cmd_jnt_pos_fri_offset"])
def test_positions_of_more_than_a_turn_are_refused_and_a_turn_of_all_joints_is_not(field):
    record = valid_msr()
    for name in ("msr_jnt_pos", "cmd_jnt_pos", "cmd_jnt_pos_fri_offset"):
        record[name] = 2.0 * np.pi * 0.999
    assert judge(record.tobytes()) is None
    record = valid_msr()
    record[field][3] = 29.0
    assert judge(record.tobytes()) is Fault.VALUE
    record[field][3] = -28.0
    assert judge(record.tobytes()) is None


def test_torques_beyond_the_sensors_are_refused_and_full_scale_of_all_joints_is_not():
    record = valid_msr()
    record["msr_jnt_trq"] = 999.0
    assert judge(record.tobytes()) is None
    record["msr_jnt_trq"] = -1001.0
    assert judge(record.tobytes()) is Fault.VALUE
    record["msr_jnt_trq"] = 0.0
    record["msr_jnt_trq"][6] = 2700.0
    assert judge(record.tobytes()) is Fault.VALUE


@pytest.mark.parametrize("field", ["state", "quality", "control"])
def test_every_value_of_the_protocol_is_accepted(field):
    for value in range(3 if field == "state" else 4):
        record = valid_msr()
        record[field] = value
        assert judge(record.tobytes()) is None


@pytest.mark.parametrize("sample_time", [0.001, 0.002, 0.012, 0.05, 0.1])
def test_all_sample_times_of_friopen_are_accepted(sample_time):
    record = valid_msr()
    record["cmd_sample_time"] = sample_time
    record["msr_jnt_pos"], record["msr_jnt_trq"] = 2.9, 300.0
    assert judge(record.tobytes()) is None


@settings(max_examples=300)
@given(st.binary(max_size=1000))
def test_arbitrary_bytes_are_refused_not_raised(data):
    assert isinstance(judge(data), Fault)
    assert isinstance(CmdBuffer().load(data), Fault)


@given(st.integers(0, MSR_SIZE - 1), st.integers(1, 255))
def test_any_damage_of_the_identity_is_seen(position, damage):
    data = bytearray(valid_msr().tobytes())
    data[position] ^= damage
    if 4 <= position < 8:
        assert judge(bytes(data)) in (Fault.ID, Fault.SIZE)
    else:
        judge(bytes(data))


def test_faulty_command_leaves_the_buffer_as_it_was():
    good = new_cmd()
    good["send_seq"], good["refl_seq"], good["krl_bool"], good["cmd_flags"] = 3, 4, 0x8001, 0x35
    good["krl_int"] = np.arange(16)
    buffer = CmdBuffer()
    assert (buffer.send_seq, buffer.refl_seq, buffer.krl_bool, buffer.cmd_flags) == (0, 0, 0, 0)
    assert buffer.load(good.tobytes()) is None
    assert (buffer.send_seq, buffer.refl_seq, buffer.krl_bool, buffer.cmd_flags) == (3, 4, 0x8001, 0x35)
    bad = good.copy()
    bad["packet_size"], bad["krl_int"], bad["send_seq"] = 372, 5, 99
    assert buffer.load(bad.tobytes()) is Fault.SIZE
    assert buffer.load(good.tobytes()[:-1]) is Fault.LENGTH
    bad["packet_size"], bad["datagram_id"] = CMD_SIZE, MSR_ID
    assert buffer.load(bad.tobytes()) is Fault.ID
    assert buffer.send_seq == 3
    assert buffer.krl_int.tolist() == list(range(16))
