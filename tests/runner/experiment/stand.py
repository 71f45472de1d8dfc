"""A stand with an arm that follows every motion at once, in place of the driver and the person at the arm."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from fri.errors import LwrError
from lwr_driver.arm import Arm
from lwr_driver.arm.cell import Cell
from lwr_driver.configuration import find
from lwr_driver.driver import LinkSettings, Outcome
from lwr_driver.motion import Motion, move_to
from lwr_driver.ring import ROW
from runner.experiment import Bench, Run
from runner.experiment_file import Experiment, MotorTorque, Moves, Payload, SessionPlan
from runner.preflight import gravity_torque
from runner.status import StatusLine

PERIOD_S = 0.01
HOME = np.array([0.0, 0.5, 0.0, -1.3, 0.0, 0.8, 0.0])
LOAD = Payload("paper_load", 3.34, (0.0, -0.066, 0.144))


class Stand:
    """Driver, operator and onlooker in one; `calls` lists what was asked of them, in order.

    flange : the payload mounted in truth, mounted by `swap` unless the person is `careless`.
    """

    def __init__(self, arm: Arm) -> None:
        self.arm = arm
        self.q = HOME.astype(np.float32).astype(np.float64)
        self.flange: Payload | None = None
        self.careless = False
        self.calls: list[tuple[Any, ...]] = []
        self.sets_load = True
        self.rights = None
        self.link = LinkSettings()
        self.quality, self.error = "OK", 0
        self.sign = np.ones(7)
        self.outcome = ("success", "", None)
        self.during: Callable[[], None] = lambda: None
        self.at_command: Callable[[], None] = lambda: None
        self.write_error = ""
        self.motor_rejected = 0
        self.in_command = False
        self.leave_error: LwrError | None = None
        self.packets = 0
        self.text = io.StringIO()
        self.trace: bytes | None = None

    def names(self) -> list[str]:
        """Names of the calls."""
        return [call[0] for call in self.calls]

    def of(self, name: str) -> list[tuple[Any, ...]]:
        """Arguments of the calls of this name."""
        return [call[1:] for call in self.calls if call[0] == name]

    def expect_load(self, *load: Any) -> None:
        """The payload of the contact watch."""

    # -- driver ----------------------------------------------------------------------------------------------

    def state(self) -> SimpleNamespace:
        self.packets += 100
        return SimpleNamespace(
            period_s=PERIOD_S,
            quality=self.quality,
            state="CMD" if self.in_command else "MON",
            mode="hold" if self.in_command else "mirror",
            error=self.error,
            answer_rate=1.0,
            q_command=self.q,
            received=self.packets,
            miss_counter=self.packets // 10,
            lost=self.packets // 20,
            late=self.packets // 50,
            latency_s={0.5: 1e-4, 0.99: 2e-4},
            tracking_error=np.full(7, 0.002),
        )

    def monitor(self, cycles: int) -> SimpleNamespace:
        self.calls.append(("monitor", cycles))
        return SimpleNamespace(q=self.q, tau=self.sign * gravity_torque(self.arm, self.q, self.flange))

    def wait_quality(self, *, cycles: int) -> None:
        self.calls.append(("wait_quality", cycles))

    def set_load(self, *load: Any) -> None:
        self.calls.append(("set_load", *load))

    def last_rows(self, count: int) -> np.ndarray:
        return np.zeros(count, ROW)

    def enter_command(self) -> None:
        self.calls.append(("enter_command",))
        self.in_command = True
        self.at_command()

    def leave_command(self) -> None:
        self.calls.append(("leave_command",))
        if self.leave_error is not None:
            raise self.leave_error
        self.in_command = False

    def request_stop(self) -> None:
        self.calls.append(("request_stop",))

    def drop_link(self) -> None:
        self.calls.append(("drop_link",))

    def record(self, path: Path, metadata: dict[str, str], attachments: dict[str, bytes]) -> None:
        self.calls.append(("record", path, metadata, attachments))
        path.write_bytes(b"log")

    def execute(self, motion: Motion, progress: Callable[[Any], None]) -> Outcome:
        self.calls.append(("execute", motion))
        half = len(motion) // 2
        progress(
            SimpleNamespace(row=half, rows=len(motion), time_s=1.5, phase="period 1", state=self.state())
        )
        self.during()
        self.q = motion.q[-1].astype(np.float32).astype(np.float64)
        status, reason, error = self.outcome
        return Outcome(status, reason, np.zeros(0), len(motion) - 1, len(motion), error)  # type: ignore[arg-type]

    def end_record(self, status: str, reason: str) -> SimpleNamespace:
        self.calls.append(("end_record", status, reason))
        return SimpleNamespace(error=self.write_error, samples=0, motor_rejected=self.motor_rejected)

    # -- person and onlooker ---------------------------------------------------------------------------------

    def swap(self, mounted: Payload | None, wanted: Payload | None) -> None:
        self.calls.append(("swap", mounted, wanted))
        if not self.careless:
            self.flange = wanted

    def start_trace(self) -> None:
        self.calls.append(("start_trace",))

    def save_trace(self, path: Path) -> bool:
        self.calls.append(("save_trace", path))
        return self.trace is not None

    def begin(self, session: str, payload: Payload | None, motion: Motion) -> None:
        self.calls.append(("begin", session, payload, motion))


def excite(plan: SessionPlan, period_s: float) -> Motion:
    """A short move of the wrist and back."""
    arm = Arm.load()
    there = HOME + np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.3])
    away = move_to(arm, HOME, there, period_s, speed_scale=0.5, phase="period 1")
    return away.join(move_to(arm, there, HOME, period_s, speed_scale=0.5, phase="period 1"))


def experiment(*sessions: SessionPlan, source: str = "none", **changes: Any) -> Experiment:
    """An experiment of these sessions."""
    made = Experiment(
        "stand",
        sessions=sessions or (SessionPlan("bare"),),
        motor_torque=MotorTorque(source),  # type: ignore[arg-type]
        moves=Moves(settle_s=0.5, brake_s=0.1, speed_scale=0.5),
        **changes,
    )
    vars(made).update(text="name: stand\n")
    return made


def run_of(stand: Stand, folder: Path, *sessions: SessionPlan, source: str = "none", **changes: Any) -> Run:
    """A run of these sessions on the stand, with results in `folder`."""
    bench = Bench(
        stand.arm,
        Cell.load(find("cell.yaml")),
        stand,  # type: ignore[arg-type]
        stand,
        StatusLine(stand.text),
        stand,
    )
    return Run(experiment(*sessions, source=source, **changes), folder, bench, excite)
