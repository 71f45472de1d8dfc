"""From a recording and its mapping to a session log: reading, conversion to SI at the joint, checks, writing.

Recordings are CSV (any delimiter, with or without header) or NPZ files; incomplete ones are refused.
"""

from __future__ import annotations

import datetime
import hashlib
import zipfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray

from fri.errors import ConfigurationError, DataError
from ident.import_log.mapping import Floats, LogMapping, Signal, TimeBase
from ident.import_log.read_back import check_written
from lwr_driver.configuration import find
from lwr_driver.session import SessionWriter, session_metadata


@dataclass
class ImportedRecording:
    """The files of a recording, each read once.

    source : a file, or the folder of the files named in the mapping.
    """

    source: Path
    delimiter: str | None = None
    header: bool = True
    _tables: dict[Path, tuple[tuple[str, ...], Floats]] = field(default_factory=dict, repr=False)
    _archives: dict[Path, dict[str, Floats]] = field(default_factory=dict, repr=False)
    _digests: dict[Path, str] = field(default_factory=dict, repr=False)

    def path(self, file: str | None) -> Path:
        """The file named by a signal, or the source itself."""
        if file is None:
            if self.source.is_dir():
                raise DataError(
                    f"{self.source} is a folder and the mapping names no `file`; give the file itself"
                )
            path = self.source
        else:
            path = (self.source if self.source.is_dir() else self.source.parent) / file
        if not path.is_file():
            raise DataError(f"{path}: no such file; the mapping needs it")
        return path

    @property
    def digests(self) -> dict[str, str]:
        """SHA-256 of every file read, by name."""
        return {path.name: digest for path, digest in self._digests.items()}

    def column(self, file: str | None, column: str | int) -> Floats:
        """One column (n,), or one-dimensional NPZ array."""
        path = self.path(file)
        if path.suffix == ".npz":
            values = self._array(path, str(column))
            values = values.reshape(-1) if values.ndim == 2 and 1 in values.shape else values
            if values.ndim != 1:
                raise DataError(
                    f"{path}: array {column!r} has shape {values.shape}; times are one-dimensional"
                )
            return values
        names, values = self._table(path)
        return values[:, _number(path, names, column)]

    def columns(self, signal: Signal, joints: int, what: str) -> Floats:
        """The columns (n, joints) of a signal, as they stand in the file."""
        path = self.path(signal.file)
        if path.suffix == ".npz":
            if signal.array is None:
                raise DataError(f"{path}: `{what}` needs `array`, the name of the array in the archive")
            values = self._array(path, signal.array)
            label = f"{path}: array {signal.array!r}"
            names = tuple(str(k + 1) for k in range(values.shape[-1]))
        else:
            if signal.array is not None:
                raise DataError(
                    f"{path}: `{what}` names the array {signal.array!r}, but the file is no NPZ archive"
                )
            names, values = self._table(path)
            label = str(path)
        if values.ndim != 2:
            raise DataError(
                f"{label} has shape {values.shape}; rows of samples with a column for each joint are needed"
            )
        if signal.columns is not None:
            return values[:, [_number(path, names, column) for column in signal.columns]]
        if values.shape[1] != joints:
            raise DataError(
                f"{label} has {values.shape[1]} columns for {joints} joints; "
                f"name them in `columns` of `{what}`"
            )
        return values

    def _array(self, path: Path, name: str) -> Floats:
        if path not in self._archives:
            self._digest(path)
            try:
                with np.load(path, allow_pickle=False) as archive:
                    self._archives[path] = {key: archive[key] for key in archive.files}
            except (OSError, ValueError, zipfile.BadZipFile, EOFError) as error:
                raise DataError(f"{path}: not a readable NPZ archive: {error}") from error
        arrays = self._archives[path]
        if name not in arrays:
            raise DataError(f"{path}: no array {name!r}; it has {', '.join(arrays)}")
        values = arrays[name]
        if values.dtype.kind not in "fiu":
            raise DataError(f"{path}: array {name!r} has type {values.dtype}; numbers are needed")
        return values.astype(np.float64)

    def _table(self, path: Path) -> tuple[tuple[str, ...], Floats]:
        if path not in self._tables:
            self._digest(path)
            self._tables[path] = _read_csv(path, self.delimiter, self.header)
        return self._tables[path]

    def _digest(self, path: Path) -> None:
        try:
            self._digests[path] = hashlib.sha256(path.read_bytes()).hexdigest()
        except OSError as error:
            raise DataError(f"{path}: cannot be read: {error.strerror}") from error


def _number(path: Path, names: tuple[str, ...], column: str | int) -> int:
    if isinstance(column, int):
        if not 1 <= column <= len(names):
            raise DataError(f"{path}: no column {column}; columns are numbered 1 to {len(names)}")
        return column - 1
    if names.count(column) > 1:
        raise DataError(f"{path}: {names.count(column)} columns are called {column!r}; name them by number")
    if column not in names:
        raise DataError(f"{path}: no column {column!r}; it has {', '.join(names)}")
    return names.index(column)


def _read_csv(path: Path, delimiter: str | None, header: bool) -> tuple[tuple[str, ...], Floats]:
    """Column names (numbers from 1 without a header) and the values (n, m) of a text table."""
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: not readable as text: {error}") from error
    rows = [
        (number, line) for number, line in enumerate(lines, 1) if line.strip() and line.lstrip()[0] != "#"
    ]
    if len(rows) < 1 + header:
        raise DataError(f"{path}: holds no rows of numbers")
    first = rows[0][1]
    found = next((m for m in (",", ";", "\t") if m in first.strip()), None)
    mark = found if delimiter is None else delimiter
    names: tuple[str, ...] = ()
    if header:
        names = tuple(_split(first, mark))
        rows = rows[1:]
        if all(_is_number(name) for name in names):
            raise DataError(
                f"{path}: the first row {first[:60]!r} holds numbers, no names; set `header: false`"
            )
    width = len(names) if header else len(_split(first, mark))
    values = _fast(path, rows, mark, width)
    if values is None:
        values = np.empty((len(rows), width))
        for index, (number, line) in enumerate(rows):
            values[index] = _row(path, number, _split(line, mark), width, names)
    return names or tuple(str(k + 1) for k in range(width)), values


def _fast(path: Path, rows: list[tuple[int, str]], mark: str | None, width: int) -> Floats | None:
    """The table by numpy's own reader; None unless every row is a plain row of numbers."""
    try:
        values = np.loadtxt(
            [line.strip().rstrip(mark or " ") for _, line in rows], delimiter=mark, ndmin=2, comments=None
        )
    except ValueError:
        return None
    return values if values.shape == (len(rows), width) else None


def _split(line: str, mark: str | None) -> list[str]:
    parts = [part.strip().strip('"') for part in line.strip().split(mark)]
    return parts[:-1] if len(parts) > 1 and parts[-1] == "" else parts


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _row(path: Path, number: int, parts: list[str], width: int, names: tuple[str, ...]) -> list[float]:
    if len(parts) != width:
        raise DataError(
            f"{path}: line {number} has {len(parts)} columns, the first has {width}; the file is not whole"
        )
    values = []
    for index, part in enumerate(parts):
        if not _is_number(part):
            column = names[index] if names else str(index + 1)
            shown = "is empty" if not part else f"holds {part!r}"
            raise DataError(f"{path}: line {number}, column {column!r} {shown}; a number is needed")
        values.append(float(part))
    return values


_ONCE = ("position", "velocity", "joint_torque")


@dataclass(frozen=True)
class ImportReport:
    """Result of an import; prints itself.

    rows : samples written of each topic. rows_in_source : samples of the recording.
    period_s, shortest_s, longest_s : median, least and greatest time between samples of `/joint_states` [s].
    holes : intervals longer than 1.75 periods, probably with lost samples.
    """

    path: Path
    robot: str
    uid: str
    joints: tuple[str, ...]
    rows: Mapping[str, int]
    rows_in_source: int
    duration_s: float
    period_s: float
    shortest_s: float
    longest_s: float
    holes: int
    conversions: tuple[str, ...]
    digests: Mapping[str, str]

    def __str__(self) -> str:
        written = ", ".join(f"{topic} {count}" for topic, count in self.rows.items())
        jitter = "regular" if self.longest_s - self.shortest_s < 1e-6 else "kept as recorded"
        lost = [f"  holes     {self.holes} intervals longer than 1.75 periods: lost samples"]
        lines = [
            f"{self.robot}: {len(self.joints)} joints, {self.duration_s:.3f} s",
            f"  rows      {written} (recording: {self.rows_in_source})",
            f"  period    median {self.period_s * 1e3:.4g} ms, {self.shortest_s * 1e3:.4g} to "
            f"{self.longest_s * 1e3:.4g} ms, {jitter}",
            *(lost if self.holes else ()),
            *(f"  {line}" for line in self.conversions),
            *(f"  read      {name}  sha256 {digest[:16]}" for name, digest in self.digests.items()),
            f"  written   {self.path}  uid {self.uid}",
        ]
        return "\n".join(lines)


@dataclass(frozen=True)
class _Channel:
    times: NDArray[np.int64]
    published: NDArray[np.int64]
    values: Floats


def import_log(
    mapping: LogMapping,
    source: str | Path,
    output: str | Path,
    *,
    rows: tuple[int, int] | None = None,
    payload: str | None = None,
    payload_mass: float | None = None,
    serial: str | None = None,
    beside: Path | None = None,
) -> ImportReport:
    """Write the recording `source` (a file, or the folder of the mapping's files) as the session `output`.

    rows : first and one past the last row of every file to take (from 0); None takes all.
    payload, payload_mass [kg], serial : instead of the mapping's.
    beside : folder of the mapping file, for its URDF.

    The session's uid follows from the content of the files and the rows taken, so a second import of the same
    recording is recognised. Raises DataError with file, column and row for non-finite values, times that do not
    increase, files of unequal length or missing columns; ConfigurationError for an existing output.
    """
    source = Path(source)
    if not source.exists():
        raise DataError(f"{source}: no such file or folder; give the recording of the mapping")
    recording = ImportedRecording(source, mapping.delimiter, mapping.header)
    total, channels = _read(mapping, recording, rows)
    joint = channels["position"]
    digest = hashlib.sha256(
        repr((sorted(recording.digests.values()), rows, mapping.joints)).encode()
    ).hexdigest()
    attachments = {"mapping.yaml": yaml.safe_dump(_plain(asdict(mapping)), sort_keys=False).encode()}
    if mapping.urdf is not None:
        urdf = find(mapping.urdf, beside=beside).read_text(encoding="utf-8")
        attachments["robot.urdf"] = urdf.encode()
    start = datetime.datetime.fromtimestamp(int(joint.times[0]) * 1e-9, datetime.UTC).isoformat()
    metadata = session_metadata(
        robot=mapping.robot,
        serial=mapping.serial if serial is None else serial,
        payload=mapping.payload if payload is None else payload,
        payload_mass=mapping.payload_mass if payload_mass is None else payload_mass,
        experiment="import",
        uid=digest[:32],
        motor_torque_source="none" if mapping.motor_torque is None else f"import of {source.name}",
        utc_start=start,
        imported_from=source.name,
        imported_rows="all" if rows is None else f"{rows[0]}:{rows[1]} of {total}",
        imported_sha256=" ".join(f"{name}={value}" for name, value in recording.digests.items()),
        source=mapping.source,
    )
    with SessionWriter(
        Path(output),
        mapping.joints,
        metadata,
        robot_description=None,
        attachments=attachments,
    ) as writer:
        _write(writer, channels)
    check_written(Path(output), {key: (one.times, one.values) for key, one in channels.items()})
    written = {
        topic: len(channels[key].times)
        for topic, key in (
            ("/joint_states", "position"),
            ("/motor_states", "motor_torque"),
            ("/joint_command", "command"),
        )
        if key in channels
    }
    steps = np.diff(joint.times) * 1e-9
    return ImportReport(
        path=Path(output),
        robot=mapping.robot,
        uid=digest[:32],
        joints=mapping.joints,
        rows=written,
        rows_in_source=total,
        duration_s=float(joint.times[-1] - joint.times[0]) * 1e-9,
        period_s=float(np.median(steps)),
        shortest_s=float(steps.min()),
        longest_s=float(steps.max()),
        holes=int(np.count_nonzero(steps > 1.75 * np.median(steps))),
        conversions=_conversions(mapping),
        digests=recording.digests,
    )


def _read(
    mapping: LogMapping, recording: ImportedRecording, rows: tuple[int, int] | None
) -> tuple[int, dict[str, _Channel]]:
    """Rows of the recording, and every channel converted to joint side and SI."""
    joints = len(mapping.joints)
    channels: dict[str, _Channel] = {}
    total = 0
    for name, signal in mapping.signals.items():
        raw = recording.columns(signal, joints, name)
        place = f"{recording.path(signal.file)}: `{name}`"
        base = signal.time if signal.time is not None else mapping.time
        clock = _clock(base, signal, recording, len(raw), place)
        total = len(raw) if name == "position" else total
        if name in _ONCE and len(raw) != total:
            raise DataError(
                f"{place} has {len(raw)} rows, the positions have {total}; the recording is not whole"
            )
        raw, clock = _cut(raw, rows, place), _cut(clock, rows, place)
        _refuse_non_finite(raw, mapping.joints, place, 0 if rows is None else rows[0])
        times = _log_times(mapping, base, clock, place, 0 if rows is None else rows[0])
        channels[name] = _Channel(
            times, _published(mapping, base, times), _convert(mapping, name, signal, raw)
        )
    if len(channels["position"].times) < 2:
        raise DataError(
            f"{recording.source}: {len(channels['position'].times)} samples are no motion; two at least"
        )
    return total, channels


def _clock(base: TimeBase, signal: Signal, recording: ImportedRecording, count: int, place: str) -> Floats:
    """Times of the samples (n,) [s] by the source's clock."""
    if base.column is None:
        assert base.rate_hz is not None
        return np.arange(count) / base.rate_hz
    file = base.file if base.file is not None else signal.file
    times = recording.column(file, base.column) * base.seconds
    if len(times) != count:
        raise DataError(f"{place} has {count} rows, its time column {base.column!r} has {len(times)}")
    return times


def _log_times(
    mapping: LogMapping, base: TimeBase, clock: Floats, place: str, first: int
) -> NDArray[np.int64]:
    """UTC [ns] of each sample, strictly increasing. DataError with the rows otherwise."""
    if not np.isfinite(clock).all():
        row = int(np.flatnonzero(~np.isfinite(clock))[0])
        raise DataError(
            f"{place}: time in row {first + row} is {clock[row]}; a log needs the time of every sample"
        )
    origin = _origin_ns(mapping, base)
    # Whole seconds and the rest apart: a double holds unix time to 0.2 us only once, not twice.
    whole = np.floor(clock)
    times = whole.astype(np.int64) * 10**9 + np.rint((clock - whole) * 1e9).astype(np.int64) + origin
    backwards = np.flatnonzero(np.diff(times) <= 0)
    if len(backwards):
        row = int(backwards[0])
        raise DataError(
            f"{place}: time {clock[row + 1]:.9g} s in row {first + row + 1} follows {clock[row]:.9g} s; "
            f"times must increase ({len(backwards)} such rows); repair the clock of the recording or import "
            "without it by `rate_hz`"
        )
    if times[0] < 0:
        raise DataError(
            f"{place}: times begin at {clock[0]:.9g} s, before 1970; give `start_utc`, the UTC of time 0"
        )
    return times


def _published(mapping: LogMapping, base: TimeBase, times: NDArray[np.int64]) -> NDArray[np.int64]:
    """The source's own clock [ns], counted from the first sample if it begins below zero."""
    published = times - _origin_ns(mapping, base)
    return published - min(0, int(published[0]))


def _origin_ns(mapping: LogMapping, base: TimeBase) -> int:
    """UTC [ns] of the source's time 0."""
    return _utc_ns(mapping.start_utc) if base.zero == "start" and mapping.start_utc is not None else 0


def _utc_ns(text: str) -> int:
    try:
        moment = datetime.datetime.fromisoformat(text)
    except ValueError as error:
        raise ConfigurationError(
            f"`start_utc` {text!r} is no time such as 2016-04-07T13:01:04+00:00"
        ) from error
    if moment.tzinfo is None:
        moment = moment.replace(tzinfo=datetime.UTC)
    elapsed = moment - datetime.datetime(1970, 1, 1, tzinfo=datetime.UTC)
    return (elapsed.days * 86400 + elapsed.seconds) * 10**9 + elapsed.microseconds * 1000


def _cut(values: Floats, rows: tuple[int, int] | None, place: str) -> Floats:
    if rows is None:
        return values
    first, last = rows
    if not 0 <= first < last <= len(values):
        raise DataError(f"{place}: rows {first}:{last} asked for, the recording has 0:{len(values)}")
    return values[first:last]


def _refuse_non_finite(values: Floats, joints: tuple[str, ...], place: str, first: int) -> None:
    bad = ~np.isfinite(values)
    if bad.any():
        row, column = np.argwhere(bad)[0]
        raise DataError(
            f"{place} of {joints[column]!r} is {values[row, column]} in row {first + row} "
            f"({int(bad.sum())} such values); leave these rows out with "
            "`--rows`, a session holds measured values only"
        )


def _convert(mapping: LogMapping, name: str, signal: Signal, raw: Floats) -> Floats:
    """Values (n, joints) at the joint: the formulas at the head of `ident.import_log.mapping`."""
    values = raw * signal.factors(len(mapping.joints), name)
    if signal.side == "motor":
        matrix = mapping.matrix
        values = values @ (matrix if signal.quantity == "torque" else np.linalg.inv(matrix).T)
    return values + mapping.offset if signal.quantity == "angle" else values


def _write(writer: SessionWriter, channels: Mapping[str, _Channel]) -> None:
    def values(name: str) -> Floats | None:
        return channels[name].values if name in channels else None

    joint = channels["position"]
    writer.write_joint_states(
        joint.times,
        joint.values,
        values("joint_torque"),
        velocity=values("velocity"),
        publish_time=joint.published,
    )
    if "motor_torque" in channels:
        motor = channels["motor_torque"]
        position = values("motor_position")
        if position is not None and not np.array_equal(channels["motor_position"].times, motor.times):
            raise DataError(
                f"{writer.path}: `motor_position` and `motor_torque` have different times; one channel"
            )
        writer.write_motor_states(motor.times, motor.values, position, publish_time=motor.published)
    if "command" in channels:
        command = channels["command"]
        writer.write_joint_command(command.times, command.values, publish_time=command.published)


def _plain(value: object) -> object:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items() if item is not None}
    if isinstance(value, (tuple, list)):
        return [_plain(item) for item in value]
    return value


def _conversions(mapping: LogMapping) -> tuple[str, ...]:
    lines = []
    for name, signal in mapping.signals.items():
        steps: list[str] = [signal.unit]
        if signal.scale is not None:
            steps.append(f"x {signal.scale}")
        if signal.sign != 1:
            steps.append(f"sign {signal.sign}")
        if signal.side == "motor":
            steps.append("motor side, through the gear")
        if signal.quantity == "angle" and mapping.offset_rad is not None:
            steps.append("+ offset")
        lines.append(f"{name:<15} {', '.join(steps)}")
    return tuple(lines)
