"""A loop and a controller's session in one thread: one call is one FRI cycle; sockets out of lock step only."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fri.controller_end import ControllerEnd
from fri.in_process import Network
from fri.krc import KrcSession, Sample, Setpoint
from fri.krl import Interpreter
from fri.packets import CMD, CMD_SIZE
from fri.policy import KrcLimits, KrcPolicy
from fri.states import State
from lwr_driver.arm import Arm, ArmLimits
from lwr_driver.control import Control, Job, Mode, Result, Text, Word
from lwr_driver.loop import Loop, LoopSettings
from lwr_driver.motion import Motion, move_to
from lwr_driver.ring import Ring
from sim_backend.program import krl_program

DEG = np.pi / 180.0
START = np.array([0.1, 0.5, -0.2, -1.3, 0.3, 0.8, -0.1])
POLICY = {"window": 40, "minimum_packets": 10, "start_dwell": 5}
HOP = np.array([0.4, -0.3, 0.3, 0.5, -0.6, 0.2, 0.7])
ROUNDING = 2.0**-23


@cache
def arm() -> Arm:
    return Arm.load()


def excesses(rows: NDArray[np.float64], times: NDArray[np.float64], limits: ArmLimits) -> list[str]:
    """Which limits the values `rows` (n, 7), commanded at `times` [s] after rest at the first, break.

    Plain divided differences of the values as they arrived, with the worst that rounding to float32 can do.
    """
    period = float(np.diff(times).min()) if len(times) > 1 else 1e-3
    before = times[0] - period * np.arange(3, 0, -1)
    t = np.concatenate([before, times])
    table, error = np.vstack([rows[:1]] * 3 + [rows]), np.full(len(rows) + 3, ROUNDING)
    found = []
    if np.any(rows < limits.q_low - ROUNDING) or np.any(rows > limits.q_high + ROUNDING):
        found.append("position")
    for order, (name, bound) in enumerate(
        (("velocity", limits.v_max), ("acceleration", limits.a_max), ("jerk", limits.j_max)), start=1
    ):
        width = (t[order:] - t[:-order]) / order
        table = np.diff(table, axis=0) / width[:, None]
        error = (error[1:] + error[:-1]) / width
        if np.any(np.abs(table) > bound + error[:, None] + 1e-6):
            found.append(name)
    return found


@dataclass
class Arrived:
    """Commands that reached the controller in command mode with drives on: cycle and position.

    begins : places in the list where command mode was entered; there the arm was at rest
    """

    cycles: list[int] = field(default_factory=list)
    rows: list[NDArray[np.float64]] = field(default_factory=list)
    begins: list[int] = field(default_factory=list)

    def excesses(self, limits: ArmLimits, period_s: float) -> list[str]:
        found: list[str] = []
        for first, end in itertools.pairwise([*self.begins, len(self.rows)]):
            if end > first:
                times = np.array(self.cycles[first:end]) * period_s
                found += excesses(np.array(self.rows[first:end]), times, limits)
        return found


class Rig:
    """The loop under test answers the controller's session, cycle by cycle; the arm follows at once."""

    def __init__(
        self,
        period_ms: int = 1,
        *,
        q: NDArray[np.float64] = START,
        program: str = "stanford",
        lock_step: bool = True,
        ring: Ring | None = None,
        policy: dict[str, object] | None = None,
        tracking_limit_rad: float = 0.2,
        watch: Any = None,
    ) -> None:
        self.arm = arm()
        self.period_ms, self.period_s = period_ms, period_ms * 1e-3
        hard = KrcLimits(self.arm.q_min, self.arm.q_max, 1.2 * self.arm.v_max, np.full(7, 20.0))
        self.session = KrcSession(hard, q, KrcPolicy(**{**POLICY, **(policy or {})}))
        self.interpreter = Interpreter(self.session, krl_program(program, period_ms))
        self.sample = Sample()
        self.sample.msr_jnt_pos[:] = q
        self.control = Control.create(200_000)
        self.settings = LoopSettings(
            "127.0.0.1", 0, None, lock_step, program, 0.1, tracking_limit_rad, self.arm.joint_names
        )
        self.network = Network() if lock_step else None  # in real time the loop waits at its socket
        self.loop = Loop(self.settings, self.arm.limits, self.control, ring, watch, self.network)
        self.end = ControllerEnd(self.loop.remote.address, network=self.network)
        self.arrived = Arrived()
        self.sent_by_loop: list[NDArray[np.float64]] = []
        self.cycle_number = 0
        self.timeout_s = 5.0
        self.commanding = False
        self.displacement = np.zeros(7)
        self.interpreter.advance(period_ms)

    def replace_loop(self) -> None:
        """Another client takes the place of the loop, as after a crash of this computer."""
        port = self.loop.remote.address[1]
        self.loop.remote.close()
        settings = dataclasses.replace(self.settings, port=port)
        self.loop = Loop(settings, self.arm.limits, self.control, network=self.network)

    def close(self) -> None:
        self.end.close()
        self.loop.remote.close()
        self.control.close()

    def cycle(self, *, lose_packet: bool = False, lose_answer: bool = False, copies: int = 1) -> Setpoint:
        """One cycle of the controller; the packet or its answer may get lost, or come several times."""
        if self.session.state is State.OFF:
            setpoint = self.session.close_cycle()
        else:
            packet = self.session.packet(self.sample)
            commanding = self.session.state is State.CMD and self.session.power != 0
            if commanding and not self.commanding:
                self.arrived.begins.append(len(self.arrived.rows))
            self.commanding = commanding
            if not lose_packet:
                for _ in range(copies):
                    self.end.send(packet)
                self.loop.cycle(self.timeout_s)
                for _ in range(copies - 1):
                    self.loop.cycle(0.0)
                while (datagram := self.end.receive(0.0)) is not None:
                    self._note(datagram, packet, commanding)
                    if not lose_answer:
                        self.session.receive(datagram)
            setpoint = self.session.close_cycle()
        self.sample.msr_jnt_pos[:] = setpoint.position + self.displacement
        self.interpreter.advance(self.period_ms)
        self.cycle_number += 1
        return setpoint

    def _note(self, datagram: bytes, packet: bytes, commanding: bool) -> None:
        assert len(datagram) == CMD_SIZE
        cmd = np.frombuffer(datagram, CMD)[0]
        if commanding and datagram[2:4] == packet[:2]:
            self.arrived.cycles.append(self.cycle_number)
            self.arrived.rows.append(cmd["jnt_pos"].astype(np.float64))

    def cycles(self, count: int) -> None:
        for _ in range(count):
            self.cycle()

    def post(self, job: Job, a: int = 0, b: int = 0, limit: int = 0) -> None:
        self.control.post(job, a, b, limit)

    @property
    def done(self) -> bool:
        return self.control.done

    @property
    def result(self) -> Result:
        return self.control.result

    @property
    def reason(self) -> str:
        return self.control.text(Text.REASON)

    @property
    def mode(self) -> Mode:
        return self.loop.mode

    def until_done(self, most: int = 5000) -> Result:
        for _ in range(most):
            if self.done:
                return self.result
            self.cycle()
        raise AssertionError(f"job not done after {most} cycles, mode {self.mode.name}")

    def enter(self) -> None:
        """Up to command mode."""
        self.post(Job.START, limit=2000)
        assert self.until_done() is Result.DONE, self.reason

    def start(self, motion: Motion) -> None:
        """Ask for a motion; the next cycle sends its first row."""
        words = self.control.words
        phases: Sequence[tuple[int, int]] = [(row, 2 + n) for n, (row, _) in enumerate(motion.phases)]
        self.control.put_motion(motion.q, phases)
        self.post(Job.MOTION, len(motion), int(words[Word.STOP]))

    def stop(self) -> None:
        self.control.words[Word.STOP] += 1

    @property
    def target(self) -> NDArray[np.float64]:
        """Last position that was sent."""
        return np.array(self.loop.remote.command["jnt_pos"], dtype=np.float64)


def check_sent(rig: Rig) -> None:
    """What arrived at the controller is within the arm's limits."""
    assert rig.arrived.excesses(arm().limits, rig.period_s) == []


def hop(rig: Rig, speed_scale: float = 1.0) -> Motion:
    return move_to(arm(), rig.target, rig.target + HOP, rig.period_s, speed_scale=speed_scale)


def in_motion(rig: Rig, cycles: int = 60) -> Motion:
    """A rig that has sent `cycles` rows of a motion."""
    rig.enter()
    motion = hop(rig)
    rig.start(motion)
    rig.cycles(cycles)
    assert rig.mode is Mode.MOTION
    return motion


class Clock:
    """Time that only its owner lets pass; stands in for the module `time` of the loop."""

    def __init__(self) -> None:
        self.now_ns = 10**12

    def monotonic(self) -> float:
        """Virtual time [s]."""
        return self.now_ns * 1e-9

    def monotonic_ns(self) -> int:
        """Virtual time [ns]."""
        return self.now_ns

    def sleep(self, seconds: float) -> None:
        """Let time pass."""
        self.now_ns += round(seconds * 1e9)
