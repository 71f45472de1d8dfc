"""The messages of the session log: their definitions (`ros2msg`), and CDR packed by columns with numpy.

Messages of a topic with constant names and array lengths have one size, with every field at the same place.
`Layout` holds such a message as a template of bytes and the places of its fields. Packing copies the template
n times and writes the columns into it; unpacking checks all bytes outside the fields against the template and
reads the columns. Rows are moved as plain bytes, never as structured arrays with gaps: copies of these leave
out the bytes between the fields.

CDR: 4 bytes of encapsulation (byte order and version), then the fields. A number is aligned to its own size
(XCDR2: at most 4) counted from the end of the encapsulation, a string has its length with the closing zero, a
sequence its count; an empty sequence has no padding after its count.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Schema:
    """Name and text of a message definition."""

    name: str
    text: str


_RULE = "=" * 80
_CODES = {"uint16": "<u2", "uint32": "<u4", "float32": "<f4", "float64": "<f8"}

_TIME = f"""{_RULE}
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""

_HEADER = f"""{_RULE}
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
{_TIME}"""

JOINT_STATE = Schema(
    "sensor_msgs/msg/JointState",
    f"""std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
{_HEADER}""",
)

STRING = Schema("std_msgs/msg/String", "string data\n")

TF_MESSAGE = Schema(
    "tf2_msgs/msg/TFMessage",
    f"""geometry_msgs/TransformStamped[] transforms
{_RULE}
MSG: geometry_msgs/TransformStamped
std_msgs/Header header
string child_frame_id
geometry_msgs/Transform transform
{_RULE}
MSG: geometry_msgs/Transform
geometry_msgs/Vector3 translation
geometry_msgs/Quaternion rotation
{_RULE}
MSG: geometry_msgs/Vector3
float64 x
float64 y
float64 z
{_RULE}
MSG: geometry_msgs/Quaternion
float64 x
float64 y
float64 z
float64 w
{_HEADER}""",
)

FRI_STATUS = Schema(
    "lwr_msgs/msg/FriStatus",
    f"""# State and statistics of the controller's FRI session, as received in one cycle.
std_msgs/Header header
uint16 state          # 0 OFF, 1 MON, 2 CMD
uint16 quality        # 0 UNACCEPTABLE, 1 BAD, 2 OK, 3 PERFECT
uint32 sequence       # packet count of the controller, unwrapped
float64 sample_time   # [s]
float32 answer_rate   # answered packets, 0 to 1
float32 latency       # [s]
float32 jitter        # [s]
float32 miss_rate     # missing answers, 0 to 1
uint32 miss_counter
uint16 power          # bit i: drive of joint i is on
uint16 control        # control mode
uint16 error          # bit i: error of drive i
uint16 warning        # bit i: warning of drive i
float32[7] temperature
{_HEADER}""",
)

CONTROLLER_MODEL = Schema(
    "lwr_msgs/msg/ControllerModel",
    f"""# The controller's own model at the measured position.
std_msgs/Header header
float32[49] mass_matrix             # row-major 7 x 7 [kg m2]
float32[7] gravity                  # joint torques [Nm]
float32[42] jacobian                # row-major 6 x 7, rows X Y Z RZ RY RX
float32[7] estimated_external_torque  # [Nm]
{_HEADER}""",
)

TOPICS: dict[str, Schema] = {
    "/joint_states": JOINT_STATE,
    "/motor_states": JOINT_STATE,
    "/joint_command": JOINT_STATE,
    "/experiment/phase": STRING,
    "/fri/status": FRI_STATUS,
    "/fri/controller_model": CONTROLLER_MODEL,
    "/robot_description": STRING,
    "/tf": TF_MESSAGE,
}
"""The topics of the session log and their message definitions."""


_ENCAPSULATIONS: dict[bytes, tuple[str, int]] = {
    b"\x00\x00": (">", 8),
    b"\x00\x01": ("<", 8),
    b"\x00\x06": (">", 4),
    b"\x00\x07": ("<", 4),
    b"\x00\x10": (">", 4),
    b"\x00\x11": ("<", 4),
}
"""Byte order and largest alignment of plain CDR; XCDR2 has two sets of numbers, of versions 1.2 and 1.3."""

_TAIL_PADDING = 7
"""Most bytes of padding at the end of a message."""


class CdrError(ValueError):
    """The bytes of a message do not fit its definition."""


@dataclass(frozen=True)
class Layout:
    """Place of every field in messages of one size.

    template : the message with all fields zero
    fields : name -> (numpy type, shape, offset)
    """

    template: bytes
    fields: Mapping[str, tuple[str, tuple[int, ...], int]]

    def __post_init__(self) -> None:
        names = list(self.fields)
        dtype = np.dtype(
            {
                "names": names,
                "formats": [(np.dtype(self.fields[name][0]), self.fields[name][1]) for name in names],
                "offsets": [self.fields[name][2] for name in names],
                "itemsize": len(self.template),
            }
        )
        constant = np.ones(len(self.template), dtype=bool)
        for code, shape, offset in self.fields.values():
            constant[offset : offset + np.dtype(code).itemsize * int(np.prod(shape))] = False
        object.__setattr__(self, "_dtype", dtype)
        object.__setattr__(self, "_constant", np.flatnonzero(constant))
        bytes_ = np.frombuffer(self.template, dtype=np.uint8)
        object.__setattr__(self, "_expected", bytes_[constant])

    @property
    def size(self) -> int:
        """Bytes of a message."""
        return len(self.template)

    def pack(self, columns: Mapping[str, Any], count: int) -> NDArray[np.uint8]:
        """`count` messages, shape (count, size); `columns` maps each field to an array with `count` rows."""
        rows = np.frombuffer(bytearray(self.template * count), dtype=np.uint8).reshape(count, self.size)
        fields = self.view(rows)
        for name in self.fields:
            fields[name] = columns[name]
        return rows

    def view(self, rows: NDArray[np.uint8]) -> NDArray[Any]:
        """The messages `rows` (n, size) as records on the same memory."""
        return np.ndarray((len(rows),), dtype=self._dtype, buffer=rows.data)  # type: ignore[attr-defined]

    def matches(self, rows: NDArray[np.uint8]) -> NDArray[np.bool_]:
        """Mask of the messages `rows` (n, size) with these constants: names, counts, byte order, padding."""
        constant: NDArray[np.intp] = self._constant  # type: ignore[attr-defined]
        expected: NDArray[np.uint8] = self._expected  # type: ignore[attr-defined]
        return np.asarray((rows[:, constant] == expected).all(axis=1))

    def relaid(self, prefix: bytes, fields: Mapping[str, tuple[str, int]]) -> Layout:
        """This layout behind `prefix`, with the prefix's numbers `fields` (name -> type, offset)."""
        shifted = {name: (code, shape, at + len(prefix)) for name, (code, shape, at) in self.fields.items()}
        added = {name: (code, (), at) for name, (code, at) in fields.items()}
        return Layout(prefix + self.template, {**added, **shifted})


class LayoutBuilder:
    """Builds a little-endian XCDR1 `Layout` field by field, in the order of the message definition."""

    def __init__(self) -> None:
        self._bytes = bytearray(b"\x00\x01\x00\x00")
        self._fields: dict[str, tuple[str, tuple[int, ...], int]] = {}

    def numbers(self, name: str, code: str, shape: tuple[int, ...] = ()) -> LayoutBuilder:
        """A number or an array of fixed length; `code` is the numpy type, such as `<f8`."""
        size = np.dtype(code).itemsize
        count = int(np.prod(shape))
        if count:
            self._align(size)
            self._fields[name] = (code, shape, len(self._bytes))
            self._bytes += bytes(size * count)
        return self

    def sequence(self, name: str, code: str, count: int) -> LayoutBuilder:
        """A sequence of always `count` numbers; no field if that is zero."""
        return self.count(count).numbers(name, code, (count,))

    def text(self, value: str) -> LayoutBuilder:
        """A constant string."""
        data = value.encode() + b"\x00"
        self.count(len(data))
        self._bytes += data
        return self

    def texts(self, values: Sequence[str]) -> LayoutBuilder:
        """A constant sequence of strings."""
        self.count(len(values))
        for value in values:
            self.text(value)
        return self

    def header(self, prefix: str = "", frame_id: str = "") -> LayoutBuilder:
        """A `std_msgs/Header` with the fields `sec` and `nanosec`."""
        return self.numbers(f"{prefix}sec", "<i4").numbers(f"{prefix}nanosec", "<u4").text(frame_id)

    def count(self, value: int) -> LayoutBuilder:
        """The count of a sequence; its elements follow."""
        self._align(4)
        self._bytes += struct.pack("<I", value)
        return self

    def layout(self) -> Layout:
        """The layout of all fields so far."""
        return Layout(bytes(self._bytes), dict(self._fields))

    def _align(self, size: int) -> None:
        self._bytes += bytes(-(len(self._bytes) - 4) % size)


def joint_state_layout(names: Sequence[str], *, position: bool, velocity: bool, effort: bool) -> Layout:
    """Layout of `sensor_msgs/msg/JointState` for the joints `names`, with or without each array."""
    builder = LayoutBuilder().header().texts(names)
    for field, present in (("position", position), ("velocity", velocity), ("effort", effort)):
        builder.sequence(field, "<f8", len(names) if present else 0)
    return builder.layout()


def fixed_layout(schema: Schema) -> Layout:
    """Layout of a definition with a header first, then numbers and arrays of fixed length."""
    builder = LayoutBuilder().header()
    for line in schema.text.partition(_RULE)[0].splitlines():
        words = line.partition("#")[0].split()
        if words and words[0] != "std_msgs/Header":
            kind, _, length = words[0].partition("[")
            builder.numbers(words[1], _CODES[kind], (int(length[:-1]),) if length else ())
    return builder.layout()


def tf_layout(frames: Sequence[tuple[str, str]]) -> Layout:
    """Layout of `tf2_msgs/msg/TFMessage` for (parent, child) pairs; pose i is the field `pose_i`.

    A pose is x y z [m] and the quaternion x y z w.
    """
    builder = LayoutBuilder().count(len(frames))
    for index, (parent, child) in enumerate(frames):
        builder.header(f"{index}_", parent).text(child).numbers(f"pose_{index}", "<f8", (7,))
    return builder.layout()


class CdrReader:
    """Reads one message of any encapsulation field by field; `CdrError` for impossible bytes."""

    def __init__(self, data: bytes) -> None:
        if len(data) < 4:
            raise CdrError(f"message of {len(data)} bytes has no CDR encapsulation")
        if data[:2] not in _ENCAPSULATIONS:
            raise CdrError(f"CDR encapsulation 0x{data[:2].hex()} is not plain CDR")
        self.order, self._widest = _ENCAPSULATIONS[data[:2]]
        self._data = data
        self._at = 4

    def place(self, size: int, count: int) -> int:
        """Offset of `count` numbers of `size` bytes each; steps over them."""
        if count == 0:
            return self._at
        align = min(size, self._widest)
        at = self._at + -(self._at - 4) % align
        if count > (len(self._data) - at) // size:
            raise CdrError(f"message of {len(self._data)} bytes ends before {count} numbers at byte {at}")
        self._at = at + size * count
        return at

    def unsigned(self) -> int:
        """A uint32."""
        return int(struct.unpack_from(self.order + "I", self._data, self.place(4, 1))[0])

    def signed(self) -> int:
        """An int32."""
        return int(struct.unpack_from(self.order + "i", self._data, self.place(4, 1))[0])

    def text(self) -> str:
        """A string; its length may or may not count the closing zero."""
        length = self.unsigned()
        data = self._data[self._at : self._at + length]
        if len(data) < length:
            raise CdrError(f"message of {len(self._data)} bytes ends within a text of {length} bytes")
        self._at += length
        try:
            return data.removesuffix(b"\x00").decode()
        except UnicodeDecodeError as error:
            raise CdrError(f"a text is not UTF-8: {error}") from error

    def texts(self) -> tuple[str, ...]:
        """A sequence of strings."""
        count = self.unsigned()
        if count > (len(self._data) - self._at) // 4:
            raise CdrError(f"message of {len(self._data)} bytes cannot hold {count} texts")
        return tuple(self.text() for _ in range(count))

    def finish(self) -> None:
        """Raise if more than padding is left."""
        left = len(self._data) - self._at
        if left > _TAIL_PADDING:
            raise CdrError(f"{left} bytes follow the last field")


def read_joint_state_layout(data: bytes) -> tuple[Layout, tuple[str, ...]]:
    """Layout and joint names of a `sensor_msgs/msg/JointState` message, in any plain CDR encapsulation.

    Empty arrays are no fields of the layout. `CdrError` if another array differs in length from the names.
    """
    reader = CdrReader(data)
    order = reader.order
    fields: dict[str, tuple[str, tuple[int, ...], int]] = {
        "sec": (order + "i4", (), reader.place(4, 1)),
        "nanosec": (order + "u4", (), reader.place(4, 1)),
    }
    reader.text()
    names = reader.texts()
    for field in ("position", "velocity", "effort"):
        count = reader.unsigned()
        if count not in (0, len(names)):
            raise CdrError(f"`{field}` has {count} values for {len(names)} joint names")
        at = reader.place(8, count)
        if count:
            fields[field] = (order + "f8", (count,), at)
    reader.finish()
    template = bytearray(data)
    for code, shape, at in fields.values():
        size = np.dtype(code).itemsize * int(np.prod(shape))
        template[at : at + size] = bytes(size)
    return Layout(bytes(template), fields), names
