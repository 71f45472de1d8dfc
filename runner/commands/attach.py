"""`lwr-run attach`: motor torques from a controller's trace file, added to a session log."""

from __future__ import annotations

from pathlib import Path

import click

from lwr_driver.session.trace import import_trace
from runner.options import json_option
from runner.plain import as_json as to_json


@click.command("attach")
@click.argument("session", type=click.Path(path_type=Path))
@click.argument("trace", type=click.Path(path_type=Path))
@click.option(
    "--out", type=click.Path(path_type=Path), help="New file; default: replace SESSION in one step."
)
@click.option(
    "--tolerance-ms", type=click.FloatRange(min=0.0, min_open=True), help="Largest timing error accepted."
)
@json_option
def command(session: Path, trace: Path, out: Path | None, tolerance_ms: float | None, as_json: bool) -> None:
    """Add the motor torques of a controller's TRACE file to a SESSION log.

    The trace has a clock of its own; it is aligned by the joint positions that both hold. Delay, clock rate
    and their uncertainty are printed and kept in the log. No sample is resampled.

    The file has one line a sample and a header: time_s, tau_m_A1 ... tau_m_A6 [Nm, after the gear],
    q_A1 ... q_A6 [rad].

    \b
    lwr-run attach loaded.mcap loaded.trace.csv
    """
    tolerance = None if tolerance_ms is None else tolerance_ms / 1000.0
    done = import_trace(session, trace, out, tolerance_s=tolerance)
    click.echo(to_json(done) if as_json else str(done))
