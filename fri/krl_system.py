"""Variables and functions of the controller in KRL: `$FRI_TO_INT`, `$STIFFNESS`, `$LOAD`, `friOpen` ...

A variable is live (it belongs to the FRI session or to the machinery), kept (a KRL program may set and read it,
the emulated arm does not obey it), or absent. Structures are mappings of their fields.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Protocol

import numpy as np

from fri.errors import RobotError
from fri.krc import KrcSession

#: Indices of the axes of KRL (A1 to A6, then E1) in the kinematic order A1 A2 E1 A3 A4 A5 A6.
AXES = (0, 1, 3, 4, 5, 6, 2)
AXIS_NAMES = ("A1", "A2", "A3", "A4", "A5", "A6", "E1")
#: A2 of KRL is the angle of the second joint plus this [deg].
A2_OFFSET_DEG = 90.0
#: Load data in the order of ``Machinery.load``: mass [kg], centre of mass [mm], orientation of its axes A B C
#: [deg], inertia about it along these axes [kg m2].
LOAD = (".M", ".CM.X", ".CM.Y", ".CM.Z", ".CM.A", ".CM.B", ".CM.C", ".J.X", ".J.Y", ".J.Z")

Step = str | int | tuple[int, ...]
Path = tuple[Step, ...]


class Machinery(Protocol):
    """The controller and its arm beside the FRI session, all in kinematic order."""

    currents: np.ndarray | None
    """(7,) motor currents in the unit of the emulated drives; None where `$CURR_ACT` does not exist."""
    powered: bool
    mode: str

    @property
    def position(self) -> np.ndarray:
        """(7,) measured joint positions [rad]."""

    @property
    def joint_torque(self) -> np.ndarray:
        """(7,) joint torque sensors [Nm]."""

    @property
    def load(self) -> tuple[float, ...]:
        """Load data in force in the order of `LOAD`."""

    def set_load(self, load: tuple[float, ...]) -> None:
        """Put load data in force."""

    @property
    def gravity(self) -> tuple[float, float, float]:
        """`$GRAVITATION`: the acceleration that holds the base against gravity [m/s^2]; (0, 0, 9.81) upright."""

    def set_gravity(self, gravity: tuple[float, float, float]) -> None:
        """Put another direction of gravity in force."""

    def set_impedance(self, stiffness: np.ndarray, damping: np.ndarray) -> None:
        """Default springs of joint impedance control: (7,) [Nm/rad], (7,) damping ratios."""

    def say(self, text: str) -> None:
        """Show a message of the program."""


class NoMachinery:
    """Drives without current, load data without effect, an arm at zero."""

    def __init__(self) -> None:
        self.currents: np.ndarray | None = np.zeros(7)
        self.position = np.zeros(7)
        self.joint_torque = np.zeros(7)
        self.powered = True
        self.mode = "EXT"
        self.load: tuple[float, ...] = (0.0,) * len(LOAD)
        self.gravity: tuple[float, float, float] = (0.0, 0.0, 9.81)
        self.said: list[str] = []

    def set_load(self, load: tuple[float, ...]) -> None:
        """Keep `load`."""
        self.load = load

    def set_gravity(self, gravity: tuple[float, float, float]) -> None:
        """Keep `gravity`."""
        self.gravity = gravity

    def set_impedance(self, stiffness: np.ndarray, damping: np.ndarray) -> None:
        """No arm, no spring."""

    def say(self, text: str) -> None:
        """Keep the message."""
        self.said.append(text)


class Table(dict[Any, Any]):
    """An array: elements by index from 1, made from a template when first touched. size : 0 is no bound."""

    def __init__(self, template: Any, size: int = 0) -> None:
        self._template, self.size = template, size

    def __missing__(self, index: Any) -> Any:
        self[index] = value = copy.deepcopy(self._template)
        return value

    def __deepcopy__(self, memory: Any) -> Table:
        made = Table(self._template, self.size)
        for index, value in self.items():
            made[index] = copy.deepcopy(value, memory)
        return made


def _fields(names: str, value: Any = 0.0) -> dict[str, Any]:
    return dict.fromkeys(names.split(), value)


_FRAME = _fields("X Y Z A B C")
_SPRING = "A1 A2 A3 A4 A5 A6 E1"
#: Structures of KRL by type.
STRUCTURES: dict[str, dict[str, Any]] = {
    "AXIS": _fields("A1 A2 A3 A4 A5 A6"),
    "E6AXIS": _fields("A1 A2 A3 A4 A5 A6 E1 E2 E3 E4 E5 E6"),
    "FRAME": _FRAME,
    "POS": {**_FRAME, "S": 0, "T": 0},
    "E6POS": {**_FRAME, "S": 0, "T": 0, **_fields("E1 E2 E3 E4 E5 E6")},
    "LOAD": {"M": 0.0, "CM": _FRAME, "J": _fields("X Y Z")},
    "STIFFNESS": {
        "STRATEGY": 10,
        "COMMIT": False,
        "FRAMETYPE": "#TOOL",
        "BASE": _FRAME,
        "TOOL": _FRAME,
        "TASKFRAME": _FRAME,
        "AXISSTIFFNESS": _fields(_SPRING, 1000.0),
        "AXISDAMPING": _fields(_SPRING, 0.7),
        "AXISMAXDELTA": _fields(_SPRING),
        "AXISMAXDELTATRQ": _fields(_SPRING),
        "CPSTIFFNESS": _FRAME,
        "CPDAMPING": _FRAME,
        "CPMAXDELTA": _FRAME,
        "MAXFORCE": _FRAME,
    },
}
_EMPTY: dict[str, Any] = {"INT": 0, "REAL": 0.0, "BOOL": False, "CHAR": "", "FRISTATE": "#OFF"}

# Live variables: bound of the index, 0 for none.
_ARRAYS = {f"$FRI_{way}_{kind}": 16 for way in ("FRM", "TO") for kind in ("INT", "REA", "BOOL")}
_ARRAYS |= {"$CURR_ACT": 7, "$TORQUE_AXIS_ACT": 7, "$GRAVITATION": 3}
_ARRAYS |= {"$TIMER": 64, "$TIMER_STOP": 64, "$TIMER_FLAG": 64}
_POSES = ("$AXIS_ACT", "$AXIS_ACT_MES", "$AXIS_ACT_MSR", "$AXIS_ACT_CMD", "$AXIS_RET", "$AXIS_INT")
#: Places where the arm is, as goals of a motion.
HERE = (*_POSES, "$POS_ACT", "$POS_ACT_MES", "$POS_ACT_MSR", "$POS_ACT_CMD")
_STATES = ("$FRISTATE", "$FRIQUALITY", "$ON_PATH", "$ROB_STOPPED", "$MODE_OP", "$DRIVES_ON", "$PERI_RDY")
_LIVE = (*_ARRAYS, *_POSES, *_STATES, "$STIFFNESS", "$LOAD", "$MSG_T")
_READ_ONLY = (
    *_STATES, *HERE, "$FRI_FRM_INT", "$FRI_FRM_REA", "$FRI_FRM_BOOL", "$CURR_ACT", "$TORQUE_AXIS_ACT", "$TIMER_FLAG",
)  # fmt: skip

# Kept variables with their first values.
_KEPT: dict[str, Any] = {
    "$ADVANCE": 3, "$OV_PRO": 100, "$OV_ROB": 100, "$OV_JOG": 10, "$NUM_AX": 6, "$EX_AX_NUM": 1,
    "$ACT_TOOL": 1, "$ACT_BASE": 0, "$BWDSTART": False, "$STOPMESS": False, "$IPO_MODE": "#BASE", "$ERR": {},
    "$NULLFRAME": _FRAME, "$ROBROOT": _FRAME, "$WORLD": _FRAME, "$BASE": _FRAME, "$TOOL": _FRAME,
    "$POS_ACT": STRUCTURES["E6POS"], "$POS_ACT_MES": STRUCTURES["E6POS"], "$POS_ACT_MSR": STRUCTURES["E6POS"],
    "$POS_ACT_CMD": STRUCTURES["E6POS"], "$H_POS": STRUCTURES["E6AXIS"], "$APO": {}, "$VEL": {}, "$ACC": {},
    "$VEL_AXIS": Table(100), "$ACC_AXIS": Table(100), "$VEL_EXTAX": Table(100), "$ACC_EXTAX": Table(100),
    "$OUT": Table(False), "$IN": Table(False), "$FLAG": Table(False), "$CYCFLAG": Table(False),
    "$ANOUT": Table(0.0), "$ANIN": Table(0.0), "$TORQUE_AXIS_EST": Table(0.0),
    "$TORQUE_TCP_EST": {"FT": _FRAME}, "$TRUE": True, "$PRO_STATE": "#P_ACTIVE", "$DATE": {}, "$IOSYS_IN_TRUE": True,
    # Of $config.dat.
    "XHOME": STRUCTURES["E6AXIS"], "PDEFAULT": {}, "FHOME": {}, "PDAT_ACT": {}, "FDAT_ACT": {}, "LDAT_ACT": {},
    "TOOL_DATA": Table(_FRAME), "BASE_DATA": Table(_FRAME), "LOAD_DATA": Table(STRUCTURES["LOAD"]),
    "TOOL_NAME": Table(""), "BASE_NAME": Table(""),
}  # fmt: skip

#: Functions of the controller with the least and largest number of arguments.
FUNCTIONS = {
    "FRISETUP": (3, 3), "FRIOPEN": (1, 1), "FRISTART": (1, 1), "FRISTOP": (0, 0), "FRICLOSE": (0, 0),
    "FRISHOW": (0, 0),
    "BAS": (1, 2), "SWRITE": (4, 12), "SREAD": (4, 12), "CWRITE": (3, 12), "VARSTATE": (1, 1),
    "ABS": (1, 1), "SQRT": (1, 1), "SIN": (1, 1), "COS": (1, 1), "TAN": (1, 1), "ACOS": (1, 1), "ATAN2": (2, 2),
}  # fmt: skip
_MATHEMATICS: dict[str, Callable[..., float]] = {
    "ABS": abs,
    "SQRT": math.sqrt,
    "SIN": lambda x: math.sin(math.radians(x)),
    "COS": lambda x: math.cos(math.radians(x)),
    "TAN": lambda x: math.tan(math.radians(x)),
    "ACOS": lambda x: math.degrees(math.acos(x)),
    "ATAN2": lambda y, x: math.degrees(math.atan2(y, x)),
}


def first_value(kind: str, size: int) -> Any:
    """First value of a variable of the type `kind`; `size` for an array."""
    template = duplicate(_EMPTY[kind] if kind in _EMPTY else STRUCTURES.get(kind, {}))
    return Table(template, size) if size and kind != "CHAR" else template


def get(value: Any, path: Path, what: str) -> Any:
    """The part of `value` at `path`. RobotError where there is none."""
    for step in path:
        if isinstance(value, Table):
            _bound(value, step, what)
        elif isinstance(value, str) and isinstance(step, int):
            value = value[step - 1 : step]
            continue
        elif not isinstance(value, dict) or step not in value:
            raise RobotError(f"{what} has no part {step}, or it was never set")
        value = value[step]
    return value


def put(value: Any, path: Path, new: Any, what: str) -> Any:
    """`value` with `new` at `path`; structures change in place."""
    if not path:
        return duplicate(new)
    step, *rest = path
    if isinstance(value, Table):
        _bound(value, step, what)
    elif not isinstance(value, dict):
        raise RobotError(f"{what} has no part {step}")
    inner = value[step] if isinstance(value, Table) or step in value else {}
    value[step] = put(inner, tuple(rest), new, what)
    return value


def duplicate(value: Any) -> Any:
    """A copy that shares nothing."""
    return value if isinstance(value, (int, float, str)) else copy.deepcopy(value)


def _bound(table: Table, step: Step, what: str) -> None:
    if table.size and isinstance(step, int) and not 1 <= step <= table.size:
        raise RobotError(f"{what}[{step}] is outside 1 to {table.size}")


def axes(q: Sequence[float] | np.ndarray) -> dict[str, float]:
    """Joint positions (7,) [rad] in kinematic order as axes of KRL [deg]."""
    degrees = np.degrees(np.asarray(q, dtype=float))
    found = {name: float(degrees[place]) for name, place in zip(AXIS_NAMES, AXES, strict=True)}
    found["A2"] += A2_OFFSET_DEG
    return {**STRUCTURES["E6AXIS"], **found}


def positions(goal: dict[str, Any], here: np.ndarray, *, relative: bool = False) -> np.ndarray:
    """Axes of KRL [deg] as joint positions (7,) [rad]; axes left out stay at `here` (7,)."""
    degrees = np.degrees(here)
    for name, place in zip(AXIS_NAMES, AXES, strict=True):
        if name in goal:
            offset = A2_OFFSET_DEG if name == "A2" and not relative else 0.0
            degrees[place] = float(goal[name]) - offset + (degrees[place] if relative else 0.0)
    return np.radians(degrees)


class System:
    """Variables and functions of one controller. clock_ms : time of the interpreter."""

    def __init__(self, machinery: Any) -> None:
        self.machinery = machinery
        self.session: KrcSession | None = None
        self.clock_ms = 0.0
        self._kept: dict[str, Any] = {}
        self.stiffness: dict[str, Any] = copy.deepcopy(STRUCTURES["STIFFNESS"])
        self._message: dict[str, Any] = {"VALID": False}
        # A stopped timer's value [ms], a running timer's time of zero.
        self._timers: dict[int, tuple[float, bool]] = {}
        # Load data read last, and their structure; never changed.
        self._load_seen: tuple[tuple[float, ...] | None, dict[str, Any]] = None, {}

    @staticmethod
    def template(title: str) -> Any:
        """Fields of a known variable; None for an unknown one."""
        if title in ("$STIFFNESS", "$LOAD"):
            return STRUCTURES[title[1:]]
        if title in _POSES:
            return STRUCTURES["E6AXIS"]
        return _KEPT.get(title, {} if title in _LIVE else None)

    @staticmethod
    def array(title: str) -> int:
        """Length of a live array, 0 for any other variable."""
        return _ARRAYS.get(title, 0)

    @staticmethod
    def read_only(title: str) -> bool:
        """Whether a program cannot write it."""
        return title in _READ_ONLY

    def _need(self) -> KrcSession:
        assert self.session is not None
        return self.session

    def read(self, title: str, path: Path) -> Any:
        """Value of a variable, or of its part at `path`."""
        if title in _ARRAYS:
            return self._element(title, self._place(title, path))
        if title in _STATES:
            return self._state(title)
        if title in _POSES:
            setpoint = title in ("$AXIS_ACT_CMD", "$AXIS_ACT")
            return get(axes(self._need().setpoint if setpoint else self.machinery.position), path, title)
        if title == "$LOAD":
            load = self.machinery.load
            if load is not self._load_seen[0]:
                self._load_seen = load, _load(load)
            return get(self._load_seen[1], path, title)
        if title == "$STIFFNESS":
            return get(self.stiffness, path, title)
        if title == "$MSG_T":
            return get(self._message, path, title)
        kept = self._keep(title, path)
        if title not in _KEPT and (not isinstance(kept, dict) or (path and path[0] not in kept)):
            return kept if not path else 0
        return get(kept, path, title)

    def reader(self, title: str, path: Path) -> Callable[[], Any]:
        """``read`` of one place, as a function."""
        if title not in _ARRAYS or not self._exists(title, path):
            return partial(self.read, title, path)
        number = self._place(title, path)
        if title == "$FRI_FRM_INT":
            return lambda: int(self._need().from_int[number - 1])
        return partial(self._element, title, number)

    def writer(self, title: str, path: Path) -> Callable[[Any], None]:
        """``write`` of one place, as a function."""
        if title not in _ARRAYS or not self._exists(title, path):
            return partial(self.write, title, path)
        number = self._place(title, path)
        writers = {"$FRI_TO_INT": self._write_integer, "$FRI_TO_REA": self._write_real}
        if title in writers:
            return partial(writers[title], number - 1)
        return partial(self._write_element, title, number)

    def _write_integer(self, place: int, value: Any) -> None:
        self._need().to_int[place] = min(max(int(value), -(2**31)), 2**31 - 1)

    def _write_real(self, place: int, value: Any) -> None:
        self._need().to_real[place] = float(value)

    @staticmethod
    def _exists(title: str, path: Path) -> bool:
        """Whether the array has this element."""
        number = path[0] if path else None
        return isinstance(number, int) and 1 <= number <= _ARRAYS[title]

    def _keep(self, title: str, path: Path) -> Any:
        """Content of a kept variable; an unknown one is made as its first use has it."""
        if title not in self._kept:
            unknown: Any = 0 if not path else {} if isinstance(path[0], str) else Table(0)
            self._kept[title] = copy.deepcopy(_KEPT.get(title, unknown))
        return self._kept[title]

    @staticmethod
    def _place(title: str, path: Path) -> int:
        number = path[0] if path else None
        if not isinstance(number, int) or not 1 <= number <= _ARRAYS[title]:
            raise RobotError(f"{title}[{number}] is outside 1 to {_ARRAYS[title]}")
        return number

    def _element(self, title: str, number: int) -> Any:
        session, place = self._need(), number - 1
        if title == "$CURR_ACT":
            if self.machinery.currents is None:
                raise RobotError(f"$CURR_ACT[{number}] does not exist on this controller")
            return float(self.machinery.currents[AXES[place]])
        if title == "$TORQUE_AXIS_ACT":
            return float(self.machinery.joint_torque[AXES[place]])
        if title == "$GRAVITATION":
            return float(self.machinery.gravity[place])
        if title.startswith("$TIMER"):
            value, stopped = self._timers.get(number, (0.0, True))
            now = value if stopped else self.clock_ms - value
            return stopped if title == "$TIMER_STOP" else now > 0.0 if title == "$TIMER_FLAG" else int(now)
        if title.endswith("_BOOL"):
            return bool((session.to_bool if "_TO_" in title else session.from_bool) >> place & 1)
        if title.endswith("_INT"):
            return int((session.to_int if "_TO_" in title else session.from_int)[place])
        return float((session.to_real if "_TO_" in title else session.from_real)[place])

    def _state(self, title: str) -> Any:
        session = self._need()
        if title == "$FRISTATE":
            return f"#{session.state.name}"
        if title == "$FRIQUALITY":
            return f"#{session.quality.name}"
        if title == "$ON_PATH":
            # A fallback leaves the arm away from the setpoint of KRL.
            return not session.needs_resync
        if title == "$MODE_OP":
            return f"#{self.machinery.mode}"
        return not session.ramping if title == "$ROB_STOPPED" else self.machinery.powered

    def write(self, title: str, path: Path, value: Any) -> None:
        """Set a variable, or its part at `path`."""
        session = self._need()
        if title in _ARRAYS:
            self._write_element(title, self._place(title, path), value)
        elif title == "$LOAD":
            load = put(_load(self.machinery.load), path, value, title)
            self.machinery.set_load(tuple(float(get(load, _steps(name), title)) for name in LOAD))
        elif title == "$STIFFNESS":
            before = get(self.stiffness, path, title)
            merged = {**before, **value} if isinstance(before, dict) and isinstance(value, dict) else value
            self.stiffness = put(self.stiffness, path, merged, title)
            if not path or (path == ("COMMIT",) and value):
                self._commit(session)
        elif title == "$MSG_T":
            self._message = put(self._message, path, value, title)
            if self._message.get("VALID"):
                # The user interface takes the message and clears the mark.
                self._message["VALID"] = False
                self.machinery.say(str(self._message.get("KEY", "")))
        else:
            self._kept[title] = put(self._keep(title, path), path, value, title)

    def _write_element(self, title: str, number: int, value: Any) -> None:
        session, place = self._need(), number - 1
        if title == "$GRAVITATION":
            gravity = list(self.machinery.gravity)
            gravity[place] = float(value)
            self.machinery.set_gravity(tuple(gravity))
        elif title == "$TIMER":
            stopped = self._timers.get(number, (0.0, True))[1]
            self._timers[number] = (float(value) if stopped else self.clock_ms - float(value), stopped)
        elif title == "$TIMER_STOP":
            value_now, stopped = self._timers.get(number, (0.0, True))
            if bool(value) != stopped:
                self._timers[number] = (self.clock_ms - value_now, bool(value))
        elif title == "$FRI_TO_INT":
            self._write_integer(place, value)
        elif title == "$FRI_TO_REA":
            self._write_real(place, value)
        else:
            bit = 1 << place
            session.to_bool = session.to_bool | bit if value else session.to_bool & ~bit

    def _commit(self, session: KrcSession) -> None:
        """Put strategy, stiffness and damping in force."""
        try:
            session.set_strategy(int(self.stiffness["STRATEGY"]))
        except RuntimeError as error:
            raise RobotError(str(error)) from error
        rows = np.empty((2, 7))
        for row, name in enumerate(("AXISSTIFFNESS", "AXISDAMPING")):
            for axis, place in zip(AXIS_NAMES, AXES, strict=True):
                rows[row, place] = float(self.stiffness[name].get(axis, 0.0))
        self.machinery.set_impedance(rows[0], rows[1])

    def call(self, name: str, values: list[Any]) -> Any:
        """Result of a function of the controller."""
        session = self._need()
        try:
            if name in _MATHEMATICS:
                return _MATHEMATICS[name](*(float(value) for value in values))
            if name == "FRIOPEN":
                session.fri_open(int(values[0]))
            elif name == "FRISTART":
                session.fri_start(float(values[0]))
            elif name == "FRISTOP":
                session.fri_stop()
            elif name == "FRICLOSE":
                session.fri_close()
        except (ValueError, TypeError) as error:
            raise RobotError(f"{name}: {error}") from error
        # friSetup, friShow and BAS have no effect: address, tool and velocities are the emulator's own. Neither
        # have the subprograms of modules that are not there.
        return f"#{session.state.name}" if name.startswith("FRI") else 0


def _steps(name: str) -> Path:
    return tuple(name[1:].split("."))


def _load(values: tuple[float, ...]) -> dict[str, Any]:
    load = copy.deepcopy(STRUCTURES["LOAD"])
    for name, value in zip(LOAD, values, strict=True):
        put(load, _steps(name), value, "$LOAD")
    return load
