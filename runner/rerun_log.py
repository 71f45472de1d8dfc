"""A session log with a layout of its own for the Rerun viewer: `python -m runner.rerun_log LOG [--save FILE.rrd]`.

Rerun reads the MCAP file by itself; the layout adds the arm in 3D, positions, torques and the phases of the motion.
Needs `pip install 'rerun-sdk>=0.30,<1'`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from fri.errors import ConfigurationError, LwrError

APPLICATION = "lwr-identification"


def layout() -> Any:
    """The `rerun.blueprint.Blueprint`: the arm beside joint torque, motor torque, position and phase over time."""
    blueprint = _rerun("rerun.blueprint")
    plots = [
        blueprint.TimeSeriesView(origin="/", contents=[path], name=name)
        for name, path in (
            ("joint torque [Nm]", "/joint_states/effort"),
            ("motor torque [Nm]", "/motor_states/effort"),
            ("position [rad]", "/joint_states/position"),
        )
    ]
    arm = blueprint.Spatial3DView(
        origin="/", contents=["/lwr4plus/visual_geometries/**", "/tf"], name="the arm"
    )
    phase = blueprint.TextDocumentView(origin="/experiment/phase", name="phase")
    return blueprint.Blueprint(
        blueprint.Horizontal(
            blueprint.Vertical(arm, phase, row_shares=[5, 1]),
            blueprint.Vertical(*plots),
            column_shares=[2, 3],
        ),
        collapse_panels=True,
    )


def open_log(log: str | Path, save: str | Path | None = None) -> None:
    """Show a log in the viewer, or write it with its layout to an .rrd file.

    ConfigurationError without the log, for another suffix than .rrd, or without rerun-sdk.
    """
    source = Path(log)
    if not source.is_file():
        raise ConfigurationError(f"{source}: no such log; name a session's .mcap file")
    if save is not None and Path(save).suffix != ".rrd":
        raise ConfigurationError(f"{save}: a recording for Rerun ends in .rrd")
    rerun = _rerun("rerun")
    rerun.init(APPLICATION, recording_id=source.stem, spawn=save is None)
    if save is not None:
        rerun.save(str(save), default_blueprint=layout())
    else:
        rerun.send_blueprint(layout())
    rerun.log_file_from_path(str(source))
    rerun.disconnect()


def _rerun(module: str) -> Any:
    from importlib import import_module

    try:
        return import_module(module)
    except ImportError as error:
        raise ConfigurationError(
            "Rerun: rerun-sdk is not installed; run `pip install 'rerun-sdk>=0.30,<1'`"
        ) from error


@click.command()
@click.argument("log", type=click.Path(path_type=Path))
@click.option(
    "--save", type=click.Path(path_type=Path), help="Write an .rrd file instead of opening the viewer."
)
def main(log: Path, save: Path | None) -> None:
    """Open the session LOG in Rerun with its layout."""
    try:
        open_log(log, save)
    except LwrError as error:
        raise click.ClickException(str(error)) from error


if __name__ == "__main__":
    main()
