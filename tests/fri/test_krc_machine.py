"""The controller's session under arbitrary clients, operators and KRL programs."""

from __future__ import annotations

import numpy as np
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from fri.krc import EventKind, Setpoint
from fri.packets import MSR_SIZE, MsrBuffer
from fri.states import ALL_DRIVES, Control, Quality, State
from tests.fri.fri_rig import A_MAX, LIMITS, Q_MAX, Q_START, V_MAX, Rig

DROPS = set(EventKind) - {
    EventKind.OPENED,
    EventKind.STARTED,
    EventKind.STOPPED,
    EventKind.CLOSED,
    EventKind.REFUSED,
}
# Float32 of the commands, differenced twice.
ROUNDING = 2e-6


class SessionMachine(RuleBasedStateMachine):
    """Whatever comes in, the setpoint stays within its limits and the states change by the book."""

    @initialize(sample_time_ms=st.sampled_from([1, 2, 5]), bridged=st.integers(0, 3), malformed=st.booleans())
    def begin(self, sample_time_ms: int, bridged: int, malformed: bool) -> None:
        self.rig = Rig(
            sample_time_ms,
            window=20,
            minimum_packets=5,
            start_dwell=3,
            bridged_cycles=bridged,
            drop_on_malformed=malformed,
            acceleration_factor=1.0,
        )
        self.session = self.rig.session
        self.buffer = MsrBuffer()
        self.track = [self.session.setpoint]
        self.step = np.zeros(7)
        self.sequence: int | None = None
        self.started = False

    def packet(self) -> bool:
        """Begin a cycle; False while the session is closed."""
        session = self.session
        if session.state is State.OFF:
            self.take(session.close_cycle())
            return False
        before = session.state
        msr = self.rig.begin()
        self.buffer.buffer[:MSR_SIZE] = msr.tobytes()
        assert self.buffer.fault(MSR_SIZE) is None
        assert self.sequence is None or self.buffer.send_seq == (self.sequence + 1) & 0xFFFF
        self.sequence = self.buffer.send_seq
        total = msr["cmd_jnt_pos"].astype(float) + msr["cmd_jnt_pos_fri_offset"]
        assert np.allclose(total, session.setpoint, atol=ROUNDING)
        if before is State.MON and session.state is State.CMD:
            assert self.started
            assert session.quality >= Quality.OK
            self.started = False
        return True

    def take(self, setpoint: Setpoint) -> None:
        self.track.extend(setpoint.positions)
        if setpoint.drop is not None:
            assert setpoint.drop.kind in DROPS
            assert setpoint.state is not State.CMD
            self.started = False
        if setpoint.state is State.CMD:
            self.step = self.track[-1] - self.track[-1 - self.rig.sample_time_ms]

    @rule(count=st.integers(1, 30))
    def hold(self, count: int) -> None:
        for _ in range(count):
            if self.packet():
                self.session.receive(self.rig.answer())
                self.take(self.session.close_cycle())

    @rule(
        count=st.integers(1, 40),
        ahead=st.lists(st.floats(-1.0, 1.0), min_size=7, max_size=7),
    )
    def move(self, count: int, ahead: list[float]) -> None:
        """A client that accelerates within its limits."""
        period = self.rig.sample_time_ms * 1e-3
        target = np.array(ahead) * V_MAX * period * 0.95
        for _ in range(count):
            if not self.packet():
                return
            q = None
            if self.session.state is State.CMD:
                change = A_MAX * period**2 * 0.45
                self.step = self.step + np.clip(target - self.step, -change, change)
                q = np.clip(self.session.setpoint + self.step, -Q_MAX, Q_MAX)
            self.session.receive(self.rig.answer(q))
            self.take(self.session.close_cycle())

    @rule()
    def recover(self) -> None:
        """From any state a well-behaved client and operator come to command mode."""
        session = self.session
        session.quality_ceiling = Quality.PERFECT
        session.set_drives(ALL_DRIVES)
        self.rig.open()
        if session.state is State.CMD:
            return
        session.fri_stop()
        self.hold(30)
        for _ in range(1000):
            if session.ramping:
                self.hold(1)
        session.resync()
        self.start(1.0)
        self.hold(30)
        assert session.state is State.CMD

    @rule(count=st.integers(20, 60), ahead=st.lists(st.floats(-1.0, 1.0), min_size=7, max_size=7))
    def move_from_anywhere(self, count: int, ahead: list[float]) -> None:
        self.recover()
        self.move(count, ahead)

    @rule(
        moving=st.booleans(),
        scale=st.sampled_from([3e-4, 2e-3, 0.05, 4.0]),
        jump=st.lists(st.floats(-1.0, 1.0), min_size=7, max_size=7),
    )
    def jump(self, moving: bool, scale: float, jump: list[float]) -> None:
        if moving:
            self.move_from_anywhere(20, jump)
        if self.packet():
            self.session.receive(self.rig.answer(self.rig.mirror() + scale * np.array(jump)))
            self.take(self.session.close_cycle())

    @rule(count=st.integers(1, 8), ahead=st.lists(st.floats(-1.0, 1.0), min_size=7, max_size=7))
    def miss(self, count: int, ahead: list[float]) -> None:
        if count > 2:
            self.move_from_anywhere(20, ahead)
        for _ in range(count):
            if self.packet():
                self.take(self.session.close_cycle())

    @rule(
        field=st.sampled_from(["cmd_flags", "refl_seq", "packet_size", "datagram_id"]),
        value=st.integers(0, 0xFFFF),
    )
    def strange(self, field: str, value: int) -> None:
        if value & 1:
            self.recover()
        if self.packet():
            self.session.receive(self.rig.answer(None, **{field: value}))
            self.take(self.session.close_cycle())

    @rule(datagram=st.binary(max_size=400), good=st.booleans())
    def garbage(self, datagram: bytes, good: bool) -> None:
        if self.packet():
            self.session.receive(datagram)
            if good:
                self.session.receive(self.rig.answer())
            self.take(self.session.close_cycle())

    @rule(value=st.sampled_from([np.nan, np.inf, -np.inf]), joint=st.integers(0, 6))
    def no_number(self, value: float, joint: int) -> None:
        if self.packet():
            q = self.rig.mirror()
            q[joint] = value
            self.session.receive(self.rig.answer(q))
            # In Cartesian impedance the joint position is not flagged, so it is not looked at.
            used = self.session.state is State.CMD and self.session.control is not Control.CART_IMP
            self.take(self.session.close_cycle())
            assert not used or self.session.state is State.MON

    @rule(factor=st.floats(0.1, 1.0))
    def start(self, factor: float) -> None:
        if self.session.state is State.MON:
            self.session.fri_start(factor)
            self.started = not self.session.needs_resync

    @rule()
    def stop(self) -> None:
        self.session.fri_stop()
        self.started = False
        assert self.session.state is not State.CMD

    @rule()
    def close(self) -> None:
        self.session.fri_close()
        self.started = False
        assert self.session.state is State.OFF

    @rule()
    def open(self) -> None:
        if self.session.state is State.OFF:
            self.started = False
        self.rig.open()

    @rule()
    def resync(self) -> None:
        if self.session.state is not State.CMD and not self.session.ramping:
            self.session.resync()

    @rule(power=st.sampled_from([0, ALL_DRIVES]), error=st.sampled_from([0, 0, 0, 1]))
    def drives(self, power: int, error: int) -> None:
        self.session.set_drives(power, error)

    @rule(strategy=st.sampled_from([10, 20, 30]))
    def strategy(self, strategy: int) -> None:
        if self.session.state is not State.CMD:
            self.session.set_strategy(strategy)

    @rule(quality=st.sampled_from(Quality))
    def ceiling(self, quality: Quality) -> None:
        self.session.quality_ceiling = quality

    @invariant()
    def setpoint_moves_within_the_limits(self) -> None:
        track = np.array(self.track)
        assert np.isfinite(track).all()
        assert (np.abs(track) <= Q_MAX + 2e-6).all()
        if len(track) > 1:
            # Bridging may correct a line by what the acceleration limit allows over the gap.
            step = np.abs(np.diff(track, axis=0))
            assert (step <= V_MAX * 1e-3 + ROUNDING).all()
        self.track = self.track[-2:] if self.session.state is not State.CMD else self.track[-200:]

    @invariant()
    def counters_fit(self) -> None:
        counters = self.session.counters()
        assert counters["answered"] <= counters["packets"]
        drops = sum(event.kind in DROPS for event in self.session.events)
        assert drops == counters["drops"] or len(self.session.events) == 256

    @invariant()
    def fallback_needs_a_resync(self) -> None:
        if self.session.needs_resync:
            assert self.session.state is not State.CMD


SessionMachine.TestCase.settings = settings(
    max_examples=45, stateful_step_count=40, deadline=None, derandomize=True
)
test_session_machine = SessionMachine.TestCase


def test_start_position_lies_inside_the_limits():
    assert (np.abs(Q_START) < LIMITS.q_max).all()
