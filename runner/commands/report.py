"""`lwr-run report`: the report of a finished experiment, and its figures as SVG."""

from __future__ import annotations

from pathlib import Path

import click

from runner.options import json_option
from runner.plain import as_json as to_json

__all__ = ["command"]


@click.command("report")
@click.argument("folder", type=click.Path(path_type=Path))
@click.option(
    "--svg",
    type=click.Path(path_type=Path),
    metavar="FOLDER",
    help="Write the figures as SVG files for papers into this folder instead.",
)
@click.option(
    "--columns", default=2, show_default=True, type=click.IntRange(1, 7), help="Panels side by side."
)
@click.option(
    "--width", default=720, show_default=True, type=click.IntRange(200, 3000), help="Of an SVG [px]."
)
@json_option
def command(folder: Path, svg: Path | None, columns: int, width: int, as_json: bool) -> None:
    """Write report.html into the FOLDER of an experiment; its first screen says whether the run was good.

    The page is one file that needs no network: plots to zoom into, tables to copy from, and a print style, so
    that a browser makes a PDF of it. What lies in the folder is read again each time, a diagnosis.json too.

    \b
    lwr-run report experiments/lwr4plus-20260101-120000
    lwr-run report experiments/lwr4plus-20260101-120000 --svg figures --columns 1 --width 420
    lwr-run report experiments/lwr4plus-20260101-120000 --json          the verdicts, for a script
    """
    from runner.report.folder import ResultFolder

    if svg is None:
        from runner.report.page import write_report
        from runner.report.verdicts import headline, verdicts

        page = write_report(folder)
        lines = verdicts(ResultFolder.load(folder))
        level, sentence = headline(lines)
        content = {"report": page, "level": level, "headline": sentence, "verdicts": lines}
        click.echo(to_json(content) if as_json else f"{sentence}\n{page}")
        return
    from runner.report.figures import every_figure

    results = ResultFolder.load(folder)
    svg.mkdir(parents=True, exist_ok=True)
    files = [
        figure.save(svg / f"{figure.name}.svg", columns=columns, width=float(width))
        for figure in every_figure(results)
    ]
    click.echo(to_json({"figures": files}) if as_json else "\n".join(map(str, files)))
