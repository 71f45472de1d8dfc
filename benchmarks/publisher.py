"""Rate of the motor currents published by the KRL program, and what its statements cost.

    python -m benchmarks.publisher

The emulated controller runs configs/krl/lwr_identification.src in its own time. No document gives the speed of the
interpreter of a KR C2 lr, so its time of a statement is varied. `pass` is what the program itself publishes in
`$FRI_TO_REA[12]`, `rate` counts new counts in a second of packets.
"""

from __future__ import annotations

from pathlib import Path

import click
import numpy as np

from fri.krc import KrcLimits, KrcSession, Sample
from fri.krl import Interpreter
from fri.packets import MSR, new_cmd
from fri.states import State
from lwr_driver.arm import Arm
from sim_backend.program import krl_program

__all__ = ["measure"]

_PERIOD_MS = 1
_STATEMENTS_MS = (0.0, 0.02, 0.05, 0.1, 0.2, 0.5)


def measure(
    statement_ms: float, wait_s: float, *, currents: bool = True, seconds: float = 10.0
) -> tuple[float, float]:
    """Rate of new values [1/s] and time of a pass [ms], in monitor mode with a client that answers."""
    arm = Arm.load()
    session = KrcSession(KrcLimits(arm.q_min, arm.q_max, arm.v_max, arm.a_max), np.zeros(7))
    settings = {"LWR_WAIT": wait_s, "LWR_CURRENTS": currents}
    program = krl_program("lwr_identification", _PERIOD_MS, statement_ms=statement_ms, **settings)
    interpreter = Interpreter(session, program)
    command, sample = new_cmd(), Sample()
    command["cmd_flags"] = 1
    counts = []
    last = np.zeros((), MSR)
    while len(counts) < round(1000.0 * seconds / _PERIOD_MS):
        if session.state is not State.OFF:
            last = np.frombuffer(session.packet(sample), MSR).reshape(())
            command["jnt_pos"] = last["cmd_jnt_pos"] + last["cmd_jnt_pos_fri_offset"]
            command["refl_seq"] = last["send_seq"]
            session.receive(command.tobytes())
            counts.append(int(last["krl_int"][0]))
        session.close_cycle()
        interpreter.advance(_PERIOD_MS)
    half = len(counts) // 2
    rate = (counts[-1] - counts[half]) / ((len(counts) - 1 - half) * _PERIOD_MS * 1e-3)
    return rate, float(last["krl_real"][11])


@click.command()
@click.option("--out", type=click.Path(path_type=Path), help="Write the table to a file, too.")
def main(out: Path | None) -> None:
    """Print the table."""
    lines = [
        "| time of a statement [ms] | wait 0.002 s: rate [1/s] | pass [ms] | wait 0.012 s: rate | pass | without "
        "currents, wait 0.002 s: pass |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for statement_ms in _STATEMENTS_MS:
        short, long = measure(statement_ms, 0.002), measure(statement_ms, 0.012)
        bare = measure(statement_ms, 0.002, currents=False)[1]
        figures = (short[0], short[1], long[0], long[1], bare)
        lines.append(f"| {statement_ms:g} | " + " | ".join(f"{value:.1f}" for value in figures) + " |")
    text = "\n".join(lines)
    click.echo(text)
    if out is not None:
        out.write_text(text + "\n")


if __name__ == "__main__":
    main()
