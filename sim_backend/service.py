"""The emulator's main loop: the FRI socket, the pendant, and the clock (virtual time or real time)."""

from __future__ import annotations

import gc
import logging
import os
import select
import socket
import time
from collections.abc import Callable

from fri.controller_end import ControllerEnd
from fri.in_process import Network, Port
from fri.states import State
from lwr_driver.hosted_loop import Seat
from sim_backend.ahead import CabinetAhead, prepare
from sim_backend.cabinet import Cabinet
from sim_backend.configuration import EmulatorConfig
from sim_backend.faults import FaultyWire, Parcel
from sim_backend.operator import Operator
from sim_backend.pendant import PendantServer
from sim_backend.plant import CYCLE_S

log = logging.getLogger(__name__)

_RESEND_S = 0.2
# After an answer the PC may think for long; a restarted PC waits for its first packet.
_RESEND_HEARD_S = 2.0
_IDLE_S = 0.2
_TURN_S = 0.0005  # pause between the turns of an idle loop
# A damaged datagram is answered at once or not at all.
_PERHAPS_S = 0.02
_PACED_AFTER = 2000
_PENDANT_EVERY = 50
_MANY = 250  # most cycles at once: the pendant and requests of the driver wait for so long


class Service:
    """One emulator: cabinet, operator, FRI socket and pendant.

    follow : file descriptor of a pipe from the parent; its end of file ends the emulator
    once : in lock step, end when the client has left
    seat : descriptor for a `Seat` of the driver's loop in this process, in lock step; None talks UDP
    """

    def __init__(
        self,
        config: EmulatorConfig,
        remote: tuple[str, int],
        pendant_port: int = 0,
        *,
        follow: int | None = None,
        once: bool = False,
        seat: int | None = None,
    ) -> None:
        self.config = config
        self.cabinet = Cabinet(config)
        self.wire = FaultyWire(self.cabinet.wire_seed, self.cabinet.period_ms * CYCLE_S)
        self.operator = Operator(self.cabinet, self.wire)
        self._network = None if seat is None else Network()
        self._seat = None if seat is None or self._network is None else Seat(seat, self._network)
        if seat is not None:
            prepare(self.cabinet)
        self.end = ControllerEnd(remote, (config.fri.local_host, config.fri.local_port), self._network)
        self.pendant = PendantServer(pendant_port, self.operator.handle)
        self._foreign: dict[str, socket.socket | Port] = {}
        self._turns = 0
        self._follow = follow
        self._parent = os.getppid()
        self._ended = False
        self._impatient = False
        self._unanswerable = 0
        self._stepping = False
        self._last_head = b""  # counters of the answer taken last
        self._reminded = False
        self._once = once
        self._heard_s: float | None = None
        self._absent = False
        self._refused = 0
        self._poller = select.poll()
        self._fri = self.end.fileno() if self._seat is None else self._seat.descriptor
        self._poller.register(self._fri, select.POLLIN)
        self._poller.register(self.pendant.socket.fileno(), select.POLLIN)
        if follow is not None:
            self._poller.register(follow, select.POLLIN)

    @property
    def running(self) -> bool:
        """False once the emulator shall end."""
        return not (self._ended or self.operator.ended)

    def stop(self) -> None:
        """End after the present cycle; may be called by a signal handler."""
        self._ended = True

    def close(self) -> None:
        """Release the sockets."""
        if self._seat is not None:
            self._seat.close()
        self.end.close()
        self.pendant.close()
        for other in self._foreign.values():
            other.close()

    def run(self, lock_step: bool) -> None:
        """Run until `stop`, or the end by pendant or parent."""
        # Objects of the start-up stay; collecting them again would cost time within a cycle.
        gc.collect()
        gc.freeze()
        self._stepping = lock_step
        cycle: Callable[[], None] = self._lock_step if lock_step else self._real_time
        self._deadline = time.monotonic()
        while self.running:
            cycle()

    def _serve(self, timeout_s: float) -> bool:
        """Wait for something at most `timeout_s`, serve pendant and parent; True if an FRI datagram is there.

        FRI goes first: a command sent before a request to the pendant acts before it.
        """
        if self._seat is not None:
            return self._take_turns(self._seat, timeout_s)
        return self._look(timeout_s)

    def _take_turns(self, seat: Seat, timeout_s: float) -> bool:
        """As `_serve`, with the loop of the driver in this process."""
        end, deadline = self.end, 0.0
        while True:
            if end.waiting:
                return True
            if seat.turn():
                self._turns += 1
                if self._turns % _PENDANT_EVERY == 0:
                    self._look(0.0)
                if end.waiting:
                    return True
            now = time.monotonic()
            deadline = deadline or now + timeout_s
            if not self.running or now >= deadline:
                return False
            if self._look(min(_TURN_S, deadline - now)):
                return False

    def _look(self, timeout_s: float) -> bool:
        """Wait at most `timeout_s`, serve pendant and parent; True if an FRI datagram, or anything here, was there."""
        ready = self._poller.poll(timeout_s * 1000.0)
        if not ready:
            # A forked child of a dead parent may hold the pipe open.
            if self._follow is not None and os.getppid() != self._parent:
                self._ended = True
            return False
        if any(descriptor == self._fri for descriptor, _ in ready):
            if self._seat is not None and not self._seat.serve():
                self._ended = True
            return True
        for descriptor, _ in ready:
            if descriptor != self._follow:
                self.pendant.serve()
            elif not os.read(descriptor, 4096):
                self._ended = True
        return self._seat is not None

    def _lock_step(self) -> None:
        cabinet, operator = self.cabinet, self.operator
        if self._seat is not None and self._many(self._seat):
            return
        if cabinet.session.state is State.OFF or operator.silent:
            self._silent_cycle()
            return
        datagram = cabinet.packet()
        age_s = self.config.fri.answer_delay_s
        if self.wire.quiet:
            self.end.send(datagram)
            self._await(datagram, age_s)
        else:
            self._send_faulty(datagram, age_s)
            for arrived in self.wire.due(cabinet.cycle):
                cabinet.receive(*arrived)
        if self.running:
            cabinet.close()
            operator.step()

    def _many(self, seat: Seat) -> bool:
        """Many ordinary cycles of a motion at once, with the loop of the driver in this process; False without any.

        Each ends with both sides as after as many single cycles. What is not ordinary is left to a single cycle.
        """
        cabinet, operator, end = self.cabinet, self.operator, self.end
        if not cabinet.ordinary or not self._undisturbed():
            return False
        commands = seat.offer(_MANY)
        if not len(commands):
            return False
        # Nothing has happened yet, and what the pendant does now comes first.
        self._look(0.0)
        if not (self.running and self._undisturbed()):
            return False
        ahead = CabinetAhead.of(cabinet, commands, self.config.fri.answer_delay_s)
        if ahead is None:
            return False
        commands = commands[: len(ahead.packets)]
        accepted = seat.accept(ahead.packets, commands)
        if accepted == 0:
            return False
        done = ahead.take(accepted)
        seat.take(ahead.packets[:done], commands[:done])
        self._last_head = commands[done - 1 : done].tobytes()[:4]
        self._heard_s, self._refused, self._impatient = time.monotonic(), end.refused, False
        operator.step()
        return True

    def _undisturbed(self) -> bool:
        """Whether nothing else acts on the next cycles: no fault, no datagram, no action of the operator."""
        return self.wire.quiet and self.operator.idle and not (self._absent or self.end.waiting)

    def _silent_cycle(self) -> None:
        """A cycle without a packet; time stands still unless the operator is busy."""
        cabinet, operator = self.cabinet, self.operator
        if not operator.busy:
            self._serve_silently(_IDLE_S)
            return
        if cabinet.cycle % _PENDANT_EVERY == 0:
            self._serve_silently(0.0)
        if cabinet.session.state is not State.OFF:
            # Made but not sent: the PC finds the gap in the counter.
            cabinet.packet()
        cabinet.close()
        operator.step()

    def _serve_silently(self, timeout_s: float) -> None:
        """Serve while no answer is expected; any command from the PC is late."""
        while self._serve(timeout_s):
            self._take(self.config.fri.answer_delay_s)
            timeout_s = 0.0

    def _send_faulty(self, datagram: bytes, age_s: float) -> None:
        cabinet = self.cabinet
        self.wire.period_s = cabinet.session.sample_time_s
        parcels = self.wire.outgoing(datagram, cabinet.packets, cabinet.cycle)
        answerable = False
        for parcel in parcels:
            self._send_parcel(parcel)
            if parcel.awaited == "yes":
                answerable = True
                self._await(parcel.datagram, age_s)
            elif parcel.awaited == "perhaps":
                self._await(parcel.datagram, age_s, limit_s=_PERHAPS_S)
        self._unanswerable = 0 if answerable else self._unanswerable + 1
        if not answerable:
            # Nothing to wait for, but a dead link must not race through its time.
            paced = self._unanswerable > _PACED_AFTER
            if paced or cabinet.cycle % _PENDANT_EVERY == 0:
                self._serve_silently(CYCLE_S if paced else 0.0)

    def _send_parcel(self, parcel: Parcel) -> None:
        if parcel.host is None:
            self.end.send(parcel.datagram)
        else:
            self._send_foreign(parcel.host, parcel.datagram, self.end.remote)

    def _send_foreign(self, host: str, datagram: bytes, to: tuple[str, int]) -> None:
        if host not in self._foreign:
            if self._network is not None:
                self._foreign[host] = self._network.bind(host)
            else:
                self._foreign[host] = other = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
                other.bind((host, 0))
        self._foreign[host].sendto(datagram, to)

    def _take(self, age_s: float) -> bytes | None:
        """One datagram of the PC, handed on; in lock step a reminder is noted instead."""
        datagram = self.end.receive(0.0)
        if datagram is None:
            return None
        if self._stepping:
            self._reminded = datagram[:4] == self._last_head
            if self._reminded:
                return None
            self._last_head = datagram[:4]
        cabinet = self.cabinet
        self._heard_s, self._refused = time.monotonic(), self.end.refused
        if self._absent:
            self._absent = False
            cabinet.journal.warn("a client answers again")
        cabinet.arrived(datagram)
        if self.wire.quiet:
            cabinet.receive(datagram, age_s)
        else:
            for host, other in self.wire.incoming(datagram, age_s, cabinet.cycle):
                if host is not None:
                    self._send_foreign(host, other, self.end.address)
        return datagram

    def _await(self, sent: bytes, age_s: float, limit_s: float | None = None) -> None:
        """Lock step: wait until the PC has answered `sent`.

        The wait has no end in monitor mode; in command mode it ends with the configured patience or the client.
        The first packet is repeated until the PC is heard, any other now and then, for a restarted PC. After an
        answer to another packet the wait is short. After a reminder of the PC (`RemoteEnd.remind`) the packet was
        perhaps lost: it is sent again, and the wait begins anew.
        """
        wanted = sent[:2]
        commanding = self.cabinet.session.state is State.CMD
        if limit_s is None and commanding:
            limit_s = _PERHAPS_S if self._impatient else self.config.fri.patience_s
        if limit_s is None and self._serve_until_heard(sent):
            return
        deadline = None if limit_s is None else time.monotonic() + limit_s
        again = time.monotonic() + self._patience_s
        while self.running:
            timeout_s = _IDLE_S if deadline is None else min(_IDLE_S, deadline - time.monotonic())
            if timeout_s <= 0.0:
                self._impatient = commanding
                return
            if not self._serve(timeout_s):
                if self.cabinet.session.state is State.OFF or self.operator.silent:
                    return
                if self._left() and commanding:
                    self._impatient = True
                    return
                # In command mode the repetition asks whether the port of the client is still open.
                if limit_s != _PERHAPS_S and time.monotonic() >= again:
                    self.end.send(sent)
                    again = time.monotonic() + self._patience_s
                continue
            datagram = self._take(age_s)
            if datagram is None:
                if self._reminded and limit_s != _PERHAPS_S:
                    self._reminded = False
                    self.end.send(sent)
                    deadline = None if limit_s is None else time.monotonic() + limit_s
                continue
            if datagram[2:4] == wanted:
                self._impatient = False
                return
            deadline = time.monotonic() + _PERHAPS_S

    @property
    def _patience_s(self) -> float:
        return _RESEND_S if self._absent or self._heard_s is None else _RESEND_HEARD_S

    def _left(self) -> bool:
        """Lock step: whether the client has left, told once: its port is closed, or it is silent for too long."""
        if self._heard_s is None:
            return False
        closed = self.end.refused > self._refused
        silent_s = time.monotonic() - self._heard_s
        if not closed and silent_s < self.config.fri.leave_s:
            return False
        if not self._absent:
            self._absent = True
            host, port = self.end.remote
            why = "its port is closed" if closed else f"no answer for {silent_s:.0f} s"
            then = (
                "the emulator ends"
                if self._once
                else "time stands still until a client answers; Ctrl-C ends it"
            )
            self.cabinet.journal.warn(f"the client at {host}:{port} has left ({why}); {then}")
            self._ended = self._ended or self._once
        return True

    def _serve_until_heard(self, sent: bytes) -> bool:
        """Repeat a session's packet until it had its first answer; True if the wait is over for good.

        After a restart the PC believes the new count only when the packet comes again.
        """
        while self.running and not self.cabinet.session.counters()["answered"]:
            if self._serve(_RESEND_S):
                return False
            if self.cabinet.session.state is State.OFF or self.operator.silent:
                return True
            self.end.send(sent)
        return not self.running

    def _real_time(self) -> None:
        cabinet, operator = self.cabinet, self.operator
        period_s = cabinet.session.sample_time_s
        now = time.monotonic()
        self._deadline += period_s
        if self._deadline < now - period_s:
            # Too late to catch up: a controller never sends two packets at once.
            self._deadline = now + period_s
        sending = cabinet.session.state is not State.OFF
        silent = sending and operator.silent
        if sending:
            datagram = cabinet.packet()
            if not silent:
                if self.wire.quiet:
                    self.end.send(datagram)
                else:
                    for parcel in self.wire.outgoing(datagram, cabinet.packets, cabinet.cycle):
                        self._send_parcel(parcel)
        sent = time.monotonic()
        self._collect(sent)
        if sending:
            for arrived in self.wire.due(cabinet.cycle):
                cabinet.receive(*arrived)
        cabinet.close()
        operator.step()

    def _collect(self, sent: float) -> None:
        """Real time: serve everybody until the deadline."""
        descriptors = [self._fri, self.pendant.socket.fileno()]
        if self._follow is not None:
            descriptors.append(self._follow)
        while (remaining := self._deadline - time.monotonic()) > 0.0:
            ready, _, _ = select.select(descriptors, [], [], remaining)
            if self._fri in ready:
                self._take(time.monotonic() - sent)
            if len(ready) > (self._fri in ready):
                self._serve(0.0)
            if not self.running:
                return
        if self.cabinet.cycle % _PENDANT_EVERY == 0 and self._follow is not None:
            self._ended = self._ended or os.getppid() != self._parent
