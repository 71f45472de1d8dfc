"""The parts of the report below its first table: sessions, the paper's tables, figures, parameters."""

from __future__ import annotations

import math
from collections.abc import Mapping
from html import escape
from typing import Any

from ident.diagnosis.outcome.statements import Number
from ident.estimation.assumptions import HARMLESS, IN_WORDS
from ident.estimators.problem import condition_text
from runner.published import SOURCE, TABLE_2
from runner.report import tables
from runner.report.figures import (
    correlation_figure,
    motion_figure,
    parameter_figure,
    pretty_unit,
    residual_figure,
    torque_figure,
    velocity_figure,
)
from runner.report.folder import ResultFolder
from runner.report.markup import (
    MOST_PERCENT,
    Cell,
    chart_html,
    conditions_table,
    figure_html,
    fold,
    paragraph,
    section,
    table,
)

_PAIRS = 12
_SLOWEST_S = 2e-3
_WORDS: dict[bool | None, str] = {True: "yes", False: "no", None: "–"}


_OF_LOGS = 5
"""Columns of the sessions without those of a link."""


def session_section(results: ResultFolder) -> str:
    """Sessions with their link, and the conditions checked before each motion."""
    links = results.summary.get("link", {})
    rows: list[list[Cell]] = []
    for entry in results.summary["sessions"]:
        name = entry["name"]
        log, link = results.sessions.get(name), links.get(name, {})
        payload = "–" if log is None else log.metadata.get("payload", "")
        if log is not None and payload != "none" and log.metadata.get("payload_mass"):
            payload += f", {log.metadata['payload_mass']} kg"
        latency = link.get("latency_s", {})
        rows.append(
            [
                name,
                "validation" if entry.get("validation") else "estimate",
                entry["exit_status"] + (f": {entry['reason']}" if entry["reason"] else ""),
                payload,
                Number(None if log is None else log.duration_s, ".1f"),
                *(
                    Number(link.get(key), "d", f"link.{name}.{key}")
                    for key in ("cycles", "missed", "lost", "late")
                ),
                *(_micro(latency.get(quantile)) for quantile in ("p50", "p99", "p100")),
                Number(1000 * max(link["worst_tracking_error_rad"]) if link else None, ".1f"),
            ]
        )
    head: tuple[str, ...] = (
        "session", "for", "ended", "payload", "lasted [s]", "cycles", "missed", "lost", "late", "reply 50 % [µs]",
        "99 % [µs]", "worst [µs]", "tracking [mrad]",
    )  # fmt: skip
    label = "Sessions and their link"
    if not links:  # logs of another program
        head, rows, label = head[:_OF_LOGS], [row[:_OF_LOGS] for row in rows], "Sessions"
    parts = [table(head, rows, label)]
    if results.lock_step:
        text = "Lock step: the emulator waited for every reply, so the reply times are not those of a link."
        parts.append(paragraph(text, "soft"))
    if results.unread:
        parts.append(paragraph(f"No log could be read of: {', '.join(results.unread)}.", "soft"))
    if results.summary.get("prepared"):
        parts.append(_signal_table(results))
    for name, items in results.preflights.items():
        label = f"Conditions before the motion of {name}"
        held = f"{sum(i['ok'] for i in items)} of {len(items)} held"
        parts.append(fold(f"{label}: {held}", conditions_table(items, label)))
    return section("sessions", "Sessions, link and limits", *parts)


def _signal_table(results: ResultFolder) -> str:
    """What the estimate made of each session: rows, lost samples, delays, cut-off."""
    rows: list[list[Cell]] = []
    for number, entry in enumerate(results.summary["prepared"]):
        keys = ("rows", "lost_samples", "old_samples")
        counts = (Number(entry.get(key), "d", f"prepared.{number}.{key}") for key in keys)
        delays = (
            entry.get(key)
            for key in ("motor_delay_s", "motor_delay_std_s", "joint_delay_s", "joint_delay_std_s")
        )
        cutoff = Number(entry["cutoff_hz"], ".3g", f"prepared.{number}.cutoff_hz")
        milliseconds = (Number(None if value is None else 1e3 * value, ".2f") for value in delays)
        rows.append([entry["name"], *counts, *milliseconds, cutoff])
    head = (
        "session", "rows", "lost samples", "repeated or old",
        "motor torque late by [ms]", "± [ms]", "joint torque late by [ms]", "± [ms]",
        "cut-off [Hz]",
    )  # fmt: skip
    reasons = results.summary["signals"]["reasons"]
    return table(head, rows, "Signals of the estimate") + "".join(paragraph(one, "soft") for one in reasons)


def table_1_section(results: ResultFolder) -> str:
    """The paper's Table 1 with this run in it."""
    if not (results.summary.get("parameters") and results.published_arm):
        return ""
    condition = results.summary.get("excitation", {}).get("condition", {})
    shown = tables.table_1(results)
    note = (
        "|τ|: mean magnitude of the joint torque; the published motions were loaded. The condition number belongs "
        "to the unscaled observation matrix of all sessions over the 49 parameters of Table 2, in agreement with "
        "the published numbers; that of the recorded sessions is over their filtered rows. Mean and worst RSD are "
        "predicted for the same parameters, with the published noise and equally many independent samples for all "
        "motions. The coefficients of the published motions are not known; the rebuilt ones follow their rules with "
        "T0 = 25 s."
    )
    sets = {"base": "all base parameters", "essential": "the essential ones of this run"}
    others = [f"{condition_text(condition[key])} over {of}" for key, of in sets.items() if condition.get(key)]
    note += f" Condition number of this run: {', '.join(others)}." if others else ""
    if _printed_truths(results)[0]:
        note += (
            " Agreement by construction: the emulated arm has the parameters of Table 2, so equal motions give "
            "about equal torques; only the condition number is a result of the motion itself."
        )
    return section(
        "table-1",
        "Table 1: the exciting motion",
        table(shown.head, shown.rows, "Table 1 with the published values and this run", strong=shown.strong),
        paragraph(f"{tables.better_than_published(results)} {tables.estimate_rsd(results)}".strip()),
        paragraph(note, "soft"),
    )


def table_2_section(results: ResultFolder) -> str:
    """The paper's Table 2 beside the estimates of this run."""
    if not (results.summary.get("parameters") and results.published_arm):
        return ""
    essential = (results.summary.get("essential") or {}).get("parameters", [])
    kept = {entry["name"]: (entry, f"essential.parameters.{i}") for i, entry in enumerate(essential)}
    base = {e["name"]: (e, f"parameters.{i}") for i, e in enumerate(results.summary.get("parameters", []))}
    shown = tables.table_2(results)
    head, rows = shown.head, shown.rows
    half = math.ceil(len(rows) / 2)
    label = "Table 2, estimates of this run and published ones"
    printed_names = {entry.name for entry in TABLE_2}
    forms = {"estimate": ".4g", "std": ".3g", "rsd_percent": ".2f"}
    others = [
        [e["name"], pretty_unit(e["unit"]), *_numbers(e, forms, k)]
        for n, (e, k) in kept.items()
        if n not in printed_names
    ]
    parts = [
        "<div class=halves>",
        table(head, rows[:half], f"{label}, first half"),
        table(head, rows[half:], f"{label}, second half"),
        "</div>",
    ]
    if any(str(row[0]).endswith("*") for row in rows):
        parts.append(paragraph("* not essential in this run; estimate of the full base set.", "soft"))
    if others:
        title = f"{len(others)} further essential parameters of this run, not in Table 2"
        parts.append(fold(title, table(("parameter", "unit", "estimate", "std", "RSD %"), others, title)))
    absent = [printed.name for printed in TABLE_2 if printed.name not in base]
    if absent:
        parts.append(paragraph(_why_absent(results, absent), "soft"))
    eliminated = (results.summary.get("essential") or {}).get("eliminated", [])
    if eliminated:
        title = f"{len(eliminated)} parameters eliminated, in this order"
        forms = {"estimate": ".4g", "rsd_percent": ".1f", "f": ".2f"}
        lines = [[e["name"], *_numbers(e, forms), e["reason"]] for e in eliminated]
        parts.append(fold(title, table(("parameter", "estimate", "RSD %", "F", "reason"), lines, title)))
    printed_truths, truths = _printed_truths(results)
    if printed_truths:
        text = (
            f"Agreement by construction: the emulated arm was built from this table, and {printed_truths} of its "
            f"{truths} true values here are the printed ones. The difference to the published values is therefore "
            "the error of this estimate on the emulated arm. It says nothing about the paper or about a real arm."
        )
        parts.insert(0, paragraph(text))
        source = f"Published: {SOURCE}."
    else:
        source = f"Published: {SOURCE}; the arm and the payload were others than those of this run."
    parts.append(paragraph(source, "soft"))
    return section("table-2", "Table 2: essential base parameters", *parts)


def _printed_truths(results: ResultFolder) -> tuple[int, int]:
    """How many true values of the emulated arm are those of Table 2, to its two decimals, and of how many."""
    printed = {entry.name: entry.estimate for entry in TABLE_2}
    known = [e for e in results.summary.get("parameters", []) if "truth" in e and e["name"] in printed]
    same = [e for e in known if abs(e["truth"] - printed[e["name"]]) <= 0.005 + 1e-9]
    return len(same), len(known)


def _why_absent(results: ResultFolder, absent: list[str]) -> str:
    reasons = []
    if any(name.endswith("8") for name in absent):
        carried = {s.metadata.get("payload", "none") for s in results.sessions.values()} - {"none"}
        regrouped = "no session without the payload, so it is part of link 7 and its regrouped parameters"
        reasons.append(regrouped if carried else "no session with a payload")
    if any("m" in name for name in absent) or "Ia1" in absent:
        reasons.append("no motor torques in the estimate")
    rest = "; ".join(reasons) or "the motion or the model does not show them"
    return f"{len(absent)} published parameters are not in this run: {rest}."


def motion_section(results: ResultFolder) -> str:
    """Figure 2 for each session."""
    parts = []
    for index, one in enumerate(results.curves):
        if one.side == "joint":
            velocity = figure_html(velocity_figure(results, one.session, joints="names"))
            parts.append(fold(f"2a, joint velocities, {one.session}", velocity, is_open=not index))
        torque = figure_html(motion_figure(results, one.session, one.side, joints="names"))
        parts.append(fold(f"2b, {one.side} torques, {one.session}", torque, is_open=not index))
    return section("motion", "Figure 2: velocities and torques of the motion", *parts) if parts else ""


def torque_section(results: ResultFolder) -> str:
    """Figure 3 for each session and side, with the numbers of the computed-torque test."""
    if not results.curves:
        return ""
    head: tuple[str, ...] = (
        "joint", "torque error %", "rms", "bias", "worst", "at [s]", "moving samples only",
        "standstill, % of samples", "standstill, % of squared error", "in the band", "repeatability floor",
    )  # fmt: skip
    if any(one.unseen for one in results.curves):
        origin = "The held-out motion is first."
    else:
        origin = (
            "These are the sessions of the estimate. Test the model on others with `lwr-run validate`, or with a "
            "session with `validation: true` in the experiment file."
        )
    parts = [
        paragraph(
            "Computed torque from the filtered measured motion, and measured torque. Both lines passed the same "
            f"low-pass; the logged samples are behind them, with every spike. {origin}"
        ),
        paragraph(
            "Torque error: rms of measured minus computed torque over rms of the measured torque, all samples as "
            "logged, standstill and reversals included. It has the same value in the first table, in the terminal "
            "and in summary.json (`torque_error`). A resting joint holds any torque up to its Coulomb friction, "
            "beyond any model of the motion; the columns on standstill show its share. In the band: both torques "
            "through the low-pass of the estimation "
            f"({results.curves[0].whole.band_hz:g} Hz); repeatability floor: scatter between the periods there."
        ),
    ]
    units = {score.unit for one in results.curves for score in one.scores}
    if len(units) == 1:
        own = {"rms", "bias", "worst", "moving samples only", "in the band", "repeatability floor"}
        head = tuple(f"{name} [{min(units)}]" if name in own else name for name in head)
    for index, one in enumerate(sorted(results.curves, key=lambda one: not one.unseen)):
        rows: list[list[Cell]] = [
            [
                score.joint if len(units) == 1 else f"{score.joint} [{score.unit}]",
                Number(100 * score.relative, ".2f"),
                *(Number(v, ".3f") for v in (score.rms, score.bias, score.worst)),
                Number(score.worst_time_s, ".2f"),
                Number(score.moving_rms, ".3f"),
                *(Number(100 * v, ".1f") for v in (score.standstill, score.standstill_error)),
                *(Number(v, ".4f") for v in (score.band_rms, score.floor_rms)),
            ]
            for score in one.scores
        ]
        parts.append(
            fold(
                f"{one.label}: torque error of all joints {100 * one.relative:.2f} %",
                figure_html(torque_figure(results, one.session, one.side, joints="names")),
                table(head, rows, f"Residuals, {one.label}"),
                is_open=index < 2,
            )
        )
    return section("torque", "Figure 3: measured and computed torque", *parts)


def residual_section(results: ResultFolder) -> str:
    """Residuals against time, position and velocity."""
    parts = []
    for index, one in enumerate(results.curves):
        for against in ("time", "position", "velocity"):
            figure = figure_html(residual_figure(results, one.session, one.side, against, joints="names"))
            parts.append(fold(f"against {against}: {one.label}", figure, is_open=index == 0))
    return section("residuals", "Residuals against time, position and velocity", *parts) if parts else ""


def assumption_section(results: ResultFolder) -> str:
    """Verdicts on the assumptions of the standard deviations."""
    checks = results.summary.get("assumptions")
    if not checks:
        return ""
    rows: list[list[Cell]] = [
        [
            name,
            check["verdict"].replace("VIOLATED", "violated"),
            check["finding"],
            Number(check["p_value"], ".2g", f"assumptions.{name}.p_value"),
        ]
        for name, check in checks.items()
    ]
    covered = "They need every assumption above."
    if not str(results.summary["covariance"]).startswith("textbook"):
        covered = (
            "They hold for correlated, non-normal residuals of unequal variance, but do not cover a lack of fit or of "
            "exogeneity."
        )
    parts = [
        table(("assumption", "verdict", "finding", "p"), rows, "Assumptions of the estimate"),
        paragraph(f"Standard deviations: {results.summary['covariance']}. {covered}", "soft"),
    ]
    if any(check["verdict"] == HARMLESS for check in checks.values()):
        parts.append(paragraph(f"{IN_WORDS[0].upper()}{IN_WORDS[1:]}.", "soft"))
    if checks.get("lack of fit", {}).get("verdict") == "VIOLATED":
        parts.append(
            paragraph(
                "Lack of fit: a part of the residual repeats in every period. It is unmodelled physics, not noise. "
                "Gear twist and presliding friction cause it in a healthy arm too; the finding gives its size in Nm. "
                "The diagnosis names only causes beyond that, so it may find nothing beside a lack of fit.",
                "soft",
            )
        )
    if results.summary.get("warnings"):
        items = "".join(f"<li>{escape(warning)}</li>" for warning in results.summary["warnings"])
        parts.append(f"<h3>Warnings</h3><ul>{items}</ul>")
    return section("assumptions", "Assumptions", *parts)


def parameter_section(results: ResultFolder) -> str:
    """All base parameters with intervals, and how they are correlated."""
    entries = results.summary.get("parameters")
    if not entries:
        return ""
    shown = tables.parameters(results)
    counts = results.summary["counts"]
    intro = (
        f"Model {results.summary['model']}: {counts['standard']} parameters, {counts['not_identifiable']} "
        f"not identifiable, {counts['regrouped']} regrouped, {counts['base']} base. R marks regrouped "
        "parameters, link 8 is the payload."
    )
    parts = [
        paragraph(intro),
        figure_html(parameter_figure(results)),
        fold(
            f"All {len(entries)} base parameters as a table", table(shown.head, shown.rows, "Base parameters")
        ),
    ]
    return section("parameters", "Parameters and their intervals", *parts) + _correlation(results)


def _correlation(results: ResultFolder) -> str:
    model = results.model
    if model is None or model.covariance is None:
        return ""
    figure = correlation_figure(results)
    rows: list[list[Cell]] = [
        [f"{first} and {second}", Number(value, ".3f")] for first, second, value in figure.strongest(_PAIRS)
    ]
    text = (
        f"{figure.alt} The sum or difference of a strongly correlated pair is more precise than either one."
    )
    pairs = table(("pair", "correlation"), rows, "Strongest correlations")
    return section(
        "correlation",
        "Correlation of the parameters",
        paragraph(text),
        chart_html(figure.chart(), figure.alt, "square"),
        fold("The strongest pairs", pairs, is_open=True),
    )


def provenance_section(results: ResultFolder) -> str:
    """Versions, logs and files of the run."""
    versions = results.summary.get("versions", {})
    rows: list[list[Cell]] = [[name.replace("_", " "), str(value)] for name, value in versions.items()]
    logs = []
    for name, session in results.sessions.items():
        meta = session.metadata
        robot = f"{meta.get('robot', '')} {meta.get('serial', '')}".strip()
        given = [meta.get(key, "") for key in ("uid", "parent_uid", "utc_start", "motor_torque_source")]
        given[1] = given[1] or "–"
        if results.lock_step:
            # The clock of an emulator in lock step starts at a fixed date.
            given[2] = "emulated clock"
        logs.append([name, robot, *given, str(session.missing)])
    head = ("session", "robot", "uid", "goes on from", "started", "motor torque", "missing")
    parts = ["<div class=halves>", table(("", "version"), rows, "Versions")]
    files: list[list[Cell]] = [
        [path.name, Number(path.stat().st_size / 1e3, ".1f")]
        for path in sorted(results.path.iterdir())
        if path.is_file() and path.name != "report.html"
    ]
    parts += [table(("file", "kB"), files, "Files of this run"), "</div>"]
    parts.append(table(head, logs, "Session logs"))
    titles = {"experiment.yaml": "The experiment file", "plan.yaml": "The plan of the motion, with its seed"}
    for name, title in titles.items():
        text = results.text(name)
        if text is not None:
            parts.append(fold(f"{title}, {name}", f"<pre tabindex=0>{escape(text)}</pre>"))
    parts.append(
        "<p>The logs are ordinary MCAP files: <code>rerun session.mcap</code>, PlotJuggler, Foxglove and "
        "Lichtblick open them as they are.</p>"
    )
    return section("provenance", "Provenance", *parts)


def _numbers(entry: Mapping[str, Any], forms: Mapping[str, str], key: str = "") -> list[Number]:
    """Values of an entry. key : place of the entry in summary.json."""
    return [
        Number(
            entry[what], form, key and f"{key}.{what}", MOST_PERCENT if what == "rsd_percent" else math.inf
        )
        for what, form in forms.items()
    ]


def _micro(seconds: float | None) -> Cell:
    # The histogram of the loop ends at 2 ms.
    if seconds is not None and seconds >= _SLOWEST_S:
        return "over 2000"
    return Number(None if seconds is None else 1e6 * seconds, ".0f")
