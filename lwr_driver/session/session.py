"""A session log in memory: metadata, channels as columns of numpy arrays, phases, and missing samples."""

from __future__ import annotations

import dataclasses
import datetime
import difflib
import html
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fri.errors import ConfigurationError, DataError
from lwr_driver.notebook import optional, subplots

# Steps of a counter that by chance have hardly ever a common divisor.
_LEAST_STEPS = 16
_WIDEST = 120
"""Characters of a line of a `repr`."""


class Phase(NamedTuple):
    """Beginning of a phase of the experiment: log time [ns] and name."""

    log_time: int
    name: str


class Gap(NamedTuple):
    """Lost samples before row `row`: their number, and the log times of the rows before and after [ns]."""

    row: int
    lost: int
    before: int
    after: int


@dataclass(frozen=True, repr=False)
class JointColumns:
    """One channel of joint states, n samples of J joints, in the order of the file.

    log_time, publish_time : (n,) int64, host time and the source's time [ns]
    sequence : (n,) int64, counter of the source; a gap is a lost sample
    position [rad], velocity [rad/s], effort [Nm] : (n, J) float64, or (n, 0) if the channel has none
    source : file, for messages
    """

    topic: str
    names: tuple[str, ...]
    log_time: NDArray[np.int64]
    publish_time: NDArray[np.int64]
    sequence: NDArray[np.int64]
    position: NDArray[np.float64]
    velocity: NDArray[np.float64]
    effort: NDArray[np.float64]
    source: str = ""

    def __len__(self) -> int:
        return len(self.log_time)

    def __repr__(self) -> str:
        rate, lost = pace(self.log_time)[0], f", {self.lost} lost" if self.lost else ""
        return f"{self.topic}: {len(self)} samples at {rate:.1f} Hz{lost} ({', '.join(self.held)})"

    @property
    def held(self) -> tuple[str, ...]:
        """Names of the fields with values."""
        return tuple(name for name in ("position", "velocity", "effort") if getattr(self, name).shape[1])

    @property
    def numbered(self) -> bool:
        """Whether the source counts its samples; a constant zero is no counter."""
        return bool(self.sequence.any())

    @property
    def counts(self) -> NDArray[np.int64] | None:
        """Number (n,) of each sample by the counter, None without one. Where every k-th sample of the source is
        recorded, these are counted and none is lost in between."""
        if not self.numbered:
            return None
        steps = np.diff(self.sequence)
        stride = int(np.gcd.reduce(steps)) if len(steps) >= _LEAST_STEPS else 1
        return self.sequence // max(stride, 1)

    @property
    def gaps(self) -> tuple[Gap, ...]:
        """Lost samples by the counter of the source; empty without a counter."""
        counts = self.counts
        if counts is None:
            return ()
        steps = np.diff(counts)
        return tuple(
            Gap(int(row) + 1, int(steps[row]) - 1, int(self.log_time[row]), int(self.log_time[row + 1]))
            for row in np.flatnonzero(steps > 1)
        )

    @property
    def lost(self) -> int:
        """Number of lost samples between the first and the last."""
        return sum(gap.lost for gap in self.gaps)

    @property
    def period_s(self) -> float:
        """Median time between samples by the clock of the source, else of the host [s]."""
        if len(self) < 2:
            return float("nan")
        times = self.publish_time if np.ptp(self.publish_time) > 0 else self.log_time
        return float(np.median(np.diff(times))) * 1e-9

    def select(self, names: Sequence[str]) -> JointColumns:
        """The same samples with the joints `names` in this order; DataError for an unknown joint."""
        wanted = tuple(names)
        if wanted == self.names:
            return self
        for name in wanted:
            if name not in self.names:
                near = difflib.get_close_matches(name, self.names, n=1)
                advice = f"did you mean {near[0]!r}?" if near else f"it has {', '.join(self.names)}"
                raise DataError(
                    f"{self.source}: {self.topic} at {stamp(self.log_time)} has no joint {name!r}; {advice}"
                )
        columns = [self.names.index(name) for name in wanted]
        picked = {name: getattr(self, name)[:, columns] for name in self.held}
        return dataclasses.replace(self, names=wanted, **picked)

    def rows(self, start: int, stop: int) -> JointColumns:
        """The samples with `start` <= log time < `stop` [ns]."""
        low, high = np.searchsorted(self.log_time, [start, stop], side="left")
        fields = ("log_time", "publish_time", "sequence", "position", "velocity", "effort")
        return dataclasses.replace(
            self, **{name: getattr(self, name)[int(low) : int(high)] for name in fields}
        )


@dataclass(frozen=True)
class StatusColumns:
    """The channel `/fri/status`, n cycles; names and units as in `lwr_msgs/msg/FriStatus`."""

    log_time: NDArray[np.int64]
    publish_time: NDArray[np.int64]
    state: NDArray[np.uint16]
    quality: NDArray[np.uint16]
    sequence: NDArray[np.uint32]
    sample_time: NDArray[np.float64]
    answer_rate: NDArray[np.float32]
    latency: NDArray[np.float32]
    jitter: NDArray[np.float32]
    miss_rate: NDArray[np.float32]
    miss_counter: NDArray[np.uint32]
    power: NDArray[np.uint16]
    control: NDArray[np.uint16]
    error: NDArray[np.uint16]
    warning: NDArray[np.uint16]
    temperature: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.log_time)


@dataclass(frozen=True)
class ControllerModelColumns:
    """The channel `/fri/controller_model`: n samples of the controller's own model, float64.

    mass_matrix (n, 7, 7) [kg m2], gravity (n, 7) [Nm], jacobian (n, 6, 7), estimated_external_torque (n, 7)
    [Nm]
    """

    log_time: NDArray[np.int64]
    publish_time: NDArray[np.int64]
    mass_matrix: NDArray[np.float64]
    gravity: NDArray[np.float64]
    jacobian: NDArray[np.float64]
    estimated_external_torque: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.log_time)


def stamp(times: NDArray[np.int64] | int) -> str:
    """A log time, or the first of an array, in seconds for a message."""
    if isinstance(times, np.ndarray):
        if not len(times):
            return "(empty)"
        times = int(times[0])
    return f"t = {times // 10**9}.{times % 10**9:09d} s"


@dataclass(frozen=True)
class Missing:
    """Missing parts of a session; false if it is whole.

    ended : the recorder wrote `session_end`; true for a file of another program, which has none
    closed : the file has its summary and footer
    bytes_unread : bytes behind the last readable record
    lost_from, lost_to : log times of a truncated chunk, if its head is readable [ns]
    samples : lost samples of each topic by the counters of the source
    notes : further remarks, each a sentence
    """

    ended: bool = True
    closed: bool = True
    bytes_unread: int = 0
    lost_from: int | None = None
    lost_to: int | None = None
    samples: Mapping[str, int] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def __bool__(self) -> bool:
        return not (self.ended and self.closed and not self.bytes_unread and not any(self.samples.values()))

    @property
    def lines(self) -> tuple[str, ...]:
        """One sentence for each missing part."""
        lines = []
        if not self.ended:
            lines.append(
                "the recorder died: there is no session_end; up to one open chunk (0.5 s) was never written"
            )
        elif not self.closed:
            lines.append("the file has no footer")
        if self.bytes_unread:
            lines.append(f"{self.bytes_unread} bytes at the end of the file are not whole and were not read")
        if self.lost_from is not None and self.lost_to is not None:
            seconds = (self.lost_to - self.lost_from) * 1e-9
            lines.append(f"the truncated chunk spans {seconds:.3f} s of log time")
        lines += [f"{topic}: {count} samples lost" for topic, count in self.samples.items() if count]
        return (*lines, *self.notes)

    def __str__(self) -> str:
        return "; ".join(self.lines) or "nothing"


@dataclass(frozen=True, repr=False)
class Session:
    """One motion of the arm with one payload.

    metadata : the record `session`, empty in a file of another program; end : the record `session_end`, None there
        and if the recorder died
    joint_names : joints of `/joint_states` in its order; the other channels keep this order
    joint : `/joint_states`; motor, command : `/motor_states` and `/joint_command`, None if absent
    phases : beginnings of phases; empty if the whole session is one
    attachments : file name -> content
    """

    path: Path
    metadata: Mapping[str, str]
    end: Mapping[str, str] | None
    joint_names: tuple[str, ...]
    joint: JointColumns
    motor: JointColumns | None = None
    command: JointColumns | None = None
    phases: tuple[Phase, ...] = ()
    status: StatusColumns | None = None
    controller_model: ControllerModelColumns | None = None
    robot_description: str | None = None
    attachments: Mapping[str, bytes] = field(default_factory=dict)
    missing: Missing = field(default_factory=Missing)

    @property
    def encoder(self) -> str | None:
        """`motor` if the metadata say that the positions come from before the gear, None if they do not say."""
        return self.metadata.get("encoder")

    def __repr__(self) -> str:
        data = self.metadata
        duration = f"{self.duration_s:.3f} s" if len(self.joint) else "empty"
        recorded = f"{clock_text(data, utc_text(self.start))}, {duration}" if len(self.joint) else duration
        phases = ", ".join(dict.fromkeys(phase.name.split()[0] for phase in self.phases if phase.name))
        lines = [
            f"Session {self.path}",
            f"  robot     {data.get('robot', 'unknown')} {data.get('serial', '')}".rstrip(),
            f"  payload   {payload_text(data)}",
            f"  recorded  {recorded}",
            f"  joints    {' '.join(self.joint_names)}",
            *(f"  channel   {item!r}" for item in (self.joint, self.motor, self.command) if item is not None),
            f"  phases    {len(self.phases)}{f': {phases}' if phases else ''}",
            f"  missing   {self.missing}",
        ]
        return "\n".join(line if len(line) <= _WIDEST else f"{line[: _WIDEST - 3]}..." for line in lines)

    def _repr_html_(self) -> str:
        return f"<pre>{html.escape(repr(self))}</pre>"

    def to_dataframe(self, topic: str = "/joint_states") -> Any:
        """A channel of joints as a pandas DataFrame, one row per sample.

        topic : `/joint_states`, `/motor_states` or `/joint_command`

        The index is log time since the first joint state [s]; the columns are `position_JOINT` [rad],
        `velocity_JOINT` [rad/s] and `effort_JOINT` [Nm], as far as the channel holds them.
        ConfigurationError for an absent channel, or without pandas.
        """
        channels = {item.topic: item for item in (self.joint, self.motor, self.command) if item is not None}
        if topic not in channels:
            raise ConfigurationError(
                f"{self.path}: no channel {topic!r}; choose one of {', '.join(channels)}"
            )
        pandas = optional("pandas", "Session: to_dataframe()", "the arrays of `session.joint`")
        channel = channels[topic]
        columns = {
            f"{field}_{name}": getattr(channel, field)[:, column]
            for field in channel.held
            for column, name in enumerate(channel.names)
        }
        time = pandas.Index((channel.log_time - self.start) * 1e-9, name="time_s")
        return pandas.DataFrame(columns, index=time)

    def plot(self) -> Any:
        """Positions, joint and motor torques over time; the matplotlib Axes, one for each channel with values."""
        panels = [("position [rad]", self.joint, self.joint.position)]
        if self.joint.effort.shape[1]:
            panels.append(("joint torque [Nm]", self.joint, self.joint.effort))
        if self.motor is not None:
            panels.append(("motor torque [Nm]", self.motor, self.motor.effort))
        axes = subplots(len(panels), sharex=True, figsize=(8.0, 2.2 * len(panels)))
        for axis, (label, channel, values) in zip(axes, panels, strict=True):
            for name, column in zip(channel.names, values.T, strict=True):
                axis.plot((channel.log_time - self.start) * 1e-9, column, linewidth=0.8, label=name)
            axis.set_ylabel(label)
        axes[0].set_title(f"{self.path.name}, payload {payload_text(self.metadata)}", fontsize="medium")
        axes[0].legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize="small")
        axes[-1].set_xlabel("time [s]")
        return axes

    @property
    def start(self) -> int:
        """Log time of the first joint state [ns]."""
        return int(self.joint.log_time[0])

    @property
    def duration_s(self) -> float:
        """Log time from the first joint state to the last [s]."""
        return float(self.joint.log_time[-1] - self.joint.log_time[0]) * 1e-9

    def select(self, joint_names: Sequence[str]) -> Session:
        """This session with only the joints `joint_names`, in this order, in all channels.

        DataError for a joint missing in a channel.
        """
        names = tuple(joint_names)
        if not names or len(set(names)) != len(names):
            raise DataError(
                f"{self.path}: joints asked for are {', '.join(names) or 'none'}; each once, one at least"
            )
        return dataclasses.replace(
            self,
            joint_names=names,
            joint=self.joint.select(names),
            motor=None if self.motor is None else self.motor.select(names),
            command=None if self.command is None else self.command.select(names),
        )

    def spans(self, name: str) -> tuple[tuple[int, int], ...]:
        """[start, stop) log times [ns] of every phase `name` or `name N`."""
        stops = [*(phase.log_time for phase in self.phases[1:]), int(self.joint.log_time[-1]) + 1]
        return tuple(
            (phase.log_time, stop)
            for phase, stop in zip(self.phases, stops, strict=False)
            if phase.name == name or phase.name.startswith(name + " ")
        )


def payload_text(metadata: Mapping[str, str]) -> str:
    """Name and mass of the payload."""
    mass = f", {metadata['payload_mass']} kg" if metadata.get("payload_mass") else ""
    return f"{metadata.get('payload', 'unknown')}{mass}"


def clock_text(metadata: Mapping[str, str], utc: str) -> str:
    """A time, unless it is that of an emulator in lock step: its clock starts with the year 2020."""
    emulated = metadata.get("utc_start", "").startswith("2020-01-01T00:00:00")
    return "emulated clock" if emulated else utc


def utc_text(log_time: int) -> str:
    """A log time [ns] as date and time of day."""
    first = datetime.datetime.fromtimestamp(log_time / 1e9, datetime.UTC)
    return first.strftime("%Y-%m-%d %H:%M:%S.%f UTC")


def pace(log_time: NDArray[np.int64]) -> tuple[float, float]:
    """Median rate of the samples [Hz] and longest pause between two of them [s]."""
    steps = np.diff(log_time) * 1e-9
    rate = float(1.0 / np.median(steps)) if len(steps) and np.median(steps) > 0 else 0.0
    return rate, float(steps.max()) if len(steps) else 0.0
