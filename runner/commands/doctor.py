"""`lwr-run doctor`: is this computer ready, and the link, and the controller?"""

from __future__ import annotations

import logging
import sys
from contextlib import ExitStack

import click

from fri.errors import ConfigurationError
from lwr_driver.arm import Arm
from runner.doctor import Patient, examine
from runner.experiment_file import DEFAULT, Experiment
from runner.laboratory import free_port
from runner.options import json_option
from runner.plain import as_json as to_json
from runner.status import StatusLine
from sim_backend.process import EmulatorProcess


@click.command("doctor")
@click.argument("file", default=DEFAULT)
@click.option("--link", is_flag=True, help="Test the link, too: answer the controller in monitor mode.")
@click.option(
    "--seconds", default=10.0, show_default=True, type=click.FloatRange(0.5), help="Length of the test."
)
@click.option(
    "--wait",
    "wait_s",
    default=20.0,
    show_default=True,
    type=click.FloatRange(0.1),
    help="For the first packet [s].",
)
@click.option(
    "--address", help="Address of this computer; default: the experiment file's. Means a real controller."
)
@click.option("--port", type=click.IntRange(1, 65535), help="UDP port; default: the experiment file's.")
@click.option("--controller", help="Address of the controller; default: the experiment file's.")
@click.option("--period-ms", type=click.FloatRange(1, 100), help="Cycle of the built-in emulator.")
@json_option
def command(
    file: str,
    link: bool,
    seconds: float,
    wait_s: float,
    address: str | None,
    port: int | None,
    controller: str | None,
    period_ms: float | None,
    as_json: bool,
) -> None:
    """Examine this computer and, with --link, the connection to the controller. Nothing moves.

    Each item has its value, its limit, and what to do about it. FILE is the experiment file whose addresses
    and KRL program are meant; with backend `emulator` the built-in one is tested in real time, which shows
    what this computer can do without a robot.

    Exits with 0 if ready, 3 (computer), 5 (controller) or 6 (link, real-time rights) by the first failure.

    \b
    lwr-run doctor                                      this computer
    lwr-run doctor my_lab.yaml --link                   and the link to the controller
    lwr-run doctor --link --period-ms 5                 against the built-in emulator
    lwr-run doctor --link --address 192.168.0.100       a controller, without an experiment file
    """
    experiment = Experiment.load(file)
    emulated = experiment.backend == "emulator" and address is None
    if period_ms is not None and not emulated:
        raise ConfigurationError("--period-ms is for the emulator; a controller chooses its cycle in friOpen")
    here = address if address is not None else experiment.link.address
    status = StatusLine()
    with ExitStack() as stack:
        # What the driver would warn of is among the findings.
        driver_log = logging.getLogger("lwr_driver.driver")
        driver_log.addFilter(_is_error)
        stack.callback(driver_log.removeFilter, _is_error)
        place = port if port is not None else experiment.link.port
        if emulated:
            place = free_port(here) if port is None else port
        patient = Patient(
            arm=Arm.load(experiment.arm, beside=experiment.folder),
            address=here,
            port=place,
            controller=controller if controller is not None else experiment.link.controller,
            handshake=experiment.link.handshake,
            counter_int=_counter(experiment),
            realtime=not emulated,
        )
        if emulated and link:
            stack.enter_context(_emulator(experiment, here, place, period_ms))
        stack.callback(status.clear)
        found = examine(patient, link_s=seconds if link else None, wait_s=wait_s, report=status.show)
        status.clear()
    click.echo(to_json(found.to_dict()) if as_json else str(found))
    sys.exit(found.exit_code)


def _is_error(record: logging.LogRecord) -> bool:
    return record.levelno > logging.WARNING


def _counter(experiment: Experiment) -> int | None:
    settings = experiment.motor_torque
    return settings.krl.counter_int if settings.source == "krl_reals" else None


def _emulator(experiment: Experiment, address: str, port: int, period_ms: float | None) -> EmulatorProcess:
    """The built-in emulator in real time."""
    return EmulatorProcess(
        experiment.emulator_path,
        lock_step=False,
        fri_host=address,
        fri_port=port,
        period_ms=period_ms,
        settings={"fri.program": experiment.link.handshake, **experiment.emulator_settings},
    )
