"""Emulated KRL programs: what runs on the controller beside FRI and obeys the PC's KRL variables.

Three published programs are emulated by what they exchange with the PC: Stanford's FRIControl,
CentroEPiaggio's ros_control, and RCPRG's fri_start. Each is a state machine stepped at the interpreter's tick
of 12 ms. The PC's side of each is in ``fri.handshake``.

Two liberties of ours: a wait for quality or for command mode also ends when the PC withdraws its request,
where the published programs would hang; and after a fallback a start first sets KRL's setpoint anew (``PTP
$AXIS_ACT``). Screen messages and their pauses are left out. None starts command mode again by itself.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from enum import Enum, auto
from types import MappingProxyType
from typing import Protocol

from fri.krc import KrcSession
from fri.states import Quality, State

__all__ = ["PROGRAMS", "Interpreter", "KrlProgram", "RcprgProgram", "RosProgram", "StanfordProgram"]

#: Period of the KRL interpreter [ms].
TICK_MS = 12


class KrlProgram(Protocol):
    """A KRL program; ``step`` is one tick of the interpreter."""

    name: str
    finished: bool

    def step(self, session: KrcSession) -> None:
        """Run one tick, between two cycles of `session`."""


class Interpreter:
    """Runs a program at the interpreter's tick.

    Parameters
    ----------
    session : KrcSession
    program : KrlProgram or None
        None runs the background alone.
    background : callable or None
        Called with the session at every tick before the program, as the submit interpreter is; for instance
        to publish motor torques in ``$FRI_TO_REA``.
    tick_ms : int
        Period [ms].
    """

    def __init__(
        self,
        session: KrcSession,
        program: KrlProgram | None = None,
        background: Callable[[KrcSession], None] | None = None,
        tick_ms: int = TICK_MS,
    ) -> None:
        self.session = session
        self.program = program
        self.background = background
        self.tick_ms = tick_ms
        # The first tick comes with the first call.
        self._due_ms = 0

    def advance(self, milliseconds: int) -> None:
        """Let `milliseconds` pass, between two cycles; runs the ticks that fall due."""
        while self._due_ms <= 0:
            if self.background is not None:
                self.background(self.session)
            if self.program is not None and not self.program.finished:
                self.program.step(self.session)
            self._due_ms += self.tick_ms
        self._due_ms -= milliseconds


class _Step(Enum):
    BEGIN = auto()
    SETTLE = auto()
    LOOP = auto()
    QUALITY = auto()
    COMMAND = auto()
    PAUSE = auto()
    ENDING = auto()
    END = auto()


def _begin(session: KrcSession) -> None:
    """What every program does first: end what was open and clear the variables to the PC."""
    session.fri_close()
    session.to_int[:] = 0
    session.to_real[:] = 0.0
    session.to_bool = 0


class StanfordProgram:
    """Stanford's FRIControl.

    ``$FRI_FRM_INT[15]`` strategy, ``[16]`` 10 start, 20 stop, abort code: close. ``$FRI_TO_INT[16]`` 10
    opened, 20 started, 30 closed; ``[15]`` the abort code, 30 or 40, toggled from one run of the program to
    the next.
    """

    name = "stanford"
    _CLOSING_TICKS = 8

    def __init__(self, sample_time_ms: int, abort_code: int = 30) -> None:
        if abort_code not in (30, 40):
            raise ValueError(f"abort code {abort_code} is neither 30 nor 40")
        self.finished = False
        self.abort_code = abort_code
        self._sample_time_ms = sample_time_ms
        self._step = _Step.BEGIN
        self._ticks = 0

    def step(self, session: KrcSession) -> None:
        """One tick of the interpreter."""
        request = int(session.from_int[15])
        status = session.to_int
        if self._step is _Step.BEGIN:
            _begin(session)
            status[14] = self.abort_code
            self._step = _Step.SETTLE
        elif self._step is _Step.SETTLE:
            if session.ramping:
                return
            session.resync()
            session.set_strategy(10)
            session.fri_open(self._sample_time_ms)
            status[15] = 10
            self._step = _Step.LOOP
        elif self._step is _Step.LOOP:
            if request == self.abort_code:
                status[15] = 30
                self._step = _Step.ENDING
            elif request == 10 and status[15] != 20:
                if _ready(session):
                    session.set_strategy(int(session.from_int[14]))
                    self._step = _Step.QUALITY
            elif request == 20 and status[15] != 10:
                session.fri_stop()
                status[15] = 10
        elif self._step is _Step.QUALITY or self._step is _Step.COMMAND:
            self._step = _starting(session, self._step, withdrawn=request != 10)
            if self._step is _Step.LOOP and session.state is State.CMD:
                status[15] = 20
        elif self._step is _Step.ENDING:
            # The PC must be able to read the 30 before the packets end.
            self._ticks += 1
            if self._ticks >= self._CLOSING_TICKS:
                session.fri_close()
                self._step = _Step.END
                self.finished = True


class RosProgram:
    """CentroEPiaggio's ros_control.

    ``$FRI_FRM_INT[1]`` strategy, ``[2]`` 1 start, 0 stop. ``$FRI_TO_INT[2]`` 10 until the first start, then 1
    started, 0 stopped. The first start stays in position control. There is no close.
    """

    name = "ros_control"

    def __init__(self, sample_time_ms: int) -> None:
        self.finished = False
        self._sample_time_ms = sample_time_ms
        self._step = _Step.BEGIN

    def step(self, session: KrcSession) -> None:
        """One tick of the interpreter."""
        request = int(session.from_int[1])
        status = session.to_int
        if self._step is _Step.BEGIN:
            _begin(session)
            status[1] = 10
            self._step = _Step.SETTLE
        elif self._step is _Step.SETTLE:
            if session.ramping:
                return
            session.resync()
            session.set_strategy(10)
            session.fri_open(self._sample_time_ms)
            self._step = _Step.LOOP
        elif self._step is _Step.LOOP:
            if request == 0 and status[1] == 1:
                session.fri_stop()
                status[1] = 0
            elif request == 1 and status[1] != 1 and _ready(session):
                if status[1] != 10:
                    session.set_strategy(int(session.from_int[0]))
                self._step = _Step.QUALITY
        elif self._step is _Step.QUALITY or self._step is _Step.COMMAND:
            self._step = _starting(session, self._step, withdrawn=request != 1)
            if self._step is _Step.LOOP and session.state is State.CMD:
                status[1] = 1


class RcprgProgram:
    """RCPRG's fri_start.

    ``$FRI_FRM_BOOL[1]`` makes the request of ``$FRI_FRM_INT[1]``: 1 start, 2 stop, 3 open again with the
    period of ``$FRI_FRM_INT[2]``; ``$FRI_TO_BOOL[1]`` acknowledges while it is being carried out. Joint
    impedance control. A request that simply stays is carried out once; the published program repeats it.
    """

    name = "rcprg"
    _PAUSE_TICKS = 17

    def __init__(self, sample_time_ms: int) -> None:
        self.finished = False
        self._sample_time_ms = sample_time_ms
        self._step = _Step.BEGIN
        self._ticks = 0
        self._served: int | None = None

    def step(self, session: KrcSession) -> None:
        """One tick of the interpreter."""
        if self._step is _Step.BEGIN:
            _begin(session)
            self._step = _Step.SETTLE
        elif self._step is _Step.SETTLE:
            if session.ramping:
                return
            session.resync()
            session.set_strategy(30)
            session.fri_open(self._sample_time_ms)
            self._step = _Step.LOOP
        elif self._step is _Step.LOOP:
            request = int(session.from_int[0]) if session.from_bool & 1 else None
            if request is not None and request != self._served:
                session.to_bool |= 1
                self._carry_out(session, request)
                self._ticks = 0
                self._step = _Step.PAUSE
            self._served = request
        elif self._step is _Step.PAUSE:
            self._ticks += 1
            if self._ticks >= self._PAUSE_TICKS and not session.ramping:
                if session.state is State.MON:
                    session.resync()
                session.to_bool &= ~1
                self._step = _Step.LOOP

    def _carry_out(self, session: KrcSession, request: int) -> None:
        if request == 1 and _ready(session):
            session.fri_start(1.0)
        elif request == 2:
            session.fri_stop()
        elif request == 3 and 1 <= int(session.from_int[1]) <= 100:
            self._sample_time_ms = int(session.from_int[1])
            session.fri_close()
            session.fri_open(self._sample_time_ms)


def _ready(session: KrcSession) -> bool:
    """Whether a start may begin: monitor mode, the arm at rest, KRL's setpoint in step."""
    if session.state is State.CMD:
        return True
    if session.ramping:
        return False
    if session.needs_resync:
        session.resync()
    return True


def _starting(session: KrcSession, step: _Step, withdrawn: bool) -> _Step:
    """Wait for quality, call friStart, wait for command mode; back to the loop when there or withdrawn."""
    if withdrawn:
        session.fri_stop()
        return _Step.LOOP
    if step is _Step.QUALITY:
        if session.quality is not Quality.PERFECT:
            return step
        session.fri_start(1.0)
        return _Step.COMMAND
    return _Step.LOOP if session.state is State.CMD else step


#: The programs by name; each is made with the sample time [ms].
PROGRAMS: Mapping[str, Callable[[int], KrlProgram]] = MappingProxyType(
    {program.name: program for program in (StanfordProgram, RosProgram, RcprgProgram)}
)
