"""The PC's end of the link: receive measurements, answer each one once.

The PC is the server: it binds its port, the controller sends first, and every packet is answered to its
sender. Datagrams are checked (length, id, size field, enumerations, finite joint values) and counted; only
packets of the controller are answered. Outside commanding the answer is the mirror of the controller's
setpoint,

    jnt_pos = cmd_jnt_pos + cmd_jnt_pos_fri_offset,

with the flags of the control mode and no additional torque. Flags change in monitor mode only.

The path of a packet has no lasting allocation, no logging, and one system call each to receive and to answer.
Rare events (another sender, a restart) are kept in ``events`` for the caller to report.
"""

from __future__ import annotations

import ipaddress
import select
import socket
import struct
from collections import deque
from enum import Enum
from math import hypot, isfinite
from time import monotonic, monotonic_ns
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from fri.errors import ConfigurationError, NetworkError
from fri.in_process import Network, Port
from fri.packets import (
    CMD_OFFSETS,
    JOINT_NAMES,
    JOINTS,
    MSR_SIZE,
    Fault,
    MsrBuffer,
    leading,
    new_cmd,
    plausible,
)
from fri.sequence import Arrival, SequenceTracker
from fri.states import FLAGS, Control, State

#: UDP port of FRI clients by default.
DEFAULT_PORT = 49938

_CMD = int(State.CMD)
_JNT_POS = slice(CMD_OFFSETS["jnt_pos"], CMD_OFFSETS["jnt_pos"] + 4 * JOINTS)
# What does not change between plain successors.
_STEADY = (
    "packet_size", "datagram_id", "state", "quality", "msr_sample_time", "cmd_sample_time", "safety_limits",
    "miss_counter", "power", "control", "error",
)  # fmt: skip
# Silence of the known port [s] before another port of the same host is taken for the restarted controller.
_PORT_GRACE_S = 0.1
# Number of foreign hosts named in events; further ones are counted only.
_NAMED_FOREIGN = 16
# Packets without an irregularity before the next one is told again.
_QUIET_PACKETS = 1000
_LONGEST_DRAIN_S = 0.05
# Time for clearing away worthless datagrams, even with a timeout of zero.
_SHORTEST_FLOOD_S = 0.005


# A restart takes so many cycles at least.
_RESTART_CYCLES = 2


class LinkEventKind(Enum):
    """Kinds of rare events on the link."""

    LOCKED = "locked"
    FOREIGN = "foreign"
    PORT_CHANGED = "port changed"
    RESTARTED = "restarted"
    AHEAD = "ahead of time"


class LinkEvent(NamedTuple):
    """A rare event on the link: number of the newest packet then, kind, and a sentence."""

    sequence: int
    kind: LinkEventKind
    text: str


def _ip(value: str, subject: str) -> str:
    try:
        return str(ipaddress.IPv4Address(value))
    except ValueError:
        raise ConfigurationError(
            f"{subject} {value!r} is not an IPv4 address; give four numbers such as 192.168.0.100"
        ) from None


class RemoteEnd:
    """PC end of an FRI link; as a context manager it closes the socket.

    Parameters
    ----------
    address : str
        IPv4 address of the network interface to bind.
    port : int
        UDP port to bind, 0 for any free one.
    controller : str or None
        IPv4 address of the controller. With None the sender of the first valid packet is taken.
    first_sequence : int
        Counter of the first answer.
    network : Network or None
        A network inside this process instead of UDP; ``receive`` never waits there.

    Attributes
    ----------
    msr : np.ndarray
        Last measurement, shape (), dtype `MSR`. The next ``receive`` overwrites it: copy values to keep.
    command : np.ndarray
        The command, shape (), dtype `CMD`; after ``answer`` it is exactly the datagram sent.
    krl_real, krl_int : np.ndarray
        (16,) views into `command`: ``$FRI_FRM_REA[n]`` is ``krl_real[n - 1]``. They stay until changed. A
        restart of the controller clears them, and with them the requests to its last run.
    sequence : int
        Unwrapped number of the last measurement; state, quality, power, control, error (int), timestamp_s and
        sample_time_s are its fields, received_ns the monotonic time of its arrival.
    host_clock : bool
        Whether this computer's clock tells how long a controller was away; after a restart `sequence` has left out
        the cycles of that time. One cycle is left out at least, and no more where this is False (in lock step).
    commanding : bool
        Whether its answer moves the arm: state CMD and drives on.
    events : deque of LinkEvent
        The last 64 rare events.
    malformed_by : dict of Fault to int
        Malformed datagrams by reason.
    received, answered, lost, repeated, reordered, suspect, malformed, foreign, restarts, port_changes,
    unreflected, send_errors, ahead : int
        Counters. `lost` includes late packets (`reordered`); `unreflected` counts answers not yet seen by the
        controller in its next packet; `ahead` counts cycles that took no time, see ``tell_ahead``.

    Raises
    ------
    ConfigurationError
        An address or the port is invalid.
    NetworkError
        The address cannot be bound.
    """

    def __init__(
        self,
        address: str,
        port: int = DEFAULT_PORT,
        controller: str | None = None,
        first_sequence: int = 1,
        network: Network | None = None,
    ) -> None:
        host = _ip(address, "PC address")
        if not 0 <= port <= 65535:
            raise ConfigurationError(f"port {port} is outside 0..65535; FRI uses {DEFAULT_PORT} by default")
        self._controller_ip = None if controller is None else _ip(controller, "controller address")
        self._socket: socket.socket | Port
        try:
            self._socket = _bound(host, port) if network is None else network.bind(host, port)
        except OSError as error:
            raise NetworkError(
                f"cannot bind UDP {host}:{port}: {error.strerror}; check that the address is this PC's "
                "and that no other FRI client is running"
            ) from error
        self.address: tuple[str, int] = self._socket.getsockname()
        self.controller: tuple[str, int] | None = None
        self._receive_timeout = -1.0

        self._msr = MsrBuffer()
        self.msr = self._msr.record
        self._torque_sign: np.ndarray | None = None
        self.command = new_cmd()
        self.krl_real: np.ndarray = self.command["krl_real"]
        self.krl_int: np.ndarray = self.command["krl_int"]
        self._out = self.command.reshape(1).view(np.uint8).data
        self._jnt_pos: np.ndarray = self.command["jnt_pos"]
        self._add_jnt_trq: np.ndarray = self.command["add_jnt_trq"]
        self._cart_pos: np.ndarray = self.command["cart_pos"]
        self._pack_sequence = struct.Struct("<HH").pack_into
        self.set_impedance(np.full(JOINTS, 1000.0), np.full(JOINTS, 0.7))
        self.command["cart_stiffness"] = (1000.0, 1000.0, 1000.0, 100.0, 100.0, 100.0)
        self.command["cart_damping"] = 0.7
        self._flags_control = -1
        self._torque_set = False
        self._unanswered = False
        self._answered_last = False
        self._answered_seq = 0

        self.send_seq = (first_sequence - 1) & 0xFFFF
        self.sequence = -1
        self.state = int(State.OFF)
        self.quality = 0
        self.power = 0
        self.control = int(Control.OTHER)
        self.error = 0
        self.timestamp_s = 0.0
        self.sample_time_s = 0.0
        self.received_ns = 0
        self.commanding = False

        self._tracker = SequenceTracker()
        self._heard_s = 0.0
        self._named_foreign: set[str] = set()
        self.events: deque[LinkEvent] = deque(maxlen=64)
        self.received = 0
        self.answered = 0
        self.malformed = 0
        self.malformed_by: dict[Fault, int] = dict.fromkeys(Fault, 0)
        self.foreign = 0
        self.host_clock = True
        self.port_changes = 0
        self.unreflected = 0
        self.send_errors = 0
        self.ahead = 0
        self._ahead_at = -_QUIET_PACKETS - 1

    @property
    def lost(self) -> int:
        """Missing and late packets of the controller."""
        return self._tracker.lost

    @property
    def repeated(self) -> int:
        """Packets received again."""
        return self._tracker.repeated

    @property
    def reordered(self) -> int:
        """Packets received after a newer one."""
        return self._tracker.reordered

    @property
    def suspect(self) -> int:
        """Packets held back for an implausible counter."""
        return self._tracker.suspect

    @property
    def restarts(self) -> int:
        """Restarts of the controller's counter."""
        return self._tracker.restarts

    def counters(self) -> dict[str, int]:
        """All counters by name."""
        return {
            "received": self.received,
            "answered": self.answered,
            "lost": self.lost,
            "repeated": self.repeated,
            "reordered": self.reordered,
            "suspect": self.suspect,
            "malformed": self.malformed,
            "foreign": self.foreign,
            "restarts": self.restarts,
            "port_changes": self.port_changes,
            "unreflected": self.unreflected,
            "send_errors": self.send_errors,
            "ahead": self.ahead,
        }

    @property
    def descriptor(self) -> int:
        """File descriptor of the socket, for waiting outside ``receive``."""
        return self._socket.fileno()

    @property
    def buffer(self) -> bytearray:
        """Receive buffer of the datagrams."""
        return self._msr.buffer

    @property
    def foreseen(self) -> int | None:
        """Counter of the next packet, or None if its answer cannot be prepared.

        A prepared answer fits a next packet in command mode and position control with the drives on.
        """
        if self._torque_set or self._flags_control != Control.POSITION:
            return None
        return self._tracker.expected

    def foresee(self, jnt_pos: np.ndarray, out: memoryview, ahead: int = 0) -> None:
        """Prepare the datagram of ``answer(jnt_pos)`` for the packet `ahead` packets after the next one.

        jnt_pos : (7,) float32, finite [rad]; out : the 376 bytes of the answer; ahead : number of answered packets
        before it. RuntimeError if ``foreseen`` is None.
        """
        expected = self.foreseen
        if expected is None:
            raise RuntimeError("no answer can be prepared: the next packet is not known")
        out[:] = self._out
        out[_JNT_POS] = jnt_pos.data.cast("B")
        self._pack_sequence(out, 0, (self.send_seq + 1 + ahead) & 0xFFFF, (expected + ahead) & 0xFFFF)

    def prepare(self, jnt_pos: np.ndarray) -> np.ndarray:
        """The datagrams of ``answer`` to the next packets with the set points (n, 7), as (n,) of `CMD`.

        RuntimeError if ``foreseen`` is None.
        """
        expected = self.foreseen
        if expected is None:
            raise RuntimeError("no answer can be prepared: the next packet is not known")
        count = np.arange(len(jnt_pos))
        commands = np.repeat(self.command[np.newaxis], len(count))
        commands["send_seq"] = (self.send_seq + 1 + count) & 0xFFFF
        commands["refl_seq"] = (expected + count) & 0xFFFF
        commands["jnt_pos"] = jnt_pos
        return commands

    def recognise(self, packets: np.ndarray, commands: np.ndarray) -> int:
        """How many leading `packets`, (n,) of `MSR`, are plain successors of the last packet.

        Their counters follow, they reflect the last answer and then `commands` in turn, and state, control, drives and
        times are those of the last packet. No other packet is judged here, ``receive`` does it.
        """
        msr, expected = self._msr, self.foreseen
        if expected is None or not self._answered_last:
            return 0
        count = np.arange(len(packets))
        good = packets["send_seq"] == (expected + count) & 0xFFFF
        good &= packets["refl_seq"] == np.append(
            np.uint16(self.send_seq), commands["send_seq"][: len(packets) - 1]
        )
        for name in _STEADY:
            good &= packets[name] == msr.record[name]
        return min(leading(good), plausible(packets))

    def take(self, packets: np.ndarray, commands: np.ndarray) -> None:
        """Take in recognised `packets`, (n,) of `MSR`, and their answers, (n,) of `CMD`, sent already."""
        msr, count = self._msr, len(packets)
        msr.buffer[:MSR_SIZE] = packets[-1].tobytes()
        fault = msr.fault(MSR_SIZE)
        assert fault is None
        self._turn_torques(self.msr)
        self.received_ns = monotonic_ns()
        self._heard_s = self.received_ns * 1e-9
        self._tracker.follow(count, msr.send_seq, msr.timestamp)
        self.sequence = self._tracker.sequence
        self.timestamp_s = msr.timestamp
        self.received += count
        self.answered += count
        self._out[:] = commands[-1].tobytes()
        self.send_seq = int(commands[-1]["send_seq"])
        self._answered_seq = msr.send_seq

    def turned(self, packets: np.ndarray) -> np.ndarray:
        """The `packets`, (n,) of `MSR`, with their torques in the sign of ``set_torque_sign``."""
        if self._torque_sign is None:
            return packets
        packets = packets.copy()
        self._turn_torques(packets)
        return packets

    def _turn_torques(self, msr: np.ndarray) -> None:
        if self._torque_sign is not None:
            msr["msr_jnt_trq"] *= self._torque_sign
            msr["est_ext_jnt_trq"] *= self._torque_sign

    def receive(
        self, timeout_s: float, arrived: tuple[int, tuple[str, int], int] | None = None
    ) -> np.ndarray | None:
        """Wait for the next new packet of the controller.

        Repeated, late, malformed and foreign datagrams are counted and passed over within the same timeout.

        timeout_s : longest wait [s]; 0 does not wait. The kernel rounds it up to its tick, up to 10 ms.
        arrived : length, source and time [ns] of a datagram already in ``buffer``, or None
        Returns ``self.msr``, or None after `timeout_s`.
        """
        self._unanswered = False
        deadline = monotonic() + max(timeout_s, _SHORTEST_FLOOD_S)
        flags = self._set_timeout(timeout_s)
        buffer = self._msr.buffer
        receive_into = self._socket.recvfrom_into
        if arrived is not None and self._accept(*arrived):
            return self.msr
        while True:
            try:
                length, source = receive_into(buffer, 0, flags)
            except BlockingIOError:
                return None
            if self._accept(length, source):
                return self.msr
            # A flood of worthless datagrams must not hold the caller beyond its timeout.
            remaining = deadline - monotonic()
            if remaining <= 0.0:
                return None
            flags = self._set_timeout(remaining if timeout_s > 0.0 else 0.0)

    def drain(self) -> int:
        """Drop all waiting datagrams, for they are stale; returns their number."""
        dropped, deadline = 0, monotonic() + _LONGEST_DRAIN_S
        try:
            while monotonic() < deadline:
                self._socket.recv_into(self._msr.buffer, 0, socket.MSG_DONTWAIT)
                dropped += 1
        except OSError:
            pass
        return dropped

    def tell_ahead(self, cycles: int, text: str) -> None:
        """Count `cycles` of the sender that took no time; `text` is told when an irregularity begins."""
        if self.sequence - self._ahead_at > _QUIET_PACKETS:
            self._event(LinkEventKind.AHEAD, text)
        self._ahead_at = self.sequence
        self.ahead += cycles

    def pending(self) -> bool:
        """Whether another datagram is waiting; the present packet is stale then."""
        if isinstance(self._socket, Port):
            return bool(self._socket.waiting)
        return bool(select.select((self._socket,), (), (), 0.0)[0])

    def answer(
        self,
        jnt_pos: ArrayLike | None = None,
        add_jnt_trq: ArrayLike | None = None,
        *,
        insist: bool = False,
        sent: bool = False,
    ) -> bool:
        """Answer the packet of the last ``receive``, once.

        jnt_pos : (7,) setpoint [rad], used only while `commanding`. Otherwise, and with None, the mirror is sent.
        add_jnt_trq : (7,) additional torque [Nm], likewise; None is zero
        insist : send the setpoint although, by the packet, the arm does not follow: the packet may be damaged, and
        a controller in monitor mode ignores the setpoint
        sent : the datagram of ``foresee`` has been sent already: only count it

        Returns True if `jnt_pos` was sent, False if the mirror was, or if the network refused the datagram. Raises
        RuntimeError without a packet to answer or for a second answer, ValueError for a value not finite as
        float32; nothing is sent then.
        """
        if not self._unanswered:
            raise RuntimeError(
                "no packet to answer: answer() needs a receive() that returned a packet, once each"
            )
        msr = self._msr
        commanding = self.commanding or insist
        used = commanding and jnt_pos is not None
        if used:
            self._jnt_pos[:] = jnt_pos
            _check_finite(self._jnt_pos, "setpoint", "rad")
        else:
            np.add(msr.cmd_jnt_pos, msr.cmd_jnt_pos_fri_offset, out=self._jnt_pos)
        if commanding and add_jnt_trq is not None:
            self._add_jnt_trq[:] = add_jnt_trq
            _check_finite(self._add_jnt_trq, "additional torque", "Nm")
            self._torque_set = True
        elif self._torque_set:
            self._add_jnt_trq[:] = 0.0
            self._torque_set = False
        if (
            self._flags_control != msr.control
            and (msr.state != _CMD or self._flags_control < 0)
            and not insist
        ):
            self._flags_control = msr.control
            self.command["cmd_flags"] = int(FLAGS[Control(msr.control)])
        if msr.control == Control.CART_IMP:
            self._cart_pos[:] = msr.cmd_cart_pos
        self._unanswered = False
        self.send_seq = (self.send_seq + 1) & 0xFFFF
        self._answered_seq = msr.send_seq
        self._pack_sequence(self._out, 0, self.send_seq, msr.send_seq)
        assert self.controller is not None
        try:
            if not sent:
                self._socket.sendto(self._out, self.controller)
        except OSError:
            self.send_errors += 1
            return False
        self.answered += 1
        self._answered_last = True
        return used

    def remind(self) -> None:
        """Send the last answer once more: no packet has come since. In lock step only.

        After a lost packet or a lost answer the emulator waits, and this makes it send its packet again. A real
        controller never waits, and must not get this.
        """
        if self.controller is None:
            return
        self._pack_sequence(self._out, 0, self.send_seq, self._answered_seq)
        try:
            self._socket.sendto(self._out, self.controller)
        except OSError:
            self.send_errors += 1

    def set_krl_bool(self, index: int, value: bool) -> None:
        """Set bit `index` (0..15), ``$FRI_FRM_BOOL[index + 1]``, in the answers from now on."""
        if not 0 <= index < 16:
            raise ValueError(f"KRL boolean index {index} is outside 0..15")
        bits = int(self.command["krl_bool"])
        self.command["krl_bool"] = bits | 1 << index if value else bits & ~(1 << index)

    def set_impedance(self, stiffness: ArrayLike, damping: ArrayLike) -> None:
        """Set joint stiffness (7,) [Nm/rad] and normalised damping (7,), used in joint impedance control."""
        self.command["jnt_stiffness"] = stiffness
        self.command["jnt_damping"] = damping

    def close(self) -> None:
        """Close the socket; the controller notices by the missing answers."""
        self._socket.close()

    def __enter__(self) -> RemoteEnd:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _set_timeout(self, timeout_s: float) -> int:
        """Arm the receive timeout; returns the flags for the receive call."""
        if timeout_s <= 0.0 or isinstance(self._socket, Port):
            return socket.MSG_DONTWAIT
        if timeout_s != self._receive_timeout:
            # Zero would mean for ever, so at least a microsecond.
            seconds, micros = divmod(max(1, round(timeout_s * 1e6)), 1_000_000)
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, struct.pack("ll", seconds, micros))
            self._receive_timeout = timeout_s
        return 0

    def set_torque_sign(self, sign: ArrayLike) -> None:
        """Sign of the joint torque sensors, (7,) of +1 and -1; measured and external torques are multiplied by it."""
        values = np.array(sign, dtype=np.float32)
        if values.shape != (JOINTS,) or not (np.abs(values) == 1.0).all():
            raise ConfigurationError(f"torque sign {values} must be +1 or -1 for each of the {JOINTS} joints")
        self._torque_sign = None if (values > 0.0).all() else values

    def _accept(self, length: int, source: tuple[str, int], received_ns: int | None = None) -> bool:
        """Judge the datagram in the buffer; True if it is a new packet of the controller."""
        new_source = False
        if source != self.controller:
            if not self._may_be_controller(source):
                self._count_foreign(source)
                return False
            new_source = True
        msr = self._msr
        fault = msr.fault(length)
        if fault is not None:
            self.malformed += 1
            self.malformed_by[fault] += 1
            return False
        if new_source:
            # A new session begins in monitor mode; command mode never moves to another port.
            if self.controller is not None and msr.state == _CMD:
                self._count_foreign(source)
                return False
            new_source = self._lock(source)
        now_ns = monotonic_ns() if received_ns is None else received_ns
        self._heard_s = now_ns * 1e-9
        tracker = self._tracker
        losses = tracker.lost
        arrival = tracker.feed(msr.send_seq, msr.timestamp, msr.sample_time, new_source)
        if arrival is not Arrival.NEW:
            if arrival is not Arrival.RESTARTED:
                return False
            self._restarted()
            # The time without a controller is a gap in the numbers, too.
            away = (now_ns - self.received_ns) * 1e-9 / msr.sample_time if self.host_clock else 0.0
            tracker.skip(max(round(away), _RESTART_CYCLES) - 1)
        if self._answered_last and tracker.lost == losses and msr.refl_seq != self.send_seq:
            self.unreflected += 1
        self._answered_last = False
        self._turn_torques(self.msr)
        self.received += 1
        self.received_ns = now_ns
        self.sequence = tracker.sequence
        self.state = msr.state
        self.quality = msr.quality
        self.power = msr.power
        self.control = msr.control
        self.error = msr.error
        self.timestamp_s = msr.timestamp
        self.sample_time_s = msr.sample_time
        self.commanding = msr.state == _CMD and msr.power != 0
        self._unanswered = True
        return True

    def _may_be_controller(self, source: tuple[str, int]) -> bool:
        if self.controller is None:
            return self._controller_ip is None or source[0] == self._controller_ip
        return source[0] == self.controller[0] and monotonic() - self._heard_s >= _PORT_GRACE_S

    def _lock(self, source: tuple[str, int]) -> bool:
        """Take `source` for the controller; True if another port was known before."""
        known = self.controller
        self.controller = source
        if known is None:
            self._event(LinkEventKind.LOCKED, f"controller is {source[0]}:{source[1]}")
            return False
        self.port_changes += 1
        self._event(
            LinkEventKind.PORT_CHANGED,
            f"controller {source[0]} sends from port {source[1]} instead of {known[1]}; it was opened again",
        )
        return True

    def _restarted(self) -> None:
        self._event(LinkEventKind.RESTARTED, "controller counts anew; it was started again")
        self.krl_real[:] = 0.0
        self.krl_int[:] = 0
        self.command["krl_bool"] = 0
        self._flags_control = -1
        self._answered_last = False

    def _count_foreign(self, source: tuple[str, int]) -> None:
        self.foreign += 1
        host = source[0]
        if host in self._named_foreign or len(self._named_foreign) >= _NAMED_FOREIGN:
            return
        self._named_foreign.add(host)
        expected = f"{self.controller[0]}:{self.controller[1]}" if self.controller else self._controller_ip
        self._event(
            LinkEventKind.FOREIGN,
            f"datagrams from {host}:{source[1]} are not answered: the controller is {expected}",
        )

    def _event(self, kind: LinkEventKind, text: str) -> None:
        self.events.append(LinkEvent(self.sequence, kind, text))


def _bound(host: str, port: int) -> socket.socket:
    end = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        end.bind((host, port))
    except OSError:
        end.close()
        raise
    return end


def _check_finite(values: np.ndarray, subject: str, unit: str) -> None:
    if isfinite(hypot(*values.tolist())):
        return
    for name, value in zip(JOINT_NAMES, values.tolist(), strict=True):
        if not isfinite(value):
            raise ValueError(f"{name} {subject} is {value} {unit}, must be finite; nothing was sent")
