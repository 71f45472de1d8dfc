"""A controller's session with a client beside it, without a socket."""

from __future__ import annotations

import numpy as np

from fri.krc import KrcLimits, KrcPolicy, KrcSession, Sample, Setpoint
from fri.packets import MSR, new_cmd
from fri.states import FLAGS, Control, State

DEG = np.pi / 180.0
Q_MAX = np.array([170.0, 120.0, 170.0, 120.0, 170.0, 120.0, 170.0]) * DEG
V_MAX = np.array([120.0, 120.0, 160.0, 160.0, 250.0, 220.0, 220.0]) * DEG
A_MAX = np.array([1200.0, 1200.0, 1600.0, 1600.0, 2500.0, 4400.0, 4400.0]) * DEG
LIMITS = KrcLimits(-Q_MAX, Q_MAX, V_MAX, A_MAX)
Q_START = np.array([0.5, -0.4, 0.3, 1.2, -0.2, 0.7, 0.1])
# The largest step that the velocity limits allow in one millisecond.
STEP = V_MAX * 1e-3
QUICK = {"window": 40, "minimum_packets": 10, "start_dwell": 5}


class Rig:
    """A session and a well-behaved client that answers every packet with the mirror unless told otherwise."""

    def __init__(self, sample_time_ms: int = 1, q: np.ndarray = Q_START, **policy: object) -> None:
        self.session = KrcSession(LIMITS, q, KrcPolicy(**{**QUICK, **policy}))
        self.sample = Sample()
        self.cmd = new_cmd()
        self.cmd["cmd_flags"] = int(FLAGS[Control.POSITION])
        self.msr = np.zeros((), MSR)
        self.sample_time_ms = sample_time_ms
        self.flags_follow = True

    def open(self) -> Rig:
        self.session.fri_open(self.sample_time_ms)
        return self

    def begin(self) -> np.ndarray:
        """Send a packet; the measurement as the client sees it."""
        self.msr = np.frombuffer(self.session.packet(self.sample), MSR).reshape(())
        return self.msr

    def mirror(self) -> np.ndarray:
        return self.msr["cmd_jnt_pos"] + self.msr["cmd_jnt_pos_fri_offset"]

    def answer(self, q: np.ndarray | None = None, **fields: object) -> bytes:
        """The client's answer to the packet in hand; `fields` overwrites single fields."""
        cmd = self.cmd
        cmd["send_seq"] = (int(cmd["send_seq"]) + 1) & 0xFFFF
        cmd["refl_seq"] = self.msr["send_seq"]
        cmd["jnt_pos"] = self.mirror() if q is None else q
        if self.flags_follow and self.msr["state"] != State.CMD:
            cmd["cmd_flags"] = int(FLAGS[Control(int(self.msr["control"]))])
        special = cmd.copy()
        for name, value in fields.items():
            special[name] = value
        return special.tobytes()

    def cycle(self, q: np.ndarray | None = None, reply: bool = True, **fields: object) -> Setpoint:
        """One cycle with an answer (mirror, or `q`), or without one."""
        self.begin()
        if reply:
            self.session.receive(self.answer(q, **fields))
        return self.session.close_cycle()

    def cycles(self, count: int) -> Setpoint:
        for _ in range(count):
            setpoint = self.cycle()
        return setpoint

    def command_mode(self) -> Rig:
        """Open, wait for quality and dwell, start; the next packet is the first of command mode."""
        self.open().cycles(20)
        self.session.fri_start()
        self.cycle()
        assert self.session.state is State.CMD
        return self


def accelerate(rig: Rig, cycles: int, step: np.ndarray) -> np.ndarray:
    """Move with a constant `step` per cycle for some cycles; the last command."""
    q = rig.session.setpoint
    for _ in range(cycles):
        q = q + step
        rig.cycle(q)
    return np.float32(q).astype(float)
