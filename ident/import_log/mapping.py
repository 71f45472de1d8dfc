"""The mapping file: columns, units and side of the gear for each channel of a recording.

Conventions of the conversion, with R the matrix of the transmission, q_motor = R q (n x n)::

    R[i, i] = reduction of joint i (negative if motor and joint turn against each other)
    R[m, j] = further ratios: turns of motor m for a turn of joint j (coupled drives of a wrist)

    y = sign * scale * torque constant * unit * x
    position   joint side:  y + offset      motor side:  inv(R) y + offset
    velocity   joint side:  y               motor side:  inv(R) y
    torque     joint side:  y               motor side:  R' y

The torque rule is the power balance tau' qd = tau_motor' qd_motor. A torque constant [Nm/A] is the motor's own,
so a current with one is on the motor side. docs/import_mapping.md has all keys with unit, default and example.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from fri.errors import ConfigurationError
from fri.quantities import FileName, Name, check, entries, within
from ident.import_log.tables import Floats
from lwr_driver.configuration import find, parse, read_mapping

# fmt: off
_QUANTITIES = {
    "position": "angle", "velocity": "rate", "joint_torque": "torque", "motor_torque": "torque",
    "motor_position": "angle", "command": "angle",
}
# fmt: on
_TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_UNITS = {
    "rad": ("angle", 1.0),
    "mrad": ("angle", 1e-3),
    "deg": ("angle", math.pi / 180.0),
    "rev": ("angle", 2.0 * math.pi),
    "counts": ("angle", None),
    "m": ("angle", 1.0),
    "rad/s": ("rate", 1.0),
    "deg/s": ("rate", math.pi / 180.0),
    "rpm": ("rate", 2.0 * math.pi / 60.0),
    "m/s": ("rate", 1.0),
    "Nm": ("torque", 1.0),
    "mNm": ("torque", 1e-3),
    "N": ("torque", 1.0),
    "A": ("torque", None),
    "mA": ("torque", None),
}
_CURRENTS = {"A": 1.0, "mA": 1e-3}
_Rate = Annotated[float, within(0.0, 1e6, "Hz", above=True)]
_Size = Annotated[float, within(-1e12, 1e12)]
_Turns = Annotated[float, within(-1e6, 1e6)]
_Place = Annotated[float, within(-1e4, 1e4)]
_Sign = Annotated[int, within(-1, 1)]
_Number = Annotated[int, within(1, 100_000)]
Unit = Literal[
    "rad", "mrad", "deg", "rev", "counts", "m", "rad/s", "deg/s", "rpm", "m/s", "Nm", "mNm", "N", "A", "mA"
]  # fmt: skip


@dataclass(frozen=True)
class TimeBase:
    """Times of the samples: a column of the recording, or a fixed rate.

    file : file of the column, relative to the source; None is the source itself (or the signal's own file).
    column : name or number (from 1) of a column, or name of an array; kept as it is, jitter included.
    unit : of the column. rate_hz : of a recording without a time column.
    zero : "start" if the column counts from a moment of its own, "unix" if it counts from 1970-01-01 UTC.
    equal : samples with one and the same time, from a clock of coarse steps: "refuse" them, or "spread" them evenly,
        over the whole recording if its stamps are rounded, else up to the next time.
    """

    column: Name | _Number | None = None
    file: FileName | None = None
    unit: Literal["s", "ms", "us", "ns"] = "s"
    rate_hz: _Rate | None = None
    zero: Literal["start", "unix"] = "start"
    equal: Literal["refuse", "spread"] = "refuse"

    def __post_init__(self) -> None:
        if (self.column is None) == (self.rate_hz is None):
            raise ConfigurationError("`time` needs either `column` or `rate_hz`, and not both")
        check(self)

    @property
    def seconds(self) -> float:
        """Seconds in a unit of the column."""
        return _TIME_UNITS[self.unit]


@dataclass(frozen=True)
class Signal:
    """One quantity of all joints.

    file : file, relative to the source, or one for each joint; None is the source itself.
    columns : names or numbers (from 1) of columns, one a joint; None takes the columns called like the joints, or
        all columns in their order.
    array : name of a two-dimensional array of an NPZ or MATLAB file or a bag (rows are samples).
    unit : of the numbers. `counts` need `scale` (rad a count), `A` and `mA` `torque_constant` or `scale` (Nm/A at
        the joint).
    side : `motor` before the gear, `joint` after it; None is `motor` with a torque constant, else `joint`.
    sign : 1 or -1, one a joint or one for all. scale : factor, one a joint or one for all.
    torque_constant : of the motors [Nm/A], one a joint or one for all.
    time : a clock of its own; None takes that of the mapping.
    """

    unit: Unit
    file: FileName | tuple[FileName, ...] | None = None
    columns: tuple[Name | _Number, ...] | None = None
    array: FileName | None = None
    side: Literal["joint", "motor"] | None = None
    sign: _Sign | tuple[_Sign, ...] = 1
    scale: _Size | tuple[_Size, ...] | None = None
    torque_constant: _Size | tuple[_Size, ...] | None = None
    time: TimeBase | None = None

    def __post_init__(self) -> None:
        signs = self.sign if isinstance(self.sign, tuple) else (self.sign,)
        if any(sign not in (1, -1) for sign in signs):
            raise ConfigurationError(f"`sign` is {self.sign}, it must be 1 or -1 for each joint")
        for name in ("scale", "torque_constant"):
            value = getattr(self, name)
            if value is not None and 0.0 in (value if isinstance(value, tuple) else (value,)):
                raise ConfigurationError(f"`{name}` is 0 and would erase the measurement")
        if self.torque_constant is not None and self.unit not in _CURRENTS:
            raise ConfigurationError(
                f"`torque_constant` goes with a current, and the unit is `{self.unit}`; use `A` or `mA`"
            )
        if self.torque_constant is not None and self.side == "joint":
            raise ConfigurationError(
                "`torque_constant` is the motor's, before the gear, and `side` is `joint`; leave `side` out, or give "
                "`scale` in Nm of the joint for an ampere"
            )
        if _UNITS[self.unit][1] is None and self.scale is None and self.torque_constant is None:
            advice = "`scale` (rad a count)"
            if self.unit in _CURRENTS:
                advice = (
                    "`torque_constant` (Nm/A, the gear is in `transmission`) or `scale` (Nm/A at the joint)"
                )
            raise ConfigurationError(f"unit `{self.unit}` has no size of its own; give {advice}")

    @property
    def before_gear(self) -> bool:
        """Whether the numbers are those of the motor."""
        return self.side == "motor" or (self.side is None and self.torque_constant is not None)

    @property
    def quantity(self) -> str:
        """Quantity of the unit: angle, rate or torque."""
        return _UNITS[self.unit][0]

    def factors(self, joints: int, where: str) -> Floats:
        """sign x scale x torque constant x unit for each joint (n,)."""
        size = _UNITS[self.unit][1]
        factors = np.full(joints, _CURRENTS.get(self.unit, 1.0) if size is None else size)
        for name in ("sign", "scale", "torque_constant"):
            value = getattr(self, name)
            if value is None:
                continue
            values = np.atleast_1d(np.array(value, dtype=np.float64))
            if len(values) not in (1, joints):
                raise ConfigurationError(f"{where}: `{name}` has {len(values)} entries for {joints} joints")
            factors *= values
        return factors


@dataclass(frozen=True)
class Coupling:
    """Motor `motor` turns `ratio` times as far as joint `joint`, besides the turns for its own joint."""

    motor: Name
    joint: Name
    ratio: _Turns


@dataclass(frozen=True)
class Transmission:
    """Between motors and joints: q_motor = R q. reduction : the diagonal of R, may be negative."""

    reduction: tuple[_Turns, ...]
    coupling: tuple[Coupling, ...] = ()

    def matrix(self, joints: tuple[str, ...]) -> Floats:
        """R (n, n). ConfigurationError if it does not fit the joints or has no inverse."""
        if len(self.reduction) != len(joints):
            raise ConfigurationError(
                f"`reduction` has {len(self.reduction)} entries for {len(joints)} joints"
            )
        matrix = np.diag(self.reduction)
        for entry in self.coupling:
            for name in (entry.motor, entry.joint):
                if name not in joints:
                    raise ConfigurationError(f"`coupling` names joint {name!r}; joints: {', '.join(joints)}")
            if entry.motor == entry.joint:
                raise ConfigurationError(
                    f"`coupling` of {entry.motor!r} with itself belongs into `reduction`"
                )
            matrix[joints.index(entry.motor), joints.index(entry.joint)] = entry.ratio
        if 0.0 in self.reduction or np.linalg.cond(matrix) > 1e9:
            raise ConfigurationError("the transmission has no inverse; every joint needs a motor of its own")
        return matrix


@dataclass(frozen=True)
class PeriodMarks:
    """Periods of the excitation, as known to whoever recorded the motion.

    period_s : length of one; None: from the start to the end of the recording in `count` parts.
    start_s : beginning of the first one, after the first sample taken.
    count : number; None: all that fit; 0: none, and none are looked for.
    """

    period_s: Annotated[float, within(0.0, 1e6, "s", above=True)] | None = None
    start_s: Annotated[float, within(0.0, 1e9, "s")] = 0.0
    count: Annotated[int, within(0, 1_000_000)] | None = None

    def __post_init__(self) -> None:
        if self.period_s is None and self.count is None:
            raise ConfigurationError("`periods` needs `period_s` or `count`; leave it out to have them found")
        check(self)


@dataclass(frozen=True)
class LogMapping:
    """A mapping file, see the head of the module and the files in `configs/imports/`.

    robot : model, as in the metadata of the session. joints : names, as in the URDF, base to tip.
    time : times of the samples. position : measured joint position, the one required signal.
    joint_torque : joint torque sensor. motor_torque : motor torque or current.
    velocity, motor_position, command : measured velocity, motor position, commanded position.
    offset_rad : added to the positions of each joint after the gear, to meet the zero of the URDF.
    urdf : file of the arm, found as configuration files are, attached to the session. Its other joints, those of
        a gripper say, are held at zero, or where `held` says [rad or m].
    periods : of the excitation; None: as the positions show them.
    base, tip : first and last link of the arm in it; None: its root, and behind the last joint.
    delimiter : of text files; None tries semicolon, comma, tab and blanks.
    header : whether text files name their columns in the first row; None looks whether it holds numbers.
    """

    robot: Name
    joints: Annotated[tuple[Name, ...], entries(1, 100)]
    time: TimeBase
    position: Signal
    schema_version: Literal[1] = 1
    serial: Annotated[str, entries(0, 64)] = ""
    payload: Name = "none"
    payload_mass: Annotated[float, within(0.0, 1e4, "kg")] | None = None
    start_utc: Annotated[str, entries(1, 64)] | None = None
    source: Annotated[str, entries(0, 1000)] = ""
    joint_torque: Signal | None = None
    motor_torque: Signal | None = None
    velocity: Signal | None = None
    motor_position: Signal | None = None
    command: Signal | None = None
    transmission: Transmission | None = None
    offset_rad: tuple[_Place, ...] | None = None
    periods: PeriodMarks | None = None
    urdf: FileName | None = None
    held: dict[str, _Place] | None = None
    base: Name | None = None
    tip: Name | None = None
    delimiter: Annotated[str, entries(1, 8)] | None = None
    header: bool | None = None

    def __post_init__(self) -> None:
        if not self.joints or len(set(self.joints)) != len(self.joints):
            raise ConfigurationError("`joints` must hold different names, one at least")
        if self.offset_rad is not None and len(self.offset_rad) != len(self.joints):
            raise ConfigurationError(
                f"`offset_rad` has {len(self.offset_rad)} entries for {len(self.joints)} joints"
            )
        for name, signal in self.signals.items():
            if signal.quantity != _QUANTITIES[name]:
                known = ", ".join(unit for unit, (kind, _) in _UNITS.items() if kind == _QUANTITIES[name])
                raise ConfigurationError(f"`{name}` cannot have the unit `{signal.unit}`; use one of {known}")
            if isinstance(signal.file, tuple) and len(signal.file) != len(self.joints):
                raise ConfigurationError(
                    f"`{name}`: {len(signal.file)} files in `file` for {len(self.joints)} joints; name one each"
                )
            if signal.columns is not None and len(signal.columns) != len(self.joints):
                raise ConfigurationError(
                    f"`{name}`: {len(signal.columns)} `columns` for {len(self.joints)} joints; name one each"
                )
            if signal.before_gear and self.transmission is None:
                raise ConfigurationError(
                    f"`{name}` is on the motor side; the gear is needed, give `transmission: {{reduction: [...]}}`"
                )
            signal.factors(len(self.joints), f"`{name}`")
        if self.joint_torque is not None and self.joint_torque.before_gear:
            raise ConfigurationError(
                "`joint_torque` is the sensor behind the gear, it cannot be on the motor side; "
                "is it `motor_torque`?"
            )
        for name in ("velocity", "joint_torque"):
            if name in self.signals and self.signals[name].time is not None:
                raise ConfigurationError(
                    f"`{name}` belongs to the samples of `position` and has no `time` of its own"
                )
        if self.motor_position is not None and self.motor_torque is None:
            raise ConfigurationError("`motor_position` goes with `motor_torque`, missing in the mapping")
        if self.joint_torque is None and self.motor_torque is None:
            raise ConfigurationError("the mapping has no torque; give `joint_torque` or `motor_torque`")
        self.matrix  # noqa: B018 - checked once, here

    @property
    def signals(self) -> dict[str, Signal]:
        """The signals of the mapping, by name."""
        return {name: getattr(self, name) for name in _QUANTITIES if getattr(self, name) is not None}

    @property
    def matrix(self) -> Floats:
        """R (n, n) of q_motor = R q; the identity without a transmission."""
        if self.transmission is None:
            return np.eye(len(self.joints))
        return self.transmission.matrix(self.joints)

    @property
    def offset(self) -> Floats:
        """Offsets of the positions (n,) [rad]."""
        return np.zeros(len(self.joints)) if self.offset_rad is None else np.array(self.offset_rad)

    def content(self) -> dict[str, Any]:
        """Plain content of a mapping file, without keys at their defaults."""
        return {"schema_version": self.schema_version, **_plain(self)}

    @classmethod
    def load(cls, name: str | Path) -> LogMapping:
        """Read a mapping file, looked for as given, in `configs/` and in `configs/imports/`."""
        path = mapping_path(name)
        return parse(cls, read_mapping(path), path)


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        kept = [f for f in dataclasses.fields(value) if getattr(value, f.name) != f.default]
        return {f.name: _plain(getattr(value, f.name)) for f in kept}
    if isinstance(value, dict):
        return dict(value)
    return [_plain(item) for item in value] if isinstance(value, tuple) else value


def mapping_path(name: str | Path) -> Path:
    """Path of the mapping file `name`; a bare name such as `tx40` means `configs/imports/tx40.yaml`."""
    try:
        return find(name)
    except ConfigurationError:
        bare = Path("imports") / Path(name).with_suffix(".yaml")
        try:
            return find(bare)
        except ConfigurationError as error:
            raise ConfigurationError(
                f"mapping file {str(name)!r} not found; looked also for: {error}"
            ) from error
