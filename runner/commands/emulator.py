"""`lwr-run emulator`: the emulated controller and arm, until interrupted."""

from __future__ import annotations

import sys

import click

from fri.errors import LwrError
from runner.options import json_option
from runner.plain import as_json as to_json
from sim_backend.process import EmulatorProcess


@click.command("emulator")
@click.argument("config", default="emulator/default.yaml")
@click.option("--fri-host", default="127.0.0.1", show_default=True, help="Address of the PC that commands.")
@click.option("--fri-port", default=49938, show_default=True, type=click.IntRange(1, 65535), help="Its port.")
@click.option(
    "--pendant-port", default=0, type=click.IntRange(0, 65535), help="Port of the pendant; 0: any free."
)
@click.option("--period-ms", type=click.FloatRange(1, 100), help="FRI cycle; default: as configured.")
@click.option("--seed", type=int, help="Seed of all randomness; default: as configured.")
@click.option(
    "--lock-step", is_flag=True, help="Own clock: one cycle for each answer, repeatable bit for bit."
)
@json_option
def command(
    config: str,
    fri_host: str,
    fri_port: int,
    pendant_port: int,
    period_ms: float | None,
    seed: int | None,
    lock_step: bool,
    as_json: bool,
) -> None:
    """Run the emulated controller and arm in real time until Ctrl-C.

    It behaves as the KRC of a KUKA LWR4+: it sends to --fri-host:--fri-port and expects an answer in each
    cycle. Any FRI 1.0 client can talk to it.

    \b
    lwr-run emulator                             the default arm at its configured cycle
    lwr-run emulator --period-ms 2 --fri-port 7001
    lwr-run emulator --json                      its ports as one JSON value, for a script
    """
    emulator = EmulatorProcess(
        config,
        lock_step=lock_step,
        fri_host=fri_host,
        fri_port=fri_port,
        pendant_port=pendant_port,
        period_ms=period_ms,
        seed=seed,
    )
    with emulator:
        ports = {"fri_host": fri_host, "fri_port": fri_port, "pendant_port": emulator.pendant_port}
        text = f"sends to {fri_host}:{fri_port}, pendant on 127.0.0.1:{emulator.pendant_port}; Ctrl-C ends it"
        try:
            click.echo(to_json(ports) if as_json else text)
            emulator.wait()
        except KeyboardInterrupt:
            click.echo("ended", err=True)
            return
        messages = emulator.messages().strip()
    if messages:
        raise LwrError(f"the emulator ended by itself: {messages.splitlines()[-1]}")
    sys.exit(0)
