"""The FRI loop: receive, judge, answer at once, write a row; nothing else.

Outside command mode the answer is the mirror of the controller's own set point, in command mode the value of
`lwr_driver.commander`. Leaving command mode ends a motion for good; it is never resumed.

Requests come through shared memory and are read once a cycle. In lock step the loop stands still between
requests, so no virtual time passes without one.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fri.handshake import IdentificationHandshake, find_handshake
from fri.in_process import Network
from fri.packets import CMD
from fri.remote import RemoteEnd
from fri.states import ALL_DRIVES, Quality, State
from fri.states import Control as ControlMode
from lwr_driver.arm import JOINTS, ArmLimits
from lwr_driver.commander import Commander
from lwr_driver.contact import Contact, ContactWatch, Stale, WatchAhead
from lwr_driver.control import Control, Job, Mode, Result, Text, Word
from lwr_driver.cycle_rows import CycleRows
from lwr_driver.means import CycleMeans
from lwr_driver.pace import Pace, Stamps
from lwr_driver.ring import Ring
from lwr_driver.setpoint import SetpointHistory

if TYPE_CHECKING:
    from lwr_driver.turnaround import Turnaround

_IDLE_S = 0.0005  # pause of an idle loop in lock step
_SLICE_S = 0.02  # longest wait for a packet between checks of requests and silence
_FEWEST_CYCLES = 10  # silence of so many cycles is always tolerated
_RING_PATIENCE_S = 5.0
# Active waiting begins so long before a packet is due, at most this share of a cycle, and ends so long after.
# On a kernel without PREEMPT_RT waking up can take a millisecond; it must be over when the packet comes.
_LOOKOUT_S, _LOOKOUT_SHARE = 1.2e-3, 0.4
_OVERDUE_S = 0.15e-3
# Jobs without a message to the KRL program.
_LEAVE_ALONE = (Job.NONE, Job.MOTION, Job.CYCLES)
# Rows written at once fill at most this share of the ring, so that its onlookers are not overtaken.
_RING_SHARE = 4
# What the watch sees of a packet.
_WATCHED = ("msr_jnt_pos", "msr_jnt_trq", "est_ext_jnt_trq", "gravity")
_NOBODY_S = 1.0  # a motion goes on so long without a sign of life of the driver's process
_REMIND_S = 1.0  # silence in lock step before a reminder to the other side
# A motion ends after so many packets of quality UNACCEPTABLE in command mode, or so long below OK.
_UNACCEPTABLE_PACKETS, _BAD_S = 3, 1.0
# Counters of the link in a reason, with their words.
_REPORTED = (
    ("lost", "lost"),
    ("reordered", "late"),
    ("suspect", "held back"),
    ("malformed", "malformed"),
    ("foreign", "foreign"),
    ("ahead", "ahead of their time by the sender's fault"),
)


@dataclass(frozen=True)
class LoopSettings:
    """Settings of the loop, as in `lwr_driver.link.LinkSettings`."""

    address: str
    port: int
    controller: str | None
    lock_step: bool
    handshake: str
    link_timeout_s: float
    tracking_limit_rad: float
    joint_names: tuple[str, ...]
    torque_sign: tuple[float, ...] = (1.0,) * JOINTS


class Loop:
    """One link to a controller, driven by requests in shared memory.

    Usable in any process: `cycle` handles one packet, `run` goes on until the request to quit.

    control : the shared memory; ring : rows for the recorder, None keeps none
    watch : of torque and contact, None watches nothing
    network : shared with the other side in this process, for `turn`; None uses UDP
    turnaround : waits actively for the next packet, with its answer and those to the following packets ready;
        it costs up to 1.35 ms of a processor in each cycle, 0.55 ms at 1 kHz; None to sleep instead
    pace : keeps rows from passing faster than this computer's clock; None where packets have no such clock, as in
        lock step
    """

    def __init__(
        self,
        settings: LoopSettings,
        limits: ArmLimits,
        control: Control,
        ring: Ring | None = None,
        watch: ContactWatch | None = None,
        network: Network | None = None,
    ) -> None:
        self._settings, self._control, self._ring, self._watch = settings, control, ring, watch
        self.turnaround: Turnaround | None = None
        self.pace: Pace | None = None
        self._ready_in = Mode.MIRROR  # mode of the prepared answers
        self._handshake = find_handshake(settings.handshake)
        self.remote = RemoteEnd(settings.address, settings.port, settings.controller, network=network)
        self.remote.set_torque_sign(settings.torque_sign)
        self.remote.host_clock = not settings.lock_step
        self._commander = Commander(limits, control, settings.joint_names, settings.tracking_limit_rad)
        self._words = control.words
        msr = self.remote.msr
        self._krl, self._offset = msr["cmd_jnt_pos"], msr["cmd_jnt_pos_fri_offset"]
        self._q = msr["msr_jnt_pos"]
        self._torques = msr["msr_jnt_trq"], msr["est_ext_jnt_trq"], msr["gravity"]
        if watch is not None:
            self._commander.external, self._commander.allowed = watch.external, watch.allowed
        self._loads = 0  # payloads taken from the driver
        self._alarm: Callable[[], None] | None = None  # ends a motion with the next packet
        self._unacceptable, self._bad = 0, 0  # packets of such quality on end, cycles below OK
        self._sample_time = self._period = 0.0
        self._silence_s, self._silence_cycles = settings.link_timeout_s, 0
        self._sequence = self._count = -1  # of packets, and of the cycles they took
        self._stamps = Stamps()
        self._setpoints = SetpointHistory(limits)
        self._doubted = self._held_back = False
        self._let_brake = 0  # cycles of a moving set point left to the controller
        self._misses, self._misses_before, self._missed_at = 0, 0, -_FEWEST_CYCLES
        self._counted_before = self.remote.counters()
        self._heard_s = self._reminded_s = time.monotonic()
        self._answered = False
        self._restarts = 0
        self._offered_ns = 0
        self._looked: WatchAhead | None = None  # at accepted packets not taken yet

        self._request = int(self._words[Word.REQUEST])
        self._job = Job.NONE
        self._a = self._b = self._limit = 0  # its arguments
        self._job_cycles = self._run_length = 0
        self._begun = False
        self._means = CycleMeans(self.remote)
        self._rows = CycleRows(self.remote, self._commander, control, ring, lock_step=settings.lock_step)

    @property
    def mode(self) -> Mode:
        """Present kind of answer."""
        return self._commander.mode

    def run(self, parent: int | None = None) -> None:
        """Serve packets and requests until `QUIT` is set or the parent is gone; stops a motion first."""
        parent = os.getppid() if parent is None else parent
        commander = self._commander
        if not self._settings.lock_step:
            # Packets that came while this process was being set up.
            self.remote.drain()
        self.begin()
        try:
            while True:
                if (self._words[Word.QUIT] or os.getppid() != parent) and self._up_to_date():
                    if self._settings.lock_step or not commander.moving:
                        return
                    if commander.mode is Mode.MOTION:
                        commander.stop(Result.ABORTED, f"the driver ended {commander.place()}")
                self._serve()
        finally:
            self.end()

    def begin(self) -> None:
        """Declare this process the writer of the rows."""
        if self._ring is not None:
            self._ring.start_writing()

    def end(self) -> None:
        """Declare an intended end, and close the link."""
        if self._ring is not None:
            self._ring.stop_writing()
        self.remote.close()

    def turn(self) -> bool:
        """In lock step, one step of `run` without waiting; False if no packet was handled."""
        self._take_request()
        if self._job is Job.NONE:
            self._idle()
            return False
        self._wait_for_ring()
        if self.cycle(0.0):
            return True
        self.remind()
        return False

    def cycle(self, timeout_s: float) -> bool:
        """Handle the next packet; False if none came within `timeout_s` [s]."""
        remote, turnaround = self.remote, self.turnaround
        if turnaround is None:
            came, sent = remote.receive(timeout_s) is not None, False
        else:
            came, sent = self._look_out(turnaround, timeout_s), turnaround.sent
        if not came:
            if sent:
                self._disagree()
            self._no_packet()
            return False
        counted = remote.sequence - self._sequence if self._sequence >= 0 else 1
        elapsed = self._passed(counted, sent)
        target = self._decide(elapsed, sent)
        self._sequence = remote.sequence
        answered = self._commander.mode is not Mode.SILENT and not self._held_back
        if answered:
            remote.answer(target, insist=self._doubted, sent=sent)
        if turnaround is not None and sent and turnaround.answer_bytes != self._rows.command_bytes:
            self._disagree()
        self._answered = answered or sent
        self._rows.write(self._answered, turnaround.sent_ns if turnaround is not None and sent else None)
        self._advance_job(max(elapsed, 1))
        return True

    def offer(self, most: int) -> NDArray[Any]:
        """In lock step, the answers to the coming packets, at most `most`, as (n,) of `CMD`; nothing is sent.

        They are given while a motion just goes on and hold for packets that `accept` finds in order: then each is the
        very answer of `cycle`. None otherwise, n = 0: the next packet goes through `cycle`.
        """
        self._take_request()
        self._offered_ns = time.monotonic_ns()
        remote, words, ring = self.remote, self._words, self._ring
        ordinary = (
            self._job is Job.MOTION
            and self._begun
            and int(words[Word.STOP]) == self._b
            and self._limit == 0
            and self._alarm is None
            and self._answered
            and not (self._doubted or self._held_back)
            and self.pace is None
            and remote.sequence == self._sequence
            and remote.sample_time_s == self._sample_time
            and remote.state == State.CMD
            and remote.power == ALL_DRIVES
            and remote.error == 0
            and remote.quality >= Quality.OK
            and remote.restarts == self._restarts
            and remote.foreseen is not None
            # A packet sent twice must not outlive the packets after it: it would look like a restart.
            and not remote.pending()
        )
        if ring is not None:
            most = min(most, ring.free, ring.capacity // _RING_SHARE)
        values = self._commander.rows_ahead(self._count + 1, most if ordinary else 0)
        return remote.prepare(values) if len(values) else np.zeros(0, CMD)

    def accept(self, packets: NDArray[Any], commands: NDArray[Any]) -> int:
        """For how many leading `packets`, (n,) of `MSR`, the answers `commands` of `offer` hold.

        These are packets in which nothing has happened: the same tests as for each packet of `cycle`.
        """
        remote, watch = self.remote, self._watch
        count = remote.recognise(packets, commands)
        packets = packets[:count]
        setpoints = packets["cmd_jnt_pos"] + packets["cmd_jnt_pos_fri_offset"]
        count = self._commander.watch_rows(commands["jnt_pos"][:count], setpoints, packets["msr_jnt_pos"])
        if watch is None or not count:
            return count
        packets = remote.turned(packets[:count])
        self._looked = watch.ahead(*(packets[name] for name in _WATCHED))
        return self._looked.count

    def take(self, packets: NDArray[Any], commands: NDArray[Any]) -> None:
        """Take in accepted `packets` and their answers, (n,) each, as `cycle` does one by one."""
        count, words = len(packets), self._words
        values = commands["jnt_pos"].astype(np.float32)
        before = self._sequence
        self.remote.take(packets, commands)
        packets = self.remote.turned(packets)
        if self._looked is not None:
            self._looked.place(count)
            self._looked = None
        first_index = self._commander.index + 1
        self._commander.take_rows(values, packets["msr_jnt_pos"])
        self._note_packets(packets)
        self._sequence += count
        self._count += count
        self._job_cycles += count
        self._unacceptable = self._bad = 0
        self._heard_s = self.remote.received_ns * 1e-9
        words[Word.HEARD_NS] = self.remote.received_ns
        sent_ns = time.monotonic_ns()
        # Together they took this time, each a share of it.
        self._rows.count_latency((sent_ns - self._offered_ns) // count, count)
        self._rows.write_many(before + 1, first_index, packets, commands)

    def _note_packets(self, packets: NDArray[Any]) -> None:
        """Set points and time stamps of plain successors, as far as later packets are compared with them."""
        self._setpoints.add_packets(packets)
        for stamp in packets["timestamp"][-2:].tolist():
            self._stamps.feed(1, stamp, self._sample_time)

    def _passed(self, counted: int, sent: bool) -> int:
        """How many of the `counted` cycles have passed by the clocks; 0 for a packet ahead of its time."""
        remote, pace = self.remote, self.pace
        if remote.restarts != self._restarts:
            # Neither clock goes on over a restart.
            self._stamps = Stamps()
            self._count += counted
            return counted
        passed = self._stamps.feed(counted, remote.timestamp_s, remote.sample_time_s)
        if pace is not None:
            passed = pace.feed(counted, remote.received_ns, answered=sent)
        if passed < counted and not sent and self._commander.mode is not Mode.MIRROR:
            whose = f"this computer's clock: {pace}" if pace is not None else "its own time stamp"
            remote.tell_ahead(
                counted - passed, f"the controller's counter runs ahead of {whose}; the sender is at fault"
            )
        self._count = self._count + passed if self._sequence >= 0 else remote.sequence
        return passed

    def _up_to_date(self) -> bool:
        """Whether every answered packet has been processed."""
        return self.turnaround is None or not self.turnaround.waiting

    def _serve(self) -> None:
        if not self._settings.lock_step:
            self.cycle(_SLICE_S)
            return
        self._take_request()
        if self._job is not Job.NONE:
            self._wait_for_ring()
            if not self.cycle(_SLICE_S):
                self.remind()
            return
        time.sleep(_IDLE_S)
        self._idle()

    def _idle(self) -> None:
        if self._commander.mode is not Mode.MIRROR:
            self.remind()
        if self._ring is not None:
            self._ring.beat(time.monotonic_ns())

    def _look_out(self, turnaround: Turnaround, timeout_s: float) -> bool:
        """Wait for a packet with the answer ready; False if none came. A new request is taken at once."""
        remote = self.remote
        again = not turnaround.next(more=self._commander.mode is self._ready_in and self._alarm is None)
        while again:
            self._make_ready(turnaround)
            due = remote.received_ns * 1e-9 + self._period - time.monotonic()
            early = due - min(_LOOKOUT_S, _LOOKOUT_SHARE * self._period)
            window = round(1e9 * early), round(1e9 * (due + _OVERDUE_S))
            again = turnaround.wait(*window, round(1e9 * timeout_s))
        if not turnaround.arrived:
            return False
        return remote.receive(0.0, (turnaround.length, turnaround.source, turnaround.received_ns)) is not None

    def _make_ready(self, turnaround: Turnaround) -> None:
        """Prepare the answers to the next packets, if these are regular, as far as known now."""
        seen, remote, commander = turnaround.disarm(), self.remote, self._commander
        self._take_request()
        asked = self._job is Job.MOTION
        begins = asked and not self._begun
        stops = not asked or int(seen[Word.STOP]) != self._b
        counter = remote.foreseen
        if (
            self._doubted
            or counter is None
            or remote.controller is None
            or (stops and (begins or commander.mode is Mode.MOTION))
            or (self._alarm is not None and commander.mode is Mode.MOTION)
        ):
            return
        # Other jobs may write to the KRL program with any answer. In lock step no packet waits.
        several = self._job in _LEAVE_ALONE and not self._settings.lock_step
        most = turnaround.most if several else 1
        foreseen = commander.foresee(self._count + 1, self._a if begins else 0, most)
        if foreseen is None:
            return
        ready = len(foreseen.values)
        for ahead in range(ready - foreseen.new, ready):
            remote.foresee(
                foreseen.values[ahead], turnaround.slot(counter + ahead, foreseen.values[ahead]), ahead
            )
        self._ready_in = commander.mode
        turnaround.arm(
            remote.controller,
            counter,
            ready,
            self._sample_time,
            commander.target,
            foreseen.room,
            *((self.pace.due_ns, self.pace.period_ns) if self.pace is not None else ()),
        )

    def _disagree(self) -> None:
        """Fall silent after an answer sent against the loop's decision; this cannot happen."""
        self._commander.fall_silent(Result.GUARD, "an answer was sent that the loop would not have given")

    def remind(self) -> None:
        """Lock step: after some silence, repeat that all packets have been answered.

        Otherwise both sides would wait for ever after one lost datagram, and in command mode a slow driver
        would seem to be gone. An answer held back on purpose is no reason to remind.
        """
        now = time.monotonic()
        answering = self._answered and self._commander.mode is not Mode.SILENT
        if answering and now - max(self._heard_s, self._reminded_s) >= _REMIND_S:
            self._reminded_s = now
            self.remote.remind()

    def _wait_for_ring(self) -> None:
        ring = self._ring
        if ring is None or ring.free > 0:
            return
        deadline = time.monotonic() + _RING_PATIENCE_S
        while ring.free <= 0 and time.monotonic() < deadline and not self._words[Word.QUIT]:
            time.sleep(_IDLE_S)

    # -- what to answer --------------------------------------------------------------------------------------

    def _decide(self, elapsed: int, sent: bool) -> NDArray[np.float32] | None:
        """The position to send, or None for the mirror, or for no answer at all if it is held back.

        elapsed : cycles since the last packet, 0 for one ahead of its time, see `_passed`
        sent : the answer has left already; new requests are for the next packet

        In command mode the mirror of a moving set point would stop the arm at once. Without an answer the
        controller brakes it.
        """
        remote, commander = self.remote, self._commander
        self._held_back = False
        self._heard_s = remote.received_ns * 1e-9
        setpoint = self._krl + self._offset
        early, elapsed = elapsed == 0, max(elapsed, 1)
        self._setpoints.add(setpoint, elapsed)
        ready = self._check_link(elapsed)
        if not sent:
            self._take_request()
        touched = self._feel(elapsed)
        misses = int(remote.msr["miss_counter"])
        if misses != self._misses:
            self._misses, self._missed_at = misses, remote.sequence
        if commander.mode is Mode.SILENT:
            return None
        if not ready:
            self._leave()
            if remote.commanding:
                step = self._setpoints.step()
                self._held_back = step is None or bool(step.any())
            return None
        if commander.mode is Mode.MIRROR:
            return self._enter(setpoint, elapsed)
        if early and (commander.moving or self._job is Job.MOTION):
            # Without an answer a controller that is too fast brakes by itself; no row is due yet.
            self._held_back = True
            self._react(touched, elapsed, sent)
            if commander.mode is Mode.MOTION and self.pace is not None and self.pace.too_fast:
                commander.stop(Result.NETWORK, self._too_fast())
            return None
        commander.watch(elapsed, setpoint, self._q)
        self._react(touched, elapsed, sent)
        if self._job is Job.MOTION and not self._begun:
            self._begun = True
            commander.begin(self._a, self._count)
        if commander.mode is Mode.MOTION and not sent:
            if int(self._words[Word.STOP]) != self._b:
                commander.stop(Result.ABORTED, f"stop requested {commander.place()}")
            elif self._job is not Job.MOTION:
                commander.stop(Result.ABORTED, f"stopped by the driver {commander.place()}")
        return commander.command(self._count)

    def _check_link(self, elapsed: int) -> bool:
        """Notice a restart, a gap and another sample time; whether the controller takes commands.

        A packet in doubt, see `_doubtful`, is taken for one that takes commands.
        """
        remote = self.remote
        if remote.restarts != self._restarts:
            self._restarts = remote.restarts
            self._reset_pace()
            # The restart has cleared the request to start; it is made anew.
            self._begun = self._begun and self._job is not Job.START
            self._lose("the controller was started again")
        elif elapsed > self._silence_cycles:
            self._lose(f"{elapsed - 1} packets in a row were lost")
        ready = (
            remote.state == State.CMD
            and remote.power == ALL_DRIVES
            and remote.error == 0
            and remote.control == ControlMode.POSITION
        )
        other_cycle = remote.sample_time_s != self._sample_time
        self._doubted = (other_cycle or not ready) and self._doubtful()
        if other_cycle and not self._doubted:
            self._set_period(remote.sample_time_s)
        return ready or self._doubted

    def _enter(self, setpoint: NDArray[np.float32], elapsed: int) -> NDArray[np.float32] | None:
        """The first position in command mode; None, held back, while the controller's set point must not be stopped."""
        step = self._setpoints.step()
        if step is None or (step.any() and not self._may_stop(setpoint, elapsed)):
            self._held_back = True
            return None
        self._let_brake = self._unacceptable = self._bad = 0
        self._alarm = None
        if self._watch is not None:
            self._watch.weigh()
        self._misses_before = self._misses
        self._counted_before = self.remote.counters()
        return self._commander.enter(setpoint, float(self.remote.msr["safety_limits"]), step)

    def _feel(self, elapsed: int) -> Contact | None:
        """Torque or contact beyond its limit in this packet."""
        watch = self._watch
        if watch is None:
            return None
        loads = int(self._words[Word.LOAD])
        if loads != self._loads and not self._commander.moving:
            self._loads, load = loads, self._control.load
            watch.carry(float(load[0]), load[1:4], load[4:])
        return watch.update(elapsed, self._q, *self._torques)

    @property
    def _stale(self) -> Stale | None:
        """A stale measurement that began in this motion; one before it is an arm that stopped at once."""
        found = None if self._watch is None else self._watch.stale
        return found if found is not None and found.seconds <= self._commander.index * self._period else None

    def _react(self, touched: Contact | None, elapsed: int, sent: bool) -> None:
        """In command mode, end a motion after a contact, or after a link rated bad for too long.

        A motion with its answer already sent ends with the next packet.
        """
        commander, quality = self._commander, self.remote.quality
        self._unacceptable = self._unacceptable + 1 if quality == Quality.UNACCEPTABLE else 0
        self._bad = self._bad + elapsed if quality < Quality.OK else 0
        if touched is not None:
            what = f"contact: {touched.describe(self._settings.joint_names)}"
            self._alarm = partial(commander.touch, what, touched.advice)
        elif self._alarm is None and commander.mode is Mode.MOTION and self._stale is not None:
            what = f"{self._stale.describe(self._settings.joint_names)} {commander.place()}; {self._stale.advice}"
            self._alarm = partial(commander.stop, Result.ROBOT, what)
        elif self._alarm is None and commander.mode is Mode.MOTION and (silence := self._unwatched()):
            what = (
                f"no sign of life of the driver's process for {silence:.1f} s {commander.place()}: it was suspended, "
                "or this computer is overloaded"
            )
            self._alarm = partial(commander.stop, Result.ABORTED, what)
        elif (
            self._alarm is None
            and commander.mode is Mode.MOTION
            and (self._unacceptable >= _UNACCEPTABLE_PACKETS or self._bad * self._period >= _BAD_S)
        ):
            reason = (
                f"the controller rates the link {Quality(quality).name} in command mode, "
                f"{self._bad * self._period:.3f} s below OK, {self._misses - self._misses_before} answers missed "
                f"{commander.place()}"
            )
            if self.pace is not None and self.pace.hasty:
                # Packets ahead of their time get no answer, and that is what the controller rates.
                reason = self._too_fast()
            self._alarm = partial(commander.stop, Result.NETWORK, reason)
        moves = commander.mode is Mode.MOTION or (self._job is Job.MOTION and not self._begun)
        if self._alarm is not None and not (sent and moves):
            self._alarm()
            self._alarm = None

    def _unwatched(self) -> float:
        """How long the driver's process has given no sign of life [s]; 0 below the limit, and in lock step."""
        beat = int(self._words[Word.BEAT_NS])
        silence = 1e-9 * (self.remote.received_ns - beat)
        return silence if beat and silence > _NOBODY_S and not self._settings.lock_step else 0.0

    def _too_fast(self) -> str:
        where = self._commander.place()
        return f"the controller's packets run ahead of time {where}: {self.pace}; see its friOpen"

    def _may_stop(self, setpoint: NDArray[np.float32], elapsed: int) -> bool:
        """Whether commands shall stop a set point still moving after a loss of command mode.

        They shall if it follows the value sent last. No command can continue the braking of a controller
        after missing answers within the limits; it is left to brake, unless it goes on without answers.
        """
        self._let_brake += elapsed
        return self._commander.follows(setpoint) or self._let_brake > _FEWEST_CYCLES

    def _doubtful(self) -> bool:
        """Whether this is the first, unrequested packet to end command mode.

        One packet alone may be damaged: commands go on, and the next packet decides.
        """
        in_command = self._commander.mode not in (Mode.MIRROR, Mode.SILENT)
        return in_command and not self._doubted and self._job is not Job.LEAVE

    def _set_period(self, sample_time_s: float) -> None:
        """Take the controller's sample time: float32 on the wire, in truth whole milliseconds."""
        if self._sample_time:
            self._lose(f"the controller changed its sample time to {sample_time_s:.4g} s")
        self._sample_time = sample_time_s
        self._period = round(sample_time_s * 1e6) * 1e-6
        self._silence_s = max(self._settings.link_timeout_s, _FEWEST_CYCLES * self._period)
        self._silence_cycles = round(self._silence_s / self._period)
        self._setpoints.set_period(self._period)
        self._rows.period_s = self._period
        self._commander.set_period(self._period)
        if self._watch is not None:
            self._watch.set_period(self._period)
        self._reset_pace()

    def _reset_pace(self) -> None:
        if self.pace is not None and self._period > 0.0:
            self.pace.reset(self._period, self._silence_cycles)

    def _leave(self) -> None:
        """End command mode, with the reason, if the controller no longer follows."""
        if self._commander.mode is Mode.MIRROR:
            return
        remote = self.remote
        state, quality = State(remote.state).name, Quality(remote.quality).name
        missed = self._misses - self._misses_before
        what = "controller left command mode"
        if remote.power != ALL_DRIVES:
            what = "drives are off"
        elif remote.error:
            what = "drives report an error"
        elif remote.state == State.CMD:
            what = "controller left position control"
        timing = remote.quality <= Quality.BAD or remote.sequence - self._missed_at < _FEWEST_CYCLES
        self._lose(
            f"{what}: state {state}, quality {quality}, control {ControlMode(remote.control).name}, "
            f"power 0x{remote.power:02x}, error 0x{remote.error:02x}, {missed} answers missed meanwhile",
            Result.NETWORK if timing and what.startswith("controller left command") else Result.ROBOT,
        )

    def _lose(self, reason: str, result: Result = Result.NETWORK) -> None:
        if self._commander.mode in (Mode.MIRROR, Mode.SILENT):
            return
        reason += self._meanwhile()
        self._commander.lose(result, reason)
        # The KRL program must not start command mode again without a request.
        self._handshake.request_stop(self.remote.command, self.remote.msr)
        if self._job is Job.START:
            self._finish(result, reason)

    def _meanwhile(self) -> str:
        """Irregular packets in command mode, for a reason."""
        now, before = self.remote.counters(), self._counted_before
        seen = [f"{now[name] - before[name]} {word}" for name, word in _REPORTED if now[name] > before[name]]
        if now["malformed"] > before["malformed"]:
            by = self.remote.malformed_by
            seen.append(f"most for its {max(by, key=lambda fault: by[fault]).value}")
        return f" (packets in command mode: {', '.join(seen)})" if seen else ""

    def _no_packet(self) -> None:
        now = time.monotonic()
        if self._ring is not None:
            self._ring.beat(round(now * 1e9))
        self._take_request()
        self._rows.publish_counters()
        self._words[Word.MODE] = int(self._commander.mode)
        if self._commander.mode is Mode.SILENT and self._job in (Job.MOTION, Job.HALT):
            self._finish(
                *(self._commander.ended if self._begun else (Result.ABORTED, "the link was dropped"))
            )
        silence = now - self._heard_s
        if self._settings.lock_step or self._sample_time == 0.0 or silence <= self._silence_s:
            return
        reason = f"no packet for {silence:.3f} s"
        self._lose(reason)
        reason += self._meanwhile()
        self._words[Word.MODE] = int(self._commander.mode)
        if self._job is Job.CYCLES or (self._job is Job.MOTION and not self._begun):
            self._finish(Result.NETWORK, reason)
        elif self._job in (Job.MOTION, Job.HALT):
            self._advance_job(0)

    # -- requests --------------------------------------------------------------------------------------------

    def _take_request(self) -> None:
        words = self._words
        if words[Word.DROP] and self._commander.mode is not Mode.SILENT:
            self._commander.fall_silent(
                Result.ABORTED, f"the link was dropped on request {self._commander.place()}"
            )
        request = int(words[Word.REQUEST])
        if request != self._request:
            self._request, self._job = request, Job(int(words[Word.JOB]))
            self._a, self._b, self._limit = (int(words[place]) for place in (Word.A, Word.B, Word.LIMIT))
            self._job_cycles = self._run_length = 0
            self._begun = False
            if self._job is Job.MOTION:
                words[Word.ROW] = -1

    def _advance_job(self, elapsed: int) -> None:
        """Finish the job if its aim is reached or its limit exceeded."""
        job, remote = self._job, self.remote
        if job is Job.NONE:
            return
        commander, handshake = self._commander, self._handshake
        self._job_cycles += elapsed
        done = False
        if job is Job.CYCLES:
            done = self._means.add(first=self._run_length == 0) >= self._a
            self._run_length += 1
        elif job is Job.QUALITY:
            self._run_length = self._run_length + 1 if remote.quality >= self._b else 0
            done = self._run_length >= self._a
        elif job is Job.START:
            # After a fallback, seen or not, the program needs its stop acknowledged before a start.
            self._begun = self._begun and not handshake.fallen(remote.msr)
            self._begun = self._begun or handshake.stopped(remote.msr) or remote.state == State.CMD
            if self._begun:
                handshake.request_start(remote.command, remote.msr, ControlMode.POSITION)
            else:
                handshake.request_stop(remote.command, remote.msr)
            done = commander.mode is Mode.HOLD and handshake.started(remote.msr)
            if done:
                commander.allow()
        elif job is Job.LEAVE:
            handshake.request_stop(remote.command, remote.msr)
            done = remote.state != State.CMD and handshake.stopped(remote.msr)
        elif job is Job.HALT:
            done = not commander.moving
        elif job is Job.LOAD:
            assert isinstance(handshake, IdentificationHandshake)
            handshake.request_load(remote.command, remote.msr, self._control.plan[0])
            done = handshake.load_taken(remote.command, remote.msr)
        elif self._begun and commander.ended[0] is not Result.NONE:
            self._finish(*commander.ended)
            return
        elif not self._begun and commander.mode is not Mode.HOLD:
            self._finish(Result.REFUSED, f"not in command mode. {self._control.text(Text.LEFT)}".strip())
            return
        if done:
            self._finish(Result.DONE, "")
        elif 0 < self._limit < self._job_cycles:
            if job is Job.START:
                handshake.request_stop(remote.command, remote.msr)
            self._finish(Result.TIMEOUT, "")

    def _finish(self, result: Result, reason: str) -> None:
        if self._job is Job.CYCLES and self._run_length > 0:
            self._means.write(self._control.measured)
        self._control.write_text(Text.REASON, reason)
        self._words[Word.RESULT] = int(result)
        self._words[Word.DONE] = self._request
        self._job = Job.NONE
