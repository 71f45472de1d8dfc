"""Reading a session log, of any writer, into columns of numpy arrays.

The messages of a chunk are compared with the layouts met so far and read as strided columns; only a message
of a new layout is decoded field by field. Inconsistent data raise an error with file, topic and time; missing
data are listed in `Session.missing`. Nothing is repaired on the way.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from fri.errors import ConfigurationError, DataError
from lwr_driver.session.messages import (
    TOPICS,
    CdrError,
    CdrReader,
    Layout,
    fixed_layout,
    read_joint_state_layout,
)
from lwr_driver.session.scan import Block, ChannelRecord, Scan
from lwr_driver.session.session import (
    ControllerModelColumns,
    JointColumns,
    Missing,
    Phase,
    Session,
    StatusColumns,
    stamp,
)
from lwr_driver.session.spool import Growing, release, spans
from lwr_driver.session.summary import SessionSummary, summarise

SCHEMA_VERSION = "1"
_FIELDS = ("position", "velocity", "effort")
_NEEDED = {"/joint_states": "position", "/motor_states": "effort", "/joint_command": "position"}
_TEXT_TOPICS = ("/experiment/phase", "/robot_description")
_FIXED_TOPICS = ("/fri/status", "/fri/controller_model")
_MANY_LAYOUTS = 8
"""Most layouts of one block and size; further messages are decoded one by one."""

Sessions: TypeAlias = Session | str | os.PathLike[str] | Iterable[Session | str | os.PathLike[str]]
"""A session, the path of a session log, or several of either."""


def read_session(
    path: str | os.PathLike[str], joint_names: Sequence[str] | None = None, *, status: bool = True
) -> Session:
    """The session in the MCAP file `path`.

    joint_names : joints wanted, in this order; None takes those of `/joint_states`
    status : read `/fri/status` too; it needs as much memory as all torques and positions

    A truncated file is read up to its last whole chunk; `missing` lists the rest. DataError, with file, topic
    and time, for: no MCAP, no `/joint_states`, a damaged chunk amid others, wrong types, unknown or changing
    joints, values not finite, log times or counters not rising. ConfigurationError if `path` is no path.
    """
    scan = Scan(path)
    source = str(scan.path)
    joints = {topic: _JointTopic(source, topic) for topic in _NEEDED}
    texts: dict[str, list[tuple[int, str]]] = {topic: [] for topic in _TEXT_TOPICS}
    notes: list[str] = []
    fixed = {topic: _FixedTopic(topic, fixed_layout(TOPICS[topic]), notes) for topic in _FIXED_TOPICS}
    readable: dict[int, bool] = {}
    for block in scan.blocks():
        for number in np.unique(block.channel).tolist():
            channel = scan.channels.get(number)
            if channel is None:
                raise DataError(
                    f"{source}: a message in the chunk at byte {block.offset} belongs to no channel"
                )
            if channel.topic not in TOPICS or channel.topic == "/tf":
                continue
            if channel.topic == "/fri/status" and not status:
                continue
            if number not in readable:
                readable[number] = _check_types(
                    source, channel, int(block.log_time[block.channel == number][0]), notes
                )
            if not readable[number]:
                continue
            rows = np.flatnonzero(block.channel == number)
            if channel.topic in joints:
                joints[channel.topic].take(block, rows)
            elif channel.topic in texts:
                texts[channel.topic] += _texts(source, channel.topic, block, rows)
            elif not fixed[channel.topic].take(block, rows):
                readable[number] = False
                notes.append(
                    f"{channel.topic} holds other messages than its definition says and was not read"
                )
    return _session(scan, joints, texts, fixed, notes, joint_names)


def as_sessions(value: Sessions) -> list[Session]:
    """The sessions of `value`: a session, the path of a session log, or an iterable of these.

    ConfigurationError for anything else; DataError as `read_session`.
    """
    if isinstance(value, Iterable) and not isinstance(value, (str, bytes, Mapping)):
        return [_as_session(item) for item in value]
    return [_as_session(value)]


def describe(session: Session | str | os.PathLike[str]) -> SessionSummary:
    """Summary of a session, or of the session in a file. DataError as `read_session`."""
    return summarise(_as_session(session))


def _as_session(value: Any) -> Session:
    if isinstance(value, Session):
        return value
    if isinstance(value, (str, os.PathLike)):
        return read_session(value)
    shown = repr(value)
    raise ConfigurationError(
        f"sessions: {shown if len(shown) <= 80 else f'{shown[:80]}...'} is neither a session nor a path; give "
        "a Session, the path of a session log (.mcap), or a list of these"
    )


def _session(
    scan: Scan,
    joints: Mapping[str, _JointTopic],
    texts: Mapping[str, list[tuple[int, str]]],
    fixed: Mapping[str, _FixedTopic],
    notes: list[str],
    joint_names: Sequence[str] | None,
) -> Session:
    source = str(scan.path)
    metadata = _metadata(scan, "session")
    end = _metadata(scan, "session_end")
    if metadata is None:
        notes.append("there is no metadata record `session`")
    elif metadata.get("schema_version", SCHEMA_VERSION) != SCHEMA_VERSION:
        raise DataError(
            f"{source}: schema version {metadata['schema_version']!r}; this software reads "
            f"{SCHEMA_VERSION!r}, use the version that recorded it"
        )
    columns = {topic: reader.columns(notes) for topic, reader in joints.items()}
    joint = columns["/joint_states"]
    if joint is None:
        topics = sorted({channel.topic for channel in scan.channels.values()})
        cut = "; it was cut" if topics else "; the file was cut before its first whole chunk"
        cut = "" if scan.whole else cut
        raise DataError(f"{source}: no message on /joint_states; topics: {', '.join(topics) or 'none'}{cut}")
    for topic, other in columns.items():
        if other is not None and topic != "/joint_states":
            columns[topic] = _in_order_of(joint, other)
    status, model = fixed["/fri/status"].status(), fixed["/fri/controller_model"].controller_model()
    missing = Missing(
        ended=end is not None or metadata is None,
        closed=scan.closed,
        bytes_unread=scan.bytes_unread,
        lost_from=scan.lost_from,
        lost_to=scan.lost_to,
        samples={topic: item.lost for topic, item in columns.items() if item is not None and item.lost},
        notes=tuple(notes),
    )
    attachments = {name: data for name, (_, _, data) in scan.attachments.items()}
    session = Session(
        path=scan.path,
        metadata=metadata or {},
        end=end,
        joint_names=joint.names,
        joint=joint,
        motor=columns["/motor_states"],
        command=columns["/joint_command"],
        phases=_phases(source, texts["/experiment/phase"]),
        status=status,
        controller_model=model,
        robot_description=_description(source, texts["/robot_description"], attachments),
        attachments=attachments,
        missing=missing,
    )
    return session if joint_names is None else session.select(joint_names)


def _phases(source: str, marks: Sequence[tuple[int, str]]) -> tuple[Phase, ...]:
    phases = tuple(Phase(*mark) for mark in marks)
    for before, after in itertools.pairwise(phases):
        if after.log_time <= before.log_time:
            raise DataError(
                f"{source}: /experiment/phase {after.name!r} at {stamp(after.log_time)} follows "
                f"{stamp(before.log_time)}; log times must be strictly increasing"
            )
    return phases


def _description(
    source: str, described: Sequence[tuple[int, str]], attachments: Mapping[str, bytes]
) -> str | None:
    """The URDF of the topic, else that of the attachments."""
    text = described[0][1] if described else _attached_description(source, attachments)
    if text is not None and not text.lstrip().startswith("<"):
        # A log must not lead a user of the description to a file of that name.
        raise DataError(f"{source}: /robot_description begins with {text[:20]!r}, which is no XML")
    return text


def _attached_description(source: str, attachments: Mapping[str, bytes]) -> str | None:
    """The URDF among the attachments: imported logs have no topic with it, for lack of transforms."""
    try:
        return attachments["robot.urdf"].decode("utf-8") if "robot.urdf" in attachments else None
    except UnicodeDecodeError as error:
        raise DataError(f"{source}: attachment robot.urdf is not UTF-8: {error}") from error


def _metadata(scan: Scan, name: str) -> dict[str, str] | None:
    found = [values for key, values in scan.metadata if key == name]
    return found[-1] if found else None


def _check_types(source: str, channel: ChannelRecord, log_time: int, notes: list[str]) -> bool:
    """Whether a channel can be read. DataError for an essential channel, a note for another."""
    wanted = TOPICS[channel.topic]
    found = channel.schema.name if channel.schema is not None else "no schema"
    problem = ""
    if channel.encoding != "cdr":
        problem = f"message encoding {channel.encoding!r} instead of 'cdr'"
    elif found.replace("/msg/", "/") != wanted.name.replace("/msg/", "/"):
        problem = f"messages of type {found} instead of {wanted.name}"
    elif channel.schema is not None and channel.schema.encoding == "ros2msg" and channel.schema.data:
        given = _definition(channel.schema.data.decode(errors="replace"))
        if given != _definition(wanted.text):
            problem = f"another definition of {wanted.name} ({'; '.join(given)})"
    if not problem:
        return True
    if channel.topic in _FIXED_TOPICS:
        notes.append(f"{channel.topic} has {problem} and was not read")
        return False
    raise DataError(f"{source}: {channel.topic} at {stamp(log_time)} has {problem}")


def _definition(text: str) -> tuple[str, ...]:
    """Fields of the main message of a `ros2msg` definition, without comments, constants and blanks."""
    fields = []
    for line in text.split("\n"):
        if line.startswith("==="):
            break
        words = line.split("#")[0].split()
        if len(words) >= 2 and "=" not in "".join(words[1:]):
            kind = words[0].replace("/msg/", "/")
            fields.append(f"{'std_msgs/Header' if kind == 'Header' else kind} {words[1]}")
    return tuple(fields)


def _texts(source: str, topic: str, block: Block, rows: NDArray[np.int64]) -> list[tuple[int, str]]:
    found = []
    for row in rows.tolist():
        log_time = int(block.log_time[row])
        try:
            found.append((log_time, CdrReader(block.message(row)).text()))
        except CdrError as error:
            raise DataError(f"{source}: {topic} at {stamp(log_time)}: {error}") from error
    return found


def _in_order_of(joint: JointColumns, other: JointColumns) -> JointColumns:
    for name in other.names:
        if name not in joint.names:
            raise DataError(
                f"{other.source}: {other.topic} at {stamp(other.log_time)} has the joint {name!r}, "
                f"unknown to /joint_states, which has {', '.join(joint.names)}"
            )
    return other.select([name for name in joint.names if name in other.names])


@dataclass
class _JointTopic:
    """Collects the messages of one topic of joint states."""

    source: str
    topic: str
    names: tuple[str, ...] = ()
    fields: tuple[str, ...] = ()
    layouts: dict[int, list[tuple[Layout, list[int] | None]]] = field(default_factory=dict)
    parts: dict[str, Growing] = field(default_factory=dict)
    unstamped: tuple[int, int] | None = None

    def take(self, block: Block, rows: NDArray[np.int64]) -> None:
        sizes = block.sizes[rows]
        count = len(rows)
        values = {name: np.empty((count, len(self.names))) for name in self.fields}
        stamps = np.empty(count, dtype=np.int64)
        alike = (sizes == sizes[0]).all()
        # Sizes in the order of the file: an error names the first wrong message.
        for size in sizes[:1].tolist() if alike else dict.fromkeys(sizes.tolist()):
            left = np.flatnonzero(sizes == size)
            layouts = self.layouts.setdefault(size, [])
            tried = 0
            while len(left):
                if tried < min(len(layouts), _MANY_LAYOUTS):
                    layout, columns = layouts[tried]
                    tried += 1
                    data = (
                        block.gather(rows[left], size) if size else np.zeros((len(left), 0), dtype=np.uint8)
                    )
                    fits = layout.matches(data)
                    if fits.all():
                        done, left = left, left[:0]
                    else:
                        done, left, data = left[fits], left[~fits], data[fits]
                    records = layout.view(data)
                else:
                    layout, columns = self._learn(block, int(rows[left[0]]))
                    if len(layouts) < _MANY_LAYOUTS:
                        layouts.append((layout, columns))
                        if not values:
                            values = {name: np.empty((count, len(self.names))) for name in self.fields}
                        continue
                    done, left = left[:1], left[1:]
                    records = layout.view(block.gather(rows[done], size))
                for name in self.fields:
                    read = records[name].astype(np.float64)
                    values[name][done] = read if columns is None else read[:, columns]
                stamps[done] = records["sec"].astype(np.int64) * 10**9 + records["nanosec"]
        log_time = block.log_time[rows]
        off = np.flatnonzero(stamps != log_time)
        if len(off) and self.unstamped is None:
            self.unstamped = (int(log_time[off[0]]), int(stamps[off[0]]))
        columns_ = {
            "log_time": log_time,
            "publish_time": block.publish_time[rows],
            "sequence": block.sequence[rows],
            **values,
        }
        for name, part in columns_.items():
            self.parts.setdefault(name, Growing()).append(part)

    def _learn(self, block: Block, row: int) -> tuple[Layout, list[int] | None]:
        """Layout of a message, and the columns of our joints in it; None if in our order."""
        where = f"{self.source}: {self.topic} at {stamp(int(block.log_time[row]))}"
        try:
            layout, names = read_joint_state_layout(block.message(row))
        except CdrError as error:
            raise DataError(f"{where}: not a sensor_msgs/msg/JointState: {error}") from error
        if not names or len(set(names)) != len(names):
            raise DataError(
                f"{where}: joint names {', '.join(names) or 'are missing'}; each joint needs its own"
            )
        fields = tuple(name for name in _FIELDS if name in layout.fields)
        if not self.names:
            self.names, self.fields = names, fields
            needed = _NEEDED[self.topic]
            if needed not in fields:
                raise DataError(f"{where}: `{needed}` is empty; the topic needs it")
        if set(names) != set(self.names):
            raise DataError(
                f"{where}: joint names change from {', '.join(self.names)} to {', '.join(names)}; "
                "a topic must hold the same joints in every message"
            )
        if fields != self.fields:
            raise DataError(
                f"{where}: {' and '.join(fields) or 'nothing'} given, {' and '.join(self.fields)} before"
            )
        if names == self.names:
            return layout, None
        return layout, [names.index(name) for name in self.names]

    def columns(self, notes: list[str]) -> JointColumns | None:
        """All samples, after checks."""
        if not self.parts:
            return None
        count = len(self.parts["log_time"])
        joined = {name: parts.array() for name, parts in self.parts.items()}
        self.parts = {}
        for name in _FIELDS:
            if name in joined:
                self._check_finite(name, joined[name], joined["log_time"])
            else:
                joined[name] = np.empty((count, 0))
        columns = JointColumns(topic=self.topic, names=self.names, source=self.source, **joined)
        self._check_rising("log time", columns.log_time, columns.log_time, 1)
        self._check_rising("publish time", columns.publish_time, columns.log_time, 0)
        if columns.numbered:
            self._check_rising("sequence", columns.sequence, columns.log_time, 1)
        else:
            notes.append(f"{self.topic}: the samples carry no counter, so lost ones cannot be seen")
        if self.unstamped is not None:
            time, other = self.unstamped
            notes.append(
                f"{self.topic}: header.stamp differs from the log time, first at {stamp(time)} by "
                f"{(other - time) * 1e-9:.6f} s; the log time is used"
            )
        return columns

    def _check_finite(self, name: str, values: NDArray[np.float64], log_time: NDArray[np.int64]) -> None:
        wrong = [
            np.argwhere(~finite) + np.array([some.start, 0])
            for some in spans(len(values))
            if not (finite := np.isfinite(values[some])).all()
        ]
        release(values)
        if wrong:
            bad = np.concatenate(wrong)
            row, column = bad[0].tolist()
            raise DataError(
                f"{self.source}: {self.topic} at {stamp(int(log_time[row]))}: `{name}` of joint "
                f"{self.names[column]} is {values[row, column]} ({len(bad)} such values); "
                "it must be finite"
            )

    def _check_rising(
        self, name: str, values: NDArray[np.int64], log_time: NDArray[np.int64], least: int
    ) -> None:
        steps = np.diff(values)
        if (steps < least).any():
            row = int(np.flatnonzero(steps < least)[0]) + 1
            unit = " ns" if "time" in name else ""
            verb = "repeats" if steps[row - 1] == 0 else "runs backwards"
            raise DataError(
                f"{self.source}: {self.topic} at {stamp(int(log_time[row]))}: {name} {verb}, "
                f"from {values[row - 1]}{unit} to {values[row]}{unit}; it must rise with every sample"
            )


@dataclass
class _FixedTopic:
    """Collects messages of one of our own definitions, all of one layout."""

    topic: str
    layout: Layout
    notes: list[str]
    rows: list[NDArray[np.uint8]] = field(default_factory=list)
    log_time: list[NDArray[np.int64]] = field(default_factory=list)
    publish_time: list[NDArray[np.int64]] = field(default_factory=list)

    def take(self, block: Block, rows: NDArray[np.int64]) -> bool:
        if (block.sizes[rows] != self.layout.size).any():
            return False
        data = block.gather(rows, self.layout.size)
        if not self.layout.matches(data).all():
            return False
        self.rows.append(data)
        self.log_time.append(block.log_time[rows])
        self.publish_time.append(block.publish_time[rows])
        return True

    def _columns(self) -> dict[str, Any]:
        fields = self.layout.view(np.concatenate(self.rows))
        columns: dict[str, Any] = {
            name: np.ascontiguousarray(fields[name])
            for name in self.layout.fields
            if name not in ("sec", "nanosec")
        }
        columns["log_time"] = np.concatenate(self.log_time)
        for name, values in columns.items():
            bad = np.flatnonzero(~np.isfinite(values).reshape(len(values), -1).all(axis=1))
            if len(bad):
                first = stamp(int(columns["log_time"][bad[0]]))
                self.notes.append(
                    f"{self.topic}: `{name}` is not finite in {len(bad)} samples, first at {first}"
                )
        columns["publish_time"] = np.concatenate(self.publish_time)
        return columns

    def status(self) -> StatusColumns | None:
        return StatusColumns(**self._columns()) if self.rows else None

    def controller_model(self) -> ControllerModelColumns | None:
        if not self.rows:
            return None
        columns = self._columns()
        shapes = {
            "mass_matrix": (7, 7),
            "gravity": (7,),
            "jacobian": (6, 7),
            "estimated_external_torque": (7,),
        }
        for name, shape in shapes.items():
            columns[name] = columns[name].reshape(-1, *shape).astype(np.float64)
        return ControllerModelColumns(**columns)
