"""Pages of a fleet: one arm over its days, or all arms."""

from __future__ import annotations

from html import escape

import numpy as np

from ident.diagnosis.outcome.statements import Number
from ident.monitoring import Series
from ident.monitoring.changes import LEAST_DAYS
from runner.computer import versions
from runner.fleet.days import as_day
from runner.fleet.trend import ArmTrend, FleetTrend, Named
from runner.report.figure import Figure
from runner.report.markup import Cell, figure_html, fold, paragraph, section, table
from runner.report.page import page_html
from runner.report.plot import Line, Mark, Panel, Points
from runner.report.verdicts import Level, Verdict

UNDATED_ADVICE = "put the date into their path, such as 2026-03-12/"
_HEAD = ("quantity", "course", "since", "before", "after", "unit", "change [%]", "chance")


def arm_html(trend: ArmTrend) -> str:
    """The page of an arm: changes, findings, and every quantity over the days."""
    changed = {one.change.name for one in trend.changes}
    parts = [("changes", "Changes"), ("findings", "Findings"), ("days", "All quantities")]
    content = section(
        "changes", "Changes", _changes_table(trend.changes, trend.doubt), _panels(trend, changed)
    )
    if trend.findings:
        rows: list[list[Cell]] = [
            [
                row["key"],
                row["cause"],
                row["joints"] or "arm",
                Number(row["confidence"], ".2f"),
                row["statement"],
            ]
            for row in trend.first_findings.values()
        ]
        head = ("first day", "cause", "joints", "confidence", "statement")
        content += section("findings", "Findings", table(head, rows, "Findings with their first day"))
    rest = {name for name in trend.series if name not in changed}
    content += section("days", "All quantities", fold(f"{len(rest)} without a change", _panels(trend, rest)))
    level, sentence = _verdict(trend)
    return page_html(
        trend.arm,
        escape(f"{trend.arm} over {trend.count} day{'s' * (trend.count != 1)}"),
        (level, sentence),
        _lines(trend),
        content,
        parts,
        str(versions()["software"]),
    )


def fleet_html(fleet: FleetTrend) -> str:
    """The page of all arms: who changed, and who is unlike the others."""
    rows: list[list[Cell]] = []
    for arm in fleet.arms:
        first = str(arm.changes[0]) if arm.changes else "–"
        found = next((row["statement"] for row in arm.first_findings.values()), "–")
        counts = [Number(float(count), ".0f") for count in (arm.count, len(arm.changes))]
        rows.append([arm.arm, *counts, first, found])
    head: tuple[str, ...] = ("arm", "days", "changes", "first change", "first finding")
    content = section("arms", "Arms", table(head, rows, "All arms"))
    strange: list[list[Cell]] = [
        [
            one.arm,
            one.name,
            Number(one.value),
            Number(one.median),
            Number(one.spread, ".2g"),
            Number(one.p, ".1g"),
        ]
        for one in fleet.strange
    ]
    if strange:
        head = ("arm", "quantity", "value", "median of all", "spread", "chance")
        content += section("unlike", "Unlike the others", table(head, strange, "Arms unlike the others"))
    moved = [arm for arm in fleet.arms if arm.changes]
    for arm in moved:
        names = {one.change.name for one in arm.changes}
        content += section(f"arm-{arm.arm}", arm.arm, _panels(arm, names))
    lines = [Verdict(arm.arm, _verdict(arm)[1], "no change", "look", f"arm-{arm.arm}") for arm in moved]
    for arm in fleet.arms:
        for name, day in arm.new_payloads.items():
            lines.append(Verdict(arm.arm, f"payload {name} since {day}", "as before", "look", "arms"))
    short = [arm for arm in fleet.arms if arm.doubt and not arm.changes]
    lines += [Verdict(arm.arm, arm.doubt, f"at least {LEAST_DAYS} days", "look", "arms") for arm in short]
    undated = [arm.arm for arm in fleet.arms if arm.undated]
    if undated:
        lines.append(Verdict("undated logs", f"of {', '.join(undated)}", UNDATED_ADVICE, "look", "arms"))
    lines += [
        Verdict(one.arm, f"unlike the others in {one.name}", "like the others", "look", "unlike")
        for one in fleet.strange
    ]
    counted = len(fleet.arms) - len(short)
    sentence = f"{len(moved) or 'none'} of {counted} arms changed" if counted else "no change can be told"
    if short:
        sentence += f"; {len(short)} of {len(fleet.arms)} arms have too few days, {LEAST_DAYS} are needed"
    return page_html(
        "Fleet",
        escape(f"Fleet of {len(fleet.arms)} arms"),
        ("look" if lines else "good", sentence),
        lines,
        content,
        [("arms", "Arms"), ("unlike", "Unlike the others")],
        str(versions()["software"]),
    )


def _verdict(trend: ArmTrend) -> tuple[Level, str]:
    if not trend.changes and trend.doubt:
        return "look", trend.doubt
    if not trend.changes:
        return "good", f"no change in {trend.count} days beyond the scatter from day to day"
    first = trend.changes[0]
    more = len(trend.changes) - 1
    return "look", f"{first}" + (f", and {more} more" if more else "")


def _lines(trend: ArmTrend) -> list[Verdict]:
    lines = [Verdict(one.change.name, str(one), "no change", "look", "changes") for one in trend.changes[:8]]
    for name, day in trend.new_payloads.items():
        lines.append(Verdict("payload", f"{name} since {day}", "as before", "look"))
    lines += [Verdict("estimate", f"{day}: {reason}", "every day", "bad") for day, reason in trend.failed[:5]]
    if trend.undated:
        lines.append(Verdict("undated logs", "no part of any course", UNDATED_ADVICE, "look"))
    if trend.doubt:
        lines.append(Verdict("days", trend.doubt, f"at least {LEAST_DAYS}", "look", "days"))
    return lines or [Verdict("changes", "none", "none", "good", "changes")]


def _changes_table(found: tuple[Named, ...], doubt: str) -> str:
    if not found and doubt:
        return paragraph(f"No change can be told: {doubt}.")
    if not found:
        return paragraph("No quantity changed beyond its scatter from day to day.")
    rows: list[list[Cell]] = [
        [
            one.change.name,
            one.change.course,
            one.interval,
            Number(one.change.before),
            Number(one.change.after),
            one.unit,
            Number(one.change.percent if np.isfinite(one.change.percent) else None, ".1f"),
            Number(one.change.p, ".1g"),
        ]
        for one in found
    ]
    return table(_HEAD, rows, "Changes of the arm")


def _panels(trend: ArmTrend, names: set[str]) -> str:
    panels = tuple(
        _panel(series, trend.units[name], [one for one in trend.changes if one.change.name == name])
        for name, series in trend.series.items()
        if name in names
    )
    return (
        figure_html(Figure("trend", "Quantities over the days with 95 % intervals", panels)) if panels else ""
    )


def _panel(series: Series, unit: str, found: list[Named]) -> Panel:
    time = series.time - series.time[0]
    interval = np.stack([series.values - 1.96 * series.std, series.values + 1.96 * series.std], axis=1)
    texts = tuple(as_day(day) for day in series.time)
    marks: list[Mark] = [Points("estimate", "estimate of a day", time, series.values, interval, texts)]
    low, high = float(np.min(interval)), float(np.max(interval))
    for one in found:
        at = one.change.time - series.time[0]
        marks.append(Line("limit", "first day of a change", np.array([at, at]), np.array([low, high])))
    said = "; ".join(map(str, found)) or "no change"
    return Panel(
        series.name,
        f"days since {as_day(series.time[0])}",
        f"{series.name} [{unit}]",
        tuple(marks),
        f"{series.name} over {len(time)} days: {said}.",
    )
