"""The set-up of an experiment: the arm or its emulator, the connected driver, and the person at the arm."""

from __future__ import annotations

import random
import socket
from contextlib import ExitStack, suppress
from pathlib import Path

from fri.errors import NetworkError, OperatorError
from fri.handshake import IdentificationHandshake
from lwr_driver.arm import Arm
from lwr_driver.arm.cell import Cell
from lwr_driver.driver import Driver, LinkSettings, Waiting
from runner.contact import expected_arm
from runner.experiment import Bench, Operator
from runner.experiment_file import Experiment, Payload
from runner.status import StatusLine
from runner.terminal import ask
from sim_backend.configuration import load_configuration
from sim_backend.pendant import Pendant
from sim_backend.process import EmulatorProcess
from sim_backend.robot import robot_file

# Ports that no operating system hands out by itself.
_UNASSIGNED = range(20000, 32768)


class Person:
    """The person at the arm, asked on the terminal: mounts payloads, enters load data, confirms.

    assume_yes : confirm without a question, for automation.
    enters_load : load data are entered at the pendant, not sent over the link.
    """

    def __init__(self, assume_yes: bool, *, enters_load: bool = True) -> None:
        self._assume_yes, self._enters_load = assume_yes, enters_load

    def swap(self, mounted: Payload | None, wanted: Payload | None) -> None:
        """Ask for the swap and wait for the confirmation."""
        if wanted is None:
            work = f"Take the payload {mounted.name!r} off" if mounted else "Leave the flange empty"
            load = "set the load data on the controller to the empty flange"
        else:
            verb = "Make sure that this is mounted: the payload" if wanted == mounted else "Mount the payload"
            work = f"{verb} {wanted.name!r}, {wanted.mass:g} kg"
            x, y, z = (1000 * value for value in wanted.com)
            load = (
                f"enter its load data on the controller: {wanted.mass:g} kg, centre of mass "
                f"({x:.0f}, {y:.0f}, {z:.0f}) mm in the frame of link 7"
            )
        if self._enters_load:
            work = f"{work}, then {load}"
        self._confirm(f"{work}. Stay clear of the arm. Ready?")

    def start_trace(self) -> None:
        """Ask for the controller's recording to be started."""
        self._confirm("Start the controller's trace (motor torques and axis positions). Running?")

    def save_trace(self, path: Path) -> bool:
        """Ask for the trace file."""
        self._confirm(f"Stop the trace and copy its file to {path}. Done?")
        return path.exists()

    def _confirm(self, question: str) -> None:
        if not self._assume_yes and not ask(question):
            raise OperatorError(f"not confirmed: {question.rsplit('. ', 1)[0]}; nothing moved")


class EmulatedOperator:
    """The person at the arm, emulated at the emulator's pendant.

    known : payloads with properties in the emulator; others are mounted as announced.
    enters_load : load data are entered at the pendant, not sent over the link.
    """

    def __init__(self, pendant: Pendant, known: frozenset[str], *, enters_load: bool = True) -> None:
        self._pendant, self._known, self._enters_load = pendant, known, enters_load

    def swap(self, mounted: Payload | None, wanted: Payload | None) -> None:
        """Mount or unmount, and enter the announced load data."""
        if wanted is None:
            self._pendant.unmount()
        elif wanted.name in self._known:
            self._pendant.mount(wanted.name)
        else:
            self._pendant.mount(mass=wanted.mass, com=wanted.com, inertia=wanted.inertia)
        if self._enters_load and wanted is None:
            self._pendant.set_load(0.0)
        elif self._enters_load and wanted is not None:
            self._pendant.set_load(wanted.mass, wanted.com, wanted.inertia)

    def start_trace(self) -> None:
        """Begin the controller's trace."""
        self._pendant.start_trace()

    def save_trace(self, path: Path) -> bool:
        """Save the controller's trace."""
        self._pendant.save_trace(path)
        return True


class Laboratory:
    """A context manager: starts emulator and driver, gives the `Bench`, and ends them.

    assume_yes : confirm all questions to the operator.
    allow_non_realtime : command a real arm without real-time rights; the emulator needs none.
    silence_s : without a packet for so long the link is lost [s].
    """

    def __init__(
        self,
        experiment: Experiment,
        *,
        assume_yes: bool = False,
        allow_non_realtime: bool = False,
        status: StatusLine | None = None,
        silence_s: float = LinkSettings.link_timeout_s,
    ) -> None:
        self.experiment = experiment
        self._silence_s = silence_s
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

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        self.status.clear()
        if error is not None and self.emulator is not None and not self.emulator.running:
            said = self.emulator.messages().strip().splitlines()
            self.status.say(f"the emulator ended by itself: {said[-1] if said else 'it said nothing'}")
        self._stack.close()

    def _set_up(self, stack: ExitStack) -> Bench:
        experiment = self.experiment
        arm = Arm.load(experiment.arm, beside=experiment.folder)
        cell = Cell.load(experiment.cell, beside=experiment.folder)
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
                hosting=experiment.hosted,
            )
            self.emulator = stack.enter_context(emulator)
            known = robot_file(
                load_configuration(experiment.emulator_path, experiment.emulator_settings)
            ).payloads
            operator = EmulatedOperator(emulator.pendant, frozenset(known), enters_load=enters_load)
        torque = experiment.motor_torque
        krl = torque.krl if torque.source == "krl_reals" else None
        contact, expected = experiment.contact, expected_arm(experiment.contact, arm, experiment.folder)
        driver = Driver(
            arm,
            self._link(port),
            notify=self._notify,
            motor_torque=krl,
            contact=contact,
            expected=expected,
            host=None if self.emulator is None else self.emulator.host,
        )
        stack.enter_context(driver)
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
            link_timeout_s=self._silence_s,
            # On a busy computer the emulator may pause for long; in lock step a pause is harmless.
            lock_step_patience_s=60.0,
        )

    def _notify(self, waiting: Waiting) -> None:
        # Nobody stands at the pendant of the built-in emulator.
        advice = "" if self.experiment.backend == "emulator" else waiting.advice
        self.status.wait(waiting.awaited, waiting.since_s, waiting.seen, advice)


def free_port(address: str) -> int:
    """An unused UDP port of `address`. Another program that asks for any port gets none of these, before its user binds
    it."""
    for port in random.sample(_UNASSIGNED, len(_UNASSIGNED)):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe, suppress(OSError):
            probe.bind((address, port))
            return port
    raise NetworkError(f"no UDP port of {address} can be bound; check that the address is this PC's")
