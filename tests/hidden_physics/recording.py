"""One session of an arm, from the configuration of its cabinet to the log.

`record` runs the cabinet, the loop of the driver and the recording in this process, back to back and without
waiting, at some twenty times real time. `record_by_processes` runs the emulator, the driver and the recorder
as the experiment does. Both give the same file.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from fri.controller_end import ControllerEnd
from fri.in_process import Network
from fri.states import Quality, State
from lwr_driver.arm import Arm
from lwr_driver.commander import BRAKE, HOLD
from lwr_driver.control import Control, Job, Result, Word
from lwr_driver.driver import LOCK_STEP_EPOCH_NS, Driver, LinkSettings
from lwr_driver.loop import Loop, LoopSettings
from lwr_driver.motion import Motion
from lwr_driver.ring import Ring
from lwr_driver.session import session_metadata
from lwr_driver.session.motor_torque import KrlMotorTorque
from lwr_driver.session.recording import Recording, SessionRequest
from runner.laboratory import free_port
from sim_backend.cabinet import Cabinet
from sim_backend.configuration import load_configuration
from sim_backend.process import EmulatorProcess

__all__ = ["PERIOD_MS", "Order", "begin_s", "record", "record_by_processes"]

PERIOD_MS = 4
"""FRI cycle of all hidden sessions; the KRL loop's 12 ms are three of them."""

_QUALITY_CYCLES = 25
_SETTLE_S = 0.2
_RING_ROWS = 4096
_PATIENCE_CYCLES = 5000
_PHASES = {HOLD: "hold", BRAKE: "brake"}


@dataclass(frozen=True)
class Order:
    """What to record.

    motion : rows at `PERIOD_MS`. path : the new log. settings : of the emulated cabinet by dotted key, over
    its default configuration. payload, payload_mass : what is announced; what hangs there is in the settings.
    uid : of the session; it must not tell what is hidden
    """

    motion: Motion
    path: Path
    settings: Mapping[str, Any]
    uid: str
    seed: int = 1
    payload: str = "none"
    payload_mass: float | None = None
    robot: str = "KUKA LWR4+"
    more: Mapping[str, str] = field(default_factory=dict)

    def cabinet_settings(self) -> dict[str, Any]:
        """All settings of the cabinet, plain content."""
        return {
            "robot.start_position": [float(value) for value in self.motion.q[0]],
            "robot.payload": self.payload,
            "controller.settle_s": _SETTLE_S,
            "fri.period_ms": PERIOD_MS,
            "seed": self.seed,
            **self.settings,
        }

    def metadata(self) -> dict[str, str]:
        """The record `session`; the same in every run."""
        return session_metadata(
            robot=self.robot,
            payload=self.payload,
            payload_mass=self.payload_mass,
            experiment="identification",
            uid=self.uid,
            motor_torque_source="krl_reals",
            utc_start="2020-01-01T00:00:00+00:00",
            **self.more,
        )

    def attachments(self) -> dict[str, bytes]:
        """The plan, as every session has it."""
        period = self.motion.period_s
        qd = np.gradient(self.motion.q, period, axis=0)
        buffer = io.BytesIO()
        np.savez_compressed(
            buffer,
            time=np.arange(len(self.motion)) * period,
            q=self.motion.q,
            qd=qd,
            qdd=np.gradient(qd, period, axis=0),
        )
        return {"plan.npz": buffer.getvalue()}


class _Bench:
    """Cabinet and loop, joined by a network inside this process."""

    def __init__(self, order: Order, arm: Arm) -> None:
        config = load_configuration("emulator/default.yaml", order.cabinet_settings())
        self.arm, self.order = arm, order
        self.age_s = config.fri.answer_delay_s
        self.cabinet = Cabinet(config)
        self.cabinet.start_program()
        link = LinkSettings(address="127.0.0.1", port=0, lock_step=True)
        self.control = Control.create(len(order.motion))
        network = Network()
        self.ring = Ring.create(_RING_ROWS)
        self.loop = Loop(
            LoopSettings(
                address=link.address,
                port=link.port,
                controller=None,
                lock_step=True,
                handshake=link.handshake,
                link_timeout_s=link.link_timeout_s,
                tracking_limit_rad=link.tracking_limit_rad,
                joint_names=arm.joint_names,
            ),
            arm.limits,
            self.control,
            self.ring,
            network=network,
        )
        self.end = ControllerEnd(self.loop.remote.address, network=network)
        self.recording: Recording | None = None
        self._sent = False

    def close(self) -> None:
        self.loop.remote.close()
        self.end.close()
        self.ring.unlink()
        self.control.close()

    def job(self, job: Job, a: int = 0, b: int = 0, longest: int = _PATIENCE_CYCLES) -> None:
        """Run one job of the loop to its end."""
        words = self.control.words
        words[Word.JOB], words[Word.A], words[Word.B], words[Word.LIMIT] = int(job), a, b, 0
        words[Word.REQUEST] += 1
        for cycle in range(longest):
            self._cycle()
            if cycle % (_RING_ROWS // 2) == 0:
                self._drain()
            if words[Word.DONE] == words[Word.REQUEST]:
                break
        self._drain()
        result = Result(int(words[Word.RESULT]))
        if words[Word.DONE] != words[Word.REQUEST] or result is not Result.DONE:
            raise RuntimeError(f"{job.name} ended with {result.name} in {self.order.path.name}")

    def _cycle(self) -> None:
        cabinet = self.cabinet
        while cabinet.session.state is State.OFF:
            cabinet.close()
        self.end.send(cabinet.packet())
        if not self.loop.cycle(0.0):
            raise RuntimeError("the loop got no packet")
        answer = self.end.receive(0.0)
        if answer is None:
            raise RuntimeError("the cabinet got no answer")
        cabinet.arrived(answer)
        cabinet.receive(answer, self.age_s)
        cabinet.close()

    def _drain(self) -> None:
        rows = self.ring.take()
        if self.recording is not None:
            self.recording.write(rows)
        self.ring.release(len(rows))

    def enter(self) -> None:
        """Up to command mode, in the steps in which the driver goes there."""
        self.job(Job.CYCLES, a=1)
        self.job(Job.QUALITY, a=_QUALITY_CYCLES, b=int(Quality.OK))
        self.job(Job.START)

    def run(self) -> None:
        """The motion, recorded."""
        motion, names = self.order.motion, tuple(_PHASES[number] for number in sorted(_PHASES))
        self.recording = Recording(
            SessionRequest(
                path=self.order.path,
                joint_names=self.arm.joint_names,
                metadata=self.order.metadata(),
                robot_description=self.arm.urdf,
                attachments=self.order.attachments(),
                phase_names=names,
                motor_torque=KrlMotorTorque(),
                virtual_epoch_ns=LOCK_STEP_EPOCH_NS,
            ),
            0,
        )
        first = self.recording.add_phases(tuple(name for _, name in motion.phases))
        phases = [(row, first + place) for place, (row, _) in enumerate(motion.phases)]
        self.control.put_motion(motion.q, phases)
        try:
            self.job(Job.MOTION, a=len(motion), longest=len(motion) + _PATIENCE_CYCLES)
        except BaseException as error:
            self.recording.close("fail", str(error))
            raise
        self.recording.close("success", "", restarts=self.loop.remote.restarts)


def record(order: Order, arm: Arm | None = None) -> Path:
    """Run a session in this process; returns its log. RuntimeError if the motion does not come to its end."""
    bench = _Bench(order, arm or Arm.load())
    try:
        bench.enter()
        bench.run()
    finally:
        bench.close()
    return order.path


def begin_s(order: Order, arm: Arm | None = None) -> float:
    """When the cabinet's clock stands as the first row of the motion is commanded [s]; the same for all."""
    bench = _Bench(order, arm or Arm.load())
    try:
        bench.enter()
        return bench.cabinet.milliseconds * 1e-3
    finally:
        bench.close()


def record_by_processes(order: Order, arm: Arm | None = None) -> Path:
    """The same session with the emulator, the driver's loop and the recorder as processes that talk UDP."""
    arm = arm or Arm.load()
    port = free_port("127.0.0.1")
    link = LinkSettings(address="127.0.0.1", port=port, lock_step=True, realtime="allow")
    with (
        EmulatorProcess(fri_port=port, settings=order.cabinet_settings()),
        Driver(arm, link, motor_torque=KrlMotorTorque()) as driver,
    ):
        driver.connect()
        driver.wait_quality(cycles=_QUALITY_CYCLES)
        driver.enter_command()
        driver.record(order.path, order.metadata(), order.attachments())
        outcome = driver.execute(order.motion)
        driver.end_record(outcome.status, outcome.reason)
        outcome.check()
    return order.path
