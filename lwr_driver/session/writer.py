"""Writing a session log from columns of numpy arrays.

Used by the recorder and by the import of foreign recordings. Messages are collected by topic and written as
chunks of 0.5 s of log time. So the bytes of a log depend on the samples alone, not on their arrival.
"""

from __future__ import annotations

import contextlib
import datetime
import uuid
from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fri.errors import ConfigurationError, DataError
from lwr_driver.arm import LinkFrames
from lwr_driver.configuration import as_path
from lwr_driver.session.container import Container, Messages, record_layout
from lwr_driver.session.messages import (
    TOPICS,
    Layout,
    LayoutBuilder,
    fixed_layout,
    joint_state_layout,
    tf_layout,
)
from lwr_driver.session.session import stamp

CHUNK_PERIOD_S = 0.5
SLOW_PERIOD_NS = 20_000_000
"""Period of the slow channels: 50 Hz."""

SCHEMA_VERSION = "1"
LIBRARY = "lwr-identification"

ExitStatus = Literal["success", "abort", "fail"]

_MEDIA_TYPES = {
    ".yaml": "application/yaml",
    ".urdf": "application/xml",
    ".npz": "application/octet-stream",
    ".json": "application/json",
}
_LATEST_NS = 2**31 * 10**9


def session_metadata(
    *,
    robot: str,
    serial: str = "",
    payload: str = "none",
    payload_mass: float | None = None,
    experiment: str = "",
    uid: str | None = None,
    parent_uid: str = "",
    motor_torque_source: str = "none",
    software: str = LIBRARY,
    git_commit: str = "",
    utc_start: str | None = None,
    **more: str,
) -> dict[str, str]:
    """The metadata record `session`, complete.

    uid, utc_start : from chance and from the clock if None; give both for logs equal bit for bit
    payload_mass : [kg]; more : further keys, such as the source of imported data
    """
    values = {
        "schema_version": SCHEMA_VERSION,
        "robot": robot,
        "serial": serial,
        "payload": payload,
        "experiment": experiment,
        "uid": uuid.uuid4().hex if uid is None else uid,
        "parent_uid": parent_uid,
        "motor_torque_source": motor_torque_source,
        "software": software,
        "git_commit": git_commit,
        "utc_start": datetime.datetime.now(datetime.UTC).isoformat() if utc_start is None else utc_start,
        **more,
    }
    if payload_mass is not None:
        values["payload_mass"] = repr(float(payload_mass))
    return values


class SessionWriter:
    """Writes one session. A context manager; an exception within ends the session with status `fail`.

    path : the new file; an existing one is never overwritten
    joint_names : joints of all columns, as in the URDF; any number
    metadata : the record `session`, see `session_metadata`
    robot_description : URDF text for `/robot_description`, the attachment `robot.urdf`, and `/tf`
    attachments : file name -> content, written first
    start_ns : log time of the attachments [ns]
    fsync : force each chunk to the disk

    Log times of a topic must be strictly increasing (DataError otherwise). Every `write_...` takes arrays
    with n rows; `publish_time` defaults to the log time, `sequence` to a running count. `advance` writes all
    whole chunks before a time. ConfigurationError if the file cannot be created, DataError if it cannot be
    continued (disk full).
    """

    def __init__(
        self,
        path: str | Path,
        joint_names: Sequence[str],
        metadata: Mapping[str, str],
        *,
        robot_description: str | None = None,
        attachments: Mapping[str, bytes] | None = None,
        start_ns: int = 0,
        fsync: bool = False,
    ) -> None:
        self.path = as_path(path, "session log")
        self.joint_names = tuple(joint_names)
        if not self.joint_names or len(set(self.joint_names)) != len(self.joint_names):
            raise ConfigurationError(
                f"session log {path}: joint names {self.joint_names} must be different, one at least"
            )
        for key, value in metadata.items():
            if not isinstance(key, str) or not isinstance(value, str):
                raise ConfigurationError(
                    f"session log {path}: metadata {key!r} is {value!r}; it must be a text"
                )
        self.missed = 0
        self.closed = False
        self._failure: DataError | None = None
        self._last_sequence: int | None = None
        self._period_ns = round(CHUNK_PERIOD_S * 1e9)
        self._frames = None if robot_description is None else LinkFrames(robot_description)
        self._description = robot_description
        self._layouts: dict[object, Layout] = {}
        self._queues: dict[int, deque[tuple[NDArray[np.int64], NDArray[np.uint8]]]] = {}
        self._last: dict[str, int] = {}
        self._counts: dict[str, int] = {}
        self._slow_bucket: dict[str, int] = {}
        self._container = Container(self.path, library=LIBRARY, fsync=fsync)
        try:
            # All numbers are fixed beforehand, independent of the first message.
            for topic, schema in TOPICS.items():
                self._container.channel(topic, schema)
            self._container.describe("session", metadata)
            files = dict(attachments or {})
            if robot_description is not None:
                files.setdefault("robot.urdf", robot_description.encode())
            for name, data in files.items():
                media_type = _MEDIA_TYPES.get(Path(name).suffix, "application/octet-stream")
                self._container.attach(name, data, media_type, start_ns)
        except BaseException:
            self._container.abandon()
            self.path.unlink(missing_ok=True)
            raise

    def write_joint_states(
        self,
        log_time: ArrayLike,
        position: ArrayLike,
        effort: ArrayLike | None = None,
        *,
        velocity: ArrayLike | None = None,
        publish_time: ArrayLike | None = None,
        sequence: ArrayLike | None = None,
    ) -> None:
        """Measured joint positions [rad] and joint torque sensors [Nm], (n, J) each."""
        arrays = {"position": position, "velocity": velocity, "effort": effort}
        numbers = self._joint_states("/joint_states", log_time, arrays, publish_time, sequence)
        if len(numbers):
            before = numbers[0] - 1 if self._last_sequence is None else self._last_sequence
            self.missed += int(np.maximum(np.diff(numbers, prepend=before) - 1, 0).sum())
            self._last_sequence = int(numbers[-1])

    def write_motor_states(
        self,
        log_time: ArrayLike,
        effort: ArrayLike,
        position: ArrayLike | None = None,
        *,
        publish_time: ArrayLike | None = None,
        sequence: ArrayLike | None = None,
    ) -> None:
        """Motor torques referred to the joint side [Nm], (n, J), and motor positions referred to it [rad]."""
        arrays = {"position": position, "velocity": None, "effort": effort}
        self._joint_states("/motor_states", log_time, arrays, publish_time, sequence)

    def write_joint_command(
        self,
        log_time: ArrayLike,
        position: ArrayLike,
        *,
        publish_time: ArrayLike | None = None,
        sequence: ArrayLike | None = None,
    ) -> None:
        """Commanded joint positions [rad], (n, J), at the times of their cycles."""
        arrays = {"position": position, "velocity": None, "effort": None}
        self._joint_states("/joint_command", log_time, arrays, publish_time, sequence)

    def write_phase(self, log_time: int, name: str, *, publish_time: int | None = None) -> None:
        """Beginning of the phase `name`."""
        self._write_text("/experiment/phase", log_time, name, publish_time)

    def write_status(
        self,
        log_time: ArrayLike,
        columns: Mapping[str, Any],
        *,
        publish_time: ArrayLike | None = None,
        sequence: ArrayLike | None = None,
    ) -> None:
        """State and statistics of the FRI session; `columns` are the fields of `FriStatus`, n rows each."""
        self._add_fixed("/fri/status", log_time, columns, publish_time, sequence)

    def write_controller_model(
        self,
        log_time: ArrayLike,
        *,
        mass_matrix: ArrayLike,
        gravity: ArrayLike,
        jacobian: ArrayLike,
        estimated_external_torque: ArrayLike,
        publish_time: ArrayLike | None = None,
        sequence: ArrayLike | None = None,
    ) -> None:
        """The controller's own model: (n, 7, 7) [kg m2], (n, 7) [Nm], (n, 6, 7), (n, 7) [Nm]."""
        times = np.atleast_1d(np.asarray(log_time, dtype=np.int64))
        columns = {
            "mass_matrix": np.asarray(mass_matrix).reshape(len(times), 49),
            "gravity": gravity,
            "jacobian": np.asarray(jacobian).reshape(len(times), 42),
            "estimated_external_torque": estimated_external_torque,
        }
        self._add_fixed("/fri/controller_model", times, columns, publish_time, sequence)

    def write_link_frames(
        self, log_time: ArrayLike, position: ArrayLike, *, publish_time: ArrayLike | None = None
    ) -> None:
        """Link frames at the joint positions (n, J) [rad]; nothing without a robot description.

        All rows are written; `slow` selects the rows for 50 Hz.
        """
        if self._frames is None:
            return
        pairs = self._frames.pairs
        poses = self._frames.poses(self.joint_names, np.atleast_2d(np.asarray(position, dtype=np.float64)))
        times = np.atleast_1d(np.asarray(log_time, dtype=np.int64))
        columns: dict[str, Any] = {f"pose_{index}": poses[:, index] for index in range(len(pairs))}
        for index in range(len(pairs)):
            columns[f"{index}_sec"], columns[f"{index}_nanosec"] = times // 10**9, times % 10**9
        self._add("/tf", pairs, lambda: tf_layout(pairs), times, columns, publish_time, None)

    def slow(self, topic: str, publish_time: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Rows for a 50 Hz topic, as a mask: the first of every 20 ms of the source's clock, across calls."""
        buckets = publish_time // SLOW_PERIOD_NS
        previous = self._slow_bucket.get(topic)
        taken = np.empty(len(buckets), dtype=bool)
        if len(buckets):
            taken[0] = previous is None or buckets[0] != previous
            taken[1:] = buckets[1:] != buckets[:-1]
            self._slow_bucket[topic] = int(buckets[-1])
        return taken

    def advance(self, log_time: int) -> None:
        """Write all chunks ending at or before `log_time`: no earlier message may follow."""
        self._emit(log_time // self._period_ns * self._period_ns)

    def close(
        self, exit_status: ExitStatus = "success", reason: str = "", more: Mapping[str, str] | None = None
    ) -> None:
        """Write the rest, the record `session_end` and the summary; a second call has no effect.

        After a failed write (disk full) the file ends behind its last whole chunk, with exit status `fail`.
        DataError if the rest, or even the end, cannot be written.
        """
        if self.closed:
            return
        self.closed = True
        known = self._failure
        with contextlib.suppress(DataError):
            self._emit(None)
        if self._failure is not None:
            exit_status, reason = "fail", reason or str(self._failure)
        end = {
            "exit_status": exit_status,
            "reason": reason,
            "samples": str(self.samples),
            "missed": str(self.missed),
            **(more or {}),
        }
        try:
            self._container.describe("session_end", end)
            self._container.finish()
        except DataError:
            self._container.abandon()
            raise
        if self._failure is not known and self._failure is not None:
            raise self._failure

    def abandon(self) -> None:
        """Close the file without an end, as a crash would."""
        self.closed = True
        self._container.abandon()

    @property
    def samples(self) -> int:
        """Joint states in the file; before `close` those in whole chunks."""
        return self._container.count("/joint_states")

    def __enter__(self) -> SessionWriter:
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if error is None:
            self.close()
        else:
            self.close("abort" if isinstance(error, KeyboardInterrupt) else "fail", str(error) or repr(error))

    def _joint_states(
        self,
        topic: str,
        log_time: ArrayLike,
        arrays: Mapping[str, ArrayLike | None],
        publish_time: ArrayLike | None,
        sequence: ArrayLike | None,
    ) -> NDArray[np.int64]:
        columns: dict[str, Any] = {}
        for field, values in arrays.items():
            if values is not None:
                array = np.atleast_2d(np.asarray(values, dtype=np.float64))
                if array.shape[1:] == (0,):
                    continue
                if array.shape[1:] != (len(self.joint_names),):
                    raise DataError(
                        f"session log {self.path}: {topic} `{field}` has shape {array.shape}; "
                        f"it must be (n, {len(self.joint_names)}), a column for each joint"
                    )
                columns[field] = array
        present = {field: field in columns for field in ("position", "velocity", "effort")}
        return self._add(
            topic,
            (self.joint_names, *present.values()),
            lambda: joint_state_layout(self.joint_names, **present),
            log_time,
            columns,
            publish_time,
            sequence,
        )

    def _write_text(self, topic: str, log_time: int, value: str, publish_time: int | None) -> None:
        self._add(
            topic, value, lambda: LayoutBuilder().text(value).layout(), log_time, {}, publish_time, None
        )

    def _add_fixed(self, topic: str, *arguments: Any) -> None:
        self._add(topic, topic, lambda: fixed_layout(TOPICS[topic]), *arguments)

    def _add(
        self,
        topic: str,
        key: object,
        build: Any,
        log_time: ArrayLike,
        columns: Mapping[str, Any],
        publish_time: ArrayLike | None,
        sequence: ArrayLike | None,
    ) -> NDArray[np.int64]:
        if self._failure is not None:
            raise self._failure
        times = np.atleast_1d(np.asarray(log_time, dtype=np.int64))
        count = len(times)
        done = self._counts.get(topic, 0)
        published = times if publish_time is None else np.atleast_1d(np.asarray(publish_time, dtype=np.int64))
        numbers = np.arange(done, done + count) if sequence is None else np.atleast_1d(np.asarray(sequence))
        numbers = numbers.astype(np.int64, copy=False)
        lengths = {name: len(np.atleast_1d(values)) for name, values in columns.items()}
        lengths |= {"publish_time": len(published), "sequence": len(numbers)}
        for name, length in lengths.items():
            if length != count:
                raise DataError(
                    f"session log {self.path}: {topic} `{name}` has {length} rows for {count} log times"
                )
        if not count:
            return numbers
        self._check_times(topic, times)
        if published.min() < 0 or numbers.min() < 0 or numbers.max() >= 2**32:
            raise DataError(
                f"session log {self.path}: {topic} has publish times from {published.min()} ns and "
                f"sequence numbers {numbers.min()} to {numbers.max()}; both count from 0, "
                f"sequence numbers up to {2**32 - 1}"
            )
        number = self._container.channel(topic, TOPICS[topic])
        layout_key = (topic, key)
        if layout_key not in self._layouts:
            self._layouts[layout_key] = record_layout(build(), number)
        layout = self._layouts[layout_key]
        values = {"channel_sequence": numbers, "log_time": times, "publish_time": published, **columns}
        if "sec" in layout.fields:
            values["sec"], values["nanosec"] = times // 10**9, times % 10**9
        self._queues.setdefault(number, deque()).append((times, layout.pack(values, count)))
        self._counts[topic] = done + count
        return numbers

    def _check_times(self, topic: str, times: NDArray[np.int64]) -> None:
        steps = np.diff(times, prepend=self._last.get(topic, times[0] - 1))
        if (steps <= 0).any():
            row = int(np.flatnonzero(steps <= 0)[0])
            before = int(times[row] - steps[row])
            raise DataError(
                f"session log {self.path}: {topic} at {stamp(int(times[row]))} follows {stamp(before)}; "
                "log times must be strictly increasing"
            )
        if times[0] < 0 or times[-1] >= _LATEST_NS:
            raise DataError(
                f"session log {self.path}: {topic} at {stamp(int(times[0]))} to {stamp(int(times[-1]))}; "
                "log times are UTC from 1970 to 2038"
            )
        self._last[topic] = int(times[-1])

    def _emit(self, boundary: int | None) -> None:
        """Write the chunks of all windows ending at or before `boundary`; all of them if None."""
        while True:
            heads = [int(queue[0][0][0]) for queue in self._queues.values() if queue]
            if not heads:
                return
            stop = (min(heads) // self._period_ns + 1) * self._period_ns
            if boundary is not None and stop > boundary:
                return
            if self._description is not None:
                description, self._description = self._description, None
                self._write_text("/robot_description", min(heads), description, None)
            messages = self._take(stop)
            try:
                self._container.write_chunk(messages)
            except DataError as error:
                # Later chunks would stand behind a gap.
                self._failure = error
                self._queues.clear()
                raise

    def _take(self, stop: int) -> Messages:
        """Take all messages before `stop` off the queues, in order of log time."""
        records: list[bytes] = []
        channels: list[NDArray[np.int64]] = []
        times: list[NDArray[np.int64]] = []
        for number, queue in sorted(self._queues.items()):
            while queue and queue[0][0][0] < stop:
                log_time, rows = queue.popleft()
                count = int(np.searchsorted(log_time, stop, side="left"))
                if count < len(log_time):
                    queue.appendleft((log_time[count:], rows[count:]))
                size = rows.shape[1]
                raw = rows[:count].tobytes()
                records += [raw[start : start + size] for start in range(0, len(raw), size)]
                channels.append(np.full(count, number, dtype=np.int64))
                times.append(log_time[:count])
        log_times = np.concatenate(times)
        order = np.argsort(log_times, kind="stable")
        return Messages(
            [records[row] for row in order.tolist()], np.concatenate(channels)[order], log_times[order]
        )
