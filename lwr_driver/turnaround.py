"""Answers ready before their packets come, and the compiled wait that sends them.

Between a packet and its answer the loop's own code takes some 50 us, and several times as long with cold
caches after a long cycle. So in the quiet part of a cycle the loop decides the answer to the next packet, if
that is a regular one: the next of the controller's packets, in command mode with drives on, with new
measurements and nothing else. This module waits for the packet in compiled code, checks whether it is
regular, and sends the answer, already passed by the guard for exactly this cycle. Any other packet, and any
request of the driver, is left to the loop.

Afterwards the loop processes the packet in its ordinary code and comes to the same answer from the same
numbers; it compares the bytes and does not send again.

After a pause of the computer several packets may wait. As far as their answers are known beforehand, regular
ones are answered one after the other, as if each had come alone; only then does the loop's own code process
them in turn. In the other order it would stay late for much longer.

Importing this module compiles it, or loads the compiled code from the cache, and loads the compiler's
300 MB; only a loop with real-time rights does.
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

# A power of two, since counters wrap at 65536.
_MOST = 16

_NOTHING, _ARRIVED, _ASKED = 0, 1, 2
# Longest sleep between two checks of the requests: a motion requested shortly before a packet begins with it.
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
# Values within these keep the norms within the limits of `fri.packets`.
_TURN, _TORQUE = 2.0 * pi, 1000.0
# An argument of the compiled code, not a constant: the cache would not notice a change.
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
    """Whether the prepared answer belongs to this measurement; comparisons are false for NaN."""
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
    # Last, so that calls before the packet load the code and data of all the rest.
    return good and shorts[_AT_SEQ] == sequence


@njit("boolean(int64, uint8[::1], int64[::1], int64[::1], int64[::1])", cache=True)
def _take(descriptor: Any, datagram: Any, end: Any, found: Any, scratch: Any) -> Any:
    """Take a datagram if one waits: length and instant into `found`, the sender into `end`."""
    scratch[3] = 16
    length = _recvfrom(
        descriptor, datagram.ctypes.data, datagram.size, _DONTWAIT, end.ctypes.data, scratch[3:].ctypes.data
    )
    found[0], found[1], found[2] = length, _now(scratch[1:3]), 0
    return length >= 0


@njit("boolean(int64, uint8[::1], int64[::1], int64[::1], int64[::1])", cache=True)
def _answer(descriptor: Any, answer: Any, controller: Any, found: Any, scratch: Any) -> Any:
    """Send an answer, the instant into `found`."""
    length = _sendto(descriptor, answer.ctypes.data, CMD_SIZE, _DONTWAIT, controller.ctypes.data, 16)
    if length != CMD_SIZE:
        return False
    found[2] = _now(scratch[1:3])
    return True


@njit(
    "UniTuple(int64, 2)(int64, uint8[:, ::1], uint16[:, ::1], float32[:, ::1], int64[:, ::1], int64[::1],"
    "uint8[:, ::1], float32[:, ::1], int64, int64, float32, float32[::1], float32, int64[::1], int64[::1],"
    "int64[::1], int64[:, ::1], int64[::1], int64, int64, int64, int64, int64, int64)",
    cache=True,
)
def _turn(
    descriptor: Any,
    datagrams: Any,
    shorts: Any,
    floats: Any,
    ends: Any,
    controller: Any,
    answers: Any,
    targets: Any,
    ready: Any,
    sequence: Any,
    sample_time: Any,
    sent: Any,
    room: Any,
    words: Any,
    seen: Any,
    watched: Any,
    found: Any,
    scratch: Any,
    taken: Any,
    awake: Any,
    asleep: Any,
    patience: Any,
    due: Any,
    period: Any,
) -> Any:
    """Wait, and answer regular packets; see `Turnaround.wait`. Returns the status and the number of datagrams.

    The first `taken` datagrams have their answers. After the awaited one, waiting ones are answered as long as
    they are regular and an answer is ready.

    ends : sockaddr_in of the senders; answers, targets : by counter modulo their number, `ready` of them from
    `sequence` on; sent : value sent before them; found : length, instants of arrival and of the answer [ns] of
    each datagram; scratch : pollfd, time, length of an address; awake, asleep, patience : from now [ns]; due : no
    answer to a packet before, nor to later ones before a `period` more each [ns]
    """
    time = scratch[1:3]
    start = _now(time)
    while not _take(descriptor, datagrams[taken], ends[taken], found[taken], scratch):
        if _asked(words, seen, watched):
            return _ASKED, taken
        passed = found[taken, 1] - start
        if passed >= patience:
            return _NOTHING, taken
        if awake <= passed < asleep:
            # On the packet before, to keep code and data in the caches; the result does not matter.
            scratch[4] = _regular(shorts[0], floats[0], sequence, sample_time, sent, room)
            continue
        nap = min(_NAP_NS, patience - passed)
        if passed < awake:
            nap = min(nap, awake - passed)
        time[0], time[1] = 0, nap
        _ppoll(scratch.ctypes.data, 1, time.ctypes.data, 0)
    taken += 1
    last = sent
    if taken > 1:
        last = targets[(sequence + taken - 2) % len(answers)]
    while taken <= ready:
        place = taken - 1
        counter = (sequence + place) % 65536
        slot = counter % len(answers)
        if not (
            answers[slot, 2] + 256 * answers[slot, 3] == counter
            and found[place, 0] == MSR_SIZE
            and found[place, 1] >= due + place * period
            and ends[place, 0] == controller[0]
            and _regular(shorts[place], floats[place], counter, sample_time, last, room)
            and not _asked(words, seen, watched)
            and _answer(descriptor, answers[slot], controller, found[place], scratch)
        ):
            break
        last = targets[slot]
        if taken == ready or not _take(descriptor, datagrams[taken], ends[taken], found[taken], scratch):
            break
        taken += 1
    return _ARRIVED, taken


class Turnaround:
    """Waits for packets on the socket `descriptor`, answers regular ones, and puts them into `buffer` in turn.

    words : shared words of `Control`; after a new request no packet is answered here

    most : largest number of prepared answers
    arrived : whether there is a datagram in the buffer; sent : whether it has been answered
    length, source : of the datagram; received_ns, sent_ns : CLOCK_MONOTONIC
    """

    def __init__(self, descriptor: int, buffer: bytearray, words: NDArray[np.int64]) -> None:
        self.most = _MOST
        self._descriptor, self._words = descriptor, words
        self._buffer = np.frombuffer(buffer, np.uint8)
        self._datagrams = np.zeros((self.most, -(-len(buffer) // 4) * 4), np.uint8)
        self._shorts, self._floats = self._datagrams.view(np.uint16), self._datagrams.view(np.float32)
        self._ends, self._found = np.zeros((self.most, 2), np.int64), np.zeros((self.most, 3), np.int64)
        self._controller, self._scratch = np.zeros(2, np.int64), np.zeros(5, np.int64)
        self._scratch[0] = descriptor | _POLLIN << 32
        self._seen = words.copy()
        self._last = np.zeros(JOINTS, np.float32)
        self._ready, self._sequence, self._sample_time, self._room = 0, 0, 0.0, 0.0
        self._place, self._taken = 0, 0
        self._due = self._period = 0
        # Indexed by counter modulo `most`.
        self._answers = np.zeros((self.most, CMD_SIZE), np.uint8)
        self._targets = np.zeros((self.most, JOINTS), np.float32)
        self.arrived = self.sent = False

    def disarm(self) -> NDArray[np.int64]:
        """Discard all answers; returns the present words (64,), the reference for new requests."""
        self._ready = 0
        self._seen[:] = self._words
        return self._seen

    def slot(self, counter: int, target: NDArray[np.float32]) -> memoryview:
        """Memory for the answer to the packet with this counter, of the value `target` (7,) [rad]."""
        place = counter % self.most
        self._targets[place] = target
        return self._answers[place].data

    def arm(
        self,
        controller: tuple[str, int],
        sequence: int,
        ready: int,
        sample_time_s: float,
        last: NDArray[np.float32],
        room: float,
        due_ns: int = 0,
        period_ns: int = 0,
    ) -> None:
        """Declare the answers ready for `ready` packets from `controller`, with counters from `sequence` on.

        sample_time_s : required in the packets; last : value sent last (7,) [rad]; room : largest distance of
        measured position and set point from the value sent before [rad]; due_ns, period_ns : earliest arrival of
        the first packet, and between packets; an earlier one is left to the loop
        """
        host, port = controller
        family = socket.AF_INET.to_bytes(2, "little")
        address = _SOCKADDR.pack(family, port, socket.inet_aton(host))
        self._controller[:] = np.frombuffer(address, np.int64)
        self._sequence, self._sample_time = sequence, sample_time_s
        self._last[:] = last
        # As float32, never wider.
        self._room = float(np.nextafter(np.float32(room), np.float32(0.0)))
        self._due, self._period = due_ns, period_ns
        self._ready = ready

    def wait(self, awake_ns: int, asleep_ns: int, patience_ns: int) -> bool:
        """Wait for a datagram for `patience_ns`, without sleep from `awake_ns` until `asleep_ns`, all from now.

        The result is in the attributes; returns True if a new request ended the wait.
        """
        self._taken, self._place = 0, -1
        asked = self._run(awake_ns, asleep_ns, patience_ns)
        self.next(more=False)
        return asked

    def _run(self, awake_ns: int, asleep_ns: int, patience_ns: int) -> bool:
        status, self._taken = _turn(
            self._descriptor,
            self._datagrams,
            self._shorts,
            self._floats,
            self._ends,
            self._controller,
            self._answers,
            self._targets,
            self._ready,
            self._sequence,
            self._sample_time,
            self._last,
            self._room,
            self._words,
            self._seen,
            _WATCHED,
            self._found,
            self._scratch,
            self._taken,
            awake_ns,
            asleep_ns,
            patience_ns,
            self._due,
            self._period,
        )
        return bool(status == _ASKED)

    @property
    def waiting(self) -> int:
        """Datagrams taken and not yet put into the buffer."""
        return max(self._taken - self._place - 1, 0)

    def next(self, *, more: bool) -> bool:
        """Put the next taken datagram into the buffer; False if there is none.

        more : answer datagrams of the meantime with the remaining answers; these must still hold
        """
        if more and 0 < self._taken < self._ready and self._found[self._taken - 1, 2] > 0:
            self._run(0, 0, 0)
        self._place += 1
        self.arrived = self._place < self._taken
        self.sent = self.arrived and self.sent_ns > 0
        if self.arrived:
            self._buffer[:] = self._datagrams[self._place, : len(self._buffer)]
        return self.arrived

    @property
    def answer_bytes(self) -> memoryview:
        """The 376 bytes of the answer to the datagram in the buffer, if it was sent."""
        return self._answers[(self._sequence + self._place) % self.most].data

    @property
    def length(self) -> int:
        """Bytes of the datagram."""
        return int(self._found[self._place, 0])

    @property
    def source(self) -> tuple[str, int]:
        """Host and port of its sender."""
        _, port, host = _SOCKADDR.unpack(self._ends[self._place].tobytes())
        return socket.inet_ntoa(host), port

    @property
    def received_ns(self) -> int:
        """Time of its arrival [ns]."""
        return int(self._found[self._place, 1])

    @property
    def sent_ns(self) -> int:
        """Time after its answer was sent, 0 without one [ns]."""
        return int(self._found[self._place, 2])
