"""KRL programs on the emulated controller: the laboratory's program text itself is run.

``KrlProgram`` runs the statements of `fri.krl_source` one after the other, with the values of `fri.krl_values`.
``Interpreter`` runs it beside an FRI session. A statement takes `statement_ms`, by default nothing; a wait ends with
a tick of the interpolation cycle, 12 ms. Interrupts, Cartesian motions and unknown system variables have no effect,
and ``KrlProgram.remarks`` names each of them.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Generator, Mapping
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from fri import krl_source
from fri import krl_tree as tree
from fri.errors import ConfigurationError, RobotError
from fri.krc import KrcSession
from fri.krl_check import Check
from fri.krl_motion import PointToPoint
from fri.krl_system import AXIS_NAMES, HERE, Machinery, NoMachinery, System, duplicate, positions
from fri.krl_values import Frame, Values
from fri.states import Control, State

#: Interpolation cycle of the controller: a wait ends at its ticks [ms].
TICK_MS = 12

# A statement due so soon runs now [ms].
_DUE_MS = 1e-6
_LONG = 10**6
_LONGEST_RUN = 2000
_DEEPEST = 100
_SPEED_SHARE = 0.25
_FRAME = frozenset("XYZABC")

# Both yield times of the interpreter's clock [ms]; the result of `Flow` is EXIT or RETURN if one of them ended the
# block, else empty.
Wait = Generator[float, None, None]
Flow = Generator[float, None, str]


class _Step(NamedTuple):
    """A statement prepared.

    plain : takes no time and never waits. act : does it at once, for one that runs no others; choose : the block to run
    """

    line: int
    plain: bool
    act: Callable[[], str] | None
    choose: Callable[[], tuple[tree.Statement, ...]] | None
    statement: tree.Statement


class KrlProgram:
    """A KRL module at work; ``step`` is one tick of the interpreter.

    text, data : content of the `.src` and the `.dat` file
    settings : values for variables of the data list, e.g. ``LWR_CYCLE``
    machinery : the controller and its arm; None takes drives without current
    statement_ms : time of a statement [ms]. halt_s : time until somebody presses start after HALT [s]
    modules : text and data of further modules by name, for their global subprograms
    remarks : what the program asks for and does not get, a sentence each

    Raises ConfigurationError with the line for a syntax error, or an unknown variable or function. A program that
    fails at work raises RobotError, as the controller stops it with a message.
    """

    def __init__(
        self,
        text: str,
        data: str = "",
        settings: Mapping[str, float | int | str] | None = None,
        machinery: Machinery | None = None,
        name: str = "KRL program",
        *,
        statement_ms: float = 0.0,
        halt_s: float = 1.0,
        modules: Mapping[str, tuple[str, str]] | None = None,
    ) -> None:
        self.name = name
        self.finished = False
        self.machinery: Any = machinery if machinery is not None else NoMachinery()
        self.source = krl_source.parse_source(text, data, name)
        self._sources = [self.source]
        for title, (more, values) in (modules or {}).items():
            self._sources.append(krl_source.parse_source(more, values, title))
        self._programs: dict[str, tuple[int, tree.Subprogram]] = {}
        for number, source in enumerate(self._sources):
            for title, subprogram in source.subprograms.items():
                self._programs.setdefault(title, (number, subprogram))
        check = Check(self._sources, self._programs, name)
        check.run()
        self.remarks: tuple[str, ...] = tuple(check.remarks)
        self._statement_ms, self._halt_s = statement_ms, halt_s
        self._system = System(self.machinery)
        self._clock = self._due = self._owed = self._now_ms = 0.0
        self._ticks = 0
        self._nested = 0
        self._line = 0
        # By identity: prepared blocks, and whether a statement takes no time and never waits.
        self._prepared: dict[int, list[_Step]] = {}
        self._plain: dict[int, bool] = {}
        self._flow: Wait | None = None
        self._motion: PointToPoint | None = None
        self._values = Values(self._sources, self._programs, self._system, self._nested_call)
        known = self._values.modules[0]
        for key, value in (settings or {}).items():
            if key.upper() not in known:
                raise ConfigurationError(f"{name}: has no variable {key}; it has {', '.join(sorted(known))}")
            known[key.upper()] = value

    def preset(self, name: str, value: float | int | str) -> bool:
        """Set a variable of the data list before the start; whether the program has it."""
        known = self._values.modules[0]
        if name not in known:
            return False
        known[name] = value
        return True

    def step(self, session: KrcSession) -> None:
        """One tick of the interpreter: all statements up to it."""
        self.run(session, self._ticks * TICK_MS)
        self._ticks += 1

    def run(self, session: KrcSession, now_ms: float) -> None:
        """Run all statements due at `now_ms` or before."""
        self._system.session = session
        self._now_ms = now_ms
        if self._flow is None:
            self._flow = self._enter(self.source.main, [])
        while not self.finished and self._due <= now_ms + _DUE_MS:
            self._clock = self._system.clock_ms = self._due
            try:
                self._due = next(self._flow)
            except StopIteration:
                self.finished = True
            except (RobotError, ArithmeticError, TypeError, ValueError) as error:
                self.finished = True
                raise RobotError(f"{self.name}, line {self._line}: {error}") from error

    @property
    def due_ms(self) -> float:
        """When the next statement is due; the first one at once."""
        return self._due

    @property
    def moving(self) -> bool:
        """Whether KRL's setpoint moves."""
        return self._motion is not None

    def drive(self, session: KrcSession, now_ms: float) -> None:
        """Give the session KRL's setpoint at `now_ms`, the end of the next cycle, during a motion."""
        motion = self._motion
        if motion is None:
            return
        if not self.machinery.powered or motion.commanded != (session.state is State.CMD):
            self._motion = None
            return
        session.move_krl(motion.position(now_ms))
        if now_ms - motion.begin_ms >= motion.duration_ms:
            self._motion = None

    # Flow

    def _tick(self, after_ms: float = 0.0) -> float:
        """The next tick; with `after_ms` the first one at least so much later."""
        if after_ms > 0.0:
            return math.ceil(round((self._clock + after_ms) / TICK_MS, 9)) * TICK_MS
        return (math.floor(round(self._clock / TICK_MS, 9)) + 1) * TICK_MS

    def _spend(self) -> float | None:
        """Take the time of a statement, and of functions before it; the time to wait for, None if it has come."""
        cost, self._owed = self._statement_ms + self._owed, 0.0
        if self._nested:
            self._owed += cost
        elif cost > 0.0:
            due = self._clock + cost
            if due > self._now_ms + _DUE_MS:
                return due
            self._clock = self._system.clock_ms = due
        return None

    def _pause(self, until_ms: float) -> Wait:
        if self._nested:
            raise RobotError(
                "a function that waits is called within an expression; assign its result to a variable"
            )
        yield until_ms

    def _enter(self, title: str, arguments: list[Any]) -> Wait:
        """Run the subprogram `title` with the values of its arguments; its frame holds the result."""
        frame = self._frame(title, arguments)
        try:
            yield from self._block(self._programs[title][1].body)
        finally:
            self._values.frames.pop()
            self._last = frame

    def _frame(self, title: str, arguments: list[Any]) -> Frame:
        """The frame of a subprogram that begins with the values of its arguments."""
        module, subprogram = self._programs[title]
        if len(self._values.frames) > _DEEPEST:
            raise RobotError(f"{title} calls itself without end")
        frame = Frame(module, self._values.first_values(subprogram.declarations))
        for (name, _), value in zip(subprogram.parameters, arguments, strict=False):
            frame.values[name] = duplicate(value)
        self._values.frames.append(frame)
        return frame

    def _call(self, call: tree.Call) -> Wait:
        """Run a subprogram of the program; changed arguments by reference go back to the caller."""
        yield from self._enter(call.name, [self._values.of(argument) for argument in call.arguments])
        self._give_back(call)

    def _give_back(self, call: tree.Call) -> None:
        _, subprogram = self._programs[call.name]
        frame = self._last
        for (name, by_value), argument in zip(subprogram.parameters, call.arguments, strict=False):
            if not by_value and isinstance(argument, tree.Name):
                self._values.write(argument, frame.values[name])
        self._last = frame

    def _call_at_once(self, call: tree.Call) -> None:
        """As `_call`, for a subprogram that never waits."""
        frame = self._frame(call.name, [self._values.of(argument) for argument in call.arguments])
        try:
            self._run_at_once(self._programs[call.name][1].body)
        finally:
            self._values.frames.pop()
            self._last = frame
        self._give_back(call)

    def _block(self, statements: tuple[tree.Statement, ...]) -> Flow:
        """Run statements; the result is EXIT or RETURN if one of them ended the block, else empty."""
        for line, plain, act, choose, statement in self._steps(statements):
            self._line = line
            if not plain and (due := self._spend()) is not None:
                yield due
            if act is not None:
                left = act()
            elif choose is not None:
                left = yield from self._block(choose())
            else:
                left = yield from self._statement(statement)
            if left:
                return left
        return ""

    def _steps(self, statements: tuple[tree.Statement, ...]) -> list[_Step]:
        """The statements of a block, prepared at its first run."""
        try:
            return self._prepared[id(statements)]
        except KeyError:
            self._prepared[id(statements)] = steps = [self._step_of(statement) for statement in statements]
            return steps

    def _step_of(self, statement: tree.Statement) -> _Step:
        plain = self._is_plain(statement)
        act: Callable[[], str] | None = None
        choose: Callable[[], tuple[tree.Statement, ...]] | None = None
        if plain or self._is_single(statement):
            act = partial(self._do, statement)
        if isinstance(statement, tree.Assign) and self._is_single(statement):
            act = self._assignment(statement)
        elif isinstance(statement, tree.Branch):
            choose = partial(self._chosen, statement, self._values.evaluator(statement.condition))
        elif isinstance(statement, tree.Switch):
            choose = self._switch(statement)
        return _Step(statement.line, plain, act, choose, statement)

    def _assignment(self, statement: tree.Assign) -> Callable[[], str]:
        value, write = self._values.evaluator(statement.value), self._values.writer(statement.target)

        def act() -> str:
            write(value())
            return ""

        return act

    def _switch(self, statement: tree.Switch) -> Callable[[], tuple[tree.Statement, ...]]:
        subject = self._values.evaluator(statement.subject)
        cases = [
            ([self._values.evaluator(value) for value in values], block) for values, block in statement.cases
        ]

        def choose() -> tuple[tree.Statement, ...]:
            chosen = subject()
            for values, block in cases:
                if any(value() == chosen for value in values):
                    return block
            return statement.default

        return choose

    @staticmethod
    def _chosen(statement: tree.Branch, condition: Callable[[], Any]) -> tuple[tree.Statement, ...]:
        return statement.then if condition() else statement.otherwise

    def _is_plain(self, statement: tree.Statement) -> bool:
        """Whether the statement takes no time and never waits: it needs no `Flow` then."""
        plain = self._plain.get(id(statement))
        if plain is None:
            self._plain[id(statement)] = False  # for a subprogram that calls itself
            self._plain[id(statement)] = plain = self._statement_ms == 0.0 and self._cannot_wait(statement)
        return plain

    def _is_single(self, statement: tree.Statement) -> bool:
        """Whether the statement waits at most at its beginning, and runs no others."""
        single = isinstance(statement, (tree.Assign, tree.Leave, tree.Call))
        return single and self._called(statement) is None

    def _called(self, statement: tree.Statement) -> tree.Call | None:
        """The call of a subprogram that is the whole statement, or the whole value that it assigns."""
        call = statement.value if isinstance(statement, tree.Assign) else statement
        return call if isinstance(call, tree.Call) and call.name in self._programs else None

    def _cannot_wait(self, statement: tree.Statement) -> bool:
        blocks: list[tuple[tree.Statement, ...]] = []
        if isinstance(statement, (tree.Assign, tree.Call)):
            call = self._called(statement)
            if call is not None:
                blocks.append(self._programs[call.name][1].body)
        elif isinstance(statement, tree.Branch):
            blocks += [statement.then, statement.otherwise]
        elif isinstance(statement, tree.Switch):
            blocks += [statement.default, *(block for _, block in statement.cases)]
        elif not isinstance(statement, tree.Leave):
            return False
        return all(self._is_plain(part) for block in blocks for part in block)

    def _run_at_once(self, statements: tuple[tree.Statement, ...]) -> str:
        """As `_block`, for statements that never wait."""
        for step in self._steps(statements):
            self._line = step.line
            assert step.act is not None
            left = step.act()
            if left:
                return left
        return ""

    def _do(self, statement: tree.Statement) -> str:
        """Run a statement that never waits on its way; EXIT or RETURN, else empty."""
        if isinstance(statement, tree.Branch):
            return self._run_at_once(
                statement.then if self._values.of(statement.condition) else statement.otherwise
            )
        if isinstance(statement, tree.Switch):
            return self._run_at_once(self._switch(statement)())
        if isinstance(statement, tree.Leave):
            if statement.value is not None:
                self._values.frames[-1].result = copy.deepcopy(self._values.of(statement.value))
            return statement.what
        call = self._called(statement)
        if call is not None:
            self._call_at_once(call)
            if isinstance(statement, tree.Assign):
                self._values.write(statement.target, self._last.result)
        elif isinstance(statement, tree.Call):
            self._values.of(statement)
        return ""

    def _statement(self, statement: tree.Statement) -> Flow:
        """Run a statement that may wait on its way; `_do` runs the others."""
        left = ""
        call = self._called(statement)
        if call is not None:
            yield from self._call(call)
            if isinstance(statement, tree.Assign):
                self._values.write(statement.target, self._last.result)
        elif isinstance(statement, (tree.Loop, tree.Repeat)):
            left = yield from self._loop(statement)
        elif isinstance(statement, tree.For):
            left = yield from self._count(statement)
        elif isinstance(statement, tree.WaitFor):
            while not self._values.of(statement.condition):
                yield from self._pause(self._tick())
        elif isinstance(statement, tree.WaitSeconds):
            milliseconds = 1000.0 * float(self._values.of(statement.seconds))
            if milliseconds > 0.0:
                yield from self._pause(self._tick(milliseconds))
        elif isinstance(statement, tree.Halt):
            self.machinery.say(
                f"{self.name}, line {statement.line}: HALT; start is pressed in {self._halt_s:g} s"
            )
            yield from self._pause(self._tick(1000.0 * self._halt_s))
        elif isinstance(statement, tree.Move):
            yield from self._move(statement)
        return left

    def _count(self, statement: tree.For) -> Flow:
        value, last = int(self._values.of(statement.first)), int(self._values.of(statement.last))
        step = int(self._values.of(statement.step))
        while (value <= last) if step > 0 else (value >= last and step < 0):
            self._values.write(statement.variable, value)
            left = yield from self._block(statement.body)
            if left:
                return "" if left == "EXIT" else left
            if (due := self._spend()) is not None:
                yield due
            value += step
        self._values.write(statement.variable, value)
        return ""

    def _loop(self, statement: tree.Loop | tree.Repeat) -> Flow:
        passes, until = 0, isinstance(statement, tree.Repeat)
        while True:
            if not until and statement.condition is not None and not self._values.of(statement.condition):
                return ""
            clock = self._clock
            left = yield from self._block(statement.body)
            if left:
                return "" if left == "EXIT" else left
            if until and statement.condition is not None and self._values.of(statement.condition):
                return ""
            if (due := self._spend()) is not None:
                yield due
            passes = passes + 1 if clock == self._clock else 0
            if passes > _LONGEST_RUN:
                self._line = statement.line
                raise RobotError("the loop never waits")

    def _move(self, statement: tree.Move) -> Wait:
        """Move KRL's setpoint to the goal; to the place of the arm, once the arm stands."""
        session = self._need()
        while session.ramping:
            yield from self._pause(self._tick())
        here = isinstance(statement.goal, tree.Name) and statement.goal.name in HERE
        if here:
            if session.state is not State.CMD:
                # A spring holds the arm away from its setpoint.
                soft = session.control is not Control.POSITION
                session.resync(self.machinery.position if soft else None)
            return
        goal = self._values.of(statement.goal)
        axes = isinstance(goal, dict) and goal.keys() & AXIS_NAMES
        # A frame may have E1 too.
        if not axes or (axes == {"E1"} and goal.keys() & _FRAME):
            self.machinery.say(f"{self.name}, line {statement.line}: a Cartesian goal is passed over")
            return
        target = positions(goal, session.krl_setpoint, relative=statement.relative)
        outside = (target < session.limits.q_min - 1e-6) | (target > session.limits.q_max + 1e-6)
        if outside.any():
            raise RobotError(
                f"software limit: the goal {np.degrees(target).round(2).tolist()} deg is out of reach"
            )
        while True:
            while session.ramping or not self.machinery.powered:
                yield from self._pause(self._tick())
            if session.state is not State.CMD:
                session.resync()
            share = _SPEED_SHARE * max(1.0, float(self._system.read("$OV_PRO", ()))) / 100.0
            self._motion = PointToPoint(session, target, self._clock, share)
            while self._motion is not None:
                yield from self._pause(self._tick())
            if session.state is State.CMD or np.array_equal(session.krl_setpoint, target.astype(np.float32)):
                return

    def _need(self) -> KrcSession:
        assert self._system.session is not None
        return self._system.session

    def _nested_call(self, call: tree.Call) -> Any:
        """The result of a subprogram that is called within an expression."""
        self._nested += 1
        try:
            for _ in self._call(call):
                pass
        finally:
            self._nested -= 1
        return self._last.result


class Interpreter:
    """Runs `program` beside `session`; the first statements run with the first call."""

    def __init__(self, session: KrcSession, program: KrlProgram) -> None:
        self.session = session
        self.program = program
        self._now_ms = 0

    @property
    def moving(self) -> bool:
        """Whether the program moves KRL's setpoint."""
        return self.program.moving

    def idle_cycles(self, milliseconds: int) -> int:
        """How often `advance` by `milliseconds` would do nothing before the next statement is due."""
        if self.program.finished:
            return _LONG
        due_ms = self.program.due_ms
        wait = max(math.ceil(due_ms - _DUE_MS - self._now_ms), 0)
        # Against rounding: the very comparison of `run`.
        while wait and due_ms <= self._now_ms + wait - 1 + _DUE_MS:
            wait -= 1
        return wait // milliseconds

    def skip(self, milliseconds: int) -> None:
        """Let `milliseconds` pass without a statement."""
        self._now_ms += milliseconds

    def advance(self, milliseconds: int) -> None:
        """Let the `milliseconds` of a cycle pass, between two cycles; runs the statements due."""
        for _ in range(milliseconds):
            self.millisecond()
        self.drive()

    def millisecond(self) -> None:
        """Run the statements due in the coming millisecond of the cycle."""
        if not self.program.finished:
            self.program.run(self.session, self._now_ms)
        self._now_ms += 1

    def drive(self) -> None:
        """Give the session KRL's setpoint for the next cycle, during a motion."""
        self.program.drive(self.session, self._now_ms + self.session.sample_time_ms)
