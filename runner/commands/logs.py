"""Commands for session logs and results: info, recover, attach, import, report."""

from __future__ import annotations

from pathlib import Path

import click

from fri.errors import ConfigurationError
from lwr_driver.listing import Listing
from runner.output import OUTPUT_FILE, OUTPUT_FOLDER, check_file, check_folder, default_output, set_aside
from runner.status import answer
from runner.terminal import (
    NAMED_FILE,
    PATH,
    FiniteRange,
    forced,
    implied,
    json_option,
    tell,
    to_json,
    verb,
)


@verb("info")
@click.argument("session", type=PATH)
@json_option
def info_command(session: Path, as_json: bool) -> None:
    """Summarise a SESSION log: origin, duration, channels, lost samples.

    \b
    lwr-run info experiments/lwr4plus-20260101-120000/loaded.mcap
    """
    from lwr_driver.session import describe
    from runner.ending import of_session

    summary = describe(session)
    if as_json:
        click.echo(to_json(summary.as_dict()))
    else:
        of_session(summary).tell()


@verb("recover")
@click.argument("session", type=PATH)
@click.option("--out", type=OUTPUT_FILE, help="Recovered file; default: SESSION.recovered.mcap.")
@json_option
def recover_command(session: Path, out: Path | None, as_json: bool) -> None:
    """Repair the SESSION log of a killed recorder, as a new file.

    Everything up to the last complete chunk is kept. The result is read back as a check.

    \b
    lwr-run recover experiments/lwr4plus-20260101-120000/loaded.mcap
    """
    from lwr_driver.session import recover

    target = out if out is not None else default_output(session.with_suffix(".recovered.mcap"), forced())
    if target.resolve() == session.resolve():
        raise ConfigurationError(f"--out {target} is the damaged log itself; it is kept, choose another name")
    with set_aside(target):
        done = recover(session, target)
    tell(done, as_json)


@verb("attach")
@click.argument("session", type=PATH)
@click.argument("trace", type=PATH)
@click.option("--out", type=OUTPUT_FILE, help="New file; default with --force: SESSION itself.")
@click.option(
    "--tolerance-ms", type=FiniteRange(min=0.0, min_open=True), help="Largest accepted timing error."
)
@json_option
def attach_command(
    session: Path, trace: Path, out: Path | None, tolerance_ms: float | None, as_json: bool
) -> None:
    """Add the motor torques of a controller's TRACE file to a SESSION log.

    The trace has its own clock. It is aligned by the joint positions in both files, without resampling. Delay,
    clock rate and their uncertainty are printed and stored in the log.

    The file has a header and one line per sample: time_s, tau_m_A1 ... tau_m_A6 [Nm, after the gear],
    q_A1 ... q_A6 [rad].

    \b
    lwr-run attach loaded.mcap loaded.trace.csv --out traced.mcap
    lwr-run attach loaded.mcap loaded.trace.csv --force
    """
    from lwr_driver.session.trace import import_trace

    if out is None:
        check_file(session)
        if not forced():
            raise ConfigurationError(
                f"attach would change {session}; name a new file with --out, or change it with --force"
            )
    tolerance = None if tolerance_ms is None else tolerance_ms / 1000.0
    done = import_trace(session, trace, out, tolerance_s=tolerance)
    tell(done, as_json)


def _rows(context: click.Context, parameter: click.Parameter, value: str | None) -> tuple[int, int] | None:
    if value is None:
        return None
    first, mark, last = value.partition(":")
    if not mark or not first.isdigit() or not last.isdigit():
        raise click.BadParameter(f"{value!r} is no range of rows such as 0:24750", context, parameter)
    return int(first), int(last)


@verb("import")
@click.argument("mapping", type=NAMED_FILE)
@click.argument("source", type=PATH)
@click.argument("output", type=OUTPUT_FILE)
@click.option("--rows", callback=_rows, metavar="A:B", help="Rows A to B-1 only, counted from 0.")
@click.option("--payload", help="Name of the payload; `none`: the bare arm.")
@click.option(
    "--payload-mass",
    type=FiniteRange(0.0, 1000.0, min_open=True),
    metavar="KG",
    help="Weighed mass of the payload.",
)
@click.option("--serial", help="Serial number of the arm.")
@click.option("--urdf", type=PATH, help="URDF of the arm, instead of the mapping's.")
@click.option("--base", metavar="LINK", help="First link of the arm; gravity points down in its axes.")
@click.option("--tip", metavar="LINK", help="Last link of the arm; default: behind the last joint.")
@json_option
def import_command(
    mapping: str,
    source: Path,
    output: Path,
    rows: tuple[int, int] | None,
    payload: str | None,
    payload_mass: float | None,
    serial: str | None,
    urdf: Path | None,
    base: str | None,
    tip: str | None,
    as_json: bool,
) -> None:
    """Convert a recording (CSV, text, NPZ, MATLAB, ROS 2 bag) to a session log.

    MAPPING is a mapping file (columns, units, signs, gears, time base) or the name of one in configs/imports.
    SOURCE is the recording: a file, a bag, or the folder of the files named by the mapping. OUTPUT is the new log.
    All keys of a mapping are in docs/import_mapping.md; `lwr-run identify` guesses one from the names of columns.

    \b
    lwr-run import lwr4_flobaroid measurements_1.npz run_1.mcap
    lwr-run import tx40 recordings/tx40 tx40.mcap --rows 0:24750
    """
    from ident.import_log import LogMapping, import_log
    from ident.import_log.mapping import mapping_path

    if output.suffix != ".mcap":
        raise ConfigurationError(f"output {output}: a session log ends in .mcap")
    with set_aside(output):
        done = import_log(
            LogMapping.load(mapping),
            source,
            output,
            rows=rows,
            payload=payload,
            payload_mass=payload_mass,
            serial=serial,
            urdf=urdf,
            base=base,
            tip=tip,
            beside=mapping_path(mapping).parent,
        )
    tell(done, as_json)


@verb("report")
@click.argument("folder", type=PATH)
@click.option(
    "--figures",
    type=OUTPUT_FOLDER,
    metavar="FOLDER",
    help="Write figures and LaTeX tables for a paper to this folder instead.",
)
@click.option(
    "--format",
    "suffix",
    default="pdf",
    show_default=True,
    type=click.Choice(["pdf", "pgf", "svg", "png"]),
    help="Format of the figures.",
)
@click.option(
    "--width",
    default="ieee-wide",
    show_default=True,
    metavar="NAME|MM",
    help="Width of the figures: ieee, ifac (one column), ieee-wide, ifac-wide, or mm.",
)
@click.option("--columns", type=click.IntRange(1, 7), help="Panels side by side; default: as many as fit.")
@click.option(
    "--joints",
    default="numbers",
    show_default=True,
    type=click.Choice(["numbers", "names"]),
    help="Joints 1 to 7 or the names of the arm.",
)
@click.option("--statistics", is_flag=True, help="Write numbers such as the rms beside the titles.")
@json_option
def report_command(
    folder: Path,
    figures: Path | None,
    suffix: str,
    width: str,
    columns: int | None,
    joints: str,
    statistics: bool,
    as_json: bool,
) -> None:
    """Write report.html for the results in FOLDER, with a verdict on the run at the top.

    The page is one file and needs no network. Its plots zoom, its tables can be copied, and it has a print style
    for PDF. All files of the folder are read anew, a diagnosis.json too.

    With --figures FOLDER holds an experiment or a diagnosis; its figures fit the columns of IEEE or IFAC papers.

    \b
    lwr-run report experiments/lwr4plus-20260101-120000
    lwr-run report experiments/lwr4plus-20260101-120000 --figures paper --format pgf --width ifac
    lwr-run report experiments/lwr4plus-20260101-120000 --json          the verdicts, for a script
    """
    from runner.report.folder import ResultFolder

    if figures is None:
        from runner.ending import of_folder
        from runner.report.page import write_report
        from runner.report.verdicts import headline, verdicts
        from runner.status import StatusLine

        for name in ("suffix", "width", "columns", "joints", "statistics"):
            if not implied(name):
                option = "format" if name == "suffix" else name
                raise click.UsageError(f"--{option} is for figures; add --figures FOLDER")
        check_folder(folder)
        status = StatusLine()
        status.show("writing the report")
        page = write_report(folder)
        status.clear()
        lines = verdicts(ResultFolder.load(folder))
        level, sentence = headline(lines)
        content = {"report": page, "level": level, "headline": sentence, "verdicts": lines}
        if as_json:
            click.echo(to_json(content))
        else:
            rows = [(line.subject, line.level, line.found, line.wanted) for line in lines]
            of_folder(folder, page, [Listing(("question", "", "found", "wanted"), rows, 0)]).tell()
        return
    from runner.report.paper_folder import save_for_paper

    files = save_for_paper(
        folder,
        figures,
        suffix=f".{suffix}",
        width=float(width) if width.replace(".", "", 1).isdigit() else width,
        columns=columns,
        joints=joints,
        statistics=statistics,
    )
    if as_json:
        click.echo(to_json({"figures": files}))
    else:
        answer(*map(str, files))
