"""The PC's end under an arbitrary network, against a model of what it must count and answer."""

from __future__ import annotations

import socket
import time

import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from fri.packets import CMD, CMD_SIZE, MSR_SIZE, new_msr
from fri.remote import RemoteEnd
from fri.states import FLAGS, Control, State

pytestmark = pytest.mark.slow

PATIENCE_S = 5.0


def bound(host: str = "127.0.0.1") -> socket.socket:
    made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    made.bind((host, 0))
    made.setblocking(False)
    return made


class LinkMachine(RuleBasedStateMachine):
    """One controller, a stranger, and a network that loses, repeats, reorders and damages."""

    arriving = ("received", "repeated", "reordered", "malformed", "foreign")

    @initialize(first=st.integers(0, 0xFFFF), uptime=st.sampled_from([0.0, 3000.0]))
    def begin(self, first: int, uptime: float) -> None:
        self.end = RemoteEnd("127.0.0.1", 0)
        self.controller, self.stranger = bound(), bound("127.0.0.2")
        self.msr = new_msr()
        self.msr["msr_sample_time"] = self.msr["cmd_sample_time"] = 0.002
        self.msr["state"], self.msr["control"], self.msr["power"] = State.MON, Control.POSITION, 0x7F
        self.number, self.uptime = first, uptime
        self.newest = first
        self.known = False
        self.flags: int | None = None
        self.count = dict.fromkeys(("received", "lost", "repeated", "reordered", "malformed", "foreign"), 0)
        self.answers = 0
        self.rng = np.random.default_rng(first)

    def teardown(self) -> None:
        if hasattr(self, "end"):
            self.end.close()
            self.controller.close()
            self.stranger.close()

    def make(self, number: int) -> bytes:
        self.msr["send_seq"] = number & 0xFFFF
        self.msr["timestamp"] = self.uptime + (number - self.newest) * 0.002 + self.newest * 0.002
        return self.msr.tobytes()

    def post(self, datagram: bytes, source: socket.socket | None = None) -> None:
        (source or self.controller).sendto(datagram, self.end.address)

    def nothing_usable(self) -> None:
        """Wait until all that was sent has arrived (a loaded machine delivers late); none is handed on."""
        patience, wait_s = time.monotonic() + PATIENCE_S, 0.0
        while sum(self.end.counters()[name] for name in self.arriving) < sum(
            self.count[name] for name in self.arriving
        ):
            assert self.end.receive(wait_s) is None
            wait_s = 0.001  # the kernel waits ten times as long
            assert time.monotonic() < patience, f"counted {self.end.counters()}, sent {self.count}"
        assert self.end.receive(0.0) is None

    def replies(self, source: socket.socket) -> list[np.ndarray]:
        found = []
        while True:
            try:
                datagram = source.recv(2048)
            except BlockingIOError:
                return found
            assert len(datagram) == CMD_SIZE
            found.append(np.frombuffer(datagram, CMD)[0])

    @rule(
        gap=st.integers(1, 60),
        state=st.sampled_from([State.MON, State.CMD]),
        power=st.sampled_from([0, 0x7F]),
        control=st.sampled_from([Control.POSITION, Control.JNT_IMP]),
        answer=st.booleans(),
    )
    def packet(self, gap: int, state: State, power: int, control: Control, answer: bool) -> None:
        self.msr["state"], self.msr["power"], self.msr["control"] = state, power, control
        self.msr["cmd_jnt_pos"] = self.rng.uniform(-2, 2, 7)
        self.msr["cmd_jnt_pos_fri_offset"] = self.rng.uniform(-1, 1, 7)
        gap = gap if self.known else 1
        self.number += gap
        self.newest = self.number
        self.post(self.make(self.number))
        assert self.end.receive(PATIENCE_S) is not None
        if self.known:
            self.count["lost"] += gap - 1
        self.known = True
        self.count["received"] += 1
        assert self.end.sequence % 65536 == self.number % 65536
        follows = state is not State.CMD or self.flags is None
        expected_flags = int(FLAGS[control]) if follows else self.flags
        if not answer:
            return
        self.flags = expected_flags
        q = self.rng.uniform(-2, 2, 7)
        used = self.end.answer(q)
        self.answers += 1
        (reply,) = self.replies(self.controller)
        commanding = state is State.CMD and power != 0
        assert used is commanding
        mirror = self.msr["cmd_jnt_pos"] + self.msr["cmd_jnt_pos_fri_offset"]
        assert reply["jnt_pos"].tolist() == (np.float32(q) if commanding else mirror).tolist()
        assert int(reply["refl_seq"]) == self.number & 0xFFFF
        assert int(reply["send_seq"]) == self.answers & 0xFFFF
        assert int(reply["cmd_flags"]) == expected_flags

    @rule()
    def repeat(self) -> None:
        if self.known:
            self.post(self.make(self.number))
            self.count["repeated"] += 1
            self.nothing_usable()

    @rule(age=st.integers(1, 60))
    def late(self, age: int) -> None:
        if self.known:
            # An isolated late packet; runs of them are a restart and tested apart.
            self.post(self.make(self.number - age))
            self.count["reordered"] += 1
            self.nothing_usable()
            self.packet(1, State.MON, 0x7F, Control.POSITION, True)

    @rule(cut=st.integers(0, MSR_SIZE - 1), extra=st.binary(max_size=20))
    def truncated(self, cut: int, extra: bytes) -> None:
        datagram = self.make(self.number + 1)[:cut] + extra
        if len(datagram) != MSR_SIZE:
            self.post(datagram)
            self.count["malformed"] += 1
            self.nothing_usable()

    @rule(position=st.integers(4, 7), damage=st.integers(1, 255))
    def damaged(self, position: int, damage: int) -> None:
        datagram = bytearray(self.make(self.number + 1))
        datagram[position] ^= damage
        self.post(bytes(datagram))
        self.count["malformed"] += 1
        self.nothing_usable()

    @rule(datagram=st.binary(max_size=1200))
    def foreign(self, datagram: bytes) -> None:
        if self.known:
            self.post(datagram, self.stranger)
            self.post(self.make(self.number + 5), self.stranger)
            self.count["foreign"] += 2
            self.nothing_usable()

    @invariant()
    def counters_are_those_of_the_model(self) -> None:
        counters = self.end.counters()
        assert {name: counters[name] for name in self.count} == self.count
        assert counters["answered"] == self.answers
        assert counters["restarts"] == counters["suspect"] == counters["port_changes"] == 0

    @invariant()
    def nobody_else_is_answered(self) -> None:
        assert not self.replies(self.stranger)
        assert not self.replies(self.controller)


LinkMachine.TestCase.settings = settings(
    max_examples=60, stateful_step_count=40, deadline=None, derandomize=True
)
test_link_machine = LinkMachine.TestCase
