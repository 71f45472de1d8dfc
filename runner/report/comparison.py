"""The page of two models side by side: what differs, by how many standard deviations, and the errors of their runs."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from ident.estimation.compare import Comparison, Difference
from runner.computer import versions
from runner.report.figure import Figure
from runner.report.markup import Cell, Number, figure_html, paragraph, section, table
from runner.report.page import page_html
from runner.report.plot import Line, Mark, Panel, Points
from runner.report.verdicts import Level, Verdict

_NAMED = 3
# 95 % of a normal variable, in standard deviations.
_WITHIN = 1.96


def comparison_html(comparison: Comparison, joints: Sequence[str], runs: Mapping[str, Path]) -> str:
    """The text of the page.

    joints : their names. runs : folders of results by the label of their model, for their torque errors.
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
    content = section("differences", "Differences", _figure(comparison, joints), _table(comparison))
    if runs:
        content += section("errors", "Torque errors of the runs", *_errors(runs))
    for title, names in (
        (f"Only in {comparison.first}", comparison.only_first),
        (f"Only in {comparison.second}", comparison.only_second),
    ):
        if names:
            content += section("only", title, paragraph(" ".join(names)))
    return page_html(
        "Comparison",
        escape(f"{comparison.first} and {comparison.second}"),
        (level, sentence),
        lines,
        content,
        [("differences", "Differences"), ("errors", "Torque errors"), ("only", "Only in one")],
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
    size = f" ({one.percent:+.1f} %)" if math.isfinite(one.percent) else ""
    return f"{one.first:.4g} to {one.second:.4g} {one.unit}{size}, {abs(one.z):.1f} standard deviations"


def _table(comparison: Comparison) -> str:
    head = (
        "parameter",
        comparison.first,
        "±",
        comparison.second,
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
                Number(one.percent if known else None, ".1f"),
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


def _errors(runs: Mapping[str, Path]) -> list[str]:
    """Torque errors on held-out sessions, of each run with results."""
    rows: list[list[Cell]] = []
    for label, folder in runs.items():
        summary: dict[str, Any] = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
        for one in summary.get("validation") or []:
            error = one.get("torque_error") or {}
            shares = [error.get(side) for side in ("motor", "joint")]
            # Shares of the torque's root mean square.
            cells = [Number(None if share is None else 100.0 * share, ".2f") for share in shares]
            rows.append([label, str(one.get("session", "")), *cells])
    if not rows:
        return [paragraph("Neither run has a held-out session.")]
    head = ("run", "held-out session", "motor [%]", "joint [%]")
    return [table(head, rows, "Torque error of all samples on held-out sessions")]
