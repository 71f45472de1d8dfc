"""KRL programs on the emulated controller: the laboratory's program text itself is run.

``KrlProgram`` knows the system variables and functions of the interface (``$FRI_TO_INT``, ``$FRISTATE``,
``friOpen`` ...), the control strategy, motor currents and load data. ``Interpreter`` runs it beside an FRI
session. Between two waits a program takes no time; a wait lasts whole ticks of 12 ms.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Generator, Mapping
from functools import lru_cache
from typing import Any, Protocol

import numpy as np

from fri import krl_source as tree
from fri.errors import ConfigurationError
from fri.krc import KrcSession
from fri.states import State

#: Period of the KRL interpreter [ms].
TICK_MS = 12
#: Indices of the axes of KRL (A1 to A6, then E1) in the kinematic order A1 A2 E1 A3 A4 A5 A6.
AXES = (0, 1, 3, 4, 5, 6, 2)
#: Load data in the order of ``Machinery.load``: mass [kg], centre of mass [mm], inertia about it [kg m2].
LOAD = (".M", ".CM.X", ".CM.Y", ".CM.Z", ".J.X", ".J.Y", ".J.Z")

_LONGEST_RUN = 2000
_ARRAYS = {f"$FRI_{way}_{kind}": 16 for way in ("FRM", "TO") for kind in ("INT", "REA", "BOOL")}
_ARRAYS["$CURR_ACT"] = 7
_STATES = ("$FRISTATE", "$FRIQUALITY", "$ON_PATH", "$ROB_STOPPED")
_PLAIN = (*_STATES, "$STIFFNESS.STRATEGY", "$STIFFNESS.COMMIT", "$ADVANCE", "$LOAD")
_READ_ONLY = (*_STATES, "$FRI_FRM_INT", "$FRI_FRM_REA", "$FRI_FRM_BOOL", "$CURR_ACT")
_GOALS = ("$AXIS_ACT", "$AXIS_ACT_MES")
_FUNCTIONS = {"FRISETUP": 3, "FRIOPEN": 1, "FRISTART": 1, "FRISTOP": 0, "FRICLOSE": 0, "BAS": 2}
_OPERATORS: dict[str, Callable[[Any, Any], Any]] = {
    "AND": lambda a, b: a and b,
    "OR": lambda a, b: a or b,
    "==": operator.eq,
    "<>": operator.ne,
    "<": operator.lt,
    ">": operator.gt,
    "<=": operator.le,
    ">=": operator.ge,
    "+": operator.add,
    "-": operator.sub,
    "*": operator.mul,
}

Flow = Generator[None, None, str]


class Machinery(Protocol):
    """Motor currents and load data of the controller, beside the FRI session."""

    currents: np.ndarray
    """(7,) motor currents in kinematic order, in the unit of the emulated drives."""

    @property
    def load(self) -> tuple[float, ...]:
        """Load data in force in the order of `LOAD`."""

    def set_load(self, load: tuple[float, ...]) -> None:
        """Put load data in force."""


class NoMachinery:
    """Drives without current, and load data without effect."""

    def __init__(self) -> None:
        self.currents = np.zeros(7)
        self.load: tuple[float, ...] = (0.0,) * len(LOAD)

    def set_load(self, load: tuple[float, ...]) -> None:
        """Keep `load`."""
        self.load = load


class KrlProgram:
    """A KRL module at work; ``step`` is one tick of the interpreter.

    text, data : content of the `.src` and the `.dat` file
    settings : values for variables of the data list, e.g. ``LWR_CYCLE``
    machinery : motor currents and load data; None takes drives without current

    Raises ConfigurationError with the line for a syntax error, or an unknown variable or function.
    """

    def __init__(
        self,
        text: str,
        data: str = "",
        settings: Mapping[str, float | int | str] | None = None,
        machinery: Machinery | None = None,
        name: str = "KRL program",
    ) -> None:
        self.name = name
        self.finished = False
        self.source = tree.parse_source(text, data, name)
        self.machinery: Any = machinery if machinery is not None else NoMachinery()
        self._session: KrcSession | None = None
        self._strategy = 10
        self._tick = 0
        self._flow: Flow | None = None
        _Check(self.source, name).module()
        self._variables: dict[str, Any] = {}
        for declared in self.source.declarations.values():
            empty: Any = (0.0,) * len(LOAD) if declared.kind == "LOAD" else 0
            self._variables[declared.name] = empty if declared.value is None else declared.value.value
        for key, value in (settings or {}).items():
            if key.upper() not in self._variables:
                known = ", ".join(sorted(self._variables))
                raise ConfigurationError(f"{name}: has no variable {key}; it has {known}")
            self._variables[key.upper()] = value

    def step(self, session: KrcSession) -> None:
        """One tick of the interpreter: on to the next wait."""
        self._session = session
        self._tick += 1
        if self._flow is None:
            self._flow = self._block(self.source.subprograms[self.source.main])
        try:
            next(self._flow)
        except StopIteration:
            self.finished = True

    def _block(self, statements: tuple[tree.Statement, ...]) -> Flow:
        """Run statements; the result is EXIT or RETURN if one of them ended the block, else empty."""
        for statement in statements:
            left = ""
            if isinstance(statement, tree.Assign):
                self._write(statement.target, self._value(statement.value))
            elif isinstance(statement, tree.Call):
                if statement.name in self.source.subprograms:
                    yield from self._block(self.source.subprograms[statement.name])
                else:
                    self._function(statement)
            elif isinstance(statement, tree.Leave):
                left = statement.what
            elif isinstance(statement, tree.Branch):
                chosen = statement.then if self._value(statement.condition) else statement.otherwise
                left = yield from self._block(chosen)
            elif isinstance(statement, tree.Switch):
                left = yield from self._block(self._case(statement))
            elif isinstance(statement, tree.Loop):
                left = yield from self._loop(statement)
            elif isinstance(statement, tree.For):
                left = yield from self._count(statement)
            elif isinstance(statement, tree.WaitFor):
                while not self._value(statement.condition):
                    yield
            elif isinstance(statement, tree.WaitSeconds):
                for _ in range(math.ceil(round(1000 * float(self._value(statement.seconds)) / TICK_MS, 9))):
                    yield
            else:
                yield from self._move()
            if left:
                return left
        return ""

    def _count(self, statement: tree.For) -> Flow:
        for value in range(int(self._value(statement.first)), int(self._value(statement.last)) + 1):
            self._write(statement.variable, value)
            left = yield from self._block(statement.body)
            if left:
                return "" if left == "EXIT" else left
        return ""

    def _case(self, statement: tree.Switch) -> tuple[tree.Statement, ...]:
        subject = self._value(statement.subject)
        for values, block in statement.cases:
            if any(self._value(value) == subject for value in values):
                return block
        return statement.default

    def _loop(self, statement: tree.Loop) -> Flow:
        passes = 0
        while True:
            if statement.condition is not None and not self._value(statement.condition):
                return ""
            tick = self._tick
            left = yield from self._block(statement.body)
            if left:
                return "" if left == "EXIT" else left
            passes = passes + 1 if tick == self._tick else 0
            if passes > _LONGEST_RUN:
                raise ConfigurationError(f"{self.name}, line {statement.line}: the loop never waits")

    def _move(self) -> Generator[None, None, None]:
        """Set KRL's setpoint to the position of the arm, once the arm stands."""
        session = self._need()
        while session.ramping:
            yield
        if session.state is not State.CMD:
            session.resync()

    def _need(self) -> KrcSession:
        assert self._session is not None
        return self._session

    def _value(self, expression: tree.Expression) -> Any:
        if isinstance(expression, tree.Constant):
            return expression.value
        if isinstance(expression, tree.Name):
            return self._read(expression)
        if isinstance(expression, tree.Binary):
            left, right = self._value(expression.left), self._value(expression.right)
            if expression.operator == "/":
                # KRL divides whole numbers without remainder.
                whole = isinstance(left, int) and isinstance(right, int)
                return int(left / right) if whole else left / right
            return _OPERATORS[expression.operator](left, right)
        if isinstance(expression, tree.Unary):
            value = self._value(expression.operand)
            return not value if expression.operator == "NOT" else -value
        return self._function(expression)

    def _read(self, name: tree.Name) -> Any:
        session, (title, field) = self._need(), _split(name.name)
        if title in self._variables or title == "$LOAD":
            value = self.machinery.load if title == "$LOAD" else self._variables[title]
            return value if not field else value[LOAD.index(field)]
        if name.index is None:
            return self._state(title)
        place = self._place(name)
        if title == "$CURR_ACT":
            return float(self.machinery.currents[AXES[place]])
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
        return not session.ramping if title == "$ROB_STOPPED" else self._strategy

    def _write(self, name: tree.Name, value: Any) -> None:
        session, (title, field) = self._need(), _split(name.name)
        if field:
            load = list(self._read(tree.Name(title)))
            load[LOAD.index(field)] = float(value)
            value = tuple(load)
        if title == "$LOAD":
            self.machinery.set_load(value)
        elif title in self._variables:
            self._variables[title] = value
        elif title == "$STIFFNESS.STRATEGY":
            self._strategy = int(value)
        elif title == "$STIFFNESS.COMMIT":
            session.set_strategy(self._strategy)
        elif title == "$FRI_TO_INT":
            session.to_int[self._place(name)] = int(value)
        elif title == "$FRI_TO_REA":
            session.to_real[self._place(name)] = float(value)
        elif title == "$FRI_TO_BOOL":
            bit = 1 << self._place(name)
            session.to_bool = session.to_bool | bit if value else session.to_bool & ~bit

    def _place(self, name: tree.Name) -> int:
        assert name.index is not None
        number = int(self._value(name.index))
        if not 1 <= number <= _ARRAYS[name.name]:
            raise ConfigurationError(
                f"{self.name}: {name.name}[{number}] is outside 1 to {_ARRAYS[name.name]}"
            )
        return number - 1

    def _function(self, call: tree.Call) -> Any:
        session = self._need()
        values = [self._value(argument) for argument in call.arguments]
        if call.name == "FRIOPEN":
            session.fri_open(int(values[0]))
        elif call.name == "FRISTART":
            session.fri_start(float(values[0]))
        elif call.name == "FRISTOP":
            session.fri_stop()
        elif call.name == "FRICLOSE":
            session.fri_close()
        # friSetup and BAS have no effect: address, tool and velocities are the emulator's own.
        return f"#{session.state.name}"


class Interpreter:
    """Runs `program` beside `session`, a tick every 12 ms; the first tick comes with the first call."""

    def __init__(self, session: KrcSession, program: KrlProgram) -> None:
        self.session = session
        self.program = program
        self._due_ms = 0

    def advance(self, milliseconds: int) -> None:
        """Let `milliseconds` pass, between two cycles; runs the ticks due."""
        while self._due_ms <= 0:
            if not self.program.finished:
                self.program.step(self.session)
            self._due_ms += TICK_MS
        self._due_ms -= milliseconds


@lru_cache(maxsize=256)
def _split(name: str) -> tuple[str, str]:
    """A name of load data and its field, `$LOAD` and `.CM.X`; any other name and nothing."""
    for field in LOAD:
        if name.endswith(field):
            return name.removesuffix(field), field
    return name, ""


class _Check:
    """Search a module for unknown names and wrong numbers of arguments."""

    def __init__(self, source: tree.Source, name: str) -> None:
        self._source, self._name = source, name

    def module(self) -> None:
        for block in self._source.subprograms.values():
            self._part(block, 0, written=False)

    def _statement(self, statement: tree.Statement) -> None:
        for value in vars(statement).values():
            self._part(value, statement.line, written=False)
        if isinstance(statement, (tree.Assign, tree.For)):
            target = statement.target if isinstance(statement, tree.Assign) else statement.variable
            self._variable(target, statement.line, written=True)

    def _part(self, value: Any, line: int, *, written: bool) -> None:
        if isinstance(value, tuple):
            for item in value:
                self._part(item, line, written=written)
        elif isinstance(value, tree.Name):
            self._variable(value, line, written=written)
        elif isinstance(value, tree.Statement) and not isinstance(value, tree.Call):
            self._statement(value)
        elif isinstance(value, tree.Call):
            wanted = _FUNCTIONS.get(value.name, 0 if value.name in self._source.subprograms else None)
            if wanted is None:
                raise self._error(value.line, f"there is no function {value.name}")
            if wanted != len(value.arguments):
                raise self._error(
                    value.line, f"{value.name} takes {wanted} arguments, not {len(value.arguments)}"
                )
            self._part(value.arguments, value.line, written=False)
        elif isinstance(value, (tree.Unary, tree.Binary)):
            for inner in vars(value).values():
                self._part(inner, line, written=False)

    def _variable(self, name: tree.Name, line: int, *, written: bool) -> None:
        title, field = _split(name.name)
        declared = self._source.declarations.get(title)
        if field and title != "$LOAD" and (declared is None or declared.kind != "LOAD"):
            raise self._error(line, f"there is no variable {name.name}")
        if declared is None:
            if title not in (*_ARRAYS, *_PLAIN, *_GOALS):
                raise self._error(line, f"there is no variable {title}")
            if title in _ARRAYS and name.index is None:
                raise self._error(line, f"{title} needs an index")
            if written and title in (*_READ_ONLY, *_GOALS):
                raise self._error(line, f"{title} cannot be written")
        if name.index is not None:
            self._part(name.index, line, written=False)

    def _error(self, line: int, text: str) -> ConfigurationError:
        return ConfigurationError(f"{self._name}, line {line}: {text}")
