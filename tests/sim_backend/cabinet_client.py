"""A client beside an emulated controller, without a socket and without a clock."""

from __future__ import annotations

import numpy as np

from fri.packets import MSR, new_cmd
from fri.states import CommandFlag, State
from sim_backend.cabinet import Cabinet
from sim_backend.configuration import load_configuration

_SPRING = CommandFlag.JNTPOS | CommandFlag.JNTSTIFF | CommandFlag.JNTDAMP | CommandFlag.JNTTRQ
QUIET = {
    "controller.settle_s": 0.2,
    "fri.program": "auto_start",
    "fri.period_ms": 5,
    "krl.statement_ms": 0.0,
}


class Client:
    """Answers the packets of a cabinet; in command mode with a spring about the first set point."""

    def __init__(self, strategy: int, **settings: object) -> None:
        overrides = {**QUIET, "krl.variables": {"LWR_STRATEGY": strategy}, **settings}
        self.cabinet = Cabinet(load_configuration("emulator/default.yaml", overrides))
        self.cabinet.start_program()
        self.command = new_cmd()
        self.command["cmd_flags"] = int(_SPRING if strategy == 30 else CommandFlag.JNTPOS)
        self.command["jnt_stiffness"], self.command["jnt_damping"] = 500.0, 0.7
        self.origin: np.ndarray | None = None
        self.shift = np.zeros(7)

    def cycles(self, count: int) -> np.ndarray:
        """Measured positions (count, 7) [rad]."""
        seen = []
        for _ in range(count):
            if self.cabinet.session.state is not State.OFF:
                msr = np.frombuffer(self.cabinet.packet(), MSR).reshape(())
                mirror = (msr["cmd_jnt_pos"] + msr["cmd_jnt_pos_fri_offset"]).astype(float)
                commanding = msr["state"] == State.CMD
                self.origin = (mirror if self.origin is None else self.origin) if commanding else None
                self.command["jnt_pos"] = mirror if self.origin is None else self.origin + self.shift
                self.command["send_seq"] = (int(self.command["send_seq"]) + 1) & 0xFFFF
                self.command["refl_seq"] = msr["send_seq"]
                self.cabinet.receive(self.command.tobytes(), 1e-4)
            self.cabinet.close()
            seen.append(self.cabinet.plant.position.copy())
        return np.array(seen)

    def until_command(self) -> None:
        for _ in range(600):
            self.cycles(1)
            if self.cabinet.session.state is State.CMD:
                return
        raise AssertionError(f"no command mode: {list(self.cabinet.session.events)}")
