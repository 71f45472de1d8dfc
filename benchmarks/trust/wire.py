"""Faults on the wire, each alone and mixed, in every phase of a session, thousands of seeded runs.

A run: connect, command mode, hold, a motion of four phases, hold, monitor mode, log closed and read again.
The fault strikes at an instant of the drawn phase and stays for a while. What must hold is in `judge`.
"""

from __future__ import annotations

import re
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.trust.stand import LABEL, Stand, shared_ring, the_motion
from benchmarks.trust.table import Ledger, stamp
from benchmarks.trust.wire_faults import FAULTS, NAMED, PERIODS_MS, SEEN, Fault
from fri.states import State
from lwr_driver.control import Job, Mode, Result, Text, Word
from lwr_driver.link import advise_command, silence_in_lock_step, snapshot
from lwr_driver.ring import Ring
from lwr_driver.session import read_session

__all__ = ["FAULTS", "PHASES", "WireRun", "campaign", "plan", "run"]

PHASES = ("monitor", "start", "hold", "move_to_start", "settle", "excitation", "return", "brake", "end")
MOTION = ("move_to_start", "settle", "excitation", "return")
MIXED_SHARE = 0.35
_START_LIMIT = 700
_AFTERMATH = 30


@dataclass(frozen=True)
class Plan:
    """What a run is made of, drawn from seed and number."""

    number: int
    faults: tuple[Fault, ...]
    phase: str
    offset: int
    period_ms: int
    variant: int
    program: str
    lock_step: bool
    first_sequence: int
    uptime_s: float
    ahead: bool


@dataclass
class WireRun:
    """How a run ended. complaints : what should hold and did not; empty if all is well."""

    number: int
    faults: tuple[str, ...]
    phase: str
    status: str
    reason: str
    cycles_to_end: int | None
    complaints: list[str] = field(default_factory=list)


def plan(seed: int, number: int) -> tuple[Plan, np.random.SeedSequence]:
    """The run `number` of the campaign `seed`: faults and phases in turn, the rest by chance."""
    sequence = np.random.SeedSequence([seed, number])
    own, wire = sequence.spawn(2)
    random = np.random.default_rng(own)
    names = list(FAULTS)
    chosen = [names[number % len(names)]]
    phase = PHASES[number // len(names) % len(PHASES)]
    if random.random() < MIXED_SHARE:
        others = [name for name in names if name != chosen[0]]
        chosen += [str(name) for name in random.choice(others, int(random.integers(1, 4)), replace=False)]
    faults = tuple(FAULTS[name](random) for name in chosen)
    first = int(random.integers(0, 65536))
    if "wrap" in chosen:
        first = 65536 - int(random.integers(20, 140))
    chosen_plan = Plan(
        number,
        faults,
        phase,
        int(random.integers(0, 12)),
        int(random.choice(PERIODS_MS)),
        int(random.integers(12)),
        str(random.choice(["lwr_identification", "stanford", "ros_control"])),
        bool(random.random() < 0.5),
        first,
        float(random.choice([0.0, 3600.0, 4e4])),
        bool(random.random() < 0.5),
    )
    return chosen_plan, wire


def run(seed: int, number: int, ring: Ring, folder: Path) -> WireRun:
    """Do the run `number` and judge it."""
    chosen, wire = plan(seed, number)
    with Stand(
        wire,
        ring,
        folder,
        period_ms=chosen.period_ms,
        program=chosen.program,
        lock_step=chosen.lock_step,
        ahead=chosen.ahead and not chosen.lock_step,
        first_sequence=chosen.first_sequence,
        uptime_s=chosen.uptime_s,
    ) as stand:
        return _Course(stand, chosen).go()


class _Course:
    """The session of one run, step by step."""

    def __init__(self, stand: Stand, chosen: Plan) -> None:
        self.stand, self.plan = stand, chosen
        self.struck_at: int | None = None
        self.ended_at: int | None = None
        self.complaints: list[str] = []

    def strike(self, phase: str) -> None:
        """Let the faults begin if this is their phase."""
        if phase != self.plan.phase or self.struck_at is not None:
            return
        self.struck_at = self.stand.cycle_number
        for fault in self.plan.faults:
            fault.begin(self.stand)

    def pause(self, phase: str, cycles: int) -> None:
        """Some cycles, in which the fault strikes if the phase is its own."""
        for cycle in range(cycles):
            if cycle == min(self.plan.offset, cycles - 1):
                self.strike(phase)
            self.stand.cycle()

    def go(self) -> WireRun:
        """The whole session."""
        stand = self.stand
        while not stand.loop.remote.received:
            stand.cycle()
        self.pause("monitor", 14)
        status, reason = self.start()
        if status == "success":
            self.pause("hold", 13)
            status, reason = self.move()
            self.ended_at = stand.cycle_number
            self.pause("end", 13)
        self.aftermath(status)
        recorded = stand.close_log(status, reason)
        self.judge(status, reason, recorded)
        took = None
        if self.struck_at is not None and self.ended_at is not None and status == "fail":
            took = self.ended_at - self.struck_at
        names = tuple(fault.name for fault in self.plan.faults)
        return WireRun(self.plan.number, names, self.plan.phase, status, reason, took, self.complaints)

    def start(self) -> tuple[str, str]:
        """Into command mode, or the reason why not, as the driver gives it."""
        stand = self.stand
        stand.post(Job.START, limit=_START_LIMIT)
        begun = stand.cycle_number

        def each() -> None:
            if stand.cycle_number - begun == self.plan.offset % 4:
                self.strike("start")

        done = stand.until_done(_START_LIMIT + 50, each)
        self.ended_at = stand.cycle_number
        if done and stand.result is Result.DONE:
            return "success", ""
        if done and stand.result is not Result.TIMEOUT:
            return "fail", f"command mode with drives on: {stand.reason}"
        if not done:
            # Without a cycle the driver's own clock ends the waiting, some time later.
            stand.clock.sleep(2.0)
        state = snapshot(stand.control, stand.clock.now_ns, 0)
        return "fail", f"waiting for command mode; seen: {state.summary}. {advise_command(state)}"

    def move(self) -> tuple[str, str]:
        """The motion, which the fault may end."""
        stand, chosen = self.stand, self.plan
        if stand.loop.mode is not Mode.HOLD:
            return "fail", stand.control.text(Text.LEFT)
        motion = the_motion(stand.period_ms, chosen.variant)
        if not np.array_equal(motion.q[0].astype(np.float32), stand.loop.remote.command["jnt_pos"]):
            # After a fall from command mode the arm is elsewhere; the driver refuses such a motion.
            return "fail", "the motion does not begin at the commanded position"
        starts = {name: row for row, name in motion.phases}
        stand.start_motion(motion)
        stop_at = None
        if chosen.phase == "brake":
            stop_at = starts["excitation"] + 4 + 2 * chosen.offset
        words = stand.control.words

        def each() -> None:
            row = int(words[Word.ROW])
            if chosen.phase in starts and row >= starts[chosen.phase] + chosen.offset:
                self.strike(chosen.phase)
            if stop_at is not None and row >= stop_at and int(words[Word.STOP]) == 0:
                words[Word.STOP] = 1
            if stand.loop.mode is Mode.STOP:
                self.strike("brake")

        if not stand.until_done(len(motion) + 400, each):
            if chosen.lock_step:
                # The driver's patience for a silent emulator.
                state = snapshot(stand.control, stand.clock.now_ns, 0)
                return "fail", silence_in_lock_step(state, 15.0)
            self.complaints.append("motion without an end")
            return "fail", "no end"
        if stand.result is Result.DONE:
            return "success", ""
        return ("abort" if stand.result is Result.ABORTED else "fail"), stand.reason

    def aftermath(self, status: str) -> None:
        """Whatever comes now, the arm must not move by itself; then leave command mode."""
        stand = self.stand
        for _ in range(_AFTERMATH):
            stand.cycle()
            if stand.loop.mode is Mode.MOTION and stand.done:
                self.complaints.append("in motion after the end")
                break
        # Command mode that was lost and comes again may have a set point to bring to rest.
        if stand.loop.mode is Mode.STOP and stand.done:
            self.complaints.append(f"still stopping {_AFTERMATH} cycles after the end")
        stand.post(Job.LEAVE, limit=200)
        stand.until_done(80)

    def judge(self, status: str, reason: str, recorded: Any) -> None:
        """All that must hold at the end of a run."""
        stand, faults = self.stand, self.plan.faults
        say = self.complaints.append
        if stand.monitor.violations.sum():
            say(f"outside the limits: {stand.monitor.first_violation}")
        if stand.moved_alone > 0.0:
            say(f"commanded position moved by {stand.moved_alone:.2g} rad after the end")
        if (status == "success") != (reason == ""):
            say(f"status {status} with reason {reason!r}")
        if status == "fail" and all(fault.harmless for fault in faults):
            say(f"a harmless fault ended the motion: {reason}")
        if status == "fail" and "does not begin" not in reason:
            named = [NAMED.get(fault.name, "$^") for fault in faults]
            if "waiting for" in reason:
                named += [SEEN.get(fault.name, "$^") for fault in faults]
            if not re.search("|".join(named), reason):
                say(f"reason does not name the cause: {reason}")
        if self.struck_at is None and status == "success" and self.plan.phase != "brake":
            say(f"the fault never struck in phase {self.plan.phase}")
        self.judge_log(status, reason, recorded)

    def judge_log(self, status: str, reason: str, recorded: Any) -> None:
        """Every sample that was received is in the log, the others are counted."""
        stand, faults, say = self.stand, self.plan.faults, self.complaints.append
        received = int(stand.control.words[Word.RECEIVED])
        if recorded.error or recorded.rejected or recorded.overruns:
            say(f"log: error {recorded.error!r}, {recorded.rejected} rejected, {recorded.overruns} overruns")
        if recorded.samples != received:
            say(f"log has {recorded.samples} samples, {received} were received")
        if not received:
            return
        session = read_session(stand.path)
        end = session.end or {}
        if end.get("exit_status") != status or end.get("reason") != reason:
            say(f"log ends with {end.get('exit_status')} {end.get('reason')!r}")
        if len(session.joint) != recorded.samples or int(end.get("missed", -1)) != session.joint.lost:
            say(f"log: {len(session.joint)} samples, {end.get('missed')} missed, {session.joint.lost} gaps")
        # A clock at another pace makes a gap look like a restart.
        unclear = len(faults) > 1 and any(fault.name == "clock pace" for fault in faults)
        if unclear or any(fault.untrue or fault.recounts for fault in faults):
            return
        # The true numbers of the packets rise as the counter of the log does.
        labels = np.rint(session.joint.effort[:, 6]).astype(np.int64)
        steps = np.diff(session.joint.sequence)
        wrong = np.flatnonzero((np.diff(labels) - steps) % LABEL)
        if len(wrong):
            say(f"log: {len(wrong)} steps of the counter are not those of the packets")
        lost = stand.packets - received
        if stand.session.state is State.MON and not self.plan.faults and session.joint.lost != lost:
            say(f"{lost} packets were lost, the log counts {session.joint.lost}")


_BLOCK = 200
_RUNS = 10_000


def campaign(ledger: Ledger, options: Any) -> None:
    """All runs in blocks; a line for each fault alone, one for the mixed ones, one for each phase."""
    if options.only is not None:
        with shared_ring() as ring, tempfile.TemporaryDirectory() as folder:
            options.say(str(plan(options.seed, options.only)[0]))
            options.say(str(run(options.seed, options.only, ring, Path(folder))))
        return
    total = options.runs or _RUNS
    with shared_ring() as ring, tempfile.TemporaryDirectory() as folder:
        for first in range(0, total, _BLOCK):
            piece = f"{first}+{min(_BLOCK, total - first)}"
            if ledger.has("wire", piece):
                continue
            for number in range(first, min(first + _BLOCK, total)):
                _enter(ledger, run(options.seed, number, ring, Path(folder)))
            ledger.finish("wire", piece)
            ledger.line("wire", "all").figures |= stamp()
            failed = ledger.line("wire", "all").failed
            options.say(f"wire: {first + _BLOCK} of {total} runs, {failed} failed")


def _enter(ledger: Ledger, result: WireRun) -> None:
    alone = result.faults[0] if len(result.faults) == 1 else "mixed"
    for what in ("all", alone, f"in {result.phase}"):
        line = ledger.line("wire", what)
        line.count(result.complaints, f"run {result.number} {'+'.join(result.faults)} in {result.phase}")
        line.figures[result.status] = line.figures.get(result.status, 0) + 1
