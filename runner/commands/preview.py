"""`lwr-run preview`: the planned motion in 3D, before anything moves."""

from __future__ import annotations

from pathlib import Path

import click

from runner.experiment_file import DEFAULT
from runner.options import json_option
from runner.plain import as_json as to_json

__all__ = ["command"]


@click.command("preview")
@click.argument("file", default=DEFAULT)
@click.option("--session", metavar="NAME", help="Session of the experiment; default: the heaviest payload.")
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    default=Path("preview.html"),
    show_default=True,
    help="The page to write.",
)
@click.option(
    "--serve", "serving", is_flag=True, help="Serve the scene with play and time slider until Ctrl-C instead."
)
@click.option("--port", default=8080, show_default=True, type=click.IntRange(1, 65535), help="Of --serve.")
@json_option
def command(file: str, session: str | None, out: Path, serving: bool, port: int, as_json: bool) -> None:
    """Show the motion of an experiment FILE, of a folder of results, or of a plan file in 3D. Nothing moves.

    The page is one file that needs no network. It shows the arm along the motion, the path of its flange
    coloured by clearance, the tightest moment, and every limit with what the motion uses of it.

    \b
    lwr-run preview my_lab.yaml
    lwr-run preview my_lab.yaml --session unloaded --out unloaded.html
    lwr-run preview experiments/lwr4plus-20260101-120000 --serve
    """
    from runner.preview import planned_motion, preview_html, serve

    planned = planned_motion(file, session=session)

    def tell(place: str) -> None:
        if as_json:
            click.echo(to_json({**planned.facts(), "place": place}))
            return
        click.echo(f"{planned.title}: {planned.motion.duration_s:.1f} s, tightest moment {planned.tightest}")
        for item in planned.preflight.items:
            if not item.ok:
                click.echo(str(item))
        click.echo(place)

    if serving:
        serve(planned, port, tell)
        return
    out.write_text(preview_html(planned), encoding="utf-8")
    tell(str(out))
