"""The test stand of the campaign: controller, faulty wire, driver's loop and log, in one thread.

One call of `cycle` is one FRI cycle over real sockets, with a clock of its own that replaces the one of the
loop, so a run takes milliseconds and repeats itself from its seed, in lock step as in real time. The arm
follows at once; the physics of the arm has campaigns of its own.

The emulator's command monitor judges the commands as they arrived at the controller, in float32. The packets
carry their true number in the torque of the last joint, so that the log can be held against it.
"""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from fri.controller_end import ControllerEnd
from fri.krc import KrcSession, Sample
from fri.krl import Interpreter
from fri.packets import CMD, CMD_SIZE
from fri.policy import KrcLimits, KrcPolicy
from fri.states import State
from lwr_driver.arm import Arm
from lwr_driver.control import Control, Job, Mode, Result, Text, Word
from lwr_driver.loop import Loop, LoopSettings
from lwr_driver.motion import Motion, check_motion, move_to
from lwr_driver.pace import Pace
from lwr_driver.ring import Ring
from lwr_driver.session import session_metadata
from lwr_driver.session.recording import Recorded, Recording, SessionRequest
from lwr_driver.turnaround import Turnaround
from runner.planning import dwell
from sim_backend.faults import FaultyWire, Parcel, WireFault
from sim_backend.monitor import CommandMonitor
from sim_backend.program import krl_program
from tests.lwr_driver.driver_rig import Clock

__all__ = ["LABEL", "START", "Stand", "the_arm", "the_motion"]

START = np.array([0.1, 0.5, -0.2, -1.3, 0.3, 0.8, -0.1])
LABEL = 997
"""Numbers of packets are carried modulo this prime."""

_POLICY: dict[str, Any] = {"window": 40, "minimum_packets": 10, "start_dwell": 5}
_SPEED = 0.6
_ROWS = 200
_PHASES = ("hold", "brake")


@cache
def the_arm() -> Arm:
    """The arm under test."""
    return Arm.load()


@cache
def the_motion(period_ms: int, variant: int) -> Motion:
    """Approach, rest, excitation, return: a session in small, checked like any other."""
    random = np.random.default_rng([period_ms, variant])
    arm, period_s = the_arm(), period_ms * 1e-3
    way = random.uniform(0.3, 0.6, 7) * random.choice([-1.0, 1.0], 7)
    here = START.astype(np.float32).astype(np.float64)
    low, high = arm.limits.q_low + 0.2, arm.limits.q_high - 0.2
    parts: list[Motion] = []
    # A cycle costs the same whatever its length, so a short cycle has a short way.
    while not parts or sum(map(len, parts)) > _ROWS:
        there = np.clip(here + way, low, high)
        beyond = np.clip(there - 1.5 * way, low, high)
        legs = (("move_to_start", here, there), ("excitation", there, beyond), ("return", beyond, here))
        parts = [move_to(arm, a, b, period_s, speed_scale=_SPEED, phase=name) for name, a, b in legs]
        way *= 0.7
    rest = dwell(there, 6 * period_s, period_s, "settle")
    motion = parts[0].join(rest).join(parts[1]).join(parts[2])
    check_motion(arm, motion)
    return motion


class TimedTurnaround(Turnaround):
    """The loop's answers ahead, at the time of the stand."""

    def __init__(self, loop: Loop, control: Control, clock: Clock) -> None:
        super().__init__(loop.remote.descriptor, loop.remote.buffer, control.words)
        self._clock = clock
        self.meanwhile = False

    def next(self, *, more: bool) -> bool:
        """The first packet of a cycle comes while the loop looks out for it, any other one while it is busy."""
        return super().next(more=more and self.meanwhile)

    def arm(self, *arguments: Any, due_ns: int = 0, period_ns: int = 0) -> None:
        """Answers ready for the packets that are due at the time of the stand."""
        controller, sequence, ready, *more = arguments
        if len(more) > 3:
            *more, due_ns, period_ns = more
        if period_ns:
            ready = min(ready, max(0, (self._clock.now_ns - due_ns) // period_ns + 1))
        super().arm(controller, sequence, ready, *more)

    @property
    def received_ns(self) -> int:
        """When the datagram came."""
        return self._clock.now_ns

    @property
    def sent_ns(self) -> int:
        """When its answer had been sent, 0 for not at all."""
        return self._clock.now_ns if super().sent_ns else 0


class Stand:
    """One run. A context manager.

    seed : of the wire. ring : reused from run to run, must be empty. folder : where the log goes. ahead : with
    answers that are ready before their packet and leave from compiled code, as with real-time rights
    """

    def __init__(
        self,
        seed: np.random.SeedSequence,
        ring: Ring,
        folder: Path,
        *,
        period_ms: int = 5,
        program: str = "stanford",
        lock_step: bool = True,
        ahead: bool = False,
        first_sequence: int = 0,
        uptime_s: float = 0.0,
        policy: dict[str, Any] | None = None,
    ) -> None:
        arm = the_arm()
        self.arm, self.period_ms, self.program = arm, period_ms, program
        self.hard = KrcLimits(arm.q_min, arm.q_max, 1.2 * arm.v_max, np.full(7, 20.0))
        self.policy = KrcPolicy(**{**_POLICY, **(policy or {})})
        self.clock = Clock()
        self._patches = contextlib.ExitStack()
        for name in ("monotonic", "monotonic_ns"):
            self._patches.enter_context(patch(f"fri.remote.{name}", getattr(self.clock, name)))
        self._patches.enter_context(patch("lwr_driver.loop.time", self.clock))
        self.sample = Sample()
        self.setpoint = START.astype(np.float32).astype(np.float64)
        self.displacement = np.zeros(7)
        self.session = self._cold(first_sequence, uptime_s)
        self.wire = FaultyWire(seed, period_ms * 1e-3)
        self.control = Control.create(3000)
        self.ring = ring
        ring.start_writing()
        self.settings = LoopSettings("127.0.0.1", 0, None, lock_step, program, 0.1, 0.2, arm.joint_names)
        self.loop = Loop(self.settings, arm.limits, self.control, ring)
        self.ahead = TimedTurnaround(self.loop, self.control, self.clock) if ahead else None
        self.loop.turnaround = self.ahead
        self.loop.pace = None if lock_step else Pace()
        self.end = ControllerEnd(self.loop.remote.address)
        self.monitor = CommandMonitor(arm, period_ms * 1e-3)
        self.path = folder / "run.mcap"
        self.path.unlink(missing_ok=True)
        names = (*_PHASES, "move_to_start", "settle", "excitation", "return")
        self.recording = Recording(
            SessionRequest(
                self.path,
                arm.joint_names,
                session_metadata(
                    robot=arm.name, software="trust", git_commit="", utc_start="2020-01-01T00:00:00"
                ),
                phase_names=names,
                virtual_epoch_ns=1_577_836_800 * 10**9 if lock_step else None,
            ),
            1_577_836_800 * 10**9,
        )
        self.closed: Recorded | None = None
        self.cycle_number = 0
        self.pace = 1.0  # true length of a cycle, as a share of the one in the header
        self.packets = 0
        self.silent = 0
        self.hurry = 0
        self.slow, self.delay_ns = 0, 0
        self.alter: Callable[[bytes, int], bytes] | None = None
        self.beside: Callable[[bytes, int], None] | None = None
        self.commanding = False
        self.moved_alone = 0.0
        self.resting: NDArray[np.float64] | None = None
        self._others: dict[str, socket.socket] = {}
        self.interpreter.advance(period_ms)

    def __enter__(self) -> Stand:
        return self

    def __exit__(self, *error: object) -> None:
        self.end.close()
        self.loop.remote.close()
        for other in self._others.values():
            other.close()
        self.drain()
        if self.closed is None:
            self.recording.close("fail", "the stand was closed")
        self.control.close()
        self._patches.close()

    # -- the controller --------------------------------------------------------------------------------------

    def _cold(self, first_sequence: int, uptime_s: float) -> KrcSession:
        session = KrcSession(
            self.hard, self.setpoint, self.policy, first_sequence=first_sequence, uptime_s=uptime_s
        )
        self.interpreter = Interpreter(session, krl_program(self.program, self.period_ms))
        self.sample.msr_jnt_pos[:] = self.setpoint
        return session

    def restart(self, first_sequence: int, uptime_s: float, *, new_port: bool) -> None:
        """The controller starts again: counters anew, the arm stands where it was."""
        self.session = self._cold(first_sequence, uptime_s)
        self.wire.restart()
        if new_port:
            self.end.close()
            self.end = ControllerEnd(self.loop.remote.address)
        self.commanding = False
        self.interpreter.advance(self.period_ms)

    def reopen(self, period_ms: int) -> None:
        """The KRL program is selected anew with another cycle."""
        self.session.fri_close()
        self.period_ms = period_ms
        self.wire.period_s = self.monitor.period_s = period_ms * 1e-3
        self.interpreter = Interpreter(self.session, krl_program(self.program, period_ms))

    def slow_down(self, cycles: int, extra: float) -> None:
        """The next cycles each take longer by `extra` periods."""
        self.slow, self.delay_ns = cycles, round(extra * self.period_ms * 1e6)

    def other(self, host: str) -> socket.socket:
        """A socket of another host."""
        if host not in self._others:
            self._others[host] = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            self._others[host].bind((host, 0))
        return self._others[host]

    # -- one cycle -------------------------------------------------------------------------------------------

    def cycle(self) -> None:
        """One cycle of the controller, with all that comes of it."""
        session = self.session
        if self.slow > 0:
            # The loop looks in vain meanwhile.
            self.slow -= 1
            self.clock.now_ns += self.delay_ns
            self._serve()
        self.clock.now_ns += round(self.period_ms * 1e6 * self.pace)
        if session.state is State.OFF:
            self._serve()
            positions = session.close_cycle().positions
        else:
            self.packets += 1
            self.sample.msr_jnt_trq[6] = self.packets % LABEL
            packet = session.packet(self.sample)
            commanding = session.state is State.CMD and session.power != 0
            if commanding and not self.commanding:
                self.monitor.period_s = session.sample_time_s
                self.monitor.rest(session.setpoint, self.cycle_number - 1)
                self.resting = None
            self.commanding = commanding
            self._deliver(packet)
            # A controller in a hurry does not wait for answers: they come in a heap, late.
            if self.hurry <= 0:
                self._serve()
                self._collect(packet)
            else:
                self.hurry -= 1
            positions = session.close_cycle().positions
        self.setpoint = positions[-1]
        self.sample.msr_jnt_pos[:] = self.setpoint + self.displacement
        self.interpreter.advance(self.period_ms)
        self.cycle_number += 1
        if self.ring.free < 64:
            self.drain()

    def _deliver(self, packet: bytes) -> None:
        if self.alter is not None:
            packet = self.alter(packet, self.packets)
        if self.beside is not None:
            self.beside(packet, self.packets)
        if self.silent > 0:
            self.silent -= 1
            return
        if self.wire.quiet:
            self.end.send(packet)
            return
        for parcel in self.wire.outgoing(packet, self.packets, self.cycle_number):
            self._send(parcel)

    def _send(self, parcel: Parcel) -> None:
        if parcel.host is None:
            self.end.send(parcel.datagram)
        else:
            self.other(parcel.host).sendto(parcel.datagram, self.end.remote)

    def _serve(self) -> None:
        """Let the loop handle all that waits for it, and look at its requests."""
        ahead = self.ahead
        self.loop.cycle(0.0)
        if ahead is not None:
            ahead.meanwhile = True
        while self.loop.remote.pending() or (ahead is not None and ahead.waiting):
            self.loop.cycle(0.0)
        if ahead is not None:
            ahead.meanwhile = False

    def _collect(self, packet: bytes) -> None:
        session, cycle = self.session, self.cycle_number
        while (datagram := self.end.receive(0.0)) is not None:
            if self.commanding and len(datagram) == CMD_SIZE and datagram[2:4] == packet[:2]:
                self._judge(np.frombuffer(datagram, CMD)[0]["jnt_pos"])
            if self.wire.quiet:
                session.receive(datagram)
                continue
            for host, other in self.wire.incoming(datagram, 0.0, cycle):
                if host is not None:
                    self.other(host).sendto(other, self.end.address)
        for arrived in self.wire.due(cycle):
            session.receive(*arrived)

    def _judge(self, command: NDArray[np.float32]) -> None:
        self.monitor.take(command, self.cycle_number)
        if self.resting is not None:
            self.moved_alone = max(self.moved_alone, float(np.abs(command - self.resting).max()))
        if self.loop.mode in (Mode.HOLD, Mode.MIRROR) and self.done:
            self.resting = command.astype(np.float64)

    def cycles(self, count: int) -> None:
        """That many cycles."""
        for _ in range(count):
            self.cycle()

    # -- the driver ------------------------------------------------------------------------------------------

    def post(self, job: Job, a: int = 0, b: int = 0, limit: int = 0) -> None:
        """Ask the loop for something, as the driver does."""
        self.control.post(job, a, b, limit)

    @property
    def done(self) -> bool:
        """Whether the loop has done what it was asked for last."""
        return self.control.done

    @property
    def result(self) -> Result:
        """How that ended."""
        return self.control.result

    @property
    def reason(self) -> str:
        """And why."""
        return self.control.text(Text.REASON)

    def until_done(self, most: int, each: Callable[[], None] = lambda: None) -> bool:
        """Cycles until the job is done, False after `most`; `each` is called before every one."""
        for _ in range(most):
            if self.done:
                return True
            each()
            self.cycle()
        return self.done

    def start_motion(self, motion: Motion) -> None:
        """Ask for the motion; the next cycle sends its first row."""
        self.resting = None
        phases = [(row, 2 + n) for n, (row, _) in enumerate(motion.phases)]
        self.control.put_motion(motion.q, phases)
        self.post(Job.MOTION, len(motion), int(self.control.words[Word.STOP]))

    # -- the log ---------------------------------------------------------------------------------------------

    def drain(self) -> None:
        """Rows from the ring to the log."""
        rows = self.ring.take()
        if len(rows) and self.closed is None:
            self.recording.write(rows)
        self.ring.release(len(rows))

    def close_log(self, status: Any, reason: str) -> Recorded:
        """End the session log."""
        self.drain()
        self.closed = self.recording.close(status, reason)
        return self.closed

    def inject(self, **settings: Any) -> None:
        """Begin a fault on the wire now."""
        self.wire.inject(WireFault(**settings), self.cycle_number)


@contextlib.contextmanager
def shared_ring() -> Iterator[Ring]:
    """A ring for many runs."""
    with Ring.create(512) as ring:
        yield ring
