"""The answer that is ready before its packet comes, and the compiled wait that sends it.

Between a packet and its answer the loop's own code takes some 50 us, and several times that when a long cycle
has let the processor's caches go cold. So the loop decides in the quiet part of a cycle what the next packet
gets if it is a regular one: the next of the controller's packets, in command mode with drives on and nothing
new in it but measurements. This module waits for that packet in compiled code, looks whether it is regular,
and sends the answer, which the guard has passed for exactly that cycle. Whatever is not regular, be it a
packet or a request of the driver, is left to the loop as if this module were not there.

Afterwards the loop takes the packet through its ordinary code, which comes to the same answer from the same
numbers; it compares the bytes and does not send again.

Importing this module compiles it, or takes the compiled code from the cache, and loads the compiler's 300 MB;
only a loop with real-time rights does.
"""

from __future__ import annotations

import select
import socket
import struct
from math import pi
from typing import Any

import numpy as np
from numba import njit, types
from numpy.typing import NDArray

from fri.packets import CMD_SIZE, JOINTS, MSR_ID, MSR_OFFSETS, MSR_SIZE
from fri.states import ALL_DRIVES, Control, Quality, State
from lwr_driver.control import Word

__all__ = ["Turnaround"]

_NOTHING, _ARRIVED, _SENT, _ASKED = 0, 1, 2, 3
# Asleep it looks at the requests so often: a motion that is asked for shortly before a packet is begun by it.
_NAP_NS = 250_000
_CLOCK_MONOTONIC, _DONTWAIT, _POLLIN = 1, int(socket.MSG_DONTWAIT), int(select.POLLIN)
_SOCKADDR = struct.Struct("!2s H 4s 8x")

# Places of 16-bit words and of float32 in a measurement.
_AT_SEQ, _AT_SIZE, _AT_ID, _AT_STATE, _AT_QUALITY, _AT_POWER, _AT_CONTROL, _AT_ERROR = (
    MSR_OFFSETS[name] // 2
    for name in ("send_seq", "packet_size", "datagram_id", "state", "quality", "power", "control", "error")
)
_AT_TIME, _AT_MEASURING, _AT_SAMPLE, _AT_Q, _AT_KRL, _AT_OFFSET, _AT_TORQUE = (
    MSR_OFFSETS[name] // 4
    for name in (
        "timestamp",
        "msr_sample_time",
        "cmd_sample_time",
        "msr_jnt_pos",
        "cmd_jnt_pos",
        "cmd_jnt_pos_fri_offset",
        "msr_jnt_trq",
    )
)
_COMMANDING, _BEST, _DRIVES, _POSITION = (
    int(State.CMD),
    int(Quality.PERFECT),
    ALL_DRIVES,
    int(Control.POSITION),
)
# Each value within these keeps the norms within those that `fri.packets` allows.
_TURN, _TORQUE = 2.0 * pi, 1000.0
# An argument of the compiled code and no constant in it, since the cache would not notice that they moved.
_WATCHED = np.array([Word.REQUEST, Word.STOP, Word.DROP, Word.QUIT], np.int64)

_recvfrom: Any = types.ExternalFunction(
    "recvfrom", types.intp(types.int32, types.uintp, types.uintp, types.int32, types.uintp, types.uintp)
)
_sendto: Any = types.ExternalFunction(
    "sendto", types.intp(types.int32, types.uintp, types.uintp, types.int32, types.uintp, types.uint32)
)
_ppoll: Any = types.ExternalFunction("ppoll", types.int32(types.uintp, types.uintp, types.uintp, types.uintp))
_clock_gettime: Any = types.ExternalFunction("clock_gettime", types.int32(types.int32, types.uintp))


@njit("int64(int64[::1])", cache=True)
def _now(time: Any) -> Any:
    _clock_gettime(_CLOCK_MONOTONIC, time.ctypes.data)
    return time[0] * 1_000_000_000 + time[1]


@njit("boolean(int64[::1], int64[::1], int64[::1])", cache=True)
def _asked(words: Any, seen: Any, watched: Any) -> Any:
    new = False
    for place in watched:
        new = new or words[place] != seen[place]
    return new


@njit("boolean(uint16[::1], float32[::1], int64, float32, float32[::1], float32)", cache=True)
def _regular(shorts: Any, floats: Any, sequence: Any, sample_time: Any, sent: Any, room: Any) -> Any:
    """Whether the measurement is the one that the answer is for; comparisons are false for what is no
    number.
    """
    good = (
        shorts[_AT_SIZE] == MSR_SIZE
        and shorts[_AT_ID] == MSR_ID
        and shorts[_AT_STATE] == _COMMANDING
        and shorts[_AT_QUALITY] <= _BEST
        and shorts[_AT_POWER] == _DRIVES
        and shorts[_AT_CONTROL] == _POSITION
        and shorts[_AT_ERROR] == 0
        and abs(floats[_AT_TIME]) < 1e9
        and 0.0009 < floats[_AT_MEASURING] < 0.1001
        and floats[_AT_SAMPLE] == sample_time
    )
    for joint in range(JOINTS):
        q, krl = floats[_AT_Q + joint], floats[_AT_KRL + joint]
        offset = floats[_AT_OFFSET + joint]
        good = (
            good
            and abs(q) < _TURN
            and abs(krl) < _TURN
            and abs(offset) < _TURN
            and abs(floats[_AT_TORQUE + joint]) < _TORQUE
            and abs(q - sent[joint]) <= room
            and abs((krl + offset) - sent[joint]) <= room
        )
    # Last, so that all of it is at hand when the packet comes: it is looked at before, too.
    return good and shorts[_AT_SEQ] == sequence


@njit(
    "int64(int64, uint8[::1], uint16[::1], float32[::1], int64[::1], uint8[::1], boolean, int64, float32,"
    "float32[::1], float32, int64[::1], int64[::1], int64[::1], int64[::1], int64[::1], int64, int64, int64)",
    cache=True,
)
def _turn(
    descriptor: Any,
    datagram: Any,
    shorts: Any,
    floats: Any,
    ends: Any,
    answer: Any,
    armed: Any,
    sequence: Any,
    sample_time: Any,
    sent: Any,
    room: Any,
    words: Any,
    seen: Any,
    watched: Any,
    found: Any,
    scratch: Any,
    awake: Any,
    asleep: Any,
    patience: Any,
) -> Any:
    """Wait, and answer a regular packet; see `Turnaround.wait`.

    ends : sockaddr_in of the sender, then of the controller. found : length, instants of arrival and of the
    answer [ns]. scratch : pollfd, time, length of an address. awake, asleep, patience : from now [ns]
    """
    time = scratch[1:3]
    start = _now(time)
    while True:
        scratch[3] = 16
        length = _recvfrom(
            descriptor,
            datagram.ctypes.data,
            datagram.size,
            _DONTWAIT,
            ends.ctypes.data,
            scratch[3:].ctypes.data,
        )
        now = _now(time)
        if length >= 0:
            break
        if _asked(words, seen, watched):
            return _ASKED
        passed = now - start
        if passed >= patience:
            return _NOTHING
        if awake <= passed < asleep:
            # Of the packet before: what is found does not matter, only that the code and the data are at hand.
            scratch[4] = _regular(shorts, floats, sequence, sample_time, sent, room)
            continue
        nap = min(_NAP_NS, patience - passed)
        if passed < awake:
            nap = min(nap, awake - passed)
        time[0], time[1] = 0, nap
        _ppoll(scratch.ctypes.data, 1, time.ctypes.data, 0)
    found[0], found[1] = length, now
    if (
        armed
        and length == MSR_SIZE
        and ends[0] == ends[2]
        and _regular(shorts, floats, sequence, sample_time, sent, room)
        and not _asked(words, seen, watched)
        and _sendto(descriptor, answer.ctypes.data, CMD_SIZE, _DONTWAIT, ends[2:].ctypes.data, 16) == CMD_SIZE
    ):
        found[2] = _now(time)
        return _SENT
    return _ARRIVED


class Turnaround:
    """Waits for a packet on the socket `descriptor`, into `buffer` [bytes], and answers a regular one.

    words : shared words of `Control`; a request that is new keeps a packet from being answered here

    arrived : whether `wait` has put a datagram into the buffer; sent : and has answered it
    length, source : of the datagram; received_ns, sent_ns : CLOCK_MONOTONIC
    """

    def __init__(self, descriptor: int, buffer: bytearray, words: NDArray[np.int64]) -> None:
        self._descriptor, self._words = descriptor, words
        self._datagram = np.frombuffer(buffer, np.uint8)
        self._shorts = np.frombuffer(buffer, np.uint16, MSR_SIZE // 2)
        self._floats = np.frombuffer(buffer, np.float32, MSR_SIZE // 4)
        self._ends, self._found = np.zeros(4, np.int64), np.zeros(3, np.int64)
        self._scratch = np.zeros(5, np.int64)
        self._scratch[0] = descriptor | _POLLIN << 32
        self._seen = words.copy()
        self._target = np.zeros(JOINTS, np.float32)
        self._armed, self._sequence, self._sample_time, self._room = False, 0, 0.0, 0.0
        self.answer = np.zeros(CMD_SIZE, np.uint8)
        self.answer_bytes = self.answer.data
        self.arrived = self.sent = False

    def disarm(self) -> NDArray[np.int64]:
        """Have nothing ready; the words (64,) as they are now, to which requests are compared."""
        self._armed = False
        self._seen[:] = self._words
        return self._seen

    def arm(
        self,
        controller: tuple[str, int],
        sequence: int,
        sample_time_s: float,
        target: NDArray[np.float32],
        room: float,
    ) -> None:
        """Have `answer` ready for the packet with the counter `sequence` from `controller`.

        sample_time_s : that the packet must name. target, room : value sent last (7,) [rad], and how far the
        measured position and the set point may be from it
        """
        host, port = controller
        family = socket.AF_INET.to_bytes(2, "little")
        address = _SOCKADDR.pack(family, port, socket.inet_aton(host))
        self._ends[2:] = np.frombuffer(address, np.int64)
        self._sequence, self._sample_time = sequence, sample_time_s
        self._target[:] = target
        # As float32, and no wider.
        self._room = float(np.nextafter(np.float32(room), np.float32(0.0)))
        self._armed = True

    def wait(self, awake_ns: int, asleep_ns: int, patience_ns: int) -> bool:
        """Wait for a datagram for `patience_ns`, from `awake_ns` until `asleep_ns` without sleeping, all from
        now on; what came is in the attributes. True if a new request ended the waiting.
        """
        status = _turn(
            self._descriptor,
            self._datagram,
            self._shorts,
            self._floats,
            self._ends,
            self.answer,
            self._armed,
            self._sequence,
            self._sample_time,
            self._target,
            self._room,
            self._words,
            self._seen,
            _WATCHED,
            self._found,
            self._scratch,
            awake_ns,
            asleep_ns,
            patience_ns,
        )
        self.sent = status == _SENT
        self.arrived = self.sent or status == _ARRIVED
        return bool(status == _ASKED)

    def take_waiting(self) -> bool:
        """Take a datagram that waits already, with nothing ready; False if there is none."""
        self.disarm()
        self.wait(0, 0, 0)
        return self.arrived

    @property
    def length(self) -> int:
        """Bytes of the datagram."""
        return int(self._found[0])

    @property
    def source(self) -> tuple[str, int]:
        """Host and port that it came from."""
        _, port, host = _SOCKADDR.unpack(self._ends[:2].tobytes())
        return socket.inet_ntoa(host), port

    @property
    def received_ns(self) -> int:
        """When it came."""
        return int(self._found[1])

    @property
    def sent_ns(self) -> int:
        """When the answer had been sent."""
        return int(self._found[2])
