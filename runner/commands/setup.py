"""Commands around the computer: doctor, emulator, completion."""

from __future__ import annotations

import logging
import sys
from contextlib import ExitStack
from pathlib import Path

import click
from click.shell_completion import get_completion_class

from fri.errors import ConfigurationError
from lwr_driver.configuration import CONFIGS
from runner.status import StatusLine, write
from runner.terminal import NAMED_FILE, PATH, FiniteRange, default_file, json_option, tell, verb


@verb("doctor")
@click.argument("file", type=NAMED_FILE, default=default_file)
@click.option("--link", is_flag=True, help="Test the link too: answer the controller in monitor mode.")
@click.option(
    "--seconds", default=10.0, show_default=True, type=FiniteRange(0.5, 3600.0), help="Length of the test."
)
@click.option(
    "--wait",
    "wait_s",
    default=20.0,
    show_default=True,
    type=FiniteRange(0.1, 86400.0),
    help="For the first packet [s].",
)
@click.option("--address", help="Address of this computer, for a real controller; default: from FILE.")
@click.option("--port", type=click.IntRange(1, 65535), help="UDP port; default: from FILE.")
@click.option("--period-ms", type=FiniteRange(1, 100), help="Cycle of the built-in emulator.")
@json_option
def doctor_command(
    file: str,
    link: bool,
    seconds: float,
    wait_s: float,
    address: str | None,
    port: int | None,
    period_ms: float | None,
    as_json: bool,
) -> None:
    """Examine this computer and, with --link, the connection to the controller. Nothing moves.

    Each item has a value, a limit and advice. The experiment FILE gives addresses and KRL program. With backend
    `emulator` the built-in emulator is tested in real time, as a measure of the computer alone.

    Exits with 0 if ready, 3 (computer), 5 (controller) or 6 (link, real-time rights) by the first failure.

    \b
    lwr-run doctor                                      this computer
    lwr-run doctor my_lab.yaml --link                   and the link to the controller
    lwr-run doctor --link --period-ms 5                 against the built-in emulator
    lwr-run doctor --link --address 192.168.0.100       a controller, without an experiment file
    """
    from lwr_driver.arm import Arm
    from runner.doctor import Patient, examine
    from runner.experiment_file import Experiment
    from runner.laboratory import free_port
    from sim_backend.process import EmulatorProcess

    experiment = Experiment.load(file)
    emulated = experiment.backend == "emulator" and address is None
    if period_ms is not None and not emulated:
        raise ConfigurationError("--period-ms is for the emulator; a controller chooses its cycle in friOpen")
    here = address if address is not None else experiment.link.address
    place = port or (free_port(here) if emulated else experiment.link.port)
    torque = experiment.motor_torque
    patient = Patient(
        arm=Arm.load(experiment.arm, beside=experiment.folder),
        address=here,
        port=place,
        controller=experiment.link.controller,
        handshake=experiment.link.handshake,
        counter_int=torque.krl.counter_int if torque.source == "krl_reals" else None,
        realtime=not emulated,
    )
    status = StatusLine()
    with ExitStack() as stack:
        # The findings include the driver's warnings.
        driver_log = logging.getLogger("lwr_driver.driver")
        driver_log.addFilter(_is_error)
        stack.callback(driver_log.removeFilter, _is_error)
        if emulated and link:
            emulator = EmulatorProcess(
                experiment.emulator_path,
                lock_step=False,
                fri_host=here,
                fri_port=place,
                period_ms=period_ms,
                settings={"fri.program": experiment.link.handshake, **experiment.emulator_settings},
            )
            stack.enter_context(emulator)
        stack.callback(status.clear)
        found = examine(patient, link_s=seconds if link else None, wait_s=wait_s, report=status.show)
        status.clear()
    tell(found, as_json)
    sys.exit(found.exit_code)


def _is_error(record: logging.LogRecord) -> bool:
    return record.levelno > logging.WARNING


@verb("emulator")
@click.argument("config", type=NAMED_FILE, default=str(CONFIGS / "emulator/default.yaml"))
@click.option("--fri-host", default="127.0.0.1", show_default=True, help="Address of the commanding PC.")
@click.option("--fri-port", default=49938, show_default=True, type=click.IntRange(1, 65535), help="Its port.")
@click.option(
    "--pendant-port", default=0, type=click.IntRange(0, 65535), help="Port of the pendant; 0: any free port."
)
@click.option("--period-ms", type=FiniteRange(1, 100), help="FRI cycle; default: as configured.")
@click.option("--program", type=NAMED_FILE, help="KRL program: a name of configs/krl, or a .src file.")
@click.option(
    "--set",
    "settings",
    multiple=True,
    metavar="KEY=VALUE",
    help="Replace a key, e.g. krl.variables.LWR_STRATEGY=30.",
)
@click.option(
    "--lock-step", is_flag=True, help="Own clock: one cycle for each answer, repeatable bit for bit."
)
@click.option("--once", is_flag=True, help="With --lock-step: end when the client has left.")
@json_option
@click.pass_context
def emulator_command(
    context: click.Context,
    config: str,
    fri_host: str,
    fri_port: int,
    pendant_port: int,
    period_ms: float | None,
    program: str | None,
    settings: tuple[str, ...],
    lock_step: bool,
    once: bool,
    as_json: bool,
) -> None:
    """Run the emulated controller and arm in real time until Ctrl-C.

    It behaves as the KRC of a KUKA LWR4+: it sends to --fri-host:--fri-port and expects an answer in each
    cycle. Any FRI 1.0 client can connect. With -v before the command it tells monitor and command mode and the
    reason of a drop, with -vv quality, drives and missing answers too.

    \b
    lwr-run emulator                             for Stanford's library, cycle as configured
    lwr-run emulator --program auto_start        command mode without a request, as KUKA's samples expect
    lwr-run emulator --program my_lab.src        a laboratory's own KRL program
    lwr-run -v emulator --period-ms 2 --fri-port 7001
    lwr-run emulator --json                      its ports as one JSON value, for a script
    """
    from sim_backend.configuration import read_settings
    from sim_backend.process import EmulatorProcess

    if program is not None and program.lower().endswith(".src"):
        # As every file of a command line, in the working folder; else beside the configuration.
        if not (Path(config).parent / program).is_file():
            PATH.require(Path(program))
        if Path(program).is_file():
            program = str(Path(program).resolve())
    emulator = EmulatorProcess(
        config,
        lock_step=lock_step,
        fri_host=fri_host,
        fri_port=fri_port,
        pendant_port=pendant_port,
        period_ms=period_ms,
        settings={**read_settings(settings), **({} if program is None else {"fri.program": program})},
        once=once,
        verbosity=min(2, int(context.find_root().params.get("verbose", 0))),
    )
    with emulator:
        ports = {"fri_host": fri_host, "fri_port": fri_port, "pendant_port": emulator.pendant_port}
        text = f"sends to {fri_host}:{fri_port}, pendant on 127.0.0.1:{emulator.pendant_port}; Ctrl-C ends it"
        try:
            tell(ports if as_json else text, as_json)
            status = emulator.wait()
        except KeyboardInterrupt:
            write("ended")
            return
    sys.exit(status)


@verb("completion")
@click.argument("shell", type=click.Choice(("bash", "zsh", "fish")))
@click.pass_context
def completion_command(context: click.Context, shell: str) -> None:
    """Print the completion script for SHELL.

    \b
    lwr-run completion bash >> ~/.bashrc
    lwr-run completion zsh >> ~/.zshrc
    lwr-run completion fish > ~/.config/fish/completions/lwr-run.fish
    """
    kind = get_completion_class(shell)
    assert kind is not None
    # The script is not tied to the version of the shell here; it may be for another computer.
    script = kind(context.find_root().command, {}, "lwr-run", "_LWR_RUN_COMPLETE")
    click.echo(script.source_template % script.source_vars())
