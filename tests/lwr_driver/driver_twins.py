"""Two loops in step, of which one has its answers ready before the packets and one does not."""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fri.packets import MSR_OFFSETS
from fri.states import ALL_DRIVES
from lwr_driver.control import Job, Mode, Text, Word
from lwr_driver.motion import Motion, move_to
from lwr_driver.ring import Ring
from lwr_driver.turnaround import Turnaround
from tests.lwr_driver.driver_rig import Rig, arm

HOP = np.array([0.3, -0.2, 0.3, 0.4, -0.5, 0.2, 0.6])


class Watched(Turnaround):
    """Counts what it answers, and can be made to see something happen before or after it waits."""

    def __init__(self, rig: Rig) -> None:
        remote = rig.loop.remote
        super().__init__(remote.descriptor, remote.buffer, rig.control.words)
        self.answered = 0
        self.batches: list[int] = []
        # The packets of the rig are sent before the loop looks; they are to come while it looks out.
        self.meanwhile = False
        self.before: Callable[[], None] | None = None
        self.after: Callable[[], None] | None = None

    def next(self, *, more: bool) -> bool:
        return super().next(more=more and self.meanwhile)

    def wait(self, awake_ns: int, asleep_ns: int, patience_ns: int) -> bool:
        if self.before is not None:
            hook, self.before = self.before, None
            hook()
        asked = super().wait(awake_ns, asleep_ns, patience_ns)
        self.batches.append(int(np.count_nonzero(self._found[: self._taken, 2])))
        self.answered += self.sent
        if self.after is not None:
            hook, self.after = self.after, None
            hook()
        return asked


class Twins:
    """Two rigs in step, the first of which answers ahead."""

    def __init__(self, period_ms: int = 5, **options: Any) -> None:
        self.rings = Ring.create(2000), Ring.create(2000)
        self.rigs = [Rig(period_ms, lock_step=False, ring=ring, **options) for ring in self.rings]
        self.ahead = Watched(self.rigs[0])
        self.rigs[0].loop.turnaround = self.ahead
        self.alter: Callable[[bytes], bytes] | None = None
        self.heard: tuple[list[bytes], list[bytes]] = ([], [])
        for rig, heard in zip(self.rigs, self.heard, strict=True):
            rig.timeout_s = 0.0
            self._tap(rig, heard)

    def _tap(self, rig: Rig, heard: list[bytes]) -> None:
        send, receive = rig.end.send, rig.end.receive

        def altered(packet: bytes) -> None:
            send(packet if self.alter is None else self.alter(packet))

        def received(timeout_s: float) -> bytes | None:
            datagram = receive(timeout_s)
            if datagram is not None:
                heard.append(datagram)
            return datagram

        rig.end.send, rig.end.receive = altered, received  # type: ignore[method-assign]

    def close(self) -> None:
        for rig, ring in zip(self.rigs, self.rings, strict=True):
            rig.close()
            ring.unlink()

    def __getattr__(self, name: str) -> Any:
        """What is asked of the twins is asked of the first."""
        return getattr(self.rigs[0], name)

    def both(self, act: Callable[[Rig], object]) -> None:
        for rig in self.rigs:
            act(rig)

    def cycle(self, **faults: Any) -> int:
        """One cycle of both; how many answers left ahead."""
        before = self.ahead.answered
        self.both(lambda rig: rig.cycle(**faults))
        assert self.heard[0] == self.heard[1]
        assert self.rigs[0].mode is self.rigs[1].mode
        return self.ahead.answered - before

    def cycles(self, count: int) -> int:
        return sum(self.cycle() for _ in range(count))

    def until_done(self, most: int = 2000) -> int:
        """Cycles until what was asked for is done; how many answers left ahead."""
        ahead = 0
        for _ in range(most):
            if self.rigs[0].done:
                assert self.rigs[1].done
                assert self.rigs[0].result is self.rigs[1].result
                assert self.rigs[0].reason == self.rigs[1].reason
                return ahead
            ahead += self.cycle()
        raise AssertionError(f"not done after {most} cycles, mode {self.rigs[0].mode.name}")

    def enter(self) -> None:
        self.both(lambda rig: rig.post(Job.START, limit=2000))
        self.until_done()
        assert self.rigs[0].mode is Mode.HOLD

    def start(self, motion: Motion) -> None:
        self.both(lambda rig: rig.start(motion))

    def hop(self, way: NDArray[np.float64] = HOP) -> Motion:
        rig = self.rigs[0]
        return move_to(arm(), rig.target, rig.target + way, rig.period_s, speed_scale=0.6)

    def in_motion(self, rows: int = 20) -> Motion:
        self.enter()
        motion = self.hop()
        self.start(motion)
        assert self.cycles(rows) == rows
        assert self.rigs[0].mode is Mode.MOTION
        return motion

    def check_same(self) -> None:
        """Logs, counters, tracking errors and reasons are the same, too; times apart."""
        rows = [ring.take() for ring in self.rings]
        for name in ("sequence", "plan_index", "phase", "answered", "msr", "cmd"):
            assert rows[0][name].tobytes() == rows[1][name].tobytes(), name
        sent = rows[0]["answered"] == 1
        assert np.all(rows[0]["t_send"][sent] >= rows[0]["t_recv"][sent])
        assert np.all(np.diff(rows[0]["t_recv"]) > 0)
        words = [rig.control.words.copy() for rig in self.rigs]
        for each in words:
            each[Word.HEARD_NS] = 0
        np.testing.assert_array_equal(*words)
        np.testing.assert_array_equal(*(rig.control.tracking for rig in self.rigs))
        assert len({int(rig.control.latency.sum()) for rig in self.rigs}) == 1
        assert len({rig.control.text(Text.LEFT) for rig in self.rigs}) == 1
        assert len({tuple(rig.loop.remote.counters().items()) for rig in self.rigs}) == 1


def ask(rig: Rig, what: str) -> None:
    words = rig.control.words
    if what == "request":
        rig.post(Job.HALT)
    else:
        words[Word[what.upper()]] += 1


def put(name: str, layout: str, *values: float) -> Callable[[bytes], bytes]:
    def alter(packet: bytes) -> bytes:
        changed = bytearray(packet)
        struct.pack_into(layout, changed, MSR_OFFSETS[name], *values)
        return bytes(changed)

    return alter


SPOILT = {
    "state": put("state", "<H", 1),
    "state unknown": put("state", "<H", 7),
    "quality unknown": put("quality", "<H", 4),
    "drives off": put("power", "<H", 0),
    "a drive off": put("power", "<H", ALL_DRIVES & ~4),
    "drive error": put("error", "<H", 4),
    "control": put("control", "<H", 3),
    "sample time": put("cmd_sample_time", "<f", 0.007),
    "measuring time": put("msr_sample_time", "<f", -0.005),
    "timestamp": put("timestamp", "<f", float("nan")),
    "position no number": put("msr_jnt_pos", "<f", float("nan")),
    "position impossible": put("msr_jnt_pos", "<f", -1e3),
    "set point impossible": put("cmd_jnt_pos", "<f", 1e3),
    "offset impossible": put("cmd_jnt_pos_fri_offset", "<f", 1e3),
    "set point no number": put("cmd_jnt_pos", "<f", float("nan")),
    "offset infinite": put("cmd_jnt_pos_fri_offset", "<f", float("inf")),
    "torque no number": put("msr_jnt_trq", "<f", float("nan")),
    "torque impossible": put("msr_jnt_trq", "<f", 3e3),
    "id": put("datagram_id", "<H", 0x2007),
    "size field": put("packet_size", "<H", 915),
    "counter far on": put("send_seq", "<H", 40_000),
    "short": lambda packet: packet[:-1],
    "long": lambda packet: packet + b"x",
    "empty": lambda packet: b"",
}
