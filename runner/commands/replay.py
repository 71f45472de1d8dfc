"""`lwr-run replay`: a session beside its simulation in 3D, or as a video."""

from __future__ import annotations

from pathlib import Path

import click

from runner.output import OUTPUT_FILE
from runner.terminal import NAMED_FILE, PATH, FiniteRange, json_option, to_json, verb


@verb("replay")
@click.argument("source", type=PATH)
@click.option("--session", metavar="NAME", help="Session of the folder; default: the held-out one.")
@click.option("--model", type=PATH, help="Model file; default: model.yaml beside the log.")
@click.option("--extended", type=PATH, help="Extended model; default: that of the diagnosis beside the log.")
@click.option("--arm", type=NAMED_FILE, help="Arm file; default: the one with the joints of the model.")
@click.option(
    "--longest-s", default=20.0, show_default=True, type=FiniteRange(2.0, 600.0), help="Simulated part."
)
@click.option("--port", default=8080, show_default=True, type=click.IntRange(1, 65535), help="Of the page.")
@click.option("--out", type=OUTPUT_FILE, help="Write a video, .mp4 or .gif, instead of serving a page.")
@click.option(
    "--length-s", default=10.0, show_default=True, type=FiniteRange(0.5, 300.0), help="Of the video."
)
@json_option
def command(
    source: Path,
    session: str | None,
    model: Path | None,
    extended: Path | None,
    arm: str | None,
    longest_s: float,
    port: int,
    out: Path | None,
    length_s: float,
    as_json: bool,
) -> None:
    """Show a session beside its simulation. SOURCE is a folder of results or a session log.

    The measured arm is solid, the simulated one a ghost with its deviation enlarged; links are coloured by the torque
    error of their joints. The page, served until Ctrl-C, has a time slider, the speed, and the choice of base and
    extended model; a video shows both side by side.

    \b
    lwr-run replay experiments/lwr4plus-20260101-120000
    lwr-run replay experiments/lwr4plus-20260101-120000 --session loaded --out loaded.mp4
    lwr-run replay loaded.mcap --model model.yaml --extended diagnosis/model_extended.yaml
    """
    from runner.replay_video import check_format, write_video
    from runner.replay_view import motion_replay, serve
    from runner.status import StatusLine, next_step

    if out is not None:
        check_format(out)
    status = StatusLine()
    status.show("simulating the session")
    shown = motion_replay(
        source, session=session, model=model, extended=extended, arm=arm, longest_s=longest_s
    )
    status.clear()

    def tell(place: str) -> None:
        if as_json:
            click.echo(to_json({**shown.facts(), "place": place}))
            return
        for note in shown.notes:
            status.say(note)
        next_step(place)

    if out is None:
        serve(shown, port, tell)
        return
    write_video(shown, out, length_s, lambda share: status.show("drawing the video", share))
    status.clear()
    tell(str(out))
