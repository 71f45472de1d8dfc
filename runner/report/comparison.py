"""The page of two models side by side: what differs, by how many standard deviations, and the errors of their runs."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

import numpy as np

from ident.diagnosis.outcome.statements import Number
from ident.estimation.compare import Comparison, Difference
from ident.model import DynamicModel
from runner.computer import versions
from runner.file_names import MODEL, SUMMARY
from runner.report.figure import Figure
from runner.report.folder import ResultFolder
from runner.report.markup import MOST_PERCENT, Cell, figure_html, paragraph, section, table
from runner.report.page import page_html
from runner.report.plot import Line, Mark, Panel, Points
from runner.report.verdicts import Level, Verdict

_NAMED = 3
# 95 % of a normal variable, in standard deviations.
_WITHIN = 1.96


@dataclass(frozen=True)
class ComparedModel:
    """One of the two models. place : model file, or a folder of results with one. name : short, on the page."""

    place: Path
    model: DynamicModel
    name: str

    @classmethod
    def both(
        cls, places: tuple[Path, Path], models: tuple[DynamicModel, DynamicModel]
    ) -> tuple[ComparedModel, ComparedModel]:
        """Both with names to tell them apart: of the arms, else the ends of their paths."""
        robots = models[0].robot, models[1].robot
        names = robots if all(robots) and robots[0] != robots[1] else short_names(*places)
        return cls(places[0], models[0], names[0]), cls(places[1], models[1], names[1])

    @property
    def file(self) -> Path:
        """The model file."""
        return self.place / MODEL if self.place.is_dir() else self.place


def short_names(first: Path, second: Path) -> tuple[str, str]:
    """The shortest ends of two paths that differ; a `model.yaml` goes with its folder, as every run has one."""
    parts = []
    for path in (Path(os.path.abspath(first)), Path(os.path.abspath(second))):
        own = path.parts
        parts.append((*own[:-2], "/".join(own[-2:])) if path.name == MODEL and len(own) > 2 else own)
    for count in range(1, max(map(len, parts)) + 1):
        ends = [Path(*own[-count:]).as_posix() for own in parts]
        if ends[0] != ends[1]:
            return ends[0], ends[1]
    return parts[0][-1], f"{parts[1][-1]} again"


def comparison_html(
    comparison: Comparison, joints: Sequence[str], pair: tuple[ComparedModel, ComparedModel]
) -> str:
    """The text of the page.

    joints : their names. pair : the two models; the torque errors are of those in a folder of results.
    """
    changed = [one for one in comparison.differences if one.name in comparison.significant]
    level, sentence = _verdict(comparison, changed)
    lines = [
        Verdict(one.name, _words(one), "no difference beyond chance", "look", "differences")
        for one in sorted(changed, key=lambda one: one.p)[:8]
    ]
    if math.isfinite(comparison.p):
        found = f"p = {comparison.p:.2g} by chance"
        lines.append(
            Verdict("all together", found, "p above 0.05", "good" if comparison.p > 0.05 else "look")
        )
    first, second = pair
    content = section("differences", "Differences", _figure(comparison, joints), _table(comparison, pair))
    runs = [one for one in pair if (one.place / SUMMARY).is_file()]
    if runs:
        content += section("errors", "Torque errors of the runs", *_errors(runs))
    only = [
        paragraph(f"Only in {side.name}: {' '.join(names)}")
        for side, names in ((first, comparison.only_first), (second, comparison.only_second))
        if names
    ]
    if only:
        content += section("only", "Only in one", *only)
    content += section("provenance", "Provenance", _provenance(pair))
    return page_html(
        "Comparison",
        escape(f"{first.name} and {second.name}"),
        (level, sentence),
        lines,
        content,
        [
            ("differences", "Differences"),
            ("errors", "Torque errors"),
            ("only", "Only in one"),
            ("provenance", "Provenance"),
        ],
        str(versions()["software"]),
    )


def _verdict(comparison: Comparison, changed: Sequence[Difference]) -> tuple[Level, str]:
    count = len(comparison.differences)
    if not math.isfinite(comparison.p):
        return "look", f"{count} parameters, no significance: a model has no covariance"
    if not changed:
        return "good", f"No difference beyond chance in {count} parameters"
    names = [one.name for one in sorted(changed, key=lambda one: one.p)]
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    return "look", f"{len(names)} of {count} parameters differ: {', '.join(names[:_NAMED])}{more}"


def _words(one: Difference) -> str:
    size = f" ({one.percent:+.1f} %)" if abs(one.percent) <= MOST_PERCENT else ""
    return f"{one.first:.4g} to {one.second:.4g} {one.unit}{size}, {abs(one.z):.1f} standard deviations"


def _table(comparison: Comparison, pair: tuple[ComparedModel, ComparedModel]) -> str:
    head = (
        "parameter",
        pair[0].name,
        "±",
        pair[1].name,
        "±",
        "unit",
        "difference [%]",
        "z",
        "verdict",
    )
    rows: list[list[Cell]] = []
    for one in comparison.differences:
        known = math.isfinite(one.percent)
        rows.append(
            [
                one.name,
                Number(one.first),
                Number(one.first_std, ".2g"),
                Number(one.second),
                Number(one.second_std, ".2g"),
                one.unit,
                Number(one.percent if known else None, ".1f", most=MOST_PERCENT),
                Number(one.z, ".1f"),
                "differs" if one.name in comparison.significant else "",
            ]
        )
    strong = [k for k, one in enumerate(comparison.differences) if one.name in comparison.significant]
    return table(head, rows, "Parameters of both models", strong=strong)


def _figure(comparison: Comparison, names: Sequence[str]) -> str:
    """Differences in standard deviations, a panel for each joint and one for the payload."""
    joints: dict[str, list[Difference]] = {}
    for one in comparison.differences:
        number = re.search(r"\d+", one.name)
        if number and math.isfinite(one.z):
            joints.setdefault(number[0], []).append(one)
    panels = []
    for joint, found in sorted(joints.items(), key=lambda item: int(item[0])):
        x, z = np.arange(1.0, len(found) + 1.0), np.array([one.z for one in found])
        span = np.array([0.5, len(found) + 0.5])
        marks: list[Mark] = [
            Points(
                "estimate",
                "difference with its 95 % interval",
                x,
                z,
                np.stack([z - _WITHIN, z + _WITHIN], axis=1),
            ),
            Line("limit", "no difference", span, np.zeros(2)),
        ]
        worst = max(found, key=lambda one: abs(one.z))
        title = names[int(joint) - 1] if int(joint) <= len(names) else "payload"
        alt = f"{title}: {len(found)} parameters; the largest difference is {worst.name}, z = {worst.z:.1f}."
        ticks = tuple(one.name for one in found)
        panels.append(Panel(title, "", "z", tuple(marks), alt, x_names=ticks))
    if not panels:
        return ""
    return figure_html(Figure("differences", "Differences in standard deviations", tuple(panels)), tall=True)


def _errors(runs: Sequence[ComparedModel]) -> list[str]:
    """Torque errors on held-out sessions, of each run with results."""
    rows: list[list[Cell]] = []
    for run in runs:
        summary = ResultFolder.load(run.place).summary
        for one in summary.get("validation") or []:
            error = one.get("torque_error") or {}
            shares = [error.get(side) for side in ("motor", "joint")]
            # Shares of the torque's root mean square.
            cells = [Number(None if share is None else 100.0 * share, ".2f") for share in shares]
            rows.append([run.name, str(one.get("session", "")), *cells])
    if not rows:
        return [paragraph("Neither run has a held-out session.")]
    head = ("run", "held-out session", "motor [%]", "joint [%]")
    return [table(head, rows, "Torque error of all samples on held-out sessions")]


def _provenance(pair: Sequence[ComparedModel]) -> str:
    """Where each model comes from."""
    rows: list[list[Cell]] = []
    for one in pair:
        known = one.model.provenance
        made = [str(known.get(key, "")) for key in ("estimator", "software")]
        logs = [log.get("file", "") if isinstance(log, dict) else log for log in known.get("sessions") or ()]
        rows.append([one.name, os.path.abspath(one.file), one.model.robot, *made, ", ".join(map(str, logs))])
    head = ("model", "file", "arm", "estimator", "software", "sessions")
    return table(head, rows, "The two models", classes="paths")
