"""The set-up of an experiment: the arm or its emulator, the driver connected to it, and who stands there."""

from __future__ import annotations

import logging
import socket
from contextlib import ExitStack
from types import TracebackType

from fri.handshake import IdentificationHandshake
from lwr_driver.arm import Arm
from lwr_driver.arm.cell import Cell
from lwr_driver.driver import Driver, LinkSettings, Waiting
from lwr_driver.session.motor_torque import KrlMotorTorque
from runner.experiment import Bench
from runner.experiment_file import Experiment
from runner.operator import EmulatedOperator, Operator, Person
from runner.status import StatusLine
from sim_backend.configuration import load_configuration
from sim_backend.process import EmulatorProcess
from sim_backend.robot import robot_file

__all__ = ["Laboratory"]

log = logging.getLogger(__name__)


class Laboratory:
    """Starts what an experiment needs and ends it again; a context manager that gives the `Bench`.

    assume_yes : confirm questions to the operator by itself
    allow_non_realtime : command a real arm without real-time rights; the emulator never needs them
    """

    def __init__(
        self,
        experiment: Experiment,
        *,
        assume_yes: bool = False,
        allow_non_realtime: bool = False,
        status: StatusLine | None = None,
    ) -> None:
        self.experiment = experiment
        self.status = status if status is not None else StatusLine()
        self.emulator: EmulatorProcess | None = None
        self._assume_yes = assume_yes
        self._allow_non_realtime = allow_non_realtime
        self._stack = ExitStack()

    def __enter__(self) -> Bench:
        with ExitStack() as stack:
            bench = self._set_up(stack)
            self._stack = stack.pop_all()
        return bench

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.status.clear()
        if error is not None and self.emulator is not None and not self.emulator.running:
            said = self.emulator.messages().strip().splitlines()
            self.status.say(f"the emulator ended by itself: {said[-1] if said else 'it said nothing'}")
        self._stack.close()

    def _set_up(self, stack: ExitStack) -> Bench:
        experiment = self.experiment
        beside = experiment.folder
        arm = Arm.load(experiment.arm, beside=beside)
        cell = Cell.load(experiment.cell, beside=beside)
        port = experiment.link.port
        enters_load = experiment.link.handshake != IdentificationHandshake.name
        operator: Operator = Person(self._assume_yes, enters_load=enters_load)
        if experiment.backend == "emulator":
            port = free_port(experiment.link.address)
            emulator = EmulatorProcess(
                experiment.emulator_path,
                lock_step=experiment.lock_step,
                fri_host=experiment.link.address,
                fri_port=port,
                settings={"fri.program": experiment.link.handshake, **experiment.emulator_settings},
            )
            self.emulator = stack.enter_context(emulator)
            known = robot_file(load_configuration(experiment.emulator_path)).payloads
            operator = EmulatedOperator(emulator.pendant, frozenset(known), enters_load=enters_load)
        driver = stack.enter_context(
            Driver(arm, self._link(port), notify=self._notify, motor_torque=self._krl())
        )
        driver.connect()
        return Bench(arm, cell, driver, operator, self.status)

    def _link(self, port: int) -> LinkSettings:
        link = self.experiment.link
        emulated = self.experiment.backend == "emulator"
        return LinkSettings(
            address=link.address,
            port=port,
            controller=link.controller,
            lock_step=emulated and self.experiment.lock_step,
            handshake=link.handshake,
            realtime="allow" if emulated or self._allow_non_realtime else "require",
            # On a busy computer the emulator may be held up for long, and in lock step that harms nothing.
            lock_step_patience_s=60.0,
        )

    def _krl(self) -> KrlMotorTorque | None:
        settings = self.experiment.motor_torque
        return settings.krl if settings.source == "krl_reals" else None

    def _notify(self, waiting: Waiting) -> None:
        self.status.show(
            f"waiting for {waiting.awaited}",
            0.0,
            f"{waiting.since_s:.0f} s; seen: {waiting.seen}. {waiting.advice}",
        )


def free_port(address: str) -> int:
    """A UDP port of `address` that nobody uses now."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind((address, 0))
        port: int = probe.getsockname()[1]
    return port
