"""The end of a command on the screen: one sentence, a few numbers, and where to look next."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from shlex import quote
from typing import Any

import numpy as np

from ident.diagnosis.statements import Statements
from ident.estimation.scores import by_side
from runner import status
from runner.report.folder import ResultFolder
from runner.report.verdicts import Level, Verdict, headline, verdicts
from runner.terminal import verbosity


@dataclass(frozen=True)
class Ending:
    """The end of a command.

    numbers : name and value. look : verdicts to look at. advice : sentences before the next step. next_step : a shell
    command. tables : the whole text, for `--verbose`.
    """

    level: Level
    sentence: str
    numbers: Sequence[tuple[str, str]] = ()
    look: Sequence[Verdict] = ()
    advice: Sequence[str] = ()
    next_step: str = ""
    tables: str = ""

    def tell(self) -> None:
        """Write the end to standard output, the last line being the next step."""
        out = sys.stdout
        if verbosity() and self.tables:
            status.write(f"{self.tables.rstrip()}\n", stream=out)
        status.write(self.sentence, f"bold {status.STYLES[self.level]}", stream=out)
        for verdict in self.look:
            wanted = f" (wanted: {verdict.wanted})" if verdict.wanted else ""
            text = f"  {verdict.subject}: {verdict.found}{wanted}"
            status.write(text, status.STYLES[verdict.level], stream=out)
        width = max((len(name) for name, _ in self.numbers), default=0)
        for name, value in self.numbers:
            status.write(f"  {name:<{width}}  {value}", stream=out)
        for text in self.advice:
            status.write(text, stream=out)
        if self.next_step:
            status.write(self.next_step, "bold", stream=out, command=True)


def numbers_of(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Torque error, parameters and payload of a summary, as far as they are there.

    summary : content of summary.json, or `Identification.to_dict()` with `validation`.
    """
    found = []
    held = [one for one in summary.get("validation") or () if not one.get("seen")]
    scored = held or list(summary.get("fit") or ())
    if scored:
        worst = max(scored, key=lambda one: max(one["torque_error"].values()))
        kind = "held-out data" if held else "data of the estimate"
        found.append(("torque error", f"{by_side(worst['torque_error'])} on {kind}"))
    counts, essential = summary.get("counts"), summary.get("essential")
    if counts:
        text = f"{counts['base']} estimated"
        if essential:
            text += f", {essential['count']} essential"
        listed = (essential or {}).get("parameters") or [
            one for one in summary["parameters"] if not essential or one["name"] in essential["names"]
        ]
        rsd = [one["rsd_percent"] for one in listed if one.get("rsd_percent") is not None]
        text += f", median relative std {float(np.median(rsd)):.2g} %" if rsd else ""
        found.append(("parameters", text))
    masses = [one for one in summary.get("parameters", ()) if _is_mass(one["name"])]
    if masses:
        text = ", ".join(_spread(one["estimate"], one["std"]) for one in masses)
        found.append(("payload mass", text))
    elif "condition" in summary:
        found.append(("condition number", f"{summary['condition']:.4g}"))
    return found


def of_estimate(content: Mapping[str, Any], model: Path | None, tables: str) -> Ending:
    """The end of an estimate without a folder of results. content : of `Identification.to_dict`."""
    names = [one["name"] for one in content["sessions"]]
    sentence = f"Model {content['model']} estimated from {len(names)} session{'s' * (len(names) > 1)}."
    warnings = content.get("warnings") or ()
    advice = [] if verbosity() else ["`--verbose` shows the tables, `--results FOLDER` writes a report"]
    next_step = "" if model is None else f"lwr-run validate {quote(str(model))} HELD_OUT.mcap"
    look = [Verdict("warning", text, "", "look") for text in warnings]
    return Ending("look" if look else "good", sentence, numbers_of(content), look, advice, next_step, tables)


def of_diagnosis(said: Statements, page: Path | None, folder: Path, tables: str) -> Ending:
    """The end of a diagnosis with results in `folder`."""
    shown = [line for line in said.lines if line.anchor != "limits"]
    numbers = [(line.subject, line.found) for line in shown if line.level == "good"]
    look = [
        Verdict(line.subject, line.found, line.wanted, line.level) for line in shown if line.level != "good"
    ]
    next_step = open_page(page if page is not None else folder / "diagnosis.txt")
    return Ending(said.level, f"{said.headline}.", numbers, look, said.answers, next_step, tables)


def _is_mass(name: str) -> bool:
    return name[:1] == "M" and name[1:].isdigit()


def _spread(mass: float, std: float) -> str:
    digits = max(0, -math.floor(math.log10(std))) if std > 0.0 and math.isfinite(std) else 4
    return f"{mass:.{digits}f} ± {std:.{digits}f} kg"


def open_page(page: Path) -> str:
    """The shell command that opens a page."""
    return f"open {quote(str(page))}"


def of_folder(
    folder: Path, page: Path | None, tables: str = "", more: Sequence[str] = (), advice: Sequence[str] = ()
) -> Ending:
    """The end of a run with results in `folder`. page : its report. more : sentences after the verdict."""
    results = ResultFolder.load(folder)
    lines = verdicts(results)
    level, sentence = headline(lines)
    numbers = dict(numbers_of(results.summary))
    numbers |= {line.subject: line.found for line in lines if line.subject in numbers}
    return Ending(
        level,
        ". ".join([sentence, *more]) + ".",
        tuple(numbers.items()),
        [line for line in lines if line.level != "good"],
        advice,
        open_page(page if page is not None else folder / "report.txt"),
        tables,
    )
