"""Faults on the wire, each alone and mixed, in every phase of a session, thousands of seeded runs.

A run: connect, command mode, hold, a motion of four phases, hold, monitor mode, log closed and read again.
The fault strikes at an instant of the drawn phase and stays for a while. What must hold is in `judge`.
"""

from __future__ import annotations

import re
import struct
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.trust.stand import LABEL, Stand, shared_ring, the_motion
from benchmarks.trust.table import Ledger
from fri.states import State
from lwr_driver.control import Job, Mode, Result, Word
from lwr_driver.link import advise_command, silence_in_lock_step
from lwr_driver.ring import Ring
from lwr_driver.session import read_session
from lwr_driver.state import snapshot

__all__ = ["FAULTS", "PHASES", "WireRun", "campaign", "plan", "run"]

PHASES = ("monitor", "start", "hold", "move_to_start", "settle", "excitation", "return", "brake", "end")
MOTION = ("move_to_start", "settle", "excitation", "return")
PERIODS_MS = (1, 2, 4, 5, 10, 20)
MIXED_SHARE = 0.35
_START_LIMIT = 700
_AFTERMATH = 30

Random = np.random.Generator


@dataclass
class Fault:
    """A fault as it strikes: how to begin it, what it does to the expected end.

    begin : called in the cycle in which it strikes. harmless : the motion must succeed nevertheless
    untrue : packets may be taken for good that the controller did not send
    """

    name: str
    begin: Callable[[Stand], None]
    harmless: bool = False
    untrue: bool = False
    recounts: bool = False


def _wire(name: str, **settings: Any) -> Callable[[Random], Fault]:
    """A fault of the emulator's wire; a pair stands for the range from which a value is drawn."""

    def draw(random: Random) -> Fault:
        chosen: dict[str, Any] = {"kind": name, "cycles": int(random.integers(1, 80))}
        for key, value in settings.items():
            if isinstance(value, tuple) and isinstance(value[0], float):
                chosen[key] = float(random.uniform(*value))
            elif isinstance(value, tuple) and type(value[0]) is int:
                chosen[key] = int(random.integers(value[0], value[1] + 1))
            elif isinstance(value, tuple):
                chosen[key] = value[int(random.integers(len(value)))]
            else:
                chosen[key] = value
        to_pc = chosen["direction"] != "to_krc"
        untrue = to_pc and (name == "corrupt" or (name == "foreign" and chosen["host"] == "127.0.0.1"))
        harmless = name == "duplicate" or (name == "foreign" and not untrue)
        return Fault(name, lambda stand: stand.inject(**chosen), harmless, untrue)

    return draw


def _wrap(random: Random) -> Fault:
    """The counter wraps; where is set as the stand is built."""
    return Fault("wrap", lambda stand: None, harmless=True)


def _restart(random: Random) -> Fault:
    """The controller starts again, after some silence or none, with other counters, clock and port."""
    silent, new_port = int(random.integers(0, 60)), bool(random.random() < 0.5)
    # A cabinet counts from zero, after a mere friClose its clock goes on.
    first = int(random.choice([0, 0, int(random.integers(0, 65536))]))
    cold = bool(random.random() < 0.7)

    def begin(stand: Stand) -> None:
        uptime = 0.0 if cold else stand.session.timestamp_s + silent * stand.period_ms * 1e-3
        stand.clock.now_ns += max(silent * stand.period_ms, 200) * 1_000_000
        stand.restart(first, uptime, new_port=new_port)

    return Fault("restart", begin, recounts=True)


def _silent(random: Random) -> Fault:
    """The controller sends nothing for a while, or never again."""
    cycles = 10**6 if random.random() < 0.3 else int(random.integers(1, 150))
    return Fault("silent", lambda stand: setattr(stand, "silent", cycles))


def _fast(random: Random) -> Fault:
    """Packets come in heaps, faster than they can be answered."""
    cycles = int(random.integers(2, 40))
    return Fault("too fast", lambda stand: setattr(stand, "hurry", cycles))


def _pace(random: Random) -> Fault:
    """The controller's clock runs faster or slower than its sample time says."""
    factor = float(random.choice([0.25, 0.5, 0.9, 1.1, 2.0, 4.0]))

    def begin(stand: Stand) -> None:
        begun: list[float] = []

        def alter(packet: bytes, number: int) -> bytes:
            (timestamp,) = struct.unpack_from("<f", packet, 140)
            begun.append(timestamp) if not begun else None
            changed = bytearray(packet)
            struct.pack_into("<f", changed, 140, begun[0] + (timestamp - begun[0]) * factor)
            return bytes(changed)

        stand.alter = alter

    return Fault("clock pace", begin, harmless=True)


def _reopen(random: Random) -> Fault:
    """The program is selected anew with another cycle time."""
    period = int(random.choice(PERIODS_MS))
    return Fault("other cycle", lambda stand: stand.reopen(period), recounts=True)


def _version(random: Random) -> Fault:
    """Packets of another version of the protocol: another id, another size, or both."""
    cycles = 10**6 if random.random() < 0.3 else int(random.integers(1, 120))
    kind = int(random.integers(3))
    identifier = int(random.choice([0x2005, 0x2007, 0x1005, 0x3001]))
    size = int(random.choice([888, 908, 924, 1040]))

    def begin(stand: Stand) -> None:
        last = stand.packets + cycles

        def alter(packet: bytes, number: int) -> bytes:
            if number > last:
                stand.alter = None
                return packet
            changed = bytearray(packet)
            if kind != 1:
                struct.pack_into("<H", changed, 6, identifier)
            if kind != 0:
                struct.pack_into("<H", changed, 4, size)
                changed = changed[:size] + bytes(max(0, size - len(changed)))
            return bytes(changed)

        stand.alter = alter

    return Fault("other version", begin)


def _second_client(random: Random) -> Fault:
    """Another PC answers the controller too, and another controller sends to us."""
    cycles = int(random.integers(5, 120))
    host = str(random.choice(["127.0.0.1", "127.0.0.3"]))
    controller = bool(random.random() < 0.5)

    def begin(stand: Stand) -> None:
        last = stand.packets + cycles

        def beside(packet: bytes, number: int) -> None:
            if number > last:
                stand.beside = None
                return
            if controller:
                other = bytearray(packet)
                struct.pack_into("<HH", other, 0, (number * 7) & 0xFFFF, 5)
                stand.other(host).sendto(bytes(other), stand.end.remote)
            else:
                command = bytearray(376)
                struct.pack_into(
                    "<4H", command, 0, number & 0xFFFF, *struct.unpack_from("<H", packet), 376, 0x1005
                )
                struct.pack_into("<I7f", command, 140, 1, *np.linspace(-0.5, 0.5, 7))
                stand.other(host).sendto(bytes(command), stand.end.address)

        stand.beside = beside

    return Fault("second client", begin, harmless=True, untrue=controller and host == "127.0.0.1")


_BOTH = ("to_pc", "to_krc", "both")
FAULTS: dict[str, Callable[[Random], Fault]] = {
    "loss": _wire("loss", direction=_BOTH, probability=(0.02, 1.0)),
    "burst": _wire("burst", direction=_BOTH, probability=(0.02, 0.3), length=(2, 40)),
    "delay": _wire("delay", direction=_BOTH, probability=(0.05, 1.0), length=(1, 12)),
    "jitter": _wire("jitter", direction=_BOTH, probability=(0.05, 1.0), length=(1, 6)),
    "duplicate": _wire("duplicate", direction=_BOTH, probability=(0.1, 1.0)),
    "reorder": _wire("reorder", direction=_BOTH, probability=(0.05, 1.0)),
    "truncate": _wire("truncate", direction=_BOTH, probability=(0.05, 1.0)),
    "corrupt": _wire("corrupt", direction=_BOTH, probability=(0.05, 1.0), bits=(1, 12)),
    "foreign": _wire(
        "foreign",
        direction=_BOTH,
        probability=(0.1, 1.0),
        imitate=(True, False),
        host=("127.0.0.2", "127.0.0.1"),
    ),
    "wrap": _wrap,
    "restart": _restart,
    "silent": _silent,
    "too fast": _fast,
    "clock pace": _pace,
    "other cycle": _reopen,
    "other version": _version,
    "second client": _second_client,
}

# What a reason must say to name the cause: what the PC can know of each fault.
_ANSWERS = r"[1-9]\d* answers missed"
_PACKETS = r"lost|no packet for|late|out of order"
_DAMAGED = r"malformed"
_AGAIN = r"started again|sample time"
_NAMED: dict[str, str] = {
    "loss": f"{_ANSWERS}|{_PACKETS}",
    "burst": f"{_ANSWERS}|{_PACKETS}",
    "delay": f"{_ANSWERS}|{_PACKETS}",
    "jitter": f"{_ANSWERS}|{_PACKETS}",
    "reorder": f"{_ANSWERS}|{_PACKETS}",
    "truncate": f"{_ANSWERS}|{_DAMAGED}|{_PACKETS}",
    "corrupt": f"{_ANSWERS}|{_DAMAGED}|{_PACKETS}|{_AGAIN}|left|set point|measured position|drives",
    "restart": f"{_AGAIN}|{_PACKETS}",
    "silent": _PACKETS,
    "too fast": f"{_ANSWERS}|{_PACKETS}",
    "other cycle": f"{_AGAIN}|{_PACKETS}|left command mode",
    "other version": f"{_DAMAGED}",
    "clock pace": _AGAIN,
    "second client": _AGAIN,
    "foreign": "foreign|left command mode",
}


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
    return Plan(
        number,
        faults,
        phase,
        int(random.integers(0, 12)),
        int(random.choice(PERIODS_MS)),
        int(random.integers(12)),
        str(random.choice(["stanford", "ros_control"])),
        bool(random.random() < 0.5),
        first,
        float(random.choice([0.0, 3600.0, 4e4])),
    ), wire


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
        state = snapshot(stand.control, stand.clock.now_ns, 0)
        # Without a cycle the driver's own clock ends the waiting.
        return "fail", f"waiting for command mode; seen: {state.summary}. {advise_command(state)}"

    def move(self) -> tuple[str, str]:
        """The motion, which the fault may end."""
        stand, chosen = self.stand, self.plan
        if stand.loop.mode is not Mode.HOLD:
            return "fail", stand.control.text(1)
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
            if stand.loop.mode in (Mode.MOTION, Mode.STOP) and stand.done:
                self.complaints.append(f"in mode {stand.loop.mode.name} after the end")
                break
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
        if status == "fail" and "waiting for" not in reason and "does not begin" not in reason:
            named = "|".join(_NAMED.get(fault.name, "$^") for fault in faults)
            if not re.search(named, reason):
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
            failed = ledger.line("wire", "all").failed
            options.say(f"wire: {first + _BLOCK} of {total} runs, {failed} failed")


def _enter(ledger: Ledger, result: WireRun) -> None:
    alone = result.faults[0] if len(result.faults) == 1 else "mixed"
    for what in ("all", alone, f"in {result.phase}"):
        line = ledger.line("wire", what)
        line.count(result.complaints, f"run {result.number} {'+'.join(result.faults)} in {result.phase}")
        line.figures[result.status] = line.figures.get(result.status, 0) + 1
