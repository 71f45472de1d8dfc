"""Everything of a folder for a paper: figures in one format, tables in LaTeX."""

from __future__ import annotations

from pathlib import Path

from fri.errors import ConfigurationError
from runner.file_names import DIAGNOSIS, SUMMARY
from runner.report.diagnosis import DiagnosisFolder, diagnosis_paper_figures
from runner.report.figure import Figure, MatrixFigure
from runner.report.figures import every_figure
from runner.report.folder import ResultFolder
from runner.report.latex import save_tables
from runner.report.paper import SUFFIXES, width_mm


def save_for_paper(
    folder: str | Path,
    target: str | Path,
    *,
    suffix: str = ".pdf",
    width: str | float = "ieee-wide",
    columns: int | None = None,
    joints: str = "numbers",
    statistics: bool = False,
) -> list[Path]:
    """Write the figures and tables of an experiment or of a diagnosis into the folder `target`; returns the files.

    suffix : of the figures. width, columns, statistics : as of `Figure.save`. joints : `numbers` or `names`.
    ConfigurationError for a wrong format or width, or a folder without results.
    """
    source, place = Path(folder), Path(target)
    if suffix not in SUFFIXES:
        raise ConfigurationError(f"figures: format {suffix!r} is none of {', '.join(SUFFIXES)}")
    width_mm(width)
    if place.exists() and not place.is_dir():
        raise ConfigurationError(f"figures: {place} is a file; name a folder")
    figures: list[Figure | MatrixFigure] = []
    results, diagnosis = None, None
    if (source / SUMMARY).is_file() or not (source / DIAGNOSIS).is_file():
        results = ResultFolder.load(source)
        figures += every_figure(results, joints=joints)
        diagnosis = DiagnosisFolder.of(results)
    else:
        diagnosis = DiagnosisFolder.load(source)
    if diagnosis is not None:
        figures += diagnosis_paper_figures(diagnosis, joints=joints)
    place.mkdir(parents=True, exist_ok=True)
    files = [
        one.save(place / f"{one.name}{suffix}", width, columns=columns, statistics=statistics)
        for one in figures
    ]
    return files + (save_tables(results, place) if results is not None else [])
