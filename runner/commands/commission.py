"""`lwr-run commission`: the healthy arm, for later diagnoses to be held against."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import click

__all__ = ["command"]


@click.command("commission")
@click.argument("sessions", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "--sets",
    default=1,
    show_default=True,
    type=click.IntRange(1),
    help="Number of sets that SESSIONS are made of, in their order, each as a diagnosis will get them.",
)
@click.option("--out", required=True, type=click.Path(path_type=Path), help="Model file of the healthy arm.")
@click.option("--arm", help="Arm file (stiffness, gear ratios); default: the one of the sessions' robot.")
@click.option(
    "--urdf", type=click.Path(path_type=Path), help="Kinematics; default: the one in the first session."
)
def command(sessions: tuple[Path, ...], sets: int, out: Path, arm: str | None, urdf: Path | None) -> None:
    """Learn the healthy arm from SESSIONS: its parameters, stiffness, delays, noise, and what
    chance looks like.

    The more sets of sessions, the better known is what each cause may seem to explain where nothing is wrong:
    one set is a beginning, eight are good.

    \b
    lwr-run commission unloaded.mcap loaded.mcap --out commissioned.yaml
    lwr-run commission u1.mcap l1.mcap u2.mcap l2.mcap --sets 2 --out commissioned.yaml
    """
    from fri.errors import ConfigurationError
    from ident.discrepancy import commission
    from ident.model_file import write_model
    from lwr_driver.session import read_session
    from runner.diagnosis import arm_data, chain_of, known_arm

    if len(sessions) % sets:
        raise ConfigurationError(
            f"{len(sessions)} sessions do not make {sets} sets of equal size; give them set after set"
        )
    logs = [read_session(path) for path in sessions]
    chain = chain_of(logs, urdf)
    size = len(logs) // sets
    parts = [logs[k : k + size] for k in range(0, len(logs), size)]
    found = commission(parts, chain, arm=arm_data(known_arm(arm, chain)))
    write_model(replace(found.model, provenance={**found.model.provenance, **found.stored()}), out)
    loudest = sorted(found.null.items(), key=lambda item: -item[1])[:5]
    click.echo(f"Commissioned from {len(logs)} sessions in {sets} set{'s' if sets > 1 else ''}")
    click.echo(
        f"  delays: motor torque {1e3 * found.motor_delay_s:.2f} ms, "
        f"joint torque {1e3 * found.joint_delay_s:.2f} ms"
    )
    for side, values in found.noise.items():
        click.echo(f"  noise of a row, {side:<6} " + "".join(f"{v:>9.4f}" for v in values) + " Nm")
    for (cause, joint), gain in loudest:
        where = f" joint {joint + 1}" if joint >= 0 else ""
        click.echo(f"  largest gain by chance: {cause}{where} {gain:.1f}")
    click.echo(str(out))
