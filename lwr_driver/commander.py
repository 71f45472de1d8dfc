"""The command of a cycle: hold, a row of the motion, or a stop; guarded, and without any socket.

Every value passes the guard. A refused value is not sent: the arm is stopped instead. If even the stop would
break a limit, no more answers are sent, and the controller brakes by itself.

The rows of a motion are counted by the controller's packets, not by answers: after a lost packet the motion
continues as if it had come. In between the controller extrapolates.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fri.packets import leading
from lwr_driver.arm import JOINTS, ArmLimits
from lwr_driver.control import Control, Mode, Result, Text, Word
from lwr_driver.guard import Guard, Retreat, Stop, Violation
from lwr_driver.ring import NO_PHASE

HOLD, BRAKE, CONTACT, RETREAT = 0, 1, 2, 3
"""Phase numbers given by the loop itself: holding; stopping before the end of a motion, or at a contact; going back."""

# A retreat ends where the arm was commanded so long before the contact was noticed.
BEFORE_CONTACT_S = 0.05
# An arm at rest is pressed by more than this share of the limit of the external torque.
_PRESSED = 0.5

# New values foreseen in a cycle: one is used up, and it must not take long.
_MORE = 3


class Foreseen(NamedTuple):
    """Values of the next packets.

    values : (7,) float32 each [rad], the last `new` of them new since the last call
    room : largest distance of arm and set point from the value sent before, for the values to hold [rad]
    """

    values: list[NDArray[np.float32]]
    new: int
    room: float


class _Ahead:
    """Values of the packets from `sequence` on, each checked by a guard after the values before it.

    sent : number of values sent so far; state : the values hold in this state only; cycles : from the last
    value sent to the first of these
    """

    def __init__(self, sequence: int, sent: int, state: object, guard: Guard, cycles: int) -> None:
        self._sequence, self._sent, self._state = sequence, sent, state
        self._guard, self._cycles = guard, cycles
        self.values: list[NDArray[np.float32]] = []

    def advance(self, sequence: int, sent: int, state: object) -> bool:
        """Drop the sent values; False unless each packet got its value and nothing else happened."""
        used = sent - self._sent
        if state != self._state or used != sequence - self._sequence or used > len(self.values):
            return False
        del self.values[:used]
        self._sequence, self._sent = sequence, sent
        return True

    def add(self, value: NDArray[np.float32]) -> bool:
        """Append a value if it passes the guard."""
        if self._guard.check(value, self._cycles) is not None:
            return False
        self._cycles = 1
        self.values.append(value)
        return True


class Commander:
    """Chooses the position of each cycle in command mode.

    limits : of every value sent; control : shared memory with the motion; joint_names : for reasons
    tracking_limit : largest distance of the arm, or of the controller's set point, from the last value sent;
        beyond it a motion is stopped [rad]

    mode : kind of answer; index : row of the motion, -1 outside one; phase : number of the phase
    target : last value sent (7,) float32, NaN before the first
    ended : result and reason of the motion, (NONE, "") before its end
    barred : why no motion may begin before `allow`: a fallback or a contact; empty if one may
    external, allowed : external torque and its limit (7,) [Nm], as the watch has them; zero without one
    """

    def __init__(
        self, limits: ArmLimits, control: Control, joint_names: tuple[str, ...], tracking_limit: float
    ) -> None:
        self._limits, self._control, self._joint_names = limits, control, joint_names
        self._plan, self._tracking_limit = control.plan, tracking_limit
        self.mode = Mode.MIRROR
        self.index, self.phase = -1, NO_PHASE
        self.target = np.full(JOINTS, np.nan, dtype=np.float32)
        self.ended: tuple[Result, str] = (Result.NONE, "")
        self._period = 0.0
        self.barred = ""
        self._touched = False  # whether a contact is the reason
        self.external, self.allowed = np.zeros(JOINTS), np.zeros(JOINTS)
        self._guard: Guard
        self._stop: Stop
        self._retreat: Retreat
        self._origin: NDArray[np.float64] | None = None  # goal of a retreat from the contact
        self._since_sent = 0  # cycles since `target` was sent
        self._sent = 0  # values, altogether
        self._ahead: _Ahead | None = None
        self._past = np.zeros((3, JOINTS))  # rows commanded in that cycle and in the two before it
        self._hold = np.zeros(JOINTS)
        self._base, self._rows = 0, 0
        self._next_phase = 0
        self._pending: tuple[Result, str] = (Result.NONE, "")  # why the stop under way was begun
        self._stopping = False  # whether a stop was under way when command mode was lost

    def set_period(self, period_s: float) -> None:
        """Take the controller's cycle [s]; not in command mode."""
        self._period = period_s
        self.target = np.full(JOINTS, np.nan, dtype=np.float32)
        self._guard = Guard(self._limits, period_s)
        self._stop = Stop(self._limits, period_s)
        self._retreat = Retreat(self._limits, period_s)

    @property
    def moving(self) -> bool:
        """Whether a motion or a stop is under way."""
        return self.mode in (Mode.MOTION, Mode.STOP)

    def enter(
        self, setpoint: NDArray[np.float32], safety_limits: float, step: NDArray[np.float64] | None = None
    ) -> NDArray[np.float32] | None:
        """Begin to command with the controller's own set point; returns the value to send.

        step : of the set point per cycle (7,) [rad], None at rest

        A moving set point means a loss of command mode in motion. It is brought to rest within the limits:
        from the rows of the motion if it equals the value sent last, else from its present velocity.
        """
        moves = step is not None and bool(step.any())
        self._guard.scale_velocity(safety_limits)
        self.index, self.phase = -1, HOLD
        self._control.tracking[:] = 0.0
        self.mode = Mode.HOLD
        if step is not None and moves and self.follows(setpoint):
            self._since_sent = 1
            if self._stopping:
                self._pending, self.mode = self.ended, Mode.STOP
            else:
                self.stop(*self.ended)
            return self.command(0)
        self.target = setpoint.copy()
        self._hold = setpoint.astype(np.float64)
        self._past[:] = self._hold
        if step is not None and moves:
            self._past -= np.arange(3)[:, np.newaxis] * step
        self._guard.reset(setpoint, step / self._period if step is not None and moves else None)
        self._since_sent = 0
        if not moves:
            return self.target
        self._since_sent = 1
        self.stop(*self.ended)
        return self.command(0)

    def follows(self, setpoint: NDArray[np.float32]) -> bool:
        """Whether the set point is the value sent last: the controller has missed nothing."""
        return bool(np.array_equal(setpoint, self.target))

    def watch(self, elapsed: int, setpoint: NDArray[np.float32], q: NDArray[np.float32]) -> None:
        """Count `elapsed` cycles, and stop if arm or set point are too far from the value sent."""
        self._since_sent += elapsed
        error = np.abs(q - self.target)
        np.maximum(self._control.tracking, error, out=self._control.tracking)
        if self.mode is not Mode.MOTION:
            return
        limit = self._tracking_limit
        subject, distance = "measured position", error
        away = np.abs(setpoint - self.target)
        if np.maximum.reduce(away) > limit:
            subject, distance = "set point of the controller", away
        joint = int(distance.argmax())
        if distance[joint] > limit:
            self.stop(
                Result.ROBOT,
                f"{self._joint_names[joint]} {subject} is {distance[joint]:.3f} rad from what was commanded, "
                f"limit {limit:.3f} rad {self.place()}; something holds the arm, or it does not follow",
            )

    def foresee(self, sequence: int, rows: int, most: int = 1) -> Foreseen | None:
        """Values of `command` for the next packet, number `sequence`, and up to `most` from there on.

        They hold if each packet comes and nothing new is requested; the call has no effect. None if the value
        is not known beforehand or does not pass the guard.

        rows : of a motion to begin with that packet, 0 for none
        """
        room, begins = np.inf, False
        if self.mode is Mode.MOTION:
            room = self._tracking_limit
            most = max(1, min(most, self._base + self._rows - sequence))
        elif self.mode is Mode.HOLD:
            begins = rows > 0 and not self.barred and self._begins_here()
            most = 1 if begins else most
        else:
            self._ahead = None
            return None
        ahead = self._ahead
        state = (self.mode, self._base, self._rows, begins)
        if ahead is None or not ahead.advance(sequence, self._sent, state) or len(ahead.values) > most:
            ahead = self._ahead = _Ahead(
                sequence, self._sent, state, self._guard.copy(), self._since_sent + 1
            )
        new = 0
        while new < _MORE and len(ahead.values) < most:
            if self.mode is Mode.MOTION:
                row = self._plan[min(sequence + len(ahead.values) - self._base, self._rows - 1)]
            else:
                row = self._plan[0] if begins else self._hold
            if not ahead.add(row.astype(np.float32)):
                break
            new += 1
        return Foreseen(ahead.values, new, room) if ahead.values else None

    def begin(self, rows: int, sequence: int) -> None:
        """Begin the motion in the shared memory, `rows` rows, with packet number `sequence`."""
        self.ended = (Result.NONE, "")
        if self.mode is not Mode.HOLD:
            self.ended = (Result.REFUSED, f"a motion cannot begin {self.place()}")
        elif self.barred:
            result = Result.ROBOT if self._touched else Result.REFUSED
            self.ended = (result, f"no motion before `enter_command`: {self.barred}")
        elif not self._begins_here():
            self.ended = (Result.REFUSED, "the motion does not begin at the commanded position")
        else:
            self.mode, self._base, self._rows = Mode.MOTION, sequence, rows
            self.phase, self._next_phase = NO_PHASE, 0

    def command(self, sequence: int) -> NDArray[np.float32] | None:
        """The value for packet number `sequence`, (7,); None if no value may be sent any more."""
        target = self._next(sequence)
        violation = self._guard.check(target, self._since_sent)
        if violation is not None and self.mode is not Mode.STOP:
            self.stop(Result.GUARD, self._refusal(violation))
            if self.mode is Mode.STOP:
                target = self._next(sequence)
                violation = self._guard.check(target, self._since_sent)
        if violation is not None:
            self.fall_silent(Result.GUARD, self._refusal(violation))
            return None
        self._commit(target)
        return target

    def rows_ahead(self, sequence: int, most: int) -> NDArray[np.float32]:
        """Values of `command` for the packets from number `sequence` on, (n, 7), while the motion just goes on.

        Each has passed the guard after those before it. n is `most` or less, and 0 where the next value is none of
        these: outside a motion, after a gap, at the beginning of a phase, at its last row, or where the guard objects.
        """
        first, last = sequence - self._base, self._rows - 1
        if self.mode is not Mode.MOTION or self._since_sent or first != self.index + 1 or self.index < 0:
            return np.zeros((0, JOINTS), dtype=np.float32)
        if self._next_phase < int(self._control.words[Word.PHASES]):
            last = min(last, int(self._control.phase_rows[self._next_phase]))
        rows = self._plan[first : max(min(first + most, last), first)].astype(np.float32)
        return rows[: self._guard.check_rows(rows)] if len(rows) else rows

    def watch_rows(
        self, values: NDArray[np.float32], setpoints: NDArray[np.float32], q: NDArray[np.float32]
    ) -> int:
        """In how many leading packets arm and set point are as near to the value sent before as in `watch`.

        values : of `rows_ahead`; setpoints, q : of the packets that they answer; (n, 7) each
        """
        error, away = self._distances(values, q), self._distances(values, setpoints)
        limit = self._tracking_limit
        return leading(~((error > limit) | (away > limit)))

    def take_rows(self, values: NDArray[np.float32], q: NDArray[np.float32]) -> None:
        """The `values` of `rows_ahead`, (n, 7), have been sent; q : of the packets that they answer."""
        tracking = self._control.tracking
        np.maximum(tracking, self._distances(values, q).max(axis=0), out=tracking)
        self._guard.remember_rows(values)
        self.index += len(values)
        for back in range(3):
            self._past[back] = self._plan[max(self.index - back, 0)]
        self.target = values[-1].copy()
        self._sent += len(values)

    def _distances(self, values: NDArray[np.float32], rows: NDArray[np.float32]) -> NDArray[np.float32]:
        before = np.concatenate([self.target[np.newaxis], values[:-1]])
        return np.abs(rows - before)

    def stop(self, result: Result, reason: str) -> None:
        """Begin a stop within the limits; `ended` is (`result`, `reason`) once the arm holds."""
        if self.mode in (Mode.MOTION, Mode.HOLD):
            self._pending = (result, reason)
            self._brake()

    def _brake(self) -> None:
        try:
            self._stop.begin(*self._past)
        except ValueError as error:
            self.fall_silent(self._pending[0], f"{self._pending[1]}; {error}")
            return
        self._origin = None
        self.mode = Mode.STOP

    def touch(self, what: str, advice: str) -> None:
        """Something touches the arm: stop a motion, and begin none before `allow`.

        At rest the arm goes back to its place before the contact if it is still pressed from there.
        """
        if self.mode not in (Mode.HOLD, Mode.MOTION, Mode.STOP):
            return
        reason = f"{what} {self.place()}; {advice}"
        moving, before = self.mode is Mode.MOTION, round(BEFORE_CONTACT_S / self._period)
        if moving:
            origin = self._plan[max(self.index - before, 0)].copy()
            self.stop(Result.ROBOT, reason)
            self._origin = origin
        if self.barred:
            return
        self.barred, self._touched = reason, True
        self._control.write_text(Text.LEFT, reason)
        if self.mode is Mode.STOP and not moving:
            self._pending = (self._pending[0], f"{self._pending[1]}; then {reason}")

    def allow(self) -> None:
        """Motions may begin again."""
        self.barred, self._touched = "", False
        self._control.write_text(Text.LEFT, "")

    def lose(self, result: Result, reason: str) -> None:
        """Return to the mirror when the controller no longer follows; a motion ends for good."""
        if self.mode in (Mode.MIRROR, Mode.SILENT):
            return
        reason = f"{reason}, {self.place()}"
        self._stopping = self.mode is Mode.STOP
        if self.mode is Mode.MOTION:
            self.ended = (result, reason)
        elif self.mode is Mode.STOP:
            self.ended = (self._pending[0], f"{self._pending[1]}; then {reason}")
        self.barred, self._touched = reason, False
        self._control.write_text(Text.LEFT, reason)
        self.mode, self.index, self.phase = Mode.MIRROR, -1, NO_PHASE

    def fall_silent(self, result: Result, reason: str) -> None:
        """Stop answering for good: the controller brakes the arm by itself."""
        if self.mode is Mode.SILENT:
            return
        if self.moving:
            self.ended = (result, f"{reason}; no more answers are sent")
        self._control.write_text(Text.LEFT, reason)
        self.mode, self.index, self.phase = Mode.SILENT, -1, NO_PHASE

    def place(self) -> str:
        """Place in the motion, for a reason."""
        if self.mode is not Mode.MOTION:
            return f"in mode {self.mode.name.lower()}"
        row = max(self.index, 0)
        return f"at row {row} of {self._rows} (t = {row * self._period:.3f} s)"

    def _begins_here(self) -> bool:
        """Whether the motion in the shared memory begins at the value sent last."""
        return np.array_equal(self._plan[0].astype(np.float32), self.target)

    def _next(self, sequence: int) -> NDArray[np.float32]:
        """Row of this cycle in the present mode."""
        if self.mode is Mode.MOTION:
            self.index = min(sequence - self._base, self._rows - 1)
            self._find_phase()
            return self._plan[self.index].astype(np.float32)
        self.index = -1
        if self.mode is Mode.STOP:
            if self._retreat.under_way:
                self.phase = RETREAT
                return self._retreat.advance(self._since_sent).astype(np.float32)
            self.phase = BRAKE if self._origin is None else CONTACT
            return self._stop.advance(self._since_sent).astype(np.float32)
        self.phase = HOLD
        return self._hold.astype(np.float32)

    def _commit(self, target: NDArray[np.float32]) -> None:
        """Remember the rows before a possible stop, and end a finished motion or stop."""
        past = self._past
        if self.mode is Mode.MOTION:
            for back in range(3):
                past[back] = self._plan[max(self.index - back, 0)]
            if self.index == self._rows - 1:
                self._end(Result.DONE, "")
        elif self.mode is Mode.STOP:
            self._commit_stop()
        else:
            past[:] = self._hold
        self.target = target
        self._since_sent = 0
        self._sent += 1

    def _commit_stop(self) -> None:
        past, stop, retreat = self._past, self._stop, self._retreat
        if retreat.under_way:
            for back in range(3):
                past[back] = retreat.row(back)
            if retreat.arrived:
                retreat.end()
                self._end(*self._pending)
            elif np.any((np.abs(self.external) > self.allowed) & (self.external * retreat.way < 0.0)):
                # Something is in the way back.
                retreat.end()
                self._brake()
            return
        past[:] = stop.advance(0)
        if not stop.finished:
            return
        origin, self._origin = self._origin, None
        if origin is not None and self._pressed(origin - past[0]):
            self._pending = (
                self._pending[0],
                f"{self._pending[1]}; still pressed at rest, the arm went back",
            )
            retreat.begin(past[0], origin)
            if retreat.under_way:
                return
        self._end(*self._pending)

    def _pressed(self, way: NDArray[np.float64]) -> bool:
        """Whether the arm at rest is pressed in the direction `way` (7,)."""
        return bool(np.any((np.abs(self.external) > _PRESSED * self.allowed) & (self.external * way > 0.0)))

    def _end(self, result: Result, reason: str) -> None:
        """End a motion or a stop: the arm holds."""
        self._hold = self._past[0].copy()
        self.mode = Mode.HOLD
        self.ended = (result, reason)

    def _find_phase(self) -> None:
        rows, count = self._control.phase_rows, int(self._control.words[Word.PHASES])
        while self._next_phase < count and rows[self._next_phase] <= self.index:
            self.phase = int(self._control.phase_ids[self._next_phase])
            self._next_phase += 1

    def _refusal(self, violation: Violation) -> str:
        what = violation.describe(self._joint_names)
        return f"guard: {what} {self.place()}; the value was not sent. Check the motion with `check_motion`"
