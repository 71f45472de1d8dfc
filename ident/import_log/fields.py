"""What a recording holds, read off the names of its columns, arrays and files: the quantity of each field.

A field is one quantity of all joints, or a column of times. Columns that differ in a joint's number or name only
belong together: `q1` to `q7`, `panda_joint1_pos` to `panda_joint7_pos`, files `tau_1.txt` to `tau_7.txt`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from fri.errors import DataError
from ident.import_log.recording import Recording
from ident.import_log.tables import ARCHIVES, Floats, unpacked


def _words(text: str) -> frozenset[str]:
    return frozenset(text.split())


TEXTS = frozenset({".csv", ".txt", ".dat", ".tsv"})
QUANTITIES: dict[str, frozenset[str]] = {
    "acceleration": _words("acceleration acc accel ddq qdd qddot qpp beschleunigung"),
    "velocity": _words(
        "velocity vel velo velocities dq qd qdot qp dth thd dtheta thetad thetadot omega speed spd geschwindigkeit "
        "drehzahl"
    ),
    "torque": _words("torque tau effort trq tq moment qfrc drehmoment motormoment"),
    "position": _words("position pos q th theta angle ang winkel gelenkwinkel achswinkel"),
    "current": _words("current curr cur amp ampere i iq strom motorstrom"),
    "time": _words("time t stamp timestamp clock sec secs seconds ts timestep zeit zeitstempel"),
}
"""Words of each quantity; the first quantity with a word in the name is meant."""
_ASIDE = _words(
    "cmd command commanded cmptd des desired d target ref reference goal set setpoint model err error ext external "
    "gravity grav g temp temperature est estimated ideal plan planned limit std hat friction coriolis "
    "soll sollwert temperatur reibung "
    "tcp cartesian cart ee tool flange force pose x y z"
)
_SENSED = _words("sm sensor sensed measured meas msr actual act fb feedback real raw ist istwert")
_FILTERED = _words("filt filtered filter smooth smoothed lp lowpass")
_MOTOR = _words("motor mot motors drive actuator motormoment antrieb")
_NUMBERED = re.compile(r"(?<![A-Za-z])(?:joint|jnt|j|axis|ax|achse|gelenk)[\s_.\-]*(\d+)", re.IGNORECASE)
"""A joint's number in the name of a column."""
_SHORTEST = 3
"""Letters of the least quantity behind a prefix."""
_AXES = _words("achse gelenk")
"""German for a joint: `Achse 1 Ist` is its position."""
_PREFIXES = _words("q j jnt joint axis ax ang angular rot arm")
"""Written before a quantity without a mark, as in `angvel` and `jointpos`; so are words of sensors and motors."""
_UNITS = {"mnm": r"mN[.·*-]?m(?![A-Za-z])|N[.·*-]?mm(?![A-Za-z])", "ma": r"(?<![A-Za-z])mA(?![A-Za-z])"}
"""Units of two cases, each one word."""
_BRACKETS = re.compile(r"[(\[{]([^()\[\]{}]*[^()\[\]{}\d\s][^()\[\]{}]*)[)\]}]")
_OF_UNIT = {
    "acceleration": _words("rad/s^2 rad/s2 rad/s² deg/s^2 deg/s2 deg/s² °/s^2 °/s2 °/s² m/s^2 m/s2 m/s²"),
    "velocity": _words("rad/s rad/sec deg/s deg/sec °/s rpm 1/min u/min m/s mm/s"),
    "torque": _words("nm n.m n·m n*m n-m mnm nmm"),
    "position": _words("rad mrad deg °"),
    "current": _words("a ma"),
}
"""Units in brackets that tell the quantity where the name does not, as in `T_mot J1 (Nm)`."""


@dataclass(frozen=True)
class Field:
    """One quantity as recorded.

    name : common part of the names. labels : joint names, numbers or nothing, one a column.
    file, array, columns : its place, as in a mapping; columns counted from 1 or by name, None takes all.
    values : (n, k).
    """

    name: str
    labels: tuple[str, ...]
    values: Floats
    file: str | tuple[str, ...] | None = None
    array: str | None = None
    columns: tuple[str | int, ...] | None = None

    @property
    def words(self) -> tuple[str, ...]:
        """Words of the name in lower case, plurals as singulars."""
        name = re.sub(r"°(?!\s*C)", " deg ", self.name)
        for unit, spelling in _UNITS.items():
            name = re.sub(spelling, f" {unit} ", name)
        parts = re.findall("[a-z]+", re.sub(r"([a-z])([A-Z])", r"\1 \2", name).lower())
        known = frozenset().union(_ASIDE, _SENSED, _MOTOR, _FILTERED, *QUANTITIES.values())
        parts = [part[:-1] if part not in known and part[:-1] in known else part for part in parts]
        return tuple(word for part in parts for word in ((part,) if part in known else _compound(part)))

    @property
    def _by_unit(self) -> str | None:
        """The quantity by a unit in brackets."""
        units = {re.sub(r"\s", "", unit).lower() for unit in _BRACKETS.findall(self.name)}
        return next((name for name, known in _OF_UNIT.items() if units & known), None)

    @property
    def quantity(self) -> str | None:
        """Key of `QUANTITIES`, or None for a name without such a word or of something not measured."""
        words = set(self.words)
        by_unit = self._by_unit
        if self.values.shape[1] == 1 and words & QUANTITIES["time"] and by_unit is None:
            return "time"
        if words & _ASIDE:
            return None
        if words & QUANTITIES["position"] and "dot" in words:
            return "velocity"
        if words & _AXES and words & _SENSED and words <= _AXES | _SENSED:
            return "position"
        by_name = (name for name, known in QUANTITIES.items() if words & known and name != "time")
        return next(by_name, by_unit)

    @property
    def of_motor(self) -> bool:
        """Whether the name speaks of a motor or a current."""
        return bool(set(self.words) & (_MOTOR | QUANTITIES["current"]))

    @property
    def rank(self) -> int:
        """Preference among fields of one quantity: sensed before plain, before filtered or of the motor."""
        words = set(self.words)
        return bool(words & _SENSED) - bool(words & _FILTERED) - bool(words & _MOTOR)

    def of(self, joints: Sequence[str]) -> Field | None:
        """The columns of these joints if the labels are joint names, else all if they are as many; or None."""
        if set(joints) <= set(self.labels):
            picked = [self.labels.index(name) for name in joints]
            file, columns = self.file, self.columns
            if isinstance(file, tuple):
                file = tuple(file[k] for k in picked)
            elif columns is not None or len(picked) < len(self.labels):
                columns = tuple(k + 1 if columns is None else columns[k] for k in picked)
            return replace(
                self, labels=tuple(joints), values=self.values[:, picked], file=file, columns=columns
            )
        return self if self.values.shape[1] == len(joints) else None

    @property
    def shown(self) -> str:
        """The place as a person names it."""
        if isinstance(self.file, tuple):
            return f"{self.file[0]} ... {self.file[-1]}"
        if self.columns is not None and all(isinstance(column, str) for column in self.columns):
            first, last = str(self.columns[0]), str(self.columns[-1])
            inner = first if first == last else f"{first} ... {last}"
        elif self.columns == (1,):
            inner = "" if self.file else "column 1"
        elif self.columns is not None and len(self.columns) == 1:
            inner = f"column {self.columns[0]}"
        elif self.columns is not None:
            inner = f"columns {self.columns[0]} to {self.columns[-1]}"
        else:
            inner = self.array or ""
        return " ".join(part for part in (self.file or "", inner) if part) or self.name


def fields(recording: Recording, joints: Sequence[str]) -> list[Field]:
    """The fields of a recording. joints : names of the URDF's joints, looked for in the names of columns."""
    if not recording.source.is_dir():
        return list(_in_file(recording, None, joints))
    files = sorted(
        p.name
        for p in recording.source.iterdir()
        if p.suffix.lower() in ARCHIVES or unpacked(p).suffix.lower() in TEXTS
    )
    if not files:
        raise DataError(
            f"{recording.source}: a folder without recordings; known are {', '.join(sorted(TEXTS | ARCHIVES))}, and "
            "ROS 2 bags (.mcap)"
        )
    return _one_a_joint([found for name in files for found in _in_file(recording, name, joints)], joints)


def _in_file(recording: Recording, file: str | None, joints: Sequence[str]) -> Iterator[Field]:
    path = recording.path(file)
    for array, table in recording.tables(path).items():
        values = table.values
        if values.dtype.kind != "f" or values.ndim != 2 or not len(values):
            continue
        names = table.names
        unnamed = names == tuple(str(k + 1) for k in range(len(names)))
        name = array or unpacked(path).stem
        if unnamed:
            if array and values.shape[0] < values.shape[1]:
                values = values.T
            columns = (1,) if not array and values.shape[1] == 1 else None
            yield Field(name, ("",) * values.shape[1], values, file, array or None, columns)
            continue
        groups: dict[str, list[tuple[str, int]]] = {}
        for index, column in enumerate(names):
            if np.isnan(values[:, index]).all():
                continue
            stem, label = split_name(column, joints)
            groups.setdefault(stem, []).append((label, index))
        for stem, members in groups.items():
            members = sorted(members, key=lambda member: _order(member[0], joints))
            picked = [index for _, index in members]
            one = Field(
                stem,
                tuple(label for label, _ in members),
                values[:, picked],
                file,
                array or None,
                tuple(names[index] if names.count(names[index]) == 1 else index + 1 for index in picked),
            )
            # `Joint_1` in `position.csv`: the file says which quantity.
            if one.quantity is None and not set(one.words) & _ASIDE:
                one = replace(one, name=f"{unpacked(path).stem} {stem}")
            yield one


def _one_a_joint(found: list[Field], joints: Sequence[str]) -> list[Field]:
    """Files with one column each that differ in the joint only become one field."""
    groups: dict[str, list[tuple[str, Field]]] = {}
    kept: list[Field] = []
    for one in found:
        stem, label = split_name(unpacked(Path(str(one.file))).stem, joints)
        if one.values.shape[1] == 1 and label and one.columns == (1,):
            groups.setdefault(stem, []).append((label, one))
        else:
            kept.append(one)
    for stem, members in groups.items():
        members.sort(key=lambda member: _order(member[0], joints))
        if len(members) == 1 or len({len(one.values) for _, one in members}) > 1:
            kept += [one for _, one in members]
        else:
            values = np.hstack([one.values for _, one in members])
            labels = tuple(label for label, _ in members)
            kept.append(Field(stem, labels, values, tuple(str(one.file) for _, one in members)))
    return kept


def split_name(name: str, joints: Sequence[str]) -> tuple[str, str]:
    """The name without its joint, and the joint: a name of the URDF, the number behind a word such as `joint`, or the
    last number that is not of a unit in brackets."""
    for joint in sorted(joints, key=len, reverse=True):
        match = re.search(rf"(?<![A-Za-z0-9]){re.escape(joint)}(?![0-9])", name, re.IGNORECASE)
        if match:
            return name[: match.start()] + name[match.end() :], joint
    plain = _BRACKETS.sub(lambda unit: " " * len(unit[0]), name)
    number = _NUMBERED.search(plain) or re.search(r"(\d+)(?!.*\d)", plain)
    if number:
        return name[: number.start(1)] + name[number.end(1) :], number[1]
    return name, ""


def _compound(word: str) -> tuple[str, ...]:
    """The parts of two words written as one, as in `angvel`; else the word."""
    firsts = sorted(_PREFIXES | _MOTOR | _SENSED, key=len, reverse=True)
    quantities = frozenset().union(*QUANTITIES.values())
    for first in firsts:
        rest = word.removeprefix(first)
        if len(rest) in range(_SHORTEST, len(word)) and rest in quantities:
            return first, rest
    return (word,)


def _order(label: str, joints: Sequence[str]) -> tuple[int, int]:
    return (0, list(joints).index(label)) if label in joints else (1, int(label) if label.isdigit() else 0)
