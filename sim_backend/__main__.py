"""Run the emulator: ``python -m sim_backend emulator/default.yaml --fri-port 49938``."""

from __future__ import annotations

import json
import logging
import os
import signal
import sys
from typing import Any

# Ctrl-C at a terminal goes to all its processes. A child ends with its parent instead, from its first imports on.
if "--follow-stdin" in sys.argv:
    signal.signal(signal.SIGINT, signal.SIG_IGN)

import click

from fri.errors import ConfigurationError, LwrError
from sim_backend.configuration import load_configuration, read_settings
from sim_backend.service import Service


@click.command()
@click.argument("config", default="emulator/default.yaml")
@click.option(
    "--lock-step/--real-time", default=False, help="Own clock, one cycle per answer; or the wall's."
)
@click.option("--fri-host", default="127.0.0.1", show_default=True, help="Where the PC's end listens.")
@click.option("--fri-port", default=49938, show_default=True, help="Its port.")
@click.option("--pendant-port", default=0, help="Port of the pendant on 127.0.0.1; 0 takes a free one.")
@click.option("--period-ms", type=float, help="FRI cycle, 1 to 100 ms, instead of the configured one.")
@click.option("--seed", type=int, help="Seed of everything random, instead of the configured one.")
@click.option(
    "--set", "settings", multiple=True, metavar="KEY=VALUE", help="Replace a key, e.g. robot.payload=none."
)
@click.option("--follow-stdin", is_flag=True, help="End when standard input ends.")
@click.option("--announce", is_flag=True, help="Print the pendant's port as one line of JSON.")
@click.option("--once", is_flag=True, help="Lock step: end when the client has left.")
@click.option("--seat", type=int, hidden=True, help="Descriptor for the driver's loop in this process.")
@click.option("-v", "--verbose", count=True, help="Tell the session's events; twice: finer changes too.")
def main(
    config: str,
    lock_step: bool,
    fri_host: str,
    fri_port: int,
    pendant_port: int,
    period_ms: float | None,
    seed: int | None,
    settings: tuple[str, ...],
    follow_stdin: bool,
    announce: bool,
    once: bool,
    seat: int | None,
    verbose: int,
) -> None:
    """Emulate a KUKA LWR4+ and its controller: talks FRI over UDP to the PC, and has a pendant."""
    level = (logging.WARNING, logging.INFO, logging.DEBUG)[min(verbose, 2)]
    logging.basicConfig(level=level, format="%(name)s: %(message)s")
    logging.getLogger("numba").setLevel(logging.WARNING)
    try:
        overrides = _overrides(settings, period_ms, seed)
        follow = sys.stdin.fileno() if follow_stdin else None
        service = Service(
            load_configuration(config, overrides),
            (fri_host, fri_port),
            pendant_port,
            follow=follow,
            once=once,
            seat=seat if lock_step else None,
        )
        try:
            signal.signal(signal.SIGTERM, lambda *_: service.stop())
            # Ctrl-C at a terminal goes to all its processes. A child ends with its parent instead, after the
            # parent has braked the arm.
            signal.signal(signal.SIGINT, signal.SIG_IGN if follow_stdin else lambda *_: service.stop())
            # As Ctrl-C, Ctrl-Z and Ctrl-\ are for the command above: it brakes the arm, and needs it for that.
            for name in ("SIGTSTP", "SIGQUIT"):
                if follow_stdin and hasattr(signal, name):
                    signal.signal(getattr(signal, name), signal.SIG_IGN)
            if announce:
                click.echo(json.dumps({"pendant_port": service.pendant.port}))
            else:
                click.echo(
                    f"emulator: FRI to {fri_host}:{fri_port} in {'lock step' if lock_step else 'real time'}, "
                    f"pendant on 127.0.0.1:{service.pendant.port}, Ctrl-C ends it"
                )
            service.run(lock_step)
        finally:
            service.close()
    except LwrError as error:
        click.echo(f"error: {error}", err=True)
        sys.exit(error.exit_code)


def _overrides(settings: tuple[str, ...], period_ms: float | None, seed: int | None) -> dict[str, Any]:
    overrides = read_settings(settings)
    if period_ms is not None:
        if period_ms != int(period_ms):
            raise ConfigurationError(f"--period-ms {period_ms:g} is no whole number of milliseconds")
        overrides["fri.period_ms"] = int(period_ms)
    if seed is not None:
        overrides["seed"] = seed
    return overrides


if __name__ == "__main__":
    # Last, so that a file of the working folder adds effects of a lab but replaces no module.
    sys.path.append(os.getcwd())
    main()
