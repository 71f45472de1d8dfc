"""The controller's end of an FRI session, without a socket and without a clock.

One cycle is ``packet`` (the 916 bytes to send), any number of ``receive`` (answers) and ``close_cycle`` (the
setpoints of the next period). Everything else happens between cycles: the KRL calls ``fri_open``,
``fri_start``, ``fri_stop``, ``fri_close``, the drives, the KRL variables. The same calls give the same bytes.

By the protocol, the controller sends first. In command mode ``cmd_jnt_pos`` remains KRL's own setpoint and
``cmd_jnt_pos_fri_offset`` is FRI's addition, for absolute and superposing clients alike. Missing answers are
bridged by extrapolation and then end command mode, as do wrong commands and limits; nothing is clipped.
Commands are interpolated to 1 ms with a delay of one period. The thresholds are in ``fri.policy``.

Two assumptions of this project: the offset refers to the setpoint accepted last, the end of the interpolation;
and after a fallback KRL must set its own setpoint anew (``resync``) before the next start.
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from fri.judge import CommandJudge, Objection
from fri.packets import (
    CMD,
    CMD_ID,
    CMD_SIZE,
    JOINT_NAMES,
    JOINTS,
    MSR,
    MSR_OFFSETS,
    CmdBuffer,
    Fault,
    leading,
    new_msr,
)
from fri.policy import KrcLimits, KrcPolicy
from fri.states import (
    ALL_DRIVES,
    CONTROL_BY_STRATEGY,
    TRANSITIONS,
    CommandFlag,
    Control,
    Event,
    EventKind,
    Quality,
    State,
    Trigger,
)
from fri.timing import AnswerStatistics, classify
from fri.track import SetpointTrack

#: 3x4 row-major pose without rotation and translation.
IDENTITY_POSE = (1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0)


def _identity() -> np.ndarray:
    return np.array(IDENTITY_POSE)


def _joints() -> np.ndarray:
    return np.zeros(JOINTS)


#: Bytes of the reals and integers of KRL in a packet; its truth values follow.
KRL = slice(MSR_OFFSETS["krl_real"], MSR_OFFSETS["krl_bool"])
_JNTPOS = int(CommandFlag.JNTPOS)


@dataclass(slots=True)
class Sample:
    """Measurements of the arm in the units of `MSR`; written in place, read by ``KrcSession.packet``."""

    msr_jnt_pos: np.ndarray = field(default_factory=_joints)
    msr_cart_pos: np.ndarray = field(default_factory=_identity)
    cmd_cart_pos: np.ndarray = field(default_factory=_identity)
    msr_jnt_trq: np.ndarray = field(default_factory=_joints)
    est_ext_jnt_trq: np.ndarray = field(default_factory=_joints)
    est_ext_tcp_ft: np.ndarray = field(default_factory=lambda: np.zeros(6))
    jacobian: np.ndarray = field(default_factory=lambda: np.zeros((6, JOINTS)))
    mass_matrix: np.ndarray = field(default_factory=lambda: np.zeros((JOINTS, JOINTS)))
    gravity: np.ndarray = field(default_factory=_joints)
    temperature: np.ndarray = field(default_factory=_joints)


class Setpoint(NamedTuple):
    """Setpoint of the arm during the next period.

    positions : (n, 7) [rad], one row for each millisecond of the period; state : of the session;
    drop : end of command mode since the last cycle, or None.
    """

    positions: np.ndarray
    state: State
    drop: Event | None

    @property
    def position(self) -> np.ndarray:
        """Setpoint at the end of the period, (7,) [rad]."""
        return self.positions[-1]


class KrcSession:
    """An FRI session at the controller's end.

    Parameters: limits of the commands; `q` (7,), KRL's setpoint at the beginning [rad]; policy, None takes the
    defaults; `power`, drive bits; `uptime_s`, the controller's clock at the beginning; `first_sequence`, counter of the
    first packet. The control mode is position until ``set_strategy``.

    Attributes
    ----------
    state, quality, control : State, Quality, Control
    power, error, warning : int
        Drive bits; change them with ``set_drives``.
    quality_ceiling : Quality
        Upper bound on the quality, for provoking a drop; PERFECT is no bound.
    sample_time_ms, cycle : int
        Period of the last ``fri_open``, 1 before it; packets made so far.
    to_real, to_int : np.ndarray
        (16,) ``$FRI_TO_REA``, ``$FRI_TO_INT``; index 0 is ``[1]`` in KRL, as bit 0 of the mask `to_bool`.
    answered, needs_resync : bool
        Whether this cycle has its valid answer; whether KRL's setpoint must be set anew after a fallback.
    events : deque of Event
        The last 256; `last_event` is the newest or None. `on_event`, if given, is called with each.
    refused : dict of Control to str
        Control modes without command mode here, with the reason.
    """

    _head = struct.Struct("<HH").pack_into
    _bools = struct.Struct("<H").pack_into
    _intf = struct.Struct("<fHHfffffffIHHHH").pack_into

    def __init__(
        self,
        limits: KrcLimits,
        q: ArrayLike,
        policy: KrcPolicy | None = None,
        *,
        power: int = ALL_DRIVES,
        uptime_s: float = 0.0,
        first_sequence: int = 0,
    ) -> None:
        self.limits = limits
        self.policy = policy = policy if policy is not None else KrcPolicy()
        self.state = State.OFF
        self.quality = Quality.UNACCEPTABLE
        self.quality_ceiling = Quality.PERFECT
        self.control = Control.POSITION
        self.power = power
        self.error = 0
        self.warning = 0
        self.sample_time_ms = 1
        self.cycle = 0
        self.last_event: Event | None = None
        self.events: deque[Event] = deque(maxlen=256)
        self.on_event: Callable[[Event], None] | None = None
        self.refused: dict[Control, str] = {}

        record = new_msr()
        self._record = record
        self._bytes = record.reshape(1).view(np.uint8).data
        self.to_real: np.ndarray = record["krl_real"]
        self.to_int: np.ndarray = record["krl_int"]
        self.to_bool = 0
        self._views: dict[str, np.ndarray] = {name: record[name] for name in Sample.__dataclass_fields__}
        self._cmd_jnt_pos: np.ndarray = record["cmd_jnt_pos"]
        self._offset: np.ndarray = record["cmd_jnt_pos_fri_offset"]
        record["cmd_cart_pos_fri_offset"] = IDENTITY_POSE

        # KRL's setpoint is rounded to float32 as sent: setpoint plus offset is exact for clients.
        self._krl = _as_sent(q)
        self._track = SetpointTrack(limits, policy, self._krl)
        self._safety_limits = 1.0
        self._t1 = False
        self._judge = CommandJudge(limits, policy)

        self._uptime_ms = round(uptime_s * 1000.0)
        self._sequence = (first_sequence - 1) & 0xFFFF
        self._reflected = 0
        self._statistics = AnswerStatistics(policy.window)
        self._dwell = 0
        self._start_pending = False
        self.needs_resync = False
        self._open = False
        self.answered = False
        self._fault: Fault | None = None
        self._delay_ns = 0
        self._incoming = CmdBuffer()
        self._command = CmdBuffer()
        self._monitor_flags: int | None = None
        self._first_command = True
        self._drop: Event | None = None
        self._counts = dict.fromkeys(("answered", "late", "duplicated", "malformed", "starts", "drops"), 0)

    @property
    def sample_time_s(self) -> float:
        """Period [s]."""
        return self.sample_time_ms * 1e-3

    @property
    def timestamp_s(self) -> float:
        """The controller's clock at the last packet [s]."""
        return self._uptime_ms * 1e-3

    @property
    def send_seq(self) -> int:
        """Counter of the last packet."""
        return self._sequence

    @property
    def t1(self) -> bool:
        """Whether the operating mode is T1, with its lower speed limits."""
        return self._t1

    @t1.setter
    def t1(self, value: bool) -> None:
        self._t1 = value
        self._tighten_judge()

    @property
    def malformed_now(self) -> bool:
        """Whether a malformed datagram came in this cycle."""
        return self._fault is not None

    @property
    def ramping(self) -> bool:
        """Whether the arm is still braking after command mode."""
        return self._track.ramping

    @property
    def setpoint(self) -> np.ndarray:
        """Total setpoint, KRL plus FRI, (7,) [rad]; a copy."""
        return self._track.target.copy()

    @property
    def krl_setpoint(self) -> np.ndarray:
        """KRL's own setpoint, (7,) [rad]; a copy."""
        return self._krl.copy()

    @property
    def command(self) -> np.ndarray:
        """The last valid answer, shape (), dtype `CMD`; zeros before the first. Valid for one cycle."""
        return self._command.record

    @property
    def from_real(self) -> np.ndarray:
        """``$FRI_FRM_REA``, (16,), as of the last valid answer."""
        return self._command.krl_real

    @property
    def from_int(self) -> np.ndarray:
        """``$FRI_FRM_INT``, (16,), as of the last valid answer."""
        return self._command.krl_int

    @property
    def from_bool(self) -> int:
        """``$FRI_FRM_BOOL`` as a mask, bit 0 is ``[1]``."""
        return self._command.krl_bool

    @property
    def variables(self) -> bytes:
        """``$FRI_TO_REA``, ``$FRI_TO_INT`` and the mask `to_bool` as the next packet holds them, from `KRL` on."""
        bits = self.to_bool & 0xFFFF
        return bytes(self._bytes[KRL]) + bits.to_bytes(2, "little")

    @property
    def miss_counter(self) -> int:
        """Missing answers since the session was opened."""
        return self._statistics.miss_counter

    def counters(self) -> dict[str, int]:
        """Packets, answers in time, late, duplicated and malformed ones, misses, starts and drops by name."""
        return {"packets": self.cycle, "missed": self.miss_counter, **self._counts}

    def fri_open(self, sample_time_ms: int) -> State:
        """``friOpen(T)``: send every T = 1..100 ms; statistics and the variables from the PC begin anew."""
        if not 1 <= sample_time_ms <= 100:
            raise ValueError(f"friOpen sample time {sample_time_ms} ms is outside 1..100 ms")
        if not self._transition(Trigger.FRI_OPEN):
            return self.state
        self.sample_time_ms = int(sample_time_ms)
        self._track.set_period(self.sample_time_ms)
        self._tighten_judge()
        self._statistics = AnswerStatistics(self.policy.window)
        self.quality = Quality.UNACCEPTABLE
        self._dwell = 0
        self._monitor_flags = None
        # A request of the PC from before must not be obeyed now.
        self._command = CmdBuffer()
        self._note(EventKind.OPENED, f"opened with {self.sample_time_ms} ms")
        return self.state

    def fri_start(self, safety_limits: float = 1.0) -> State:
        """``friStart(x)``: ask for command mode with the limits shrunk to `safety_limits` (0..1].

        It is entered at the beginning of a cycle as soon as the timing has been good for long enough and the
        arm stands; ``fri_stop`` withdraws the request. After a fallback it is refused until ``resync``.
        """
        if not 0.0 < safety_limits <= 1.0:
            raise ValueError(f"friStart limit factor {safety_limits} is outside (0, 1]")
        if self.state is not State.MON:
            return self.state
        if self.needs_resync:
            self._note(
                EventKind.REFUSED,
                "start refused: KRL's setpoint must be set anew after a fallback (PTP $AXIS_ACT)",
            )
            return self.state
        if self.control in self.refused:
            self._note(EventKind.REFUSED, f"start refused: {self.refused[self.control]}")
            return self.state
        self._safety_limits = float(safety_limits)
        self._tighten_judge()
        self._start_pending = True
        return self.state

    def fri_stop(self) -> State:
        """``friStop()``: back to monitor mode; an arm in motion is braked."""
        self._start_pending = False
        if self._transition(Trigger.FRI_STOP):
            self._track.brake()
            self._note(EventKind.STOPPED, "stopped")
        return self.state

    def fri_close(self) -> State:
        """``friClose()``: stop sending, after ``fri_stop`` if need be; there is no goodbye packet."""
        self.fri_stop()
        if self._transition(Trigger.FRI_CLOSE):
            self._open = False
            self._note(EventKind.CLOSED, "closed")
        return self.state

    def set_strategy(self, strategy: int) -> None:
        """``$STIFFNESS.STRATEGY`` with commit: 10 position, 20 Cartesian, 30 joint impedance.

        RuntimeError in command mode.
        """
        if self.state is State.CMD:
            raise RuntimeError(
                f"strategy {strategy} cannot be committed in command mode; call fri_stop first"
            )
        control = CONTROL_BY_STRATEGY.get(int(strategy), Control.OTHER)
        if control is not self.control:
            # The client must have seen the new mode before command mode begins.
            self.control = control
            self._dwell = 0

    def set_drives(self, power: int, error: int = 0, warning: int = 0) -> None:
        """Set the drive bits; switching off or an error during command mode ends it."""
        switched_off = self.power != 0 and power == 0
        if power and not self.power:
            self._first_command = True
        self.power, self.error, self.warning = power, error, warning
        if self.state is not State.CMD:
            return
        if error:
            names = ", ".join(name for bit, name in enumerate(JOINT_NAMES) if error >> bit & 1)
            self.drop(EventKind.DRIVE_ERROR, f"drive error of {names}")
        elif switched_off and self.policy.drop_on_drives_off:
            self.drop(EventKind.DRIVES_OFF, "drives switched off in command mode")
        elif switched_off:
            self._track.rest()

    def drop(self, kind: EventKind, text: str) -> None:
        """End command mode as the controller does: monitor mode, the arm braked, KRL out of step.

        Outside command mode it does nothing.
        """
        if not self._transition(Trigger.FAULT):
            return
        self._start_pending = False
        self.needs_resync = True
        self._counts["drops"] += 1
        self._track.brake()
        self._drop = self._note(kind, text)

    def move_krl(self, q: ArrayLike) -> None:
        """Move KRL's setpoint to `q` (7,) [rad] within the next period.

        In command mode the arm goes on following FRI and the offset takes up the difference.
        """
        krl = _as_sent(q)
        if self.state is not State.CMD:
            self._track.shift(krl - self._krl)
        self._krl = krl

    def resync(self, q: ArrayLike | None = None) -> None:
        """Set KRL's setpoint to `q`, or to the present total setpoint; the offset is zero then.

        Not in command mode and not while the arm is braking. A given `q` becomes the setpoint at once.
        """
        if self.state is State.CMD or self._track.ramping:
            raise RuntimeError("KRL's setpoint cannot be set anew while FRI moves the arm; stop it first")
        self._krl = _as_sent(self._track.target if q is None else q)
        self._track.place(self._krl)
        self.needs_resync = False

    def packet(self, sample: Sample) -> bytes:
        """Begin a cycle: the 916 bytes of its packet."""
        if self.state is State.OFF or self._open:
            reason = (
                "the session is not open" if self.state is State.OFF else "the cycle before is not closed"
            )
            raise RuntimeError(f"no packet: {reason}")
        if self._start_pending:
            self._try_start()
        self.cycle += 1
        self._uptime_ms += self.sample_time_ms
        self._sequence = (self._sequence + 1) & 0xFFFF
        self._open = True
        self.answered = False
        self._fault = None
        buffer = self._bytes
        self._stamp(buffer)
        for name, view in self._views.items():
            view[...] = getattr(sample, name)
        self._cmd_jnt_pos[:] = self._krl
        np.subtract(self._track.target, self._krl, out=self._offset, casting="same_kind")
        return bytes(buffer)

    def _stamp(self, buffer: memoryview | bytearray) -> None:
        """Write counters, state, clock and statistics into a packet."""
        statistics, period = self._statistics, self.sample_time_ms * 1e-3
        self._head(buffer, 0, self._sequence, self._reflected)
        self._bools(buffer, 136, self.to_bool & 0xFFFF)
        self._intf(
            buffer,
            140,
            self._uptime_ms * 1e-3,
            self.state,
            self.quality,
            period,
            period,
            self._safety_limits,
            statistics.answer_rate,
            statistics.latency,
            statistics.jitter,
            statistics.miss_rate,
            statistics.miss_counter & 0xFFFFFFFF,
            self.power,
            self.control,
            self.error,
            self.warning,
        )

    def receive(self, datagram: bytes | bytearray | memoryview, delay_s: float = 0.0) -> bool:
        """Take in a datagram `delay_s` after the packet; True if it is this cycle's answer.

        The first valid answer counts. A valid answer has the right length, id and size, and reflects the last
        packet; with the counter of an older packet it is late.
        """
        if not self._open:
            return False
        incoming = self._incoming
        fault = incoming.load(datagram)
        if fault is not None:
            self._counts["malformed"] += 1
            self._fault = fault
            return False
        self._reflected = incoming.send_seq
        age = (self._sequence - incoming.refl_seq) & 0xFFFF
        delay_ns = round(delay_s * 1e9)
        if age:
            self._counts["late"] += 1
            self._statistics.late(age, age * self.sample_time_ms * 1_000_000 + delay_ns)
            return False
        if self.answered:
            self._counts["duplicated"] += 1
            return False
        self.answered = True
        self._counts["answered"] += 1
        self._delay_ns = delay_ns
        self._incoming, self._command = self._command, incoming
        return True

    def ahead(self, commands: np.ndarray, delay_s: float) -> CyclesAhead | None:
        """The coming cycles worked out beforehand, if they are ordinary ones; nothing changes yet.

        commands : (n,) of `CMD`, the answers to the coming packets, each `delay_s` [s] after its packet

        Ordinary are cycles of command mode in position control, answered so regularly that only clock, counters and
        setpoint change. None if the first is none; the result ends before the first command that is objected to.
        """
        if not self._ordinary(delay_s) or not len(commands):
            return None
        head = commands[0]
        count = np.arange(len(commands))
        fits = (
            (commands["packet_size"] == CMD_SIZE)
            & (commands["datagram_id"] == CMD_ID)
            & (commands["refl_seq"] == (self._sequence + 1 + count) & 0xFFFF)
            & (commands["cmd_flags"] == head["cmd_flags"])
            & (commands["krl_bool"] == head["krl_bool"])
            & (commands["krl_int"] == head["krl_int"]).all(axis=1)
            & (commands["krl_real"] == head["krl_real"]).all(axis=1)
        )
        flags = int(head["cmd_flags"])
        if flags != _JNTPOS or self._monitor_flags not in (None, flags):
            return None
        targets = commands["jnt_pos"].astype(np.float64)
        most = min(leading(fits), self._judge.pass_rows(targets, self._track.target))
        return CyclesAhead(self, commands[:most], targets[:most]) if most else None

    def _ordinary(self, delay_s: float) -> bool:
        """Whether a cycle with a valid answer after `delay_s` changes only clock, counters and setpoint."""
        track, policy = self._track, self.policy
        if self.state is not State.CMD or self._open or self._fault is not None or self._first_command:
            return False
        if self.control is not Control.POSITION or not self.power or track.ramping or track.missed:
            return False
        if policy.acceleration_factor is not None or self._drop is not None:
            return False
        if not self._statistics.steady(round(delay_s * 1e9)):
            return False
        return self.quality == self._rated() and self.quality >= policy.hold_quality

    def close_cycle(self) -> Setpoint:
        """End the cycle: judge the answer and give the setpoints of the next period.

        While the session is OFF it may be called without a packet: the arm holds, or goes on braking.
        """
        if self.state is State.OFF:
            self._uptime_ms += self.sample_time_ms
            positions = self._track.coast()
        elif not self._open:
            raise RuntimeError("no cycle to close: call packet() first")
        else:
            self._open = False
            self._statistics.close(self._delay_ns if self.answered else None)
            self._rate()
            positions = self._follow() if self.state is State.CMD else self._monitor()
        drop, self._drop = self._drop, None
        return Setpoint(positions, self.state, drop)

    def _transition(self, trigger: Trigger) -> bool:
        state = TRANSITIONS.get((self.state, trigger))
        if state is None:
            return False
        self.state = state
        return True

    def _note(self, kind: EventKind, text: str) -> Event:
        event = Event(self.cycle, kind, text)
        self.last_event = event
        self.events.append(event)
        if self.on_event is not None:
            self.on_event(event)
        return event

    def _tighten_judge(self) -> None:
        self._judge.tighten(self.sample_time_s, self._safety_limits, self._t1)

    def _rate(self) -> None:
        self.quality = self._rated()
        self._dwell = self._dwell + 1 if self.quality >= self.policy.start_quality else 0

    def _rated(self) -> Quality:
        statistics = self._statistics
        quality = classify(
            statistics.packets, statistics.answer_rate, statistics.latency, self.sample_time_s, self.policy
        )
        return min(quality, self.quality_ceiling)

    def _try_start(self) -> None:
        if self._dwell < self.policy.start_dwell or self._track.ramping:
            return
        if self.control in self.refused:
            return
        if self.quality < self.policy.start_quality or not self._transition(Trigger.FRI_START):
            return
        self._start_pending = False
        self._first_command = True
        self._track.rest()
        self._counts["starts"] += 1
        self._note(EventKind.STARTED, f"command mode with limits x {self._safety_limits:.2f}")

    def _monitor(self) -> np.ndarray:
        if self.answered:
            self._monitor_flags = self._command.cmd_flags
        return self._track.coast()

    def _follow(self) -> np.ndarray:
        """Judge a cycle of command mode; the setpoints of the next period."""
        track = self._track
        target: np.ndarray | None = None
        objection: Objection | None
        if self._fault is not None and self.policy.drop_on_malformed:
            objection = EventKind.MALFORMED, f"malformed datagram in command mode: {self._fault.value}"
        elif self.answered:
            target, objection = self._commanded()
        else:
            objection = self._missing()
        if objection is None and self.quality < self.policy.hold_quality:
            statistics = self._statistics
            objection = (
                EventKind.QUALITY,
                f"quality {self.quality.name} in command mode is below {self.policy.hold_quality.name}: "
                f"answer rate {statistics.answer_rate:.2f}, latency {statistics.latency * 1e3:.2f} ms",
            )
        if objection is not None:
            self.drop(*objection)
            return track.coast()
        return track.bridge() if target is None else track.command(target)

    def _missing(self) -> Objection | None:
        """Objection to bridging one more missing answer."""
        missed = self._track.missed + 1
        if missed > self.policy.bridged_cycles:
            return (
                EventKind.MISSES,
                f"{missed} answers in a row are missing, at most {self.policy.bridged_cycles} are bridged",
            )
        return self._judge.position(self._track.extrapolated().tolist(), "extrapolated")

    def _commanded(self) -> tuple[np.ndarray, Objection | None]:
        """The setpoint of the answer, and the objection to it."""
        command, judge, held = self._command, self._judge, self._track.target
        objection = judge.flags(command, self._monitor_flags, self.control)
        if objection is not None or not command.cmd_flags & _JNTPOS:
            return held, objection
        if self.power == 0:
            return held, judge.mirror(command, held, "the command with the drives off")
        # Through a list: numpy warns of a signalling NaN, left to the judge.
        commanded = command.jnt_pos.tolist()
        target = np.array(commanded)
        soft = self.control is Control.JNT_IMP
        if self._first_command:
            objection = judge.mirror(command, held, "the first command", soft=soft)
        objection = (
            objection or (judge.springs(command) if soft else None) or judge.position(commanded, "commanded")
        )
        if objection is None and not (soft and self._first_command):
            # A spring takes the way from its setpoint to the arm without a motion.
            objection = judge.velocity(command, held)
            if objection is None and self.policy.acceleration_factor is not None:
                objection = judge.acceleration(*self._track.change_of_step(target))
        self._first_command = False
        return target, objection


class CyclesAhead:
    """Ordinary cycles of a session, see ``KrcSession.ahead``; `place` takes them.

    positions : (n, k, 7) [rad], setpoints of each period, a row for each millisecond, as of `Setpoint`
    packets : (n,) of `MSR`, the packets but for the measurements and the KRL variables
    """

    def __init__(self, session: KrcSession, commands: np.ndarray, targets: np.ndarray) -> None:
        self._session, self._commands, self._targets = session, commands, targets
        self._done = 0
        self._krl, self._first = session._krl, session._track.target
        self._target = self._first
        self.positions = session._track.lines(targets).reshape(len(targets), -1, JOINTS)
        self.packets = self._heads()

    def _heads(self) -> np.ndarray:
        session, commands, before = self._session, self._commands, self._targets[:-1]
        count = np.arange(1, len(commands) + 1)
        first = bytearray(session._bytes)
        session._stamp(first)
        packets = np.repeat(np.frombuffer(first, MSR, 1), len(count))
        packets["send_seq"] = (session._sequence + count) & 0xFFFF
        packets["refl_seq"][:1] = session._reflected
        packets["refl_seq"][1:] = commands["send_seq"][:-1]
        packets["timestamp"] = (session._uptime_ms + session.sample_time_ms * count) * 1e-3
        packets["cmd_jnt_pos"] = session._krl
        offset = packets["cmd_jnt_pos_fri_offset"]
        offset[0], offset[1:] = session._track.target - session._krl, before - session._krl
        return packets

    @property
    def going_on(self) -> bool:
        """Whether the cycles placed so far have left the session in command mode, with the setpoint of the last."""
        session = self._session
        return (
            session.state is State.CMD
            and session.control is Control.POSITION
            and session._krl is self._krl
            and session._drop is None
            and session._track.target is self._target
        )

    def place(self, done: int) -> None:
        """Put the session behind the first `done` cycles, as far as KRL can see and change it; never back."""
        session, count = self._session, done - self._done
        if not self._done:
            # What KRL reads is the same in all.
            session._command.load(self._commands[0].tobytes())
            session.answered = True
        session.cycle += count
        session._uptime_ms += count * session.sample_time_ms
        session._sequence = (session._sequence + count) & 0xFFFF
        before, self._target = self._targets[done - 2] if done > 1 else self._first, self._targets[done - 1]
        session._track.follow(before, self._target)
        self._done = done

    def finish(self) -> None:
        """Put the rest of the session behind the cycles placed."""
        session, done = self._session, self._done
        if session.state is State.CMD:
            session._track.accept(self._targets[:done])
        session._statistics.repeat(done)
        session._counts["answered"] += done
        session._dwell = session._dwell + done if session.quality >= session.policy.start_quality else 0
        session._command.load(self._commands[done - 1].tobytes())
        session._reflected = session._command.send_seq


def _as_sent(q: ArrayLike) -> np.ndarray:
    """(7,) float64 copy of `q`, rounded to float32."""
    values = np.array(q, dtype=CMD["jnt_pos"].base).astype(float)
    if values.shape != (JOINTS,) or not np.isfinite(values).all():
        raise ValueError(f"joint position {values} must be {JOINTS} finite numbers")
    return values
