"""`sensor_msgs/JointState` of a ROS 2 bag: an MCAP file, or the folder of a split bag, read as recorded.

Joints stand in the order of their names in each message, so every message is sorted by name. Publishers with
different joints on one topic stay apart.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from fri.errors import DataError
from ident.import_log.tables import Floats, Table
from lwr_driver.session.messages import CdrError, CdrReader, Layout, read_joint_state_layout
from lwr_driver.session.scan import Block, ChannelRecord, Scan
from lwr_driver.session.session import stamp

_FIELDS = ("position", "velocity", "effort")
_JOINT_STATE = ("sensor_msgs/msg/JointState", "sensor_msgs/JointState")
_OWN_TOPICS = frozenset({"/motor_states", "/joint_command", "/experiment/phase", "/fri/status"})
_STRING = ("std_msgs/msg/String", "std_msgs/String")


def bag_files(path: Path) -> list[Path]:
    """The MCAP files of a bag in their order, or none if `path` is no bag."""
    if path.is_dir():
        parts = path.glob("*.mcap")
        return sorted(parts, key=lambda part: [int(n) for n in re.findall(r"\d+", part.stem)][-1:])
    return [path] if path.suffix == ".mcap" and path.is_file() else []


@dataclass(frozen=True)
class JointStates:
    """All messages of one topic with the same joints: `names` sorted; log_time, stamp (n,) int64 [ns].

    values : position, velocity and effort (n, joints) as far as recorded, and not zero throughout.
    """

    topic: str
    names: tuple[str, ...]
    log_time: Any
    stamp: Any
    values: dict[str, Floats]

    @property
    def clock(self) -> str:
        """`stamp`, the time of measurement, if every message has a later one than the last; else `log_time`."""
        good = self.stamp[0] > 0 and bool(np.all(np.diff(self.stamp) > 0))
        return "stamp" if good else "log_time"


@dataclass(frozen=True)
class Bag:
    """Joint states of a bag, those with most arrays and joints first, and its robot description, if recorded.

    is_session : whether it has topics or metadata of a session log.
    """

    path: Path
    states: tuple[JointStates, ...]
    robot_description: str | None
    is_session: bool

    def tables(self) -> dict[str, Table]:
        """Arrays `TOPIC/position`, `TOPIC/velocity`, `TOPIC/effort`, `TOPIC/stamp` and `TOPIC/log_time` [s].

        A second publisher on a topic has `TOPIC#2`, and so on.
        """
        found: dict[str, Table] = {}
        count: dict[str, int] = {}
        for group in self.states:
            number = count[group.topic] = count.get(group.topic, 0) + 1
            head = group.topic if number == 1 else f"{group.topic}#{number}"
            for name, values in group.values.items():
                found[f"{head}/{name}"] = Table(group.names, values)
            for name in ("stamp", "log_time"):
                found[f"{head}/{name}"] = Table(("1",), getattr(group, name)[:, None] * 1e-9)
        return found


def read_bag(path: Path) -> Bag:
    """Read the bag `path`. DataError for a damaged file, or one without joint states."""
    groups: dict[tuple[str, tuple[str, ...]], _Group] = {}
    description: str | None = None
    topics: dict[str, str] = {}
    described = False
    for file in bag_files(path):
        scan = Scan(file)
        layouts: dict[tuple[int, int], list[tuple[Layout, tuple[str, ...]]]] = {}
        for block in scan.blocks():
            for number in np.unique(block.channel).tolist():
                channel = scan.channels.get(number)
                kind = channel.schema.name if channel is not None and channel.schema is not None else ""
                if channel is None:
                    continue
                topics[channel.topic] = f"{kind} in {channel.encoding}" if channel.encoding != "cdr" else kind
                if channel.encoding != "cdr":
                    continue
                rows = np.flatnonzero(block.channel == number)
                if kind in _STRING and channel.topic.endswith("robot_description"):
                    description = CdrReader(block.message(int(rows[0]))).text()
                elif kind in _JOINT_STATE:
                    _take(file, channel, block, rows, layouts, groups)
        described |= any(name == "session" for name, _ in scan.metadata)
    if not groups:
        listed = ", ".join(f"{topic} ({kind})" for topic, kind in topics.items()) or "none"
        raise DataError(f"{path}: no messages of sensor_msgs/JointState in CDR (ROS 2); topics: {listed}")
    states = [group.states(topic, names) for (topic, names), group in groups.items()]
    states.sort(key=lambda group: (-len(group.values), -len(group.names), -len(group.log_time)))
    return Bag(path, tuple(states), description, described or not _OWN_TOPICS.isdisjoint(topics))


def _take(
    file: Path,
    channel: ChannelRecord,
    block: Block,
    rows: Any,
    layouts: dict[tuple[int, int], list[tuple[Layout, tuple[str, ...]]]],
    groups: dict[tuple[str, tuple[str, ...]], _Group],
) -> None:
    """Sort the messages `rows` of a block into their groups, all of one layout at a time."""
    sizes = block.sizes[rows]
    for size in np.unique(sizes).tolist():
        left = rows[sizes == size]
        known = layouts.setdefault((channel.number, size), [])
        tried = 0
        while len(left):
            if tried == len(known):
                where = f"{file}: {channel.topic} at {stamp(int(block.log_time[left[0]]))}"
                try:
                    known.append(read_joint_state_layout(block.message(int(left[0]))))
                except CdrError as error:
                    raise DataError(f"{where}: not a sensor_msgs/msg/JointState: {error}") from error
                names = known[-1][1]
                if len(set(names)) != len(names):
                    raise DataError(
                        f"{where}: joint names {', '.join(names)} repeat; each joint needs its own"
                    )
            layout, names = known[tried]
            tried += 1
            data = block.gather(left, size)
            fits = layout.matches(data)
            if fits.any() and names:
                key = (channel.topic, tuple(sorted(names)))
                groups.setdefault(key, _Group(f"{file}: {channel.topic}")).add(
                    block, left[fits], layout, layout.view(data[fits]), np.argsort(names)
                )
            left = left[~fits]


@dataclass
class _Group:
    place: str
    fields: tuple[str, ...] = ()
    parts: dict[str, list[Any]] = field(default_factory=dict)

    def add(self, block: Block, rows: Any, layout: Layout, records: Any, order: Any) -> None:
        fields = tuple(name for name in _FIELDS if name in layout.fields)
        if self.parts and fields != self.fields:
            raise DataError(
                f"{self.place} at {stamp(int(block.log_time[rows[0]]))}: {' and '.join(fields) or 'nothing'} "
                f"given, {' and '.join(self.fields) or 'nothing'} before; every message needs the same arrays"
            )
        self.fields = fields
        columns = {
            "log_time": block.log_time[rows],
            "stamp": records["sec"].astype(np.int64) * 10**9 + records["nanosec"],
            **{name: records[name].astype(np.float64)[:, order] for name in fields},
        }
        for name, part in columns.items():
            self.parts.setdefault(name, []).append(part)

    def states(self, topic: str, names: tuple[str, ...]) -> JointStates:
        joined = {name: np.concatenate(parts) for name, parts in self.parts.items()}
        order = np.argsort(joined["log_time"], kind="stable")
        return JointStates(
            topic,
            names,
            joined["log_time"][order],
            joined["stamp"][order],
            # Drivers fill what they do not measure with zeros.
            {name: joined[name][order] for name in self.fields if name == "position" or joined[name].any()},
        )
