"""The two datagrams of FRI 1.0 as numpy dtypes, and their validation.

The controller (KRC) sends the 916-byte measurement `MSR`, the PC answers with the 376-byte command `CMD`.
Both are little-endian with natural 4-byte alignment and no implicit padding. There is one definition, this
one; offsets and sizes are asserted on import. Joints run in kinematic order A1 A2 E1 A3 A4 A5 A6, units are
SI.

``MsrBuffer`` and ``CmdBuffer`` receive datagrams without allocation: their field views are bound once.
"""

from __future__ import annotations

import math
import struct
from enum import Enum
from math import hypot
from typing import Any

import numpy as np

#: Joints in the order of the wire, the kinematic order; E1 is the third.
JOINT_NAMES = ("A1", "A2", "E1", "A3", "A4", "A5", "A6")
JOINTS = len(JOINT_NAMES)

MSR_ID = 0x2006
CMD_ID = 0x1005
MSR_SIZE = 916
CMD_SIZE = 376

_HEAD: list[tuple] = [
    ("send_seq", "<u2"),  # sender's counter, wraps at 65536
    ("refl_seq", "<u2"),  # send_seq of the last packet received from the other side
    ("packet_size", "<u2"),
    ("datagram_id", "<u2"),
    ("krl_real", "<f4", (16,)),  # $FRI_TO_REA[1..16] in MSR, $FRI_FRM_REA[1..16] in CMD
    ("krl_int", "<i4", (16,)),
    ("krl_bool", "<u2"),  # bit i is $FRI_TO_BOOL[i+1] or $FRI_FRM_BOOL[i+1]
    ("krl_fill", "<u2"),
]

#: Measurement, controller to PC: robot state, session state, link statistics, KRL variables.
MSR = np.dtype(
    [
        *_HEAD,
        ("timestamp", "<f4"),  # controller's clock [s]; too coarse for differences
        ("state", "<u2"),
        ("quality", "<u2"),
        ("msr_sample_time", "<f4"),  # [s]
        ("cmd_sample_time", "<f4"),  # [s]
        ("safety_limits", "<f4"),  # argument of friStart, shrinks the limits
        ("answer_rate", "<f4"),
        ("latency", "<f4"),  # [s]
        ("jitter", "<f4"),  # [s]
        ("miss_rate", "<f4"),
        ("miss_counter", "<u4"),
        ("power", "<u2"),  # one bit a drive
        ("control", "<u2"),
        ("error", "<u2"),
        ("warning", "<u2"),
        ("temperature", "<f4", (7,)),
        ("msr_jnt_pos", "<f4", (7,)),  # [rad]
        ("msr_cart_pos", "<f4", (12,)),  # 3x4 row-major [R|p], p in m
        ("cmd_jnt_pos", "<f4", (7,)),  # setpoint of the KRL interpolator, before FRI [rad]
        ("cmd_jnt_pos_fri_offset", "<f4", (7,)),  # FRI's addition to it [rad]
        ("cmd_cart_pos", "<f4", (12,)),
        ("cmd_cart_pos_fri_offset", "<f4", (12,)),
        ("msr_jnt_trq", "<f4", (7,)),  # joint torque sensors, after the gear [Nm]
        ("est_ext_jnt_trq", "<f4", (7,)),  # [Nm]
        ("est_ext_tcp_ft", "<f4", (6,)),  # Fx Fy Fz Tz Ty Tx [N, Nm]
        ("jacobian", "<f4", (6, 7)),  # rows X Y Z RZ RY RX
        ("mass_matrix", "<f4", (7, 7)),  # [kg m^2]
        ("gravity", "<f4", (7,)),  # gravity torques [Nm]
    ]
)

#: Command, PC to controller. The controller uses only the fields named in `cmd_flags`.
CMD = np.dtype(
    [
        *_HEAD,
        ("cmd_flags", "<u4"),
        ("jnt_pos", "<f4", (7,)),  # absolute [rad]
        ("cart_pos", "<f4", (12,)),  # 3x4 row-major, m
        ("add_jnt_trq", "<f4", (7,)),  # [Nm]
        ("add_tcp_ft", "<f4", (6,)),  # Fx Fy Fz Tz Ty Tx [N, Nm]
        ("jnt_stiffness", "<f4", (7,)),  # [Nm/rad]
        ("jnt_damping", "<f4", (7,)),  # normalised
        ("cart_stiffness", "<f4", (6,)),  # X Y Z A B C [N/m, Nm/rad]
        ("cart_damping", "<f4", (6,)),  # normalised
    ]
)

_HEAD_OFFSETS = {
    "send_seq": 0,
    "refl_seq": 2,
    "packet_size": 4,
    "datagram_id": 6,
    "krl_real": 8,
    "krl_int": 72,
    "krl_bool": 136,
    "krl_fill": 138,
}

#: Byte offset of every field, from the protocol's table; the dtypes are checked against it.
MSR_OFFSETS = {
    **_HEAD_OFFSETS,
    "timestamp": 140,
    "state": 144,
    "quality": 146,
    "msr_sample_time": 148,
    "cmd_sample_time": 152,
    "safety_limits": 156,
    "answer_rate": 160,
    "latency": 164,
    "jitter": 168,
    "miss_rate": 172,
    "miss_counter": 176,
    "power": 180,
    "control": 182,
    "error": 184,
    "warning": 186,
    "temperature": 188,
    "msr_jnt_pos": 216,
    "msr_cart_pos": 244,
    "cmd_jnt_pos": 292,
    "cmd_jnt_pos_fri_offset": 320,
    "cmd_cart_pos": 348,
    "cmd_cart_pos_fri_offset": 396,
    "msr_jnt_trq": 444,
    "est_ext_jnt_trq": 472,
    "est_ext_tcp_ft": 500,
    "jacobian": 524,
    "mass_matrix": 692,
    "gravity": 888,
}

CMD_OFFSETS = {
    **_HEAD_OFFSETS,
    "cmd_flags": 140,
    "jnt_pos": 144,
    "cart_pos": 172,
    "add_jnt_trq": 220,
    "add_tcp_ft": 248,
    "jnt_stiffness": 272,
    "jnt_damping": 300,
    "cart_stiffness": 328,
    "cart_damping": 352,
}


def _assert_layout(dtype: np.dtype, size: int, offsets: dict[str, int]) -> None:
    fields = dtype.fields
    assert fields is not None
    found = {name: field[1] for name, field in fields.items()}
    if dtype.itemsize != size or found != offsets:
        raise AssertionError(
            f"packet layout is {found} in {dtype.itemsize} bytes, must be {offsets} in {size}"
        )


_assert_layout(MSR, MSR_SIZE, MSR_OFFSETS)
_assert_layout(CMD, CMD_SIZE, CMD_OFFSETS)

# Larger than either packet, so that longer datagrams are recognised.
_BUFFER_SIZE = 2048
# No axis of the arm turns by more than 340 degrees, no torque sensor reads 1000 Nm: more is a damaged packet.
_MAX_POSITION_NORM = math.sqrt(3 * JOINTS) * 2 * math.pi
_MAX_TORQUE_NORM = math.sqrt(JOINTS) * 1000.0


class Fault(Enum):
    """Why a datagram is not a valid packet."""

    LENGTH = "length"
    ID = "datagram id"
    SIZE = "packet size field"
    FIELD = "state, quality, control, sample time or timestamp outside the protocol"
    VALUE = "joint values not finite or not possible"


def new_msr() -> np.ndarray:
    """Zeroed measurement of shape (), its size and id filled in."""
    record = np.zeros((), dtype=MSR)
    record["packet_size"] = MSR_SIZE
    record["datagram_id"] = MSR_ID
    return record


def new_cmd() -> np.ndarray:
    """Zeroed command of shape (), its size and id filled in."""
    record = np.zeros((), dtype=CMD)
    record["packet_size"] = CMD_SIZE
    record["datagram_id"] = CMD_ID
    return record


class MsrBuffer:
    """Receive buffer for measurements.

    ``buffer`` takes the datagram (``recvfrom_into``), ``record`` (shape (), dtype `MSR`) and the views are
    bound to its memory once. The header integers of the last valid packet are plain attributes.
    """

    _head = struct.Struct("<4H").unpack_from
    _intf = struct.Struct("<fHHff").unpack_from
    _robot = struct.Struct("<3H").unpack_from
    _values = struct.Struct("<7f48x14f96x7f").unpack_from  # msr_jnt_pos, cmd_jnt_pos and offset, msr_jnt_trq

    def __init__(self) -> None:
        self.buffer = bytearray(_BUFFER_SIZE)
        self.record = np.frombuffer(self.buffer, dtype=MSR, count=1).reshape(())
        self.msr_jnt_pos: np.ndarray = self.record["msr_jnt_pos"]
        self.cmd_jnt_pos: np.ndarray = self.record["cmd_jnt_pos"]
        self.cmd_jnt_pos_fri_offset: np.ndarray = self.record["cmd_jnt_pos_fri_offset"]
        self.cmd_cart_pos: np.ndarray = self.record["cmd_cart_pos"]
        self.send_seq = 0
        self.refl_seq = 0
        self.timestamp = 0.0
        self.state = 0
        self.quality = 0
        self.sample_time = 0.0
        self.power = 0
        self.control = 0
        self.error = 0

    def fault(self, length: int) -> Fault | None:
        """Judge the datagram of `length` bytes in the buffer; on success update the header attributes."""
        if length != MSR_SIZE:
            return Fault.LENGTH
        buffer = self.buffer
        send_seq, refl_seq, size, identifier = self._head(buffer, 0)
        if identifier != MSR_ID:
            return Fault.ID
        if size != MSR_SIZE:
            return Fault.SIZE
        timestamp, state, quality, measuring, sample_time = self._intf(buffer, 140)
        power, control, error = self._robot(buffer, 180)
        # 1 to 100 ms with room for float32; the comparisons are also false for NaN.
        if (
            state > 2
            or quality > 3
            or control > 3
            or not 0.0009 < sample_time < 0.1001
            or not 0.0009 < measuring < 0.1001
            or not -1e9 < timestamp < 1e9
        ):
            return Fault.FIELD
        values = self._values(buffer, 216)
        # The norms are NaN or infinite as soon as one value is, and then the comparisons are false.
        if not (hypot(*values[:21]) < _MAX_POSITION_NORM and hypot(*values[21:]) < _MAX_TORQUE_NORM):
            return Fault.VALUE
        self.send_seq = send_seq
        self.refl_seq = refl_seq
        self.timestamp = timestamp
        self.state = state
        self.quality = quality
        self.sample_time = sample_time
        self.power = power
        self.control = control
        self.error = error
        return None


def leading(good: Any) -> int:
    """Number of leading rows of `good`, (n,) or (n, ...), without a false value."""
    return len(good) if good.all() else int(np.argmin(good.reshape(len(good), -1).all(axis=1)))


def plausible(packets: np.ndarray) -> int:
    """How many leading `packets`, (n,) of `MSR`, have joint values that are sure to pass ``MsrBuffer.fault``.

    Values at the very edge of what it passes are not sure.
    """
    # By the single values instead of the norm; false for NaN.
    position, torque = _MAX_POSITION_NORM / math.sqrt(3 * JOINTS), _MAX_TORQUE_NORM / math.sqrt(JOINTS)
    places = ("msr_jnt_pos", "cmd_jnt_pos", "cmd_jnt_pos_fri_offset")
    limits = [*((name, position) for name in places), ("msr_jnt_trq", torque)]
    return min(leading(np.abs(packets[name]) < limit) for name, limit in limits)


def raw(records: np.ndarray) -> np.ndarray:
    """The bytes (n, size) of `records` (n,), on the same memory; copies of them cost much less than field by field."""
    return records.view(np.uint8).reshape(len(records), records.dtype.itemsize)


class CmdBuffer:
    """Receive buffer for commands; ``load`` copies a datagram in and judges its header.

    The values are judged by the controller's end: only fields in use must be finite.
    """

    _head = struct.Struct("<4H").unpack_from
    _bool = struct.Struct("<H").unpack_from
    _flags = struct.Struct("<I").unpack_from

    def __init__(self) -> None:
        self.buffer = bytearray(CMD_SIZE)
        self.record = np.frombuffer(self.buffer, dtype=CMD, count=1).reshape(())
        self.krl_real: np.ndarray = self.record["krl_real"]
        self.krl_int: np.ndarray = self.record["krl_int"]
        self.jnt_pos: np.ndarray = self.record["jnt_pos"]
        self.send_seq = 0
        self.refl_seq = 0
        self.krl_bool = 0
        self.cmd_flags = 0

    def load(self, datagram: bytes | bytearray | memoryview) -> Fault | None:
        """Copy a valid datagram in and read its header; a faulty one leaves the buffer as it was."""
        if len(datagram) != CMD_SIZE:
            return Fault.LENGTH
        send_seq, refl_seq, size, identifier = self._head(datagram, 0)
        if identifier != CMD_ID:
            return Fault.ID
        if size != CMD_SIZE:
            return Fault.SIZE
        self.buffer[:] = datagram
        self.send_seq = send_seq
        self.refl_seq = refl_seq
        (self.krl_bool,) = self._bool(datagram, 136)
        (self.cmd_flags,) = self._flags(datagram, 140)
        return None
